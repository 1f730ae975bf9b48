"""How fast NTBC's inference and training step are beside plain torch: ``table1`` and ``step`` of ``bench.ntbc``.

Both time the paper's pair of networks (``endpoints=network``), trained a little.
"""

from __future__ import annotations

import functools
from types import SimpleNamespace

import numpy as np

from ._ntbc_lab import Lab
from .harness import interleave

TRAINED = 300
"""Steps that the networks of ``table1`` and ``step`` are trained for at most: neither's time depends on it."""


def _trained(lab: Lab, source, mode: str):
    """Return (config, pairs) of networks that are trained a little, as a fit trains them."""
    import torch

    from warp_neumat.models import ntbc
    from warp_neumat.training.block_maps import BlockMapData
    from warp_neumat.training.loop import Plan

    choice = lab.choice
    config = ntbc.configure(source, {**choice.options, "mode": mode, "endpoints": "network"})
    plan = Plan(min(choice.steps or TRAINED, TRAINED), BlockMapData.batch(config), choice.seed)
    trainer = BlockMapData.trainer(ntbc, source, config, plan, torch.device("cpu"), checkpoint=None)
    trainer.run()
    return config, list(trainer.model.pairs), plan


def table1(lab: Lab):
    """Yield inference of both modes, all textures and those in BC1 alone, beside torch; then stages of loading."""
    name = lab.choice.timed
    opened = lab.source(name)[1]
    tree = opened.manifest()
    wide = {c.map for c in opened.channels if c.component == "g"}
    sources = {"BC1 & BC4": opened}
    if wide:
        from warp_neumat.io.texture_set import open_texture_set

        sources["BC1 only"] = open_texture_set({**tree, "maps": {m: f for m, f in tree["maps"].items() if m in wide}})
    for mode in lab.choice.modes:
        for what, source in sources.items():
            config, pairs, _ = _trained(lab, source, mode)
            for row in _inference(config, pairs, lab.choice.rounds):
                yield {"table": "table1", "set": name, "method": f"ntbc {mode}, {what}", **row}
    for mode in lab.choice.modes:
        known = [other for other in lab.choice.sets if len(lab.source(other)[1].channels) == 7]
        chosen = known[0] if known else name
        material, _, _ = lab.fitted(chosen, {"mode": mode})
        stages = {key: round(value, 2) for key, value in material.load_ms.items()}
        text = ", ".join(f"{key} {value:.4g}" for key, value in stages.items())
        row = {"ms": sum(stages.values()), "load_ms": stages, "maps": text}
        yield {"table": "table1", "set": chosen, "method": f"load, ntbc {mode}", **row}


def _inference(config, pairs, rounds: int):
    import torch
    import warp as wp

    from warp_neumat import metrics
    from warp_neumat.kernels.ntbc import ModelShape, ntbc_blocks

    from ._ntbc_peers import SPELLINGS, Inference

    models = []
    for pair in pairs:
        planes = tuple((plane.format, plane.components) for plane in config.planes(pair.model))
        arrays = [pair.endpoint_grid, pair.endpoint_net, pair.texel_grid, pair.texel_net]
        device = [wp.array(a.numpy(), dtype=wp.float32, device="cpu") for a in arrays]
        models.append((pair, planes, ModelShape(pair.shape.endpoint, pair.shape.texel, planes), device))

    def ours():
        return [ntbc_blocks(shape, config.rows, config.columns, *a) for _, _, shape, a in models]

    written = [plane.numpy().reshape(-1, 8) for planes in ours() for plane in planes]
    formats = [format for _, planes, _, _ in models for format, _ in planes]
    peers, calls = {}, {"ours": ours}
    # float16 is emulated where the CPU has none: once, by one spelling.
    for dtype, short, spellings in ((torch.float32, "fp32", SPELLINGS), (torch.float16, "fp16", SPELLINGS[1:])):
        for spelling in spellings:
            nets = [Inference(p, planes, config.rows, config.columns, spelling, dtype) for p, planes, _, _ in models]
            for write, suffix in ((False, "networks"), (True, "networks and blocks")):
                peers[short, suffix, spelling] = [(net, write) for net in nets]
    for key, nets in peers.items():
        calls[key] = lambda nets=nets: [blocks for net, write in nets for blocks in net.run(write)]
    fast = {key: call for key, call in calls.items() if key == "ours" or key[0] == "fp32"}
    seconds = interleave(fast, rounds)
    slow = {key: call for key, call in calls.items() if key not in fast}
    seconds |= interleave(slow, 1, warmup=0)
    for short in ("fp32", "fp16"):
        for suffix in ("networks", "networks and blocks"):
            key = min((k for k in peers if k[:2] == (short, suffix)), key=seconds.get)
            row = {"ms": 1e3 * seconds["ours"], "peer": f"torch {short}, {suffix} ({key[2]})"}
            row |= {"peer_ms": 1e3 * seconds[key], "ratio": seconds[key] / seconds["ours"]}
            if suffix != "networks":
                theirs = [blocks.numpy() for blocks in calls[key]()]
                differ, mse = zip(
                    *(_differing(*pair) for pair in zip(formats, written, theirs, strict=True)), strict=True
                )
                row |= {"differ": float(np.mean(differ)), "psnr_peer": metrics.psnr_of_mse(mse)}
            yield row


def _differing(format: str, ours: np.ndarray, theirs: np.ndarray) -> tuple[float, float]:
    """Return the share of blocks that differ, and the mean squared difference of what they decode to."""
    from warp_neumat.kernels.bc1 import bc1_decode
    from warp_neumat.kernels.bc4 import bc4_decode

    decode = {"bc1": bc1_decode, "bc4": bc4_decode}[format]
    pair = [decode(np.ascontiguousarray(blocks)).astype(np.float64) / 255 for blocks in (ours, theirs)]
    return float((ours != theirs).any(1).mean()), float(np.square(pair[0] - pair[1]).mean())


def step(lab: Lab):
    """Yield training steps of the paper's losses and of the joint ones, of all planes in one model, beside torch."""
    import torch
    import warp as wp

    from bench.mlp import peak_kernel
    from warp_neumat.kernels import dispatch
    from warp_neumat.models.ntbc import block_colours
    from warp_neumat.training.block_maps import reference_endpoints
    from warp_neumat.training.ntbc_loop import APART, JOINT

    name = lab.choice.timed
    opened = lab.source(name)[1]
    config, (pair,), plan = _trained(lab, opened, "aggressive")
    planes = config.planes(pair.model)
    problem = SimpleNamespace(
        config=config,
        pair=pair,
        batch=min(plan.batch, config.rows * config.columns // 8 * 8),
        colours=block_colours(planes, opened.pixels),
        endpoints=reference_endpoints(planes, opened.pixels),
    )
    order = torch.randperm(len(problem.colours), generator=torch.Generator().manual_seed(1))
    blocks = order[: problem.batch].int()
    threads, most = torch.get_num_threads(), dispatch.worker_count()
    turns = 1 << 21
    try:
        for losses, weights in (("paper's losses", APART), ("joint losses", JOINT)):
            errors = _gradient_errors(problem, blocks, weights)
            for workers in sorted({min(n, most) for n in lab.choice.workers}):
                dispatch.set_worker_count(workers)
                torch.set_num_threads(workers)
                calls = _steps(problem, blocks, weights, workers)
                sums = wp.zeros((workers, 16), dtype=wp.float32, device="cpu")
                inputs = [wp.array([0.5, 1.0], dtype=wp.float32, device="cpu"), sums, turns]
                calls["peak"] = dispatch.Job(peak_kernel, workers, inputs=inputs, device="cpu", grain=1).run
                seconds = interleave(calls, lab.choice.rounds, warmup=2)
                peak = float(sums.numpy()[:, 1].sum()) / seconds["peak"]
                peer = min((key for key in calls if key not in ("ours", "peak")), key=seconds.get)
                yield {
                    "table": "step",
                    "set": name,
                    "method": f"{losses}, {problem.batch} blocks",
                    "workers": workers,
                    "ms": 1e3 * seconds["ours"],
                    "peer": f"torch ({peer})",
                    "peer_ms": 1e3 * seconds[peer],
                    "ratio": seconds[peer] / seconds["ours"],
                    "floor_ms": 1e3 * pair.shape.flops * problem.batch / peak,
                    "error": errors[0],
                    "peer_error": errors[1],
                }
    finally:
        dispatch.set_worker_count(None)
        torch.set_num_threads(threads)


def _values(pair) -> list:
    return [v.detach().clone() for v in (pair.endpoint_grid, pair.endpoint_net, pair.texel_grid, pair.texel_net)]


def _steps(problem, blocks, weights, workers: int) -> dict:
    """Return whole steps, ours and torch's, by name."""
    import torch

    from warp_neumat.ops.grid_update import GridAdam
    from warp_neumat.ops.ntbc import NTBCStep

    from ._ntbc_peers import SPELLINGS, Step

    config, shape = problem.config, problem.pair.shape
    place = config.rows, config.columns
    adams = []
    for number, values in enumerate(_values(problem.pair)):
        gradients = torch.zeros(workers, values.numel())
        network = (shape.endpoint, shape.texel)[number // 2]
        more = {"bits": None, "lazy": False} if number % 2 else {"offsets": network.grid_offsets}
        adams.append(GridAdam(values, gradients, **more))
    fused = NTBCStep(
        shape, *place, problem.colours, problem.endpoints, *(adam.used for adam in adams), batch=problem.batch,
        parts=workers, gradients=[adam.gradients for adam in adams],
    )  # fmt: skip
    fused.weights.copy_(torch.tensor(weights))
    taken = 0

    def ours():
        nonlocal taken
        taken += 1
        fused.run(blocks)
        for number, adam in enumerate(adams):
            adam.step((0.01, 0.005)[number % 2], taken)

    calls = {"ours": ours}
    for spelling in SPELLINGS:
        peer = Step(shape, *place, problem.colours, problem.endpoints, _values(problem.pair), weights, spelling)
        calls[spelling] = functools.partial(peer.run, blocks, peer.taps(blocks))
    return calls


def _gradient_errors(problem, blocks, weights) -> tuple[float, float]:
    """Return the relative errors of the fused gradients and of torch's in float32, against torch in float64."""
    import torch

    from warp_neumat.models.ntbc import layers
    from warp_neumat.ops.ntbc import NTBCStep

    from ._ntbc_peers import Step

    config, shape = problem.config, problem.pair.shape
    place, values = (config.rows, config.columns), _values(problem.pair)
    arguments = (shape, *place, problem.colours, problem.endpoints)
    exact, single = (
        Step(*arguments, values, weights, "embedding_bag", dtype).gradients(blocks)
        for dtype in (torch.float64, torch.float32)
    )
    fused = NTBCStep(*arguments, *values, batch=problem.batch, parts=2)
    fused.weights.copy_(torch.tensor(weights))
    fused.run(blocks)
    ours = []
    for network, name in ((shape.endpoint, "endpoint"), (shape.texel, "texel")):
        ours.append(getattr(fused, f"{name}_grid_gradient"))
        packed = layers(network, getattr(fused, f"{name}_net_gradient"))
        ours.append(torch.cat([part.reshape(-1) for layer in packed for part in layer]))

    def error(found):
        pairs = zip(found, exact, strict=True)
        return max(float((f.double() - e).norm() / e.norm()) for f, e in pairs if e.norm() > 0)

    return error(ours), error(single)
