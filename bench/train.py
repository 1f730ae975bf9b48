"""One training step of a BCf material: ours beside plain torch, and where the time goes.

Both sides do the same work on the same cores, in turns, at preset 1k with nine channels: decode all blocks (Eq. 6–9),
sample features (trilinear) and reference (bicubic in two mips), network, mean squared error, all gradients, Adam over
endpoints, positions and weights, clamping. Torch is written as its users would: vectorised decoding, ``grid_sample``,
autograd, fused Adam. It is favoured where the two differ: one scale for the whole batch, as in the paper, so that two
calls a texture do (ours sorts out a scale per 256 samples); clamped borders, which ``grid_sample`` has built in; the
coordinates, which it is given, come in the order of our patches, which is kind to its cache.

``error``: the largest deviation of a gradient from torch in float64, over the largest, of 4,096 samples (texel octaves
and hidden units kept off their kinks, where neither has a gradient). ``mib``: peak memory of three steps in a process
of its own over that of the bare imports; pictures, model and optimiser included, which is most of it.
"""

import json
import math
import os
import subprocess
import sys
import time

import numpy as np

from bench.harness import interleave
from warp_neumat.io.mipmaps import mip_sizes
from warp_neumat.kernels import dispatch
from warp_neumat.kernels.patches import PATCH, SPACING, draw_patches, pad_reference

COLUMNS = [
    "reference", "batch", "workers", "part", "ms", "share", "peer_ms", "ratio", "error", "peer_error", "mib",
    "peer_mib",
]  # fmt: skip

SCALE = 1.5
"""Level of the reference that the batch is sampled at: each feature texture is then met between two of its mips."""

CHANNELS = 9
RATES = {"endpoints": 1e-3, "positions": 1e-2, "net": 1e-3}


class Ours:
    """The step as :class:`warp_neumat.training.block_loop.BlockTrainer` makes it, cut into its parts."""

    def __init__(self, side: int, batch: int, parts: int):
        import torch

        from warp_neumat.ops.bcf import Step
        from warp_neumat.ops.block_texture import BlockJobs

        self.torch, self.number = torch, 0
        self.model, self.mips = _model(side)
        model, config = self.model, self.model.config
        reference = torch.from_numpy(pad_reference(self.mips, config.shape.stride, "clamp"))
        self.step = Step(config.pyramids, config.shape, model.texels, model.net, reference, batch // PATCH, parts)
        gradient = self.step.texel_gradient
        self.jobs = BlockJobs(
            model.endpoints, model.positions, model.shapes, model.modes, model.texels, gradient, config.signed
        )
        self.values = {name: getattr(model, name) for name in RATES}
        self.adam = _adam(self.values)
        self.parts = {
            "draw": self.draw, "decode": self.jobs.decode, "samples": self.samples, "adjoint": self.jobs.adjoint,
            "weights' sum": self.sum, "Adam": self.adam.step, "clamp": lambda: _clamp(self.values),
        }  # fmt: skip
        for part in self.parts.values():
            part()

    def draw(self):
        self.number += 1
        self.patches = _patches(self.number, len(self.step.patches), self.model.config.pyramids)

    def samples(self):
        self.step.run(self.torch.from_numpy(self.patches), self.number * 2654435761)

    def sum(self):
        self.values["net"].grad = self.step.weight_gradient.sum(0)
        self.values["endpoints"].grad = self.jobs.endpoint_gradient
        self.values["positions"].grad = self.jobs.position_gradient

    def __call__(self):
        for part in self.parts.values():
            part()


class Peer:
    """The same step in plain torch; ``dtype`` float64 makes it the judge of both."""

    def __init__(self, model, mips, uv, dtype=None):
        import torch

        self.torch, self.model, dtype = torch, model, dtype or torch.float32
        self.values = {name: getattr(model, name).clone().to(dtype).requires_grad_() for name in RATES}
        self.adam = _adam(self.values)
        self.pictures = [torch.from_numpy(m).to(dtype).permute(2, 0, 1)[None].contiguous() for m in mips]
        self.grid = (2.0 * uv.reshape(1, 1, -1, 2).to(dtype) - 1.0).contiguous()

    def _mix(self, pictures, s: float, mode: str):
        """Return (C, n): two mips, each by one call."""
        from torch.nn.functional import grid_sample

        m = min(int(s), max(len(pictures) - 2, 0))
        value = [
            grid_sample(picture, self.grid, mode=mode, padding_mode="border", align_corners=False)[0, :, 0]
            for picture in pictures[m : m + 2]
        ]
        return value[0] if len(value) == 1 or s == m else (1.0 - (s - m)) * value[0] + (s - m) * value[1]

    def gradients(self):
        """Leave the gradient of the loss in ``values``; return the hidden units before their ReLU."""
        from torch.nn.functional import linear

        from warp_neumat.models.bcf import _images, decode_reference

        torch, config = self.torch, self.model.config
        for value in self.values.values():
            value.grad = None
        texels = decode_reference(self.values["endpoints"], self.values["positions"], self.model.shapes).view(-1, 3)
        offsets = [row[0] for row in config.pyramids.feature_offsets] + [config.pyramids.texel_count]
        features = []
        for t, (mips, bias) in enumerate(zip(config.mips, config.pyramids.biases, strict=True)):
            pictures = _images(texels[offsets[t] : offsets[t + 1]], mips)
            features.append(self._mix(pictures, min(max(SCALE + bias, 0.0), len(mips) - 1.0), "bilinear"))
        with torch.no_grad():
            target = self._mix(self.pictures, SCALE, "bicubic")
        w0, b0, w1, b1 = self.model.layers(self.values["net"])
        hidden = linear(torch.cat(features).T, w0.T, b0)
        output = linear(torch.relu(hidden), w1.T, b1)
        torch.nn.functional.mse_loss(output, target.T).backward()
        return hidden.detach()

    def __call__(self):
        self.gradients()
        self.adam.step()
        _clamp(self.values)


def _model(side: int):
    """Return a model of preset 1k whose blocks lie within one octave, and its reference, noise of all scales."""
    import torch

    from warp_neumat.models.bcf import BCf, BCfConfig, feature_sizes

    names = tuple(
        {"map": f"map_{c}", "component": "value", "encoding": "linear", "range": [0.0, 1.0]} for c in range(CHANNELS)
    )
    config = BCfConfig(feature_sizes(side, side, "1k"), side, side, names, {}, wrap="clamp")
    rng = np.random.default_rng(5)
    mips = [
        rng.random((h, w, CHANNELS), np.float32).astype(np.float16).astype(np.float32) for w, h in mip_sizes(side, side)
    ]
    model = BCf(config, np.full(CHANNELS, 0.5, np.float32), 1)
    generator = torch.Generator().manual_seed(2)
    model.random_blocks(generator)
    # Half bits 14346 … 15350: values from 0.505 to 0.995.
    model.endpoints.copy_((14346.0 + 1004.0 * torch.rand(model.endpoints.shape, generator=generator)) / 31744.0)
    return model, mips


def _adam(values: dict):
    import torch

    groups = [{"params": [value], "lr": RATES[name]} for name, value in values.items()]
    return torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-14, fused=True)


def _clamp(values: dict) -> None:
    for name in ("endpoints", "positions"):
        values[name].detach().clamp_(0.0, 1.0)


def _patches(number: int, count: int, pyramids) -> np.ndarray:
    """Return patches of one scale and weight, drawn as in training."""
    patches = draw_patches(1, number, count, pyramids, aligned=0.0)
    extent = np.minimum(1.0, 16.0 * SPACING * 2.0**SCALE / np.array(pyramids.reference[0]))
    place = patches[:, 2:4] / np.maximum(1.0 - patches[:, 4:6], 1e-6)
    patches[:, :2], patches[:, 2:4], patches[:, 4:6] = (SCALE, 1.0), place.clip(0, 1) * (1.0 - extent), extent
    return patches


def gradient_errors(side: int) -> tuple[float, float]:
    """Return the largest errors of our and of torch's float32 gradients against float64, over the largest value."""
    import torch

    ours = Ours(side, 16 * PATCH, dispatch.worker_count())
    model, mips = _model(side)
    for name, value in ours.values.items():
        value.copy_(getattr(model, name))  # the construction took a step
    for _ in range(64):
        ours.draw()
        ours.jobs.decode()
        ours.samples()
        ours.jobs.adjoint()
        ours.sum()
        judge = Peer(model, mips, ours.step.samples, torch.float64)
        if judge.gradients().abs().min() > 3e-6:
            break
    else:
        raise ValueError("every draw has a hidden unit at its kink")
    peer = Peer(model, mips, ours.step.samples)
    peer.gradients()

    def error(values) -> float:
        pairs = [(values[name].grad.double(), judge.values[name].grad) for name in RATES]
        return max(float((got - exact).abs().max() / exact.abs().max()) for got, exact in pairs)

    return error(ours.values), error(peer.values)


def _resident() -> dict[str, float]:
    """Return the process's memory and its peak [MiB], where the system tells."""
    with open("/proc/self/status", encoding="ascii") as file:
        lines = [line.split() for line in file if line.startswith(("VmHWM", "VmRSS"))]
    return {name.strip(":"): int(kib) / 1024 for name, kib, _ in lines}


def measure_memory(who: str, side: int, batch: int, workers: int) -> float:
    """Return by how much three steps of ``who`` raise this process's peak [MiB]; call in a fresh process."""
    import torch
    import warp as wp

    wp.init()
    dispatch.set_worker_count(workers)
    torch.set_num_threads(workers)
    before = _resident()["VmRSS"]
    if who == "ours":
        step = Ours(side, batch, workers)
    else:
        step = Peer(*_model(side), torch.rand(batch, 2))
    with open("/proc/self/clear_refs", "w", encoding="ascii") as file:
        file.write("5")  # the peak starts anew: making the data is no part of a step
    for _ in range(3):
        step()
    return _resident()["VmHWM"] - before


def _memory_of(who: str, side: int, batch: int, workers: int) -> float | None:
    if not os.path.exists("/proc/self/clear_refs"):  # Linux only
        return None
    code = (
        f"import bench.train, json; print(json.dumps(bench.train.measure_memory({who!r}, {side}, {batch}, {workers})))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def _profile(ours: Ours, rounds: int) -> dict[str, float]:
    """Return the median seconds of each part of our step, in its place between the others."""
    seconds = {name: [] for name in ours.parts}
    for _ in range(rounds):
        for name, part in ours.parts.items():
            start = time.perf_counter()
            part()
            seconds[name].append(time.perf_counter() - start)
    return {name: float(np.median(values)) for name, values in seconds.items()}


def rows(*, device: str, quick: bool):
    """Yield one row for the step and one for each of its parts, for each size and number of workers."""
    import torch
    import warp as wp

    wp.init()
    if not wp.get_device(device).is_cpu:
        raise ValueError(f"training runs on the CPU, got device {device!r}; leave out --device")
    threads = torch.get_num_threads()
    sides, batch, rounds = ((64,), 4096, 2) if quick else ((512, 2048), 65536, 7)
    everyone = dispatch.worker_count()
    try:
        for side in sides:
            error, peer_error = gradient_errors(side)
            for workers in dict.fromkeys((everyone,) if quick else (1, everyone)):
                dispatch.set_worker_count(workers)
                torch.set_num_threads(workers)
                ours = Ours(side, batch, workers)
                peer = Peer(*_model(side), ours.step.samples.clone())
                seconds = interleave({"ours": ours, "peer": peer}, rounds=rounds)
                parts = _profile(ours, 3 * rounds)
                row = {"reference": side, "batch": batch, "workers": workers}
                yield row | {
                    "part": "step",
                    "ms": 1e3 * seconds["ours"],
                    "peer": "torch",
                    "peer_ms": 1e3 * seconds["peer"],
                    "ratio": seconds["peer"] / seconds["ours"],
                    "error": error,
                    "peer_error": peer_error,
                    "mib": None if quick else _memory_of("ours", side, batch, workers),
                    "peer_mib": None if quick else _memory_of("peer", side, batch, workers),
                }
                for name, value in parts.items():
                    yield row | {"part": name, "ms": 1e3 * value, "share": value / math.fsum(parts.values())}
                del ours, peer
    finally:
        dispatch.set_worker_count(None)
        torch.set_num_threads(threads)
