"""Analytic BRDFs fitted to a source: what a renderer uses where it has no learned material. Baselines of [neubrdf].

- ``ggx``: a microfacet lobe over a diffuse base, f = k_d/π + F·D·V: GGX (Walter et al. 2007), height-correlated Smith
  (Heitz 2014, Eq. 99), Schlick's F. 7 numbers, 8 for an anisotropic source: k_d and f₀ RGB, α or (α_x, α_y).
- ``two_lobe``: a diffuse base and two lobes of the microfacet model of Löw et al. 2012, "BRDF Models for Accurate and
  Efficient Rendering of Glossy Surfaces": f = k_d/π + Σ S(1 − cosθ_h) F G/(cosθ_i cosθ_o), S(x) = A/(1 + B x)^C, with
  the V-shaped grooves' G. Differs: Schlick's F stands for the dielectric's. 15 numbers: k_d RGB and, for each lobe,
  A RGB, B, C and f₀. Isotropic; A is free, so that it need not conserve energy.

Directions as everywhere: ω_i to the light, z the normal; values in 1/sr without the cosine. Both are fitted under the
loss of the learned model, on samples from the same sampler: Adam from several starts at once, then from the best one
on more samples. Every parameter is free on the real line (logarithms, logits).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import numpy as np
import torch

from warp_neumat.training.losses import LogCosine
from warp_neumat.training.samplers import BRDFSampler

CHUNK = 1 << 15


@dataclasses.dataclass(frozen=True)
class FittedBRDF:
    """A baseline that was fitted: a BRDF source by itself."""

    name: str
    """Which baseline."""
    weights: np.ndarray
    """What its ``model`` takes, one row of float32."""
    model: Callable
    """``model(weights, wi, wo)`` → (N, 3), numpy."""
    values: dict
    """The parameters by name, in plain units."""
    seconds: float
    """Time of the fit."""
    isotropic: bool = True
    symmetry: str = "reciprocal"

    @property
    def parameters(self) -> int:
        """How many numbers describe it."""
        return self.weights.size

    @property
    def bytes(self) -> int:
        """Size in float32."""
        return 4 * self.parameters

    def eval(self, wi, wo) -> np.ndarray:
        """Return the BRDF for unit directions (N, 3) each as (N, 3) float32, 1/sr; 0 below the horizon."""
        wi, wo = (np.ascontiguousarray(d, np.float32) for d in (wi, wo))
        value = np.empty((len(wi), 3), np.float32)
        for first in range(0, len(wi), CHUNK):
            part = slice(first, first + CHUNK)
            value[part] = self.model(self.weights, wi[part], wo[part])
        value[(wi[:, 2] <= 0) | (wo[:, 2] <= 0)] = 0.0
        return value


def in_numpy(value) -> Callable:
    """Return a torch model of this module as one of numpy."""

    def model(weights, wi, wo):
        with torch.inference_mode():
            return value(*(torch.from_numpy(a) for a in (weights, wi, wo))).numpy()

    return model


def _angles(wi, wo):
    """Return half vectors (B, 3), cosθ_d (B, 1), cosθ_i and cosθ_o (B, 1)."""
    half = torch.nn.functional.normalize(wi + wo, dim=-1, eps=1e-20)
    cosine = (wi * half).sum(-1, keepdim=True).clamp(0.0, 1.0)
    return half, cosine, wi[:, 2:].clamp_min(1e-6), wo[:, 2:].clamp_min(1e-6)


def _schlick(f0, cosine):
    weak = 1.0 - cosine
    square = weak * weak
    return f0 + (1.0 - f0) * (square * square * weak)


# A model's parameters are one row of P numbers, or (S, P) for S starts; they broadcast over the samples as (…, B, 3).


def ggx_value(p, wi, wo):
    """Return f of parameters ``p`` (…, 7 or 8): k_d (log) and f₀ (logit) RGB, then log α or log α_x, log α_y."""
    half, cosine, zi, zo = _angles(wi, wo)
    p = p[..., None, :]
    diffuse, f0 = torch.exp(p[..., 0:3]), torch.sigmoid(p[..., 3:6])
    ax, ay = torch.exp(p[..., 6:7]), torch.exp(p[..., -1:])
    stretch = (half[:, :1] / ax) ** 2 + (half[:, 1:2] / ay) ** 2 + half[:, 2:] ** 2
    distribution = 1.0 / (math.pi * ax * ay * stretch * stretch)
    si = zo * torch.sqrt((ax * wi[:, :1]) ** 2 + (ay * wi[:, 1:2]) ** 2 + zi * zi)
    so = zi * torch.sqrt((ax * wo[:, :1]) ** 2 + (ay * wo[:, 1:2]) ** 2 + zo * zo)
    return diffuse / math.pi + _schlick(f0, cosine) * (0.5 * distribution / (si + so))


def two_lobe_value(p, wi, wo):
    """Return f of parameters ``p`` (…, 15): k_d (log) RGB, then for each lobe log A RGB, log B, log C, logit f₀."""
    half, cosine, zi, zo = _angles(wi, wo)
    p = p[..., None, :]
    hz = half[:, 2:]
    away = (half[:, :2] ** 2).sum(-1, keepdim=True) / (1.0 + hz)  # 1 − cosθ_h without cancellation
    groove = (2.0 * hz * torch.minimum(zi, zo) / cosine.clamp_min(1e-6)).clamp_max(1.0) / (zi * zo)
    value = torch.exp(p[..., 0:3]) / math.pi
    for first in (3, 9):
        lobe = p[..., first : first + 6]
        steep = torch.log1p(torch.exp(lobe[..., 3:4]) * away)
        shape = torch.exp(lobe[..., 0:3] - torch.exp(lobe[..., 4:5]) * steep)
        value = value + shape * _schlick(torch.sigmoid(lobe[..., 5:6]), cosine) * groove
    return value


def _ggx_starts(diffuse, isotropic: bool) -> torch.Tensor:
    shapes = [(a, f) for a in (0.01, 0.04, 0.15, 0.5) for f in (-3.0, 0.0)]
    rows = [[*diffuse, f, f, f, *[math.log(a)] * (1 if isotropic else 2)] for a, f in shapes]
    return torch.tensor(rows)


def _two_lobe_starts(diffuse) -> torch.Tensor:
    rows = []
    for sharp in (1e2, 3e3, 1e5):
        for peak in (0.3, 10.0):
            narrow = [math.log(peak)] * 3 + [math.log(sharp), math.log(1.5), -3.0]
            wide = [math.log(0.1 * peak)] * 3 + [math.log(0.03 * sharp), math.log(1.5), -3.0]
            rows.append([*diffuse, *narrow, *wide])
    return torch.tensor(rows)


def _diffuse(samples) -> list[float]:
    """Return log of π times the lower quartile of the value: what is left far from a highlight."""
    value = np.quantile(samples["value"], 0.25, axis=0) * np.pi
    return [math.log(min(max(v, 1e-4), 1.0)) for v in value.tolist()]


def fit_analytic(name: str, source, *, seed: int, steps: int) -> tuple[np.ndarray, dict]:
    """Return (parameters (P,), the same by name in plain units) of ``"ggx"`` or ``"two_lobe"`` fitted to ``source``.

    A third of the steps goes to all starts alike, the rest to the best one.
    """
    rng = np.random.default_rng(seed)
    loss = LogCosine()
    drawn = BRDFSampler(source, rng).draw(1 << 16)
    samples = {key: torch.from_numpy(value) for key, value in drawn.items()}
    samples.update(loss.target(samples))
    anisotropic = name == "ggx" and not source.isotropic
    start = _ggx_starts(_diffuse(drawn), not anisotropic) if name == "ggx" else _two_lobe_starts(_diffuse(drawn))
    model = {"ggx": ggx_value, "two_lobe": two_lobe_value}[name]
    early = steps // 3
    rows, worth = _descend(model, start, samples, loss, rng, early, 1024, 0.1)
    best, _ = _descend(model, rows[worth.argmin()], samples, loss, rng, steps - early, 8192, 0.05)
    return best.numpy(), _named(name, best)


def _descend(model, start, samples, loss, rng, steps: int, batch: int, rate: float):
    """Return (parameters, mean loss of each row over the samples) after ``steps`` of Adam with a cosine rate."""
    p = start.clone().requires_grad_()
    optimiser = torch.optim.Adam([p], lr=rate, betas=(0.9, 0.99))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(steps, 1), eta_min=1e-3 * rate)

    def worth(part):
        residual = loss.residual(model(p, part["wi"], part["wo"]), part)
        return torch.sqrt(residual * residual + loss.softness**2).mean((-2, -1))

    for _ in range(steps):
        first = int(rng.integers(0, len(samples["wi"]) - batch))  # they lie in random order
        total = worth({key: value[first : first + batch] for key, value in samples.items()}).sum()
        optimiser.zero_grad()
        total.backward()
        optimiser.step()
        schedule.step()
        with torch.no_grad():
            p.clamp_(-20.0, 20.0)
    with torch.no_grad():
        return p.detach(), worth({key: value[:8192] for key, value in samples.items()})


def _named(name: str, p: torch.Tensor) -> dict:
    p = p.double()
    colours = {"diffuse": torch.exp(p[:3]).tolist()}
    if name == "ggx":
        return {**colours, "f0": torch.sigmoid(p[3:6]).tolist(), "alpha": torch.exp(p[6:]).tolist()}
    for number, first in enumerate((3, 9)):
        lobe = p[first : first + 6]
        a, (b, c) = torch.exp(lobe[:3]).tolist(), torch.exp(lobe[3:5]).tolist()
        colours[f"lobe{number}"] = {"a": a, "b": b, "c": c, "f0": float(torch.sigmoid(lobe[5]))}
    return colours
