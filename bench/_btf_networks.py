"""The run-time networks of a BTF by themselves: blocks of quads with fetches, without a mesh; and the same in float64.

What a shading kernel calls (``kernels/btf.py``): ``view`` once, ``light`` for each light. Lanes are the texels of an
atlas's rows, four neighbours a quad, whose texture has 400² texels as the measured ones have. Directions come from a
few blocks that stay in cache, where a shading kernel has just computed them.
"""

from __future__ import annotations

import functools
import itertools
import time

import numpy as np
import warp as wp

from warp_neumat.io.asset import KINDS
from warp_neumat.io.mipmaps import mip_sizes
from warp_neumat.kernels import btf as kernels
from warp_neumat.kernels import dispatch
from warp_neumat.materials.btf import BTF
from warp_neumat.models.btf_config import VARIANTS, BTFConfig
from warp_neumat.reference.btf import btf_quads

SIDE = 400
"""Texels of the fine texture along a side, as in UBO2014."""

LIGHTS = 9
"""Blocks of directions, and most lights that are evaluated at once."""

SHAPES = {
    "coarse-to-fine": {
        "fine": {"channels": 16, "hidden": [8, 8, 8]},
        "coarse": {"channels": 14, "hidden": [8, 8, 8], "latent": 8},
    },
    "single-level": {"fine": {"channels": 30, "hidden": [8] * 7}, "coarse": None},
    "coarse-to-fine, folded": {
        "fine": {"channels": 8, "hidden": [8, 8, 8]},
        "coarse": {"channels": 8, "hidden": [8, 8, 8], "latent": 8},
    },
    "single-level, folded": {"fine": {"channels": 8, "hidden": [8] * 7}, "coarse": None},
}
"""Name → networks as an asset's config says them; the first two have the paper's 779 weights, and 30 features a texel;
the others are what is stored of them, with no more features than a first layer has units (``BTF.folded``)."""

CHECKED = 1024
"""Quads that are compared with float64."""


def asset(rng, name: str, *, side: int = SIDE, mips: int = 1) -> tuple[dict, dict]:
    """Return (tensors, header) of a material of one of :data:`SHAPES` with random contents, values of order one."""
    shape = SHAPES[name]
    config = {"width": side, "height": side, "mips": mips, "half_vector": True, "features": "half", **shape}
    config["activation"] = VARIANTS[name.partition(",")[0]].get("activation", BTFConfig.activation)
    fine, coarse = shape["fine"], shape["coarse"]
    head = coarse["latent"] if coarse else 9
    nets = {"fine": (head + fine["channels"], *fine["hidden"], 3)}
    if coarse:
        nets["coarse"] = (9 + coarse["channels"], *coarse["hidden"], coarse["latent"])
    tensors = {}
    for net, widths in nets.items():
        for n, (i, o) in enumerate(itertools.pairwise(widths)):
            tensors[f"{net}.weight{n}"] = (rng.normal(size=(o, i)) * np.sqrt(2 / i)).astype(np.float16)
            tensors[f"{net}.bias{n}"] = np.full(o, 0.2, np.float16)
        for m, (w, h) in enumerate(mip_sizes(side, side)[:mips]):
            size = (max(1, h // 2), max(1, w // 2)) if net == "coarse" else (h, w)
            tensors[f"{net}.mip{m}"] = rng.normal(size=(*size, shape[net]["channels"])).astype(np.float16)
    return tensors, {"kind": "btf", "version": KINDS["btf"], "config": config}


@functools.cache
def _make_kernel(layout, lanes: int):
    evaluate = kernels.functions(layout, lanes)
    view, light = evaluate.view, evaluate.light
    L = lanes
    STRIDE = layout.scratch(lanes) + 3 * lanes
    DIRECTIONS = LIGHTS
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def lights_kernel(
        first: int,
        slot: int,
        material: kernels.Arguments,
        place: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        wi: wp.array(dtype=wp.float32),
        lights: int,
        active: wp.array(dtype=wp.int32),
        scratch: wp.array(dtype=wp.float32),
        # outputs
        value: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        own = scratch.ptr + wp.uint64(slot) * wp.uint64(STRIDE) * FLOAT
        Y = wp.array(ptr=own, shape=(3 * L,), dtype=wp.float32)
        own = own + wp.uint64(3 * L) * FLOAT
        at = wp.uint64(b) * wp.uint64(3 * L) * FLOAT
        P = wp.array(ptr=place.ptr + at, shape=(3 * L,), dtype=wp.float32)
        turn = wp.uint64(b % DIRECTIONS) * wp.uint64(3 * L) * FLOAT
        O = wp.array(ptr=wo.ptr + turn, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        R = wp.array(ptr=value.ptr + at, shape=(3 * L,), dtype=wp.float32)
        view(material, P, O, active, L, own, Y)
        for j in range(lights):
            to = wp.uint64((b + j) % DIRECTIONS) * wp.uint64(3 * L) * FLOAT
            I = wp.array(ptr=wi.ptr + to, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
            light(material, I, active, L, own, R)

    return lights_kernel


def _directions(rng, shape) -> np.ndarray:
    d = rng.normal(size=(*shape, 3))
    d[..., 2] = np.abs(d[..., 2]) + 0.1
    return (d / np.linalg.norm(d, axis=-1, keepdims=True)).astype(np.float32)


def quad_uv(quads: int) -> np.ndarray:
    """Return uv (n, 4, 2) float32 of neighbouring texels of an atlas, row by row.

    A texel of the atlas is 0.9 of the texture's, so that all four taps count.
    """
    number = np.arange(quads)
    corner = np.stack([(2 * number) % SIDE, 2 * (2 * number // SIDE)], 1)[:, None] + [[0, 0], [1, 0], [0, 1], [1, 1]]
    return (corner * (0.9 / SIDE)).astype(np.float32)


def taps(uv: np.ndarray, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (n, 4) int64 and weights (n, 4) float32 of the bilinear taps at ``uv`` (n, 2); a texture repeats."""
    at = uv.astype(np.float64) % 1.0 * (width, height) - 0.5
    low = np.floor(at)
    fx, fy = (at - low).T
    x, y = low.astype(np.int64).T
    rows = np.stack([(y + dy) % height * width + (x + dx) % width for dy in (0, 1) for dx in (0, 1)], 1)
    weights = np.stack([gy * gx for gy in (1 - fy, fy) for gx in (1 - fx, fx)], 1)
    return rows, weights.astype(np.float32)


class Run:
    """The networks of one of :data:`SHAPES` over ``texels`` texels; :meth:`call` evaluates them under some lights."""

    def __init__(self, name: str, texels: int, device, seed: int = 4):
        lanes = dispatch.lanes(device)
        if lanes < 4:
            raise ValueError(f"figure13 and peers compare CPU cores; device must be cpu, got {device}")
        rng = np.random.default_rng(seed)
        self.tensors, header = asset(rng, name)
        self.material = BTF(self.tensors, header, device=device)
        blocks = dispatch.blocks(texels, lanes)
        self.texels = blocks * lanes
        self.uv = quad_uv(self.texels // 4)
        self.wo, self.wi = (_directions(rng, (LIGHTS, lanes // 4)).repeat(4, 1) for _ in range(2))

        def array(x, dtype=wp.float32):
            return wp.array(np.ascontiguousarray(x).ravel(), dtype=dtype, device=device)

        place = np.concatenate([self.uv, np.zeros((*self.uv.shape[:2], 1))], 2).reshape(blocks, lanes, 3)
        self._value = wp.zeros(3 * self.texels, dtype=wp.float32, device=device)
        scratch = dispatch.worker_count() * (self.material.layout.scratch(lanes) + 3 * lanes)
        self._job = dispatch.Job(
            _make_kernel(self.material.layout, lanes),
            blocks,
            inputs=[
                self.material.shader().arguments, array(place.swapaxes(1, 2)), array(self.wo.swapaxes(1, 2)),
                array(self.wi.swapaxes(1, 2)), 1, array(np.arange(lanes), wp.int32),
                wp.zeros(scratch, dtype=wp.float32, device=device),
            ],
            outputs=[self._value],
            device=device,
        )  # fmt: skip
        self._shape = (blocks, 3, lanes)

    def call(self, lights: int) -> None:
        """Evaluate 0 … :data:`LIGHTS` lights: fetches, networks, values."""
        self._job.set(4, lights)
        self._job.run()

    def error(self, lights: int = 1) -> float:
        """Return the largest deviation of the last light's values from float64 over the largest value."""
        self.call(lights)
        got = self._value.numpy().reshape(self._shape).swapaxes(1, 2).reshape(-1, 4, 3)[:CHECKED]
        n, blocks = len(got), np.arange(self._shape[0])
        block = [self.wo[blocks % LIGHTS], self.wi[(blocks + lights - 1) % LIGHTS]]
        wo, wi = (d.reshape(-1, 4, 3)[:n] for d in block)
        expected = btf_quads(self.tensors, self.material.config, self.uv[:n], wi, wo, np.zeros((n, 4)))
        return float(np.abs(got - expected).max() / expected.max())


def least(functions: dict, rounds: int) -> dict[str, float]:
    """Return the least seconds of each function, called in turn: what each takes where nothing disturbs it.

    The minimum, where other benches take the median: a fitted line and a ratio of two near times bear no outlier.
    """
    best = dict.fromkeys(functions, float("inf"))
    order = list(functions)
    for name in order:  # compilation and first touch
        functions[name]()
    for turn in range(rounds):
        for k in range(len(order)):
            name = order[(turn + k) % len(order)]
            start = time.perf_counter()
            functions[name]()
            best[name] = min(best[name], time.perf_counter() - start)
    return best


def surplus(more, less, rounds: int) -> float:
    """Return the median of how many seconds ``more`` takes beyond ``less``, called right after one another."""
    found = []
    for turn in range(rounds):
        seconds = {}
        for function in (more, less) if turn % 2 else (less, more):
            start = time.perf_counter()
            function()
            seconds[function] = time.perf_counter() - start
        found.append(seconds[more] - seconds[less])
    return float(np.median(found))


def line(x, y) -> dict[str, float]:
    """Return ``intercept``, ``slope`` and ``r2`` of the least squares line through at least two points."""
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    slope, intercept = np.polyfit(x, y, 1)
    spread = ((y - y.mean()) ** 2).sum()
    rest = ((y - intercept - slope * x) ** 2).sum()
    return {"intercept": float(intercept), "slope": float(slope), "r2": float(1 - rest / max(spread, 1e-30))}


def rows(device, texels: int, rounds: int):
    """Yield Figure 13's times: both designs under 1 … 4 lights, in turns; then both as they are stored."""
    for names in (("coarse-to-fine", "single-level"), ("coarse-to-fine, folded", "single-level, folded")):
        yield from _compared(names, device, texels, rounds)


def _compared(names, device, texels: int, rounds: int):
    runs = {name: Run(name, texels, device) for name in names}
    calls = {(name, n): functools.partial(run.call, n) for name, run in runs.items() for n in range(1, 5)}
    seconds = least(calls, rounds)
    ours, peer = runs
    for n in range(1, 5):
        yield {
            "table": "figure13",
            "method": ours,
            "lights": n,
            "texels": runs[ours].texels,
            "ms": 1e3 * seconds[ours, n],
            "ms_per_light": 1e3 * seconds[ours, n] / n,
            "ns_per_texel": 1e9 * seconds[ours, n] / n / runs[ours].texels,
            "error": runs[ours].error(n),
            "peer": peer,
            "peer_ms": 1e3 * seconds[peer, n],
            "peer_error": runs[peer].error(n),
            "ratio": seconds[peer, n] / seconds[ours, n],
        }
