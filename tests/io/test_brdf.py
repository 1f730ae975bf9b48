"""BRDF sources against formulas written out in float64."""

import shutil

import numpy as np
import pytest

from warp_neumat.io.brdf import open_brdf, rusinkiewicz


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


@pytest.fixture
def merl(data):
    path = data / "brdf" / "merl80_nbrdf.npz"
    if not path.is_file():
        pytest.skip(f"no {path}")
    return path


def rotation(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]] if axis == "z" else [[c, 0, s], [0, 1, 0], [-s, 0, c]])


def test_rusinkiewicz_matches_rotation_matrices(pair):
    wi, wo = (d[:200].astype(np.float64) for d in pair)
    wi, wo = (d / np.linalg.norm(d, axis=1, keepdims=True) for d in (wi, wo))
    got = rusinkiewicz(wi, wo)
    for i, o, row in zip(wi, wo, got, strict=True):
        h = (i + o) / np.linalg.norm(i + o)
        theta, phi = np.arccos(min(h[2], 1.0)), np.arctan2(h[1], h[0])
        back = rotation("y", -theta) @ rotation("z", -phi)
        if theta > 1e-6:  # at the pole φ_h is free
            np.testing.assert_allclose(row, [np.sin(theta), 0, np.cos(theta), *(back @ i)], atol=1e-7)


@pytest.mark.parametrize("name", ["alum-bronze", "black-fabric", "chrome"])
def test_network_matches_float64(merl, pair, name):
    wi, wo = pair
    source = open_brdf(f"{merl}:{name}")
    assert source.name == name
    assert source.isotropic
    with np.load(merl) as archive:
        w = {k: archive[f"{name}/{k}"].astype(np.float64) for k in ("w0", "b0", "w1", "b1", "w2", "b2")}
    x = rusinkiewicz(wi.astype(np.float64), wo.astype(np.float64))
    a = np.maximum(np.maximum(x @ w["w0"] + w["b0"], 0) @ w["w1"] + w["b1"], 0)
    expected = np.maximum(np.exp(a @ w["w2"] + w["b2"]) - 1, 0)
    got = source.eval(wi, wo)
    assert got.dtype == np.float32
    assert got.shape == (4000, 3)
    # Worst seen 2e-6 (chrome); x 3.
    assert (np.abs(got - expected) / (1 + expected)).max() < 6e-6


def test_network_is_isotropic(merl, pair):
    wi, wo = pair
    turn = rotation("z", 1.1).T.astype(np.float32)
    source = open_brdf(f"{merl}:nickel")
    wi, wo = wi[1000:], wo[1000:]  # at the mirror direction itself the azimuth of h is rounding
    a, b = source.eval(wi, wo), source.eval(wi @ turn, wo @ turn)
    # Worst seen 8e-6; x 3.
    assert (np.abs(a - b) / (1 + a)).max() < 2.4e-5


def test_path_may_contain_colons(merl, tmp_path, pair):
    path = tmp_path / "C:" / "a:b.npz"
    path.parent.mkdir()
    shutil.copy(merl, path)
    wi, wo = (d[:10] for d in pair)
    np.testing.assert_array_equal(open_brdf(f"{path}:chrome").eval(wi, wo), open_brdf(f"{merl}:chrome").eval(wi, wo))


def test_wrong_names_are_explained(merl, tmp_path):
    with pytest.raises(ValueError, match="no material 'alum-brass'; nearest: .*alum"):
        open_brdf(f"{merl}:alum-brass")
    with pytest.raises(ValueError, match="name one as .*npz:NAME, as .*:alum-bronze"):
        open_brdf(str(merl))
    with pytest.raises(FileNotFoundError, match=r"none\.npz: no such file"):
        open_brdf(f"{tmp_path}/none.npz:x")
    (tmp_path / "bad.npz").write_bytes(b"not a zip")
    with pytest.raises(ValueError, match=r"bad\.npz: not a readable \.npz"):
        open_brdf(f"{tmp_path}/bad.npz:x")


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


@pytest.mark.parametrize(
    "spec",
    ["ggx?roughness=0.15&f0=0.9,0.6,0.3", "ggx?roughness=0.5&anisotropy=0.8&ior=1.5", "lambert?albedo=0.2,0.5,1"],
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


def test_ior_sets_f0(pair):
    wi, wo = pair
    a = open_brdf("analytic:ggx?ior=1.5").eval(wi, wo)
    np.testing.assert_allclose(a, open_brdf("analytic:ggx?f0=0.04").eval(wi, wo), rtol=1e-6)


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
    ],
)
def test_wrong_parameters_are_explained(spec, message):
    with pytest.raises(ValueError, match=message):
        open_brdf(f"analytic:{spec}")


def test_wrong_specs_and_shapes_are_explained():
    with pytest.raises(ValueError, match="is no BRDF source; use FILE.npz:NAME"):
        open_brdf("bronze")
    with pytest.raises(ValueError, match=r"wo must have shape \(N, 3\), got \(4,\)"):
        open_brdf("analytic:lambert").eval(np.ones((4, 3)), np.ones(4))
