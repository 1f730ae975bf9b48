"""BCf at run time: block-compressed feature textures and a small network on a device (paper [bcf], Eq. 3, 10, 11)."""

import math
from pathlib import Path

import numpy as np
import warp as wp

from warp_neumat.io.asset import FormatError, expect
from warp_neumat.io.block_formats import BlockTexture, grid, mip_limit, mip_size
from warp_neumat.kernels import arrays, bcf_shade, bcf_storage, dispatch
from warp_neumat.kernels import bcf as kernels
from warp_neumat.kernels.bc6h import bc6h_decode
from warp_neumat.kernels.filter import MOST_MIPS, WRAPS, level_table
from warp_neumat.kernels.mlp import pack
from warp_neumat.materials.base import Material, Shader

COMPONENTS = (("value",), ("x", "y"), ("r", "g"), ("r", "g", "b"), ("r", "g", "b", "a"))
"""Components that a map may have, in order; x and y are those of a normal map."""

ENCODINGS = ("linear", "srgb", "normal")
"""What a channel's number in [0, 1] stands for."""

MOST_CHANNELS = 16

_AGAIN = "fit it again"


class BCf(Material):
    """A material whose maps are decoded from block-compressed features, at any place and scale.

    Args:
        tensors: ``texture{t}.mip{m}`` uint8 (rows, columns, 16) BC6H blocks; ``weight0`` (H, 3T), ``bias0`` (H,),
            ``weight1`` (C, H), ``bias1`` (C,) float16.
        header: The asset's header; its config says sizes, wrap mode, channels and constants.
        path: Where they come from, for messages.
        device: Warp device.
        storage: How features lie in memory: ``"blocks"``, ``"unquantised"`` or ``"half"``, 1, 4 or 8 bytes a texel; the
            results are the same. Each is faster than the one before it, at random places by half or more;
            ``kernels.bcf_storage`` has the figures.

    Raises:
        FormatError: If an array is missing, has another shape or type, or the config is not one of this kind.
        ValueError: If there is no such storage.
    """

    kind = "bcf"

    def __init__(
        self,
        tensors: dict,
        header: dict,
        *,
        path: Path = Path("asset"),
        device=None,
        storage: str = "unquantised",
    ):
        if storage not in kernels.STORAGES:
            raise ValueError(f"storage must be one of {', '.join(kernels.STORAGES)}, got {storage!r}")
        self.header, self.name = header, path.stem
        self.bytes = sum(t.nbytes for t in tensors.values())
        self.device = wp.get_device(device)
        config = _checked(header.get("config"), path)
        self.config: dict = config
        """The asset's config."""
        self.channels: list[dict] = config["channels"]
        """What each output of the network is: map, component, encoding, range."""
        self.constants = {name: np.float32(value) for name, value in config.get("constants", {}).items()}
        """Maps that are one value everywhere, linear."""
        signed = config["signed"]
        self.textures = tuple(_texture(tensors, t, signed, config, path) for t in range(len(config["textures"])))
        """The feature textures, ``BlockTexture`` each."""
        count, hidden, outputs = len(self.textures), config["hidden"], len(self.channels)
        weights, biases = [], []
        for n, (i, o) in enumerate(((3 * count, hidden), (hidden, outputs))):
            weights.append(expect(tensors, f"weight{n}", "float16", (o, i), path))
            biases.append(expect(tensors, f"bias{n}", "float16", (o,), path))
        self.weights = {f"weight{n}": w for n, w in enumerate(weights)} | {f"bias{n}": b for n, b in enumerate(biases)}
        """The network as it is stored: ``weight0`` (H, 3T), ``bias0``, ``weight1`` (C, H), ``bias1``, float16."""

        blocks = np.concatenate([b.reshape(-1, 16) for t in self.textures for b in t.levels[0]])
        wide = bcf_storage.unquantise(blocks, signed) if signed or storage == "unquantised" else None
        if signed and bcf_storage.overflows(wide).any():
            raise FormatError(path, "texture", "a block of mode 14 holds −32768, which decodes to −∞", _AGAIN)
        sizes = [(t.width, t.height) for t in self.textures]
        biases_of_level = [math.log2(max(w / config["width"], h / config["height"])) for w, h in sizes]
        try:
            levels, _ = level_table(sizes, biases_of_level, [t.mips for t in self.textures])
        except ValueError as error:
            raise FormatError(path, "textures", str(error), "fit smaller ones") from None
        self.layout = kernels.Layout(count, hidden, outputs, config["wrap"], signed, storage)
        self.stored_bytes = len(blocks) * bcf_storage.BLOCK_BYTES[storage]
        """Bytes of the features on the device, in their storage."""
        if storage == "half":
            texels = np.concatenate(
                [
                    bcf_storage.paired(
                        bc6h_decode(b.reshape(-1, 16), signed).reshape(*b.shape[:2], 4, 4, 3),
                        *mip_size(t.width, t.height, m),
                        config["wrap"] == "repeat",
                    )
                    for t in self.textures
                    for m, b in enumerate(t.levels[0])
                ]
            )
        else:
            texels = (wide if storage == "unquantised" else blocks).ravel()
        self._arguments = kernels.device_arrays(
            {
                "texels": texels,
                "tables": bcf_storage.packed_tables(signed),
                "levels": levels,
                "weights": pack(weights, biases),
            },
            self.device,
        )
        self._maps = _columns(self.channels)
        self._programs = {
            name: wp.array(np.concatenate(rows).astype(np.int32), device=self.device)
            for name, rows in (("maps", [r for rows in self._maps.values() for r in rows]), ("encoded", _raw(outputs)))
        }

    def encoded(self, uv, lod):
        """Return the network's outputs clamped to [0, 1], in the order of :attr:`channels`, shape [n, C], float32.

        Args:
            uv: Texture coordinates, shape [n, 2]; numpy, torch or Warp. One that is not finite counts as 0, or as the
                nearest edge where an infinite one meets wrap mode ``"clamp"``.
            lod: Mip level of the reference material, 0 = finest, continuous, shape [n] or a number; beyond the mips it
                is clamped, NaN counts as the finest.

        Returns: An array of the kind of ``uv``.
        Raises: ValueError: If a shape or device differs.
        Error: at most 5e-6 against float64 with features to 180, 3e-7 with features of order one; held by
            test_encoded_matches_float64.
        """
        kind, count, result = self._run("encoded", uv, lod, len(self.channels))
        return kind.give(_reshaped(result, 0, (count, len(self.channels))))

    def maps(self, uv, lod) -> dict:
        """Return the maps in linear values, {name: [n, k] float32}, of the kind of ``uv``; normals are unit, [n, 3].

        Constants are broadcast. Arguments as for :meth:`encoded`.

        Error: at most 1e-5 against float64 for values in [0, 1], and for normals with z > 0.1; held by
            test_maps_match_float64.
        """
        widths = {name: len(rows) for name, rows in self._maps.items()}
        kind, count, result = self._run("maps", uv, lod, sum(widths.values()))
        found, start = {}, 0
        for name, width in widths.items():
            found[name] = kind.give(_reshaped(result, start * count, (count, width)))
            start += width
        for name, value in self.constants.items():
            rows = np.ascontiguousarray(np.broadcast_to(value, (count, len(value))))
            found[name] = kind.give(wp.array(rows, dtype=wp.float32, device=self.device))
        return found

    def _run(self, program: str, uv, lod, columns: int):
        kind = arrays.kind_of(uv, self.device)
        at = arrays.take(uv, "uv", ("n", 2), wp.float32, kind)
        if kind.device != self.device:
            raise ValueError(f"uv must be on {self.device}, where the material is, got {kind.device}; move it first")
        count = at.shape[0]
        single = isinstance(lod, (int, float, np.number))
        lods = arrays.take([lod] if single else lod, "lod", (1 if single else count,), wp.float32, kind)
        if count * columns >= 1 << 31:
            raise ValueError(f"uv must have fewer than {(1 << 31) // columns} rows for one call, got {count}")
        result = kind.empty((count * columns,), wp.float32)
        if count:
            lanes = dispatch.lanes(self.device)
            own = self.layout.scratch(lanes) + (3 + self.layout.channels) * lanes
            words = dispatch.worker_count() * own if lanes > 1 else 1
            scratch = wp.empty(words, dtype=wp.float32, device=self.device)
            dispatch.launch(
                kernels.make_eval_kernel(self.layout, lanes),
                dispatch.blocks(count, lanes),
                inputs=[
                    self._arguments, at.flatten(), lods, 0 if single else 1, count, self._programs[program], columns,
                    scratch,
                ],
                outputs=[result],
                device=self.device,
            )  # fmt: skip
        return kind, count, result

    def eval(self, uv, wi, wo):
        """Return value × cos θ_i [1/sr] of the metallic-roughness model with the finest maps, as :meth:`Material.eval`.

        ``uv`` [n, 2] is needed; ``kernels.bcf_shade`` says which maps are used and how.
        """
        kind = arrays.kind_of(wi, self.device)
        incoming = arrays.take(wi, "wi", ("n", 3), wp.float32, kind)
        count = incoming.shape[0]
        outgoing = arrays.take(wo, "wo", (count, 3), wp.float32, kind)
        at = arrays.take(uv, "uv", (count, 2), wp.float32, kind)
        if kind.device != self.device:
            raise ValueError(f"wi must be on {self.device}, where the material is, got {kind.device}; move it first")
        result = kind.empty((count, 3), wp.float32)
        if count == 0:  # Warp does not flatten an empty array
            return kind.give(result)
        shader, lanes = self.shader(), dispatch.lanes(self.device)
        words = dispatch.worker_count() * bcf_shade.eval_scratch(shader.layout, lanes) if lanes > 1 else 1
        dispatch.launch(
            bcf_shade.make_eval_kernel(shader.layout, lanes),
            dispatch.blocks(count, lanes),
            inputs=[
                shader.arguments, at.flatten(), incoming.flatten(), outgoing.flatten(), count,
                wp.empty(words, dtype=wp.float32, device=self.device),
            ],
            outputs=[result.flatten()],
            device=self.device,
        )  # fmt: skip
        return kind.give(result)

    def shader(self) -> Shader:
        """Return what ``kernels.shade`` needs; see :meth:`Material.shader`."""
        program = bcf_shade.slot_program(self.channels, self.constants)
        arguments = bcf_shade.Arguments()
        arguments.maps = self._arguments
        arguments.program = wp.array(program.ravel(), dtype=wp.float32, device=self.device)
        size = (self.config["width"], self.config["height"])
        return Shader(bcf_shade.functions, bcf_shade.Layout(self.layout), arguments, size, bcf_shade.share)


def _reshaped(flat: wp.array, start: int, shape: tuple[int, int]) -> wp.array:
    """View a part of ``flat`` with ``shape``."""
    if 0 in shape:
        return wp.empty(shape, dtype=wp.float32, device=flat.device)
    return flat[start : start + shape[0] * shape[1]].reshape(shape)


# ---- what each column of the result is made from ---------------------------------------------------------------------


def _row(kind: int, a: int, b: int, first: int, width: int, place: int, ranges) -> np.ndarray:
    row = np.zeros(10, np.int32)
    row[:6] = kind, a, b, first, width, place
    (low, high), (low2, high2) = ranges
    row[6:].view(np.float32)[:] = low, high - low, low2, high2 - low2
    return row


def _raw(outputs: int) -> list[np.ndarray]:
    """Return the program that writes the network's outputs as they are."""
    unit = ((0.0, 1.0), (0.0, 1.0))
    return [_row(kernels.LINEAR, k, k, 0, outputs, k, unit) for k in range(outputs)]


def _columns(channels: list[dict]) -> dict[str, list[np.ndarray]]:
    """Return, for each map in the order of the channels, the program rows of its columns."""
    members: dict[str, dict[str, int]] = {}
    for k, channel in enumerate(channels):
        members.setdefault(channel["map"], {})[channel["component"]] = k
    result, first = {}, 0
    for name, found in members.items():
        order = [found[c] for names in COMPONENTS if set(names) == set(found) for c in names]
        ranges = [channels[k]["range"] for k in order]
        if channels[order[0]]["encoding"] == "normal":
            (x, y), swapped = order, ranges[::-1]
            plan = [(kernels.NORMAL, x, y, ranges), (kernels.NORMAL, y, x, swapped), (kernels.NORMAL_Z, x, y, ranges)]
        else:
            plan = [
                (kernels.SRGB if channels[k]["encoding"] == "srgb" else kernels.LINEAR, k, k, (r, r))
                for k, r in zip(order, ranges, strict=True)
            ]
        result[name] = [_row(kind, a, b, first, len(plan), n, r) for n, (kind, a, b, r) in enumerate(plan)]
        first += len(plan)
    return result


# ---- what an asset must hold -----------------------------------------------------------------------------------------


def _whole(config: dict, name: str, least: int, most: int, path, where="config") -> int:
    value = config.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        rule = f"must be a whole number from {least} to {most}, got {value!r}"
        raise FormatError(path, f"{where}.{name}", rule, _AGAIN)
    return value


def _numbers(value, field: str, path, counts) -> None:
    good = isinstance(value, (list, tuple)) and len(value) in counts
    if not good or not all(
        isinstance(v, (int, float)) and not isinstance(v, bool) and abs(v) <= 3e38
        for v in value  # a NaN fails
    ):
        length = " or ".join(map(str, counts))
        raise FormatError(path, field, f"must be {length} finite numbers, got {value!r}", _AGAIN)


def _checked(config, path) -> dict:
    """Return ``config`` if everything in it can be read.

    Raises: FormatError: Naming the first field that cannot.
    """
    if not isinstance(config, dict):
        raise FormatError(path, "config", f"must be an object, got {config!r}", _AGAIN)
    for name, most in (("width", 1 << 20), ("height", 1 << 20), ("hidden", 512)):
        _whole(config, name, 1, most, path)
    if not isinstance(config.get("signed"), bool):
        raise FormatError(path, "config.signed", f"must be true or false, got {config.get('signed')!r}", _AGAIN)
    if config.get("wrap") not in WRAPS:
        rule = f"must be one of {', '.join(WRAPS)}, got {config.get('wrap')!r}"
        raise FormatError(path, "config.wrap", rule, _AGAIN)
    textures = config.get("textures")
    if not isinstance(textures, list) or not 1 <= len(textures) <= 64:
        raise FormatError(path, "config.textures", f"must list 1 to 64 textures, got {textures!r}", _AGAIN)
    for t, texture in enumerate(textures):
        field = f"config.textures[{t}]"
        if not isinstance(texture, dict):
            raise FormatError(path, field, f"must be an object, got {texture!r}", _AGAIN)
        width, height = (_whole(texture, name, 1, (1 << MOST_MIPS) - 1, path, field) for name in ("width", "height"))
        _whole(texture, "mips", 1, mip_limit(width, height), path, field)
    channels = config.get("channels")
    if not isinstance(channels, list) or not 1 <= len(channels) <= MOST_CHANNELS:
        raise FormatError(path, "config.channels", f"must list 1 to {MOST_CHANNELS} channels, got {channels!r}", _AGAIN)
    for k, channel in enumerate(channels):
        _check_channel(channel, f"config.channels[{k}]", path)
    _check_maps(channels, path)
    constants = config.get("constants", {})
    if not isinstance(constants, dict):
        raise FormatError(path, "config.constants", f"must be an object, got {constants!r}", _AGAIN)
    for name, value in constants.items():
        field = f"config.constants.{name}"
        _numbers(value, field, path, (1, 2, 3, 4))
        if any(channel["map"] == name for channel in channels):
            raise FormatError(path, field, "is also a map of the channels", _AGAIN)
    return config


def _check_channel(channel, field: str, path) -> None:
    if not isinstance(channel, dict):
        raise FormatError(path, field, f"must be an object, got {channel!r}", _AGAIN)
    if not isinstance(channel.get("map"), str) or not channel["map"]:
        raise FormatError(path, f"{field}.map", f"must be a name, got {channel.get('map')!r}", _AGAIN)
    known = sorted({c for names in COMPONENTS for c in names})
    if channel.get("component") not in known:
        rule = f"must be one of {', '.join(known)}, got {channel.get('component')!r}"
        raise FormatError(path, f"{field}.component", rule, _AGAIN)
    if channel.get("encoding") not in ENCODINGS:
        rule = f"must be one of {', '.join(ENCODINGS)}, got {channel.get('encoding')!r}"
        raise FormatError(path, f"{field}.encoding", rule, _AGAIN)
    _numbers(channel.get("range"), f"{field}.range", path, (2,))


def _check_maps(channels: list[dict], path) -> None:
    """Check that the components of each map are complete, once each, and normals and only they are x and y."""
    members: dict[str, list[tuple[str, str]]] = {}
    for channel in channels:
        members.setdefault(channel["map"], []).append((channel["component"], channel["encoding"]))
    for name, found in members.items():
        names, encodings = sorted(c for c, _ in found), {e for _, e in found}
        if names not in [sorted(c) for c in COMPONENTS]:
            rule = f"components of {name} must be value, x y, or r g (b (a)), got {', '.join(names)}"
            raise FormatError(path, "config.channels", rule, _AGAIN)
        if len(encodings) > 1 or (names == ["x", "y"]) != (encodings == {"normal"}):
            rule = f"{name} must have one encoding, normal for x and y alone, got {', '.join(sorted(encodings))}"
            raise FormatError(path, "config.channels", rule, _AGAIN)


def _texture(tensors: dict, t: int, signed: bool, config: dict, path) -> BlockTexture:
    """Return feature texture ``t`` of an asset.

    Raises: FormatError: If a mip is missing or has another shape.
    """
    facts = config["textures"][t]
    width, height = facts["width"], facts["height"]
    mips = tuple(
        expect(tensors, f"texture{t}.mip{m}", "uint8", (*grid(*mip_size(width, height, m)), 16), path)
        for m in range(facts["mips"])
    )
    return BlockTexture("bc6h_sf16" if signed else "bc6h_uf16", width, height, (mips,))
