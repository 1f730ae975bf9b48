"""Training of a BCf material: warm-up, blocks, quantisation, network (paper [bcf], §5–6 and past it).

1. ``free``: texels move freely, the network with them (the paper's warm-up).
2. ``blocks``: texels are encoded, which chooses partitions, and the endpoints and positions of the blocks are trained
   as continuous values. With ``repartition`` they are set free (``released``) and encoded anew now and then.
3. ``quantised``: one texture after another is encoded as real BC6H blocks and frozen, and everything that is still
   continuous is trained on to make up for it. The paper quantises all at once; rounding errors of one texture are then
   nobody's to correct. Every encoding weighs a texel by how much the outputs care for it.
4. ``network``: the blocks are packed, bit for bit what was trained, and the network is tuned to them, with its weights
   rounded to float16, as they are stored.

Every random draw is a function of (seed, step): the same seed gives the same file on one machine with the same number
of threads, and a resumed run goes on exactly as if it had never stopped.
"""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path

import numpy as np
import torch

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.bc6h import bc6h_decode
from warp_neumat.kernels.patches import PATCH, draw_patches, pad_reference
from warp_neumat.models.bcf import BCf
from warp_neumat.ops.bcf import Step
from warp_neumat.ops.block_texture import BlockJobs
from warp_neumat.training import checkpoint

MOST_PARTS = 8
"""Gradient buffers at most: each costs the memory of the texels, and their sum the time to read them."""


PROBES = 32
"""Random probes that an estimate of the texels' sensitivity averages."""


@dataclasses.dataclass(frozen=True)
class Stage:
    """A stretch of training: what moves, how fast, and what is done before its first step."""

    name: str
    share: float
    """Of all steps."""
    rates: dict
    """Learning rate at begin and end, by buffer of the model."""
    begin: str = ""
    """What happens first: ``encode``, ``random``, ``quantise``, ``freeze`` or nothing."""
    texture: int | None = None
    """Which texture is quantised; None for all."""


def stages(config) -> list[Stage]:
    """Return the stages of a fit; their shares sum to 1."""
    free, blocks, quantised, network = 0.2, 0.35, 0.4, 0.05
    result = []
    if config.warmup:
        result.append(Stage("free", free, {"texels": (2e-2, 2e-3), "net": (5e-3, 1e-3)}))
    else:
        blocks += free
    if config.quantisation == "once":
        blocks, quantised = blocks + quantised, 0.0

    parts = config.repartition + 1
    for part in range(parts):
        first, last = 0.1 ** (part / parts), 0.1 ** ((part + 1) / parts)
        share, begin = blocks / parts, "encode" if config.warmup else "random"
        if part:
            released = {"texels": (3e-3 * first, 1e-3 * first), "net": (1e-3, 1e-3)}
            result.append(Stage("released", 0.25 * share, released))
            share, begin = 0.75 * share, "encode"
        highest = {"endpoints": 3e-3, "positions": 3e-2, "net": 2e-3}
        rates = {name: (rate * first, rate * last) for name, rate in highest.items()}
        result.append(Stage("blocks", share, rates, begin))

    if config.quantisation == "straight-through":
        rates = {"endpoints": (3e-5, 3e-6), "positions": (1e-3, 1e-4), "net": (1e-3, 1e-4)}
        result.append(Stage("quantised", quantised, rates, "quantise"))
    if config.quantisation == "sequential":
        count = len(config.features)
        for texture in range(count):
            rates = {"endpoints": (1e-3, 1e-4), "positions": (1e-2, 1e-3), "net": (1e-3, 3e-4)}
            if texture == count - 1:  # nothing is continuous any more
                rates = {"net": (1e-3, 3e-4)}
            result.append(Stage("quantised", quantised / count, rates, "quantise", texture))
    result.append(Stage("network", network, {"net": (5e-4, 2e-5)}, "freeze"))
    return result


class BlockTrainer:
    """Trains a :class:`warp_neumat.models.bcf.BCf` on the mips of a material.

    Args:
        model: The model; its buffers are trained in place.
        mips: Reference pictures (h, w, C) float32 by mip.
        plan: Length, batch (a multiple of 256) and seed; see :class:`warp_neumat.training.loop.Plan`.
        checkpoint_path: File to save progress to, or None.
        identity: JSON-able facts that a checkpoint must share with the run that resumes it.
        progress: ``progress(fraction, text)``, called several times a second at most.
        watch: ``watch(stage name, step)``, called every 250 steps, for measurements.
    """

    def __init__(self, model: BCf, mips, plan, *, checkpoint_path=None, identity=None, progress=None, watch=None):
        self.model, self.plan, self.config, self.mips = model, plan, model.config, mips
        self.progress, self.watch = progress or (lambda fraction, text: None), watch
        self.checkpoint = None if checkpoint_path is None else Path(checkpoint_path)
        self.identity = identity or {}
        self.stages = stages(self.config)
        self.packed: np.ndarray | None = None
        self.last_loss = math.nan
        self._stage = self._step = self._count = 0
        self._elapsed = {"total": 0.0, "stage": 0.0}
        self._pending = self._frozen = None
        pyramids, shape = self.config.pyramids, self.config.shape
        device = model.texels.device
        self._parts = min(MOST_PARTS, dispatch.worker_count()) if device.type == "cpu" else 1
        reference = torch.from_numpy(pad_reference(mips, shape.stride, self.config.wrap)).to(device)
        self.channel_weight = torch.from_numpy(channel_weights(mips[0], self.config.channel_weights)).to(device)
        self._net = model.net.clone()  # what the kernel reads: rounded in the last stage
        patches = max(1, plan.batch // PATCH)
        self.step = Step(pyramids, shape, model.texels, self._net, reference, patches, self._parts, self.channel_weight)
        self._blocks = BlockJobs(
            model.endpoints, model.positions, model.shapes, model.modes, model.texels, self.step.texel_gradient,
            self.config.signed,
        )  # fmt: skip

    # --- run ---

    def run(self) -> dict:
        """Train all stages that are left; return training facts."""
        self._last_tick = self._last_save = time.monotonic()
        while self._stage < len(self.stages):
            self._run_stage(self.stages[self._stage])
            self._stage, self._step = self._stage + 1, 0
            self._elapsed["stage"] = 0.0
        model = self.model
        model.net.copy_(model.net.half().float())
        decoded = bc6h_decode(self.packed, self.config.signed).reshape(-1, 3).astype(np.float32)
        if not np.array_equal(decoded, model.texels[:, :3].cpu().numpy()):
            raise RuntimeError("the packed blocks do not decode to the trained features; please report this")
        return {
            "seconds": round(self._elapsed["total"], 2),
            "steps": self._count,
            "batch": self.plan.batch,
            "seed": self.plan.seed,
            "threads": self._parts,
            "budget_seconds": self.plan.budget_seconds,
            "loss": self.last_loss,
        }

    def _run_stage(self, stage: Stage) -> None:
        model = self.model
        if self._step == 0 and self._pending is None:
            self._begin(stage)
        elif stage.begin == "freeze":
            self.packed = model.blocks()
        real = model.modes > 0
        self._frozen = real if self.config.quantisation == "sequential" and bool(real.any()) else None
        values = {name: getattr(model, name) for name in stage.rates}
        groups = [{"params": [value], "lr": stage.rates[name][0]} for name, value in values.items()]
        parameters = list(values.values())
        optimiser = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-14, fused=True)
        if self._pending is not None:
            checkpoint.restore_optimiser(optimiser, parameters, self._pending)
            self._pending = None
        while (position := self._position(stage)) < 1.0:
            self._save_if_due(optimiser, parameters)
            for group, (high, low) in zip(optimiser.param_groups, stage.rates.values(), strict=True):
                group["lr"] = high * (low / high) ** position
            self._gradients(stage)
            for name, value in values.items():
                value.grad = self._gradient(name)
            optimiser.step()
            self._bound(values)
            self._step, self._count = self._step + 1, self._count + 1
            if self._count % 50 == 0 or self._step == 1:
                self.last_loss = float(self.step.losses.mean())
                if not math.isfinite(self.last_loss):
                    raise FloatingPointError(f"the fit diverged in stage {stage.name}; try another seed")
                self._report(stage, f"{stage.name}: {-10 * math.log10(max(self.last_loss, 1e-12)):.2f} dB")
            if self.watch and self._count % 250 == 0:
                self.watch(stage.name, self._count)
        for value in parameters:
            value.grad = None
        if "endpoints" in stage.rates:
            self._blocks.decode()
        self._tick()

    def _begin(self, stage: Stage) -> None:
        model = self.model
        if stage.begin == "encode":
            self._report(stage, f"{stage.name}: choosing modes and partitions")
            model.encode(self.config.modes, self.sensitivity())
            model.modes.zero_()
            self._blocks.decode()
        elif stage.begin == "quantise":
            part = (0, len(model.modes)) if stage.texture is None else model.block_range(stage.texture)
            self._report(stage, f"{stage.name}: choosing modes and partitions")
            model.encode(self.config.modes, self.sensitivity(), part)
            self._blocks.decode()
        elif stage.begin == "random":
            model.random_blocks(torch.Generator().manual_seed(self.plan.seed))
            self._blocks.decode()
        elif stage.begin == "freeze":
            if self.config.quantisation == "once":
                model.encode(self.config.modes, self.sensitivity())
            self.packed = model.blocks()
            self._blocks.decode()

    def sensitivity(self) -> torch.Tensor | None:
        """Return how much the loss cares for each texel, (P, 4): the diagonal of JᵀJ from :data:`PROBES` probes."""
        if not self.config.sensitivity:
            return None
        self._net.copy_(self.model.net)
        total = torch.zeros_like(self.model.texels)
        for number in range(PROBES):
            key = ((self._count + 1) * 40503 + number * 2654435761) & 0x7FFFFFFF
            self.step.run(self._patches(1_000_000_000 + self._count * PROBES + number), key, probe=True)
            total += self.step.texel_gradient.sum(0).square_()
        return total / PROBES

    def _patches(self, number: int) -> torch.Tensor:
        config = self.config
        return torch.from_numpy(
            draw_patches(
                self.plan.seed,
                number,
                len(self.step.patches),
                config.pyramids,
                decay=config.mip_decay,
                aligned=config.aligned,
            )  # fmt: skip
        )

    def _gradients(self, stage: Stage) -> None:
        model = self.model
        if "endpoints" in stage.rates:
            self._blocks.decode()
        self._net.copy_(model.net.half() if stage.begin == "freeze" else model.net)
        key = (self._count * 2654435761 + self.plan.seed * 40503) & 0x7FFFFFFF
        self.step.run(self._patches(self._count), key)
        if "endpoints" in stage.rates:
            self._blocks.adjoint()

    def _gradient(self, name: str) -> torch.Tensor:
        if name in ("endpoints", "positions"):
            gradient = self._blocks.endpoint_gradient if name == "endpoints" else self._blocks.position_gradient
            if self._frozen is not None:
                gradient[self._frozen] = 0.0
            return gradient
        parts = self.step.texel_gradient if name == "texels" else self.step.weight_gradient
        return parts[0] if len(parts) == 1 else parts.sum(0)

    def _bound(self, values: dict) -> None:
        if "texels" in values:
            low, high = self.config.feature_range
            values["texels"].clamp_(low, high)
        if "endpoints" in values:
            values["endpoints"].clamp_(-1.0 if self.config.signed else 0.0, 1.0)
            values["positions"].clamp_(0.0, 1.0)

    # --- time, progress, checkpoints ---

    def _tick(self) -> None:
        now = time.monotonic()
        for key in self._elapsed:
            self._elapsed[key] += now - self._last_tick
        self._last_tick = now

    def _position(self, stage: Stage) -> float:
        if self.plan.budget_seconds is None:
            return self._step / max(1, round(self.plan.steps * stage.share))
        self._tick()
        return self._elapsed["stage"] / (self.plan.budget_seconds * stage.share)

    def _report(self, stage: Stage, text: str) -> None:
        before = sum(s.share for s in self.stages[: self._stage])
        self.progress(min(1.0, before + stage.share * min(1.0, self._position(stage))), text)

    def _facts(self) -> dict:
        plan = {k: v for k, v in dataclasses.asdict(self.plan).items() if k != "checkpoint_seconds"}
        return {"plan": plan, "threads": self._parts, **self.identity}

    def _save_if_due(self, optimiser, parameters) -> None:
        if self.checkpoint is None or time.monotonic() - self._last_save < self.plan.checkpoint_seconds:
            return
        self._tick()
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= checkpoint.optimiser_tensors(optimiser, parameters)
        loss = self.last_loss if math.isfinite(self.last_loss) else None
        state = {"stage": self._stage, "step": self._step, "count": self._count, "elapsed": self._elapsed, "loss": loss}
        checkpoint.save(self.checkpoint, tensors, state, self._facts())
        self._last_save = time.monotonic()

    def resume(self) -> bool:
        """Load the checkpoint; return False if there is none.

        Raises:
            FormatError: If it is no checkpoint, or was made by a fit with other settings.
        """
        if self.checkpoint is None or not self.checkpoint.is_file():
            return False
        tensors, state = checkpoint.load(self.checkpoint, self._facts())
        self.model.load_state_dict({k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")})
        self._stage, self._step, self._count = state["stage"], state["step"], state["count"]
        self._elapsed = state["elapsed"]
        self.last_loss = math.nan if state["loss"] is None else state["loss"]
        self._pending = {name: value for name, value in tensors.items() if name.startswith("optimiser.")}
        return True


def channel_weights(picture: np.ndarray, rule: str) -> np.ndarray:
    """Return the factor of each channel's squared error, (C,) float32 with mean 1.

    ``uniform``: all ones, the paper's loss. ``variance``: the inverse of the channel's variance, limited to a range of
    16, so that a flat channel is not sacrificed to a busy one.
    """
    count = picture.shape[2]
    if rule == "uniform":
        return np.ones(count, np.float32)
    variance = picture.reshape(-1, count).var(axis=0, dtype=np.float64) + 1e-6
    weight = 1.0 / np.sqrt(np.maximum(variance, variance.max() / 256.0))
    return (weight / weight.mean()).astype(np.float32)
