"""BRDF sources against formulas written out in float64."""

import shutil

import numpy as np
import pytest

from warp_neumat.io.brdf import NetworkBRDF, open_brdf, rusinkiewicz
from warp_neumat.io.brdf_source import CHUNK, from_half_difference


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


def test_half_and_difference_angles_go_there_and_back(rng):
    theta_h, theta_d, phi_d = rng.random((3, 500)) * np.array([[1.5], [1.5], [2 * np.pi]])
    h, d = np.split(rusinkiewicz(*from_half_difference(theta_h, theta_d, phi_d)), 2, axis=1)
    np.testing.assert_allclose(h, np.stack([np.sin(theta_h), 0 * theta_h, np.cos(theta_h)], 1), atol=1e-12)
    sine = np.sin(theta_d)
    np.testing.assert_allclose(
        d, np.stack([sine * np.cos(phi_d), sine * np.sin(phi_d), np.cos(theta_d)], 1), atol=1e-12
    )


@pytest.mark.parametrize("name", ["alum-bronze", "black-fabric", "chrome"])
def test_network_matches_float64(merl, pair, name):
    wi, wo = pair
    source = open_brdf(f"{merl}:{name}")
    assert source.name == name
    assert source.isotropic
    assert source.symmetry == "none"
    assert source.notes == ()
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


def test_network_does_not_depend_on_how_it_is_cut(merl, rng):
    # More than one chunk, the last of which is neither whole nor a whole number of blocks.
    wi, wo = directions(rng, 2 * CHUNK + 1234), directions(rng, 2 * CHUNK + 1234)
    source = open_brdf(f"{merl}:nickel")
    whole = source.eval(wi, wo)
    for part in (slice(0, 1), slice(CHUNK - 3, CHUNK + 700), slice(-800, None)):
        np.testing.assert_allclose(source.eval(wi[part], wo[part]), whole[part], rtol=2e-5, atol=2e-6)
    assert source.eval(wi[:0], wo[:0]).shape == (0, 3)


def test_network_survives_any_pair(merl):
    up, flat = np.float32([0, 0, 1]), np.float32([1, 0, 0])
    odd = np.float32([up, flat, -up, -flat, [1e-30, 0, 1], [1, 0, 1e-38], [0, 0, 0], [np.nan] * 3, [np.inf, 0, 1]])
    wi, wo = np.repeat(odd, len(odd), 0), np.tile(odd, (len(odd), 1))
    value = open_brdf(f"{merl}:chrome").eval(wi, wo)
    usable = np.isfinite(wi).all(1) & np.isfinite(wo).all(1)
    assert np.isfinite(value[usable]).all()
    assert (value[usable] >= 0).all()
    assert (value[~((wi[:, 2] > 0) & (wo[:, 2] > 0))] == 0).all()


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


def test_wrong_specs_and_shapes_are_explained():
    with pytest.raises(ValueError, match=r"'bronze.tif' is no BRDF source; use FILE.npz:NAME .*FILE.binary .*FILE.csv"):
        open_brdf("bronze.tif")
    with pytest.raises(ValueError, match=r"wo must have shape \(N, 3\), got \(4,\)"):
        open_brdf("analytic:lambert").eval(np.ones((4, 3)), np.ones(4))


@pytest.mark.parametrize("suffix", [".binary", ".bsdf", ".csv"])
def test_missing_files_and_wrong_options_are_explained(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    with pytest.raises(FileNotFoundError, match=rf"a{suffix}: no such file"):
        open_brdf(str(path))
    path.write_bytes(b"")
    with pytest.raises(ValueError, match="no option 'colour' here; known: "):
        open_brdf(f"{path}?colour=1")
    with pytest.raises(ValueError, match=rf"a{suffix}: "):  # empty
        open_brdf(str(path))


def test_options_are_checked(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("")
    with pytest.raises(ValueError, match="'symmetry' must be given once, as symmetry=none|reciprocal|bilateral"):
        open_brdf(f"{path}?symmetry=mirror")
    with pytest.raises(ValueError, match="'isotropic' must be given once"):
        open_brdf(f"{path}?isotropic=1&isotropic=1")


def test_network_of_another_width(rng):
    shapes = {"w0": (6, 9), "b0": (9,), "w1": (9, 9), "b1": (9,), "w2": (9, 3), "b2": (3,)}
    w = {key: rng.normal(size=shape).astype(np.float32) for key, shape in shapes.items()}
    wi, wo = directions(rng, 3000), directions(rng, 3000)
    a = np.maximum(np.maximum(rusinkiewicz(wi, wo) @ w["w0"] + w["b0"], 0) @ w["w1"] + w["b1"], 0)
    expected = np.maximum(np.expm1(a @ w["w2"] + w["b2"]), 0)
    got = NetworkBRDF("x", w).eval(wi, wo)
    assert (np.abs(got - expected) / (1 + expected)).max() < 2e-4  # float32 on both sides, exponents up to 30
