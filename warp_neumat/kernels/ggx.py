"""The metallic-roughness BRDF of glTF 2.0 (specification, Appendix B): GGX reflection over a Lambertian base.

With α = roughness², half vector h, and w = (1 − ω_o·h)⁵, the value is

    (1 − metallic) (1 − F_d) c/π + F D V,    F_d = f + (1 − f) w,    F = F₀ + (1 − F₀) w,

f = 0.04 the reflectance of the dielectric, c the base colour, F₀ = f + (c − f) metallic. D is the distribution of
Trowbridge and Reitz, V the height-correlated masking and shadowing of Smith over 4 (n·ω_i)(n·ω_o): Heitz,
"Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", JCGT 3(2), 2014, Eq. 99. As the
specification says of its model, it is not quite energy conserving; ``test_white_furnace`` holds how much.

α is kept at :data:`ALPHA_MIN` and above, because a point light has no area that would keep a mirror's highlight
finite. 1 − (n·h)² is taken from the cross product of n and h: the difference would leave nothing of a sharp lobe in
float32.
"""

import functools

import numpy as np
import warp as wp

from warp_neumat.kernels import arrays, dispatch
from warp_neumat.kernels.frame import safe_normalize

wp.set_module_options(dispatch.module_options())

ALPHA_MIN = wp.constant(1.0e-3)
"""Least α [1]: a roughness below 0.032 shades like 0.032."""

DIELECTRIC = wp.constant(0.04)
"""Reflectance at normal incidence of an index of refraction of 1.5, where no map says otherwise."""

LEAST_COSINE = wp.constant(0.01)
"""Least n·ω_o that is shaded with a normal n other than that of the frame."""

_INV_PI = wp.constant(0.318309886183790672)


@wp.func
def ggx_alpha2(roughness: float) -> float:
    """Return α² for a perceptual roughness, which is clamped to [0, 1]."""
    r = wp.clamp(roughness, 0.0, 1.0)
    a = wp.max(r * r, ALPHA_MIN)
    return a * a


@wp.func
def ggx_diffuse(base: float, metallic: float, dielectric: float) -> float:
    """Return what the Lambertian part has of one colour, before the Fresnel weight 1 − w [1/sr]."""
    return base * (1.0 - metallic) * (1.0 - dielectric) * _INV_PI


@wp.func
def ggx_f0(base: float, metallic: float, dielectric: float) -> float:
    """Return the reflectance F₀ at normal incidence of one colour."""
    return dielectric + (base - dielectric) * metallic


@wp.func
def above_horizon(w: wp.vec3, n: wp.vec3) -> wp.vec3:
    """Return unit ``w`` raised to n·w = :data:`LEAST_COSINE` where it is lower; both unit, and not opposite."""
    z = wp.dot(w, n)
    p = w - n * z
    scale = wp.sqrt((1.0 - LEAST_COSINE * LEAST_COSINE) / wp.max(wp.dot(p, p), 1.0e-12))
    low = z < LEAST_COSINE
    # Component by component: a vector select would not become a blend in a lane loop.
    return wp.vec3(
        wp.where(low, p[0] * scale + n[0] * LEAST_COSINE, w[0]),
        wp.where(low, p[1] * scale + n[1] * LEAST_COSINE, w[1]),
        wp.where(low, p[2] * scale + n[2] * LEAST_COSINE, w[2]),
    )


@wp.func
def ggx(wi: wp.vec3, wo: wp.vec3, n: wp.vec3, alpha2: float, diffuse: wp.vec3, f0: wp.vec3) -> wp.vec3:
    """Return BRDF × n·ω_i [1/sr]; 0 where ω_i or ω_o lies below the horizon of ``n``.

    Args:
        wi, wo: Unit directions to light and viewer, in the frame of ``n``'s components.
        n: Unit normal.
        alpha2: :func:`ggx_alpha2` of the roughness.
        diffuse: :func:`ggx_diffuse` per colour.
        f0: :func:`ggx_f0` per colour.

    No input with finite components gives a NaN. Nothing in here keeps a lane loop from becoming vector code.
    """
    nl = wp.dot(n, wi)
    nv = wp.dot(n, wo)
    s = wi + wo
    s2 = wp.max(wp.dot(s, s), 1.0e-20)
    c = wp.cross(n, s)
    # (1 − α²) sin² θ_h + α² is the specification's (n·h)² (α² − 1) + 1.
    spread = alpha2 + (1.0 - alpha2) * wp.min(wp.dot(c, c) / s2, 1.0)
    l = wp.max(nl, 0.0)
    v = wp.max(nv, 0.0)
    rest = 1.0 - alpha2
    masking = l * wp.sqrt(alpha2 + rest * v * v) + v * wp.sqrt(alpha2 + rest * l * l)
    # The cosine is in: D · V · n·ω_i with V = 1 / (2 masking).
    lobe = _INV_PI * alpha2 / (spread * spread) * 0.5 * l / wp.max(masking, 1.0e-12)
    u = wp.max(1.0 - 0.5 * wp.sqrt(s2), 0.0)  # ω_o·h is half the length of ω_i + ω_o
    w = u * u * u * u * u
    base = l * (1.0 - w)
    lit = nl > 0.0 and nv > 0.0
    return wp.vec3(
        wp.where(lit, diffuse[0] * base + (f0[0] + (1.0 - f0[0]) * w) * lobe, 0.0),
        wp.where(lit, diffuse[1] * base + (f0[1] + (1.0 - f0[1]) * w) * lobe, 0.0),
        wp.where(lit, diffuse[2] * base + (f0[2] + (1.0 - f0[2]) * w) * lobe, 0.0),
    )


@functools.cache
def _make_kernel(lanes: int):
    L = STRIDE = lanes  # two names, because a constant that is cast keeps the new type in the rest of the kernel
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel
    def ggx_kernel(
        first: int,
        wi: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        normal: wp.array(dtype=wp.float32),
        base: wp.array(dtype=wp.float32),
        roughness: wp.array(dtype=wp.float32),
        metallic: wp.array(dtype=wp.float32),
        dielectric: wp.array(dtype=wp.float32),
        count: int,
        # outputs
        value: wp.array(dtype=wp.float32),
    ):
        b = first + wp.tid()
        offset = wp.uint64(b) * wp.uint64(3 * L) * FLOAT
        single = wp.uint64(b) * wp.uint64(STRIDE) * FLOAT
        I = wp.array(ptr=wi.ptr + offset, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        O = wp.array(ptr=wo.ptr + offset, shape=(3 * L,), dtype=wp.float32)  # noqa: E741
        N = wp.array(ptr=normal.ptr + offset, shape=(3 * L,), dtype=wp.float32)
        C = wp.array(ptr=base.ptr + offset, shape=(3 * L,), dtype=wp.float32)
        R = wp.array(ptr=roughness.ptr + single, shape=(L,), dtype=wp.float32)
        M = wp.array(ptr=metallic.ptr + single, shape=(L,), dtype=wp.float32)
        F = wp.array(ptr=dielectric.ptr + single, shape=(L,), dtype=wp.float32)
        V = wp.array(ptr=value.ptr + offset, shape=(3 * L,), dtype=wp.float32)
        for l in range(L):
            if b * L + l < count:
                i = safe_normalize(wp.vec3(I[3 * l], I[3 * l + 1], I[3 * l + 2]))
                o = safe_normalize(wp.vec3(O[3 * l], O[3 * l + 1], O[3 * l + 2]))
                n = safe_normalize(wp.vec3(N[3 * l], N[3 * l + 1], N[3 * l + 2]))
                m = M[l]
                f = F[l]
                c = wp.vec3(C[3 * l], C[3 * l + 1], C[3 * l + 2])
                diffuse = wp.vec3(ggx_diffuse(c[0], m, f), ggx_diffuse(c[1], m, f), ggx_diffuse(c[2], m, f))
                f0 = wp.vec3(ggx_f0(c[0], m, f), ggx_f0(c[1], m, f), ggx_f0(c[2], m, f))
                y = ggx(i, above_horizon(o, n), n, ggx_alpha2(R[l]), diffuse, f0)
                above = i[2] > 0.0 and o[2] > 0.0
                V[3 * l] = wp.where(above, y[0], 0.0)
                V[3 * l + 1] = wp.where(above, y[1], 0.0)
                V[3 * l + 2] = wp.where(above, y[2], 0.0)

    return ggx_kernel


def ggx_eval(wi, wo, base_color, roughness, metallic=0.0, *, dielectric=0.04, normal=None):
    """Return BRDF × cosine [1/sr] of the metallic-roughness model, shape [n, 3], float32, of the kind of ``wi``.

    Args:
        wi: Directions to the light, shape [n, 3], z = normal of the frame, any length; numpy, torch or Warp.
        wo: Directions to the viewer, shape [n, 3].
        base_color: Linear Rec. 709 in [0, 1], shape [n, 3]; or three numbers for all.
        roughness: Perceptual roughness, shape [n], or one number; clamped to [0, 1].
        metallic: In [0, 1], shape [n], or one number.
        dielectric: Reflectance of the dielectric at normal incidence, shape [n], or one number.
        normal: Normals in the frame, as a normal map gives them, z > 0, shape [n, 3]; None = (0, 0, 1).

    The cosine is that of the angle between ω_i and ``normal``. Below the frame's horizon, and where ω_i is below that
    of ``normal``, the value is 0; a viewer above the first and below the second is raised to
    :data:`LEAST_COSINE` over the second.

    Raises: ValueError: If a shape or device differs.
    Error: relative to the value + 1e-3, at most 2e-5 from roughness 0.3 on, 5e-4 with a bent normal, 1e-3 within the
        highlight from roughness 0.1 on and 4e-3 for any roughness; held by test_ggx_matches_float64.
    """
    kind = arrays.kind_of(wi)
    i = arrays.take(wi, "wi", ("n", 3), wp.float32, kind)
    count, device = i.shape[0], kind.device
    o = arrays.take(wo, "wo", (count, 3), wp.float32, kind)

    def column(values, name, width):
        if not hasattr(values, "shape") and np.ndim(values) <= int(width > 1):
            shape = (count, width) if width > 1 else (count,)
            values = wp.array(np.broadcast_to(np.asarray(values, np.float32), shape), dtype=wp.float32, device=device)
        return arrays.take(values, name, (count, width) if width > 1 else (count,), wp.float32, kind)

    columns = [column((0.0, 0.0, 1.0) if normal is None else normal, "normal", 3)]
    columns.append(column(base_color, "base_color", 3))
    columns.append(column(roughness, "roughness", 1))
    columns.append(column(metallic, "metallic", 1))
    columns.append(column(dielectric, "dielectric", 1))
    out, lanes = kind.empty((count, 3), wp.float32), dispatch.lanes(device)
    if count == 0:  # Warp does not flatten an empty array
        return kind.give(out)
    dispatch.launch(
        _make_kernel(lanes),
        dispatch.blocks(count, lanes),
        inputs=[i.flatten(), o.flatten(), *(c.flatten() for c in columns), count],
        outputs=[out.flatten()],
        device=device,
    )
    return kind.give(out)
