"""Carrying radiance to the present: what is stored of a texel is its ratio to the proxy's radiance.

A texel that was shaded some frames ago shows light that has moved since. Its material is expensive, the material's
*proxy* (``materials/proxy.py``: Lambert and one GGX lobe per channel) is not, and where the proxy grows by a factor,
so does the material, nearly. With L the radiance of the material, P that of its proxy under the same lights, the
texture holds

    ρ = (L + ε) / (P + ε),

and a pixel shows max(ρ (P′ + ε) − ε, 0), P′ being the proxy at the pixel's own point, normal and viewer, now. ε keeps
ρ bounded where the proxy is black; it is a twentieth of what the display shows as white. A viewer below the horizon of
an interpolated normal is raised to it for P as for L: P must not be black where L is lit. So what a frame pays for a
texel that is not shaded anew is the proxy, and its error is what the proxy does not follow. What changes ρ over the
surface is likewise only what the proxy does not know, so ρ may be sampled more coarsely than L.
"""

import functools

import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.frame import safe_normalize
from warp_neumat.kernels.proxy import proxy_terms
from warp_neumat.kernels.shade import Lights, Surface, raised_view
from warp_neumat.kernels.tiles import TILE_SHIFT, anchors
from warp_neumat.kernels.worklist import drawn, footprint

wp.set_module_options(dispatch.module_options())

EPSILON = 0.05
"""ε, as a share of the radiance that a display shows as white."""


@wp.func
def light_at(lights: Lights, j: int, p: wp.vec3):
    """Return (l, e): unit direction from ``p`` to light ``j``, and what range, cone and distance leave of it [1/m²]."""
    d = wp.vec3(lights.position[3 * j], lights.position[3 * j + 1], lights.position[3 * j + 2]) - p
    axis = wp.vec3(lights.direction[3 * j], lights.direction[3 * j + 1], lights.direction[3 * j + 2])
    d2 = wp.max(wp.dot(d, d), 1.0e-12)
    l = d / wp.sqrt(d2)
    q = d2 * lights.limits[3 * j]
    cone = wp.clamp(lights.limits[3 * j + 2] - lights.limits[3 * j + 1] * wp.dot(l, axis), 0.0, 1.0)
    return l, wp.max(1.0 - q * q, 0.0) * cone * cone / d2


_ROWS = 26  # scratch per lane: ratio, position, normal, proxy in ten numbers, its radiance, whether drawn, ω_o


def gather_words(lanes: int) -> int:
    """Return the float32 words of scratch that the gather needs for a block."""
    return _ROWS * lanes


@functools.cache
def make_gather_kernel(lanes: int):
    """Return the kernel that makes the picture from ratios, for blocks of ``lanes`` pixels.

    Error: at most 2e-5 + 5e-6 of the value against float64, given the stored ratios, the most at the edge of a narrow
        spot's cone; held by test_carried_gather_matches_float64.
    """
    L = lanes
    STRIDE = TOTAL = gather_words(lanes)
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def carry_gather_kernel(
        first: int,
        slot: int,
        pixel_triangle: wp.array(dtype=wp.int32),
        pixel_barycentric: wp.array(dtype=wp.float32),
        pixel_count: int,
        corner_uv: wp.array(dtype=wp.float32),
        ratio: wp.array(dtype=wp.float16),
        width: int,
        height: int,
        rate: wp.array(dtype=wp.uint8),
        columns: int,
        background: wp.vec3,
        surface: Surface,
        face_material: wp.array(dtype=wp.int32),
        proxies: wp.array(dtype=wp.float32),
        epsilon: float,
        lights: Lights,
        eye: wp.vec3,
        scratch: wp.array(dtype=wp.float32),
        # outputs
        blank: wp.array(dtype=wp.uint8),
        image: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        end = wp.min((b + 1) * L, pixel_count)
        empty = wp.where(drawn(pixel_triangle, b * L, end) == 0, 1, 0)
        if empty == 1 and blank[b] == wp.uint8(1):
            return
        blank[b] = wp.uint8(empty)
        own = scratch.ptr + wp.uint64(slot) * wp.uint64(STRIDE) * FLOAT
        if wp.static(L == 1):
            local = wp.zeros(shape=TOTAL, dtype=wp.float32)
            own = local.ptr
        R = wp.array(ptr=own, shape=(3 * L,), dtype=wp.float32)
        P = wp.array(ptr=own + wp.uint64(3 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        N = wp.array(ptr=own + wp.uint64(6 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        K = wp.array(ptr=own + wp.uint64(9 * L) * FLOAT, shape=(10 * L,), dtype=wp.float32)
        Y = wp.array(ptr=own + wp.uint64(19 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        D = wp.array(ptr=own + wp.uint64(22 * L) * FLOAT, shape=(L,), dtype=wp.int32)
        V = wp.array(ptr=own + wp.uint64(23 * L) * FLOAT, shape=(3 * L,), dtype=wp.float32)
        for l in range(L):
            i = wp.min(b * L + l, pixel_count - 1)
            f = pixel_triangle[i]
            D[l] = wp.where(f >= 0, 1, 0)
            if f >= 0:
                b1 = pixel_barycentric[2 * i]
                b2 = pixel_barycentric[2 * i + 1]
                b0 = 1.0 - b1 - b2
                x, y, u, v = footprint(corner_uv, f, b1, b2, width, height)
                r = int(rate[(y >> TILE_SHIFT) * columns + (x >> TILE_SHIFT)])
                x0, y0, s, t = anchors(x, y, u, v, r)
                at = 4 * (y0 * width + x0)
                right = 4 << r
                below = (4 * width) << r
                i0 = 3 * surface.faces[3 * f]
                i1 = 3 * surface.faces[3 * f + 1]
                i2 = 3 * surface.faces[3 * f + 2]
                sign = wp.where(surface.side[f] < wp.int8(0), -1.0, 1.0)
                for c in range(3):
                    top = (1.0 - s) * float(ratio[at + c]) + s * float(ratio[at + right + c])
                    bottom = (1.0 - s) * float(ratio[at + below + c]) + s * float(ratio[at + below + right + c])
                    R[c * L + l] = (1.0 - t) * top + t * bottom
                    P[c * L + l] = (
                        b0 * surface.points[i0 + c] + b1 * surface.points[i1 + c] + b2 * surface.points[i2 + c]
                    )
                    N[c * L + l] = sign * (
                        b0 * surface.normals[i0 + c] + b1 * surface.normals[i1 + c] + b2 * surface.normals[i2 + c]
                    )
                m = 10 * face_material[f]
                for c in range(10):
                    K[c * L + l] = proxies[m + c]
            else:
                for c in range(3):
                    R[c * L + l] = 1.0
                    P[c * L + l] = 0.0
                    N[c * L + l] = wp.where(c == 2, 1.0, 0.0)
                for c in range(10):
                    K[c * L + l] = wp.where(c == 9, 1.0, 0.0)
        for l in range(L):
            n = safe_normalize(wp.vec3(N[l], N[L + l], N[2 * L + l]))
            to_eye = raised_view(safe_normalize(eye - wp.vec3(P[l], P[L + l], P[2 * L + l])), n)
            for c in range(3):
                N[c * L + l] = n[c]
                V[c * L + l] = to_eye[c]
                Y[c * L + l] = epsilon
        for j in range(lights.count):
            for l in range(L):
                p = wp.vec3(P[l], P[L + l], P[2 * L + l])
                to_light, left = light_at(lights, j, p)
                n = wp.vec3(N[l], N[L + l], N[2 * L + l])
                k = proxy_terms(K[9 * L + l], n, to_light, wp.vec3(V[l], V[L + l], V[2 * L + l]))
                for c in range(3):
                    value = K[c * L + l] * k[0] + K[(3 + c) * L + l] * k[1] + K[(6 + c) * L + l] * k[2]
                    Y[c * L + l] = Y[c * L + l] + left * lights.intensity[3 * j + c] * value
        if (b + 1) * L <= pixel_count:  # a test in the loop would keep it from becoming vector code
            block = wp.array(ptr=image.ptr + wp.uint64(b * L) * FLOAT * wp.uint64(3), shape=(3 * L,), dtype=wp.float32)
            for l in range(L):
                for c in range(3):
                    shown = wp.max(R[c * L + l] * Y[c * L + l] - epsilon, 0.0)
                    block[3 * l + c] = wp.where(D[l] == 1, shown, background[c])
        else:
            for l in range(L):
                if b * L + l < pixel_count:
                    for c in range(3):
                        last = wp.max(R[c * L + l] * Y[c * L + l] - epsilon, 0.0)
                        image[3 * (b * L + l) + c] = wp.where(D[l] == 1, last, background[c])

    return carry_gather_kernel
