"""BCf evaluation: four trilinear feature textures and the network, in each storage; and the paper's Table 3.

``sample``: Msamples/s of ``BCf.encoded`` with preset 1k (sides 1024, 512, 256, 128), blocks of all 14 modes and of mode
10 alone, at random places and along a picture. ``lod`` 1.5 is a close view, where only the finest texture lies between
two mips; 4.5 blends two mips of all four; ``mixed`` gives each sample a level of its own between 0 and 8. ``bytes`` is
what the features take, ``error`` the largest deviation of an output from float64.

The peer is torch as its users would write it: decoded fp32 mips, padded by one texel so that ``grid_sample`` wraps,
``lerp`` of two mips, ``linear`` twice. It has one level for all samples; for ``mixed`` the mips of a texture lie in one
atlas, which is sampled twice at coordinates that each sample computes. It gets the better of two batch sizes.

``quad``: Table 3, a textured full-screen quad with uv 0 … 1 and the level of Eq. (11), in ms a frame. ``plain`` is the
same material as ordinary textures at the reference's size 2048² with all mips: three of them, as BC1 (base colour), BC5
(normal) and BC1 (occlusion, roughness, metallic) would hold it, decoded to 8-bit RGBA beforehand and filtered by the
very loop that filters features, without a network. A GPU decodes BC at no cost and keeps it compressed in its caches;
here 8-bit texels stand for that: more bytes, no decoding. ``overhead_ms`` is ours minus plain, the paper's column.
"""

import itertools
import math

import numpy as np
import warp as wp

from bench.harness import interleave
from warp_neumat.kernels import bcf as kernels
from warp_neumat.kernels import bcf_storage, dispatch
from warp_neumat.kernels.bc6h_tables import MODES
from warp_neumat.kernels.filter import level_table
from warp_neumat.materials.bcf import BCf
from warp_neumat.reference import bcf as reference

COLUMNS = [
    "part", "storage", "modes", "uv", "lod", "workers", "ms", "msamples_per_s", "bytes", "error",
    "peer", "peer_ms", "ratio", "overhead_ms",
]  # fmt: skip

SIDES, MIPS, SIDE = (1024, 512, 256, 128), (9, 8, 7, 6), 2048
"""Preset 1k of the paper's Table 1, and its reference material."""

CHANNELS = 9


def asset(modes, rng) -> tuple[dict, dict]:
    """Return (tensors, header) of a preset 1k material with random contents: speed does not depend on them."""
    tensors, textures = {}, []
    for t, (side, mips) in enumerate(zip(SIDES, MIPS, strict=True)):
        textures.append({"width": side, "height": side, "mips": mips})
        for m in range(mips):
            n = -(-(side >> m) // 4)
            bits = rng.integers(0, 2, (n * n, 128), dtype=np.uint8)
            chosen = rng.integers(0, len(modes), n * n)
            for k, mode in enumerate(modes):
                rows = np.flatnonzero(chosen == k)
                bits[rows, : mode.mode_bits] = mode.bits >> np.arange(mode.mode_bits) & 1
                for position, (_, end, bit) in enumerate(mode.fields, mode.mode_bits):
                    # Values of order one: the upper bits of an endpoint are 011.
                    if (end == 0 or not mode.transformed) and bit >= mode.precision - 3:
                        bits[rows, position] = bit < mode.precision - 1
            tensors[f"texture{t}.mip{m}"] = np.packbits(bits, axis=1, bitorder="little").reshape(n, n, 16)
    for n, (i, o) in enumerate(((3 * len(SIDES), 16), (16, CHANNELS))):
        tensors[f"weight{n}"] = (rng.normal(size=(o, i)) * 0.3 / math.sqrt(i)).astype(np.float16)
        tensors[f"bias{n}"] = np.full(o, 0.4, np.float16)
    channels = [
        {"map": f"m{k}", "component": "value", "encoding": "linear", "range": [0.0, 1.0]} for k in range(CHANNELS)
    ]
    config = {"textures": textures, "signed": False, "hidden": 16, "width": SIDE, "height": SIDE, "wrap": "repeat"}
    return tensors, {"kind": "bcf", "version": 1, "config": config | {"channels": channels, "constants": {}}}


def places(kind: str, count: int, rng) -> np.ndarray:
    """Return texture coordinates: ``random``, or ``picture``, the quads of a square picture in tiles of 16 × 16."""
    if kind == "random":
        return rng.random((count, 2)).astype(np.float32)
    side = int(count**0.5) // 16
    axis = ((np.arange(16 * side) + 0.5) / SIDE).astype(np.float32)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1)
    return np.ascontiguousarray(grid.reshape(side, 16, side, 16, 2).swapaxes(1, 2).reshape(-1, 2))


class TorchPeer:
    """The same material in torch: decoded, fp32, ``grid_sample``."""

    def __init__(self, tensors: dict, header: dict):
        import torch

        self._torch = torch
        self.textures = reference.decoded(tensors, header["config"])
        self.padded = [
            [torch.from_numpy(np.pad(m, ((1, 1), (1, 1), (0, 0)), "wrap").astype(np.float32)).permute(2, 0, 1)[None]
             .contiguous() for m in mips]
            for mips in self.textures
        ]  # fmt: skip
        self.atlases = [self._atlas(mips) for mips in self.padded]
        self.weights = [torch.from_numpy(tensors[f"weight{n}"].astype(np.float32)) for n in range(2)]
        self.biases = [torch.from_numpy(tensors[f"bias{n}"].astype(np.float32)) for n in range(2)]

    def _atlas(self, padded):
        """Return the mips below one another, the row at which each begins, and the atlas's size."""
        starts = np.cumsum([0, *(p.shape[2] for p in padded)])
        atlas = self._torch.zeros(1, 3, int(starts[-1]), padded[0].shape[3])
        for start, p in zip(starts, padded, strict=False):
            atlas[:, :, start : start + p.shape[2], : p.shape[3]] = p
        return atlas, self._torch.from_numpy(starts[:-1].astype(np.float32))

    def _sample(self, picture, grid):
        sample = self._torch.nn.functional.grid_sample
        return sample(picture, grid[None, None], mode="bilinear", padding_mode="border", align_corners=False)[0, :, 0]

    def _uniform(self, padded, uv, lod: float):
        bias = math.log2((padded[0].shape[3] - 2) / SIDE)
        level = min(max(lod + bias, 0.0), len(padded) - 1.0)
        m = int(level)

        def at(p):
            side = p.shape[3] - 2
            return self._sample(p, (2 * uv - 1) * (side / (side + 2)))

        first = at(padded[m])
        return first if level == m else self._torch.lerp(first, at(padded[m + 1]), level - m)

    def _varied(self, atlas, starts, uv, lod):
        torch = self._torch
        side, mips = atlas.shape[3] - 2, len(starts)
        level = (lod + math.log2(side / SIDE)).clamp(0, mips - 1)
        m = level.floor()
        scale = torch.tensor([2.0 / atlas.shape[3], 2.0 / atlas.shape[2]])

        def at(m):
            size = (side * torch.exp2(-m)).floor().clamp(min=1)
            place = uv * size[:, None] + 1
            place[:, 1] += starts[m.long()]
            return self._sample(atlas, place * scale - 1)

        return torch.lerp(at(m), at((m + 1).clamp(max=mips - 1)), level - m)

    def __call__(self, uv, lod):
        """Return the outputs for torch tensors ``uv`` [n, 2] and ``lod``, a number or a tensor [n]."""
        functional = self._torch.nn.functional
        with self._torch.inference_mode():
            uv = uv - uv.floor()
            if isinstance(lod, float):
                parts = [self._uniform(p, uv, lod) for p in self.padded]
            else:
                parts = [self._varied(*a, uv, lod) for a in self.atlases]
            x = self._torch.cat(parts).t()
            hidden = functional.linear(x, self.weights[0], self.biases[0]).relu_()
            return functional.linear(hidden, self.weights[1], self.biases[1]).clamp_(0, 1)


def _in_parts(peer, uv, lod, size):
    starts = range(0, len(uv), size)
    parts = [(uv[s : s + size], lod if isinstance(lod, float) else lod[s : s + size]) for s in starts]

    def call():
        for a, b in parts:
            peer(a, b)

    return call


def sampling_rows(device: str, quick: bool, rng):
    """Yield the rows of part ``sample``."""
    import torch

    count, rounds = (1 << 14, 2) if quick else (1 << 18, 9)
    everyone, threads = dispatch.worker_count(), torch.get_num_threads()
    kinds = {"10": [MODES[9]]} if quick else {"all": list(MODES), "10": [MODES[9]]}
    try:
        for (label, modes), place in itertools.product(kinds.items(), ("random", "picture")[: 1 if quick else 2]):
            tensors, header = asset(modes, rng)
            materials = {s: BCf(tensors, header, device=device, storage=s) for s in kernels.STORAGES}
            peer = TorchPeer(tensors, header)
            uv = places(place, count, rng)
            mixed = rng.uniform(0, 8, len(uv)).astype(np.float32)
            for lod, workers in itertools.product((1.5, 4.5, "mixed"), sorted({1, everyone})):
                if quick and (lod == 1.5 or workers != 1):
                    continue
                dispatch.set_worker_count(workers)
                torch.set_num_threads(workers)
                level = mixed if lod == "mixed" else lod
                few = slice(0, 2048)
                weights, biases = ([tensors[f"{n}{k}"] for k in range(2)] for n in ("weight", "bias"))
                part = level[few] if lod == "mixed" else level
                exact = reference.encoded(peer.textures, weights, biases, header["config"], uv[few], part)
                at, scale = torch.from_numpy(uv), torch.from_numpy(mixed) if lod == "mixed" else lod
                calls = {s: (lambda m=m, level=level: m.encoded(uv, level)) for s, m in materials.items()}
                calls |= {
                    f"torch {size}": _in_parts(peer, at, scale, size) for size in sorted({min(8192, len(uv)), len(uv)})
                }
                seconds = interleave(calls, rounds=rounds)
                name = min((n for n in seconds if n.startswith("torch")), key=seconds.get)
                for storage, material in materials.items():
                    got = material.encoded(uv[few], part)
                    yield {
                        "part": "sample",
                        "storage": storage,
                        "modes": label,
                        "uv": place,
                        "lod": str(lod),
                        "workers": workers,
                        "ms": 1e3 * seconds[storage],
                        "msamples_per_s": len(uv) / seconds[storage] / 1e6,
                        "bytes": material.stored_bytes,
                        "error": float(np.abs(got - exact).max()),
                        "peer": name,
                        "peer_ms": 1e3 * seconds[name],
                        "ratio": seconds[name] / seconds[storage],
                    }
    finally:
        dispatch.set_worker_count(None)
        torch.set_num_threads(threads)


# ---- Table 3 ---------------------------------------------------------------------------------------------------------

TILE_WIDTH, TILE_HEIGHT = 32, 8
"""Pixels of a block: neighbours share texels, as in a rasteriser's tiles. Divides all three resolutions."""


def quad_kernel(evaluate, scratch_words: int, outputs: int, lanes: int):
    """Return a kernel that fills a picture: a block's uv and level, ``evaluate``, three channels as float16."""
    L, LANE, C, OWN = lanes, lanes, outputs, (3 + outputs) * lanes
    STRIDE = scratch_words + OWN
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def fill_kernel(
        first: int,
        slot: int,
        material: kernels.Arguments,
        width: int,
        height: int,
        level: float,
        scratch: wp.array(dtype=wp.float32),
        # outputs
        picture: wp.array(dtype=wp.float16),
    ):
        b = first + wp.tid()
        own = scratch.ptr + wp.uint64(slot) * wp.uint64(STRIDE) * FLOAT
        U = wp.array(ptr=own, shape=(L,), dtype=wp.float32)
        V = wp.array(ptr=own + wp.uint64(LANE) * FLOAT, shape=(L,), dtype=wp.float32)
        S = wp.array(ptr=own + wp.uint64(2 * L) * FLOAT, shape=(L,), dtype=wp.float32)
        Y = wp.array(ptr=own + wp.uint64(3 * L) * FLOAT, shape=(C * L,), dtype=wp.float32)
        columns = width / TILE_WIDTH
        left = (b % columns) * TILE_WIDTH
        top = (b / columns) * TILE_HEIGHT
        for l in range(L):
            U[l] = (float(left + l % TILE_WIDTH) + 0.5) / float(width)
            V[l] = (float(top + l / TILE_WIDTH) + 0.5) / float(height)
            S[l] = level
        evaluate(material, U, V, S, L, own + wp.uint64(OWN) * FLOAT, Y)
        for l in range(L):
            at = 4 * ((top + l / TILE_WIDTH) * width + left + l % TILE_WIDTH)
            for c in range(3):
                picture[at + c] = wp.float16(Y[c * L + l])

    return fill_kernel


def plain_textures(rng, device) -> kernels.Arguments:
    """Return three random 8-bit textures of the reference's size with all mips."""
    mips = SIDE.bit_length()
    levels, blocks = level_table([(SIDE, SIDE)] * 3, [0.0] * 3, [mips] * 3)
    texels = rng.integers(0, 256, blocks * bcf_storage.BLOCK_BYTES["rgba8"], dtype=np.uint8)
    empty = {"tables": np.zeros(1, np.uint8), "weights": np.zeros(1, np.float32)}
    return kernels.device_arrays({"texels": texels, "levels": levels, **empty}, device)


def quad_rows(device: str, quick: bool, rng):
    """Yield the rows of part ``quad``."""
    lanes = dispatch.lanes(device)
    modes = [MODES[9]]
    tensors, header = asset(modes, rng)
    sample = kernels.make_sampler(3, "repeat", False, "rgba8", lanes)

    @wp.func
    def filtered(
        a: kernels.Arguments,
        u: wp.array(dtype=wp.float32),
        v: wp.array(dtype=wp.float32),
        lod: wp.array(dtype=wp.float32),
        count: int,
        scratch: wp.uint64,
        y: wp.array(dtype=wp.float32),
    ):
        sample(a.texels, a.tables, a.levels, a.level_at, u, v, lod, count, y)

    ways = {"plain": (quad_kernel(filtered, 0, 9, lanes), plain_textures(rng, device), 3 * lanes + 9 * lanes)}
    materials = {s: BCf(tensors, header, device=device, storage=s) for s in kernels.STORAGES}
    for storage, material in materials.items():
        layout = material.layout
        kernel = quad_kernel(kernels.make_maps(layout, lanes), layout.scratch(lanes), layout.channels, lanes)
        words = layout.scratch(lanes) + (3 + layout.channels) * lanes
        ways[storage] = (kernel, material._arguments, words)
    sizes = [(1920, 1080), (2560, 1440), (3840, 2160)]
    for (width, height), workers in itertools.product(
        sizes[:1] if quick else sizes, (1,) if quick else sorted({1, dispatch.worker_count()})
    ):
        dispatch.set_worker_count(workers)
        level = math.log2(max(SIDE / width, SIDE / height))
        calls = {}
        for name, (kernel, arguments, words) in ways.items():
            job = dispatch.Job(
                kernel,
                width * height // lanes,
                [
                    arguments, width, height, level,
                    wp.empty(workers * words, dtype=wp.float32, device=device),
                ],
                [wp.zeros(4 * width * height, dtype=wp.float16, device=device)],
                device=device,
            )  # fmt: skip
            calls[name] = job.run
        try:
            seconds = interleave(calls, rounds=1 if quick else 7)
        finally:
            dispatch.set_worker_count(None)
        for storage, material in materials.items():
            yield {
                "part": "quad",
                "storage": storage,
                "modes": "10",
                "uv": f"{width}x{height}",
                "lod": f"{level:.2f}",
                "workers": workers,
                "ms": 1e3 * seconds[storage],
                "msamples_per_s": width * height / seconds[storage] / 1e6,
                "bytes": material.stored_bytes,
                "peer": "plain",
                "peer_ms": 1e3 * seconds["plain"],
                "ratio": seconds["plain"] / seconds[storage],
                "overhead_ms": 1e3 * (seconds[storage] - seconds["plain"]),
            }


def rows(*, device: str, quick: bool):
    """Yield the rows of both parts."""
    if not wp.get_device(device).is_cpu:
        raise ValueError(f"this bench compares CPU cores; device must be cpu, got {device}")
    rng = np.random.default_rng(5)
    yield from sampling_rows(device, quick, rng)
    yield from quad_rows(device, quick, rng)
