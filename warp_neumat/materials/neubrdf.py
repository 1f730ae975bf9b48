"""NeuBRDF at run time: an asset's codebook, indices and network on a device (paper [neubrdf], Eq. 3)."""

from pathlib import Path

import warp as wp

from warp_neumat.io.asset import FormatError, expect, unpack_bits
from warp_neumat.kernels import arrays, dispatch
from warp_neumat.kernels import neubrdf as kernels
from warp_neumat.kernels.healpix import hemisphere_point_count
from warp_neumat.materials.base import Material, Shader


class NeuBRDF(Material):
    """A homogeneous BRDF; ``uv`` is ignored.

    Args:
        tensors: The asset's arrays; ``models/neubrdf.py`` says what they hold.
        header: The asset's header.
        path: Where they come from, for messages.
        device: Warp device.

    Raises: FormatError: If an array is missing, has another shape or type, or holds an index out of range.
    """

    kind = "neubrdf"

    def __init__(self, tensors: dict, header: dict, *, path: Path = Path("asset"), device=None):
        self.header, self.name = header, path.stem
        self.bytes = sum(t.nbytes for t in tensors.values())
        self.device = wp.get_device(device)
        config = header.get("config", {})
        try:
            nside, features, bits = int(config["nside"]), int(config["features"]), int(config["bits"])
            hidden, frame = tuple(int(h) for h in config["hidden"]), config["frame"]
        except (KeyError, TypeError, ValueError) as error:
            raise FormatError(path, "config", f"lacks or misstates {error}", "fit it again") from None
        if not (1 <= nside <= 1024 and 1 <= features <= 256 and 1 <= bits <= 16 and hidden and max(hidden) <= 512):
            raise FormatError(path, "config", f"is out of range: {config}", "fit it again")
        if frame not in ("absolute", "isotropic"):
            raise FormatError(path, "config.frame", f'must be "absolute" or "isotropic", got {frame!r}', "fit it again")
        points = hemisphere_point_count(nside)
        codebook = expect(tensors, "codebook", "float16", (2**bits, features), path)
        stream = expect(tensors, "indices", "uint8", (-(-2 * points * bits // 8),), path)
        widths = (2 * features, *hidden, 3)
        layers = range(len(widths) - 1)
        weights = [expect(tensors, f"weight{n}", "float16", (widths[n + 1], widths[n]), path) for n in layers]
        biases = [expect(tensors, f"bias{n}", "float16", (widths[n + 1],), path) for n in layers]

        index = unpack_bits(stream, bits, 2 * points).astype("uint16")
        table_i, table_o, packed = kernels.fold(codebook, weights, biases)
        self.layout = kernels.Layout(hidden, frame == "isotropic")
        self._grid = kernels.Grid()
        self._grid.nside = nside
        for name, value in {
            "index_i": index[:points],
            "index_o": index[points:],
            "table_i": table_i.ravel(),
            "table_o": table_o.ravel(),
            "weights": packed,
        }.items():
            dtype = wp.uint16 if name.startswith("index") else wp.float32
            setattr(self._grid, name, wp.array(value, dtype=dtype, device=self.device))

    def eval(self, uv, wi, wo):
        """Return value × cos θ_i; see :meth:`Material.eval`. Directions are normalised, ``uv`` is ignored.

        Error: at most 2e-5 of 1 + f against the float64 reference; held by test_neubrdf_kernel_matches_float64.
        """
        kind = arrays.kind_of(wi, self.device)
        incoming = arrays.take(wi, "wi", ("n", 3), wp.float32, kind)
        outgoing = arrays.take(wo, "wo", (incoming.shape[0], 3), wp.float32, kind)
        if kind.device != self.device:
            raise ValueError(f"wi must be on {self.device}, where the material is, got {kind.device}; move it first")
        result, count = kind.empty(incoming.shape, wp.float32), incoming.shape[0]
        if count == 0:  # Warp does not flatten an empty array
            return kind.give(result)
        lanes = dispatch.lanes(self.device)
        words = dispatch.worker_count() * (self.layout.scratch(lanes) + 10 * lanes) if lanes > 1 else 1
        dispatch.launch(
            kernels.make_eval_kernel(self.layout, lanes),
            dispatch.blocks(count, lanes),
            inputs=[
                self._grid,
                incoming.flatten(),
                outgoing.flatten(),
                count,
                wp.empty(words, dtype=wp.float32, device=self.device),
            ],
            outputs=[result.flatten()],
            device=self.device,
            grain=1,
        )
        return kind.give(result)

    def shader(self) -> Shader:
        """Return what ``kernels.shade`` needs; see :meth:`Material.shader`."""
        return Shader(kernels.functions, self.layout, self._grid)
