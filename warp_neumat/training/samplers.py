"""Where a fit looks at its source: directions drawn from a mixture that covers what pictures show.

A BRDF is nearly constant over most of its domain and rises by orders of magnitude within a degree of the mirror
direction, so uniform directions alone would hardly ever see a highlight. Three strategies share every batch:

- both directions uniform in the projected hemisphere (what an evenly lit picture shows),
- ω_o likewise and ω_i mirrored about a half vector at angle θ_h = (π/2)·u², u uniform: MERL's own spacing,
- ω_o towards the horizon, ω_i likewise or mirrored (Fresnel reflection lives there).
"""

from __future__ import annotations

import numpy as np

MIXTURE = {"cosine": 0.35, "peak": 0.45, "grazing": 0.2}
"""Share of each strategy in a batch."""


def _polar(z: np.ndarray, phi: np.ndarray) -> np.ndarray:
    sine = np.sqrt(np.maximum(1.0 - z * z, 0.0))
    phi = phi.astype(np.float32)  # ten times as fast as float64, and an azimuth needs no more
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], 1)


def _projected(count, rng, power=0.5):
    """Directions with z = u^power: 0.5 is cosine-weighted, larger leans to the horizon."""
    u, v = rng.random((2, count))
    return _polar(u**power, 2 * np.pi * v)


def _towards_horizon(count, rng, power):
    """Directions with z = u^1.5 and, every second one, z = u^power: the last degree counts in a white furnace."""
    return _projected(count, rng, np.where(np.arange(count) % 2, power, 1.5))


def _mirrored(wo, rng):
    """Reflect ω_o about half vectors with θ_h = (π/2)·u²; what falls below the horizon is drawn again."""
    wi = np.empty_like(wo)
    todo = np.arange(len(wo))
    for _ in range(8):
        u, v = rng.random((2, len(todo)))
        half = _polar(np.cos(0.5 * np.pi * u * u), 2 * np.pi * v)
        view = wo[todo]
        light = 2.0 * (half * view).sum(1, keepdims=True) * half - view
        wi[todo] = light
        todo = todo[light[:, 2] <= 0.0]
        if not len(todo):
            break
    wi[todo] = wo[todo] * (-1.0, -1.0, 1.0)  # the mirror direction itself always lies above
    return wi


class BRDFSampler:
    """Draws training samples from a BRDF source.

    Args:
        source: As returned by :func:`warp_neumat.io.brdf.open_brdf`.
        rng: Its draws are all that the samples depend on.
        mixture: Share of each strategy.
        horizon: How far half of the grazing samples lean: cos θ_o = u^horizon, u uniform.
    """

    def __init__(self, source, rng: np.random.Generator, mixture: dict[str, float] = MIXTURE, horizon: float = 3.0):
        self.source, self.rng, self.mixture, self.horizon = source, rng, mixture, horizon

    def directions(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return unit ω_i and ω_o, (count, 3) float32 each, from the mixture, in random order."""
        rng = self.rng
        peak, grazing = (int(self.mixture[k] * count) for k in ("peak", "grazing"))
        wo = np.concatenate([_projected(count - grazing, rng), _towards_horizon(grazing, rng, self.horizon)])
        wi = np.empty_like(wo)
        cosine = count - grazing - peak
        wi[:cosine] = _projected(cosine, rng)
        wi[cosine : count - grazing] = _mirrored(wo[cosine : count - grazing], rng)
        split = count - grazing // 2
        wi[count - grazing : split] = _mirrored(wo[count - grazing : split], rng)
        wi[split:] = _projected(count - split, rng, 1.0)
        # Which of the two is the viewer is arbitrary for reciprocal data; swapping every second pair covers both
        # grids alike.
        pair = np.stack([wi, wo]).astype(np.float32)
        pair[:, 1::2] = pair[::-1, 1::2].copy()
        pair[..., 2] = np.maximum(pair[..., 2], 1e-4)  # float32 may round a grazing direction below the horizon
        order = rng.permutation(count)
        return np.take(pair[0], order, axis=0), np.take(pair[1], order, axis=0)

    def draw(self, count: int) -> dict[str, np.ndarray]:
        """Return ``{"wi", "wo", "value"}``, each (count, 3) float32; value in 1/sr without the cosine."""
        wi, wo = self.directions(count)
        return {"wi": wi, "wo": wo, "value": self.source.eval(wi, wo)}


class ListSampler:
    """Draws from a source that is a list of measured samples, with replacement.

    Args:
        source: Its ``samples`` are (wi, wo, value), (N, 3) float32 each.
        rng: Its draws are all that the samples depend on.
    """

    def __init__(self, source, rng: np.random.Generator):
        self.source, self.rng = source, rng

    def draw(self, count: int) -> dict[str, np.ndarray]:
        """Return ``{"wi", "wo", "value"}``, each (count, 3) float32; value in 1/sr without the cosine."""
        wi, wo, value = self.source.samples
        chosen = self.rng.integers(len(wi), size=count)
        return {"wi": wi[chosen], "wo": wo[chosen], "value": value[chosen]}


def sampler(source, rng: np.random.Generator):
    """Return what draws training samples from ``source``."""
    return (BRDFSampler if getattr(source, "samples", None) is None else ListSampler)(source, rng)


def measured_directions(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return unit ω_i and ω_o spaced as a MERL table is, those below the horizon left out: (≤ count, 3) float32 each.

    Uniform in √θ_h, θ_d and φ_d (Rusinkiewicz); Matusik et al. 2003.
    """
    u, theta_d, phi_d, phi = rng.random((4, count)) * np.array([[1.0], [np.pi / 2], [np.pi], [2 * np.pi]])
    theta_h = np.pi / 2 * u * u
    d = _polar(np.cos(theta_d), phi_d)
    x, z = d[:, 0] * np.cos(theta_h) + d[:, 2] * np.sin(theta_h), d[:, 2] * np.cos(theta_h) - d[:, 0] * np.sin(theta_h)
    wi = np.stack([x * np.cos(phi) - d[:, 1] * np.sin(phi), x * np.sin(phi) + d[:, 1] * np.cos(phi), z], 1)
    half = _polar(np.cos(theta_h), phi)
    wo = 2.0 * (wi * half).sum(1, keepdims=True) * half - wi
    above = (wi[:, 2] > 1e-3) & (wo[:, 2] > 1e-3)
    return wi[above].astype(np.float32), wo[above].astype(np.float32)
