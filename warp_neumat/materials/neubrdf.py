"""NeuBRDF at run time: an asset's codebook, indices, network and texture on a device (paper [neubrdf], Eq. 3, 4).

The asset, versions 1 and 2; a key that version 1 lacks has the value in brackets:

- config: ``nside``, ``features`` k, ``bits`` b, ``hidden`` (1 … 4 widths), ``frame``, ``symmetry`` ["none"],
  ``interpolation`` ["bilinear"], ``output`` ["expm1"], ``texture`` [null] or {width, height, channels, mips};
- ``codebook`` (rows, k) float16, at most 2^b rows; ``indices``, a stream of b bits each for the 2n points of both
  grids;
- ``live`` (optional), zlib-compressed bits of which points ``indices`` has; the others take their ancestors'
  (``kernels/healpix_tree.py``);
- ``weight{n}``, ``bias{n}`` float16, ReLU between layers; inputs: side 0's feature, side 1's, the texture's;
- ``texture.mip{m}`` (h, w, channels) float16.
"""

import difflib
import zlib
from pathlib import Path

import numpy as np
import warp as wp

from warp_neumat.io.asset import FormatError, expect, unpack_bits
from warp_neumat.io.block_formats import mip_limit, mip_size
from warp_neumat.kernels import arrays, dispatch, healpix_tree
from warp_neumat.kernels import neubrdf as kernels
from warp_neumat.kernels.healpix import hemisphere_point_count
from warp_neumat.kernels.neubrdf_frame import FRAMES, INTERPOLATIONS, SYMMETRIES
from warp_neumat.materials.base import Material, Shader

_AGAIN = "fit it again"


class NeuBRDF(Material):
    """A measured BRDF: homogeneous, or varying over the surface with a neural texture.

    Args:
        tensors: The asset's arrays; the module says what they hold.
        header: The asset's header.
        path: Where they come from, for messages.
        device: Warp device.

    Raises: FormatError: If a field or an array is missing, out of range, or of another shape or type.
    """

    kind = "neubrdf"

    def __init__(self, tensors: dict, header: dict, *, path: Path = Path("asset"), device=None):
        self.header, self.name = header, path.stem
        self.bytes = sum(t.nbytes for t in tensors.values())
        self.device = wp.get_device(device)
        self.config = config = _checked(header.get("config"), path)
        features, hidden, texture = config["features"], tuple(config["hidden"]), config["texture"]
        rows = len(tensors["codebook"]) if np.ndim(tensors.get("codebook")) == 2 else 1
        if rows > 2 ** config["bits"]:
            raise FormatError(path, "codebook", f"has {rows} rows, more than {config['bits']} bits can name", _AGAIN)
        codebook = expect(tensors, "codebook", "float16", (rows, features), path)
        channels = texture["channels"] if texture else 0
        widths = (2 * features + channels, *hidden, 3)
        layers = range(len(widths) - 1)
        weights = [expect(tensors, f"weight{n}", "float16", (widths[n + 1], widths[n]), path) for n in layers]
        biases = [expect(tensors, f"bias{n}", "float16", (widths[n + 1],), path) for n in layers]
        index = _indices(tensors, config, path)
        if int(index.max()) >= rows:
            raise FormatError(path, "indices", f"name primitive {int(index.max())} of {rows}", "copy or fit it again")
        points = len(index) // 2
        names = ("frame", "symmetry", "interpolation")
        self.layout = kernels.Layout(hidden, *(config[name] for name in names), channels)
        data = kernels.fold(codebook, weights, biases, interpolation=config["interpolation"])
        data |= {"index_0": index[:points], "index_1": index[points:]}
        if texture:
            data["levels"], data["texels"] = kernels.pack_texture(_mips(tensors, texture, path))
        else:
            del data["texel_weights"]
        self._grid = kernels.Grid()
        self._grid.nside = config["nside"]
        for name, value in data.items():
            dtype = wp.dtype_from_numpy(value.dtype)
            setattr(self._grid, name, wp.array(value.ravel(), dtype=dtype, device=self.device))

    @property
    def textured(self) -> bool:
        """Whether the material varies over the surface."""
        return self.layout.channels > 0

    def eval(self, uv, wi, wo, lod=0.0):
        """Return value × cos θ_i; see :meth:`Material.eval`. Directions are normalised.

        Args:
            uv: Texture coordinates, shape [n, 2]; ignored, and may be None, without a texture. One that is not finite
                counts as 0.
            wi: Directions to the light, shape [n, 3]; numpy, torch or Warp.
            wo: Directions to the viewer, shape [n, 3].
            lod: Mip level of the texture, 0 = finest, continuous, a number or shape [n]; clamped to the mips, and NaN
                counts as the finest.

        Raises: ValueError: If a shape or device differs, or ``uv`` is None for a textured material.
        Error: at most 5e-5 of 1 + f against the float64 reference for N = 8 and random contents, of which the half
        frames need 2e-5 and the others 3e-6 (2e-4 and 2e-5 at N = 64: rounding is amplified by N, by fitted contents
        less); held by test_neubrdf_kernel_matches_float64.
        """
        kind = arrays.kind_of(wi, self.device)
        incoming = arrays.take(wi, "wi", ("n", 3), wp.float32, kind)
        outgoing = arrays.take(wo, "wo", (incoming.shape[0], 3), wp.float32, kind)
        if kind.device != self.device:
            raise ValueError(f"wi must be on {self.device}, where the material is, got {kind.device}; move it first")
        result, count = kind.empty(incoming.shape, wp.float32), incoming.shape[0]
        at = levels = None
        if self.textured:
            if uv is None:
                raise ValueError(f"uv must be given for {self.name}, which has a texture; pass shape [{count}, 2]")
            at = arrays.take(uv, "uv", (count, 2), wp.float32, kind)
            single = np.ndim(lod) == 0 if not hasattr(lod, "shape") else len(lod.shape) == 0
            lod = np.full(1, float(lod), np.float32) if single else lod
            numbers = arrays.Kind("numpy", self.device) if single else kind
            levels = arrays.take(lod, "lod", (1 if single else count,), wp.float32, numbers)
        if count == 0:  # Warp does not flatten an empty array
            return kind.give(result)
        lanes = dispatch.lanes(self.device)
        words = dispatch.worker_count() * kernels.eval_scratch(self.layout, lanes) if lanes > 1 else 1
        dispatch.launch(
            kernels.make_eval_kernel(self.layout, lanes),
            dispatch.blocks(count, lanes),
            inputs=[
                self._grid, at.flatten() if at is not None else None, levels,
                int(levels is not None and levels.shape[0] == count), incoming.flatten(), outgoing.flatten(), count,
                wp.empty(words, dtype=wp.float32, device=self.device),
            ],
            outputs=[result.flatten()],
            device=self.device,
            grain=1,
        )  # fmt: skip
        return kind.give(result)

    def shader(self) -> Shader:
        """Return what ``kernels.shade`` needs; see :meth:`Material.shader`."""
        texture = self.config["texture"]
        size = (texture["width"], texture["height"]) if texture else None
        return Shader(kernels.functions, self.layout, self._grid, size)


# ---- what an asset must hold -----------------------------------------------------------------------------------------


def _whole(config: dict, name: str, least: int, most: int, path, where: str = "config") -> int:
    value = config.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        rule = f"must be a whole number from {least} to {most}, got {value!r}"
        raise FormatError(path, f"{where}.{name}", rule, _AGAIN)
    return value


def _word(config: dict, name: str, known, path, default=None) -> str:
    value = config.get(name, default)
    if value not in known:
        near = difflib.get_close_matches(str(value), known, n=1, cutoff=0.4)
        hint = f"nearest: {near[0]}; or {_AGAIN}" if near else _AGAIN
        raise FormatError(path, f"config.{name}", f"must be one of {', '.join(known)}, got {value!r}", hint)
    return value


def _checked(config, path) -> dict:
    """Return what is read of ``config``, defaults filled in.

    Raises: FormatError: Naming the first field that cannot be read.
    """
    if not isinstance(config, dict):
        raise FormatError(path, "config", f"must be an object, got {config!r}", _AGAIN)
    result = {
        name: _whole(config, name, 1, most, path) for name, most in (("nside", 1024), ("features", 256), ("bits", 16))
    }
    hidden = config.get("hidden")
    good = isinstance(hidden, (list, tuple)) and 1 <= len(hidden) <= 4
    if not good or any(type(h) is not int or not 8 <= h <= 512 or h % 8 for h in hidden):
        rule = f"must be 1 to 4 multiples of 8, at most 512, got {hidden!r}"
        raise FormatError(path, "config.hidden", rule, _AGAIN)
    result["hidden"] = list(hidden)
    result["frame"] = _word(config, "frame", FRAMES, path)
    result["symmetry"] = _word(config, "symmetry", SYMMETRIES, path, "none")
    result["interpolation"] = _word(config, "interpolation", INTERPOLATIONS, path, "bilinear")
    _word(config, "output", ("expm1",), path, "expm1")
    if result["symmetry"] != "none" and result["frame"] not in ("half", "half-isotropic"):
        rule = f"{result['symmetry']} needs a half frame, but config.frame is {result['frame']}"
        raise FormatError(path, "config.symmetry", rule, _AGAIN)
    texture = config.get("texture")
    if texture is not None:
        if not isinstance(texture, dict):
            raise FormatError(path, "config.texture", f"must be an object or null, got {texture!r}", _AGAIN)
        limits = (("width", 65535), ("height", 65535), ("channels", 64))
        texture = {name: _whole(texture, name, 1, most, path, "config.texture") for name, most in limits} | {
            "mips": texture.get("mips")
        }
        _whole(texture, "mips", 1, mip_limit(texture["width"], texture["height"]), path, "config.texture")
    result["texture"] = texture
    return result


def _indices(tensors: dict, config: dict, path) -> np.ndarray:
    """Return the index of every point of both sides, (2n,) uint16."""
    points, bits = hemisphere_point_count(config["nside"]), config["bits"]
    live = _live(tensors, 2 * points, path)
    count = 2 * points if live is None else int(live.sum())
    stream = expect(tensors, "indices", "uint8", (-(-count * bits // 8),), path)
    index = unpack_bits(stream, bits, count).astype(np.uint16)
    return index if live is None else healpix_tree.expand(config["nside"], live, index)


def _live(tensors: dict, count: int, path) -> np.ndarray | None:
    """Return which of the ``count`` points are stored, or None for all."""
    if "live" not in tensors:
        return None
    stored = tensors["live"]
    if stored.dtype != np.uint8 or stored.ndim != 1:
        rule = f"must be bytes in one row, got {stored.dtype} of shape {stored.shape}"
        raise FormatError(path, "live", rule, _AGAIN)
    size = -(-count // 8)
    unpacker = zlib.decompressobj()
    try:
        # No more is unpacked than can be right, whatever the bytes claim.
        data = unpacker.decompress(stored.tobytes(), size + 1)
    except zlib.error as error:
        raise FormatError(path, "live", f"is not zlib data ({error})", "copy or fit it again") from None
    if len(data) != size or not unpacker.eof:
        raise FormatError(path, "live", f"must unpack to {size} bytes, one bit a point", "copy or fit it again")
    live = np.unpackbits(np.frombuffer(data, np.uint8), count=count, bitorder="little").astype(bool)
    if not all(side.any() for side in np.split(live, 2)):
        raise FormatError(path, "live", "must keep at least one point of each side", _AGAIN)
    return live


def _mips(tensors: dict, texture: dict, path) -> list[np.ndarray]:
    width, height = texture["width"], texture["height"]
    sizes = [mip_size(width, height, m) for m in range(texture["mips"])]
    if sum(w * h for w, h in sizes) * kernels.padded(texture["channels"], kernels.CHANNEL_PAD) >= 1 << 31:
        raise FormatError(path, "config.texture", "has more values than 31 bits can number", "fit a smaller one")
    return [
        expect(tensors, f"texture.mip{m}", "float16", (h, w, texture["channels"]), path)
        for m, (w, h) in enumerate(sizes)
    ]
