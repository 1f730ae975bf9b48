"""Which materials should share primitives: codes of their reflectance, and k-means over the codes (NeuBRDF Sec. 3.3).

The paper codes a material with a convolutional auto-encoder. Of a few dozen materials a deep one learns nothing that
the best linear one does not: its bottleneck is the leading principal components, in closed form, and that is used here.
"""

from __future__ import annotations

import numpy as np

from warp_neumat.training.losses import SHARPNESS
from warp_neumat.training.samplers import measured_directions

DIRECTIONS, CODE = 1024, 8


def signature(eval_fn) -> np.ndarray:
    """Return how a material looks from fixed directions: log(1 + s·f·cos θ_i), (n,) float32.

    Args:
        eval_fn: ``(wi, wo) -> (N, 3)``, value without the cosine in 1/sr.
    """
    wi, wo = measured_directions(DIRECTIONS, np.random.default_rng(0))
    value = np.log1p(SHARPNESS * np.maximum(np.asarray(eval_fn(wi, wo), np.float64), 0.0) * wi[:, 2:])
    return value.astype(np.float32).ravel()


def codes(signatures: np.ndarray, size: int = CODE) -> np.ndarray:
    """Return the code of each material, (m, ≤ size) float64: the bottleneck of the best linear auto-encoder."""
    centred = np.asarray(signatures, np.float64) - np.mean(signatures, axis=0, dtype=np.float64)
    left, scale, _ = np.linalg.svd(centred, full_matrices=False)
    return (left * scale)[:, :size]


def cluster(points: np.ndarray, count: int, *, seed: int = 0, restarts: int = 16) -> np.ndarray:
    """Return the cluster of every row of ``points``, (m,) int64, numbered by first appearance: k-means++ and Lloyd.

    No cluster is empty as long as there are ``count`` different rows.
    """
    count, best, found = min(count, len(points)), np.inf, np.zeros(len(points), np.int64)
    for restart in range(restarts):
        rng = np.random.default_rng([seed, restart])
        centres = [points[rng.integers(len(points))]]
        while len(centres) < count:
            far = np.min([((points - c) ** 2).sum(1) for c in centres], axis=0)
            chance = far / far.sum() if far.sum() > 0 else None
            centres.append(points[rng.choice(len(points), p=chance)])
        centres = np.array(centres)
        for _ in range(50):
            distance = ((points[:, None] - centres) ** 2).sum(2)
            member = distance.argmin(1)
            moved = np.array([points[member == c].mean(0) if (member == c).any() else centres[c] for c in range(count)])
            if np.array_equal(moved, centres):
                break
            centres = moved
        cost = float(((points - centres[member]) ** 2).sum())
        if cost < best:
            best, found = cost, member
    order = {c: n for n, c in enumerate(dict.fromkeys(found.tolist()))}
    return np.array([order[c] for c in found.tolist()], np.int64)


def groups(sources, count: int | None = None, *, seed: int = 0) -> list[list[int]]:
    """Return lists of numbers of ``sources`` that shall share primitives; isotropic ones stay among themselves.

    Args:
        sources: BRDF sources.
        count: Groups of each sort; default: one for about eight materials.
        seed: Decides the start of k-means.
    """
    result = []
    for isotropic in (True, False):
        chosen = [n for n, source in enumerate(sources) if bool(source.isotropic) == isotropic]
        if not chosen:
            continue
        wanted = count or max(1, round(len(chosen) / 8))
        member = cluster(codes(np.stack([signature(sources[n].eval) for n in chosen])), wanted, seed=seed)
        result += [[n for n, g in zip(chosen, member, strict=True) if g == group] for group in range(member.max() + 1)]
    return result
