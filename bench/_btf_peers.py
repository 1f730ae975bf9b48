"""The networks of a BTF in Dr.Jit and torch: the coarse one once for a quad, the fine one four times; one level too.

Ours goes from uv and directions to values. The peers are spared geometry, and fetches too unless their name says
otherwise: they get the inputs of the networks ready, in the layout and batch size that is fastest here. Ours evaluates
once for all lights what does not depend on them; a peer evaluates its network anew for each light. A ``further`` light
is an eighth of what eight more cost: no fetches in it on either side.

- ``drjit``: cooperative vectors on LLVM, packed, in float32 and float16. Coarse and fine networks of a quad are one
  kernel, or two of which the second gathers what the first left. ``with fetches``: also the bilinear features, of
  which it gets texels and weights ready, beside one light only. Dr.Jit takes the LLVM that ``DRJIT_LIBLLVM_PATH``
  names.
- ``torch``: ``addmm`` in float32, as it is or through ``torch.compile``; what the latents add to the fine network's
  first layer is computed once for a quad.
"""

from __future__ import annotations

import functools
import itertools
import sys

import numpy as np

from bench.mlp import error_of
from warp_neumat.reference.btf import layers

from ._btf_networks import SIDE, Run, asset, least, quad_uv, taps

CHECKED = 1024
NAMES = ("coarse-to-fine", "single-level")

_EXACT = {"relu": lambda x: np.maximum(x, 0), "hardswish": lambda x: x * np.clip(x / 6 + 0.5, 0, 1)}


class Problem:
    """The networks and textures of one of :data:`_btf_networks.SHAPES`, and inputs as they are asked for."""

    def __init__(self, name: str, seed: int = 6):
        self._rng = np.random.default_rng(seed)
        tensors, header = asset(self._rng, name)
        config = header["config"]
        self.activation = config["activation"]
        self.fine = layers(tensors, "fine")
        self.coarse = layers(tensors, "coarse") if config["coarse"] else None
        self.channels = config["fine"]["channels"]
        names = ("coarse", "fine") if self.coarse else ("fine",)
        self.tables = {net: tensors[f"{net}.mip0"].reshape(-1, config[net]["channels"]) for net in names}

    def inputs(self, quads: int) -> dict[str, np.ndarray]:
        """Return ``angles`` (n, 9), ``quad`` (n, 9 + coarse channels), ``texel`` (n, 4, channels), float32, and taps.

        Those are ``rows`` and ``weights`` (4 n, 4) of the fine table, ``coarse_rows`` and ``coarse_weights`` (n, 4).
        """
        uv, found = quad_uv(quads), {}
        found["angles"] = found["quad"] = self._rng.normal(size=(quads, 9)).astype(np.float32)
        if self.coarse:
            found["coarse_rows"], found["coarse_weights"] = taps(uv.mean(1), SIDE // 2, SIDE // 2)
            features = self._fetched("coarse", found["coarse_rows"], found["coarse_weights"])
            found["quad"] = np.concatenate([found["angles"], features], 1)
        found["rows"], found["weights"] = taps(uv.reshape(-1, 2), SIDE, SIDE)
        found["texel"] = self._fetched("fine", found["rows"], found["weights"]).reshape(quads, 4, -1)
        return found

    def _fetched(self, net: str, rows, weights) -> np.ndarray:
        table = self.tables[net].astype(np.float32)
        return sum(table[rows[:, k]] * weights[:, k : k + 1] for k in range(4))

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


def drjit_peers(problem: Problem, texels: int, workers: int, *, fetches: bool = False):
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

    kinds = (
        ("drjit float32", llvm.TensorXf, llvm.Float, llvm.ArrayXf, np.float32),
        ("drjit float16", llvm.TensorXf16, llvm.Float16, llvm.ArrayXf16, np.float16),
    )
    forms = ("fetched",) if fetches else ("fused", "split")
    for (name, Tensor, Array, Rows, scalar), count, form in itertools.product(
        kinds, sorted({min(1 << 14, texels), texels}), forms
    ):
        quads = count // 4
        fine = packed(*problem.fine, False, Tensor, scalar)
        coarse = packed(*problem.coarse, True, Tensor, scalar) if problem.coarse else None
        given = problem.inputs(quads)

        def columns(x, Array=Array, scalar=scalar):
            return [Array(np.ascontiguousarray(c, scalar)) for c in x.T]

        def indices(x):
            return [llvm.UInt32(np.ascontiguousarray(c, np.uint32)) for c in x.T]

        tables, heads, features, which = {}, columns(given["quad"]), [], []
        if form == "fetched":
            heads = columns(given["angles"])
            for net, table in problem.tables.items():  # a row of 2^n numbers is gathered in packets
                wide = np.zeros((len(table), 1 << (table.shape[1] - 1).bit_length()), scalar)
                wide[:, : table.shape[1]] = table
                tables[net] = (Array(wide.ravel()), wide.shape[1], table.shape[1])
            for k in range(4):
                features.append((indices(given["rows"][k::4]), columns(given["weights"][k::4])))
            if coarse is not None:
                which = (indices(given["coarse_rows"]), columns(given["coarse_weights"]))
        elif form == "fused":
            features = [columns(given["texel"][:, k]) for k in range(4)]
        else:
            features = columns(given["texel"].reshape(count, -1))
            which = llvm.UInt32(np.arange(count, dtype=np.uint32) // 4)
        dr.make_opaque(heads, features, which, tables)

        def fetch(net, places, tables=tables, Rows=Rows, quads=quads):
            table, wide, channels = tables[net]
            rows = (
                dr.gather(Rows, table, at, shape=(wide, quads)) * weight for at, weight in zip(*places, strict=True)
            )
            return list(sum(rows, start=Rows(0)))[:channels]

        def run(
            coarse=coarse, fine=fine, heads=heads, features=features, which=which, form=form, Array=Array, fetch=fetch
        ):
            z = heads
            if coarse is not None:
                own = fetch("coarse", which) if form == "fetched" else []
                z = list(coarse(nn.CoopVec(*heads, *own)))
            if form == "split":
                dr.eval(z)
                out = list(fine(nn.CoopVec(*(dr.gather(Array, c, which) for c in z), *features)))
            else:
                inputs = (fetch("fine", own) if form == "fetched" else own for own in features)
                out = [c for own in inputs for c in fine(nn.CoopVec(*z, *own))]
            dr.eval(out)
            return out

        turns = max(1, texels // count)

        def call(run=run, turns=turns):
            for _ in range(turns):
                run()
            dr.sync_thread()

        got = np.stack([np.array(c) for c in run()], 1).reshape(-1, 4, 3)[:CHECKED]
        error = error_of(got, problem.exact(given["quad"][:CHECKED], given["texel"][:CHECKED]))
        yield f"{name} with fetches" if fetches else name, call, error, count * turns


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

    given = problem.inputs(texels // 4)
    quad, texel = (torch.from_numpy(given[name]) for name in ("quad", "texel"))
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
        runs, offers, calls = {}, {}, {}
        for name in NAMES:
            runs[name] = Run(name, texels, device)
            problem = Problem(name)
            found = [
                *drjit_peers(problem, texels, workers),
                *drjit_peers(problem, texels, workers, fetches=True),
                *torch_peers(problem, texels, workers, compiled=compiled),
            ]
            for number, (kind, call, error, done) in enumerate(found):
                offers[name, kind, number] = (error, done)
                calls[name, kind, number] = call
            for n in (1, 3, 9):
                calls[name, n] = functools.partial(runs[name].call, n)
        seconds = least(calls, rounds)
        peers = _fastest({key: (seconds[key] / done, error) for key, (error, done) in offers.items()})
        for name, run in runs.items():
            ours = {n: seconds[name, n] / run.texels for n in (1, 3, 9)}
            cases = {"1": (ours[1], 1), "3": (ours[3], 3), "a further": ((ours[9] - ours[1]) / 8, 1)}
            for (lights, (spent, times)), (design, kind) in itertools.product(cases.items(), peers):
                # A peer would not fetch anew for each light, and a difference that noise made negative says nothing.
                if design != name or ("fetches" in kind and lights != "1") or spent <= 0:
                    continue
                peer, error = times * peers[name, kind][0], peers[name, kind][1]
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


def _fastest(offers: dict[tuple, tuple[float, float]]) -> dict[tuple, tuple[float, float]]:
    """Return the fastest offer of each kind, and what is no plain float32 only where it is faster than that."""
    best: dict[tuple, tuple[float, float]] = {}
    for (name, kind, _), offer in offers.items():
        best[name, kind] = min(best.get((name, kind), offer), offer)
    plain = {key: key[1].replace("float16", "float32").removesuffix(" compiled") for key in best}
    return {key: offer for key, offer in best.items() if offer <= best[key[0], plain[key]]}
