"""NTBC in plain torch: network, straight-through index and losses of any precision, differentiable (NTBC §3.2–3.4).

What the fused kernels are tested and timed against, and how a training step is written without them.
"""

import torch
import torch.nn.functional as F

from warp_neumat.kernels.ntbc_network import NetworkShape
from warp_neumat.kernels.ntbc_train import StepShape


def network(shape: NetworkShape, grids, net, places):
    """Return a network's outputs (n, outputs) at places (n, 2) in [0, 1), of flat grids and packed weights."""
    found = []
    for (width, height), at, words in zip(shape.levels, shape.grid_offsets, shape.grid_sizes, strict=True):
        grid = grids[at : at + words].view(height, width, shape.features)
        p = places * torch.tensor([width, height], dtype=places.dtype, device=places.device) - 0.5
        low = p.floor()
        fx, fy = ((p - low)[:, n : n + 1].to(grids.dtype) for n in range(2))
        (i0, j0), size = low.long().T, (width, height)
        i0, i1, j0, j1 = (n % size[axis] for n, axis in ((i0, 0), (i0 + 1, 0), (j0, 1), (j0 + 1, 1)))
        top = (1 - fx) * grid[j0, i0] + fx * grid[j0, i1]
        found.append((1 - fy) * top + fy * ((1 - fx) * grid[j1, i0] + fx * grid[j1, i1]))
    x = torch.cat(found, 1)
    for n, ((bias, at), out) in enumerate(zip(shape.offsets, (*shape.hidden, shape.outputs), strict=True)):
        wide = shape.rows[n + 1]
        matrix = net[at : at + shape.rows[n] * wide].view(-1, wide)[: x.shape[1], :out]
        x = F.linear(x, matrix.T, net[bias : bias + out])
        x = F.selu(x) if n < len(shape.hidden) else torch.sigmoid(x)
    return x


def places(rows: int, columns: int, blocks, texels: bool):
    """Return (u, v) of blocks (n,), or of their texels (16 n,), [., 2] float64."""
    by, bx = blocks.long() // columns, blocks.long() % columns
    size = torch.tensor([columns, rows], dtype=torch.float64, device=blocks.device)
    if not texels:
        return (torch.stack([bx, by], 1) + 0.5) / size
    t = torch.arange(16, device=blocks.device)
    x, y = 4 * bx[:, None] + t % 4, 4 * by[:, None] + t // 4
    return ((torch.stack([x, y], 2) + 0.5) / (4 * size)).view(-1, 2)


class Expected(torch.autograd.Function):
    """The weight w_n of the largest of d (..., N); backward as if it were the mean under softmax(d/T) (NTBC Eq. 30)."""

    @staticmethod
    def forward(ctx, d, temperature):
        w = torch.arange(d.shape[-1], dtype=d.dtype, device=d.device) / (d.shape[-1] - 1)
        ctx.save_for_backward(d, w)
        ctx.temperature = temperature
        return w[d.argmax(-1)]

    @staticmethod
    def backward(ctx, gradient):
        d, w = ctx.saved_tensors
        share = torch.softmax(d / ctx.temperature, -1)
        mean = (share * w).sum(-1, keepdim=True)
        return gradient[..., None] * share * (w - mean) / ctx.temperature, None


def squared(delta, metric):
    """Return δᵀGδ of (..., K)."""
    k = delta.shape[-1]
    return torch.einsum("...i,ij,...j->...", delta, metric[:k, :k].to(delta.dtype), delta)


def index_weight(x, e0, e1, entries, metric, temperature):
    """Return the weight of the palette entry nearest to x (B, 16, K), [B, 16, 1] (NTBC Eq. 9, 10)."""
    w = torch.arange(entries, dtype=x.dtype, device=x.device) / (entries - 1)
    palette = (1 - w[:, None]) * e0[:, None, None] + w[:, None] * e1[:, None, None]
    d = -torch.sqrt(squared(x[:, :, None] - palette, metric) + 1e-12)
    return Expected.apply(d, temperature)[..., None]


def losses(shape: StepShape, said, x, ends, colours, metric, temperature=0.01, quantised=False):
    """Return the five mean losses of :data:`warp_neumat.kernels.ntbc_train.LOSSES` (NTBC Eq. 11, 12).

    Args:
        shape: Planes, and whether the variant is the naive one.
        said: The endpoint network's outputs, (B, 2C).
        x: The texel network's, (16 B, C), or (16 B, planes) of the naive variant.
        ends: Reference endpoints, (B, 2C).
        colours: Reference colours, (B, C, 16).
        metric: G of each plane, (planes, 4, 4).
        temperature: T of the softmax.
        quantised: Round the naive variant's weights, which then have no gradient.
    """
    count, c = said.shape[0], shape.channels
    sums, at = [said.new_zeros(()) for _ in range(5)], 0
    x = x.view(count, 16, -1)
    for plane, (entries, k) in enumerate(shape.planes):
        g = metric[plane]
        s0, s1 = said[:, 2 * at : 2 * at + k], said[:, 2 * at + k : 2 * at + 2 * k]
        e0, e1 = ends[:, 2 * at : 2 * at + k], ends[:, 2 * at + k : 2 * at + 2 * k]
        target = colours[:, at : at + k].transpose(1, 2)

        def decoded(w, a, b):
            return (1 - w) * a[:, None] + w * b[:, None]

        def pick(points, a, b):
            return index_weight(points, a, b, entries, g, temperature)  # noqa: B023

        sums[0] = sums[0] + squared(s0 - e0, g).sum() + squared(s1 - e1, g).sum()
        if shape.naive:
            w = x[:, :, plane : plane + 1]
            if quantised:
                w = (w.detach() * (entries - 1)).round() / (entries - 1)
            sums[4] = sums[4] + squared(decoded(w, s0, s1) - target, g).sum()
        else:
            mine = x[:, :, at : at + k]
            sums[1] = sums[1] + squared(decoded(pick(target, s0, s1), e0, e1) - target, g).sum()
            sums[2] = sums[2] + squared(mine - target, g).sum()
            sums[3] = sums[3] + squared(decoded(pick(mine, e0, e1), e0, e1) - target, g).sum()
            joint = decoded(pick(mine, s0.detach(), s1.detach()), s0, s1)
            sums[4] = sums[4] + squared(joint - target, g).sum()
        at += k
    terms = [2 * c * count] + [16 * c * count] * 4
    return torch.stack([s / n for s, n in zip(sums, terms, strict=True)])
