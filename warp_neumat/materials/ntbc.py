"""NTBC at run time: networks that write BC1, BC4 and BC7 blocks once, when the asset is opened (paper [ntbc], §3).

Mip 0 is what the networks say: predicted endpoints, and for each texel the palette entry nearest to its predicted
colour. Further mips, down to 1×1, are filtered from the predicted colours (``io/mipmaps.py`` says how) and encoded by
the fast encoders of ``kernels/block_fit.py``, as is mip 0 of an asset whose endpoints are ``"fitted"``. From there on
it is :class:`~warp_neumat.materials.block_maps.BlockMaps`: no network is left.
"""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import warp as wp

from warp_neumat.io.asset import expect, packed_bytes, unpack_bits
from warp_neumat.io.block_formats import FORMATS, BlockTexture, grid, mip_size
from warp_neumat.kernels.block_fit import bc1_encode, bc4_encode, bc7_encode
from warp_neumat.kernels.colour_metric import plane_metrics
from warp_neumat.kernels.mip_chain import mip_blocks
from warp_neumat.kernels.ntbc import ModelShape, ntbc_blocks
from warp_neumat.kernels.ntbc_network import NetworkShape
from warp_neumat.materials.block_maps import BlockMaps
from warp_neumat.materials.ntbc_config import Plane, check_ntbc, planes_of, sources_of

_NORMAL = [("normal", "x"), ("normal", "y")]


class NTBC(BlockMaps):
    """A material whose block-compressed textures are written by networks at load.

    Args:
        tensors: For model i and each of its networks, ``model{i}.{endpoint|texel}.``: ``grid{l}``, uint8 of codes q
            (h, w, features) packed as :func:`~warp_neumat.io.asset.pack_bits` says, whose values are scale · (q − zero)
            with ``scale`` (L,) float32 and ``zero`` (L,) int16 (NTBC Eq. 2). ``weight{n}`` (out, in) and ``bias{n}``
            (out,) float16 of the hidden layers and the output.
        header: The asset's header; :mod:`~warp_neumat.materials.ntbc_config` says what its config holds.
        path: Where they come from, for messages.
        device: Warp device, which the networks run on too.

    Raises:
        FormatError: If an array is missing, has another shape or type, or the config is not one of this kind.
    """

    kind = "ntbc"

    def __init__(self, tensors: dict, header: dict, *, path: Path = Path("asset"), device=None):
        config = check_ntbc(header.get("config"), path)
        device = wp.get_device(device)
        clock = _Clock()
        planes = planes_of(config)
        metrics = plane_metrics(config["metric"], [(p.components, p.channels) for p in planes], config["channels"])
        metric_of = {(p.texture, p.number): g for p, g in zip(planes, metrics, strict=True)}
        plane_at = {(p.texture, p.number): p for p in planes}
        levels: dict[tuple[int, int], list[np.ndarray]] = {}
        places: dict[int, tuple[wp.array, int, int]] = {}  # channel → source of mip_blocks
        rows, columns = grid(config["width"], config["height"])
        for i, model in enumerate(config["models"]):
            served = [plane_at[tuple(pair)] for pair in model["planes"]]
            metric = np.stack([metric_of[tuple(pair)] for pair in model["planes"]])
            written, colours = _predicted(tensors, config, i, served, metric, path, device)
            clock.lap("networks")
            row, total = 0, sum(p.components for p in served)
            for plane, blocks in zip(served, written, strict=True):
                key = plane.texture, plane.number
                if config["endpoints"] == "fitted":
                    own = colours.numpy()[:, row : row + plane.components].swapaxes(1, 2)
                    blocks = _encoded(plane, own, metric_of[key]).reshape(rows, columns, -1)
                    clock.lap("fit")
                levels[key] = [blocks]
                for n, channel in enumerate(plane.channels):
                    places[channel] = colours.flatten(), total, row + n
                row += plane.components
        sources = [places[k] for k in range(len(config["channels"]))]
        texels, counts = mip_blocks(config["channels"], sources, config["width"], config["height"], device)
        texels = texels.numpy()
        clock.lap("filter")
        sizes = [mip_size(config["width"], config["height"], mip + 1) for mip in range(len(counts))]
        for plane in planes:
            key, begin = (plane.texture, plane.number), 0
            blocks = _encoded(plane, _filled(plane, texels, config["channels"]), metric_of[key])
            for size, count in zip(sizes, counts, strict=True):
                levels[key].append(blocks[begin : begin + count].reshape(*grid(*size), -1))
                begin += count
        clock.lap("fit")
        textures = [_texture(config, t, levels) for t in range(len(config["textures"]))]
        super().__init__(textures, sources_of(config), config, name=path.stem, header=header, device=device)
        clock.lap("decode")
        self.bytes = sum(t.nbytes for t in tensors.values())
        self.load_ms: dict[str, float] = clock.spent
        """Milliseconds that opening took: ``networks``, ``filter`` and ``fit`` of the mips, ``decode``; without
        compilation of kernels where they were compiled before."""


class _Clock:
    """Sums milliseconds by stage."""

    def __init__(self):
        self.spent, self._last = {}, time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.spent[stage] = self.spent.get(stage, 0.0) + 1e3 * (now - self._last)
        self._last = now


# ---- networks --------------------------------------------------------------------------------------------------------


def _predicted(tensors, config, i: int, planes: list[Plane], metric, path, device):
    """Return (bytes of each plane (rows, columns, 8 or 16), colours (blocks, components, 16) on ``device``)."""
    model = config["models"][i]
    naive = config["variant"] == "naive"
    components = sum(p.components for p in planes)
    outputs = {"endpoint": 2 * components, "texel": len(planes) if naive else components}
    shapes, held = {}, {}
    for network, count in outputs.items():
        if model[network] is None:  # endpoints are fitted: the kernel runs the least network there is for them
            shapes[network] = NetworkShape(((1, 1),), count, (8,))
            arrays = np.zeros(shapes[network].grid_words, np.float32), np.zeros(shapes[network].weights, np.float32)
        else:
            shapes[network], *arrays = _network(tensors, config, f"model{i}.{network}", model[network], count, path)
        held[network] = [wp.array(array, dtype=wp.float32, device=device) for array in arrays]
    shape = ModelShape(shapes["endpoint"], shapes["texel"], tuple((p.format, p.components) for p in planes), naive)
    rows, columns = grid(config["width"], config["height"])
    inputs = [*held["endpoint"], *held["texel"]]
    g = wp.array(metric, dtype=wp.float32, device=device)
    written, colours = ntbc_blocks(shape, rows, columns, *inputs, metric=g, predicted=True, device=device)
    return [blocks.numpy() for blocks in written], colours


def _network(tensors, config, name: str, facts: dict, outputs: int, path):
    """Return (shape, grids as flat float32, packed weights) of the network whose tensors' names begin with ``name``."""
    sizes = tuple((w, h) for w, h in facts["levels"])
    features, bits = facts.get("features", 2), facts.get("bits", 8)
    shape = NetworkShape(sizes, outputs, tuple(config["hidden"]), features)
    scale = expect(tensors, f"{name}.scale", "float32", (len(sizes),), path)
    zero = expect(tensors, f"{name}.zero", "int16", (len(sizes),), path)
    grids = np.empty(shape.grid_words, np.float32)
    for n, (at, count) in enumerate(zip(shape.grid_offsets, shape.grid_sizes, strict=True)):
        stored = expect(tensors, f"{name}.grid{n}", "uint8", (packed_bytes(count, bits),), path)
        level = grids[at : at + count]
        level[:] = unpack_bits(stored, bits, count)
        level -= np.float32(zero[n])
        level *= scale[n]
    net, widths = np.zeros(shape.weights, np.float32), [features * len(sizes), *config["hidden"], outputs]
    for n, (i, o) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
        bias_at, weight_at = shape.offsets[n]
        net[bias_at : bias_at + o] = expect(tensors, f"{name}.bias{n}", "float16", (o,), path)
        matrix = net[weight_at : weight_at + shape.rows[n] * shape.rows[n + 1]].reshape(shape.rows[n], -1)
        matrix[:i, :o] = expect(tensors, f"{name}.weight{n}", "float16", (o, i), path).T
    return shape, grids, net


# ---- blocks ----------------------------------------------------------------------------------------------------------


def _filled(plane: Plane, texels: np.ndarray, channels: list[dict]) -> np.ndarray:
    """Return the components of a plane (n, 16, k) of texels (n, 16, channels): its channels, z of a normal, or 0."""
    own, count = texels[..., list(plane.channels)], len(plane.channels)
    if count == plane.components:
        return own
    result = np.zeros((*own.shape[:2], plane.components), np.float32)
    result[..., :count] = own
    if [(channels[k]["encoding"], channels[k]["component"]) for k in plane.channels] == _NORMAL:
        result[..., 2] = 0.5 + 0.5 * np.sqrt(np.maximum(1.0 - np.square(2.0 * own - 1.0).sum(axis=2), 0.0))
    return result


def _encoded(plane: Plane, texels: np.ndarray, metric: np.ndarray) -> np.ndarray:
    """Return blocks (n, 8 or 16) uint8 of a plane for texels (n, 16, components) float32."""
    if plane.format == "bc4":
        return bc4_encode(np.ascontiguousarray(texels).reshape(-1, 4, 4))
    encode: Callable = {"bc1": bc1_encode, "bc7": bc7_encode}[plane.format]
    count = plane.components
    return encode(np.ascontiguousarray(texels).reshape(-1, 4, 4, count), metric=metric[:count, :count])


def _texture(config: dict, t: int, levels: dict) -> BlockTexture:
    """Return texture ``t`` of the mips of its planes; alpha of BC3 and red of BC5 come first in a block."""
    facts = config["textures"][t]
    order = list(range(len(facts["planes"])))
    if FORMATS[facts["format"]].family == "bc3":
        order.sort(key=lambda p: facts["planes"][p]["format"] != "bc4")
    mips = [np.concatenate(parts, axis=-1) for parts in zip(*(levels[t, p] for p in order), strict=True)]
    return BlockTexture(facts["format"], config["width"], config["height"], [mips])
