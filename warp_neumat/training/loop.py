"""The training loop: stages, learning rates, checkpoints and progress. Knows no model by name.

Every random draw is a function of (seed, what it is for, its number), never of what was drawn before: the same seed
gives the same tensors, and a run resumed from a checkpoint goes on exactly as if it had never stopped.
"""

from __future__ import annotations

import dataclasses
import math
import time
from pathlib import Path

import numpy as np
import torch

from warp_neumat.kernels import dispatch
from warp_neumat.training import checkpoint
from warp_neumat.training.threads import torch_threads

CHUNK = 32
"""Batches that are drawn at once, and gone through :data:`PASSES` times before the next are drawn."""

PASSES = 4
EVENT_BATCH = 16384
PLATEAU = 1e-4
"""Least fall of the test error between two events that is no plateau (MobileVR §4.4)."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """How long and how a fit trains."""

    steps: int
    """Optimiser steps over all stages."""
    batch: int = 4096
    """Samples a step."""
    seed: int = 0
    """Decides every random draw."""
    budget_seconds: float | None = None
    """Where given, the stages share this time instead of ``steps``; the result then depends on the machine's speed."""
    checkpoint_seconds: float = 20.0
    """Longest stretch of work that an interruption can cost."""


class Trainer:
    """Trains a model of :mod:`warp_neumat.models` on what a sampler draws.

    Args:
        model: See the protocol in :mod:`warp_neumat.models`.
        sampler: ``sampler(rng, count)`` returns a dict of (count, 3) float32 arrays with at least ``wi``.
        loss: See :mod:`warp_neumat.training.losses`.
        plan: Length and seed.
        checkpoint: File to save progress to, or None.
        identity: JSON-able facts that a checkpoint must share with the run that resumes it.
        progress: ``progress(fraction, text)``, called several times a second at most.
    """

    def __init__(self, model, sampler, loss, plan: Plan, *, checkpoint=None, identity=None, progress=None):
        self.model, self.sampler, self.loss, self.plan = model, sampler, loss, plan
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self.identity = identity or {}
        self.progress = progress or (lambda fraction, text: None)
        self.device = next(model.parameters()).device
        self.stages = model.stages()
        self._stage = self._step = self._event = 0
        self._elapsed = {"total": 0.0, "stage": 0.0}
        self._plateau = {"halved": 0, "least": 1e30}
        self._pending = None  # optimiser state of a checkpoint, until its stage begins
        self.last_loss = math.nan

    # --- samples ---

    def _prepared(self, count: int, *key: int) -> dict[str, torch.Tensor]:
        samples = self.sampler(np.random.default_rng([self.plan.seed, *key]), count)
        samples = {name: torch.from_numpy(array).to(self.device) for name, array in samples.items()}
        return {**self.model.prepare(samples), **self.loss.target(samples)}

    def _event_batches(self, number: int):
        """Samples to take stock on: many times more than a training step sees."""
        wanted, part = self.model.event_samples(), 0
        while wanted > 0:
            count = min(wanted, EVENT_BATCH)
            yield self._prepared(count, 1, self._stage, number, part)
            wanted, part = wanted - count, part + 1

    # --- run ---

    def run(self) -> dict:
        """Train all stages that are left; return training facts: seconds, steps, seed, batch, loss."""
        self._last_tick, self._last_save = time.monotonic(), time.monotonic()
        total = 0
        while self._stage < len(self.stages):
            self._run_stage(self.stages[self._stage])
            total += self._step
            self._stage, self._step, self._event = self._stage + 1, 0, 0
            self._elapsed["stage"] = 0.0
        return {
            "seconds": round(self._elapsed["total"], 2),
            "steps": self.plan.steps if self.plan.budget_seconds is None else total,
            "batch": self.plan.batch,
            "seed": self.plan.seed,
            "budget_seconds": self.plan.budget_seconds,
            "loss": self.last_loss,
        }

    def polish(self, name: str, sampler, steps: int) -> None:
        """Train on for ``steps`` with everything rounded as it is stored, on what ``sampler`` draws.

        After :meth:`run`. It is short, so it leaves no checkpoints: a fit killed in it resumes before it.
        """
        stage = {"name": name, "kind": "round", "share": steps / self.plan.steps, "lr": (1e-3, 1e-5), "events": 0}
        kept = self.sampler, self.checkpoint, self.plan
        self.sampler, self.checkpoint = sampler, None
        self.plan = dataclasses.replace(self.plan, budget_seconds=None)
        self.stages, self._step, self._event = [*self.stages, stage], 0, 0
        try:
            self._run_stage(stage)
        finally:
            self.sampler, self.checkpoint, self.plan = kept
            self._stage += 1

    def _tick(self) -> None:
        now = time.monotonic()
        for key in self._elapsed:
            self._elapsed[key] += now - self._last_tick
        self._last_tick = now

    def _position(self, stage: dict) -> float:
        """How far the stage is, 0 … 1: by steps, or by time where there is a budget; without a share, over."""
        if stage["share"] == 0.0:
            return 1.0
        if self.plan.budget_seconds is None:
            return self._step / max(1, round(self.plan.steps * stage["share"]))
        self._tick()
        return self._elapsed["stage"] / (self.plan.budget_seconds * stage["share"])

    def _report(self, stage: dict, text: str) -> None:
        before = sum(s["share"] for s in self.stages[: self._stage])
        self.progress(min(0.999, before + stage["share"] * min(1.0, self._position(stage))), text)

    def _run_stage(self, stage: dict) -> None:
        name = stage["name"]
        if self._step == 0 and self._pending is None:
            self._report(stage, f"{name}: preparing")
            generator = torch.Generator().manual_seed(self.plan.seed * 1000 + self._stage)
            self.model.begin(stage, lambda: self._event_batches(0), self.loss, generator)
        self.model.enter(stage)
        parameters = self.model.trainable(stage)
        groups, rates = [{"params": [p]} for p in parameters], self.model.rates(parameters)
        adam = {"betas": (0.9, 0.99), "eps": 1e-10, **stage.get("adam", {})}
        optimiser = torch.optim.Adam(groups, lr=stage["lr"][0], **adam, fused=True)
        if self._pending is not None:
            checkpoint.restore_optimiser(optimiser, parameters, self._pending)
            self._pending = None
        chunk, length = None, CHUNK * self.plan.batch
        while (position := self._position(stage)) < 1.0:
            within = self._step % (CHUNK * PASSES)
            if within == 0 or chunk is None:
                self._between_chunks(stage, position, optimiser, parameters)
                chunk = self._prepared(length, 0, self._stage, self._step // (CHUNK * PASSES))
            if within % CHUNK == 0 and within:
                chunk = self._shuffled(chunk)
            start = within % CHUNK * self.plan.batch
            batch = {key: value[start : start + self.plan.batch] for key, value in chunk.items()}
            lr = self._learning_rate(stage, position)
            for group, rate in zip(optimiser.param_groups, rates, strict=True):
                group["lr"] = rate * lr
            with torch_threads(self.model.step_threads):
                optimiser.zero_grad(set_to_none=True)
                loss = self.model.gradients(batch, self.loss)
                optimiser.step()
            self._step += 1
            if within == CHUNK - 1:
                self._note(stage, loss)
                self._report(stage, f"{name}: loss {self.last_loss:.4f}")
        if chunk is not None:
            self._note(stage, loss)
        while self._event < stage["events"]:  # a short stage ends before they are due
            self._take_stock(stage)
        self._tick()

    def _learning_rate(self, stage, position: float) -> float:
        """Return the rate by the stage's schedule: half a cosine, or halved at every event that found a plateau."""
        high, low = stage["lr"]
        if stage.get("schedule") == "plateau":
            return max(low, high * 0.5 ** self._plateau["halved"])
        return low + (high - low) * 0.5 * (1.0 + math.cos(math.pi * position))

    def _note(self, stage, loss) -> None:
        self.last_loss = float(loss)
        if not math.isfinite(self.last_loss):
            raise FloatingPointError(
                f"the fit diverged in stage {stage['name']} at step {self._step}; try another seed"
            )

    def _take_stock(self, stage) -> None:
        self._event += 1
        self._report(stage, f"{stage['name']}: taking stock {self._event}/{stage['events']}")
        number = 0 if stage.get("same_events") else self._event
        error = self.model.event(stage, lambda: self._event_batches(number), self.loss)
        if stage.get("schedule") == "plateau":  # as torch's ReduceLROnPlateau without patience, absolute threshold
            if error >= self._plateau["least"] - PLATEAU:
                self._plateau["halved"] += 1
            self._plateau["least"] = min(error, self._plateau["least"])

    def _shuffled(self, chunk) -> dict[str, torch.Tensor]:
        """Return a chunk in another order: runs of 64 samples are moved as they are, at the speed of memory."""
        run = math.gcd(self.plan.batch, 64)
        draw = np.random.default_rng([self.plan.seed, 2, self._stage, self._step])
        order = torch.from_numpy(draw.permutation(CHUNK * self.plan.batch // run)).to(self.device)
        return {key: value.view(-1, run, value.shape[1])[order].flatten(0, 1) for key, value in chunk.items()}

    def _between_chunks(self, stage, position, optimiser, parameters) -> None:
        """Do what may happen only here: an event that is due, a checkpoint that is due."""
        self._tick()
        # Unless the stage says otherwise, its last quarter is free of events, to settle.
        until = stage.get("until", 0.75)
        while self._event < stage["events"] and position >= until * self._event / stage["events"]:
            self._take_stock(stage)
        if self.checkpoint is not None and time.monotonic() - self._last_save >= self.plan.checkpoint_seconds:
            self._tick()
            self._save(optimiser, parameters)
            self._last_save = time.monotonic()

    # --- checkpoints ---

    def _facts(self) -> dict:
        plan = {k: v for k, v in dataclasses.asdict(self.plan).items() if k != "checkpoint_seconds"}
        return {"plan": plan, "threads": dispatch.worker_count(), **self.identity}

    def _save(self, optimiser, parameters) -> None:
        tensors = {f"model.{name}": value for name, value in self.model.state_dict().items()}
        tensors |= checkpoint.optimiser_tensors(optimiser, parameters)
        state = {"stage": self._stage, "step": self._step, "event": self._event, "elapsed": self._elapsed}
        state |= {"plateau": self._plateau, "loss": self.last_loss if math.isfinite(self.last_loss) else None}
        checkpoint.save(self.checkpoint, tensors, state, self._facts())

    def resume(self) -> bool:
        """Load the checkpoint; return False if there is none.

        Raises:
            FormatError: If it is no checkpoint, or was made by a fit with other settings.
        """
        if self.checkpoint is None or not self.checkpoint.is_file():
            return False
        tensors, state = checkpoint.load(self.checkpoint, self._facts())
        model = {name.removeprefix("model."): value for name, value in tensors.items() if name.startswith("model.")}
        self.model.load_state_dict(model)
        self._stage, self._step, self._event = state["stage"], state["step"], state["event"]
        self._elapsed, self._plateau = state["elapsed"], state["plateau"]
        self.last_loss = math.nan if state["loss"] is None else state["loss"]
        self._pending = {name: value for name, value in tensors.items() if name.startswith("optimiser.")}
        return True
