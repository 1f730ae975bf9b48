"""What all materials with maps share at run time: channels that kernels evaluate at any place and scale.

A subclass brings a ``kernels.bcf.Layout`` and its device arrays, and all that follows from channels is here: maps in
linear values, shading, and what a renderer needs.
"""

import numpy as np
import warp as wp

from warp_neumat.kernels import arrays, bcf_shade, dispatch
from warp_neumat.kernels import bcf as kernels
from warp_neumat.materials.base import Material, Shader
from warp_neumat.materials.map_config import COMPONENTS


class MapMaterial(Material):
    """A material made of maps: channels in [0, 1] that vary over the surface, and constants.

    Args:
        config: The checked config (:func:`warp_neumat.materials.map_config.check_maps`).
        layout: What its kernels are compiled for; its first ``len(config["channels"])`` outputs are the channels.
        held: Arrays by attribute of ``kernels.bcf.Arguments``.
        device: Warp device.
    """

    def __init__(self, config: dict, layout: kernels.Layout, held: dict, device):
        self.device = wp.get_device(device)
        self.config: dict = config
        """The asset's config."""
        self.channels: list[dict] = config["channels"]
        """What each number of :meth:`encoded` is: map, component, encoding, range."""
        self.constants = {name: np.float32(value) for name, value in config.get("constants", {}).items()}
        """Maps that are one value everywhere, linear."""
        self.layout = layout
        self._arguments = kernels.device_arrays(held, self.device)
        self._maps = _columns(self.channels)
        self._programs = {
            name: wp.array(np.concatenate(rows).astype(np.int32), device=self.device)
            for name, rows in (
                ("maps", [r for rows in self._maps.values() for r in rows]),
                ("encoded", _raw(len(self.channels))),
            )
        }

    def encoded(self, uv, lod):
        """Return the channels in [0, 1], in the order of :attr:`channels`, shape [n, C], float32.

        Args:
            uv: Texture coordinates, shape [n, 2]; numpy, torch or Warp. One that is not finite counts as 0, or as the
                nearest edge where an infinite one meets wrap mode ``"clamp"``.
            lod: Mip level of the reference material, 0 = finest, continuous, shape [n] or a number; beyond the mips it
                is clamped, NaN counts as the finest.

        Returns: An array of the kind of ``uv``.
        Raises: ValueError: If a shape or device differs.
        Error: a BCf's at most 5e-6 against float64 with features to 180, 3e-7 with features of order one; held by
            test_encoded_matches_float64. Block textures': ``BlockMaps`` says.
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
    """Return the program that writes the channels as they are."""
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
