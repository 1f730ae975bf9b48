"""A diffuse term and one GGX lobe in float64: the twin of ``kernels/proxy.py``, by the textbook's formulas."""

import numpy as np


def proxy(params, normal, light, viewer) -> np.ndarray:
    """Return luminance × n·l [1/sr], shape [n]; arguments as ``kernels.proxy.proxy_eval``, unit vectors, numpy."""
    light, viewer = np.asarray(light, np.float64), np.asarray(viewer, np.float64)
    n = np.broadcast_to(np.asarray(normal, np.float64), light.shape)
    diffuse, specular, alpha2 = np.broadcast_to(np.asarray(params, np.float64), light.shape).T
    nl, nv = (n * light).sum(1), (n * viewer).sum(1)
    visible = (nl > 0) & (nv > 0)
    h = np.where(visible[:, None], light + viewer, n)
    h = h / np.linalg.norm(h, axis=1, keepdims=True)
    # Of n × h, whose length is sin θ_h: float32 vectors are unit to 1e-7 only, and a sharp lobe's 1 − (n·h)² feels it.
    sine2 = (np.cross(n, h) ** 2).sum(1)

    def g1_lambda(cosine):
        c2 = np.where(visible, cosine, 1.0) ** 2
        return (np.sqrt(1 + alpha2 * (1 - c2) / c2) - 1) / 2

    with np.errstate(divide="ignore", invalid="ignore"):
        d = alpha2 / (np.pi * (1 - (1 - alpha2) * (1 - sine2)) ** 2)
        # Smith, height-correlated, over 4 (n·l)(n·v); the cosine n·l is multiplied in below.
        v = 1 / ((1 + g1_lambda(nl) + g1_lambda(nv)) * 4 * np.where(visible, nl * nv, 1.0))
    w = (1 - np.clip((viewer * h).sum(1), 0, 1)) ** 5
    size = np.abs(specular)
    fresnel = np.where(specular < 0, size + np.maximum(1 - size, 0) * w, size)
    return np.where(visible, (diffuse / np.pi + fresnel * np.where(alpha2 > 0, d * v, 0.0)) * nl, 0.0)
