"""Training of an NTBC material: one model after another, both networks of each at once (paper [ntbc], §3.2–3.4).

1. The endpoint network learns the reference's endpoints and the texel network its colours, each with the error of the
   indices that follow from them (Eq. 11, 12).
2. For the last ``joint`` of the steps, past the paper, both see what a block of theirs decodes to: the endpoints move
   to where the predicted colours fall, and make up for a good part of what the first stage loses.
3. For the last ``quantised`` of the steps grids are rounded as they are stored, and weights to float16 (§3.3).

The naive variant trains both networks on decoded colours, and for the last fifth the endpoints alone, with weights
rounded to palette entries (§3.1).

Every random draw is a function of (seed, model, epoch): the same seed gives the same file on one machine with the same
number of threads, and a resumed run goes on exactly as if it had never stopped.
"""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path

import numpy as np
import torch

from warp_neumat.kernels import dispatch
from warp_neumat.models.ntbc import NTBC, block_colours, metrics
from warp_neumat.ops.grid_update import GridAdam
from warp_neumat.ops.ntbc import NTBCStep
from warp_neumat.training import checkpoint
from warp_neumat.training.ntbc_torch import TorchAdam, TorchStep

WARMUP = 10
"""Steps in which the learning rates rise (NTBC §3.4)."""

BETAS = (0.9, 0.99)
"""Of Adam. Paper: 0.9, 0.999; the shorter memory gained 0.6 dB in the same time."""

NAIVE_SWITCH = 0.8
"""Share of the steps after which the naive variant rounds its weights (NTBC §3.1)."""

COLOURS = (0.0, 0.0, 1.0, 0.0, 0.0)
APART = (1.0, 1.0, 1.0, 1.0, 0.0)
JOINT = (0.0, 0.0, 1.0, 0.0, 1.0)
"""Factors of the losses where endpoints are fitted, in the paper's training, and in the joint one."""

MOST_PARTS = 8


class NTBCTrainer:
    """Trains a :class:`warp_neumat.models.ntbc.NTBC` on the finest mip of a texture set.

    Args:
        model: The model; its buffers are trained in place.
        pixels: (H, W, C) float32 in [0, 1], encoded.
        reference: ``reference(planes)`` returns the endpoints of a block-compressed reference, (blocks, 2c) float32.
        plan: Length, batch (blocks a step, a multiple of 8) and seed; see :class:`warp_neumat.training.loop.Plan`.
        checkpoint_path: File to save progress to, or None.
        identity: JSON-able facts that a checkpoint must share with the run that resumes it.
        progress: ``progress(fraction, text)``, called several times a second at most.
        watch: ``watch(model number, step)``, called every 100 steps, for measurements.
        fused: Whether to train by the fused kernels or in plain torch; default: fused where the model is on the CPU.
    """

    def __init__(
        self,
        model: NTBC,
        pixels,
        reference,
        plan,
        *,
        checkpoint_path=None,
        identity=None,
        progress=None,
        watch=None,
        fused: bool | None = None,
    ):
        self.model, self.plan, self.config = model, plan, model.config
        self.pixels, self.reference = pixels, reference
        self.progress, self.watch = progress or (lambda fraction, text: None), watch
        self.checkpoint = None if checkpoint_path is None else Path(checkpoint_path)
        self.identity = identity or {}
        self.last_loss = math.nan
        self._number = self._step = self._count = 0
        self._elapsed = {"total": 0.0, "model": 0.0}
        self._rounded = False  # whether the last step left grids rounded
        self._batch = plan.batch
        self._pending: dict | None = None
        self._fused = next(model.buffers()).device.type == "cpu" if fused is None else fused
        self._parts = min(MOST_PARTS, dispatch.worker_count()) if self._fused else 1

    def run(self) -> dict:
        """Train all models that are left; return training facts."""
        self._last_tick = self._last_save = time.monotonic()
        while self._number < len(self.model.pairs):
            self._train(self.model.pairs[self._number])
            self._number, self._step, self._rounded = self._number + 1, 0, False
            self._elapsed["model"] = 0.0
        return {
            "seconds": round(self._elapsed["total"], 2),
            "steps": self._count,
            "models": len(self.model.pairs),
            "batch": self._batch,
            "seed": self.plan.seed,
            "threads": self._parts,
            "budget_seconds": self.plan.budget_seconds,
            "loss": self.last_loss,
        }

    # --- one model ---

    def _train(self, pair) -> None:
        config, naive = self.config, self.config.variant == "naive"
        planes = config.planes(pair.model)
        self._report("encoding the reference")
        colours = block_colours(planes, self.pixels)
        count = len(colours)
        batch = self._batch = min(self.plan.batch, 8 * (count // 8) or 8)
        endpoints = torch.zeros(count, 2 * colours.shape[1])
        if not naive and config.endpoints == "network":
            endpoints = self.reference(planes)
        self._report("preparing the kernels")  # seconds where they are compiled for the first time
        optimisers = self._optimisers(pair)
        step = (NTBCStep if self._fused else TorchStep)(
            pair.shape, config.rows, config.columns, colours, endpoints, *(o.used for o in optimisers.values()),
            batch=batch, parts=self._parts, metric=metrics(config, pair.model), temperature=config.temperature,
            gradients=[o.gradients for o in optimisers.values()],
        )  # fmt: skip
        self._restore(optimisers)
        draws = _Blocks(self.plan.seed, self._number, count, batch)
        fitted = config.endpoints == "fitted"
        apart, together = (torch.tensor(COLOURS if fitted else factors) for factors in (APART, JOINT))
        while (position := self._position()) < 1.0:
            self._save_if_due(optimisers)
            joint, rounded = position >= 1.0 - config.joint, position >= 1.0 - config.quantised
            step.weights.copy_(together if joint or naive else apart)
            frozen = naive and position >= NAIVE_SWITCH
            step.run(draws(self._step), quantised=frozen)
            self._step, self._count = self._step + 1, self._count + 1
            scale = min(1.0, self._step / WARMUP) * 0.5 * (1.0 + math.cos(math.pi * position))
            for name, optimiser in optimisers.items():
                if name.startswith("endpoint") and fitted:
                    continue
                still = frozen and name.startswith("texel")
                rate = 0.0 if still else config.rates[0 if name.endswith("grid") else 1] * scale
                optimiser.step(rate, self._step, rounded)
            self._rounded = rounded
            if self._count % 50 == 0 or self._step == 1:
                self._note(step, naive)
            if self.watch and self._count % 100 == 0:
                self.watch(self._number, self._step)
        self._tick()

    def _optimisers(self, pair) -> dict[str, GridAdam]:
        """Return the optimiser of each buffer: grids lazily, as few of their vertices see a batch."""
        found = {}
        for name, shape, grids, grid, net in pair.networks():
            where = {"offsets": shape.grid_offsets} if self._fused else {"shape": shape}
            for kind, value, more in (
                ("grid", grid, {**where, "bits": grids.bits}),
                ("net", net, {"bits": None, "lazy": False} | ({} if self._fused else {"shape": None})),
            ):
                gradients = torch.zeros(self._parts, value.numel(), device=value.device)
                adam = GridAdam if self._fused else TorchAdam
                found[f"{name}_{kind}"] = adam(value, gradients, betas=BETAS, eps=1e-15, **more)
        return found

    def _note(self, step: NTBCStep, naive: bool) -> None:
        self.last_loss = float(step.losses.mean(0) @ step.weights)
        if not math.isfinite(self.last_loss):
            raise FloatingPointError(f"the fit diverged at step {self._step}; try another seed, or lower rates")
        error = float(step.losses[:, 2 if self.config.endpoints == "fitted" else 4].mean())
        self._report(f"{-10.0 * math.log10(max(error, 1e-12)):.2f} dB")

    # --- time, progress, checkpoints ---

    def _tick(self) -> None:
        now = time.monotonic()
        for key in self._elapsed:
            self._elapsed[key] += now - self._last_tick
        self._last_tick = now

    def _position(self) -> float:
        if self.plan.budget_seconds is None:
            return self._step / self.plan.steps
        self._tick()
        return self._elapsed["model"] * len(self.model.pairs) / self.plan.budget_seconds

    def _report(self, text: str) -> None:
        count = len(self.model.pairs)
        name = f"model {self._number + 1} of {count}: " if count > 1 else ""
        self.progress(min(1.0, (self._number + min(1.0, self._position())) / count), name + text)

    def _facts(self) -> dict:
        plan = {k: v for k, v in dataclasses.asdict(self.plan).items() if k != "checkpoint_seconds"}
        return {"plan": plan, "threads": self._parts, **self.identity}

    def _save_if_due(self, optimisers) -> None:
        if self.checkpoint is None or time.monotonic() - self._last_save < self.plan.checkpoint_seconds:
            return
        self._tick()
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        for name, optimiser in optimisers.items():
            tensors |= {f"optimiser.{name}.first": optimiser.first, f"optimiser.{name}.second": optimiser.second}
        loss = self.last_loss if math.isfinite(self.last_loss) else None
        state = {"number": self._number, "step": self._step, "count": self._count, "elapsed": self._elapsed}
        state |= {"rounded": self._rounded, "loss": loss}
        checkpoint.save(self.checkpoint, tensors, state, self._facts())
        self._last_save = time.monotonic()

    def _restore(self, optimisers) -> None:
        if self._pending is None:
            return
        for name, optimiser in optimisers.items():
            for part in ("first", "second"):
                getattr(optimiser, part).copy_(self._pending[f"optimiser.{name}.{part}"])
            optimiser.refresh(self._rounded)
        self._pending = None

    def resume(self) -> bool:
        """Load the checkpoint; return False if there is none.

        Raises:
            FormatError: If it is no checkpoint, or was made by a fit with other settings.
        """
        if self.checkpoint is None or not self.checkpoint.is_file():
            return False
        tensors, state = checkpoint.load(self.checkpoint, self._facts())
        self.model.load_state_dict({k.removeprefix("model."): v for k, v in tensors.items() if k.startswith("model.")})
        self._number, self._step, self._count = state["number"], state["step"], state["count"]
        self._elapsed, self._rounded = state["elapsed"], state["rounded"]
        self.last_loss = math.nan if state["loss"] is None else state["loss"]
        self._pending = {name: value for name, value in tensors.items() if name.startswith("optimiser.")}
        return True


class _Blocks:
    """Which blocks a step sees: each once in an epoch, in an order drawn from (seed, model, epoch)."""

    def __init__(self, seed: int, model: int, count: int, batch: int):
        self._key, self._count, self._batch = (seed, model), count, batch
        self._epoch, self._order = -1, None

    def __call__(self, step: int) -> torch.Tensor:
        first, found = step * self._batch, []
        while len(found) == 0 or sum(map(len, found)) < self._batch:
            epoch, at = divmod(first + sum(map(len, found)), self._count)
            if epoch != self._epoch:
                order = np.random.default_rng([*self._key, epoch]).permutation(self._count)
                self._epoch, self._order = epoch, torch.from_numpy(order.astype(np.int32))
            found.append(self._order[at : at + self._batch - sum(map(len, found))])
        return torch.cat(found)
