"""Vector quantisation under a metric of its own at every point: which primitive changes the picture least.

Plain k-means treats all feature coordinates alike, though the decoder is deaf to some and alert to others, differently
in each direction. With H_p = Σ w² JᵀJ, the Gauss-Newton matrix of the loss at grid point p (w the corner weight of a
sample, J the decoder's derivative), replacing F_p alone by c costs about (c − F_p)ᵀ H_p (c − F_p). Assignment and
update are closed forms: c = (Σ H_p)⁻¹ Σ H_p F_p over the points of a cell.
"""

from __future__ import annotations

import torch


def assign(features, metric, codebook):
    """Return the cheapest codeword of every point, (n,) int64, and its cost, (n,).

    Args:
        features: F, (n, k).
        metric: H, (n, k, k), symmetric positive semi-definite.
        codebook: c, (m, k).
    """
    centre = features.mean(0)  # differences of squares cancel less around the origin
    features, codebook = features - centre, codebook - centre
    moved = torch.einsum("nij,nj->ni", metric, features)
    outer = (codebook[:, :, None] * codebook[:, None, :]).flatten(1)
    cost = metric.flatten(1) @ outer.T - 2.0 * moved @ codebook.T
    best, index = cost.min(1)
    return index, (best + (moved * features).sum(1)).clamp_min(0.0)


def update(features, metric, index, codebook):
    """Return the codebook that minimises the cost for a fixed assignment; codewords without points stay."""
    count, k = codebook.shape
    total = torch.zeros(count, k * k).index_add_(0, index, metric.flatten(1)).view(count, k, k)
    moved = torch.zeros(count, k).index_add_(0, index, torch.einsum("nij,nj->ni", metric, features))
    size = total.diagonal(dim1=1, dim2=2).mean(1)
    used = size > 0
    ridge = (1e-6 * size[used])[:, None, None] * torch.eye(k)
    result = codebook.clone()
    result[used] = torch.linalg.solve(total[used] + ridge, moved[used])
    return result


def _seed(features, metric, count, generator):
    """k-means++ under the metric: each new codeword is a point drawn in proportion to its present cost."""
    weight = metric.diagonal(dim1=1, dim2=2).sum(1)
    chosen = [int(torch.multinomial(weight, 1, generator=generator))]
    cost = torch.full((len(features),), torch.inf)
    for _ in range(count - 1):
        step = features - features[chosen[-1]]
        cost = torch.minimum(cost, torch.einsum("ni,nij,nj->n", step, metric, step).clamp_min(0.0))
        total = float(cost.sum())
        chosen.append(int(torch.multinomial(cost if total > 0 else weight, 1, generator=generator)))
    return features[torch.tensor(chosen)].clone()


def fit(features, metric, count, generator, iterations=25):
    """Return (codebook (count, k), index (n,) int64) by k-means under ``metric``.

    Points whose metric is zero are never looked at by any sample; they take part in nothing and get index 0. A codeword
    that loses all its points is moved to the point that costs most.
    """
    weight = metric.diagonal(dim1=1, dim2=2).sum(1)
    live = torch.nonzero(weight > 0).flatten()
    points, local = features[live], metric[live]
    local = local + (1e-3 * weight[live] / features.shape[1])[:, None, None] * torch.eye(features.shape[1])
    codebook = _seed(points, local, count, generator)
    for _ in range(iterations):
        index, cost = assign(points, local, codebook)
        dead = torch.nonzero(torch.bincount(index, minlength=count) == 0).flatten()
        if len(dead):
            worst = cost.topk(min(len(dead), len(cost))).indices
            index[worst] = dead[: len(worst)]
        codebook = update(points, local, index, codebook)
    result = torch.zeros(len(features), dtype=torch.int64)
    result[live] = assign(points, local, codebook)[0]
    return codebook, result
