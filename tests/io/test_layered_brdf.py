"""The layered BRDF: energy, reciprocity, and limits that can be written down."""

import numpy as np
import pytest

from tests.furnace import albedo
from warp_neumat.io.brdf import open_brdf

ANGLES = (0, 40, 60, 75, 86)
BASES = ["base_diffuse=1", *(f"base_f0=1&base_roughness={r}" for r in (0.1, 0.3, 1.0))]


def directions(rng, count):
    z = rng.uniform(0.02, 1.0, count)
    phi = rng.uniform(0, 2 * np.pi, count)
    sine = np.sqrt(1 - z * z)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], 1).astype(np.float32)


def furnace(spec, roughness, ior, base_alpha=None):
    source = open_brdf(f"analytic:layered?roughness={roughness}&ior={ior}&{spec}")
    wide = None
    if base_alpha:
        wide = min(np.sqrt(base_alpha**2 + 0.5 * (1 - 1 / ior) ** 2 * roughness**4), 1.0)
    return np.array([albedo(source, angle, roughness**2, wide, ior) for angle in ANGLES])


@pytest.mark.parametrize(("base", "ior"), [*((base, 1.5) for base in BASES), (BASES[2], 2.5), (BASES[0], 1.2)])
def test_white_furnace_of_layered(base, ior):
    alpha = None if "diffuse" in base else float(base.rpartition("=")[2]) ** 2
    for roughness in (0.1, 0.3, 1.0):
        got = furnace(base, roughness, ior, alpha)
        assert got.max() < 1.003  # worst seen 1.0019, of which the quadrature's own error is about 1e-3
        if roughness == 0.1:  # a smooth coat over a white base loses nothing but at grazing angles
            assert got[:-1].min() > 0.985


def test_absorption_and_base_colour_only_take_light_away():
    clear = furnace("base_f0=0.9&base_roughness=0.3", 0.2, 1.5, 0.09)
    thick = furnace("base_f0=0.9&base_roughness=0.3&absorption=0.1,0.5,2", 0.2, 1.5, 0.09)
    assert (np.diff(np.c_[clear[:, 0], thick], axis=1) < 0).all()
    coat = furnace("base_diffuse=0", 0.2, 1.5)
    black = furnace("base_diffuse=1&absorption=100", 0.2, 1.5)
    np.testing.assert_allclose(black, coat, atol=1e-5)
    twice = furnace("base_diffuse=0.8&absorption=0.1&thickness=3", 0.2, 1.5)
    np.testing.assert_allclose(twice, furnace("base_diffuse=0.8&absorption=0.3", 0.2, 1.5), rtol=1e-5)


def test_inner_reflectance_is_the_known_one():
    # 1 − r = (1 − r_outside)/η²; for η = 1.5 the diffuse reflectance of glass is 0.0918 outside, 0.596 inside.
    source = open_brdf("analytic:layered?ior=1.5")
    np.testing.assert_allclose(source.inner_reflectance(), 0.5963, atol=2e-4)
    assert (open_brdf("analytic:layered?ior=1.5&absorption=0.2").inner_reflectance() < 0.5).all()


def test_coat_of_index_one_is_no_coat(rng):
    wi, wo = directions(rng, 3000), directions(rng, 3000)
    bare = open_brdf("analytic:ggx?roughness=0.3&f0=0.9,0.6,0.3").eval(wi, wo)
    got = open_brdf("analytic:layered?ior=1&roughness=0.01&base_roughness=0.3&base_f0=0.9,0.6,0.3").eval(wi, wo)
    np.testing.assert_allclose(got, bare, rtol=2e-3, atol=2e-3)
    flat = open_brdf("analytic:layered?ior=1&base_diffuse=0.2,0.5,0.8").eval(wi, wo)
    np.testing.assert_allclose(flat, np.broadcast_to(np.array([0.2, 0.5, 0.8]) / np.pi, flat.shape), rtol=1e-5)


def test_first_bounce_is_attenuated_by_the_slanted_path():
    # Away from the highlight of the coat, ln of the ratio is −σ d (1/cosθ_i' + 1/cosθ_o') for a base so dark that no
    # light comes back a second time.
    wi, wo = (np.float32([[np.sin(a), 0, np.cos(a)]]) for a in np.radians((10.0, 60.0)))
    spec = "analytic:layered?roughness=0.05&ior=1.5&base_diffuse=0.0001"
    coat = open_brdf(spec.replace("0.0001", "0")).eval(wi, wo)
    clear, thick = (open_brdf(spec + extra).eval(wi, wo) - coat for extra in ("", "&absorption=0.7"))
    path = sum(1 / np.sqrt(1 - (np.sin(np.radians(a)) / 1.5) ** 2) for a in (10.0, 60.0))
    np.testing.assert_allclose(np.log(thick / clear), -0.7 * path, rtol=2e-2)


@pytest.mark.parametrize("base", ["base_diffuse=0.8", "base_f0=0.9,0.6,0.3", "base_eta=0.2,0.9,1.1&base_k=3.9,2.4,2"])
def test_layered_is_reciprocal_and_bilateral(rng, base):
    wi, wo = directions(rng, 3000), directions(rng, 3000)
    wi[:500] = wo[:500] * (-1, -1, 1)
    source = open_brdf(f"analytic:layered?roughness=0.3&absorption=0.1,0.2,0.4&{base}")
    assert source.isotropic
    assert source.symmetry == "bilateral"
    value, flip = source.eval(wi, wo), np.float32([1, -1, 1])
    assert np.isfinite(value).all()
    assert (value >= 0).all()
    np.testing.assert_allclose(source.eval(wo, wi), value, rtol=2e-5)
    np.testing.assert_allclose(source.eval(wi * flip, wo * flip), value, rtol=2e-5)


def test_grazing_pairs_are_finite():
    z = np.float32([1e-38, 1e-20, 1e-7, 1e-3])
    wi = np.stack([np.sqrt(1 - z * z), 0 * z, z], 1)
    for base in ("base_diffuse=1", "base_f0=1&base_roughness=0.01"):
        source = open_brdf(f"analytic:layered?roughness=0.01&{base}")
        for wo in (wi, wi * (-1, -1, 1), wi[::-1]):
            value = source.eval(wi, wo)
            assert np.isfinite(value).all()
            assert (value >= 0).all()


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("base_f0=1&base_diffuse=1", "base_diffuse and base_f0 exclude one another"),
        ("base_k=1", "base_eta and base_k belong together"),
        ("absorbtion=1", "no parameter 'absorbtion'; nearest: absorption"),
        ("_bounces=1", "no parameter '_bounces'"),
        ("ior=0.5", r"ior must be one number in \[1, 10\]"),
    ],
)
def test_wrong_parameters_are_explained(query, message):
    with pytest.raises(ValueError, match=message):
        open_brdf(f"analytic:layered?{query}")
