"""How much light a BRDF gives back (white furnace), and how far it is from reciprocal: deterministic quadrature.

For a fixed viewer ω_o the hemisphere of ω_i is walked by the half vector h = (θ, φ): dω_i = 4 (ω_o·h) sin θ dθ dφ.
With ω_o at azimuth 0 the directions ω_i above the horizon are exactly those with

    0 ≤ θ < Θ(φ) = π/4 + atan2(sin θ_o cos φ, cos θ_o)/2,

so the integrand has no edge inside, whatever the viewer. θ = Θ(φ) v⁴ puts points where highlights are, down to α =
0.0025; v runs over Gauss-Legendre nodes, and so does φ, apart over the
half that faces the viewer and over the other, because Θ changes fast between them when the viewer grazes.

``eval_fn(wi, wo) -> (N, 3)`` is the BRDF in 1/sr without the cosine, 0 below the horizon; numpy, float32 directions,
docs/conventions.md's frame.
"""

from __future__ import annotations

import functools

import numpy as np

ANGLES = tuple(np.radians([0, 5, 10, 15, 20, 25, 30, 35, 40, 45, 50, 55, 60, 65, 70, 74, 77, 80, 82, 84, 85, 86, 87, 88,
                           88.5, 89, 89.3, 89.5, 89.7, 89.8, 89.9]))  # fmt: skip
"""θ_o [rad] that energy is measured at: 0 to 89.9°, closer towards the horizon, where fits overshoot."""

SAMPLES = (64, 64)
"""Nodes of the half vector for one θ_o, radial × azimuthal."""

ANISOTROPIC_SAMPLES = (32, 192)
"""The same where the BRDF is not isotropic: a highlight 10 times as long as wide is narrow in azimuth."""

_POWER = 4
_TOGETHER = 8  # angles evaluated in one call: arrays of a few hundred kilobytes


@functools.cache
def _nodes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Gauss-Legendre nodes in (0, 1) and weights that add up to 1."""
    x, w = np.polynomial.legendre.leggauss(count)
    return 0.5 + 0.5 * x, 0.5 * w


def directions(theta_o: float, *, samples: tuple[int, int] = SAMPLES, azimuth: float = 0.0):
    """Return ω_i (n, 3) and ω_o (n, 3) float32, and the solid angles (n,) float64 that the pairs stand for.

    Args:
        theta_o: Angle of the viewer to the normal, in [0, π/2) rad.
        samples: Radial and azimuthal nodes, the latter an even number.
        azimuth: That of the viewer, rad.

    The solid angles add up to 2π.

    Raises: ValueError: If theta_o or samples is out of range.
    """
    if not 0 <= theta_o < np.pi / 2:
        raise ValueError(f"theta_o must be in [0, π/2), got {theta_o}; the horizon itself reflects nothing")
    radial, around = samples
    if radial < 1 or around < 2 or around % 2:
        raise ValueError(f"samples must be a positive and an even positive number, got {samples}")
    v, weight_v = _nodes(radial)
    p, weight_p = _nodes(around // 2)
    phi = np.concatenate([np.pi * (p - 0.5), np.pi * (p + 0.5)])  # towards the viewer, and away
    sine_o, cosine_o = np.sin(theta_o), np.cos(theta_o)
    limit = np.pi / 4 + 0.5 * np.arctan2(sine_o * np.cos(phi), cosine_o)
    theta = limit[:, None] * v**_POWER
    phi = np.broadcast_to(phi[:, None], theta.shape)
    half = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    along = sine_o * half[..., 0] + cosine_o * half[..., 2]
    wi = 2.0 * along[..., None] * half - [sine_o, 0.0, cosine_o]
    area = 4.0 * along * np.sin(theta) * limit[:, None] * (_POWER * v ** (_POWER - 1) * weight_v)
    area = area * (np.pi * np.concatenate([weight_p, weight_p]))[:, None]
    c, s = np.cos(azimuth), np.sin(azimuth)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    wi = (wi.reshape(-1, 3) @ turn).astype(np.float32)
    wo = np.broadcast_to((np.array([sine_o, 0.0, cosine_o]) @ turn).astype(np.float32), wi.shape)
    return wi, np.ascontiguousarray(wo), area.ravel()


def albedo(eval_fn, theta_o, *, samples: tuple[int, int] = SAMPLES, azimuth: float = 0.0) -> np.ndarray:
    """Return the directional albedo ∫ f cos θ_i dω_i for every angle of the viewer, shape (angles, 3) float64.

    Args:
        eval_fn: The BRDF.
        theta_o: Angles in [0, π/2) rad, or one.
        samples: Radial and azimuthal nodes of the half vector for each angle; the latter even.
        azimuth: Of the viewer, rad.

    Raises: ValueError: If an angle or samples is out of range.
    Error: relative, up to 89.9°: 1e-8 for a Lambertian surface, 4e-4 for GGX of α in [0.005, 1]; with the anisotropic
        samples 1.5e-3 for α_x/α_y up to 10; held by test_albedo_matches_brute_force.
    """
    pairs = [directions(float(t), samples=samples, azimuth=azimuth) for t in np.atleast_1d(theta_o)]
    result = np.empty((len(pairs), 3))
    for start in range(0, len(pairs), _TOGETHER):
        part = pairs[start : start + _TOGETHER]
        wi = np.concatenate([p[0] for p in part])
        value = np.asarray(eval_fn(wi, np.concatenate([p[1] for p in part])), np.float64).reshape(len(part), -1, 3)
        weight = np.stack([p[2] * np.maximum(p[0][:, 2], 0.0) for p in part])
        result[start : start + len(part)] = (weight[:, None] @ value)[:, 0]
    return result


def albedo_nodes(eval_fn, *, isotropic: bool = True) -> np.ndarray:
    """Return :func:`albedo` at :data:`ANGLES`, shape (nodes, 3): ω_o at azimuth 0, or also at 45, 90 and 135°."""
    samples = SAMPLES if isotropic else ANISOTROPIC_SAMPLES
    azimuths = np.arange(1 if isotropic else 4) * (np.pi / 4)
    return np.concatenate([albedo(eval_fn, ANGLES, samples=samples, azimuth=a) for a in azimuths])


def albedo_max(eval_fn, *, isotropic: bool = True) -> float:
    """Return the largest albedo over :func:`albedo_nodes` and the channels; above 1 the BRDF creates energy."""
    return float(albedo_nodes(eval_fn, isotropic=isotropic).max())


def energy(asset_fn, source_fn, *, isotropic: bool = True) -> dict[str, float]:
    """Return ``albedo_max``, ``albedo_max_source`` and ``albedo_excess`` of a stored BRDF and of what it was fitted to.

    ``albedo_excess`` is the largest ratio, over nodes and channels, of the stored BRDF's albedo to the larger of 1 and
    the source's own there: at most 1.01 means that the fit adds no more than 1 % of energy anywhere.
    """
    asset, source = (albedo_nodes(f, isotropic=isotropic) for f in (asset_fn, source_fn))
    return {
        "albedo_max": float(asset.max()),
        "albedo_max_source": float(source.max()),
        "albedo_excess": float((asset / np.maximum(1.0, source)).max()),
    }


def reciprocity_error(eval_fn, *, samples: tuple[int, int] = SAMPLES) -> float:
    """Return how far f(ω_i, ω_o) is from f(ω_o, ω_i), relative, weighted by the energy that each pair carries.

    It is the mean over pairs of |f(i, o) − f(o, i)|/m, m = (f(i, o) + f(o, i))/2, with weights m cos θ_i cos θ_o: the
    ratio of two integrals over both hemispheres, summed over the channels. Between 0 and 2; 0 where f is 0 everywhere.
    The viewer runs over 16 Gauss-Legendre nodes of cos² θ_o, each at an azimuth of its own.
    """
    nodes, weights = _nodes(16)
    golden = np.pi * (3.0 - np.sqrt(5.0))
    parts = [directions(np.arccos(np.sqrt(z2)), samples=samples, azimuth=n * golden) for n, z2 in enumerate(nodes)]
    wi, wo = (np.concatenate([p[k] for p in parts]) for k in (0, 1))
    # dω_o cos θ_o = π d(cos² θ_o), and constants cancel.
    weight = np.concatenate([p[2] * w for p, w in zip(parts, weights, strict=True)]) * np.maximum(wi[:, 2], 0.0)
    there, back = (np.asarray(f, np.float64) for f in (eval_fn(wi, wo), eval_fn(wo, wi)))
    mean = weight @ (0.5 * (there + back))
    return float((weight @ np.abs(there - back)).sum() / mean.sum()) if mean.sum() > 0 else 0.0
