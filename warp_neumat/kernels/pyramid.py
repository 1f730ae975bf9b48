"""Trilinear look-ups in a pyramid of trainable texels, and their transposes (BCf Eq. 10).

Unlike :mod:`~.bcf_train`, which fuses a whole training step, these kernels take any coordinates and a level of its own
for every sample: the building block for other losses and other samplers. Texels are float32 rows of four (r, g, b,
unused), block by block as :class:`~.patches.Pyramids` lays out one texture. Wrap modes, texel centres and what
becomes of numbers that are not finite are those of :mod:`~.filter`.

One source serves CPU and CUDA. The scatter sums in one buffer per part: a CPU has a few parts, each the work of one
thread, so that sums are the same on any number of cores; on CUDA every sample is a part, all share one buffer, and the
additions are atomic.
"""

import warp as wp

from warp_neumat.kernels.dispatch import module_options
from warp_neumat.kernels.filter import WRAPS

wp.set_module_options(module_options())

REPEAT, CLAMP, MIRROR = (wp.constant(WRAPS.index(name)) for name in ("repeat", "clamp", "mirror"))

CPU_RUN = 256
"""Samples that a CPU thread looks up in a row; on CUDA it is one."""


@wp.func
def wrapped(a: float, wrap: int) -> float:
    """Bring a coordinate into [0, 1]; one that is no number becomes 0."""
    if wrap == CLAMP:
        return wp.where(a > 0.0, wp.where(a < 1.0, a, 1.0), 0.0)
    # Halved first for mirror, which is exact: a + 1 would not be for large a.
    b = wp.where(wrap == MIRROR, 0.5 * a, a)
    b = b - wp.floor(b)
    b = wp.where(b >= 0.0, b, 0.0)
    if wrap == MIRROR:
        b = 2.0 * b
        b = wp.where(b > 1.0, 2.0 - b, b)
    return b


@wp.func
def wrap_slope(a: float, wrap: int) -> float:
    """Derivative of :func:`wrapped`; at the ends of a clamped range that of its inside."""
    if wrap == CLAMP:
        return wp.where(a >= 0.0 and a <= 1.0, 1.0, 0.0)
    if wrap == MIRROR:
        b = 0.5 * a
        return wp.where(b - wp.floor(b) > 0.5, -1.0, 1.0)
    return 1.0


@wp.func
def nearest_two(a: float, size: int, wrap: int):
    """Return the two texels around ``a`` in [0, 1] and the weight of the second."""
    at = a * float(size) - 0.5
    whole = wp.floor(at)
    first = int(whole)
    second = first + 1
    if wrap == REPEAT:
        first = wp.where(first < 0, size - 1, first)
        second = wp.where(second < size, second, 0)
    else:
        first = wp.max(first, 0)
        second = wp.min(second, size - 1)
    return first, second, at - whole


@wp.func
def scale_of(lod: float, top: int):
    """Return the finer of the two mips around level ``lod``, and the weight of the coarser."""
    s = wp.where(lod > 0.0, wp.where(lod < float(top), lod, float(top)), 0.0)
    mip = wp.max(wp.min(int(s), top - 1), 0)
    return mip, s - float(mip)


@wp.func
def column_of(x: int) -> int:
    """Texels from the start of a row of blocks to column ``x`` of its first row."""
    return ((x >> 2) << 4) + (x & 3)


@wp.func
def row_of(y: int, width: int) -> int:
    """Texels from the start of a mip to its row ``y``."""
    return (((y >> 2) * ((width + 3) >> 2)) << 4) + ((y & 3) << 2)


@wp.func
def footprint(table: wp.array(dtype=wp.int32), mip: int, at: wp.vec2, wrap: int):
    """Return the rows of the four texels around ``at`` (two above, then two below) and the weights right and below."""
    width = table[3 * mip + 1]
    height = table[3 * mip + 2]
    x0, x1, fx = nearest_two(wrapped(at[0], wrap), width, wrap)
    y0, y1, fy = nearest_two(wrapped(at[1], wrap), height, wrap)
    upper = table[3 * mip] + row_of(y0, width)
    lower = table[3 * mip] + row_of(y1, width)
    left = column_of(x0)
    right = column_of(x1)
    return wp.vec4i(upper + left, upper + right, lower + left, lower + right), fx, fy


@wp.kernel
def pyramid_sample_kernel(
    first: int,
    run: int,
    texels: wp.array(dtype=wp.vec4),
    uv: wp.array(dtype=wp.vec2),
    lod: wp.array(dtype=wp.float32),
    table: wp.array(dtype=wp.int32),
    mips: int,
    wrap: int,
    # outputs
    colours: wp.array(dtype=wp.vec3),
):
    """Samples ``run`` coordinates a thread."""
    begin = (first + wp.tid()) * run
    for i in range(begin, wp.min(begin + run, uv.shape[0])):
        mip, rest = scale_of(lod[i], mips - 1)
        total = wp.vec4()
        for side in range(2):
            share = wp.where(side == 0, 1.0 - rest, rest)
            if share > 0.0:
                at, fx, fy = footprint(table, mip + side, uv[i], wrap)
                upper = (1.0 - fx) * texels[at[0]] + fx * texels[at[1]]
                lower = (1.0 - fx) * texels[at[2]] + fx * texels[at[3]]
                total += share * ((1.0 - fy) * upper + fy * lower)
        colours[i] = wp.vec3(total[0], total[1], total[2])


@wp.kernel
def pyramid_scatter_kernel(
    first: int,
    parts: int,
    buffers: int,
    gradient: wp.array(dtype=wp.vec3),
    uv: wp.array(dtype=wp.vec2),
    lod: wp.array(dtype=wp.float32),
    table: wp.array(dtype=wp.int32),
    mips: int,
    wrap: int,
    texel_count: int,
    # outputs
    sums: wp.array(dtype=wp.vec4),
):
    """Adds what one part of the samples passes back to the texels to that part's buffer."""
    part = first + wp.tid()
    base = (part % buffers) * texel_count
    count = uv.shape[0]
    share_of = (count + parts - 1) / parts
    for i in range(part * share_of, wp.min(count, (part + 1) * share_of)):
        mip, rest = scale_of(lod[i], mips - 1)
        g = wp.vec4(gradient[i][0], gradient[i][1], gradient[i][2], 0.0)
        for side in range(2):
            share = wp.where(side == 0, 1.0 - rest, rest)
            if share > 0.0:
                at, fx, fy = footprint(table, mip + side, uv[i], wrap)
                upper = share * (1.0 - fy)
                lower = share * fy
                wp.atomic_add(sums, base + at[0], upper * (1.0 - fx) * g)
                wp.atomic_add(sums, base + at[1], upper * fx * g)
                wp.atomic_add(sums, base + at[2], lower * (1.0 - fx) * g)
                wp.atomic_add(sums, base + at[3], lower * fx * g)


@wp.kernel
def pyramid_slope_kernel(
    first: int,
    run: int,
    gradient: wp.array(dtype=wp.vec3),
    texels: wp.array(dtype=wp.vec4),
    uv: wp.array(dtype=wp.vec2),
    lod: wp.array(dtype=wp.float32),
    table: wp.array(dtype=wp.int32),
    mips: int,
    wrap: int,
    # outputs
    slopes: wp.array(dtype=wp.vec3),
):
    """Writes the gradients of u, v and level of ``run`` samples a thread."""
    begin = (first + wp.tid()) * run
    for i in range(begin, wp.min(begin + run, uv.shape[0])):
        top = mips - 1
        mip, rest = scale_of(lod[i], top)
        g = wp.vec4(gradient[i][0], gradient[i][1], gradient[i][2], 0.0)
        slope = wp.vec3()
        for side in range(2):
            k = wp.min(mip + side, top)
            at, fx, fy = footprint(table, k, uv[i], wrap)
            a = wp.dot(g, texels[at[0]])
            b = wp.dot(g, texels[at[1]])
            c = wp.dot(g, texels[at[2]])
            d = wp.dot(g, texels[at[3]])
            share = wp.where(side == 0, 1.0 - rest, rest)
            du = share * float(table[3 * k + 1]) * ((b - a) * (1.0 - fy) + (d - c) * fy)
            dv = share * float(table[3 * k + 2]) * ((c - a) * (1.0 - fx) + (d - b) * fx)
            value = (a + (b - a) * fx) * (1.0 - fy) + (c + (d - c) * fx) * fy
            slope += wp.vec3(du, dv, wp.where(side == 0, -value, value))
        inside = wp.where(lod[i] >= 0.0 and lod[i] <= float(top), 1.0, 0.0)
        slopes[i] = wp.vec3(
            slope[0] * wrap_slope(uv[i][0], wrap), slope[1] * wrap_slope(uv[i][1], wrap), slope[2] * inside
        )
