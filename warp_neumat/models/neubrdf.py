"""NeuBRDF, the fitting side: two HEALPix corner grids of features, quantised to shared primitives, and a small decoder.

Paper [neubrdf], Sec. 3 (Eq. 1–4). ψ_0 = Σ_t w_t D[S_0[p_t]] on side 0, ψ_1 the same on side 1, f = max(exp(MLP([ψ_0,
ψ_1, φ(u)])) − 1, 0). Differs: bilinear corner weights in the pixel's own coordinates (continuous; the paper trains with
inverse distance and runs with 1/4); the decoder predicts log(1 + f), because mirror peaks of several hundred stand
beside diffuse values of 0.01; by default the sides are half and difference vector instead of ω_i and ω_o.

The fit: (1) ``features``: every grid point owns its features, first on a coarse grid, then refined; (2) ``codebook``:
they are quantised under the metric of the loss (:mod:`warp_neumat.models.codebook`), then codebook and decoder are
tuned, with re-assignments in between; (3) ``round``: indices fixed, all values rounded to fp16 in the forward pass.

On the CPU loss and gradients come from one fused kernel (:mod:`warp_neumat.ops.brdf`). The plain torch forward is the
reference of the Warp kernels, and what is differentiated on CUDA.

Several materials can share codebook and decoder: each has grids of indices of its own (paper, Sec. 3.3).
"""

from __future__ import annotations

import dataclasses
import zlib

import numpy as np
import torch
from torch import nn

from warp_neumat import ops
from warp_neumat.io.asset import pack_bits, unpack_bits
from warp_neumat.kernels import dispatch
from warp_neumat.kernels.brdf_train import StepShape
from warp_neumat.kernels.healpix import hemisphere_point_count
from warp_neumat.kernels.healpix_tree import directions, expand
from warp_neumat.kernels.neubrdf import LOG_LIMIT
from warp_neumat.models import codebook as vq
from warp_neumat.models import reassign
from warp_neumat.models.feature_storage import feature_bytes, rounded4
from warp_neumat.models.healpix_grid import levels, refine
from warp_neumat.models.local_frame import corner_weights, to_local_frame
from warp_neumat.models.neubrdf_config import NeuBRDFConfig, configure
from warp_neumat.models.neural_texture import NeuralTexture
from warp_neumat.ops.brdf import BRDFStep

__all__ = ["DATA", "DEFAULT_STEPS", "NeuBRDF", "NeuBRDFConfig", "build", "configure", "from_asset"]

DATA = "brdf"
"""What kind of source the model is fitted to; :mod:`warp_neumat.training` picks sampler, loss and evaluation by it."""

VERSION = 2

DEFAULT_STEPS = 4800
"""Optimiser steps of a fit where the caller names none."""

MOST_PARTS = 8
"""Gradient buffers at most, one thread each: each costs the memory of the features, a share of the second-level cache
(two in turn on one core are a fifth slower than one), and the time to add it up."""


class NeuBRDF(nn.Module):
    """The trainable model. Continuous until its codebook was made, then built from ``codebook`` and ``indices``.

    Args:
        config: Its shape.
        seed: Decides the initial values, and nothing else does.
        count: Materials that share codebook and decoder.
    """

    def __init__(self, config: NeuBRDFConfig, seed: int = 0, count: int = 1):
        super().__init__()
        self.config, self.count = config, count
        generator = torch.Generator().manual_seed(seed)
        k, groups = config.features, ((config.features, 4), (config.features, 4))
        self.texture = None
        if config.texture is not None:
            self.texture = NeuralTexture(*config.texture, generator=generator)
            groups += ((config.texture[2], NeuralTexture.TAPS),)
        self.shape = StepShape(groups, config.hidden)
        self._lattice = None  # HEALPix
        if config.pixelation != "healpix":
            from warp_neumat.kernels.pixelations import PIXELATIONS  # for comparison alone

            self._lattice = PIXELATIONS[config.pixelation]
        self._levels = levels(config.nside) if self._lattice is None else [config.nside]
        self.register_buffer("level", torch.tensor(0))
        self.points = self._points(config.nside)
        # Features start as smooth functions of the direction (the direction itself first), so that the decoder sees
        # coordinates from the first step on instead of having to untangle noise.
        slope = torch.randn(3, k, generator=generator) * 1.5
        phase = torch.rand(k, generator=generator) * 6.2832
        self.table = nn.Parameter(torch.zeros(count * 2 * self.points, k))
        self._fill(slope, phase)
        self.codebook = nn.Parameter(torch.zeros(1 << config.bits, k))
        self.register_buffer("indices", torch.zeros(count * 2 * self.points, dtype=torch.int32))
        self.register_buffer("live", torch.zeros(count * 2 * self.points, dtype=torch.bool))
        self.register_buffer("quantised", torch.tensor(False))
        self.rounded = False
        self.net = nn.Parameter(self._initial_net(generator))
        self.support: tuple[torch.Tensor, torch.Tensor] | None = None
        """ω_i and ω_o, (n, 3) each, of every sample of a source that is a list: the points they touch are stored."""
        self._step = None

    def _points(self, nside: int) -> int:
        return hemisphere_point_count(nside) if self._lattice is None else self._lattice.points(nside)

    def _fill(self, slope, phase) -> None:
        nside = self.nside
        position = directions(nside) if self._lattice is None else self._lattice.positions(nside)
        position = torch.tensor(position, dtype=torch.float32)
        smooth = torch.sin(position @ slope + phase)
        smooth[:, :3] = position
        with torch.no_grad():
            self.table[: self.count * 2 * len(position)] = smooth.repeat(2 * self.count, 1)

    def _initial_net(self, generator) -> torch.Tensor:
        net, shape = torch.zeros(self.shape.weights), self.shape
        widths = (shape.inputs, *shape.hidden, 3)
        for layer, ((weight, _), fan_in) in enumerate(zip(self.layers(net), widths, strict=False)):
            scale = (2.0 / fan_in) ** 0.5 * (0.1 if layer == len(shape.hidden) else 1.0)
            weight.copy_(torch.randn(weight.shape, generator=generator) * scale)
        return net

    @property
    def nside(self) -> int:
        """Resolution of the grids at present: the fit starts coarse."""
        return self._levels[int(self.level)]

    def layers(self, net: torch.Tensor | None = None) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Return (weight (out, in), bias (out,)) of every layer, views of the packed parameters ``net``."""
        net, shape = self.net if net is None else net, self.shape
        found = []
        for n, width in enumerate(shape.hidden):
            bias, weights = shape.offsets[n]
            matrix = net[weights : weights + shape.rows[n] * width].view(shape.rows[n], width)
            inputs = shape.inputs if n == 0 else shape.hidden[n - 1]
            found.append((matrix[:inputs].T, net[bias : bias + width]))
        bias, weights = shape.offsets[-1]
        return [*found, (net[weights:].view(3, -1), net[bias : bias + 3])]

    # --- evaluation ---

    def prepare(self, samples: dict[str, torch.Tensor], interpolation: str | None = None) -> dict[str, torch.Tensor]:
        """Find the grid points of unit directions ``wi`` and ``wo``, (B, 3) each, once for all later passes.

        ``interpolation`` names the corner weights; default: those that the fit sees.

        ``material`` (B,) numbers the material where several share; ``uv`` (B, 2) and ``lod`` (B,) where it is textured.
        Returns ``corner`` (B, taps) int32, rows of the present grids (and texels), and ``weight`` (B, taps) float32.
        """
        config, points = self.config, self._points(self.nside)
        corners, weights = [], []
        base = samples["material"].view(-1, 1).int() * (2 * points) if "material" in samples else 0
        for side, direction in enumerate(to_local_frame(samples["wi"], samples["wo"], config.frame, config.symmetry)):
            if self._lattice is None:
                corner, weight = corner_weights(self.nside, direction, interpolation or config.training_interpolation)
            else:
                corner, weight = self._lattice.corners(self.nside, direction.contiguous())
            corners.append(corner + (base + side * points))
            weights.append(weight)
        if self.texture is not None:
            texel, weight = self.texture.taps(samples["uv"], samples["lod"])
            corners.append(texel)
            weights.append(weight)
        return {"corner": torch.cat(corners, 1), "weight": torch.cat(weights, 1)}

    def _value(self, parameter):
        """The parameter as it will be stored: rounded, gradient straight through, where the stage asks for it."""
        if self.config.storage == "4bit" and parameter is self.table and self.rounded:
            return rounded4(parameter)
        return parameter + (parameter.half().float() - parameter).detach() if self.rounded else parameter

    def rows(self, corner: torch.Tensor) -> torch.Tensor:
        """Return the rows of the table that the grid points ``corner`` (…) stand for: themselves, or their indices."""
        return self.indices[corner.long()] if self.quantised else corner

    def gather(self, batch) -> torch.Tensor:
        """Return the network's inputs [ψ_0, ψ_1, φ], (B, inputs)."""
        k = self.config.features
        corner, weight = batch["corner"][:, :8].reshape(-1, 4), batch["weight"][:, :8].reshape(-1, 4)
        table = self._value(self.codebook if self.quantised else self.table)
        psi = ops.grid_gather(table, self.rows(corner), weight).view(-1, 2 * k)
        if self.texture is None:
            return psi
        texels = self._value(self.texture.texels)
        return torch.cat([psi, ops.grid_gather(texels, batch["corner"][:, 8:], batch["weight"][:, 8:])], 1)

    def decode(self, psi: torch.Tensor) -> torch.Tensor:
        """Return y = log(1 + f), (B, 3), of the network's inputs."""
        layers = self.layers(self._value(self.net))
        for weight, bias in layers[:-1]:
            psi = torch.relu(nn.functional.linear(psi, weight, bias))
        return nn.functional.linear(psi, *layers[-1])

    def predict(self, batch) -> torch.Tensor:
        """Return the BRDF of a prepared batch in 1/sr, (B, 3), not clamped at 0 so that every sample has a gradient."""
        return torch.expm1(self.decode(self.gather(batch)).clamp_max(LOG_LIMIT))

    def forward(self, wi, wo, uv=None, lod=None, material=None) -> torch.Tensor:
        """Return the BRDF in 1/sr without the cosine, (N, 3); 0 below the horizon.

        Error: at most 1e-4 of 1 + f against the float64 reference, held by test_forward_matches_float64; seen 8e-5 on a
        fitted metal with a peak of 800.
        """
        above = (wi[:, 2:] > 0) & (wo[:, 2:] > 0)
        zenith = wi.new_tensor([0.0, 0.0, 1.0])  # stands in below the horizon, where the grids end
        samples = {"wi": torch.where(above, wi, zenith), "wo": torch.where(above, wo, zenith)}
        if self.texture is not None:
            samples |= {"uv": uv, "lod": wi.new_zeros(len(wi)) if lod is None else lod}
        if material is not None:
            samples["material"] = torch.full((len(wi),), material, dtype=torch.int32, device=wi.device)
        batch = self.prepare(samples, self.config.interpolation)
        value = torch.expm1(self.decode(self.gather(batch)).clamp_max(LOG_LIMIT)).clamp_min(0.0)
        return torch.where(above, value, 0.0)

    @torch.no_grad()
    def evaluate(self, wi: np.ndarray, wo: np.ndarray, uv=None, lod=None, material=None) -> np.ndarray:
        """Return :meth:`forward` for numpy directions, (N, 3) float32."""
        if len(wi) == 0:
            return np.empty((0, 3), np.float32)
        given = [None if a is None else np.ascontiguousarray(a, np.float32) for a in (wi, wo, uv, lod)]
        arrays = [None if a is None else torch.from_numpy(a) for a in given]
        parts = [slice(i, i + (1 << 16)) for i in range(0, len(wi), 1 << 16)]
        values = [self(*(None if a is None else a[part] for a in arrays), material).numpy() for part in parts]
        return np.concatenate(values)

    # --- training ---

    def gradients(self, batch, loss) -> torch.Tensor:
        """Return the mean ``loss`` of a batch and set the gradients of all parameters of the present stage.

        A batch is what :meth:`prepare` and ``loss.target`` returned, cut to its size. On the CPU in one fused pass.
        """
        if self.net.device.type != "cpu" or len(batch["corner"]) % 64:
            value = loss(self.predict(batch), batch)
            value.backward()
            return value.detach()
        table = self.codebook if self.quantised else self.table
        step = self._fused(len(batch["corner"]), loss)
        words = table.numel()
        with torch.no_grad():
            step.table[:words].copy_(self._value(table).view(-1))
            if self.texture is not None:
                step.table[words : words + self.texture.texels.numel()].copy_(self._value(self.texture.texels).view(-1))
            step.net.copy_(self._value(self.net))
        step.run(self.mapped(batch), batch["weight"], batch["cosine"], batch["target"])
        gradient = step.table_gradient
        table.grad = gradient[:words].view_as(table)
        if self.texture is not None:
            texels = self.texture.texels
            texels.grad = gradient[words : words + texels.numel()].view_as(texels)
        self.net.grad = step.weight_gradient
        return step.losses.mean()

    def mapped(self, batch) -> torch.Tensor:
        """Return the rows (B, taps) int32 that a batch gathers at present."""
        if not self.quantised:
            return batch["corner"]
        return torch.cat([self.rows(batch["corner"][:, :8]), batch["corner"][:, 8:]], 1)

    def _fused(self, batch: int, loss) -> BRDFStep:
        table = self.codebook if self.quantised else self.table
        key = (batch, bool(self.quantised), loss)
        if self._step is None or self._step[0] != key:
            words, texels = table.numel(), 0 if self.texture is None else self.texture.texels.numel()
            parts = min(MOST_PARTS, dispatch.worker_count())
            offsets = [0, 0, words][: len(self.shape.groups)]
            self._step = key, BRDFStep(
                self.shape, torch.zeros(words + texels), offsets, torch.zeros(self.shape.weights), batch=batch,
                parts=parts, sharpness=loss.sharpness, softness=loss.softness,
            )  # fmt: skip
        return self._step[1]

    def stages(self) -> list[dict]:
        """Return the stages in order: name, kind, share of the steps, learning rate at start and end, events."""
        quantised = self.config.storage == "codebook"
        features = 0.5 if quantised else 0.85
        coarse = 0.12 * (len(self._levels) - 1)
        stages = [
            {"name": f"features, nside {nside}", "kind": "features", "share": 0.12, "lr": (5e-3, 2e-3), "events": 0}
            for nside in self._levels[:-1]
        ]
        first = 4e-3 if len(self._levels) == 1 else 2e-3
        rest = features - coarse
        stages.append({"name": "features", "kind": "features", "share": rest, "lr": (first, 2e-4), "events": 0})
        if quantised:
            stages.append({"name": "codebook", "kind": "codebook", "share": 0.35, "lr": (1e-3, 2e-4), "events": 6})
        stages.append({"name": "round", "kind": "round", "share": 0.15, "lr": (2e-4, 1e-5), "events": 0})
        return stages

    def trainable(self, stage: dict) -> list[nn.Parameter]:
        """Return the parameters that ``stage`` trains."""
        own = self.codebook if self.quantised else self.table
        return [own, self.net, *([] if self.texture is None else [self.texture.texels])]

    @property
    def step_threads(self) -> int | None:
        """Threads of torch that a step deserves: 1 beside the fused kernel where its arrays are small, None for all."""
        return 1 if self.table.device.type == "cpu" and self.table.numel() < 1 << 18 else None

    def rates(self, parameters) -> list[float]:
        """Return the factors of the learning rate: texels are seen by few samples each, and take longer steps."""
        return [1.0, 1.0, 3.0][: len(parameters)]

    def event_samples(self) -> int:
        """Return how many samples :meth:`begin` and :meth:`event` need to know every grid point."""
        wanted = min(max(4096, 32 * self.points) * self.count, 1 << 19)
        whole = 4096 if wanted <= 16384 else 16384  # batches of one size
        return -(-wanted // whole) * whole

    def begin(self, stage: dict, batches, loss, generator: torch.Generator) -> None:
        """Prepare ``stage`` from ``batches()``, prepared samples; ``loss.residual(value, batch)`` is squared."""
        if stage["kind"] == "features" and stage["name"] != self.stages()[0]["name"]:
            self._refine()
        if stage["kind"] == "codebook":
            batches = list(batches())
            self._observe(batches)
            if self.support is not None:
                wi, wo = self.support
                self._observe(
                    self.prepare({"wi": i, "wo": o}) for i, o in zip(wi.split(65536), wo.split(65536), strict=True)
                )
            live = torch.nonzero(self.live).flatten()
            features, words = self.table.detach()[live], torch.zeros_like(self.codebook)
            if len(live) <= len(words):  # a primitive for every point
                index = torch.arange(len(live))
                words[: len(live)] = features
            else:
                metric = reassign.metric(self, batches, loss)[live]
                words, index = vq.fit(features.cpu(), metric.cpu(), len(words), generator)
            with torch.no_grad():
                self.codebook.copy_(words)
                self.indices[live] = index.to(self.indices)
                self.quantised.fill_(True)
            self._inherit()

    def enter(self, stage: dict) -> None:
        """Set what ``stage`` needs beyond the state that a checkpoint holds."""
        self.rounded = stage["kind"] == "round"

    def event(self, stage: dict, batches, loss) -> None:
        """Choose the primitive of every grid point anew; see :func:`warp_neumat.models.reassign.sweep`."""
        if int(self.live.sum()) > len(self.codebook):  # else every point has a primitive of its own
            reassign.sweep(self, list(batches()), loss)
            self._inherit()

    def _inherit(self) -> None:
        """Give the points that are not stored the indices that a file gives them: their ancestors'."""
        if self._lattice is not None:
            return
        for material in range(self.count):
            own = self._own(material)
            live, indices = self.live[own].cpu().numpy(), self.indices[own].cpu().numpy()
            full = np.asarray(expand(self.config.nside, live, indices[live]), np.int32)
            self.indices[own] = torch.from_numpy(full).to(self.indices)

    def _own(self, material: int) -> slice:
        """Return where a material's points lie among all."""
        return slice(material * 2 * self.points, (material + 1) * 2 * self.points)

    def _refine(self) -> None:
        nside, points = self.nside, self._points(self.nside)
        grids = [refine(self.table.detach()[g * points : (g + 1) * points], nside) for g in range(2 * self.count)]
        with torch.no_grad():
            self.level += 1
            self.table[: 2 * self.count * self._points(self.nside)] = torch.cat(grids)

    def _observe(self, batches) -> None:
        """Note which grid points samples touch; the others are not stored."""
        for batch in batches:
            self.live[batch["corner"][:, :8][batch["weight"][:, :8] > 0].long()] = True

    # --- storing ---

    @property
    def has_file(self) -> bool:
        """Whether the model can be stored: not what is fitted for comparison alone."""
        return self.config.storage == "codebook" and self.config.pixelation == "healpix"

    @property
    def bytes(self) -> int:
        """Size of the features as they are or would be stored, without the decoder."""
        config = self.config
        storage = "vq" if config.storage == "codebook" else config.storage
        return feature_bytes(self.points, config.features, storage, config.bits)

    def to_asset(self, material: int = 0) -> tuple[dict[str, np.ndarray], dict]:
        """Return (tensors, header) of the ``.neumat`` file: codebook and weights fp16, indices as a bit stream."""
        config = self.config
        if not self.has_file:
            raise ValueError(f"storage {config.storage} on {config.pixelation} is for comparison; it has no file")
        rows = int(self.indices[self.live].max()) + 1  # primitives beyond them stand for nothing
        tensors = {"codebook": self.codebook.detach()[:rows].half().numpy(), **self.grids(material)}
        for number, (weight, bias) in enumerate(self.layers(self.net.detach())):
            tensors[f"weight{number}"] = weight.half().contiguous().numpy()
            tensors[f"bias{number}"] = bias.half().numpy()
        texture = None
        if self.texture is not None:
            tensors |= {f"texture.mip{m}": mip for m, mip in enumerate(self.texture.mips())}
            width, height, channels = config.texture
            texture = {"width": width, "height": height, "channels": channels, "mips": len(self.texture.sizes)}
        fields = {k: v for k, v in dataclasses.asdict(config).items() if k not in ("storage", "pixelation")}
        return tensors, {
            "kind": "neubrdf",
            "version": VERSION,
            "config": {**fields, "hidden": list(config.hidden), "texture": texture},
        }

    def grids(self, material: int = 0) -> dict[str, np.ndarray]:
        """Return what is a material's own: ``indices``, and ``live`` where points are left out."""
        own = self._own(material)
        indices, live = self.indices[own].numpy(), self.live[own].numpy()
        if live.all():
            return {"indices": pack_bits(indices, self.config.bits)}
        mask = np.frombuffer(zlib.compress(np.packbits(live, bitorder="little").tobytes(), 9), np.uint8)
        return {"indices": pack_bits(indices[live], self.config.bits), "live": mask.copy()}

    def statistics(self) -> dict:
        """Return what a person wants to know of the result: primitives in use, and grid points that are stored."""
        used = len(torch.unique(self.indices[self.live]))
        return {
            "codebook_used": used,
            "codebook_size": 1 << self.config.bits,
            "points_live": int(self.live.sum()),
            "points": len(self.live),
        }


def build(config: NeuBRDFConfig, seed: int, count: int = 1) -> NeuBRDF:
    """Return the untrained model."""
    return NeuBRDF(config, seed, count)


def from_asset(tensors: dict[str, np.ndarray], config: dict) -> NeuBRDF:
    """Return the model that an asset's ``tensors`` and ``config`` hold, with its fp16 values."""
    config = dict(config)
    texture = config.pop("texture", None)
    if texture is not None:
        config["texture"] = (texture["width"], texture["height"], texture["channels"])
    model = NeuBRDF(NeuBRDFConfig(**config))
    points, bits = model.config.points, model.config.bits
    live = np.ones(2 * points, bool)
    if "live" in tensors:
        packed = zlib.decompressobj().decompress(tensors["live"].tobytes(), -(-2 * points // 8))
        raw = np.frombuffer(packed, np.uint8)
        live = np.unpackbits(raw, bitorder="little", count=2 * points).astype(bool)
    indices = expand(model.config.nside, live, unpack_bits(tensors["indices"], bits, int(live.sum())))
    with torch.no_grad():
        model.level.fill_(len(model._levels) - 1)
        model.codebook[: len(tensors["codebook"])] = torch.from_numpy(tensors["codebook"].astype(np.float32))
        model.indices.copy_(torch.from_numpy(np.asarray(indices, np.int32)))
        model.live.copy_(torch.from_numpy(live))
        model.quantised.fill_(True)
        for number, (weight, bias) in enumerate(model.layers(model.net.data)):
            weight.copy_(torch.from_numpy(tensors[f"weight{number}"].astype(np.float32)))
            bias.copy_(torch.from_numpy(tensors[f"bias{number}"].astype(np.float32)))
        if model.texture is not None:
            model.texture.load([tensors[f"texture.mip{m}"] for m in range(len(model.texture.sizes))])
    return model
