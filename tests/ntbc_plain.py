"""Problems for NTBC's training step: random tensors of any shape; its plain torch twin is ``models/ntbc_plain.py``."""

import torch

from warp_neumat.kernels.ntbc_train import StepShape
from warp_neumat.models.ntbc_plain import losses, network, places

__all__ = ["losses", "network", "places", "problem"]


def problem(shape: StepShape, rows: int, columns: int, seed: int = 0) -> dict:
    """Random tensors of a step, by name; colours scatter around lines between the endpoints."""
    draw = torch.Generator().manual_seed(seed)
    made = {}
    for name, sizes in (("endpoint", shape.endpoint), ("texel", shape.texel)):
        net = torch.zeros(sizes.weights)
        widths = (sizes.inputs, *sizes.hidden, sizes.outputs)
        for n, (bias, at) in enumerate(sizes.offsets):
            wide, tall = sizes.rows[n + 1], sizes.rows[n]
            net[bias : bias + widths[n + 1]] = 0.1 * torch.randn(widths[n + 1], generator=draw)
            matrix = net[at : at + tall * wide].view(tall, wide)[: widths[n], : widths[n + 1]]
            matrix[:] = torch.randn(matrix.shape, generator=draw) * widths[n] ** -0.5
        made[f"{name}_grid"] = torch.randn(sizes.grid_words, generator=draw)
        made[f"{name}_net"] = net
    count, c = rows * columns, shape.channels
    made["endpoints"] = torch.rand(count, 2 * c, generator=draw)
    colours, at = [], 0
    for _, k in shape.planes:
        e = made["endpoints"][:, 2 * at : 2 * at + 2 * k].view(count, 2, k, 1)
        w = torch.rand(count, 1, 16, generator=draw)
        colours.append((1 - w) * e[:, 0] + w * e[:, 1] + 0.05 * torch.randn(count, k, 16, generator=draw))
        at += k
    made["colours"] = torch.cat(colours, 1).clamp(0, 1).contiguous()
    a = torch.randn(len(shape.planes), 4, 4, generator=draw)
    made["metric"] = torch.eye(4) + 0.1 * a @ a.transpose(1, 2)
    return made
