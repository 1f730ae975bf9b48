"""Sparse samples: columns in any order and notation, masked rows, symmetric neighbours, and rows that are wrong."""

import numpy as np
import pytest

from warp_neumat.io import brdf_samples
from warp_neumat.io.brdf import open_brdf
from warp_neumat.io.brdf_samples import BRDFSamples, read_samples, write_samples


def directions(rng, count):
    z = rng.uniform(0.05, 1.0, count)
    phi = rng.uniform(0, 2 * np.pi, count)
    sine = np.sqrt(1 - z * z)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], 1).astype(np.float32)


@pytest.fixture
def sparse(rng):
    wi, wo = directions(rng, 3000), directions(rng, 3000)
    return wi, wo, open_brdf("analytic:ggx?roughness=0.6&f0=0.9,0.6,0.3&diffuse=0.2").eval(wi, wo)


def test_round_trip(tmp_path, sparse):
    source = open_brdf(str(write_samples(tmp_path / "gold.csv", *sparse, isotropic=True, symmetry="bilateral")))
    assert (source.name, source.isotropic, source.symmetry, source.masked) == ("gold", True, "bilateral", 0)
    wi, wo, value = source.samples
    np.testing.assert_allclose(wi, sparse[0], atol=1e-7)  # lengths are made exactly 1
    np.testing.assert_allclose(wo, sparse[1], atol=1e-7)
    np.testing.assert_array_equal(value, sparse[2])
    assert [a.dtype for a in source.samples] == [np.float32] * 3


def test_columns_in_any_order_and_in_degrees(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "# measured on a Tuesday\n\n b , who, THETA_I, g, phi_i, wo_z, wo_x, wo_y, r\n"
        "3, ann, 60, 2, 90, 0.8, 0.6, 0, 1   # a remark\n# isotropic: yes\n\n6, bob, 0, 5, 0, 1, 0, 0, 4\n"
    )
    source = read_samples(path)
    assert source.isotropic
    assert source.symmetry == "reciprocal"
    wi, wo, value = source.samples
    np.testing.assert_allclose(wi, [[0, np.sqrt(0.75), 0.5], [0, 0, 1]], atol=1e-7)
    np.testing.assert_allclose(wo, [[0.6, 0, 0.8], [0, 0, 1]], atol=1e-7)
    np.testing.assert_array_equal(value, [[1, 2, 3], [4, 5, 6]])


def test_the_caller_overrides_the_file(tmp_path, sparse):
    path = write_samples(tmp_path / "a.csv", *sparse)
    assert (open_brdf(str(path)).isotropic, open_brdf(str(path)).symmetry) == (False, "reciprocal")
    source = open_brdf(f"{path}?isotropic=1&symmetry=none")
    assert (source.isotropic, source.symmetry) == (True, "none")


def test_bad_values_are_masked_and_counted(tmp_path, sparse):
    wi, wo, value = (a.copy() for a in sparse)
    value[3, 1], value[4, 0], value[5, 2] = np.nan, -0.1, np.inf
    wi[6, 2] *= -1
    source = read_samples(write_samples(tmp_path / "a.csv", wi, wo, value))
    assert source.masked == 4
    assert source.notes == (
        "2996 sparse samples; between them, the nearest one counts",
        "3 of 3000 samples are masked (negative or not finite)",
        "1 of 3000 samples are masked (below the horizon)",
    )
    np.testing.assert_array_equal(source.samples[2], np.delete(value, [3, 4, 5, 6], 0))


@pytest.mark.parametrize(
    ("isotropic", "symmetry"), [(False, "none"), (False, "reciprocal"), (True, "none"), (True, "bilateral")]
)
@pytest.mark.parametrize("tree", [True, False])
def test_a_sample_and_its_images_find_it(monkeypatch, sparse, isotropic, symmetry, tree):
    if tree:
        pytest.importorskip("scipy", reason="not needed, only faster")
    else:
        monkeypatch.setattr(brdf_samples, "_tree", lambda keys: None)
    wi, wo, value = sparse
    source = BRDFSamples("x", wi, wo, value, isotropic, symmetry)

    def found(i, o):
        return np.isclose(source.eval(i, o), value, rtol=1e-6).all(1).mean()

    assert found(wi, wo) > 0.999
    c, s, flip = np.float32(np.cos(0.7)), np.float32(np.sin(0.7)), np.float32([1, -1, 1])
    turn = np.float32([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    assert (found(wi @ turn, wo @ turn) > 0.99) == isotropic
    assert (found(wo, wi) > 0.99) == (symmetry != "none")
    assert (found(wi * flip, wo * flip) > 0.99) == (symmetry == "bilateral")


def test_nearest_is_near(sparse, rng):
    wi, wo = directions(rng, 4000), directions(rng, 4000)
    source = BRDFSamples("x", *sparse, isotropic=True, symmetry="bilateral")
    exact = open_brdf("analytic:ggx?roughness=0.6&f0=0.9,0.6,0.3&diffuse=0.2").eval(wi, wo)
    assert np.median(np.abs(source.eval(wi, wo) - exact) / exact) < 0.1
    assert (source.eval(-wi, wo) == 0).all()


HEADER = "wi_x,wi_y,wi_z,wo_x,wo_y,wo_z,r,g,b\n"
GOOD = "0,0,1,0,0,1,1,1,1\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"a\.csv: holds no samples"),
        (HEADER, "holds no samples"),
        (HEADER + GOOD + "\n" + GOOD[2:], r"a\.csv, line 4: 8 fields where the header names 9"),
        (HEADER + GOOD + GOOD.replace("1,1,1\n", "1,x,1\n"), "line 3: g must be a number, got 'x'"),
        (HEADER + GOOD.replace("1,1,1\n", "1,,1\n"), "line 2: g must be a number, got ''"),
        (
            HEADER + "# x\n" + GOOD + GOOD.replace("0,0,1,0", "0,0,2,0", 1),
            r"line 4: wi must have length 1, got 2 \(1 such",
        ),
        (HEADER + GOOD.replace("0,0,1,0", "nan,0,1,0", 1), "line 2: wi must have length 1, got nan"),
        (HEADER.replace("wo_z", "wo_q") + GOOD, "the header needs wo_x, wo_y, wo_z or theta_o, phi_o; it names wi_x"),
        (HEADER.replace(",g", ",green") + GOOD, "no column 'g'; the header names wi_x"),
        ("theta_i,phi_i,theta_o,phi_o,r,g,b\n-3,0,0,0,1,1,1\n", "line 2: theta_i must be 0 to 180 degrees"),
        ("# isotropic: perhaps\n" + HEADER + GOOD, "line 1: isotropic must be one of true.*got 'perhaps'"),
        ("# symmetry: bilateral\n" + HEADER + GOOD, "symmetry bilateral holds for isotropic materials only"),
        (HEADER + GOOD.replace("1,1,1\n", "-1,1,1\n"), r"a\.csv: no sample is left"),
    ],
)
def test_wrong_rows_are_named(tmp_path, text, message):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_samples(path)
    assert "\n" not in str(caught.value)


def test_no_text_and_wrong_shapes(tmp_path, sparse):
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(ValueError, match=r"a\.csv: not a text file"):
        read_samples(tmp_path / "a.csv")
    with pytest.raises(ValueError, match=r"value must have shape \(3000, 3\)"):
        write_samples(tmp_path / "b.csv", sparse[0], sparse[1], sparse[2][:, :1])
    with pytest.raises(ValueError, match="symmetry must be one of none, reciprocal, bilateral, got 'mirror'"):
        BRDFSamples("x", *sparse, symmetry="mirror")
