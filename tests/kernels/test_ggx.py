"""The metallic-roughness BRDF against its float64 twin, in a white furnace, and at the edges of its domain."""

import numpy as np
import pytest

from warp_neumat.kernels.ggx import ggx_eval
from warp_neumat.reference.ggx import ggx as reference


def _hemisphere(rng, count, least=0.0):
    """Directions uniform over the hemisphere, z at least ``least``; float32."""
    z = rng.uniform(least, 1, count)
    phi = rng.uniform(0, 2 * np.pi, count)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], 1).astype(np.float32)


def _mirrored(wo, rng, spread):
    """Directions close to the mirror direction of ``wo``: the lobe of a smooth surface is missed by random ones."""
    wi = wo * np.float32([-1, -1, 1]) + rng.normal(size=wo.shape).astype(np.float32) * np.float32(spread)
    return (wi / np.linalg.norm(wi, axis=1, keepdims=True)).astype(np.float32)


def _error(rng, count, roughness, *, least=0.0, spread=None, normal=None):
    wo = _hemisphere(rng, count, least)
    wi = _hemisphere(rng, count) if spread is None else _mirrored(wo, rng, spread)
    arguments = (wi, wo, rng.random((count, 3)), roughness, rng.random(count).astype(np.float32))
    dielectric = rng.uniform(0, 0.2, count).astype(np.float32)
    options = {"dielectric": dielectric} | ({} if normal is None else {"normal": normal})
    got, expected = ggx_eval(*arguments, **options), reference(*arguments, **options)
    assert (expected > 0).any(1).mean() > 0.4
    return (np.abs(got - expected) / (expected + 1e-3)).max()


def test_ggx_matches_float64(rng):
    n = 200_000
    # Worst of 10 seeds (AVX2, 2026-11-22): 7e-6, 1.6e-3, 1.5e-4; roughness from 0.1 makes 4e-4 of the second.
    assert _error(rng, n, rng.uniform(0.3, 1, n).astype(np.float32)) < 2e-5
    assert _error(rng, n, rng.uniform(0.0, 1, n).astype(np.float32), least=0.02, spread=0.02) < 4e-3
    assert _error(rng, n, rng.uniform(0.1, 1, n).astype(np.float32), least=0.02, spread=0.02) < 1e-3
    bent = _hemisphere(rng, n, 0.3)
    assert _error(rng, n, rng.uniform(0.3, 1, n).astype(np.float32), normal=bent) < 5e-4


def _albedo(cosine, roughness, metallic, side=300):
    """Directional albedo of a white surface: both its lobes are sampled, and combined by the balance heuristic."""
    u, v = (a.ravel() for a in np.meshgrid(*2 * [(np.arange(side) + 0.5) / side]))
    wo = np.array([np.sqrt(1 - cosine**2), 0.0, cosine])
    a2 = max(roughness**2, 1e-3) ** 2
    z = np.sqrt((1 - u) / (1 + (a2 - 1) * u))
    h = np.stack([np.sqrt(1 - z * z) * np.cos(2 * np.pi * v), np.sqrt(1 - z * z) * np.sin(2 * np.pi * v), z], 1)
    mirrored = 2 * (h @ wo)[:, None] * h - wo
    diffuse = np.stack([np.sqrt(u) * np.cos(2 * np.pi * v), np.sqrt(u) * np.sin(2 * np.pi * v), np.sqrt(1 - u)], 1)
    total = 0.0
    for w in (mirrored, diffuse):
        w = w[w[:, 2] > 0]
        half = w + wo
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        density = a2 / (np.pi * (half[:, 2] ** 2 * (a2 - 1) + 1) ** 2) * half[:, 2] / (4 * (half @ wo))
        value = ggx_eval(w, np.broadcast_to(wo, w.shape), (1, 1, 1), roughness, metallic)
        total += (value[:, 0] / (density + w[:, 2] / np.pi)).sum() / side**2
    return total


def test_white_furnace():
    """Metals give back no more than they get. The specification's dielectric does near grazing, as it says itself."""
    cosines, roughnesses = (0.02, 0.1, 0.3, 0.6, 0.999), (0.15, 0.3, 0.6, 1.0)
    metal, dielectric = (np.array([[_albedo(c, r, m) for r in roughnesses] for c in cosines]) for m in (1.0, 0.0))
    assert metal.max() < 1.001
    assert metal[-1, 0] == pytest.approx(1.0, abs=2e-3)  # a smooth mirror loses nothing
    assert dielectric[3:].max() < 1.01
    assert 1.0 < dielectric.max() < 1.75


def test_degenerate_directions_give_finite_values(rng):
    edge = np.array(
        [[0, 0, 0], [0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [1, 0, 1e-30], [-1, 0, 1e-6], [np.nan, 0, 1],
         [np.inf, 0, 1], [1e30, 1e30, 1e30], [1e-30, 0, 1e-30], [0.6, 0, 0.8]], np.float32
    )  # fmt: skip

    def below(w):  # what has no direction becomes +z
        return (w[:, 2] <= 0) & np.isfinite(w).all(1) & w.any(1)

    pairs = np.array([(a, b) for a in edge for b in edge])
    wi, wo = np.ascontiguousarray(pairs[:, 0]), np.ascontiguousarray(pairs[:, 1])
    for normal in (None, wi, wo):
        for roughness in (0.0, 0.5, 1.0, -1.0, 7.0):
            value = ggx_eval(wi, wo, (0.5, 0.6, 0.7), roughness, 0.5, normal=normal)
            assert np.isfinite(value).all()
            assert value.min() >= 0.0
            assert (value[below(wi) | below(wo)] == 0).all()


def test_it_is_reciprocal(rng):
    wi, wo = _hemisphere(rng, 10_000, 0.05), _hemisphere(rng, 10_000, 0.05)
    color, rough = rng.random((10_000, 3)), rng.uniform(0.2, 1, 10_000).astype(np.float32)
    there, back = ggx_eval(wi, wo, color, rough, 0.3), ggx_eval(wo, wi, color, rough, 0.3)
    assert there * wo[:, 2:] == pytest.approx(back * wi[:, 2:], rel=2e-5, abs=1e-7)


def test_roughness_below_the_least_changes_nothing():
    up = np.array([[0.0, 0, 1]], np.float32)
    peak = ggx_eval(up, up, (1, 1, 1), 0.0, 1.0)
    assert np.array_equal(peak, ggx_eval(up, up, (1, 1, 1), 0.03, 1.0))
    assert peak == pytest.approx(1 / (4 * np.pi * 1e-6), rel=1e-5)  # D / 4 at the mirror peak
    assert ggx_eval(up, up, (1, 1, 1), 0.1, 1.0)[0, 0] < peak[0, 0]


def test_arguments_are_named():
    up = np.array([[0.0, 0, 1]], np.float32)
    with pytest.raises(ValueError, match=r"wo must have shape \[1, 3\], got \(2, 3\)"):
        ggx_eval(up, np.repeat(up, 2, 0), (1, 1, 1), 0.5)
    with pytest.raises(ValueError, match=r"roughness must have shape \[1\], got \(2,\)"):
        ggx_eval(up, up, (1, 1, 1), np.array([0.5, 0.5]))
    assert ggx_eval(up[:0], up[:0], (1, 1, 1), 0.5).shape == (0, 3)
