"""A white furnace: the directional albedo of a BRDF source by quadrature with multiple importance sampling."""

import numpy as np

_COUNT = 2584  # a Fibonacci number, and so is the generator below: the lattice is even in both coordinates
_U = (np.arange(_COUNT) + 0.5) / _COUNT
_V = np.arange(_COUNT) * 1597 / _COUNT % 1.0


def _around(o, alpha):
    """Mirror o about half vectors drawn from GGX's D·cosθ_h."""
    z = np.sqrt((1 - _U) / (1 + (alpha**2 - 1) * _U))
    sine = np.sqrt(1 - z * z)
    half = np.stack([sine * np.cos(2 * np.pi * _V), sine * np.sin(2 * np.pi * _V), z], 1)
    return 2 * (half @ o)[:, None] * half - o


def _density(w, o, alpha):
    half = w + o
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    stretch = (half[:, 0] ** 2 + half[:, 1] ** 2) / alpha**2 + half[:, 2] ** 2
    return half[:, 2] / (np.pi * alpha**2 * stretch**2) / np.maximum(4 * (half @ o), 1e-9)


def albedo(source, degrees, alpha, inner=None, ior=1.0):
    """Return ∫ f cosθ_i dω_i of an isotropic source for a viewer at an angle, (3,).

    Samples are cosine-weighted, around the mirror direction for a lobe of width ``alpha``, and, with ``inner``, the
    same below an interface of index ``ior``; weighted by the balance heuristic. Error about 1e-3.
    """
    o = np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))])
    root = np.sqrt(_U)
    flat = np.stack([root * np.cos(2 * np.pi * _V), root * np.sin(2 * np.pi * _V), np.sqrt(1 - _U)], 1)
    parts = [flat, _around(o, alpha)]

    def into(w):
        w = w / ior
        w[:, 2] = np.sqrt(np.maximum(1 - w[:, 0] ** 2 - w[:, 1] ** 2, 0))
        return w

    if inner:
        below = into(o[None])[0]
        i = _around(below, inner)
        sine2 = ior**2 * (i[:, 0] ** 2 + i[:, 1] ** 2)
        leaves = (i[:, 2] > 0) & (sine2 < 1)
        parts.append(np.c_[ior * i[:, :2], np.sqrt(np.maximum(1 - sine2, 0))][leaves])
    w = np.concatenate(parts)
    w = w[w[:, 2] > 1e-6]
    density = w[:, 2] / np.pi + _density(w, o, alpha)
    if inner:
        i = into(w)
        density = density + _density(i, below, inner) * w[:, 2] / (ior**2 * i[:, 2])
    value = source.eval(w, np.broadcast_to(o, w.shape)).astype(np.float64)
    return (value * (w[:, 2] / density)[:, None]).sum(0) / _COUNT
