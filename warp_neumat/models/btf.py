"""A BTF as textures of features and small networks, on the fitting side (MobileVR §4.1, 4.3)."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import nn

from warp_neumat.io.mipmaps import mip_sizes
from warp_neumat.kernels import dispatch
from warp_neumat.kernels.btf_train import QUADS, StepShape
from warp_neumat.models import btf_blocks
from warp_neumat.models.btf_config import BTFConfig, configure, from_header
from warp_neumat.ops.btf import EXPORT, FORWARD, TRAIN, BTFStep

__all__ = ["BTF", "DATA", "DEFAULT_STEPS", "VERSION", "build", "configure", "from_asset"]

DATA = "btf"
VERSION = 1
DEFAULT_STEPS = 12000
ACTIVATIONS = {"relu": torch.relu, "hardswish": nn.functional.hardswish}
ADAPTING = 0.2
"""Share of the steps in which the networks adapt to features that have become blocks."""

CORNERS = ((-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5))
"""The four places of a quad, in units of their distance: upper left, upper right, lower left, lower right."""


class BTF(nn.Module):
    """Coarse and fine network with their textures, or one network with one texture.

    Outputs are value × cos θ_i in units of :attr:`scale`, the source's mean; :meth:`to_asset` multiplies it into the
    last layer.

    Args:
        config: Shape and training.
        seed: Of the initial features and weights.
        scale: Mean of the data [1/sr].
        teacher: A model whose outputs and hidden layers :meth:`prepare` adds to every sample, or None.
    """

    def __init__(self, config: BTFConfig, seed: int = 0, scale: float = 1.0, teacher: BTF | None = None):
        super().__init__()
        self.config, self.scale = config, float(scale)
        self.shape = step_shape(config)
        generator = torch.Generator().manual_seed(seed)
        self.levels = _levels(config)
        words = sum(w * h * c for (_, w, h), c in zip(self.levels, self._level_channels(), strict=True))
        self.texels = nn.Parameter(torch.randn(words, generator=generator) * 0.1)
        self.net = nn.Parameter(self._initial_net(generator))
        self.register_buffer("history", torch.full((config.epochs,), torch.nan))
        if config.features == "bc6h":  # what was encoded is kept, because encoding it again need not give the same
            sizes = [16 * rows * columns * count for rows, columns, count in self._block_grids()]
            self.register_buffer("blocks", torch.zeros(sum(sizes), dtype=torch.uint8))
        self._teacher = [teacher]  # in a list, so that its weights are no part of this module
        if teacher is not None:
            rows, width1, width2 = self.shape.hints
            _, from1, from2 = teacher.shape.hints
            self.map1 = nn.Parameter(torch.randn(from1, width1, generator=generator) / from1**0.5)
            self.map2 = nn.Parameter(torch.randn(from2, width2, generator=generator) / from2**0.5)
        self._steps: dict = {}

    def _level_channels(self) -> list[int]:
        mips = self.config.mips
        return [self.config.channels] * mips + [self.config.coarse_channels] * (len(self.levels) - mips)

    def _initial_net(self, generator) -> torch.Tensor:
        net = torch.zeros(self.shape.weights)
        for weight, _ in self.layers(net)[:-1]:
            gain = 2.0 if self.config.activation == "relu" else 4.5  # hard-swish is nearly linear near 0
            weight.normal_(generator=generator).mul_((gain / weight.shape[1]) ** 0.5)
        weight, bias = self.layers(net)[-1]
        weight.normal_(generator=generator).mul_((0.25 / weight.shape[1]) ** 0.5)
        bias.fill_(1.0)
        for layer in self.shape.layers:  # units start alive
            net[layer[3] : layer[3] + layer[2]] = 0.05
        return net

    def layers(self, net: torch.Tensor | None = None) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Return (weight (out, in), bias (out,)) of every layer, coarse, fine, output: views of ``net``."""
        net = self.net if net is None else net
        found = []
        for _, inputs, outputs, bias, weights in self.shape.layers:
            wide = -(-outputs // 8) * 8
            matrix = net[weights : weights + inputs * wide].view(inputs, wide)
            found.append((matrix[:, :outputs].T, net[bias : bias + outputs]))
        bias, weights = self.shape.output
        wide = self.shape.fine_rows[-1]
        last = net[weights : weights + 3 * wide].view(3, wide)[:, : self.shape.hidden[-1]]
        return [*found, (last, net[bias : bias + 3])]

    @property
    def weights(self) -> int:
        """Numbers in the networks."""
        return sum(w.numel() + b.numel() for w, b in self.layers())

    # --- forward ---

    def _fetch(self, coarse: bool, uv: torch.Tensor, level: torch.Tensor) -> torch.Tensor:
        """Return bilinear features (n, C) at ``uv`` (n, 2) of the mips ``level`` (n,) int64; repeats."""
        channels = self.config.coarse_channels if coarse else self.config.channels
        table = torch.tensor(self.levels)[self.config.mips :] if coarse else torch.tensor(self.levels)
        first, w, h = table.to(uv.device)[level].T
        x, y = (uv[:, 0] - uv[:, 0].floor()) * w - 0.5, (uv[:, 1] - uv[:, 1].floor()) * h - 0.5
        x0, y0 = x.floor(), y.floor()
        fx, fy = x - x0, y - y0
        columns = torch.arange(channels, device=uv.device)
        total = uv.new_zeros(len(uv), channels)
        for dy, wy in ((0, 1 - fy), (1, fy)):
            for dx, wx in ((0, 1 - fx), (1, fx)):
                texel = ((y0.long() + dy) % h) * w + (x0.long() + dx) % w
                rows = self.texels[(first + texel * channels)[:, None] + columns]
                total = total + (wx * wy)[:, None] * rows
        return total

    def forward(self, angles, place, latents: bool = False):
        """Return the outputs of quads, (n, 12), differentiable; with ``latents`` also z₁ and z₂.

        Args:
            angles: ω_i, ω_o and, if the model sees it, h: (n, 6 or 9).
            place: Centre u, v, distance of the four places in texels of the level, level: (n, 4).
        """
        level = place[:, 3].long()
        table = torch.tensor(self.levels, device=place.device)[level]
        layers, act = self.layers(), ACTIVATIONS[self.config.activation]
        z1, head = None, angles
        if self.config.coarse:
            z1 = torch.cat([angles, self._fetch(True, place[:, :2], level)], 1)
            for weight, bias in layers[: len(self.config.coarse)]:
                z1 = act(z1 @ weight.T + bias)
            layers, head = layers[len(self.config.coarse) :], z1
        corner = torch.tensor(CORNERS, dtype=place.dtype, device=place.device)
        uv = place[:, None, :2] + corner * (place[:, 2:3] / table[:, 1:])[:, None]
        x = self._fetch(False, uv.flatten(0, 1), level.repeat_interleave(4))
        x = torch.cat([head.repeat_interleave(4, 0), x], 1)
        for number, (weight, bias) in enumerate(layers[:-1], 1):
            x = act(x @ weight.T + bias)
            if z1 is None and number == self.shape.middle:
                z1 = x
        weight, bias = layers[-1]
        y = (x @ weight.T + bias).view(len(angles), 12)
        return (y, z1, x) if latents else y

    def _step(self, quads: int, parts: int) -> BTFStep:
        key = (quads, parts)
        if key not in self._steps:
            config, taught = self.config, self._teacher[0] is not None
            self._steps[key] = BTFStep(
                self.shape, self.levels, torch.zeros_like(self.texels), torch.zeros(self.shape.weights), quads=quads,
                parts=parts, sigma=config.sigma if taught else 0.0,
                lambdas=(config.lambda1, config.lambda2) if taught else (0.0, 0.0),
            )  # fmt: skip
        step = self._steps[key]
        with torch.no_grad():
            step.table.copy_(self.texels)
            step.net.copy_(self.net)
        return step

    def angles(self, wi: torch.Tensor, wo: torch.Tensor) -> torch.Tensor:
        """Return the networks' angular inputs (n, 6 or 9)."""
        if not self.config.half_vector:
            return torch.cat([wi, wo], 1)
        h = wi + wo
        length = h.norm(dim=1, keepdim=True)
        up = h.new_tensor([0.0, 0.0, 1.0]).expand_as(h)
        return torch.cat([wi, wo, torch.where(length < 1e-6, up, h / length.clamp_min(1e-6))], 1)

    def predict(self, angles: torch.Tensor, place: torch.Tensor, *, export: bool = False):
        """Return outputs (n, 12), with ``export`` also z₁ (n, rows · width) and z₂ (n, 4 · width); fused on the CPU."""
        if self.net.device.type != "cpu":
            with torch.no_grad():
                y, z1, z2 = self(angles, place, latents=True)
            return (y, z1.reshape(len(y), -1), z2.reshape(len(y), -1)) if export else y
        found, size = [], 2048
        for start in range(0, len(angles), size):
            count = min(size, len(angles) - start)
            step = self._step(size, dispatch.worker_count())
            step.angles.zero_()
            step.place.zero_()
            step.angles[:count], step.place[:count] = angles[start : start + count], place[start : start + count]
            step.run(step.angles, step.place, step.target, mode=EXPORT if export else FORWARD)
            kept = (step.output, step.latent1, step.latent2) if export else (step.output,)
            found.append([t[:count].clone() for t in kept])
        found = [torch.cat(parts) for parts in zip(*found, strict=True)]
        return found if export else found[0]

    # --- what training.loop relies on ---

    @property
    def step_threads(self) -> int | None:
        """Threads of torch in a step: beside the fused pass one, where its arrays are too small to share."""
        return 1 if self.net.device.type == "cpu" and self.texels.numel() < 1 << 20 else None

    def prepare(self, samples: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Return the batch that :meth:`gradients` takes, of ``wi``, ``wo``, ``place`` and ``value`` (n, 12)."""
        angles = self.angles(samples["wi"], samples["wo"])
        batch = {"angles": angles, "place": samples["place"], "target": samples["value"] / self.scale}
        teacher = self._teacher[0]
        if teacher is not None:
            seen = teacher.angles(samples["wi"], samples["wo"])
            y, z1, z2 = teacher.predict(seen, samples["place"], export=True)
            batch["teacher"] = y * (teacher.scale / self.scale)
            rows, _, _ = self.shape.hints
            from_rows, width, _ = teacher.shape.hints
            if rows == 1 and from_rows == 4:  # a distance to all four is one to their mean
                z1 = z1.view(-1, 4, width).mean(1)
            elif rows == 4 and from_rows == 1:
                z1 = z1.repeat(1, 4)
            batch["z1"], batch["z2"] = z1, z2
        return batch

    def gradients(self, batch, loss) -> torch.Tensor:
        """Return the mean loss of a batch (Eq. 5) and set the gradients of all parameters. On the CPU in one pass."""
        taught = "teacher" in batch
        if self.net.device.type != "cpu" or len(batch["angles"]) % QUADS:
            value = self._loss(batch)
            value.backward()
            return value.detach()
        step = self._step(len(batch["angles"]), dispatch.worker_count())
        h1 = h2 = None
        if taught:
            with torch.no_grad():
                z1, z2 = batch["z1"].view(-1, self.map1.shape[0]), batch["z2"].view(-1, self.map2.shape[0])
                h1, h2 = (z1 @ self.map1).view_as(step.hint1), (z2 @ self.map2).view_as(step.hint2)
        step.run(batch["angles"], batch["place"], batch["target"], batch.get("teacher"), h1, h2, mode=TRAIN)
        self.texels.grad, self.net.grad = step.table_gradient, step.weight_gradient
        if taught:
            for weight, gain, z, left, mapped in zip(
                step.lambdas, step.hint_gains, (z1, z2), (step.latent1, step.latent2), (self.map1, self.map2),
                strict=True,
            ):  # fmt: skip
                if weight > 0:
                    mapped.grad = (-2.0 * weight * gain) * (z.T @ left.view(len(z), -1))
        return step.losses.mean(0).sum()

    def _loss(self, batch) -> torch.Tensor:
        """Return Eq. 5 in plain torch: what the fused pass is checked against."""
        y, z1, z2 = self(batch["angles"], batch["place"], latents=True)
        total = (y - batch["target"]).abs().mean()
        if "teacher" not in batch:
            return total
        config = self.config
        total = total + config.sigma * (y - batch["teacher"]).abs().mean()
        for weight, z, hint, mapped in (
            (config.lambda1, z1, batch["z1"], self.map1), (config.lambda2, z2, batch["z2"], self.map2),
        ):  # fmt: skip
            target = hint.view(-1, mapped.shape[0]) @ mapped
            wide = nn.functional.pad(z, (0, mapped.shape[1] - z.shape[1]))  # layers are padded to whole registers
            total = total + weight * ((wide - target) ** 2).mean()
        return total

    def stages(self) -> list[dict]:
        """Return the one stage there is; where features become blocks, a second one for the networks to adapt."""
        config = self.config
        adam = {"betas": (0.9, 0.999), "eps": 1e-8}
        first = {
            "name": "student" if self._teacher[0] is not None else config.variant, "kind": "all", "share": 1.0,
            "lr": config.lr, "events": config.epochs, "until": 1.0, "schedule": config.schedule, "same_events": True,
            "adam": adam,
        }  # fmt: skip
        if config.features != "bc6h":
            return [first]
        rates = (max(config.lr[0] / 4, config.lr[1]), config.lr[1])
        last = {"name": "blocks", "kind": "blocks", "share": ADAPTING, "lr": rates, "events": 0, "adam": adam}
        return [{**first, "share": 1.0 - ADAPTING}, last]

    def trainable(self, stage: dict) -> list[nn.Parameter]:
        """Return all parameters, without the features once they are blocks."""
        return [p for p in self.parameters() if p is not self.texels or stage["kind"] == "all"]

    def rates(self, parameters) -> list[float]:
        """Return the learning rate of each parameter in units of the stage's: one for all."""
        return [1.0] * len(parameters)

    def event_samples(self) -> int:
        """Return the quads of the test error."""
        return 8192

    def begin(self, stage: dict, batches, loss, generator: torch.Generator) -> None:
        """Encode the features where they are to be blocks, and go on with what is read from those."""
        if stage["kind"] == "blocks":
            self._fold()
            self._turn()
            encoded = self._encoded()
            self.blocks.copy_(torch.from_numpy(np.concatenate([b.ravel() for blocks in encoded for b in blocks])))
            self._decode(encoded)

    def enter(self, stage: dict) -> None:
        """Nothing to switch."""

    def event(self, stage: dict, batches, loss) -> float:
        """Return the mean |y − y_gt| [1/sr] over the test samples, and keep it in ``history``."""
        total = count = 0
        for batch in batches():
            y = self.predict(batch["angles"], batch["place"])
            total += float((y - batch["target"]).abs().double().sum()) * self.scale
            count += y.numel()
        number = int(torch.isfinite(self.history).sum())
        if number < len(self.history):
            self.history[number] = total / count
        return total / count

    # --- assets ---

    def folded(self) -> BTF:
        """Return the same function with no more features than a first layer has units; this model, if that is so.

        A first layer sees features only through their product with its weights, which is as good a texture and commutes
        with filtering: of 16 features, 8 units make 8. What training had room with need not be stored nor fetched.
        """
        config, (first, _) = self.config, self.layers()[0]
        fine = self.layers()[len(config.coarse)][0]
        spare = {"channels": (config.channels, fine), "coarse_channels": (config.coarse_channels, first)}
        spare = {name: weight for name, (count, weight) in spare.items() if count > len(weight)}
        if not spare:
            return self
        less = {name: len(weight) for name, weight in spare.items()}
        other = BTF(dataclasses.replace(config, **less), scale=self.scale)
        with torch.no_grad():
            for mine, its in zip(self.layers(), other.layers(), strict=True):
                its[1].copy_(mine[1])
                if its[0].shape == mine[0].shape:
                    its[0].copy_(mine[0])
            for number, (mine, its) in enumerate(zip(self.mips(), other.mips(), strict=True)):
                name, place = ("channels", len(config.coarse)) if number < config.mips else ("coarse_channels", 0)
                if name not in spare:
                    its[...] = mine
                    continue
                before, after = self.layers()[place][0], other.layers()[place][0]
                head = before.shape[1] - mine.shape[2]
                its[...] = mine @ before[:, head:].T.cpu().numpy()
                after[:, :head] = before[:, :head]
                after[:, head:] = torch.eye(len(before))
        return other

    def _fold(self) -> None:
        """Become the :meth:`folded` model."""
        other = self.folded()
        if other is not self:
            self.config, self.shape, self.levels = other.config, other.shape, other.levels
            device = self.net.device
            self.texels, self.net = nn.Parameter(other.texels.data.to(device)), nn.Parameter(other.net.data.to(device))
            self._steps = {}

    def _turn(self) -> None:
        """Turn features to principal components, which the first layers undo, one of the strongest in each three.

        The texels of a block lie on a line or two in their three channels: so little is lost where one component is
        large and the others are small.
        """
        deep = len(self.config.coarse)
        everything = self.mips()
        with torch.no_grad():
            for place, mips in ((deep, everything[: self.config.mips]), (0, everything[self.config.mips :])):
                if not mips:
                    continue
                rows = np.concatenate([mip.reshape(-1, mip.shape[2]) for mip in mips]).astype(np.float64)
                _, axes = np.linalg.eigh(np.cov(rows.T).reshape(rows.shape[1], -1))
                axes = np.ascontiguousarray(axes.T[btf_blocks.by_threes(rows.shape[1])], np.float32)  # weakest first
                weight = self.layers()[place][0]
                weight[:, -len(axes) :] = weight[:, -len(axes) :] @ torch.from_numpy(axes.T.copy()).to(weight)
                for mip in mips:
                    mip[...] = mip @ axes.T
            self.texels.copy_(torch.from_numpy(np.concatenate([mip.ravel() for mip in everything])))

    def load_state_dict(self, state, *args, **kwargs):
        """Take over a state, of this model or of what became of it when its features were to be blocks."""
        if state["texels"].shape != self.texels.shape:
            self._fold()
        return super().load_state_dict(state, *args, **kwargs)

    def to_asset(self) -> tuple[dict[str, np.ndarray], dict]:
        """Return (tensors, header) of the :meth:`folded` model as ``kernels/btf.py`` reads them, float16."""
        if self.config.features == "half" and self.folded() is not self:
            return self.folded().to_asset()
        tensors, kept = {}, self._kept() if self.config.features == "bc6h" else []
        with torch.no_grad():
            for number, mip in enumerate(self.mips()):
                name, level = ("fine" if number < self.config.mips else "coarse"), number % self.config.mips
                if self.config.features == "half":
                    tensors[f"{name}.mip{level}"] = mip.astype(np.float16)
                else:
                    for t, blocks in enumerate(kept[number]):
                        tensors[f"{name}.block{t}.mip{level}"] = blocks
            deep = len(self.config.coarse)
            for number, (weight, bias) in enumerate(self.layers()):
                name, place = ("coarse", number) if number < deep else ("fine", number - deep)
                gain = self.scale if number == deep + len(self.config.hidden) else 1.0
                tensors[f"{name}.weight{place}"] = (weight * gain).numpy().astype(np.float16)
                tensors[f"{name}.bias{place}"] = (bias * gain).numpy().astype(np.float16)
        return tensors, {"kind": "btf", "version": VERSION, "config": self.config.asset()}

    def mips(self) -> list[np.ndarray]:
        """Return the features (h, w, C) float32 of every mip, fine and then coarse; on the CPU views of them."""
        texels = self.texels.detach().cpu().numpy()
        return [
            texels[at : at + w * h * c].reshape(h, w, c)
            for (at, w, h), c in zip(self.levels, self._level_channels(), strict=True)
        ]

    def _encoded(self) -> list[list[np.ndarray]]:
        """Return the blocks of every mip."""
        return [btf_blocks.encode(mip) for mip in self.mips()]

    def _block_grids(self) -> list[tuple[int, int, int]]:
        """Return (rows, columns, textures of three channels) of every mip of the folded model."""
        config = self.config
        fine = min(config.channels, config.hidden[0])
        coarse = min(config.coarse_channels, config.coarse[0]) if config.coarse else 0
        counts = [fine] * config.mips + [coarse] * (len(self.levels) - config.mips)
        return [(-(-h // 4), -(-w // 4), -(-c // 3)) for (_, w, h), c in zip(self.levels, counts, strict=True)]

    def _kept(self) -> list[list[np.ndarray]]:
        """Return the blocks of every mip as they were encoded once."""
        flat, at, found = self.blocks.cpu().numpy(), 0, []
        for rows, columns, count in self._block_grids():
            found.append([])
            for _ in range(count):
                size = rows * columns * 16
                found[-1].append(flat[at : at + size].reshape(rows, columns, 16).copy())
                at += size
        return found

    def _decode(self, encoded: list[list[np.ndarray]]) -> None:
        """Replace the features by what a texture unit reads from blocks."""
        with torch.no_grad():
            read = [
                btf_blocks.decode(blocks, mip.shape[1], mip.shape[0], mip.shape[2]).ravel()
                for blocks, mip in zip(encoded, self.mips(), strict=True)
            ]
            self.texels.copy_(torch.from_numpy(np.concatenate(read).astype(np.float32)))

    def statistics(self) -> dict:
        """Return training facts for the header."""
        history = [round(float(v), 6) for v in self.history if torch.isfinite(v)]
        config = self.config
        facts = {"test_l1": history, "schedule": config.schedule, "lr": list(config.lr), "scale": self.scale}
        if self._teacher[0] is not None:
            facts["distillation"] = {"sigma": config.sigma, "lambda1": config.lambda1, "lambda2": config.lambda2}
        return facts


def step_shape(config: BTFConfig) -> StepShape:
    """Return what the fused step is compiled for."""
    return StepShape(
        config.angles, config.channels, config.hidden, config.coarse_channels, config.coarse, config.activation
    )


def _levels(config: BTFConfig) -> list[tuple[int, int, int]]:
    """Return (offset in words, width, height) of the fine mips, and of the coarse ones if there are any."""
    fine = mip_sizes(config.width, config.height)[: config.mips]
    sizes = [(size, config.channels) for size in fine]
    if config.coarse:
        sizes += [((max(1, w // 2), max(1, h // 2)), config.coarse_channels) for w, h in fine]
    found, at = [], 0
    for (w, h), channels in sizes:
        found.append((at, w, h))
        at += w * h * channels
    return found


def build(config: BTFConfig, seed: int, scale: float = 1.0, teacher: BTF | None = None) -> BTF:
    """Return an untrained model."""
    return BTF(config, seed, scale, teacher)


def from_asset(tensors: dict[str, np.ndarray], config: dict) -> BTF:
    """Return a stored model."""
    model = BTF(from_header(config))
    with torch.no_grad():
        encoded = []
        for number, mip in enumerate(model.mips()):
            name, level = ("fine" if number < model.config.mips else "coarse"), number % model.config.mips
            if model.config.features == "half":
                mip[...] = tensors[f"{name}.mip{level}"]  # a view of the parameter
            else:
                encoded.append([tensors[f"{name}.block{t}.mip{level}"] for t in range(-(-mip.shape[2] // 3))])
        if encoded:
            model.blocks.copy_(torch.from_numpy(np.concatenate([b.ravel() for blocks in encoded for b in blocks])))
            model._decode(encoded)
        deep = len(model.config.coarse)
        for number, (weight, bias) in enumerate(model.layers()):
            name, place = ("coarse", number) if number < deep else ("fine", number - deep)
            weight.copy_(torch.from_numpy(tensors[f"{name}.weight{place}"].astype(np.float32)))
            bias.copy_(torch.from_numpy(tensors[f"{name}.bias{place}"].astype(np.float32)))
    return model
