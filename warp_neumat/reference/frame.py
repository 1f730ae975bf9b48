"""Tangent frames and half vectors in float64: the twin of ``kernels/frame.py``."""

import numpy as np


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def half_vectors(wi, wo) -> np.ndarray:
    """Return unit vectors half-way between ``wi`` and ``wo``, shape [n, 3]; not defined for opposite pairs."""
    return _unit(np.asarray(wi, np.float64) + np.asarray(wo, np.float64))


def tangent_frames(normals, tangents) -> np.ndarray:
    """Return frames (rows tangent, bitangent, normal), shape [n, 3, 3]; the two inputs must not be parallel."""
    n = _unit(np.asarray(normals, np.float64))
    t = np.asarray(tangents, np.float64)
    x = _unit(t[:, :3] - n * np.sum(n * t[:, :3], axis=1, keepdims=True))
    return np.stack([x, np.cross(n, x) * t[:, 3:], n], axis=1)
