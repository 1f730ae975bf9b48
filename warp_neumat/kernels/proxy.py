"""A material in three numbers: Lambert's term and one isotropic GGX lobe, of luminance alone.

It says how much a texel's light changes when viewer, light or surface turn, at a cost far below the material's own.
With diffuse d, specular s and α²,

    value × n·l = (d/π + (|s| + g w) D V) n·l,    w = (1 − v·h)⁵,    g = max(1 − |s|, 0) if s < 0, else 0.

D is the distribution of Trowbridge and Reitz, V the height-correlated masking and shadowing of Smith over
4 (n·l)(n·v): Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", JCGT 3(2), 2014,
Eq. 99. So the sign of s is a switch: a negative one rises to 1 at grazing angles as Schlick's reflectance does ("An
Inexpensive BRDF Model for Physically-based Rendering", 1994), a positive one is the same at every angle.

Vectors are unit and in one frame, any, as the world's; l points to the light, v to the viewer, both away from the
surface. 1 − (n·h)² is taken from the cross product of n and l + v: the difference would leave nothing of a sharp lobe.
"""

import functools

import numpy as np
import warp as wp

from warp_neumat.kernels import arrays, dispatch

wp.set_module_options(dispatch.module_options())

_INV_PI = wp.constant(0.318309886183790672)


@wp.struct
class ProxyColors:
    """A material's proxy in colour, and ε of ``kernels/carry.py`` [radiance]; ε = 0: not to be used."""

    diffuse: wp.vec3
    specular: wp.vec3
    grazing: wp.vec3
    alpha2: float
    epsilon: float


@wp.func
def proxy_terms(alpha2: float, n: wp.vec3, l: wp.vec3, v: wp.vec3) -> wp.vec3:
    """Return (1/π, D V, w D V) · n·l [1/sr]: what diffuse, |s| and g are factors of; 0 below either horizon.

    Args:
        alpha2: α² in (0, 1].
        n: Unit normal.
        l: Unit direction to the light.
        v: Unit direction to the viewer.

    No finite input gives a NaN, and nothing in here keeps a lane loop from becoming vector code.
    """
    nl = wp.max(wp.dot(n, l), 0.0)
    nv = wp.max(wp.dot(n, v), 0.0)
    s = l + v
    s2 = wp.max(wp.dot(s, s), 1.0e-20)
    c = wp.cross(n, s)
    rest = 1.0 - alpha2
    # (1 − α²) sin² θ_h + α² is (n·h)² (α² − 1) + 1.
    spread = wp.max(alpha2 + rest * wp.min(wp.dot(c, c) / s2, 1.0), 1.0e-12)
    masking = nl * wp.sqrt(alpha2 + rest * nv * nv) + nv * wp.sqrt(alpha2 + rest * nl * nl)
    lobe = 0.5 * _INV_PI * alpha2 / (spread * spread * wp.max(masking, 1.0e-12))
    u = wp.max(1.0 - 0.5 * wp.sqrt(s2), 0.0)  # v·h is half the length of l + v
    cosine = wp.where(nv > 0.0, nl, 0.0)
    lobe = cosine * lobe
    return wp.vec3(_INV_PI * cosine, lobe, (u * u * u * u * u) * lobe)


@wp.func
def proxy_value(params: wp.vec3, n: wp.vec3, l: wp.vec3, v: wp.vec3) -> float:
    """Return luminance × n·l [1/sr]; 0 where l or v is not above the horizon of n.

    Args:
        params: Diffuse ≥ 0, specular (its sign: see the module), α² in (0, 1].
        n, l, v: As :func:`proxy_terms`.
    """
    t = proxy_terms(params[2], n, l, v)
    grazing = wp.where(params[1] < 0.0, wp.max(1.0 + params[1], 0.0), 0.0)
    return params[0] * t[0] + wp.abs(params[1]) * t[1] + grazing * t[2]


@functools.cache
def _make_kernel(lanes: int):
    L = lanes
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel
    def proxy_kernel(
        first: int,
        params: wp.array(dtype=wp.float32),
        normal: wp.array(dtype=wp.float32),
        light: wp.array(dtype=wp.float32),
        viewer: wp.array(dtype=wp.float32),
        count: int,
        # outputs
        value: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        start = wp.uint64(b * L) * FLOAT
        offset = start * wp.uint64(3)
        P = wp.array(ptr=params.ptr + offset, shape=(3 * L,), dtype=wp.float32)
        N = wp.array(ptr=normal.ptr + offset, shape=(3 * L,), dtype=wp.float32)
        I = wp.array(ptr=light.ptr + offset, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        O = wp.array(ptr=viewer.ptr + offset, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        Y = wp.array(ptr=value.ptr + start, shape=(L,), dtype=wp.float32)
        if (b + 1) * L <= count:
            for l in range(L):
                Y[l] = proxy_value(
                    wp.vec3(P[3 * l], P[3 * l + 1], P[3 * l + 2]),
                    wp.vec3(N[3 * l], N[3 * l + 1], N[3 * l + 2]),
                    wp.vec3(I[3 * l], I[3 * l + 1], I[3 * l + 2]),
                    wp.vec3(O[3 * l], O[3 * l + 1], O[3 * l + 2]),
                )
        else:
            for l in range(L):
                if b * L + l < count:
                    Y[l] = proxy_value(
                        wp.vec3(P[3 * l], P[3 * l + 1], P[3 * l + 2]),
                        wp.vec3(N[3 * l], N[3 * l + 1], N[3 * l + 2]),
                        wp.vec3(I[3 * l], I[3 * l + 1], I[3 * l + 2]),
                        wp.vec3(O[3 * l], O[3 * l + 1], O[3 * l + 2]),
                    )

    return proxy_kernel


def proxy_eval(params, normal, light, viewer):
    """Return luminance × n·l [1/sr] of rows, shape [n], float32, of the kind of ``light``.

    Args:
        params: Diffuse, specular and α², shape [n, 3]; or three numbers for all rows.
        normal: Unit normals, shape [n, 3]; or three numbers for all rows.
        light: Unit directions to the light, shape [n, 3]; numpy, torch or Warp.
        viewer: Unit directions to the viewer, shape [n, 3].

    Raises: ValueError: If a shape or device differs.
    Error: relative to the value + 1e-3, at most 2e-4 for α from 0.3 on, 6e-4 within such a highlight and 8e-3 within
        one of α from 0.01 on; held by test_proxy_matches_float64.
    """
    kind = arrays.kind_of(light)
    to_light = arrays.take(light, "light", ("n", 3), wp.float32, kind)
    count, device = to_light.shape[0], kind.device

    def rows(values, name):
        if not hasattr(values, "shape") and np.ndim(values) == 1:
            values = wp.array(np.tile(np.asarray(values, np.float32), (count, 1)), dtype=wp.float32, device=device)
        return arrays.take(values, name, (count, 3), wp.float32, kind)

    columns = [rows(params, "params"), rows(normal, "normal"), to_light, rows(viewer, "viewer")]
    result, lanes = kind.empty((count,), wp.float32), dispatch.lanes(device)
    if count:  # Warp does not flatten an empty array
        dispatch.launch(
            _make_kernel(lanes),
            dispatch.blocks(count, lanes),
            inputs=[*(column.flatten() for column in columns), count],
            outputs=[result],
            device=device,
        )
    return kind.give(result)
