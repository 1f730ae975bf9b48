"""What a scheduler knows of a tile: how its light has changed, how large its texels are, and what shading it showed.

One texel speaks for its tile. :func:`make_predict_kernel` gives the proxy's radiance there under the present lights,
pose and viewer, as √Y of what a display shows, so that the difference to what it was when the tile was shaded is the
predicted visible change; and the size of a texel on the picture. :func:`learn_kernel` reads what shading has left of
the whole tile: the change that it did make, and how far the anchors are from lying on straight lines, which is what a
coarser rate would miss.
"""

import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.carry import light_at
from warp_neumat.kernels.frame import safe_normalize
from warp_neumat.kernels.proxy import proxy_terms
from warp_neumat.kernels.shade import Lights, Surface, Viewer, raised_view

wp.set_module_options(dispatch.module_options())

UNKNOWN = -1.0
"""What :func:`learn_kernel` writes where a tile has nothing to learn from."""

_ROWS = 11  # scratch per lane: position, normal, proxy


def scratch_words(lanes: int) -> int:
    """Return the float32 words of scratch that the predicting kernel needs for a block."""
    return _ROWS * lanes


@wp.func
def texel_size(dx: wp.vec3, dy: wp.vec3, to: wp.vec3, depth: float, right: wp.vec3, down: wp.vec3) -> float:
    """Return the length on the picture [px] of the longer axis of the ellipse that a texel's unit circle becomes.

    Args:
        dx, dy: How the surface point moves over one texel to the right and one down.
        to: Vector from the eye to the point, of view depth ``depth``.
        right, down: How a ray of view depth 1 moves over one pixel.
    """
    forward = wp.cross(right, down)
    step2 = wp.dot(right, right)
    forward = forward / wp.max(step2, 1.0e-30)
    z = wp.max(depth, 1.0e-20)
    scale = 1.0 / (wp.max(step2, 1.0e-30) * z)
    px = scale * (wp.dot(dx, right) - wp.dot(to, right) / z * wp.dot(dx, forward))
    py = scale * (wp.dot(dx, down) - wp.dot(to, down) / z * wp.dot(dx, forward))
    qx = scale * (wp.dot(dy, right) - wp.dot(to, right) / z * wp.dot(dy, forward))
    qy = scale * (wp.dot(dy, down) - wp.dot(to, down) / z * wp.dot(dy, forward))
    a = px * px + py * py
    b = qx * qx + qy * qy
    c = px * qx + py * qy
    half = 0.5 * (a - b)
    return wp.sqrt(wp.max(0.5 * (a + b) + wp.sqrt(half * half + c * c), 0.0))


@functools.cache
def make_predict_kernel(lanes: int):
    """Return the kernel for blocks of ``lanes`` tiles."""
    L = lanes
    STRIDE = TOTAL = scratch_words(lanes)
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def predict_kernel(
        first: int,
        slot: int,
        tiles: wp.array(dtype=wp.int32),
        count: int,
        sample: wp.array(dtype=wp.int32),
        texel_material: wp.array(dtype=wp.uint8),
        corner_uv: wp.array(dtype=wp.float32),
        proxies: wp.array(dtype=wp.float32),
        surface: Surface,
        lights: Lights,
        viewer: Viewer,
        gain: float,
        scratch: wp.array(dtype=wp.float32),
        # outputs
        now: wp.array(dtype=wp.float32),
        size: wp.array(dtype=wp.float32),
    ):
        """Write √Y of the proxy and the size of a texel [px] of the listed tiles.

        Of a tile without a sample √Y is 0, and its size is left as it was.
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
        for l in range(L):
            Y[l] = 0.0
            tile = tiles[wp.min(b * L + l, count - 1)]
            at = sample[tile]
            for c in range(3):
                P[c * L + l] = 0.0
                N[c * L + l] = wp.where(c == 2, 1.0, 0.0)
            for c in range(4):
                K[c * L + l] = 0.0
            if at >= 0 and b * L + l < count:
                f = wp.max(surface.triangle[at], 0)
                b1 = surface.barycentric[2 * at]
                b2 = surface.barycentric[2 * at + 1]
                b0 = 1.0 - b1 - b2
                i0 = 3 * surface.faces[3 * f]
                i1 = 3 * surface.faces[3 * f + 1]
                i2 = 3 * surface.faces[3 * f + 2]
                sign = wp.where(surface.side[f] < wp.int8(0), -1.0, 1.0)
                p0 = wp.vec3(surface.points[i0], surface.points[i0 + 1], surface.points[i0 + 2])
                e1 = wp.vec3(surface.points[i1], surface.points[i1 + 1], surface.points[i1 + 2]) - p0
                e2 = wp.vec3(surface.points[i2], surface.points[i2 + 1], surface.points[i2 + 2]) - p0
                p = p0 + e1 * b1 + e2 * b2
                for c in range(3):
                    P[c * L + l] = p[c]
                    N[c * L + l] = sign * (
                        b0 * surface.normals[i0 + c] + b1 * surface.normals[i1 + c] + b2 * surface.normals[i2 + c]
                    )
                m = wp.max(int(texel_material[at]) - 1, 0)
                for c in range(4):
                    K[c * L + l] = proxies[4 * m + c]
                ax = corner_uv[6 * f + 2] - corner_uv[6 * f]
                ay = corner_uv[6 * f + 3] - corner_uv[6 * f + 1]
                cx = corner_uv[6 * f + 4] - corner_uv[6 * f]
                cy = corner_uv[6 * f + 5] - corner_uv[6 * f + 1]
                area = ax * cy - ay * cx
                inverse = wp.where(wp.abs(area) > 1.0e-9, 1.0 / area, 0.0)
                dx = (e1 * cy - e2 * ay) * inverse
                dy = (e2 * ax - e1 * cx) * inverse
                to = p - viewer.eye
                size[tile] = texel_size(dx, dy, to, wp.dot(to, viewer.forward), viewer.right, viewer.down)
        for j in range(lights.count):
            power = 0.2126 * lights.intensity[3 * j] + 0.7152 * lights.intensity[3 * j + 1]
            power += 0.0722 * lights.intensity[3 * j + 2]
            for l in range(L):
                p = wp.vec3(P[l], P[L + l], P[2 * L + l])
                n = safe_normalize(wp.vec3(N[l], N[L + l], N[2 * L + l]))
                to_light, left = light_at(lights, j, p)
                t = proxy_terms(K[3 * L + l], n, to_light, raised_view(safe_normalize(viewer.eye - p), n))
                Y[l] = Y[l] + power * left * (K[l] * t[0] + K[L + l] * t[1] + K[2 * L + l] * t[2])
        for l in range(L):
            if b * L + l < count:
                now[tiles[b * L + l]] = wp.sqrt(wp.clamp(gain * Y[l], 0.0, 1.0))

    return predict_kernel


# √Y of an anchor; `mul` and `sub` turn a stored ratio back into radiance, at the proxy's radiance of the tile.
_LEARN = """
#ifdef __CUDA_ARCH__
#define NEUMAT_HALF(at) half_to_float(radiance.data[at])
#else
    const _Float16* const texels = (const _Float16*)(const void*)radiance.data;
#define NEUMAT_HALF(at) (float)texels[at]
#endif
    const int columns = (width + 7) >> 3, x0 = 8 * (tile % columns), y0 = 8 * (tile / columns);
    const int r = rate.data[tile], n = 8 >> r, step = 1 << r, m = r ? n + 1 : n;
    float y[81];
    float sum = 0.f;
    int known = 0;
    for (int j = 0; j < m; ++j) for (int i = 0; i < m; ++i) {
        const int x = x0 + i * step, v = y0 + j * step;
        float root = -1.f;
        if (x < width && v < height && done.data[(long long)v * width + x]) {
            const long long at = 4 * ((long long)v * width + x);
            const float lum = 0.2126f * NEUMAT_HALF(at) + 0.7152f * NEUMAT_HALF(at + 1) + 0.0722f * NEUMAT_HALF(at + 2);
            const float shown = gain * (lum * mul - sub);
            root = sqrtf(shown < 0.f ? 0.f : shown > 1.f ? 1.f : shown);
            const float change = NEUMAT_HALF(at + 3);
            if (i < n && j < n && change >= 0.f && change <= 1.f) { sum += change; ++known; }
        }
        y[9 * j + i] = root;
    }
    float squares = 0.f;
    int triples = 0;
    for (int j = 0; j < m; ++j) for (int i = 0; i < m; ++i) {
        const float c = y[9 * j + i];
        if (c < 0.f) continue;
        if (i & 1 && i + 1 < m && y[9 * j + i - 1] >= 0.f && y[9 * j + i + 1] >= 0.f) {
            const float e = c - 0.5f * (y[9 * j + i - 1] + y[9 * j + i + 1]);
            squares += e * e; ++triples;
        }
        if (j & 1 && j + 1 < m && y[9 * j - 9 + i] >= 0.f && y[9 * j + 9 + i] >= 0.f) {
            const float e = c - 0.5f * (y[9 * j - 9 + i] + y[9 * j + 9 + i]);
            squares += e * e; ++triples;
        }
    }
    changed.data[tile] = known ? sum / known : UNKNOWN;
    rough.data[tile] = triples ? sqrtf(squares / triples) : UNKNOWN;
#undef NEUMAT_HALF
"""


@wp.func_native(f"const float UNKNOWN = {UNKNOWN}f;" + _LEARN)
def _learn_tile(
    tile: int,
    width: int,
    height: int,
    rate: wp.array(dtype=wp.uint8),
    done: wp.array(dtype=wp.uint8),
    radiance: wp.array(dtype=wp.float16),
    gain: float,
    mul: float,
    sub: float,
    changed: wp.array(dtype=wp.float32),
    rough: wp.array(dtype=wp.float32),
): ...


@wp.kernel
def learn_kernel(
    first: int,
    tiles: wp.array(dtype=wp.int32),
    count: int,
    width: int,
    height: int,
    rate: wp.array(dtype=wp.uint8),
    done: wp.array(dtype=wp.uint8),
    radiance: wp.array(dtype=wp.float16),
    now: wp.array(dtype=wp.float32),
    gain: float,
    epsilon: float,
    per_block: int,
    # outputs
    changed: wp.array(dtype=wp.float32),
    rough: wp.array(dtype=wp.float32),
):
    """Write the mean change and the roughness of the listed tiles, :data:`UNKNOWN` where there is none to see.

    ``epsilon`` is ε of ``kernels/carry.py`` in radiance where the texture holds ratios, and 0 where it holds radiance.
    ``rough`` is the root mean square of what each second anchor differs, in √Y, from the mean of its two neighbours.
    """
    b = first + wp.tid()
    for i in range(b * per_block, wp.min((b + 1) * per_block, count)):
        tile = tiles[i]
        mul = float(1.0)
        if epsilon > 0.0:
            mul = now[tile] * now[tile] / gain + epsilon
        _learn_tile(tile, width, height, rate, done, radiance, gain, mul, epsilon, changed, rough)
