"""Neural BTFs at run time: an asset's networks and feature textures on a device (paper [mobilevr], §4.1, 4.3, 4.4).

The asset, version 1:

- config: ``width``, ``height``, ``mips``; ``fine`` {channels, hidden}; ``coarse`` {channels, hidden, latent} or null, a
  single level; ``half_vector``; ``activation``, ``"relu"`` or ``"hardswish"``; ``features``, ``"half"`` or ``"bc6h"``;
- ``fine.weight{n}`` (out, in), ``fine.bias{n}``, ``coarse.weight{n}``, ``coarse.bias{n}`` float16, the
  activation after every layer but the last of the fine network. Inputs of the coarse network: ω_i, ω_o, the half
  vector, the coarse features; of the fine one: the coarse network's outputs, the fine features. A single level: the
  angles, the fine features;
- ``fine.mip{m}`` (h, w, channels) float16, ``coarse.mip{m}`` of half its size; for ``"bc6h"`` instead
  ``fine.block{t}.mip{m}`` (rows, columns, 16) uint8, signed BC6H, channels 3t … 3t + 2, decoded when opened.

The value includes the cosine (Eq. 1): max(output, 0), and 0 where a direction lies below the horizon.
"""

from pathlib import Path

import numpy as np
import warp as wp

from warp_neumat.io.asset import FormatError, expect
from warp_neumat.io.block_formats import grid, mip_limit, mip_size
from warp_neumat.kernels import arrays, btf_code, dispatch
from warp_neumat.kernels import btf as kernels
from warp_neumat.kernels.bc6h import bc6h_decode
from warp_neumat.materials.base import Material, Shader

FEATURES = ("half", "bc6h")
"""How features are stored in an asset."""

_AGAIN = "fit it again"


class BTF(Material):
    """A measured or simulated bidirectional texture function, as a coarse and a fine network or a single one.

    Args:
        tensors: The asset's arrays; the module says what they hold.
        header: The asset's header.
        path: Where they come from, for messages.
        device: Warp device.

    Raises: FormatError: If a field or an array is missing, out of range, or of another shape or type.
    """

    kind = "btf"

    def __init__(self, tensors: dict, header: dict, *, path: Path = Path("asset"), device=None):
        self.header, self.name = header, path.stem
        self.bytes = sum(t.nbytes for t in tensors.values())
        self.device = wp.get_device(device)
        self.config: dict = _checked(header.get("config"), path)
        """The asset's config."""
        fine, coarse = (
            kernels.Net(net["channels"], tuple(net["hidden"])) if net else None
            for net in (self.config["fine"], self.config["coarse"])
        )
        latent = self.config["coarse"]["latent"] if coarse else 0
        self.layout = kernels.Layout(fine, coarse, latent, self.config["half_vector"], self.config["activation"])
        self.weights: int = self.layout.parameters
        """Number of network weights and biases."""
        weights, biases = {}, {}
        for name, widths in self.layout.widths.items():
            sizes = list(enumerate(zip(widths[:-1], widths[1:], strict=True)))
            weights[name] = [_finite(tensors, f"{name}.weight{n}", (o, i), path) for n, (i, o) in sizes]
            biases[name] = [_finite(tensors, f"{name}.bias{n}", (o,), path) for n, (_, o) in sizes]
        textures = {name: _mips(tensors, name, self.config, path) for name in weights}
        try:
            self._arguments = kernels.device_arrays(
                self.layout, weights, biases, textures["fine"], textures.get("coarse"), self.device
            )
        except ValueError as error:
            raise FormatError(path, "config", str(error), "fit a smaller one") from None

    def eval(self, uv, wi, wo, lod=0.0):
        """Return value × cos θ_i of rows by themselves; see :meth:`Material.eval`. Directions are normalised.

        Args:
            uv: Texture coordinates, shape [n, 2]; the texture repeats, and one that is not finite counts as 0.
            wi: Directions to the light, shape [n, 3]; numpy, torch or Warp.
            wo: Directions to the viewer, shape [n, 3].
            lod: Mip level, 0 = finest, a number or shape [n]; rounded and clamped to the mips, NaN is the finest.

        Raises: ValueError: If a shape or device differs, or ``uv`` is None.
        Error: at most 1e-5 of the largest value against float64 (worst seen 2e-6, textures to 1024² and uv to ±8); held
            by test_rows_match_float64.
        """
        return self._run(uv, wi, wo, lod, quads=False)

    def eval_quads(self, uv, wi, wo, lod=0.0):
        """Return value × cos θ_i [1/sr] of quads, shape [n, 4, 3]: the coarse network once, the fine one four times.

        The coarse texture is read at the mean uv, unless a quad's uv lie more than ``btf_code.SEAM`` texels of its mip
        apart: then each of its texels is evaluated by itself, as :meth:`eval` does it.

        Args:
            uv: Texture coordinates of the texels, shape [n, 4, 2], as for :meth:`eval`.
            wi: Directions to the light, shape [n, 3]; numpy, torch or Warp.
            wo: Directions to the viewer, shape [n, 3].
            lod: Mip level, a number or shape [n].

        Raises: ValueError: If a shape or device differs.
        Error: at most 1e-5 of the largest value against float64 (worst seen 5e-6, textures to 1024² and uv to ±8); held
            by test_quads_match_float64.
        """
        return self._run(uv, wi, wo, lod, quads=True)

    def _run(self, uv, wi, wo, lod, quads: bool):
        kind = arrays.kind_of(wi, self.device)
        incoming = arrays.take(wi, "wi", ("n", 3), wp.float32, kind)
        rows, per_row = incoming.shape[0], 4 if quads else 1
        outgoing = arrays.take(wo, "wo", (rows, 3), wp.float32, kind)
        if kind.device != self.device:
            raise ValueError(f"wi must be on {self.device}, where the material is, got {kind.device}; move it first")
        shape = (rows, 4, 2) if quads else (rows, 2)
        if uv is None:
            raise ValueError(f"uv must be given for {self.name}, which varies in space; pass shape {list(shape)}")
        at = arrays.take(uv, "uv", shape, wp.float32, kind)
        single = np.ndim(lod) == 0 if not hasattr(lod, "shape") else len(lod.shape) == 0
        lod = np.full(1, float(lod), np.float32) if single else lod
        numbers = arrays.Kind("numpy", self.device) if single else kind
        levels = arrays.take(lod, "lod", (1 if single else rows,), wp.float32, numbers)
        if 3 * rows * per_row >= 1 << 31:
            raise ValueError(f"wi must have fewer than {(1 << 31) // (3 * per_row)} rows for one call, got {rows}")
        result = kind.empty((rows, 4, 3) if quads else (rows, 3), wp.float32)
        if rows == 0:  # Warp does not flatten an empty array
            return kind.give(result)
        lanes = kernels.eval_lanes(dispatch.lanes(self.device), quads)
        words = dispatch.worker_count() * kernels.eval_scratch(self.layout, lanes) if lanes > 4 else 1
        dispatch.launch(
            kernels.make_eval_kernel(self.layout, lanes),
            dispatch.blocks(rows * per_row, lanes),
            inputs=[
                self._arguments, at.flatten(), levels, 0 if single else 1, incoming.flatten(), outgoing.flatten(),
                2 if quads else 0, rows * per_row, wp.empty(words, dtype=wp.float32, device=self.device),
            ],
            outputs=[result.flatten()],
            device=self.device,
            grain=1,
        )  # fmt: skip
        return kind.give(result)

    def shader(self) -> Shader:
        """Return what ``kernels.shade`` needs; see :meth:`Material.shader`."""
        size = (self.config["width"], self.config["height"])
        return Shader(kernels.functions, self.layout, self._arguments, size, kernels.share)


# ---- what an asset must hold -----------------------------------------------------------------------------------------


def _whole(config: dict, name: str, least: int, most: int, path, where: str = "config") -> int:
    value = config.get(name)
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        rule = f"must be a whole number from {least} to {most}, got {value!r}"
        raise FormatError(path, f"{where}.{name}", rule, _AGAIN)
    return value


def _net(config: dict, name: str, path) -> dict:
    net, where = config.get(name), f"config.{name}"
    if not isinstance(net, dict):
        rule = "must be an object" + (" or null" if name == "coarse" else "")
        raise FormatError(path, where, f"{rule}, got {net!r}", _AGAIN)
    result = {"channels": _whole(net, "channels", 1, 64, path, where)}
    hidden = net.get("hidden")
    good = isinstance(hidden, (list, tuple)) and 1 <= len(hidden) <= 16
    if not good or any(type(h) is not int or not 1 <= h <= 512 for h in hidden):
        rule = f"must be 1 to 16 widths, each from 1 to 512, got {hidden!r}"
        raise FormatError(path, f"{where}.hidden", rule, _AGAIN)
    result["hidden"] = list(hidden)
    if name == "coarse":
        result["latent"] = _whole(net, "latent", 1, 512, path, where)
    return result


def _checked(config, path) -> dict:
    """Return what is read of ``config``.

    Raises: FormatError: Naming the first field that cannot be read.
    """
    if not isinstance(config, dict):
        raise FormatError(path, "config", f"must be an object, got {config!r}", _AGAIN)
    result = {name: _whole(config, name, 1, 65535, path) for name in ("width", "height")}
    result["mips"] = _whole(config, "mips", 1, mip_limit(result["width"], result["height"]), path)
    result["fine"] = _net(config, "fine", path)
    if "coarse" not in config:
        raise FormatError(path, "config.coarse", "is missing; it is an object or null", _AGAIN)
    result["coarse"] = None if config["coarse"] is None else _net(config, "coarse", path)
    if not isinstance(config.get("half_vector"), bool):
        rule = f"must be true or false, got {config.get('half_vector')!r}"
        raise FormatError(path, "config.half_vector", rule, _AGAIN)
    result["half_vector"] = config["half_vector"]
    for name, known in (("activation", tuple(btf_code.ACTIVATIONS)), ("features", FEATURES)):
        if config.get(name) not in known:
            rule = f"must be one of {', '.join(known)}, got {config.get(name)!r}"
            raise FormatError(path, f"config.{name}", rule, _AGAIN)
        result[name] = config[name]
    return result


def _finite(tensors: dict, name: str, shape: tuple[int, ...], path) -> np.ndarray:
    tensor = expect(tensors, name, "float16", shape, path)
    if not np.isfinite(tensor).all():
        raise FormatError(path, name, "must be finite", _AGAIN)
    return tensor


def _mips(tensors: dict, name: str, config: dict, path) -> list[np.ndarray]:
    """Return the mips (h, w, channels) float16 of the texture ``"fine"`` or ``"coarse"``."""
    channels, mips = config[name]["channels"], []
    for m in range(config["mips"]):
        width, height = mip_size(config["width"], config["height"], m)
        if name == "coarse":
            width, height = mip_size(width, height, 1)
        if config["features"] == "half":
            mips.append(_finite(tensors, f"{name}.mip{m}", (height, width, channels), path))
            continue
        parts, (rows, columns) = [], grid(width, height)
        for t in range(-(-channels // 3)):
            blocks = expect(tensors, f"{name}.block{t}.mip{m}", "uint8", (rows, columns, 16), path)
            texels = bc6h_decode(np.ascontiguousarray(blocks).reshape(-1, 16), signed=True)
            if not np.isfinite(texels).all():
                raise FormatError(path, f"{name}.block{t}.mip{m}", "decodes to −∞", _AGAIN)
            picture = texels.reshape(rows, columns, 4, 4, 3).swapaxes(1, 2).reshape(4 * rows, 4 * columns, 3)
            parts.append(picture[:height, :width])
        mips.append(np.ascontiguousarray(np.concatenate(parts, axis=2)[..., :channels]))
    return mips
