"""NTBC in plain torch, as its users would write it: both networks, the writing of blocks, and a training step.

Grids are looked up by ``grid_sample`` in copies with a border that wraps around, or by ``embedding_bag`` of the four
vertices; what does not change from batch to batch is made beforehand, and planes alike in format go together.
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional as F

SPELLINGS = ("grid_sample", "embedding_bag")
"""Ways to look grids up."""

BATCH = 1 << 16
"""Rows that go through a network at once."""


def places(rows: int, columns: int, blocks: torch.Tensor, texels: bool) -> torch.Tensor:
    """Return (u, v) of blocks by number, or of their texels, 16 a block: (n, 2) float64."""
    at = torch.stack([blocks.long() % columns, blocks.long() // columns], 1)
    size = torch.tensor([columns, rows], dtype=torch.float64)
    if not texels:
        return (at + 0.5) / size
    inner = torch.stack([torch.arange(16) % 4, torch.arange(16) // 4], 1)
    return ((4 * at[:, None] + inner + 0.5) / (4 * size)).view(-1, 2)


class Network(nn.Module):
    """Grids and layers of a ``NetworkShape``, with the values of flat ``grid`` and packed ``net``.

    Args:
        shape: Sizes.
        grid, net: As the kernels take them.
        spelling: One of :data:`SPELLINGS`.
        dtype: Of layers and inputs; grids are looked up in it where torch can: its ``grid_sample`` cannot in float16.
    """

    def __init__(self, shape, grid, net, spelling: str, dtype=torch.float32):
        from warp_neumat.models.ntbc import layers, level_views

        super().__init__()
        self.shape, self.spelling, self.dtype = shape, spelling, dtype
        bag = spelling == "embedding_bag"
        look_up = torch.float32 if dtype == torch.float16 and not bag else dtype

        def level(values):
            h, w, features = values.shape
            values = values.reshape(h * w, features) if bag else values.permute(2, 0, 1)[None]
            return nn.Parameter(values.to(look_up, copy=True).contiguous())

        self.levels = nn.ParameterList(level(values) for values in level_views(shape, grid))
        self.weights = nn.ParameterList()
        for values in (value for layer in layers(shape, net) for value in layer):
            self.weights.append(nn.Parameter(values.to(dtype, copy=True).contiguous()))

    def taps(self, uv: torch.Tensor) -> list:
        """Return what :meth:`forward` looks up at ``uv`` (n, 2) float64, level by level."""
        found = []
        for (width, height), level in zip(self.shape.levels, self.levels, strict=True):
            size = torch.tensor([width, height], dtype=uv.dtype)
            if self.spelling == "grid_sample":  # a border of one: texel 0 lies at 1.5 of size + 2
                found.append((((uv * size + 1) / (size + 2)) * 2 - 1).to(level.dtype)[None, :, None])
                continue
            at = uv * size - 0.5
            low = at.floor()
            (fx, fy), (x0, y0) = (at - low).T, low.long().T
            x0, y0, x1, y1 = x0 % width, y0 % height, (x0 + 1) % width, (y0 + 1) % height
            rows = torch.stack([y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1], 1)
            weights = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], 1)
            found.append((rows, weights.to(level.dtype)))
        return found

    def padded(self) -> list:
        """Return the levels as they are looked up."""
        if self.spelling == "embedding_bag":
            return list(self.levels)
        return [F.pad(level, (1, 1, 1, 1), mode="circular") for level in self.levels]

    def forward(self, taps: list, levels: list | None = None) -> torch.Tensor:
        """Return the outputs (n, outputs) at ``taps``; ``levels`` are :meth:`padded`, made here by default."""
        levels = self.padded() if levels is None else levels
        if self.spelling == "embedding_bag":
            pairs = zip(levels, taps, strict=True)
            parts = [F.embedding_bag(r, level, mode="sum", per_sample_weights=w) for level, (r, w) in pairs]
        else:
            sampled = [F.grid_sample(level, at, align_corners=False) for level, at in zip(levels, taps, strict=True)]
            parts = [part[0, :, :, 0].T for part in sampled]
        x = torch.cat(parts, 1).to(self.dtype)
        grad = torch.is_grad_enabled()
        for weight, bias in zip(self.weights[:-2:2], self.weights[1:-2:2], strict=True):
            x = F.selu(F.linear(x, weight, bias), inplace=not grad)
        return torch.sigmoid(F.linear(x, *self.weights[-2:]))


class Inference:
    """All blocks of one model: networks alone, or with the writing of BC1 and BC4.

    Args:
        pair: A ``models.ntbc.Pair``, as trained.
        planes: (format, components) of its planes, bc1 and bc4.
        rows, columns: Blocks of the texture.
        spelling, dtype: As for :class:`Network`.
    """

    def __init__(self, pair, planes, rows: int, columns: int, spelling: str, dtype):
        self.planes, self.count = planes, rows * columns
        shapes = pair.shape.endpoint, pair.shape.texel
        values = (pair.endpoint_grid, pair.endpoint_net), (pair.texel_grid, pair.texel_net)
        self.networks = [Network(s, *v, spelling, dtype).eval() for s, v in zip(shapes, values, strict=True)]
        self.batches, per = [], BATCH // 16
        with torch.no_grad():
            self.levels = [network.padded() for network in self.networks]
            for first in range(0, self.count, per):
                blocks = torch.arange(first, min(first + per, self.count))
                at = [places(rows, columns, blocks, texels) for texels in (False, True)]
                self.batches.append([n.taps(uv) for n, uv in zip(self.networks, at, strict=True)])

    @torch.no_grad()
    def run(self, write: bool) -> list[torch.Tensor]:
        """Return the blocks of every plane, (blocks, 8) uint8; nothing if ``write`` is false."""
        found: list[list] = [[] for _ in self.planes]
        for taps in self.batches:
            ends, texels = (n(t, levels) for n, t, levels in zip(self.networks, taps, self.levels, strict=True))
            if write:
                for own, blocks in zip(found, write_blocks(self.planes, ends.float(), texels.float()), strict=True):
                    own.append(blocks)
        return [torch.cat(own) for own in found] if write else []


# --- writing ----------------------------------------------------------------------------------------------------------


def write_blocks(planes, ends: torch.Tensor, texels: torch.Tensor) -> list[torch.Tensor]:
    """Return blocks of each plane, (B, 8) uint8, for endpoints (B, 2C) and colours (16 B, C) in [0, 1]."""
    count, at, found, members = len(ends), 0, {}, {"bc1": [], "bc4": []}
    texels = texels.view(count, 16, -1)
    for number, (format, k) in enumerate(planes):
        members[format].append((number, ends[:, 2 * at : 2 * at + 2 * k], texels[..., at : at + k]))
        at += k
    for format, write in (("bc1", write_bc1), ("bc4", write_bc4)):
        if members[format]:
            numbers, e, x = zip(*members[format], strict=True)
            blocks = write(torch.stack(e, 1).flatten(0, 1), torch.stack(x, 1).flatten(0, 1))
            found |= dict(zip(numbers, blocks.view(count, -1, 8).unbind(1), strict=True))
    return [found[number] for number in range(len(planes))]


def write_bc1(ends: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Return BC1 blocks of four colours, (N, 8) uint8, for endpoints (N, 6) and colours (N, 16, 3)."""
    most = torch.tensor([31.0, 63.0, 31.0])
    code = (ends.reshape(-1, 2, 3) * most + 0.5).long()
    word = code[..., 0] << 11 | code[..., 1] << 5 | code[..., 2]
    high, low = word.max(1).values, word.min(1).values
    equal, odd = high == low, (low & 31) > 0
    high, low = high + (equal & ~odd).long(), low - (equal & odd).long()
    first, last = (torch.stack([w >> 11, w >> 5 & 63, w & 31], 1) / most for w in (high, low))
    step = (last - first) / 3
    along = torch.bmm(x - first[:, None], step[:, :, None])[..., 0] / (step * step).sum(1, keepdim=True)
    index = torch.tensor([0, 2, 3, 1])[(along + 0.5).floor().clamp_(0, 3).long()]
    bits = (index << (2 * torch.arange(16))).sum(1)
    return (high | low << 16 | bits << 32).view(torch.uint8).view(-1, 8)


def write_bc4(ends: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Return BC4 blocks with the closer palette, (N, 8) uint8, for endpoints (N, 2) and values (N, 16, 1)."""
    x, code = 255 * x[..., 0], (255 * ends + 0.5).long()
    high, low = code.max(1, keepdim=True).values, code.min(1, keepdim=True).values
    fifths, sevenths = torch.arange(6), torch.arange(8)
    bounds = torch.tensor([0, 255]).expand(len(x), 2)
    six = torch.cat([bounds[:, :1], ((5 - fifths) * low + fifths * high) // 5, bounds[:, 1:]], 1).float()
    eight = (((7 - sevenths) * low + sevenths * high) // 7).float()
    chosen = [nearest(palette, x) for palette in (six, eight)]
    better = (high[:, 0] > low[:, 0]) & ~(chosen[0][1] < chosen[1][1])
    names = torch.tensor([[6, 0, 2, 3, 4, 5, 1, 7], [1, 7, 6, 5, 4, 3, 2, 0]])
    index = torch.where(better[:, None], names[1][chosen[1][0]], names[0][chosen[0][0]])
    ordered = torch.where(better[:, None], torch.cat([high, low], 1), torch.cat([low, high], 1))
    bits = (index << (3 * torch.arange(16))).sum(1)
    return (ordered[:, 0] | ordered[:, 1] << 8 | bits << 16).view(torch.uint8).view(-1, 8)


def nearest(palette: torch.Tensor, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return places (N, 16) of the nearest of rising values (N, 8), and squared errors (N,)."""
    place = torch.searchsorted(0.5 * (palette[:, 1:] + palette[:, :-1]), x.contiguous())
    return place, (palette.gather(1, place) - x).square().sum(1)


# --- training ---------------------------------------------------------------------------------------------------------


class _Chosen(torch.autograd.Function):
    """The weight n / (N − 1) of the largest of d (…, N); its gradient is that of the expectation under softmax(d / T).

    NTBC Eq. 10, 13 and 30.
    """

    @staticmethod
    def forward(ctx, d, temperature):
        ctx.save_for_backward(d)
        ctx.temperature = temperature
        return d.argmax(-1).to(d.dtype) / (d.shape[-1] - 1)

    @staticmethod
    def backward(ctx, gradient):
        (d,) = ctx.saved_tensors
        weights = torch.linspace(0, 1, d.shape[-1], dtype=d.dtype)
        share = torch.softmax(d / ctx.temperature, -1)
        expected = (share @ weights)[..., None]
        return gradient[..., None] * share * (weights - expected) / ctx.temperature, None


def _between(w: torch.Tensor, e0: torch.Tensor, e1: torch.Tensor) -> torch.Tensor:
    """Return (1 − w) e0 + w e1, (B, P, K, 16), for w (B, P, 16) and endpoints (B, P, K)."""
    return torch.lerp(e0[..., None], e1[..., None], w[:, :, None])


def _chosen(x, e0, e1, entries: int, temperature: float) -> torch.Tensor:
    """Return the weights (B, P, 16) of the palette entries nearest to x (B, P, K, 16)."""
    w = torch.linspace(0, 1, entries, dtype=x.dtype)
    palette = torch.lerp(e0[..., None], e1[..., None], w)  # (B, P, K, N)
    squared = (x[..., None] - palette[:, :, :, None]).square().sum(2)
    return _Chosen.apply(-torch.sqrt(squared + 1e-12), temperature)


class Step:
    """A training step: five losses, autograd, and fused Adam with the rates of grids and layers (NTBC §3.2, 3.4).

    Args:
        shape: Sizes, as the fused step takes them; not naive, plain RGB metric.
        rows, columns: Blocks of the texture.
        colours, endpoints: Reference, (blocks, C, 16) and (blocks, 2C).
        values: (endpoint grid, endpoint net, texel grid, texel net).
        weights: Five factors; losses of factor 0 are left out.
        spelling: One of :data:`SPELLINGS`.
        dtype: float32, or float64 to compare with.
    """

    def __init__(self, shape, rows, columns, colours, endpoints, values, weights, spelling, dtype=torch.float32):
        self.shape, self.size, self.weights = shape, (rows, columns), weights
        self.colours, self.endpoints = colours.to(dtype), endpoints.to(dtype)
        pairs = (shape.endpoint, *values[:2]), (shape.texel, *values[2:])
        self.networks = [Network(*pair, spelling, dtype) for pair in pairs]
        groups = [{"params": list(n.levels), "lr": 0.01} for n in self.networks]
        groups += [{"params": list(n.weights), "lr": 0.005} for n in self.networks]
        self.adam = torch.optim.Adam(groups, betas=(0.9, 0.999), eps=1e-15, fused=True)
        self.groups, at = {}, 0  # (entries, K) → numbers of e0, e1 and colours, plane by plane
        for entries, k in shape.planes:
            own = torch.arange(at, at + k)
            ends = self.groups.setdefault((entries, k), [[], [], []])
            for rows_of, numbers in zip(ends, (own + at, own + at + k, own), strict=True):
                rows_of.append(numbers)
            at += k
        self.groups = {key: [torch.stack(part) for part in parts] for key, parts in self.groups.items()}

    def taps(self, blocks: torch.Tensor) -> list:
        """Return what both networks look up for a batch."""
        pairs = zip(self.networks, (False, True), strict=True)
        return [network.taps(places(*self.size, blocks, texels)) for network, texels in pairs]

    def loss(self, blocks: torch.Tensor, taps: list, temperature: float = 0.01) -> torch.Tensor:
        """Return the weighed sum of the mean losses."""
        said, mine = (network(t) for network, t in zip(self.networks, taps, strict=True))
        count, c = len(blocks), self.shape.channels
        mine = mine.view(count, 16, c).transpose(1, 2)
        numbers = blocks.long()
        endpoints, colours = self.endpoints[numbers], self.colours[numbers]
        w, per_end, per_colour = self.weights, 1 / (2 * c * count), 1 / (16 * c * count)
        total = said.new_zeros(())
        if w[0]:
            total = total + w[0] * per_end * (said - endpoints).square().sum()
        if w[2]:
            total = total + w[2] * per_colour * (mine - colours).square().sum()
        for (entries, _), (first, second, own) in self.groups.items():
            s0, s1, e0, e1 = said[:, first], said[:, second], endpoints[:, first], endpoints[:, second]
            target, predicted = colours[:, own], mine[:, own]
            for factor, x, palette, decoded in (
                (w[1], target, (s0, s1), (e0, e1)),
                (w[3], predicted, (e0, e1), (e0, e1)),
                (w[4], predicted, (s0.detach(), s1.detach()), (s0, s1)),
            ):
                if factor:
                    chosen = _chosen(x, *palette, entries, temperature)
                    total = total + factor * per_colour * (_between(chosen, *decoded) - target).square().sum()
        return total

    def gradients(self, blocks: torch.Tensor) -> list[torch.Tensor]:
        """Return the gradients of (endpoint grid, endpoint layers, texel grid, texel layers), flat, without padding."""
        self.adam.zero_grad(set_to_none=True)
        self.loss(blocks, self.taps(blocks)).backward()
        found = []
        for network in self.networks:
            bag = network.spelling == "embedding_bag"
            levels = [p.grad if bag else p.grad[0].permute(1, 2, 0) for p in network.levels]
            found.append(torch.cat([g.reshape(-1) for g in levels]))
            found.append(torch.cat([p.grad.reshape(-1) for p in network.weights]))
        return found

    def run(self, blocks: torch.Tensor, taps: list) -> None:
        """Take one step."""
        self.adam.zero_grad(set_to_none=True)
        self.loss(blocks, taps).backward()
        self.adam.step()
