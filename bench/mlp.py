"""Small networks: ours beside Dr.Jit's LLVM MLP and torch, and the measured peak of fused multiply-adds.

All run in one process, in turns, on the same number of cores. ``cache``: inputs and outputs stay in the second-level
cache, so arithmetic decides; ``stream``: 2²⁰ evaluations go through memory, so bytes do. Each peer is given its best
batch size and data type, found here first. ``pair`` is MobileVR's coarse network (23→8→8→8→8) followed by
its fine one (24→8→8→8→3), with the coarse outputs among its inputs. ``error`` is the largest deviation from float64
over the largest output. A GFLOP counts two operations per weight.
"""

import itertools
import time

import numpy as np
import warp as wp

from bench.harness import interleave
from warp_neumat.kernels import dispatch
from warp_neumat.kernels.mlp import MLPShape, make_mlp, pack
from warp_neumat.reference.mlp import mlp as reference_mlp

COLUMNS = [
    "network", "data", "workers", "mevals_per_s", "gflops", "peak_share", "error",
    "peer", "peer_mevals_per_s", "ratio", "peer_error",
]  # fmt: skip

NETWORKS = {
    "12-16-9": (MLPShape(12, 16, 9),),
    "pair": (MLPShape(23, 8, 8, 8, 8), MLPShape(24, 8, 8, 8, 3)),
    "40-64-64-3": (MLPShape(40, 64, 64, 3),),
}

_PEAK = """
#if defined(__AVX512F__)
typedef float V __attribute__((vector_size(64)));
#elif defined(__AVX__)
typedef float V __attribute__((vector_size(32)));
#else
typedef float V __attribute__((vector_size(16)));
#endif
V m = {}, c = {}; m += x.data[0]; c += x.data[1];
V a0 = c, a1 = c, a2 = c, a3 = c, a4 = c, a5 = c, a6 = c, a7 = c, a8 = c, a9 = c, a10 = c, a11 = c;
for (int i = 0; i < turns; ++i) {
    a0 = a0 * m + c; a1 = a1 * m + c; a2 = a2 * m + c; a3 = a3 * m + c; a4 = a4 * m + c; a5 = a5 * m + c;
    a6 = a6 * m + c; a7 = a7 * m + c; a8 = a8 * m + c; a9 = a9 * m + c; a10 = a10 * m + c; a11 = a11 * m + c;
}
V s = a0 + a1 + a2 + a3 + a4 + a5 + a6 + a7 + a8 + a9 + a10 + a11;
y.data[0] = s[0]; y.data[1] = 24.0f * sizeof(V) / 4 * turns;
"""


@wp.func_native(_PEAK)
def _peak(x: wp.array(dtype=wp.float32), y: wp.array(dtype=wp.float32), turns: int): ...


@wp.kernel(module="unique", module_options=dispatch.module_options())
def peak_kernel(first: int, x: wp.array(dtype=wp.float32), ys: wp.array2d(dtype=wp.float32), turns: int):
    """Twelve independent chains of fused multiply-adds in registers."""
    _peak(x, ys[first + wp.tid()], turns)


class Problem:
    """One network or pair with random weights, inputs, and its float64 answer for the first inputs."""

    def __init__(self, shapes: tuple[MLPShape, ...], seed: int = 3):
        rng = np.random.default_rng(seed)
        self.shapes = shapes
        self.weights = [
            [(rng.normal(size=(o, i)) * np.sqrt(2 / i)).astype(np.float16).astype(np.float32) for i, o in s.layers]
            for s in shapes
        ]
        self.biases = [[np.float32(np.float16(0.1)) * np.ones(o, np.float32) for _, o in s.layers] for s in shapes]
        # A pair reads the coarse network's inputs and then the fine one's, whose last ones are the coarse outputs.
        self.inputs = sum(s.inputs for s in shapes)
        self.own = shapes[0].inputs + shapes[-1].inputs - shapes[0].outputs if len(shapes) > 1 else self.inputs
        self.flops = sum(s.flops for s in shapes)
        self._rng = rng

    def rows(self, count: int) -> np.ndarray:
        """Return ``count`` inputs, shape [count, own]."""
        return self._rng.normal(size=(count, self.own)).astype(np.float32)

    def exact(self, x: np.ndarray) -> np.ndarray:
        """Return the outputs in float64."""
        cut = self.shapes[0].inputs
        y = reference_mlp(x[:, :cut], self.weights[0], self.biases[0])
        if len(self.shapes) == 1:
            return y
        return reference_mlp(np.concatenate([x[:, cut:], y], axis=1), self.weights[1], self.biases[1])


def error_of(got, expected) -> float:
    """Return the largest deviation over the largest value."""
    return float(np.abs(np.asarray(got, np.float64) - expected).max() / np.abs(expected).max())


def ours(problem: Problem, data_rows: int, evaluations: int, device):
    """Return (call, error) for our kernel: ``data_rows`` different inputs, read until ``evaluations`` are done."""
    lanes = dispatch.lanes(device)
    shapes = problem.shapes
    inputs, outputs, cut, own = problem.inputs, shapes[-1].outputs, shapes[0].inputs, problem.own
    paired, head, tail = len(shapes) > 1, make_mlp(shapes[0], lanes), make_mlp(shapes[-1], lanes)
    latent, fine_inputs = shapes[0].outputs, shapes[-1].inputs
    L = lanes
    FLOAT = wp.constant(wp.uint64(4))

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def chain_kernel(
        first: int,
        xs: wp.array(dtype=wp.float32),
        w0: wp.array(dtype=wp.float32),
        w1: wp.array(dtype=wp.float32),
        modulus: int,
        ys: wp.array(dtype=wp.float32),
    ):
        b = (first + wp.tid()) % modulus
        at = xs.ptr + wp.uint64(b) * wp.uint64(inputs * L) * FLOAT
        X = wp.array(ptr=at, shape=(cut * L,), dtype=wp.float32)
        Y = wp.array(ptr=ys.ptr + wp.uint64(b) * wp.uint64(outputs * L) * FLOAT, shape=(outputs * L,), dtype=wp.float32)
        if wp.static(paired):
            Z = wp.array(ptr=at + wp.uint64(own * L) * FLOAT, shape=(latent * L,), dtype=wp.float32)
            F = wp.array(ptr=at + wp.uint64(cut * L) * FLOAT, shape=(fine_inputs * L,), dtype=wp.float32)
            head(X, w0, Z)
            tail(F, w1, Y)
        else:
            head(X, w0, Y)

    x = problem.rows(data_rows)
    blocks = data_rows // lanes
    laid = np.zeros((blocks, inputs, lanes), np.float32)
    laid[:, :own] = x.reshape(blocks, lanes, own).transpose(0, 2, 1)
    packed = [wp.array(pack(w, b), device=device) for w, b in zip(problem.weights, problem.biases, strict=True)]
    result = wp.zeros((blocks, outputs, lanes), dtype=wp.float32, device=device)
    job = dispatch.Job(
        chain_kernel,
        evaluations // lanes,
        inputs=[wp.array(laid.ravel(), device=device), packed[0], packed[-1], blocks],
        outputs=[result.flatten()],
        device=device,
    )

    def call():
        job.run()
        wp.synchronize_device(device)

    call()
    got = result.numpy().transpose(0, 2, 1).reshape(-1, outputs)[:4096]
    return call, error_of(got, problem.exact(x[:4096]))


def torch_peers(problem: Problem, data_rows: int, evaluations: int, workers: int):
    """Yield (name, call, error, evaluations) for torch in its data types and two batch sizes."""
    import torch

    torch.set_num_threads(workers)
    cut, paired = problem.shapes[0].inputs, len(problem.shapes) > 1
    for name, batch in itertools.product(("float32", "bfloat16", "float16"), {min(4096, data_rows), data_rows}):
        dtype = getattr(torch, name)
        layers = [
            [
                (torch.tensor(w, dtype=dtype).t().contiguous(), torch.tensor(b, dtype=dtype))
                for w, b in zip(ws, bs, strict=True)
            ]
            for ws, bs in zip(problem.weights, problem.biases, strict=True)
        ]
        x = torch.from_numpy(problem.rows(data_rows))
        parts = [part.to(dtype).contiguous() for part in x.split(batch)]

        def chain(h, net):
            for w, b in net[:-1]:
                h = torch.addmm(b, h, w).relu_()
            return torch.addmm(net[-1][1], h, net[-1][0])

        def network(h, layers=layers):
            if not paired:
                return chain(h, layers[0])
            return chain(torch.cat([h[:, cut:], chain(h[:, :cut], layers[0])], dim=1), layers[1])

        turns = max(1, evaluations // data_rows)

        def call(parts=parts, network=network, turns=turns):
            with torch.inference_mode():
                for _ in range(turns):
                    for part in parts:
                        network(part)

        with torch.inference_mode():
            got = network(parts[0][:4096]).float().numpy()
        yield f"torch {name}", call, error_of(got, problem.exact(x.numpy()[: len(got)])), data_rows * turns


def drjit_peers(problem: Problem, data_rows: int, evaluations: int, workers: int):
    """Yield (name, call, error, evaluations) for Dr.Jit's packed networks on LLVM, in two types and widths."""
    import drjit as dr
    from drjit import nn
    from drjit.llvm import Float, Float16, TensorXf, TensorXf16

    dr.set_thread_count(workers)
    cut, paired = problem.shapes[0].inputs, len(problem.shapes) > 1
    # A launch costs it tens of microseconds, so wide launches are tried beside the cached size.
    for (name, Tensor, Array, scalar), width in itertools.product(
        (("float32", TensorXf, Float, np.float32), ("float16", TensorXf16, Float16, np.float16)),
        {data_rows, max(data_rows, 1 << 18)},
    ):
        nets = []
        for shape, ws, bs in zip(problem.shapes, problem.weights, problem.biases, strict=True):
            linear = [nn.Linear(i, o) for i, o in shape.layers]
            chain = [part for layer in linear[:-1] for part in (layer, nn.ReLU())] + linear[-1:]
            net = nn.Sequential(*chain).alloc(Tensor, shape.inputs)
            for layer, w, b in zip(net.layers[::2], ws, bs, strict=True):
                layer.weights, layer.bias = Tensor(w.astype(scalar)), Tensor(b.astype(scalar))
            nets.append(nn.pack(net, layout="inference"))
        x = problem.rows(width)
        columns = [Array(np.ascontiguousarray(x[:, k].astype(scalar))) for k in range(problem.own)]
        dr.make_opaque(columns)

        def run(columns=columns, nets=nets):
            y = nets[0](nn.CoopVec(*columns[:cut]))
            if paired:
                y = nets[1](nn.CoopVec(*columns[cut:], *list(y)))
            out = list(y)
            dr.eval(out)
            return out

        turns = max(1, evaluations // width)

        def call(run=run, turns=turns):
            for _ in range(turns):
                run()
            dr.sync_thread()

        got = np.stack([np.array(c) for c in run()], axis=1)[:4096]
        yield f"drjit {name}", call, error_of(got, problem.exact(x[:4096])), width * turns


def fastest(peers) -> dict[str, tuple]:
    """Return the fastest of the offers as {name: (call, error, evaluations of a call)}."""
    best = None
    for name, call, error, done in peers:
        spent = min(_seconds(call) for _ in range(3)) / done  # the first of the three warms up
        if best is None or spent < best[0]:
            best = (spent, name, call, error, done)
    return {best[1]: best[2:]}


def _seconds(call) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def rows(*, device: str, quick: bool):
    """Yield one row per network, place of the data, number of workers and peer."""
    import torch

    if not wp.get_device(device).is_cpu:
        raise ValueError(f"this bench compares CPU cores; device must be cpu, got {device}")
    turns = 200_000 if quick else 2_000_000
    rounds = 3 if quick else 15
    everyone = dispatch.worker_count()
    threads = torch.get_num_threads()
    try:
        for (name, shapes), data, workers in itertools.product(
            NETWORKS.items(), ("cache", "stream"), sorted({1, everyone})
        ):
            if quick and (data == "stream" or workers != 1):
                continue
            dispatch.set_worker_count(workers)
            problem = Problem(shapes)
            evaluations = 1 << (15 if quick else 20 if shapes[0].inputs < 30 else 18)
            data_rows = 2048 if data == "cache" else evaluations
            call, error = ours(problem, data_rows, evaluations, device)
            peers = fastest(drjit_peers(problem, data_rows, evaluations, workers))
            peers |= fastest(torch_peers(problem, data_rows, evaluations, workers))
            # One row per worker: two that share a cache line would slow each other.
            sums = wp.zeros((workers, 16), dtype=wp.float32, device="cpu")
            peak_job = dispatch.Job(
                peak_kernel,
                workers,
                inputs=[wp.array([0.5, 1.0], dtype=wp.float32, device="cpu"), sums, turns],
                device="cpu",
                grain=1,
            )
            seconds = interleave(
                {"ours": call, "peak": peak_job.run, **{n: p[0] for n, p in peers.items()}}, rounds=rounds
            )
            peak = float(sums.numpy()[:, 1].sum()) / seconds["peak"]
            rate = evaluations / seconds["ours"]
            for peer, (_, peer_error, done) in sorted(peers.items(), key=lambda item: seconds[item[0]] / item[1][2]):
                yield {
                    "network": name,
                    "data": data,
                    "workers": workers,
                    "ms": 1e3 * seconds["ours"],
                    "mevals_per_s": rate / 1e6,
                    "gflops": rate * problem.flops / 1e9,
                    "peak_gflops": peak / 1e9,
                    "peak_share": rate * problem.flops / peak,
                    "error": error,
                    "peer": peer,
                    "peer_ms": 1e3 * seconds[peer],
                    "peer_mevals_per_s": done / seconds[peer] / 1e6,
                    "ratio": rate / (done / seconds[peer]),
                    "peer_error": peer_error,
                }
    finally:
        dispatch.set_worker_count(None)
        torch.set_num_threads(threads)
