"""Mip levels of predicted colours, from blocks to blocks: what :func:`warp_neumat.io.mipmaps.mip_chain` does, in Warp.

A source of channels is a flat float32 array [blocks][rows][16] of encoded values in [0, 1], block by block (row-major,
texel 4y + x), as networks write it. A level is half of the one before it, rounded down, by an exact area filter: sRGB
as linear light, normals as unit vectors, all else as it is; linear light and unnormalised vectors are carried from
level to level, planar [planes][height][width]. Only what leaves is encoded again, cut into blocks of 4 × 4 with the
last row and column repeated, [blocks][16][channels]: what encoders of blocks take.
"""

import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.approx import exp2
from warp_neumat.kernels.bcf import srgb_to_linear

_MODULE = {"module": "unique", "module_options": dispatch.module_options()}

LINEAR, SRGB, NORMAL = 0, 1, 2
"""What is filtered: values as they are, colours of sRGB, and the two encoded components of a unit vector."""

_CODES = {"linear": LINEAR, "srgb": SRGB, "normal": NORMAL}


@wp.func
def linear_to_srgb(v: float) -> float:
    """Return the sRGB-encoded value of a linear one in [0, 1] (IEC 61966-2-1).

    Error: at most 1e-6; held by test_srgb_matches_float64 in tests/kernels/test_mip_chain.py.
    """
    t = wp.max(v, 0.001)
    bits = wp.cast(t, wp.int32)
    # log₂ t as in ``bcf.srgb_to_linear``.
    exponent = (bits - 0x3F3504F3) >> 23
    m = wp.cast(bits - (exponent << 23), wp.float32)
    s = (m - 1.0) / (m + 1.0)
    s2 = s * s
    p = (((s2 * 0.111111111 + 0.142857143) * s2 + 0.2) * s2 + 0.333333333) * s2 + 1.0
    curve = 1.055 * exp2(0.416666667 * (float(exponent) + 2.8853900818 * s * p)) - 0.055
    return wp.where(v <= 0.0031308, v * 12.92, curve)


@wp.func
def _place(x: int, y: int, columns: int, source: wp.vec2i) -> int:
    """Return where texel (x, y) of a source of blocks lies; ``source`` is its rows a block, and the row."""
    return (((y >> 2) * columns + (x >> 2)) * source[0] + source[1]) * 16 + ((y & 3) << 2) + (x & 3)


@wp.func
def _overlap(i: int, k: int, old: int, size: int) -> float:
    """Return the share that texel ``k`` of ``old`` has in the interval of texel ``i`` of ``size``."""
    common = wp.min((i + 1) * old, (k + 1) * size) - wp.max(i * old, k * size)
    return float(wp.max(common, 0)) / float(old)


def _rows(lanes: int, width: int, height: int) -> int:
    """Return the kernel blocks of a picture whose rows are cut into runs of ``lanes``."""
    return dispatch.blocks(width, lanes) * height


@functools.cache
def make_first_kernel(lanes: int, code: int, even: bool):
    """Return the kernel that filters a channel, or both of a normal, from the blocks of the source into level 1.

    Args:
        lanes: Texels of a row that a thread owns.
        code: :data:`LINEAR`, :data:`SRGB` or :data:`NORMAL`; the last writes three planes.
        even: Whether both sides are even: 2 × 2 texels make one, else 3 × 3, of which some may weigh nothing.
    """
    L, TAPS, CODE = lanes, 2 if even else 3, code

    @wp.func
    def filtered(
        xs: wp.array(dtype=wp.float32),
        ys: wp.array(dtype=wp.float32),
        x_source: wp.vec2i,
        y_source: wp.vec2i,
        old: wp.vec2i,
        size: wp.vec2i,
        x: int,
        y: int,
    ) -> wp.vec3:
        columns = (old[0] + 3) >> 2
        total = wp.vec3(0.0, 0.0, 0.0)
        left = 2 * x
        top = 2 * y
        if wp.static(not even):
            left = (x * old[0]) / size[0]
            top = (y * old[1]) / size[1]
        for dy in range(TAPS):
            for dx in range(TAPS):
                u = left + dx
                v = top + dy
                weight = float(0.25)
                if wp.static(not even):
                    weight = _overlap(x, u, old[0], size[0]) * _overlap(y, v, old[1], size[1])
                    u = wp.min(u, old[0] - 1)
                    v = wp.min(v, old[1] - 1)
                value = xs[_place(u, v, columns, x_source)]
                if wp.static(code == NORMAL):
                    p = 2.0 * value - 1.0
                    q = 2.0 * ys[_place(u, v, columns, y_source)] - 1.0
                    flat = p * p + q * q
                    shrink = weight / wp.sqrt(wp.max(flat, 1.0))
                    total += wp.vec3(p * shrink, q * shrink, weight * wp.sqrt(wp.max(1.0 - flat, 0.0)))
                elif wp.static(code == SRGB):
                    total += wp.vec3(weight * srgb_to_linear(value), 0.0, 0.0)
                else:
                    total += wp.vec3(weight * value, 0.0, 0.0)
        return total

    @wp.kernel(**_MODULE)
    def mip_first_kernel(
        first: int,
        xs: wp.array(dtype=wp.float32),
        ys: wp.array(dtype=wp.float32),
        x_source: wp.vec2i,
        y_source: wp.vec2i,
        old: wp.vec2i,
        size: wp.vec2i,
        plane: int,
        # outputs
        level: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        runs = (size[0] + L - 1) / L
        y = b / runs
        begin = (b - y * runs) * L
        count = size[0] * size[1]
        for l in range(L):
            if begin + l < size[0]:
                value = filtered(xs, ys, x_source, y_source, old, size, begin + l, y)
                at = plane * count + y * size[0] + begin + l
                level[at] = value[0]
                if CODE == NORMAL:
                    level[at + count] = value[1]
                    level[at + 2 * count] = value[2]

    return mip_first_kernel


@functools.cache
def make_next_kernel(lanes: int, even: bool):
    """Return the kernel that filters all planes of a level into the next; ``even`` as in :func:`make_first_kernel`."""
    L, TAPS = lanes, 2 if even else 3

    @wp.kernel(**_MODULE)
    def mip_next_kernel(
        first: int,
        finer: wp.array(dtype=wp.float32),
        old: wp.vec2i,
        size: wp.vec2i,
        # outputs
        level: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        runs = (size[0] + L - 1) / L
        row = b / runs  # of all planes
        begin = (b - row * runs) * L
        plane = row / size[1]
        y = row - plane * size[1]
        top = (y * old[1]) / size[1]
        for l in range(L):
            x = begin + l
            if x < size[0]:
                total = float(0.0)
                left = 2 * x
                if wp.static(not even):
                    left = (x * old[0]) / size[0]
                for dy in range(TAPS):
                    for dx in range(TAPS):
                        u = left + dx
                        v = top + dy
                        weight = float(0.25)
                        if wp.static(not even):
                            weight = _overlap(x, u, old[0], size[0]) * _overlap(y, v, old[1], size[1])
                            u = wp.min(u, old[0] - 1)
                            v = wp.min(v, old[1] - 1)
                        total += weight * finer[(plane * old[1] + v) * old[0] + u]
                level[row * size[0] + x] = total

    return mip_next_kernel


@functools.cache
def make_blocks_kernel(lanes: int, code: int):
    """Return the kernel that encodes a plane of a level, or three of a normal, into the texels of blocks."""
    L, CODE = lanes, code

    @wp.kernel(**_MODULE)
    def mip_blocks_kernel(
        first: int,
        level: wp.array(dtype=wp.float32),
        size: wp.vec2i,
        plane: int,
        channel: int,
        channels: int,
        start: int,
        # outputs
        texels: wp.array(dtype=wp.float32),
    ):
        """Texels begin at ``start``; a normal's y is the channel behind its x."""
        b = first + wp.tid()
        width = size[0]
        across = ((width + 3) >> 2) << 4  # texels of a row of blocks
        runs = (across + L - 1) / L
        row = b / runs
        begin = (b - row * runs) * L
        count = width * size[1]
        for l in range(L):
            i = begin + l
            if i < across:
                x = wp.min(((i >> 4) << 2) + (i & 3), width - 1)
                y = wp.min((row << 2) + ((i >> 2) & 3), size[1] - 1)
                at = plane * count + y * width + x
                to = (start + row * across + i) * channels + channel
                value = level[at]
                if CODE == SRGB:
                    value = wp.clamp(linear_to_srgb(value), 0.0, 1.0)
                if CODE == NORMAL:
                    q = level[at + count]
                    z = level[at + 2 * count]
                    length = wp.sqrt(value * value + q * q + z * z)
                    scale = wp.where(length > 1.0e-6, 0.5 / wp.max(length, 1.0e-6), 0.0)
                    texels[to + 1] = 0.5 + scale * q
                    value = 0.5 + scale * value
                texels[to] = value

    return mip_blocks_kernel


def mip_blocks(channels, sources, width: int, height: int, device) -> tuple[wp.array, list[int]]:
    """Return all levels below the finest, level by level, and the blocks of each.

    Args:
        channels: ``map``, ``component`` and ``encoding`` of each, as dictionaries; y of a normal follows its x.
        sources: For each channel (flat float32 array of the finest level on ``device``, rows a block in it, its row).
        width: Texels across of the finest level.
        height: As width.
        device: Warp device.

    Returns: (blocks, 16, channels) float32 encoded, one level behind the other, from level 1 to 1×1; blocks a level.
    Error: at most 3e-6 against ``io.mipmaps.mip_chain``; held by test_levels_match_mip_chain.
    """
    sizes = [(max(1, width >> m), max(1, height >> m)) for m in range(max(width, height).bit_length())]
    counts = [((w + 3) >> 2) * ((h + 3) >> 2) for w, h in sizes[1:]]
    texels = wp.empty((sum(counts), 16, len(channels)), dtype=wp.float32, device=device)
    groups, planes = [], 0  # code, channel, plane
    for k, channel in enumerate(channels):
        code = _CODES[channel["encoding"]]
        if code == NORMAL and channel["component"] == "y":
            continue
        groups.append((code, k, planes))
        planes += 3 if code == NORMAL else 1
    lanes = dispatch.lanes(device)
    flat, start, finer = texels.flatten() if counts else None, 0, None
    for m, (w, h) in enumerate(sizes[1:]):
        level = wp.empty(planes * w * h, dtype=wp.float32, device=device)
        old, size = wp.vec2i(*sizes[m]), wp.vec2i(w, h)
        even = sizes[m] == (2 * w, 2 * h)
        if finer is None:
            for code, k, plane in groups:
                (xs, *x), (ys, *y) = sources[k], sources[k + 1 if code == NORMAL else k]
                inputs = [xs, ys, wp.vec2i(*x), wp.vec2i(*y), old, size, plane]
                kernel = make_first_kernel(lanes, code, even)
                dispatch.launch(kernel, _rows(lanes, w, h), inputs, [level], device=device)
        else:
            inputs = [finer, old, size]
            kernel = make_next_kernel(lanes, even)
            dispatch.launch(kernel, _rows(lanes, w, planes * h), inputs, [level], device=device)
        for code, k, plane in groups:
            inputs = [level, size, plane, k, len(channels), start]
            kernel, rows = make_blocks_kernel(lanes, code), (h + 3) >> 2
            dispatch.launch(kernel, _rows(lanes, 16 * ((w + 3) >> 2), rows), inputs, [flat], device=device)
        start, finer = start + 16 * counts[m], level
    return texels, counts
