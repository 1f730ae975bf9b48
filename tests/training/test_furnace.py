"""Albedo and reciprocity by quadrature: against closed forms, another quadrature, and what is wrong on purpose."""

import numpy as np
import pytest

from warp_neumat.materials import load
from warp_neumat.pipeline import demo
from warp_neumat.reference import brdf_sample
from warp_neumat.training import furnace


def lambert(wi, wo):
    return np.where((wi[:, 2:] > 0) & (wo[:, 2:] > 0), np.array([0.2, 0.5, 0.9]) / np.pi, 0)


def ggx(ax, ay, fresnel=1.0):
    """Single-scattering GGX in float64, reflectance 1 or Schlick's with F₀ = ``fresnel``."""

    def evaluate(wi, wo):
        wi, wo = (np.asarray(v, np.float64) for v in (wi, wo))
        h = wi + wo
        h /= np.maximum(np.linalg.norm(h, axis=1, keepdims=True), 1e-300)
        d = 1 / (np.pi * ax * ay * ((h[:, 0] / ax) ** 2 + (h[:, 1] / ay) ** 2 + h[:, 2] ** 2) ** 2)
        si = wo[:, 2] * np.linalg.norm(wi * [ax, ay, 1], axis=1)
        so = wi[:, 2] * np.linalg.norm(wo * [ax, ay, 1], axis=1)
        f = fresnel + (1 - fresnel) * (1 - np.clip((wi * h).sum(1), 0, 1)) ** 5
        lit = (wi[:, 2] > 0) & (wo[:, 2] > 0)
        return np.repeat(np.where(lit, f * 0.5 * d / np.where(lit, si + so, 1), 0)[:, None], 3, axis=1)

    return evaluate


def brute_force(eval_fn, alpha, theta, azimuth=0.0, side=350):
    """The albedo by a midpoint rule over the numbers that draw the visible normals of the same α: other coordinates."""
    axis = (np.arange(side) + 0.5) / side
    u = np.stack([np.full(side * side, 0.5), *(a.ravel() for a in np.meshgrid(axis, axis))], 1)
    weights = np.zeros((2, 4))
    weights[:, 1] = 1
    wo = [np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)]
    wo = np.tile(wo, (len(u), 1))
    wi, p = brdf_sample.proxy_sample([alpha] * 3, weights, wo, u)
    return (eval_fn(wi, wo)[:, 0] * np.maximum(wi[:, 2], 0) / np.where(p > 0, p, np.inf)).mean()


def test_solid_angles_cover_the_hemisphere():
    for theta in (0.0, 0.5, 1.2, *furnace.ANGLES[-3:]):
        wi, wo, area = furnace.directions(theta, azimuth=0.3)
        assert area.sum() == pytest.approx(2 * np.pi, rel=5e-6)
        assert np.abs(np.linalg.norm(wi, axis=1) - 1).max() < 1e-6
        assert wi[:, 2].min() > -1e-6
        assert np.arctan2(wo[0, 1], wo[0, 0]) == pytest.approx(0.3 if theta else 0.0)


def test_lambert_gives_back_its_albedo():
    got = furnace.albedo(lambert, furnace.ANGLES)
    assert got.shape == (len(furnace.ANGLES), 3)
    assert np.abs(got / [0.2, 0.5, 0.9] - 1).max() < 2e-7
    assert furnace.albedo_max(lambert) == pytest.approx(0.9, rel=1e-6)


# Worst seen up to 89.9°, 2026-11: 4e-4 at α = 0.005 (float32 directions), 2e-4 at α = 1, the brute force's own 2e-4.
@pytest.mark.parametrize("alpha", [0.005, 0.02, 0.1, 0.4, 1.0])
def test_albedo_matches_brute_force(alpha):
    angles = np.radians([45, 80, 89.9])
    got = furnace.albedo(ggx(alpha, alpha), angles)[:, 0]
    want = [brute_force(ggx(alpha, alpha), (alpha, alpha), t) for t in angles]
    assert np.abs(got / want - 1).max() < 8e-4


def test_albedo_of_an_anisotropic_surface_matches_brute_force():
    angles = np.radians([20, 88])
    for azimuth in (0.0, 0.5, np.pi / 2):
        f = ggx(0.5, 0.05)
        got = furnace.albedo(f, angles, samples=furnace.ANISOTROPIC_SAMPLES, azimuth=azimuth)[:, 0]
        want = [brute_force(f, (0.5, 0.05), t, azimuth) for t in angles]
        assert np.abs(got / want - 1).max() < 3e-3


def test_albedo_of_ggx_is_the_known_one():
    """A perfect mirror gives back all of it, at normal incidence α = 1 loses what Smith's shadowing takes."""
    assert furnace.albedo(ggx(0.005, 0.005), 0.0)[0, 0] == pytest.approx(1.0, abs=1e-4)
    # ω_o = n, α = 1: D = 1/π cancels into 2π ∫ cosθ/(2π (cosθ + 1)) sinθ dθ = 1 − ln 2.
    assert furnace.albedo(ggx(1.0, 1.0), 0.0)[0, 0] == pytest.approx(1 - np.log(2), rel=1e-6)


def test_a_narrow_hump_is_seen():
    """Energy in a peak of half a degree, on top of a diffuse floor, at each of the angles that are looked at."""
    base = lambda i, o: lambert(i, o) + 0.05 * ggx(0.005, 0.005)(i, o)  # noqa: E731
    more = furnace.albedo_nodes(base) - furnace.albedo_nodes(lambert)
    single = furnace.albedo_nodes(ggx(0.005, 0.005))
    assert np.allclose(more, 0.05 * single, rtol=1e-4)


def excess(asset, source):
    return furnace.energy(asset, source)["albedo_excess"]


def test_excess_compares_node_by_node():
    source = ggx(0.3, 0.3)
    assert excess(source, source) == pytest.approx(furnace.albedo_nodes(source).max(), rel=1e-12)
    # 3 % too much where nothing is lost; 40 % too much where little comes back is no excess.
    bright = lambda i, o: 1.03 * ggx(0.01, 0.01)(i, o)  # noqa: E731
    assert excess(bright, ggx(0.01, 0.01)) == pytest.approx(1.03, abs=1e-3)
    assert excess(lambda i, o: 1.05 * lambert(i, o), lambert) < 1
    # A source that itself gives back more than it gets sets the limit where it does, and only there.
    grazing = lambda i, o: lambert(i, o) * np.where(o[:, 2:] < 0.1, 2.0, 1.0)  # noqa: E731
    everywhere = lambda i, o: 2 * lambert(i, o)  # noqa: E731
    assert excess(grazing, grazing) == pytest.approx(1.0, rel=1e-6)
    values = furnace.energy(everywhere, grazing)
    assert values["albedo_excess"] == pytest.approx(1.8, rel=1e-6)
    assert values["albedo_max"] == pytest.approx(1.8, rel=1e-6)
    assert values["albedo_max_source"] == pytest.approx(1.8, rel=1e-6)


def test_anisotropic_albedo_looks_at_several_azimuths():
    def turned(wi, wo):
        along = np.maximum(wo[:, 1] / np.maximum(np.hypot(wo[:, 0], wo[:, 1]), 1e-6), 0)
        return lambert(wi, wo) * (1 + 0.5 * along[:, None])

    assert furnace.albedo_max(turned) == pytest.approx(0.9, rel=1e-5)
    assert furnace.albedo_max(turned, isotropic=False) == pytest.approx(1.35, rel=1e-5)


def test_reciprocity_error_is_that_of_the_function():
    assert furnace.reciprocity_error(lambert) == 0
    assert furnace.reciprocity_error(ggx(0.1, 0.05, 0.04)) < 1e-6
    assert furnace.reciprocity_error(lambda i, o: 0 * lambert(i, o)) == 0
    # f = (1 + ε sign(z_i − z_o))/π: |difference| = 2ε f wherever the heights differ.
    tilted = lambda i, o: (1 + 0.05 * np.sign(i[:, 2:] - o[:, 2:])) * lambert(i, o)  # noqa: E731
    assert furnace.reciprocity_error(tilted) == pytest.approx(0.1, rel=1e-3)
    # f = z_i/π: ∫∫ |z_i − z_o| z_i z_o over ∫∫ z_i z_o (z_i + z_o)/2 = (1/15)/(1/6).
    linear = lambda i, o: np.maximum(i[:, [2, 2, 2]], 0) / np.pi  # noqa: E731
    assert furnace.reciprocity_error(linear) == pytest.approx(0.4, rel=5e-3)


def test_a_bundled_material_keeps_its_energy():
    material = load(demo.material_paths()["knot"])
    nodes = furnace.albedo_nodes(material.brdf)
    assert nodes.max() < 1.01
    assert nodes[:10, 0].min() > 0.5  # a metal
    assert 0 < furnace.reciprocity_error(material.brdf) < 0.1


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match=r"theta_o must be in \[0, π/2\), got 1.6"):
        furnace.albedo(lambert, 1.6)
    with pytest.raises(ValueError, match=r"samples must be a positive and an even positive number, got \(8, 7\)"):
        furnace.albedo(lambert, 0.5, samples=(8, 7))
