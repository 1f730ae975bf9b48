"""A full-HD frame of evaluations of a fitted NeuBRDF, beside its bare network in Dr.Jit.

Ours pays for everything: eight look-ups, weights, the network, and writing value × cosine. The peer is handed the
network's inputs, resident, and computes the network alone, packed for Dr.Jit's LLVM backend in fp32 and fp16, of which
the faster one counts.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from .harness import interleave

STEPS = 20
"""Of the fit: what the weights are changes nothing in the time."""


def rows(lab):
    """Yield a row a method of :data:`bench._brdf_lab.OURS` that was chosen."""
    import warp as wp

    from warp_neumat.kernels import dispatch
    from warp_neumat.materials import load
    from warp_neumat.training.fit import fit

    from ._brdf_lab import OURS

    choice, device = lab.choice, lab.device
    rng = np.random.default_rng(6)
    pair = rng.normal(size=(2, choice.pixels, 3)).astype(np.float32)
    pair[:, :, 2] = np.abs(pair[:, :, 2])
    pair /= np.linalg.norm(pair, axis=2, keepdims=True)
    wi, wo = (wp.array(part, dtype=wp.float32, device=device) for part in pair)
    spec = "analytic:ggx?roughness=0.3&diffuse=0.2"
    for method in (m for m in choice.methods if m in OURS):
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "fitted.neumat"
            header = fit(spec, out, model="neubrdf", steps=min(STEPS, choice.steps or STEPS), seed=0, **OURS[method])
            material = load(out, device=device)
        config = header["config"]

        def ours(material=material):
            material.eval(None, wi, wo)
            wp.synchronize_device(device)

        contenders = {"ours": ours}
        widths = (2 * config["features"], *config["hidden"], 3)
        contenders.update(drjit_networks(widths, choice.pixels, dispatch.worker_count(), rng))
        seconds = interleave(contenders, choice.rounds)
        row = {"table": "frame", "material": "frame", "method": method, "pixels": choice.pixels}
        row |= {"ms": seconds["ours"] * 1e3, "mevals_per_s": choice.pixels / seconds["ours"] / 1e6}
        peers = {name: value for name, value in seconds.items() if name != "ours"}
        if peers:
            best = min(peers, key=peers.get)
            row |= {"peer": best, "peer_ms": peers[best] * 1e3, "ratio": peers[best] / seconds["ours"]}
        yield row


def drjit_networks(widths: tuple[int, ...], count: int, workers: int, rng) -> dict:
    """Return name → call of a network of these ``widths`` on ``count`` inputs; nothing where Dr.Jit is missing."""
    try:
        import drjit as dr
        from drjit import nn
        from drjit.llvm import Float, Float16, TensorXf, TensorXf16
    except ImportError:
        return {}
    dr.set_thread_count(workers)
    calls = {}
    x = rng.normal(size=(widths[0], count))
    kinds = (("drjit float32", TensorXf, Float, np.float32), ("drjit float16", TensorXf16, Float16, np.float16))
    for name, Tensor, Array, scalar in kinds:
        linear = [nn.Linear(i, o) for i, o in zip(widths, widths[1:], strict=False)]
        chain = [part for layer in linear[:-1] for part in (layer, nn.ReLU())] + linear[-1:]
        net = nn.Sequential(*chain).alloc(Tensor, widths[0])
        for layer, i, o in zip(net.layers[::2], widths, widths[1:], strict=False):
            layer.weights = Tensor((rng.normal(size=(o, i)) * (1.5 / i) ** 0.5).astype(scalar))
            layer.bias = Tensor(np.full(o, 0.2, scalar))
        net = nn.pack(net, layout="inference")
        columns = [Array(np.ascontiguousarray(row.astype(scalar))) for row in x]
        dr.make_opaque(columns)

        def call(net=net, columns=columns):
            dr.eval(list(net(nn.CoopVec(*columns))))
            dr.sync_thread()

        calls[name] = call
    return calls
