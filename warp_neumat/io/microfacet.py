"""GGX reflection and Fresnel terms in NumPy, float32 in and out: what the analytic sources are made of.

GGX: Walter et al., "Microfacet Models for Refraction through Rough Surfaces", 2007; height-correlated shadowing: Heitz,
"Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", 2014, Eq. 99. Fresnel: Born & Wolf,
"Principles of Optics", Sec. 1.5 and 14.2 (unpolarised); Schlick 1994.
"""

from __future__ import annotations

import numpy as np


def half_vector(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """Return the unit half vector, (N, 3); the normal where |ω_i + ω_o| < 1e-6, opposite along the surface."""
    half = wi + wo
    length = np.sqrt((half * half).sum(1, keepdims=True))
    opposite = length[:, 0] < 1e-6
    half /= np.maximum(length, 1e-6)
    half[opposite] = (0.0, 0.0, 1.0)
    return half


def ggx(wi, wo, half, alpha_x: float, alpha_y: float) -> np.ndarray:
    """Return D·V = D·G₂/(4 cosθ_i cosθ_o) of anisotropic GGX, (N, 1)."""
    ax, ay = np.float32(alpha_x), np.float32(alpha_y)
    hx, hy, hz = half.T
    # |h/alpha|² = 1 + (tan² terms) written without 1 − z², which would cancel near the pole.
    stretch = (hx / ax) ** 2 + (hy / ay) ** 2 + hz * hz
    distribution = 1.0 / (np.float32(np.pi) * ax * ay * stretch * stretch)
    zi, zo = np.maximum(wi[:, 2], 1e-7), np.maximum(wo[:, 2], 1e-7)
    si = zo * np.sqrt((ax * wi[:, 0]) ** 2 + (ay * wi[:, 1]) ** 2 + zi * zi)
    so = zi * np.sqrt((ax * wo[:, 0]) ** 2 + (ay * wo[:, 1]) ** 2 + zo * zo)
    return (0.5 * distribution / (si + so))[:, None]


def schlick(cosine: np.ndarray, f0) -> np.ndarray:
    """Return f0 + (1 − f0)(1 − cos)⁵: cosine (N, 1), ``f0`` a number or RGB."""
    weak = 1.0 - np.clip(cosine, 0.0, 1.0)
    square = weak * weak
    f0 = np.float32(f0)
    return f0 + (1.0 - f0) * (square * square * weak)


def dielectric(cosine: np.ndarray, ior: float) -> np.ndarray:
    """Return the reflectance of a smooth dielectric seen from outside: cosine (N, 1), relative index ``ior`` ≥ 1."""
    c = np.clip(cosine, 0.0, 1.0)
    g = np.sqrt(np.float32(ior * ior - 1.0) + c * c)  # ior · cosθ of the refracted ray
    perpendicular = (c - g) / np.maximum(c + g, np.float32(1e-30))
    eta2 = np.float32(ior * ior)
    parallel = (eta2 * c - g) / np.maximum(eta2 * c + g, np.float32(1e-30))
    return 0.5 * (perpendicular * perpendicular + parallel * parallel)


def conductor(cosine: np.ndarray, eta, k) -> np.ndarray:
    """Return the reflectance of a smooth conductor of index ``eta`` + i·``k`` (each RGB or one): cosine (N, 1)."""
    eta, k = np.float32(eta), np.float32(k)
    c = np.clip(cosine, 0.0, 1.0)
    c2 = c * c
    s2 = 1.0 - c2
    real = eta * eta - k * k - s2
    modulus = np.sqrt(real * real + 4.0 * eta * eta * k * k)  # |(a + ib)²| with a + ib = sqrt((eta + ik)² − sin²)
    a = np.sqrt(np.maximum(0.5 * (modulus + real), 0.0))
    perpendicular = (modulus + c2 - 2.0 * a * c) / (modulus + c2 + 2.0 * a * c)
    parallel = perpendicular * (
        (modulus * c2 + s2 * s2 - 2.0 * a * c * s2) / (modulus * c2 + s2 * s2 + 2.0 * a * c * s2)
    )
    return 0.5 * (perpendicular + parallel)
