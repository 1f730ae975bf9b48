"""NTBC in float64: network, losses and the choice of indices, the twin of ``kernels/ntbc_train.py`` and ``ntbc.py``.

Layouts (flat grids, packed weights, planes, positions) are those of the kernels; see ``kernels/ntbc_network.py``.
"""

import numpy as np

SELU_SCALE, SELU_ALPHA = 1.0507009873554805, 1.6732632423543772


def positions(rows: int, columns: int, texels: bool) -> np.ndarray:
    """Return (u, v) of all blocks, row by row, or of their texels, 16 a block in order 4y + x."""
    by, bx = np.divmod(np.arange(rows * columns), columns)
    if not texels:
        return np.stack([(bx + 0.5) / columns, (by + 0.5) / rows], 1)
    y, x = np.divmod(np.arange(16), 4)
    u, v = (4 * bx[:, None] + x + 0.5) / (4 * columns), (4 * by[:, None] + y + 0.5) / (4 * rows)
    return np.stack([u, v], 2).reshape(-1, 2)


def look_up(grid, place) -> np.ndarray:
    """Return a grid (height, width, features) at (u, v) of (n, 2), bilinear, wrapping around."""
    height, width = grid.shape[:2]
    p = place * [width, height] - 0.5
    low = np.floor(p)
    fx, fy = (p - low).T[:, :, None]
    i, j = low.astype(int).T
    rows = [(1 - fx) * grid[n % height, i % width] + fx * grid[n % height, (i + 1) % width] for n in (j, j + 1)]
    return (1 - fy) * rows[0] + fy * rows[1]


def network(grids, layers, place) -> np.ndarray:
    """Return the outputs (n, outputs) of a network at (u, v) of (n, 2) (NTBC §3.4).

    Args:
        grids: One (height, width, features) per level, coarsest first.
        layers: (weights [out, in], biases [out]) of every layer, the output last.
        place: Positions.
    """
    h = np.concatenate([look_up(np.asarray(grid, np.float64), place) for grid in grids], 1)
    for n, (weights, bias) in enumerate(layers):
        h = h @ np.asarray(weights, np.float64).T + np.asarray(bias, np.float64)
        if n < len(layers) - 1:
            h = SELU_SCALE * np.where(h > 0, h, SELU_ALPHA * np.expm1(np.minimum(h, 0)))
    return 1 / (1 + np.exp(-h))


def unpack(shape, grids, net):
    """Return (grids, layers) for :func:`network` out of a ``NetworkShape``'s flat arrays."""
    grids, net = np.asarray(grids, np.float64), np.asarray(net, np.float64)
    levels = [
        grids[at : at + width * height * shape.features].reshape(height, width, shape.features)
        for (width, height), at in zip(shape.levels, shape.grid_offsets, strict=True)
    ]
    layers, widths = [], (shape.inputs, *shape.hidden, shape.outputs)
    for n, (bias, at) in enumerate(shape.offsets):
        matrix = net[at : at + shape.rows[n] * shape.rows[n + 1]].reshape(shape.rows[n], shape.rows[n + 1])
        layers.append((matrix[: widths[n], : widths[n + 1]].T, net[bias : bias + widths[n + 1]]))
    return levels, layers


def squared(delta, metric) -> np.ndarray:
    """Return δᵀGδ of (…, K) with the upper left K × K of ``metric``."""
    k = delta.shape[-1]
    return np.einsum("...i,ij,...j->...", delta, np.asarray(metric, np.float64)[:k, :k], delta)


def distances(x, e0, e1, entries: int, metric) -> np.ndarray:
    """Return d_n (blocks, 16, N), the negative distances of colours x (blocks, 16, K) to the palettes (NTBC Eq. 9)."""
    w = np.arange(entries) / (entries - 1)
    palette = (1 - w[:, None]) * e0[:, None] + w[:, None] * e1[:, None]
    return -np.sqrt(squared(x[:, :, None] - palette[:, None], metric) + 1e-12)


def nearest_weight(x, e0, e1, entries: int, metric) -> np.ndarray:
    """Return the weight (blocks, 16) of the palette entry nearest to each colour (NTBC Eq. 10, 14)."""
    return distances(x, e0, e1, entries, metric).argmax(-1) / (entries - 1)


def decode(weight, e0, e1) -> np.ndarray:
    """Return the colours (blocks, 16, K) of weights (blocks, 16) between endpoints (blocks, K) (NTBC Eq. 7)."""
    return (1 - weight[..., None]) * e0[:, None] + weight[..., None] * e1[:, None]


def expected_weight(d, temperature: float) -> np.ndarray:
    """Return ŵ (…), the expectation of the weights n / (N − 1) under softmax(d / T) of (…, N) (NTBC Eq. 13, 15)."""
    p = np.exp((d - d.max(-1, keepdims=True)) / temperature)
    return (p * np.arange(d.shape[-1]) / (d.shape[-1] - 1)).sum(-1) / p.sum(-1)


def expected_weight_slope(d, temperature: float) -> np.ndarray:
    """Return ∂ŵ/∂d_n = σ_n (w_n − ŵ) / T, (…, N) (NTBC Eq. 30, where n stands for the weight w_n)."""
    p = np.exp((d - d.max(-1, keepdims=True)) / temperature)
    w = np.arange(d.shape[-1]) / (d.shape[-1] - 1)
    return p / p.sum(-1, keepdims=True) * (w - expected_weight(d, temperature)[..., None]) / temperature


def losses(planes, said, x, ends, colours, metric, *, naive: bool = False, quantised: bool = False) -> np.ndarray:
    """Return the five mean losses of a batch, in the order of ``kernels/ntbc_train.py`` (NTBC Eq. 11, 12).

    Args:
        planes: (entries, channels) of every plane.
        said: Predicted endpoints, (blocks, 2C).
        x: Predicted colours (blocks, C, 16), or weights (blocks, planes, 16) in the naive variant.
        ends: Reference endpoints, (blocks, 2C).
        colours: Reference colours, (blocks, C, 16).
        metric: (planes, 4, 4).
        naive: Whether x are weights; then only the first and last loss are not 0.
        quantised: Whether these are rounded to palette entries.
    """
    said, x, ends, colours = (np.asarray(a, np.float64) for a in (said, x, ends, colours))
    count, channels = colours.shape[:2]
    sums, at = np.zeros(5), 0
    for plane, (entries, k) in enumerate(planes):
        g = metric[plane]
        (s0, s1), (e0, e1) = (np.split(a[:, 2 * at : 2 * at + 2 * k], 2, axis=1) for a in (said, ends))
        target = colours[:, at : at + k].swapaxes(1, 2)
        sums[0] += squared(s0 - e0, g).sum() + squared(s1 - e1, g).sum()
        if naive:
            w = x[:, plane]
            if quantised:
                w = np.ceil(w * (entries - 1) - 0.5) / (entries - 1)
            sums[4] += squared(decode(w, s0, s1) - target, g).sum()
        else:
            mine = x[:, at : at + k].swapaxes(1, 2)
            sums[1] += squared(decode(nearest_weight(target, s0, s1, entries, g), e0, e1) - target, g).sum()
            sums[2] += squared(mine - target, g).sum()
            sums[3] += squared(decode(nearest_weight(mine, e0, e1, entries, g), e0, e1) - target, g).sum()
            sums[4] += squared(decode(nearest_weight(mine, s0, s1, entries, g), s0, s1) - target, g).sum()
        at += k
    return sums / (count * channels * np.array([2, 16, 16, 16, 16]))
