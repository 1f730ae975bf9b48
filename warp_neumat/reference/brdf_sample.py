"""The sampling proxy in float64: the twin of ``kernels/brdf_sample.py``, with libm's functions and textbook steps."""

import numpy as np


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def lobe_weights(weights, cosine) -> np.ndarray:
    """Return the interpolated rows of ``weights`` [nodes, 4] at cos θ_o, shape [n, 4]."""
    weights = np.asarray(weights, np.float64)
    last = len(weights) - 1
    x = np.sqrt(np.clip(1.0 - np.asarray(cosine, np.float64), 0.0, 1.0)) * last
    return np.stack([np.interp(x, np.arange(last + 1), column) for column in weights.T], axis=1)


def _bound(wo, alpha):
    a2 = alpha.min(axis=-1) ** 2
    s2 = (1.0 + np.hypot(wo[:, 0], wo[:, 1])) ** 2
    return (1.0 - a2) * s2 / (s2 + a2 * wo[:, 2] ** 2)


def ggx_lobe_pdf(wi, wo, alpha) -> np.ndarray:
    """Return the density of a bounded GGX reflection lobe, α [2], for unit pairs above the horizon, shape [n]."""
    h = _unit(wi + wo)
    stretched = np.concatenate([h[:, :2] / alpha, h[:, 2:]], axis=1)
    distribution = 1.0 / (np.pi * np.prod(alpha) * (stretched**2).sum(1) ** 2)
    length = np.linalg.norm(wo * [*alpha, 1.0], axis=1)
    return distribution / (2.0 * (_bound(wo, np.asarray(alpha)) * wo[:, 2] + length))


def proxy_pdf(alphas, weights, wi, wo) -> np.ndarray:
    """Return p(ω_i | ω_o) [1/sr], shape [n]; ``alphas`` [3, 2], ``weights`` [nodes, 4]; 0 below the horizon."""
    wi, wo = _unit(np.asarray(wi, np.float64)), _unit(np.asarray(wo, np.float64))
    w = lobe_weights(weights, wo[:, 2])
    above = (wi[:, 2] > 0) & (wo[:, 2] > 0)
    wi, wo = (np.where(above[:, None], v, [0.0, 0.0, 1.0]) for v in (wi, wo))
    p = w[:, 0] * wi[:, 2] / np.pi
    for j, alpha in enumerate(np.asarray(alphas, np.float64)):
        p = p + w[:, j + 1] * ggx_lobe_pdf(wi, wo, alpha)
    return np.where(above, p, 0.0)


def proxy_sample(alphas, weights, wo, u) -> tuple[np.ndarray, np.ndarray]:
    """Return (ω_i [n, 3], density [n]) for unit ω_o above the horizon and ``u`` [n, 3] in [0, 1)."""
    wo, u = _unit(np.asarray(wo, np.float64)), np.asarray(u, np.float64)
    edges = np.cumsum(lobe_weights(weights, wo[:, 2]), axis=1)
    lobe = (u[:, :1] >= edges[:, :-1]).sum(1)
    cosine = np.concatenate([_disk(np.sqrt(u[:, 1]), u[:, 2]), np.sqrt(1.0 - u[:, 1:2])], axis=1)
    alpha = np.asarray(alphas, np.float64)[np.maximum(lobe - 1, 0)]
    view = _unit(np.concatenate([wo[:, :2] * alpha, wo[:, 2:]], axis=1))
    bound = _bound(wo, alpha) * view[:, 2]
    z = (1.0 - u[:, 1]) * (1.0 + bound) - bound
    cap = np.concatenate([_disk(np.sqrt(np.maximum(1.0 - z * z, 0.0)), u[:, 2]), z[:, None]], axis=1)
    normal = cap + view
    normal = _unit(np.concatenate([normal[:, :2] * alpha, normal[:, 2:]], axis=1))
    mirrored = 2.0 * (wo * normal).sum(1, keepdims=True) * normal - wo
    wi = np.where(lobe[:, None] == 0, cosine, mirrored)
    return wi, proxy_pdf(alphas, weights, wi, wo)


def _disk(radius, turns):
    return np.stack([radius * np.cos(2 * np.pi * turns), radius * np.sin(2 * np.pi * turns)], axis=1)
