"""NeuBRDF evaluations: ours beside Dr.Jit and torch with the same network, and Mitsuba's `measured` plug-in.

``ms`` is 2¹⁹ evaluations of ``Material.eval`` at random pairs of directions (N = 64, k = 16, b = 9, MLP 32→64→64→3,
random contents: nothing is coherent), from directions to value × cosine; ``full_hd_ms`` is the same for 1920 × 1080.
All run in one process, in turns, on the same number of cores.

- ``drjit`` and ``torch`` evaluate the same network on the same inputs and are spared the geometry: they get the eight
  grid points and corner weights of each pair. Dr.Jit runs its packed cooperative vectors on LLVM as one kernel, torch
  embedding_bag and addmm in the batch size that is fastest here; each in its faster data type, found here first.
- ``measured`` is Mitsuba's plug-in on LLVM with a synthetic RGL file (8 elevations, 32 × 32 entries each); another
  representation, so it has no error column.
  Dr.Jit takes the LLVM that ``DRJIT_LIBLLVM_PATH`` names; with one too old for Mitsuba on x86 that peer is left out.

``error`` is the largest deviation from float64 over 1 + f. ``floor_ms`` is what the multiply-adds alone would take at
the peak measured in the same run, and ``peak_share`` that over ``ms``.
"""

import dataclasses
import itertools
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import warp as wp

from bench.harness import interleave
from bench.mlp import peak_kernel
from warp_neumat.io.asset import pack_bits, unpack_bits
from warp_neumat.io.tensor_file import write_tensors
from warp_neumat.kernels import dispatch
from warp_neumat.materials.neubrdf import NeuBRDF
from warp_neumat.reference.neubrdf import corner_weights, reference_eval, to_local_frame

COLUMNS = [
    "frame", "interpolation", "workers", "ms", "full_hd_ms", "mevals_per_s", "floor_ms", "peak_share", "error",
    "peer", "peer_ms", "ratio", "peer_error",
]  # fmt: skip

SETTINGS = (
    ("absolute", "bilinear"),
    ("isotropic", "bilinear"),
    ("half-isotropic", "bilinear"),
    ("half-isotropic", "idw"),
    ("half-isotropic", "uniform"),
)
"""Frame and interpolation of the rows."""

FULL_HD = 1920 * 1080
NSIDE, FEATURES, BITS, HIDDEN = 64, 16, 9, (64, 64)
LEAST_LLVM = 17  # the first whose x86 back-end has Dr.Jit's minimum and maximum of floats
CHECKED = 4096  # pairs that are compared with float64


def asset(rng, frame: str, interpolation: str) -> tuple[dict, dict]:
    """Return (tensors, header) of a material with random contents and values of order one."""
    points, widths = 6 * NSIDE * NSIDE + 6 * NSIDE + 1, (2 * FEATURES, *HIDDEN, 3)
    tensors = {
        "codebook": rng.normal(size=(1 << BITS, FEATURES)).astype(np.float16),
        "indices": pack_bits(rng.integers(0, 1 << BITS, 2 * points), BITS),
    }
    for n, (i, o) in enumerate(itertools.pairwise(widths)):
        tensors[f"weight{n}"] = (rng.normal(size=(o, i)) * np.sqrt(1.5 / i)).astype(np.float16)
        tensors[f"bias{n}"] = np.full(o, 0.2, np.float16)
    config = {"nside": NSIDE, "features": FEATURES, "bits": BITS, "hidden": list(HIDDEN), "frame": frame}
    config |= {"interpolation": interpolation, "symmetry": "bilateral" if frame == "half-isotropic" else "none"}
    return tensors, {"kind": "neubrdf", "version": 2, "config": config}


def pairs(rng, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` random pairs of directions above the horizon, (count, 3) float32 each."""
    v = rng.normal(size=(2, count, 3))
    v[..., 2] = np.abs(v[..., 2])
    wi, wo = (v / np.linalg.norm(v, axis=2, keepdims=True)).astype(np.float32)
    return wi, wo


@dataclasses.dataclass
class Problem:
    """What the peers get: the network, the grid points and weights of each pair, its cosine, and the answer."""

    tensors: dict
    index: np.ndarray
    corner: np.ndarray
    weight: np.ndarray
    cosine: np.ndarray
    expected: np.ndarray

    @classmethod
    def of(cls, tensors, config, wi, wo):
        """Return the problem of these pairs."""
        points = 6 * NSIDE * NSIDE + 6 * NSIDE + 1
        found = [corner_weights(NSIDE, d, "bilinear") for d in to_local_frame(wi, wo, config["frame"])]
        corner = np.concatenate([found[0][0], found[1][0] + points], 1).astype(np.int32)
        weight = np.concatenate([found[0][1], found[1][1]], 1).astype(np.float32)
        expected = reference_eval(tensors, config, wi[:CHECKED], wo[:CHECKED]) * wi[:CHECKED, 2:]
        index = unpack_bits(tensors["indices"], BITS, 2 * points)
        return cls(tensors, index, corner, weight, wi[:, 2].copy(), expected)

    def error(self, got) -> float:
        """Return the largest deviation of the first values from float64, over 1 + f."""
        got = np.asarray(got, np.float64)[:CHECKED]
        return float((np.abs(got - self.expected) / (1 + self.expected)).max())


def drjit_peers(problem: Problem):
    """Yield (name, call, error) for Dr.Jit: gathers, weighted sums, packed network and output in one LLVM kernel."""
    import drjit as dr
    from drjit import llvm, nn

    for name, Tensor, Array, Array2, scalar in (
        ("drjit float32", llvm.TensorXf, llvm.Float, llvm.ArrayXf, np.float32),
        ("drjit float16", llvm.TensorXf16, llvm.Float16, llvm.ArrayXf16, np.float16),
    ):
        layers = [nn.Linear(i, o) for i, o in itertools.pairwise((2 * FEATURES, *HIDDEN, 3))]
        chain = [part for layer in layers[:-1] for part in (layer, nn.ReLU())] + layers[-1:]
        net = nn.Sequential(*chain).alloc(Tensor, 2 * FEATURES)
        for n, layer in enumerate(net.layers[::2]):
            layer.weights = Tensor(problem.tensors[f"weight{n}"].astype(scalar))
            layer.bias = Tensor(problem.tensors[f"bias{n}"].astype(scalar))
        packed = nn.pack(net, layout="inference")
        codebook = Array(problem.tensors["codebook"].astype(scalar).ravel())
        index = llvm.UInt32(problem.index.astype(np.uint32))
        corner = [llvm.UInt32(np.ascontiguousarray(c).astype(np.uint32)) for c in problem.corner.T]
        weight = [Array(np.ascontiguousarray(w).astype(scalar)) for w in problem.weight.T]
        cosine = llvm.Float(problem.cosine)
        dr.make_opaque(codebook, index, corner, weight, cosine)

        def run(packed=packed, codebook=codebook, index=index, corner=corner, weight=weight, cosine=cosine, A=Array2):
            inputs = []
            for side in range(2):
                rows = 0
                for q in range(4 * side, 4 * side + 4):
                    word = dr.gather(llvm.UInt32, index, corner[q])
                    rows = rows + dr.gather(A, codebook, word, shape=(FEATURES, len(cosine))) * weight[q]
                inputs += list(rows)
            y = [llvm.Float(c) for c in packed(nn.CoopVec(*inputs))]
            # Not dr.maximum: older LLVM versions have no code for it at this width.
            out = [dr.select(c > 0, dr.exp(c) - 1, 0) * cosine for c in y]
            dr.eval(out)
            return out

        def call(run=run):
            run()
            dr.sync_thread()

        yield name, call, problem.error(np.stack([np.array(c) for c in run()], 1))


def torch_peers(problem: Problem):
    """Yield (name, call, error) for torch in two data types and two batch sizes."""
    import torch
    from torch.nn.functional import embedding_bag

    for dtype, batch in itertools.product((torch.float32, torch.bfloat16), (1 << 12, 1 << 15)):
        layers = [
            (torch.tensor(problem.tensors[f"weight{n}"]).to(dtype).t().contiguous(),
             torch.tensor(problem.tensors[f"bias{n}"]).to(dtype))
            for n in range(len(HIDDEN) + 1)
        ]  # fmt: skip
        codebook = torch.tensor(problem.tensors["codebook"]).to(dtype)
        index, weight = torch.from_numpy(problem.index), torch.from_numpy(problem.weight).to(dtype)
        corner, cosine = torch.from_numpy(problem.corner), torch.from_numpy(problem.cosine)[:, None]
        result = torch.empty(len(cosine), 3)

        def call(
            layers=layers, codebook=codebook, index=index, weight=weight, corner=corner, cosine=cosine, batch=batch,
            result=result,
        ):  # fmt: skip
            with torch.inference_mode():
                for part in (slice(at, at + batch) for at in range(0, len(cosine), batch)):
                    word = index[corner[part]].view(-1, 4)
                    bags = embedding_bag(word, codebook, mode="sum", per_sample_weights=weight[part].view(-1, 4))
                    h = bags.view(-1, 2 * FEATURES)
                    for w, b in layers[:-1]:
                        h = torch.addmm(b, h, w).relu_()
                    y = torch.addmm(layers[-1][1], h, layers[-1][0]).float()
                    result[part] = torch.expm1(y).clamp_(min=0) * cosine[part]

        call()
        yield f"torch {str(dtype).removeprefix('torch.')}", call, problem.error(result)


def rgl_file(path: Path) -> Path:
    """Write a small isotropic RGL file: a rough metal's table sizes with smooth contents."""
    angles, size = 8, 32
    x, y = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size))
    theta = np.linspace(0, np.pi / 2 * 0.99, angles)
    lobe = np.exp(-8 * (x**2)).astype(np.float32)
    visible = np.stack([0.05 + np.exp(-20 * (x - 0.4 * t) ** 2 - 4 * (y - 0.5) ** 2) for t in theta])[None]
    rgb = 0.2 + np.stack([np.stack([visible[0, t] * c for c in (0.9, 0.6, 0.3)]) for t in range(angles)])[None]
    return write_tensors(
        path,
        {
            "description": "synthetic",
            "theta_i": theta.astype(np.float32),
            "phi_i": np.zeros(1, np.float32),
            "ndf": lobe,
            "sigma": np.maximum(np.cos(x * x * np.pi / 2), 0.05).astype(np.float32),
            "vndf": visible.astype(np.float32),
            "luminance": visible.astype(np.float32),
            "rgb": rgb.astype(np.float32),
            "jacobian": np.array([1], np.uint8),
        },
    )


def mitsuba_peer(wi: np.ndarray, wo: np.ndarray, folder: Path):
    """Yield (name, call, None) for Mitsuba's `measured` on LLVM; nothing where that cannot run, and why on stderr."""
    import drjit as dr

    try:
        import mitsuba as mi
    except ImportError:
        print("no Mitsuba, so no measured: pip install mitsuba", file=sys.stderr)
        return
    if dr.detail.llvm_version()[0] < LEAST_LLVM:  # it would end the process
        text = ".".join(map(str, dr.detail.llvm_version()))
        print(
            f"no measured: Mitsuba needs LLVM {LEAST_LLVM} here, Dr.Jit found {text}; set DRJIT_LIBLLVM_PATH to a newer"
            " libLLVM.so",
            file=sys.stderr,
        )
        return

    mi.set_variant("llvm_ad_rgb")
    bsdf = mi.load_dict({"type": "measured", "filename": str(rgl_file(folder / "synthetic.bsdf"))})
    si = dr.zeros(mi.SurfaceInteraction3f, len(wi))
    si.wi, light = mi.Vector3f(np.ascontiguousarray(wo.T)), mi.Vector3f(np.ascontiguousarray(wi.T))
    dr.make_opaque(si, light)
    context = mi.BSDFContext()

    def call():
        value = bsdf.eval(context, si, light)
        dr.eval(value)
        dr.sync_thread()
        return value

    if not np.isfinite(np.array(call())).all():
        raise ValueError("Mitsuba's measured gave values that are not finite; the synthetic file is wrong")
    yield "mitsuba measured", call, None


def fastest(peers) -> dict[str, tuple]:
    """Return the fastest of the offers as {name: (call, error)}."""
    best = None
    for name, call, error in peers:
        spent = []
        for _ in range(3):  # the first warms up
            start = time.perf_counter()
            call()
            spent.append(time.perf_counter() - start)
        if best is None or min(spent) < best[0]:
            best = (min(spent), name, call, error)
    return {best[1]: best[2:]} if best else {}


def rows(*, device: str, quick: bool):
    """Yield one row for each setting, number of cores and peer."""
    import drjit as dr
    import torch

    if not wp.get_device(device).is_cpu:
        raise ValueError(f"this bench compares CPU cores; device must be cpu, got {device}")
    count, turns = (1 << 14, 100_000) if quick else (1 << 19, 1_000_000)
    rng = np.random.default_rng(5)
    wi, wo = pairs(rng, count)
    materials, errors = {}, {}
    for setting in SETTINGS:
        tensors, header = asset(rng, *setting)
        materials[setting] = NeuBRDF(tensors, header, device=device)
        expected = reference_eval(tensors, header["config"], wi[:CHECKED], wo[:CHECKED]) * wi[:CHECKED, 2:]
        got = materials[setting].eval(None, wi[:CHECKED], wo[:CHECKED])
        errors[setting] = float((np.abs(got - expected) / (1 + expected)).max())
        if setting == SETTINGS[1]:
            problem = Problem.of(tensors, header["config"], wi, wo)
    everyone, threads = dispatch.worker_count(), torch.get_num_threads()
    try:
        with tempfile.TemporaryDirectory() as folder:
            for workers in [1] if quick else sorted({1, everyone}):
                dispatch.set_worker_count(workers)
                torch.set_num_threads(workers)
                dr.set_thread_count(workers)
                peers = fastest(drjit_peers(problem)) | fastest(torch_peers(problem))
                peers |= fastest(mitsuba_peer(wi, wo, Path(folder)))
                # One row per worker: two that share a cache line would slow each other.
                sums = wp.zeros((workers, 16), dtype=wp.float32, device="cpu")
                inputs = [wp.array([0.5, 1.0], dtype=wp.float32, device="cpu"), sums, turns]
                peak_job = dispatch.Job(peak_kernel, workers, inputs=inputs, device="cpu", grain=1)
                calls = {s: (lambda m=m: m.eval(None, wi, wo)) for s, m in materials.items()}
                seconds = interleave(
                    {**calls, "peak": peak_job.run, **{n: p[0] for n, p in peers.items()}}, rounds=3 if quick else 5
                )
                peak = float(sums.numpy()[:, 1].sum()) / seconds["peak"]
                for setting, (peer, (_, peer_error)) in itertools.product(SETTINGS, peers.items()):
                    layout = materials[setting].layout
                    # Both sides' rows are summed for every pair, whatever is kept per view elsewhere.
                    floor = dataclasses.replace(layout, frame="half").flops * count / peak
                    yield {
                        "frame": setting[0],
                        "interpolation": setting[1],
                        "workers": workers,
                        "evaluations": count,
                        "ms": 1e3 * seconds[setting],
                        "full_hd_ms": 1e3 * seconds[setting] * FULL_HD / count,
                        "mevals_per_s": count / seconds[setting] / 1e6,
                        "peak_gflops": peak / 1e9,
                        "floor_ms": 1e3 * floor,
                        "peak_share": floor / seconds[setting],
                        "error": errors[setting],
                        "peer": peer,
                        "peer_ms": 1e3 * seconds[peer],
                        "ratio": seconds[peer] / seconds[setting],
                        **({} if peer_error is None else {"peer_error": peer_error}),
                    }
    finally:
        dispatch.set_worker_count(None)
        torch.set_num_threads(threads)
        dr.set_thread_count(everyone)
