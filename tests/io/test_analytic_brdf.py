"""Analytic BRDF sources against the textbook in float64, exact Fresnel values, and white furnaces."""

import numpy as np
import pytest

from tests.furnace import albedo
from warp_neumat.io.brdf import open_brdf
from warp_neumat.io.microfacet import conductor, dielectric


def directions(rng, count):
    z = rng.uniform(0.02, 1.0, count)
    phi = rng.uniform(0, 2 * np.pi, count)
    sine = np.sqrt(1 - z * z)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], 1).astype(np.float32)


@pytest.fixture
def pair(rng):
    wi, wo = directions(rng, 4000), directions(rng, 4000)
    wi[:1000] = wo[:1000] * (-1, -1, 1)  # the mirror peak
    return wi, wo


def ggx(wi, wo, ax, ay, f0, diffuse):
    """The textbook form, in float64: angles and tangents."""
    h = wi + wo
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    d = 1 / (np.pi * ax * ay * ((h[:, 0] / ax) ** 2 + (h[:, 1] / ay) ** 2 + h[:, 2] ** 2) ** 2)

    def smith_lambda(w):
        return 0.5 * (np.sqrt(1 + ((ax * w[:, 0]) ** 2 + (ay * w[:, 1]) ** 2) / w[:, 2] ** 2) - 1)

    g = 1 / (1 + smith_lambda(wi) + smith_lambda(wo))
    f = f0 + (1 - f0) * (1 - (wi * h).sum(1, keepdims=True)) ** 5
    return f * (d * g / (4 * wi[:, 2] * wo[:, 2]))[:, None] + np.asarray(diffuse) / np.pi


def test_ggx_matches_the_textbook(pair):
    wi, wo = pair
    source = open_brdf("analytic:ggx?roughness=0.4&f0=0.9,0.6,0.3&diffuse=0.1&anisotropy=0.5")
    assert not source.isotropic
    aspect = np.sqrt(1 - 0.9 * 0.5)
    unit = [d.astype(np.float64) / np.linalg.norm(d.astype(np.float64), axis=1, keepdims=True) for d in pair]
    expected = ggx(*unit, 0.16 / aspect, 0.16 * aspect, np.array([0.9, 0.6, 0.3]), [0.1, 0.1, 0.1])
    np.testing.assert_allclose(source.eval(wi, wo), expected, rtol=4e-6)  # worst seen 1.3e-6; x 3


def snell(cosine, index):
    """Fresnel's equations for a complex index, by way of Snell's law with complex angles."""
    inside = np.sqrt(1 - (1 - cosine**2) / index**2 + 0j)
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (index * cosine - inside) / (index * cosine + inside)
    return 0.5 * (np.abs(s) ** 2 + np.abs(p) ** 2)


@pytest.mark.parametrize("index", [1.0, 1.33, 1.5, 2.4, 0.143 + 3.983j, 1.345 + 7.475j, 3.18 + 2.21j])
def test_fresnel_matches_complex_snell(index):
    cosine = np.linspace(1e-3, 1, 1000)[:, None]
    expected = snell(cosine, index)
    if index.imag:
        got = conductor(cosine.astype(np.float32), (index.real,) * 3, (index.imag,) * 3)
    else:
        got = dielectric(cosine.astype(np.float32), index)
    np.testing.assert_allclose(got - expected, 0, atol=2e-6)  # worst seen 6e-7; x 3
    if index == 1.5:  # Brewster's angle: half of what s alone reflects
        np.testing.assert_allclose(snell(1 / np.sqrt(3.25), 1.5), 0.5 * (1.25 / 3.25) ** 2)


def test_exact_fresnel_of_ggx(pair):
    wi, wo = pair
    half = (wi + wo).astype(np.float64)
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    cosine = (wi * half).sum(1, keepdims=True)
    bare = open_brdf("analytic:ggx?roughness=0.4&f0=1").eval(wi, wo)
    glass = open_brdf("analytic:ggx?roughness=0.4&ior=1.5").eval(wi, wo)
    np.testing.assert_allclose(glass, bare * snell(cosine, 1.5), rtol=1e-4, atol=1e-6)
    gold = open_brdf("analytic:ggx?roughness=0.4&eta=0.143,0.375,1.442&k=3.983,2.386,1.603").eval(wi, wo)
    index = np.array([0.143 + 3.983j, 0.375 + 2.386j, 1.442 + 1.603j])
    np.testing.assert_allclose(gold, bare * snell(cosine, index), rtol=1e-4, atol=1e-6)


def test_alphas_may_be_given_apart(pair):
    a = open_brdf("analytic:ggx?alpha_x=0.5&alpha_y=0.1")
    assert not a.isotropic
    assert a.symmetry == "reciprocal"
    wi, wo = pair
    unit = [d.astype(np.float64) / np.linalg.norm(d.astype(np.float64), axis=1, keepdims=True) for d in pair]
    np.testing.assert_allclose(a.eval(wi, wo), ggx(*unit, 0.5, 0.1, np.full(3, 0.04), np.zeros(3)), rtol=6e-6)
    b = open_brdf("analytic:ggx?alpha_x=0.25")
    assert b.isotropic
    assert b.symmetry == "bilateral"
    np.testing.assert_allclose(b.eval(wi, wo), open_brdf("analytic:ggx?roughness=0.5").eval(wi, wo), rtol=1e-6)


def test_bilateral_sources_are_mirror_symmetric(pair):
    wi, wo = pair
    flip = np.float32([1, -1, 1])
    source = open_brdf("analytic:ggx?roughness=0.4&ior=1.5&diffuse=0.5&dim_diffuse=1")
    assert source.symmetry == "bilateral"
    np.testing.assert_allclose(source.eval(wi * flip, wo * flip), source.eval(wi, wo), rtol=6e-6)


@pytest.mark.parametrize("fresnel", ["ior=1.5", "ior=2.5", "f0=0.04", "f0=0.9", "eta=1.3&k=7.5"])
def test_white_furnace_of_dimmed_ggx(fresnel):
    # Undimmed, a white base under glass gives 1.04 and more.
    for roughness in (0.2, 0.5, 1.0):
        source = open_brdf(f"analytic:ggx?roughness={roughness}&{fresnel}&diffuse=1&dim_diffuse=1")
        for angle in (0, 40, 70, 85):
            assert albedo(source, angle, roughness**2).max() < 1.002


@pytest.mark.parametrize(
    "spec",
    ["ggx?roughness=0.15&f0=0.9,0.6,0.3", "ggx?roughness=0.5&anisotropy=0.8&ior=1.5", "lambert?albedo=0.2,0.5,1"]
    + ["ggx?roughness=0.4&diffuse=0.9&dim_diffuse=1&eta=0.2,0.9,1.1&k=3.9,2.4,2"],
)
def test_analytic_sources_are_reciprocal(pair, spec):
    wi, wo = pair
    source = open_brdf(f"analytic:{spec}")
    np.testing.assert_allclose(source.eval(wi, wo), source.eval(wo, wi), rtol=6e-6)  # worst seen 2e-6; x 3


def test_ggx_albedo_is_known_at_full_roughness(rng):
    # At alpha = 1, D = 1/π and G₂ = 2z/(1 + z) for a view along the normal, so the albedo is ∫ z/(1 + z) dz = 1 − ln 2.
    z, phi = rng.random((2, 400_000)) * [[1], [2 * np.pi]]
    wi = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], 1)
    wo = np.broadcast_to(np.float32([0, 0, 1]), wi.shape)
    value = open_brdf("analytic:ggx?roughness=1&f0=1").eval(wi, wo)
    np.testing.assert_allclose((value * z[:, None]).mean(0) * 2 * np.pi, 1 - np.log(2), rtol=5e-3)


def test_below_the_horizon_is_zero():
    up, down = np.float32([[0, 0.6, 0.8]]), np.float32([[0, 0.6, -0.8]])
    for spec in ("analytic:ggx?diffuse=1", "analytic:lambert"):
        source = open_brdf(spec)
        assert (source.eval(up, up) > 0).all()
        for wi, wo in ((up, down), (down, up), (down, down)):
            assert (source.eval(wi, wo) == 0).all()


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("ggx?roughnes=0.2", "no parameter 'roughnes'; nearest: roughness"),
        ("gxx?roughness=0.2", "no analytic model 'gxx'; nearest: ggx"),
        ("ggx?roughness=2", r"roughness must be one number in \[0.01, 1.0\], got '2'"),
        ("ggx?roughness=0.1,0.2", "roughness must be one number"),
        ("ggx?f0=1,2,x", "f0 must be one number or R,G,B"),
        ("ggx?f0=nan", "f0 must be"),
        ("lambert?albedo=0.5&albedo=0.6", "'albedo' must be given once"),
        ("ggx?eta=1", "eta and k belong together"),
        ("ggx?f0=0.5&ior=1.5", "f0 and ior exclude one another"),
        ("ggx?alpha_x=0.1&roughness=0.5", "alpha_x and roughness exclude one another"),
        ("ggx?alpha_y=0.1", "alpha_y needs alpha_x"),
    ],
)
def test_wrong_parameters_are_explained(spec, message):
    with pytest.raises(ValueError, match=message):
        open_brdf(f"analytic:{spec}")
