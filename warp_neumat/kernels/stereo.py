"""Shading for two eyes at once: where they agree, and the tiles that they have in common.

:func:`make_difference_kernel` says how much a tile's proxy differs between the eyes. The next two work on tiles that
are shared, which a third shader (the *middle* one) shades instead of the eyes' own: :func:`merge_kernel` hands it what
either eye will read, and :func:`spread_kernel` copies what it has shaded to the second eye's texture. So each eye's
texture is whole, and marking and gathering know nothing of sharing. A shared tile needs one rate in all three, or the
middle shades the anchors of several. :func:`clear_kernel` is for tiles that begin or cease to be shared.
"""

import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.carry import light_at
from warp_neumat.kernels.frame import safe_normalize
from warp_neumat.kernels.proxy import proxy_terms
from warp_neumat.kernels.shade import Lights, Surface, raised_view

wp.set_module_options(dispatch.module_options())

APART = wp.constant(2.0)
"""Difference where the eyes see different sides, or nothing: above any that √Y can have."""

_ROWS = 13  # scratch per lane: position, normal, proxy, both eyes' luminance, and whether they see the same side


def scratch_words(lanes: int) -> int:
    """Return the float32 words of scratch that the difference kernel needs for a block."""
    return _ROWS * lanes


@functools.cache
def make_difference_kernel(lanes: int):
    """Return the kernel for blocks of ``lanes`` samples.

    Error: at most 2e-6 against float64; held by test_difference_between_the_eyes_matches_float64.
    """
    L = lanes
    STRIDE = TOTAL = scratch_words(lanes)
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def difference_kernel(
        first: int,
        slot: int,
        samples: wp.array(dtype=wp.int32),
        count: int,
        texel_material: wp.array(dtype=wp.uint8),
        proxies: wp.array(dtype=wp.float32),
        surface: Surface,
        other_side: wp.array(dtype=wp.int8),
        lights: Lights,
        eye: wp.vec3,
        other_eye: wp.vec3,
        gain: float,
        scratch: wp.array(dtype=wp.float32),
        # outputs
        difference: wp.array(dtype=wp.float32),
    ):
        """Write |√Y − √Y′| of the proxy as the two eyes see it, for each sample texel; :data:`APART` without one.

        Args:
            samples: Texels, −1 = none.
            proxies: Diffuse, specular, grazing and α² of luminance per material.
            surface: Of the first eye; ``other_side`` says which side of each triangle the other one sees.
        """
        b = first + wp.tid()
        own = scratch.ptr + wp.uint64(slot) * wp.uint64(STRIDE) * FLOAT
        if wp.static(L == 1):
            local = wp.zeros(shape=TOTAL, dtype=wp.float32)
            own = local.ptr
        P = wp.array(ptr=own, shape=(3 * L,), dtype=wp.float32)
        N = wp.array(ptr=own + wp.uint64(3 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        K = wp.array(ptr=own + wp.uint64(6 * L) * FLOAT, shape=(4 * L,), dtype=wp.float32)
        Y = wp.array(ptr=own + wp.uint64(10 * L) * FLOAT, shape=(L,), dtype=wp.float32)
        Z = wp.array(ptr=own + wp.uint64(11 * L) * FLOAT, shape=(L,), dtype=wp.float32)
        S = wp.array(ptr=own + wp.uint64(12 * L) * FLOAT, shape=(L,), dtype=wp.float32)
        for l in range(L):
            Y[l] = 0.0
            Z[l] = 0.0
            S[l] = 0.0
            for c in range(3):
                P[c * L + l] = 0.0
                N[c * L + l] = wp.where(c == 2, 1.0, 0.0)
            for c in range(4):
                K[c * L + l] = wp.where(c == 3, 1.0, 0.0)
            at = samples[wp.min(b * L + l, count - 1)]
            if at >= 0 and b * L + l < count:
                f = wp.max(surface.triangle[at], 0)
                side = surface.side[f]
                if side != wp.int8(0) and side == other_side[f]:
                    S[l] = 1.0
                    b1 = surface.barycentric[2 * at]
                    b2 = surface.barycentric[2 * at + 1]
                    b0 = 1.0 - b1 - b2
                    i0 = 3 * surface.faces[3 * f]
                    i1 = 3 * surface.faces[3 * f + 1]
                    i2 = 3 * surface.faces[3 * f + 2]
                    sign = wp.where(side < wp.int8(0), -1.0, 1.0)
                    for c in range(3):
                        P[c * L + l] = (
                            b0 * surface.points[i0 + c] + b1 * surface.points[i1 + c] + b2 * surface.points[i2 + c]
                        )
                        N[c * L + l] = sign * (
                            b0 * surface.normals[i0 + c] + b1 * surface.normals[i1 + c] + b2 * surface.normals[i2 + c]
                        )
                    m = wp.max(int(texel_material[at]) - 1, 0)
                    for c in range(4):
                        K[c * L + l] = proxies[4 * m + c]
        for l in range(L):
            n = safe_normalize(wp.vec3(N[l], N[L + l], N[2 * L + l]))
            for c in range(3):
                N[c * L + l] = n[c]
        for j in range(lights.count):
            power = 0.2126 * lights.intensity[3 * j] + 0.7152 * lights.intensity[3 * j + 1]
            power += 0.0722 * lights.intensity[3 * j + 2]
            for l in range(L):
                p = wp.vec3(P[l], P[L + l], P[2 * L + l])
                n = wp.vec3(N[l], N[L + l], N[2 * L + l])
                to_light, left = light_at(lights, j, p)
                t = proxy_terms(K[3 * L + l], n, to_light, raised_view(safe_normalize(eye - p), n))
                Y[l] = Y[l] + power * left * (K[l] * t[0] + K[L + l] * t[1] + K[2 * L + l] * t[2])
                t = proxy_terms(K[3 * L + l], n, to_light, raised_view(safe_normalize(other_eye - p), n))
                Z[l] = Z[l] + power * left * (K[l] * t[0] + K[L + l] * t[1] + K[2 * L + l] * t[2])
        for l in range(L):
            if b * L + l < count:
                y = wp.sqrt(wp.clamp(gain * Y[l], 0.0, 1.0))
                z = wp.sqrt(wp.clamp(gain * Z[l], 0.0, 1.0))
                difference[b * L + l] = wp.where(S[l] > 0.0, wp.abs(y - z), APART)

    return difference_kernel


COUNTERS = 6
"""Counters per row of :func:`merge_kernel`, over its shared tiles: texels that the left, the right and both eyes read;
texels between the anchors that the left and the right one read; and tiles that either reads."""

_MERGE = """
    const int columns = (width + 7) >> 3, y0 = 8 * row, high = height - y0 < 8 ? height - y0 : 8;
    int n[6] = {0, 0, 0, 0, 0, 0};
    for (int column = 0; column < columns; ++column) {
        const int tile = row * columns + column, x0 = 8 * column, wide = width - x0 < 8 ? width - x0 : 8;
        if (!shared.data[tile]) continue;
        int a = 0, b = 0, both = 0;
        for (int j = 0; j < high; ++j) {
            const long long at = (long long)(y0 + j) * width + x0;
            unsigned long long u = 0, v = 0;
            if (wide == 8) {  // a constant length is a load, not a call
                memcpy(&u, left.data + at, 8);
                memcpy(&v, right.data + at, 8);
            } else {
                memcpy(&u, left.data + at, wide);
                memcpy(&v, right.data + at, wide);
            }
            if (!(u | v)) continue;
            a += u * ONES >> 56;  // a byte is 0 or 1, so this is their sum
            b += v * ONES >> 56;
            both += (u & v) * ONES >> 56;
            const unsigned long long all = u | v, none = 0;
            memcpy(middle.data + at, &all, wide);
            memcpy(left.data + at, &none, wide);
            memcpy(right.data + at, &none, wide);
        }
        if (!(a | b)) continue;
        const int between = (1 << 2 * rate.data[tile]) - 1;
        n[0] += a; n[1] += b; n[2] += both; n[3] += between * a; n[4] += between * b; ++n[5];
        int sum = 0;
        for (int s = 0; s < slots; ++s) {
            int& p = left_pixels.data[s * tiles + tile];
            int& q = right_pixels.data[s * tiles + tile];
            sum += p + q;
            p = q = 0;
        }
        middle_pixels.data[tile] = sum;
    }
    for (int k = 0; k < 6; ++k) counts.data[6 * row + k] = n[k];
"""


@wp.func_native("const unsigned long long ONES = 0x0101010101010101ull;" + _MERGE)
def _merge_row(
    row: int,
    shared: wp.array(dtype=wp.uint8),
    rate: wp.array(dtype=wp.uint8),
    width: int,
    height: int,
    tiles: int,
    slots: int,
    left: wp.array(dtype=wp.uint8),
    right: wp.array(dtype=wp.uint8),
    middle: wp.array(dtype=wp.uint8),
    left_pixels: wp.array(dtype=wp.int32),
    right_pixels: wp.array(dtype=wp.int32),
    middle_pixels: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
): ...


@wp.kernel
def merge_kernel(
    first: int,
    shared: wp.array(dtype=wp.uint8),
    rate: wp.array(dtype=wp.uint8),
    width: int,
    height: int,
    tiles: int,
    slots: int,
    # outputs
    left: wp.array(dtype=wp.uint8),
    right: wp.array(dtype=wp.uint8),
    middle: wp.array(dtype=wp.uint8),
    left_pixels: wp.array(dtype=wp.int32),
    right_pixels: wp.array(dtype=wp.int32),
    middle_pixels: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
):
    """Move what the eyes read of a row's shared tiles to the middle: the seen texels, and the pixels [slot][tile].

    ``counts`` is [row][:data:`COUNTERS`].
    """
    _merge_row(
        first + wp.tid(),
        shared,
        rate,
        width,
        height,
        tiles,
        slots,
        left,
        right,
        middle,
        left_pixels,
        right_pixels,
        middle_pixels,
        counts,
    )


_SPREAD = """
    const int columns = (width + 7) >> 3, y0 = 8 * row, high = height - y0 < 8 ? height - y0 : 8;
    for (int column = 0; column < columns; ++column) {
        const int tile = row * columns + column, x0 = 8 * column, wide = width - x0 < 8 ? width - x0 : 8;
        if (!shared.data[tile] || !tile_shaded.data[tile]) continue;
        for (int j = 0; j < high; ++j) {
            const long long at = 4 * ((long long)(y0 + j) * width + x0);
            memcpy((void*)(target.data + at), (const void*)(source.data + at), 8 * wide);
        }
    }
"""


@wp.func_native(_SPREAD)
def _spread_row(
    row: int,
    shared: wp.array(dtype=wp.uint8),
    tile_shaded: wp.array(dtype=wp.uint8),
    width: int,
    height: int,
    source: wp.array(dtype=wp.float16),
    target: wp.array(dtype=wp.float16),
): ...


@wp.kernel
def spread_kernel(
    first: int,
    shared: wp.array(dtype=wp.uint8),
    tile_shaded: wp.array(dtype=wp.uint8),
    width: int,
    height: int,
    source: wp.array(dtype=wp.float16),
    # outputs
    target: wp.array(dtype=wp.float16),
):
    """Copy the texels of a row's shared tiles that were shaded in this frame, flat RGBA."""
    _spread_row(first + wp.tid(), shared, tile_shaded, width, height, source, target)


_CLEAR = """
    const int columns = (width + 7) >> 3, x0 = 8 * (tile % columns), y0 = 8 * (tile / columns);
    const int high = height - y0 < 8 ? height - y0 : 8, wide = width - x0 < 8 ? width - x0 : 8;
    for (int j = 0; j < high; ++j) for (int i = 0; i < wide; ++i) {
        const long long at = (long long)(y0 + j) * width + x0 + i;
        done.data[at] = 0;
        radiance.data[4 * at + 3] = never;
    }
"""


@wp.func_native(_CLEAR)
def _clear_tile(
    tile: int,
    width: int,
    height: int,
    never: wp.float16,
    done: wp.array(dtype=wp.uint8),
    radiance: wp.array(dtype=wp.float16),
): ...


@wp.kernel
def clear_kernel(
    first: int,
    tiles: wp.array(dtype=wp.int32),
    count: int,
    per_block: int,
    width: int,
    height: int,
    # outputs
    done: wp.array(dtype=wp.uint8),
    radiance: wp.array(dtype=wp.float16),
):
    """Take the texels of the listed tiles as never shaded; their colours stay."""
    b = first + wp.tid()
    for i in range(b * per_block, wp.min((b + 1) * per_block, count)):
        _clear_tile(tiles[i], width, height, wp.float16(-1.0), done, radiance)
