"""NeuBRDF, the fitting side: two HEALPix corner grids of features, quantised to shared primitives, and a small decoder.

Paper [neubrdf], Sec. 3 (Eq. 1–3). ψ_i = Σ_t w_t D[S_i[p_t]] at ω_i, ψ_o the same at ω_o, f = max(exp(MLP([ψ_i, ψ_o])) −
1, 0). Differs: bilinear corner weights in the pixel's own coordinates (continuous; the paper trains with inverse
distance and runs with 1/4); the decoder predicts log(1 + f), because mirror peaks of several hundred stand beside
diffuse values of 0.01; an isotropic source is fitted in the frame where ω_o has azimuth 0 and ω_i is mirrored to y ≥ 0,
which leaves the codebook half a grid and one meridian to describe.

The fit: (1) ``features``: every grid point owns its features; (2) ``codebook``: they are quantised under the metric of
the loss (:mod:`warp_neumat.models.codebook`), then codebook and decoder are tuned, with re-assignments in between; (3)
``round``: indices fixed, all values rounded to fp16 in the forward pass. The plain torch forward is the reference of
the Warp kernel.
"""

from __future__ import annotations

import dataclasses
import difflib

import numpy as np
import torch
from torch import nn
from torch.nn.functional import embedding_bag

from warp_neumat import ops
from warp_neumat.io.asset import pack_bits, unpack_bits
from warp_neumat.models import codebook as vq

DATA = "brdf"
"""What kind of source the model is fitted to; :mod:`warp_neumat.training` picks sampler, loss and evaluation by it."""

VERSION = 1

_DAMPING = 0.02  # of a point's own curvature; keeps directions that the decoder ignores from running away

DEFAULT_STEPS = 4000
"""Optimiser steps of a fit where the caller names none."""


@dataclasses.dataclass(frozen=True)
class NeuBRDFConfig:
    """Everything that decides the shape of a NeuBRDF; the paper's default unless said otherwise."""

    nside: int = 64
    """HEALPix resolution N of both grids, 1 … 512; 6N² + 6N + 1 points each. Paper: 64."""
    features: int = 16
    """Width k of a primitive, 4 … 64. Paper: 16."""
    bits: int = 9
    """Bits b of an index, 1 … 16; the codebook holds 2^b primitives. Paper: 9."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the decoder's two hidden layers, multiples of 8. Paper: 64, 64."""
    interpolation: str = "bilinear"
    """Corner weights; only ``"bilinear"``. Paper: inverse distance in training, 1/4 at run time."""
    frame: str = "absolute"
    """``"absolute"`` (paper) or ``"isotropic"`` (ω_o turned to azimuth 0, ω_i mirrored to y ≥ 0)."""
    output: str = "expm1"
    """Decoder's output map; only ``"expm1"``: f = exp(y) − 1. Paper: linear."""

    def __post_init__(self):
        object.__setattr__(self, "hidden", tuple(int(width) for width in self.hidden))
        for name, low, high in (("nside", 1, 512), ("features", 4, 64), ("bits", 1, 16)):
            value = getattr(self, name)
            if not isinstance(value, int) or not low <= value <= high:
                raise ValueError(f"{name} must be a whole number in [{low}, {high}], got {value!r}")
        if len(self.hidden) != 2 or any(width < 8 or width % 8 for width in self.hidden):
            raise ValueError(f"hidden must be two multiples of 8, as 64,64, got {self.hidden}")
        for name, allowed in (
            ("interpolation", ("bilinear",)),
            ("frame", ("absolute", "isotropic")),
            ("output", ("expm1",)),
        ):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {getattr(self, name)!r}")

    @property
    def points(self) -> int:
        """Grid points of one hemisphere, with one ring beyond the equator."""
        return 6 * self.nside * self.nside + 6 * self.nside + 1


def configure(source, options: dict) -> NeuBRDFConfig:
    """Return the config for ``source``: ``options`` over the defaults.

    Isotropic sources get the isotropic frame and nside 32. Alum-bronze, 2400 steps: sphere MAE 0.0050 with the paper's
    64 (85 kB: 512 primitives are too few for its points) and 0.0030 with 32 (44 kB). 1600 steps at nside 32: chrome
    0.0024 in the isotropic and 0.0073 in the absolute frame.

    Raises:
        ValueError: If an option is unknown (names the nearest) or out of range.
    """
    fields = [field.name for field in dataclasses.fields(NeuBRDFConfig)]
    for key in options:
        if key not in fields:
            close = difflib.get_close_matches(key, fields, n=1, cutoff=0.0)[0]
            raise ValueError(f"neubrdf has no option {key!r}; nearest: {close}; known: {', '.join(fields)}")
    defaults = {"frame": "isotropic", "nside": 32} if source.isotropic else {}
    return NeuBRDFConfig(**{**defaults, **options})


def grid_points(nside: int) -> np.ndarray:
    """Return the unit directions of the n grid points, (n, 3) float64, ring by ring from the pole.

    Corner rings of HEALPix (Górski et al. 2005): cap ring r < N at z = 1 − r²/(3N²) with 4r points at φ = j(π/2)/r,
    belt ring r ≥ N at z = 2(2N − r)/(3N) with 4N points at φ = (j + ½[(r − N) odd])π/(2N).
    """
    rings = [np.array([[0.0, 0.0, 1.0]])]
    for ring in range(1, 2 * nside + 2):
        cap = ring < nside
        count = 4 * ring if cap else 4 * nside
        z = 1.0 - ring * ring / (3.0 * nside * nside) if cap else 2.0 * (2 * nside - ring) / (3.0 * nside)
        phi = (np.arange(count) + (0.0 if cap else 0.5 * ((ring - nside) & 1))) * (2.0 * np.pi / count)
        sine = np.sqrt(1.0 - z * z)
        rings.append(np.stack([sine * np.cos(phi), sine * np.sin(phi), np.full(count, z)], 1))
    return np.concatenate(rings)


def colours(nside: int) -> torch.Tensor:
    """Return a colour 0 … 3 of every grid point, (n,), such that the corners of a pixel differ.

    The corners of a pixel are one point of ring r, two neighbours of ring r + 1 and one of ring r + 2. (Along the seams
    of the base pixels and at |z| = 2/3 some pixels have two corners of one colour: harmless, they are then moved
    together.)
    """
    rings = []
    for ring in range(2 * nside + 2):
        cap = ring < nside
        count = 1 if ring == 0 else 4 * ring if cap else 4 * nside
        rings.append(2 * (ring & 1) + (torch.arange(count) + (0 if cap else ring >> 1)) % 2)
    return torch.cat(rings)


def _scatter(out: torch.Tensor, corner: torch.Tensor, weight: torch.Tensor, rows: torch.Tensor) -> None:
    """Add weight[b, t]·rows[b] to out[corner[b, t]], as one sorted segment sum."""
    order = torch.argsort(corner.flatten(), stable=True)
    target = corner.flatten()[order]
    hit, count = torch.unique_consecutive(target, return_counts=True)
    start = torch.cumsum(count, 0) - count
    source, weight = torch.div(order, corner.shape[1], rounding_mode="floor"), weight.flatten()[order]
    out[hit] += embedding_bag(source, rows, start, mode="sum", per_sample_weights=weight)


def to_local_frame(wi: torch.Tensor, wo: torch.Tensor, frame: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the directions as the grids see them; torch twin of ``reference.neubrdf.to_local_frame``."""
    if frame == "absolute":
        return wi, wo
    square = wo[:, 0] ** 2 + wo[:, 1] ** 2
    pole = square < 1e-12
    sine = torch.sqrt(torch.where(pole, 1.0, square))
    cos, sin = torch.where(pole, 1.0, wo[:, 0] / sine), torch.where(pole, 0.0, wo[:, 1] / sine)
    turned = torch.stack([wi[:, 0] * cos + wi[:, 1] * sin, (wi[:, 1] * cos - wi[:, 0] * sin).abs(), wi[:, 2]], 1)
    view = torch.stack([torch.where(pole, wo[:, 0], sine), torch.where(pole, wo[:, 1], 0.0), wo[:, 2]], 1)
    return turned, view


class NeuBRDF(nn.Module):
    """The trainable model. Continuous until :meth:`quantise` was called, then built from ``codebook`` and ``indices``.

    Args:
        config: Its shape.
        seed: Decides the initial values, and nothing else does.
    """

    def __init__(self, config: NeuBRDFConfig, seed: int = 0):
        super().__init__()
        self.config = config
        generator = torch.Generator().manual_seed(seed)
        # Features start as smooth functions of the direction (the direction itself first), so that the decoder sees
        # coordinates from the first step on instead of having to untangle noise.
        position = torch.tensor(grid_points(config.nside), dtype=torch.float32)
        slope = torch.randn(3, config.features, generator=generator) * 1.5
        smooth = torch.sin(position @ slope + torch.rand(config.features, generator=generator) * 6.2832)
        smooth[:, :3] = position
        self.table = nn.Parameter(torch.cat([smooth, smooth]))
        self.codebook = nn.Parameter(torch.zeros(1 << config.bits, config.features))
        self.register_buffer("indices", torch.zeros(2 * config.points, dtype=torch.int32))
        self.register_buffer("colour", colours(config.nside).repeat(2), persistent=False)
        self.register_buffer("quantised", torch.tensor(False))
        self.rounded = False
        widths = (2 * config.features, *config.hidden, 3)
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in zip(widths, widths[1:], strict=False))
        for layer, fan_in in zip(self.layers, widths, strict=False):
            with torch.no_grad():
                layer.weight.copy_(torch.randn(layer.weight.shape, generator=generator) * (2.0 / fan_in) ** 0.5)
                layer.bias.zero_()
        with torch.no_grad():
            self.layers[-1].weight.mul_(0.1)

    # --- evaluation ---

    def prepare(self, samples: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Find the grid points of unit directions ``wi`` and ``wo``, (B, 3) each, once for all later passes.

        Returns ``corner`` (B, 8) int32 (4 of ω_i, 4 of ω_o, offset by n) and ``weight`` (B, 8) float32."""
        local = to_local_frame(samples["wi"], samples["wo"], self.config.frame)
        pairs = [ops.healpix_corners(self.config.nside, direction.contiguous()) for direction in local]
        corner = torch.cat([pairs[0][0], pairs[1][0] + self.config.points], 1)
        return {"corner": corner, "weight": torch.cat([pairs[0][1], pairs[1][1]], 1)}

    def _value(self, parameter):
        """The parameter as it will be stored: rounded to fp16, gradient straight through, once ``rounded`` is set."""
        return parameter + (parameter.half().float() - parameter).detach() if self.rounded else parameter

    def gather(self, batch) -> torch.Tensor:
        """Return [ψ_i, ψ_o], (B, 2k)."""
        corner, weight = batch["corner"].view(-1, 4), batch["weight"].view(-1, 4)
        if self.quantised:
            corner, table = self.indices[corner], self._value(self.codebook)
        else:
            table = self.table
        return ops.grid_gather(table, corner, weight).view(-1, 2 * self.config.features)

    def decode(self, psi: torch.Tensor) -> torch.Tensor:
        """Return y = log(1 + f), (B, 3), of [ψ_i, ψ_o]."""
        for layer in self.layers[:-1]:
            psi = torch.relu(nn.functional.linear(psi, self._value(layer.weight), self._value(layer.bias)))
        last = self.layers[-1]
        return nn.functional.linear(psi, self._value(last.weight), self._value(last.bias))

    def predict(self, batch) -> torch.Tensor:
        """Return the BRDF of a prepared batch in 1/sr, (B, 3), not clamped at 0 so that every sample has a gradient."""
        return torch.expm1(self.decode(self.gather(batch)).clamp_max(16.0))

    def forward(self, wi: torch.Tensor, wo: torch.Tensor) -> torch.Tensor:
        """Return the BRDF in 1/sr without the cosine, (N, 3); 0 below the horizon.

        Error: at most 1e-4 of 1 + f against the float64 reference, held by test_forward_matches_float64; seen 8e-5 on a
        fitted metal with a peak of 800.
        """
        above = (wi[:, 2:] > 0) & (wo[:, 2:] > 0)
        zenith = wi.new_tensor([0.0, 0.0, 1.0])  # stands in below the horizon, where the grids end
        samples = {"wi": torch.where(above, wi, zenith), "wo": torch.where(above, wo, zenith)}
        value = torch.expm1(self.decode(self.gather(self.prepare(samples)))).clamp_min(0.0)
        return torch.where(above, value, 0.0)

    @torch.no_grad()
    def evaluate(self, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        """Return :meth:`forward` for numpy directions, (N, 3) float32."""
        parts = [slice(i, i + (1 << 16)) for i in range(0, len(wi), 1 << 16)]
        wi, wo = (torch.from_numpy(np.ascontiguousarray(d, np.float32)) for d in (wi, wo))
        return (
            np.concatenate([self(wi[part], wo[part]).numpy() for part in parts])
            if parts
            else np.empty((0, 3), np.float32)
        )

    # --- the fit's stages ---

    def stages(self) -> list[dict]:
        """Return the stages in order: name, share of the steps, learning rate at start and end, re-assignments."""
        return [
            {"name": "features", "share": 0.45, "lr": (4e-3, 4e-4), "events": 0},
            {"name": "codebook", "share": 0.40, "lr": (2e-3, 3e-4), "events": 6},
            {"name": "round", "share": 0.15, "lr": (3e-4, 1e-5), "events": 0},
        ]

    def trainable(self, stage: str) -> list[nn.Parameter]:
        """Return the parameters that ``stage`` trains."""
        return [self.table if stage == "features" else self.codebook, *self.layers.parameters()]

    def event_samples(self) -> int:
        """Return how many samples :meth:`begin` and :meth:`event` need to know every grid point."""
        return min(max(4096, 32 * self.config.points), 1 << 18)

    def begin(self, stage: str, batches, loss, generator: torch.Generator) -> None:
        """Prepare ``stage`` from prepared ``batches``; ``loss.residual(value, batch)`` is what is squared."""
        if stage == "codebook":
            metric = self.metric(batches, loss)
            words, index = vq.fit(self.table.detach().cpu(), metric.cpu(), 1 << self.config.bits, generator)
            with torch.no_grad():
                self.codebook.copy_(words)
                self.indices.copy_(index.int())
                self.quantised.fill_(True)

    def enter(self, stage: str) -> None:
        """Set what ``stage`` needs beyond the state that a checkpoint holds."""
        self.rounded = stage == "round"

    def event(self, stage: str, batches, loss) -> None:
        """Choose the primitive of every grid point anew: one Gauss–Seidel sweep on a fixed list of ``batches``.

        Points of one colour share no pixel, so with all others fixed each sees an exact least-squares problem of its
        own (but for the decoder's curvature). What one colour leaves over, the next takes into account: neighbours
        learn to average to values that no primitive holds. A change that does not lower the error of a point's samples
        is undone.
        """
        metric = self.metric(batches, loss)
        words, points = self.codebook.detach(), self.config.points
        size = metric.diagonal(dim1=1, dim2=2).mean(1)
        side = torch.arange(2 * points, device=words.device) // points
        eye = torch.eye(self.config.features, device=words.device)
        for part in range(8):
            live = torch.nonzero((size > 0) & (side == part // 4) & (self.colour == part % 4)).flatten()
            gradient, error = self.gradient(batches, loss)
            local = metric[live] + (_DAMPING * size[live])[:, None, None] * eye
            before = self.indices[live]
            target = words[before] - torch.linalg.solve(local, gradient[live])
            self.indices[live] = vq.assign(target, local, words)[0].int()
            worse = self.gradient(batches, loss, errors_only=True)[1][live] >= error[live]
            self.indices[live] = torch.where(worse, before, self.indices[live])

    def metric(self, batches, loss) -> torch.Tensor:
        """Return H = Σ w² JᵀJ of every grid point, (2n, k, k), J the derivative of the residuals by ψ, w the weight."""
        k, points = self.config.features, self.config.points
        metric = self.table.new_zeros(2 * points, k * k)
        for batch in batches:
            psi = self.gather(batch).detach().requires_grad_()
            residual = loss.residual(torch.expm1(self.decode(psi).clamp_max(16.0)), batch)
            jacobian = [torch.autograd.grad(residual[:, c].sum(), psi, retain_graph=c < 2)[0] for c in range(3)]
            jacobian = torch.stack(jacobian, 2).view(-1, 2, k, 3)
            square = (jacobian @ jacobian.transpose(2, 3)).view(-1, k * k)
            _scatter(metric, batch["corner"].view(-1, 4), batch["weight"].view(-1, 4) ** 2, square)
        return metric.view(2 * points, k, k)

    def gradient(self, batches, loss, errors_only: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
        """Return Σ w Jᵀr of every grid point, (2n, k), half the gradient of Σ r², and Σ r² of its samples, (2n,)."""
        k, total = self.config.features, 2 * self.config.points
        gradient, error = self.table.new_zeros(total, k), self.table.new_zeros(total, 1)
        for batch in batches:
            psi = self.gather(batch).detach().requires_grad_(not errors_only)
            residual = loss.residual(torch.expm1(self.decode(psi).clamp_max(16.0)), batch)
            corner, weight = batch["corner"].view(-1, 4), batch["weight"].view(-1, 4)
            square = residual.detach().square().sum(1, keepdim=True).repeat_interleave(2, 0)
            _scatter(error, corner, (weight > 0).float(), square)
            if not errors_only:
                pull = torch.autograd.grad((0.5 * residual * residual).sum(), psi)[0].view(-1, k)
                _scatter(gradient, corner, weight, pull)
        return gradient, error[:, 0]

    # --- storing ---

    def to_asset(self) -> tuple[dict[str, np.ndarray], dict]:
        """Return (tensors, header) of the ``.neumat`` file: codebook and weights fp16, indices as a bit stream."""
        tensors = {
            "codebook": self.codebook.detach().half().numpy(),
            "indices": pack_bits(self.indices.numpy(), self.config.bits),
        }
        for number, layer in enumerate(self.layers):
            tensors[f"weight{number}"] = layer.weight.detach().half().numpy()
            tensors[f"bias{number}"] = layer.bias.detach().half().numpy()
        config = dataclasses.asdict(self.config)
        return tensors, {
            "kind": "neubrdf",
            "version": VERSION,
            "config": {**config, "hidden": list(self.config.hidden)},
        }

    def statistics(self) -> dict:
        """Return what a person wants to know of the result: the share of primitives in use."""
        used = len(torch.unique(self.indices))
        return {"codebook_used": used, "codebook_size": 1 << self.config.bits}


def build(config: NeuBRDFConfig, seed: int) -> NeuBRDF:
    """Return the untrained model."""
    return NeuBRDF(config, seed)


def from_asset(tensors: dict[str, np.ndarray], config: dict) -> NeuBRDF:
    """Return the model that an asset's ``tensors`` and ``config`` hold, with its fp16 values."""
    model = NeuBRDF(NeuBRDFConfig(**config))
    with torch.no_grad():
        model.codebook.copy_(torch.from_numpy(tensors["codebook"].astype(np.float32)))
        model.indices.copy_(
            torch.from_numpy(unpack_bits(tensors["indices"], model.config.bits, 2 * model.config.points))
        )
        model.quantised.fill_(True)
        for number, layer in enumerate(model.layers):
            layer.weight.copy_(torch.from_numpy(tensors[f"weight{number}"].astype(np.float32)))
            layer.bias.copy_(torch.from_numpy(tensors[f"bias{number}"].astype(np.float32)))
    return model
