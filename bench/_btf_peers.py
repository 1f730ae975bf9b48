"""The networks of a BTF in Dr.Jit and torch: the coarse one once for a quad, the fine one four times; one level too.

The peers are spared geometry and fetches: they get the inputs of the networks ready in float32, in the layout and batch
size that is fastest here. Ours pays for both, from uv and directions to values. Ours evaluates once for all lights what
does not depend on them; a peer evaluates its network anew for each light.

- ``drjit``: cooperative vectors on LLVM, packed, in float32 and float16. Coarse and fine networks of a quad are one
  kernel, or two of which the second gathers what the first left. Dr.Jit takes the LLVM that ``DRJIT_LIBLLVM_PATH``
  names.
- ``torch``: ``addmm`` in float32, as it is or through ``torch.compile``; what the latents add to the fine network's
  first layer is computed once for a quad.
"""

from __future__ import annotations

import functools
import itertools
import sys

import numpy as np

from bench.mlp import error_of, fastest
from warp_neumat.reference.btf import layers

from ._btf_networks import Run, asset, least

CHECKED = 1024
NAMES = ("coarse-to-fine", "single-level")

_EXACT = {"relu": lambda x: np.maximum(x, 0), "hardswish": lambda x: x * np.clip(x / 6 + 0.5, 0, 1)}


class Problem:
    """The networks of one of :data:`SHAPES`, and inputs that are made as they are asked for."""

    def __init__(self, name: str, seed: int = 6):
        self._rng = np.random.default_rng(seed)
        tensors, header = asset(self._rng, name, side=16)
        config = header["config"]
        self.activation = config["activation"]
        self.fine = layers(tensors, "fine")
        self.coarse = layers(tensors, "coarse") if config["coarse"] else None
        self.channels = config["fine"]["channels"]
        self.head = 9 + (config["coarse"]["channels"] if self.coarse else 0)
        """Inputs of a quad: angles and coarse features, or angles alone."""

    def inputs(self, quads: int) -> tuple[np.ndarray, np.ndarray]:
        """Return those of the quads (n, head) and the fine features of their texels (n, 4, channels), float32."""
        shapes = (quads, self.head), (quads, 4, self.channels)
        return tuple(self._rng.normal(size=shape).astype(np.float32) for shape in shapes)

    def exact(self, quad: np.ndarray, texel: np.ndarray) -> np.ndarray:
        """Return the outputs (n, 4, 3) in float64."""
        head = quad.astype(np.float64)
        for w, b in zip(*self.coarse, strict=True) if self.coarse else ():
            head = _EXACT[self.activation](head @ w.T + b)
        x = np.concatenate([head[:, None].repeat(4, 1), texel], 2)
        *hidden, (last, bias) = zip(*self.fine, strict=True)
        for w, b in hidden:
            x = _EXACT[self.activation](x @ w.T + b)
        return x @ last.T + bias


def drjit_peers(problem: Problem, texels: int, workers: int):
    """Yield (name, call, error, texels of a call) for Dr.Jit; nothing, and why on stderr, where it is missing."""
    try:
        import drjit as dr
        from drjit import llvm, nn
    except ImportError:
        print("no Dr.Jit, so no such peer: pip install drjit", file=sys.stderr)
        return
    dr.set_thread_count(workers)

    class HardSwish(nn.Module):
        def __call__(self, x):
            return x * dr.minimum(dr.maximum(dr.fma(x, 1 / 6, 0.5), 0), 1)

    between = {"relu": nn.ReLU, "hardswish": HardSwish}[problem.activation]

    def packed(weights, biases, end, Tensor, scalar):
        linear = [nn.Linear(w.shape[1], len(w)) for w in weights]
        chain = [part for layer in linear for part in (layer, between())][: None if end else -1]
        net = nn.Sequential(*chain).alloc(Tensor, weights[0].shape[1])
        for layer, w, b in zip(net.layers[::2], weights, biases, strict=True):
            layer.weights, layer.bias = Tensor(np.asarray(w, scalar)), Tensor(np.asarray(b, scalar))
        return nn.pack(net, layout="inference")

    kinds = (("float32", llvm.TensorXf, llvm.Float, np.float32), ("float16", llvm.TensorXf16, llvm.Float16, np.float16))
    for (name, Tensor, Array, scalar), count, fused in itertools.product(
        kinds, sorted({min(1 << 14, texels), texels}), (True, False)
    ):
        quads = count // 4
        fine = packed(*problem.fine, False, Tensor, scalar)
        coarse = packed(*problem.coarse, True, Tensor, scalar) if problem.coarse else None
        quad, texel = problem.inputs(quads)

        def column(x, Array=Array, scalar=scalar):
            return Array(np.ascontiguousarray(x, scalar))

        heads = [column(c) for c in quad.T]
        if fused:
            features = [[column(c) for c in texel[:, k].T] for k in range(4)]
        else:
            features = [column(c) for c in texel.reshape(-1, problem.channels).T]
        which = llvm.UInt32(np.arange(4 * quads, dtype=np.uint32) // 4)
        dr.make_opaque(heads, features, which)

        def run(coarse=coarse, fine=fine, heads=heads, features=features, which=which, fused=fused, Array=Array):
            z = heads if coarse is None else list(coarse(nn.CoopVec(*heads)))
            if fused:
                out = [c for own in features for c in fine(nn.CoopVec(*z, *own))]
            else:
                dr.eval(z)
                out = list(fine(nn.CoopVec(*(dr.gather(Array, c, which) for c in z), *features)))
            dr.eval(out)
            return out

        turns = max(1, texels // count)

        def call(run=run, turns=turns):
            for _ in range(turns):
                run()
            dr.sync_thread()

        got = np.stack([np.array(c) for c in run()], 1)
        got = got.reshape(-1, 4, 3)[:CHECKED]
        yield f"drjit {name}", call, error_of(got, problem.exact(quad[:CHECKED], texel[:CHECKED])), count * turns


def torch_peers(problem: Problem, texels: int, workers: int, *, compiled: bool):
    """Yield (name, call, error, texels of a call) for torch, in two batch sizes, compiled and not."""
    import torch
    from torch.nn.functional import hardswish, linear

    between = {"relu": torch.relu, "hardswish": hardswish}[problem.activation]
    torch.set_num_threads(workers)

    def tensors(net):
        return [[torch.tensor(np.asarray(m), dtype=torch.float32) for m in pair] for pair in zip(*net, strict=True)]

    fine, coarse = tensors(problem.fine), tensors(problem.coarse) if problem.coarse else []
    first, bias = fine[0]
    cut = first.shape[1] - problem.channels
    of_head, of_texel = first[:, :cut].contiguous(), first[:, cut:].contiguous()

    def network(head, features):
        for w, b in coarse:
            head = between(linear(head, w, b))
        shared = linear(head, of_head, bias)
        h = between(linear(features, of_texel).view(-1, 4, len(bias)) + shared[:, None]).view(-1, len(bias))
        for w, b in fine[1:-1]:
            h = between(linear(h, w, b))
        return linear(h, *fine[-1])

    quad, texel = (torch.from_numpy(x) for x in problem.inputs(texels // 4))
    expected = problem.exact(quad[:CHECKED].numpy(), texel[:CHECKED].numpy())
    forms = [("torch float32", network)]
    if compiled:
        forms.append(("torch float32 compiled", torch.compile(network)))
    for (name, function), batch in itertools.product(forms, sorted({min(2048, texels // 4), texels // 4})):
        parts = list(zip(quad.split(batch), texel.flatten(0, 1).split(4 * batch), strict=True))

        def call(function=function, parts=parts):
            with torch.inference_mode():
                for head, features in parts:
                    function(head, features)

        try:
            with torch.inference_mode():
                got = function(*parts[0])[: 4 * CHECKED].numpy().reshape(-1, 4, 3)
        except Exception as error:  # no compiler, or one that torch cannot use: whatever the back end raises
            print(f"{name} left out: {str(error).splitlines()[0]}", file=sys.stderr)
            continue
        yield name, call, error_of(got, expected[: len(got)]), texels


def rows(device, texels: int, rounds: int, *, compiled: bool = True):
    """Yield each design under one and three lights, and what a further one costs, beside each peer."""
    import torch

    from warp_neumat.kernels import dispatch

    workers, threads = dispatch.worker_count(), torch.get_num_threads()
    try:
        runs, peers, calls = {}, {}, {}
        for name in NAMES:
            runs[name] = Run(name, texels, device)
            problem = Problem(name)
            for offers in (
                drjit_peers(problem, texels, workers),
                torch_peers(problem, texels, workers, compiled=compiled),
            ):
                for kind, (call, error, done) in _fastest(offers).items():
                    peers[name, kind] = (error, done)
                    calls[name, kind] = call
            for n in (1, 3, 9):
                calls[name, n] = functools.partial(runs[name].call, n)
        seconds = least(calls, rounds)
        for name, run in runs.items():
            ours = {n: seconds[name, n] / run.texels for n in (1, 3, 9)}
            cases = {"1": (ours[1], 1), "3": (ours[3], 3), "a further": ((ours[9] - ours[3]) / 6, 1)}
            for (lights, (spent, times)), (design, kind) in itertools.product(cases.items(), peers):
                if design != name:
                    continue
                error, done = peers[name, kind]
                peer = times * seconds[name, kind] / done
                yield {
                    "table": "peers",
                    "method": name,
                    "lights": lights,
                    "texels": run.texels,
                    "ms": 1e3 * spent * run.texels,
                    "ns_per_texel": 1e9 * spent / times,
                    "error": run.error(3 if lights == "3" else 1),
                    "peer": kind,
                    "peer_ms": 1e3 * peer * run.texels,
                    "peer_error": error,
                    "ratio": peer / spent,
                }
    finally:
        torch.set_num_threads(threads)


def _fastest(offers) -> dict[str, tuple]:
    """Return the fastest of the offers, nothing where there are none."""
    offers = list(offers)
    return fastest(offers) if offers else {}
