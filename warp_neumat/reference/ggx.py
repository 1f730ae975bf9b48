"""The metallic-roughness BRDF of glTF 2.0 in float64: the twin of ``kernels/ggx.py``, by the textbook's formulas."""

import numpy as np

ALPHA_MIN = 1e-3
LEAST_COSINE = 0.01


def _unit(v):
    v = np.asarray(v, np.float64)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def ggx(wi, wo, base_color, roughness, metallic=0.0, *, dielectric=0.04, normal=(0.0, 0.0, 1.0)) -> np.ndarray:
    """Return BRDF × n·ω_i [1/sr], shape [n, 3]; arguments as ``kernels.ggx.ggx_eval``, numpy."""
    wi, wo = _unit(wi), _unit(wo)
    n = np.broadcast_to(_unit(normal), wi.shape)
    visible = (wi[:, 2] > 0) & (wo[:, 2] > 0)
    base = np.broadcast_to(np.asarray(base_color, np.float64), wi.shape)
    rough, metal, f = (
        np.broadcast_to(np.asarray(v, np.float64), len(wi))[:, None] for v in (roughness, metallic, dielectric)
    )
    z = (n * wo).sum(1, keepdims=True)
    along = wo - n * z
    raised = n * LEAST_COSINE + _unit(np.where(z < LEAST_COSINE, along, [1, 0, 0])) * np.sqrt(1 - LEAST_COSINE**2)
    wo = np.where(z < LEAST_COSINE, raised, wo)
    nl, nv = (n * wi).sum(1, keepdims=True), (n * wo).sum(1, keepdims=True)
    visible = visible[:, None] & (nl > 0)
    h = _unit(np.where(visible, wi + wo, n))
    nh, vh = (n * h).sum(1, keepdims=True), (wo * h).sum(1, keepdims=True)
    alpha = np.maximum(np.clip(rough, 0, 1) ** 2, ALPHA_MIN)
    d = alpha**2 / (np.pi * (nh**2 * (alpha**2 - 1) + 1) ** 2)

    def masked(a, b):
        return a * np.sqrt(alpha**2 + (1 - alpha**2) * b**2)

    with np.errstate(divide="ignore", invalid="ignore"):
        v = np.where(visible, 1 / (2 * (masked(nl, nv) + masked(nv, nl))), 0)
    w = (1 - vh) ** 5
    dielectric_brdf = base / np.pi * (1 - (f + (1 - f) * w)) + d * v * (f + (1 - f) * w)
    metal_brdf = d * v * (base + (1 - base) * w)
    return np.where(visible, (dielectric_brdf * (1 - metal) + metal_brdf * metal) * nl, 0)
