"""Lafortune lobes in float64 with their analytic Jacobian: the twin of ``kernels/lafortune.py`` (MobileVR Eq. 6, 7).

Parameters of a texel: ρ_d (3), then for each lobe ρ (3), M (9, row-major) and n. Order of the Jacobian's unknowns:
colours [channel][diffuse, lobes], then for each lobe M (9) and ln n.
"""

import numpy as np

SMALLEST, FLATTEST = 1e-12, 1e-3


def factors(wi, cosine: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the factors (g_d, g_s) of N pairs: 1, or cosθ_i where ``cosine`` names the term."""
    one = np.ones(len(wi))
    return (one if cosine == "none" else wi[:, 2]), (wi[:, 2] if cosine == "all" else one)


def lobe_values(parameters, wi, wo) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (colours (k, 3), bases (N, k), powers (N, k)) of one texel's lobes; a base below 0 has the power 0."""
    lobes = np.asarray(parameters, np.float64)[3:].reshape(-1, 13)
    base = np.einsum("na,jab,nb->nj", wo, lobes[:, 3:12].reshape(-1, 3, 3), wi)
    lit = base > SMALLEST
    return lobes[:, :3], base, np.where(lit, np.where(lit, base, 1.0) ** lobes[:, 12], 0.0)


def value(parameters, wi, wo, cosine: str) -> np.ndarray:
    """Return ρ_d g_d + g_s Σ_j ρ_j (ω_oᵀ M_j ω_i)^n_j of one texel for directions (N, 3), shape (N, 3)."""
    wi, wo = np.asarray(wi, np.float64), np.asarray(wo, np.float64)
    diffuse, specular = factors(wi, cosine)
    colours, _, power = lobe_values(parameters, wi, wo)
    return np.asarray(parameters, np.float64)[:3] * diffuse[:, None] + specular[:, None] * (power @ colours)


def jacobian(parameters, wi, wo, cosine: str) -> np.ndarray:
    """Return ∂value/∂unknowns of one texel, shape (N, 3, 15 + 10 k); the slope at a base below 1e-3 is held back."""
    wi, wo = np.asarray(wi, np.float64), np.asarray(wo, np.float64)
    diffuse, specular = factors(wi, cosine)
    colours, base, power = lobe_values(parameters, wi, wo)
    power = power * specular[:, None]
    exponents = np.asarray(parameters, np.float64)[3:].reshape(-1, 13)[:, 12]
    count = len(colours)
    found = np.zeros((len(wi), 3, 3 * (count + 1) + 10 * count))
    outer = (wo[:, :, None] * wi[:, None, :]).reshape(-1, 9)
    slope = exponents * power / np.maximum(base, FLATTEST)
    bend = exponents * power * np.log(np.where(base > SMALLEST, base, 1.0))
    for c in range(3):
        first = c * (count + 1)
        found[:, c, first] = diffuse
        found[:, c, first + 1 : first + 1 + count] = power
        for j in range(count):
            at = 3 * (count + 1) + 10 * j
            found[:, c, at : at + 9] = colours[j, c] * slope[:, j, None] * outer
            found[:, c, at + 9] = colours[j, c] * bend[:, j]
    return found


def normal_equations(parameters, wi, wo, data, cosine: str, softness: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return (JᵀWJ, JᵀWr) of one texel with ``data`` (N, 3); W = 1, or 1/√(|r|² + ε²) of a ``softness`` ε."""
    rest = np.asarray(data, np.float64) - value(parameters, wi, wo, cosine)
    slopes = jacobian(parameters, wi, wo, cosine)
    weight = 1.0 / np.sqrt((rest**2).sum(1) + softness**2) if softness > 0 else np.ones(len(rest))
    rows = slopes.reshape(-1, slopes.shape[-1])
    weighted = (weight[:, None, None] * slopes).reshape(rows.shape)
    return weighted.T @ rows, weighted.T @ rest.ravel()
