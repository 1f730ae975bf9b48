"""One training step of a NeuBRDF: loss and all gradients by the fused kernel, beside plain torch with autograd.

Both sides get the corners and weights of a batch and leave the gradients of features and network (32→64→64→3, LogCosine
loss). Torch is written as its users would: ``embedding_bag`` for the weighted rows, ``linear``, autograd. Adam is the
same on both sides and left out. ``rows``: what is gathered from, a codebook or both grids. ``error``: the largest
deviation of a gradient from torch in float64, over the largest, without samples whose hidden units lie so near 0 that
rounding decides; ``gflops``: matrix products only, forward and backward.
"""

from bench.harness import interleave, track
from warp_neumat.kernels import dispatch

COLUMNS = ["rows", "batch", "workers", "ms", "msamples", "gflops", "peer", "peer_ms", "ratio", "error"]

ROWS = {"codebook 512": 512, "grids N = 16": 2 * 1633, "grids N = 64": 2 * 24961}
SHARPNESS, SOFTNESS = 12.0, 2e-3


def _problem(rows: int, batch: int, shape, seed: int = 0):
    import torch

    draw = torch.Generator().manual_seed(seed)
    table, net = torch.randn(rows, 16, generator=draw), 0.15 * torch.randn(shape.weights, generator=draw)
    corner = torch.randint(0, rows, (batch, 8), generator=draw, dtype=torch.int32)
    weight = torch.rand(batch, 8, generator=draw) / 4
    return table, net, (corner, weight, torch.rand(batch, 1, generator=draw), 3 * torch.rand(batch, 3, generator=draw))


def _torch_step(table, net, samples, shape):
    """Leave gradients in ``table`` and ``net``; return the smallest distance of a hidden unit from 0, per sample."""
    import torch
    from torch.nn.functional import embedding_bag

    corner, weight, cosine, target = samples
    table.grad = net.grad = None
    bag = embedding_bag(corner.view(-1, 4), table, mode="sum", per_sample_weights=weight.view(-1, 4))
    x, nearest = bag.view(-1, 32), None
    for n, width in enumerate(shape.hidden):
        bias, at = shape.offsets[n]
        x = torch.addmm(net[bias : bias + width], x, net[at : at + shape.rows[n] * width].view(-1, width))
        margin = x.detach().abs().amin(1)
        nearest = margin if nearest is None else torch.minimum(nearest, margin)
        x = torch.relu(x)
    bias, at = shape.offsets[-1]
    y = torch.addmm(net[bias : bias + 3], x, net[at:].view(3, -1).T)
    scaled = SHARPNESS * torch.expm1(y.clamp_max(11.0)) * cosine
    residual = torch.log1p(scaled.clamp_min(0.0)) + scaled.clamp_max(0.0) - target
    torch.sqrt(residual**2 + SOFTNESS**2).mean().backward()
    return nearest


def _error(rows: int, shape) -> float:
    import torch

    from warp_neumat.ops.brdf import BRDFStep

    table, net, samples = _problem(rows, 4096, shape, seed=1)
    wide = [table.double().requires_grad_(), net.double().requires_grad_()]
    double = [s.double() if s.is_floating_point() else s for s in samples]
    nearest = _torch_step(*wide, double, shape)
    kept = torch.nonzero(nearest > 1e-5).flatten()[:2048]
    _torch_step(*wide, [s[kept] for s in double], shape)
    flat = table.flatten()
    step = BRDFStep(shape, flat, [0, 0], net, batch=2048, parts=2, sharpness=SHARPNESS, softness=SOFTNESS)
    step.run(*(s[kept] for s in samples))
    pairs = ((step.table_gradient.view_as(table), wide[0].grad), (step.weight_gradient, wide[1].grad))
    return max(float((got - expected).abs().max() / expected.abs().max()) for got, expected in pairs)


def rows(*, device: str, quick: bool):
    """Yield a row per table, batch and number of workers."""
    import torch

    from warp_neumat.kernels.brdf_train import StepShape
    from warp_neumat.ops.brdf import BRDFStep

    if device != "cpu":
        raise ValueError(f"device must be cpu, where the fused step runs, got {device}")
    shape = StepShape(((16, 4), (16, 4)), (64, 64))
    batches, rounds = ((1024,), 3) if quick else ((4096, 16384), 25)
    names = list(ROWS)[:1] if quick else list(ROWS)
    threads, most = torch.get_num_threads(), dispatch.worker_count()
    choices = [(name, batch, workers) for name in names for batch in batches for workers in sorted({1, most})]
    try:
        for name, batch, workers in track(choices, "training steps"):
            dispatch.set_worker_count(workers)
            torch.set_num_threads(workers)
            table, net, samples = _problem(ROWS[name], batch, shape)
            loss = {"sharpness": SHARPNESS, "softness": SOFTNESS}
            step = BRDFStep(shape, table.flatten(), [0, 0], net.clone(), batch=batch, parts=workers, **loss)
            leaves = table.clone().requires_grad_(), net.clone().requires_grad_()

            def ours(step=step, samples=samples):
                step.run(*samples)
                return step.table_gradient, step.weight_gradient

            seconds = interleave({"ours": ours, "torch": lambda a=leaves, s=samples: _torch_step(*a, s, shape)}, rounds)
            yield {
                "rows": name,
                "batch": batch,
                "workers": workers,
                "ms": 1e3 * seconds["ours"],
                "msamples": batch / seconds["ours"] / 1e6,
                "gflops": shape.flops * batch / seconds["ours"] / 1e9,
                "peer": "torch",
                "peer_ms": 1e3 * seconds["torch"],
                "ratio": seconds["torch"] / seconds["ours"],
                "error": _error(ROWS[name], shape),
            }
    finally:
        dispatch.set_worker_count(None)
        torch.set_num_threads(threads)
