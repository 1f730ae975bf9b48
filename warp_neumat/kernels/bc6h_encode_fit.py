"""Fit of BC6H blocks to pixels: the search for partition, mode, endpoints and indices, for a vector of blocks at once.

Nothing in the search branches on a block's content, so a register holds the same variable of 8 (AVX), 16 (AVX-512) or
4 blocks, and a lane that fails a test only loses a blend. Warp's own vector types and lane loops cannot keep a loop's
sums in registers over sixteen texels, hence C++ vector types; on CUDA the same text runs with one block a thread.

``bc6h_encode_numbers`` holds the domains, ``bc6h_encode_search`` the steps; here are the plan of the modes, the loop
over a thread's blocks, and the kernel.
"""

import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.bc6h_encode_numbers import NUMBERS
from warp_neumat.kernels.bc6h_encode_search import SEARCH
from warp_neumat.kernels.bc6h_tables import ANCHOR, MODES, PARTITIONS

BATCH = 16
"""Blocks that one CPU thread fits: a whole number of vectors on every CPU."""

COLUMNS = 10
"""Numbers per row of the plan: mode number, regions, transformed, precision, three difference reaches, starts of the
polish, whether both neighbouring codes are tried, whether the first codes are rounded outwards."""


def plan(modes: str) -> list[tuple[int, ...]]:
    """Return the rows of the search, see :data:`COLUMNS`; mode 10 comes first.

    Coarse codes gain from more starts and neighbours; from 9 bits on, one start and the nearest code do.
    """
    rows = []
    for m in sorted(MODES, key=lambda m: m.number != 10)[: 1 if modes == "single" else None]:
        coarse = m.precision < 9
        starts = 4 if coarse else 0
        reach = [1 << (d - 1) for d in m.delta]
        rows.append(
            (m.number, m.regions, int(m.transformed), m.precision, *reach, starts, int(coarse), int(m.precision == 6))
        )
    return rows


_MAIN = r"""
auto from_half = [](int h) {    // a NaN becomes 0
    union { int i; float f; } v; v.i = (h & 0x7fff) << 13;
    const float m = (h & 0x7fff) > 0x7c00 ? 0.0f : v.f * 5.192296858534828e33f;
    return h & 0x8000 ? -m : m;
};
const Mode* modes = (const Mode*)plan.data;
for (int base = 0; base < @LANES@; base += NV) {
    if (start + base >= count) return;
    Fit fit;
    I free_shape = Fit::none(), want = Fit::none();
    for (int l = 0; l < NV; ++l) {    // lanes past the end repeat the last block
        const long long b = start + base + l < count ? start + base + l : count - 1;
        for (int k = 0; k < 48; ++k) {
            const long long at = 48 * b + k;
            float x = half ? from_half(((const unsigned short*)targets.data)[at]) : ((const float*)targets.data)[at];
            x = x == x ? x : 0.0f;
            x = x > 65504.0f ? 65504.0f : x < (SIGNED ? -65504.0f : 0.0f) ? (SIGNED ? -65504.0f : 0.0f) : x;
            ((float*)&fit.g[k])[l] = x;
            if (WEIGHTED) ((float*)&fit.weight[k])[l] = weights.data[at] > 0.0f ? weights.data[at] : 0.0f;
        }
        const int s = shapes.data ? shapes.data[b] : -1;
        ((int*)&want)[l] = s; ((int*)&free_shape)[l] = s < 0;
    }
    if (!LINEAR) for (int k = 0; k < 48; ++k) fit.g[k] = Fit::bits_of(fit.g[k]);
    free_shape = free_shape != 0;
    fit.prepare();
    fit.reset_rows();
    const I two = want < 32, one = (want < 0) | (want == 32);
    fit.estimate_partitions(partitions.data);
    F estimate[32];
    for (int p = 0; p < 32; ++p) estimate[p] = fit.estimate[p];
    // Mode 10 by itself, then the others: whatever these find, "all" is never worse than "single".
    for (int from = 0, to = 1; from < rows; from = to, to = rows) {
        bool split = false, whole = false;
        for (int k = from; k < to; ++k) { split |= modes[k].regions == 2; whole |= modes[k].regions == 1; }
        if (split && Fit::any(two)) {
            for (int p = 0; p < 32; ++p) fit.estimate[p] = estimate[p];
            for (int n = 0; n < tries; ++n) {
                I p = fit.next_partition();
                p = free_shape ? p : two ? want : Fit::none();
                fit.divide(2, p, partitions.data, anchors.data);
                fit.project(2);
                for (int k = from; k < to; ++k)
                    if (modes[k].regions == 2) fit.begin(modes[k], two, 0, 1 + modes[k].outward, modes[k].outward);
            }
        }
        if (whole && Fit::any(one)) {
            fit.divide(1, Fit::none(), partitions.data, anchors.data);
            fit.project(1);
            for (int k = from; k < to; ++k)
                if (modes[k].regions == 1) fit.begin(modes[k], one, 0, 1 + modes[k].outward, modes[k].outward);
        }
        for (int k = from; k < to; ++k) fit.polish(modes[k], partitions.data, anchors.data);
    }
    for (int l = 0; l < NV && start + base + l < count; ++l) {
        const long long b = start + base + l;
        mode.data[b] = (unsigned char)((int*)&fit.mode)[l];
        shape.data[b] = (unsigned char)((int*)&fit.shape)[l];
        error.data[b] = ((float*)&fit.error)[l];
        for (int k = 0; k < 12; ++k) code.data[12 * b + k] = ((int*)&fit.codes[k])[l];
        for (int t = 0; t < 16; ++t) index.data[16 * b + t] = (unsigned char)((float*)&fit.indices[t])[l];
    }
}
#undef BC6_CALL
#undef BC6_F
#undef BC6_I
"""


@functools.cache
def make_fit_kernel(lanes: int, signed: bool, linear: bool, weighted: bool):
    """Return the kernel that fits ``lanes`` blocks a thread (:data:`BATCH` on the CPU, 1 on CUDA).

    Args:
        lanes: Blocks a thread.
        signed: Whether blocks are of the signed format.
        linear: Whether the error is measured in linear values instead of half bits.
        weighted: Whether weights are given for each texel and channel.
    """
    code = NUMBERS + SEARCH + _MAIN
    for name, value in (("LANES", lanes), ("SIGNED", signed), ("LINEAR", linear), ("WEIGHTED", weighted)):
        code = code.replace(f"@{name}@", str(int(value)))
    L = lanes

    @wp.func_native(code)
    def fit(
        start: int,
        targets: wp.array(dtype=wp.uint8),
        half: int,
        weights: wp.array(dtype=wp.float32),
        shapes: wp.array(dtype=wp.int32),
        count: int,
        plan: wp.array(dtype=wp.int32),
        rows: int,
        tries: int,
        partitions: wp.array(dtype=wp.int32),
        anchors: wp.array(dtype=wp.int32),
        mode: wp.array(dtype=wp.uint8),
        shape: wp.array(dtype=wp.uint8),
        code: wp.array(dtype=wp.int32),
        index: wp.array(dtype=wp.uint8),
        error: wp.array(dtype=wp.float32),
    ): ...

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def bc6h_fit_kernel(
        first: int,
        targets: wp.array(dtype=wp.uint8),
        half: int,
        weights: wp.array(dtype=wp.float32),
        shapes: wp.array(dtype=wp.int32),
        count: int,
        plan: wp.array(dtype=wp.int32),
        rows: int,
        tries: int,
        partitions: wp.array(dtype=wp.int32),
        anchors: wp.array(dtype=wp.int32),
        # outputs
        mode: wp.array(dtype=wp.uint8),
        shape: wp.array(dtype=wp.uint8),
        code: wp.array(dtype=wp.int32),
        index: wp.array(dtype=wp.uint8),
        error: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        fit(
            b * L, targets, half, weights, shapes, count, plan, rows, tries, partitions, anchors,
            mode, shape, code, index, error,
        )  # fmt: skip

    return bc6h_fit_kernel


@functools.cache
def tables(modes: str, device: str) -> tuple[wp.array, ...]:
    """Return plan, partitions and anchors as Warp arrays on a device."""
    flat = [number for row in plan(modes) for number in row]
    parts = (flat, PARTITIONS.tolist(), ANCHOR.tolist())
    return tuple(wp.array(part, dtype=wp.int32, device=device) for part in parts)
