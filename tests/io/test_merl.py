"""MERL tables: the file's layout byte by byte, look-ups against a slow scalar reference, masked cells, conversion."""

import math
import struct

import numpy as np
import pytest

from warp_neumat.io.brdf import open_brdf
from warp_neumat.io.merl import DIMS, MERL, SCALES, above_horizon, centres, read_merl, tabulate, write_merl


def directions(rng, count, low=0.02):
    z = rng.uniform(low, 1.0, count)
    phi = rng.uniform(0, 2 * np.pi, count)
    sine = np.sqrt(1 - z * z)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], 1).astype(np.float32)


@pytest.fixture(scope="module")
def smooth():
    """A table that is a different smooth function of all three indices in every channel."""
    a, b, c = np.meshgrid(*(np.arange(n) for n in DIMS), indexing="ij")
    base = 5 * np.exp(-a / 15) + 0.3 + 0.1 * np.cos(2 * np.pi * (c + 0.5) / 180) + b / 200
    return np.stack([base, 0.5 * base + a / 100, base * base], -1)


@pytest.fixture(scope="module")
def glossy(tmp_path_factory):
    """A GGX written as a file, and its source."""
    source = open_brdf("analytic:ggx?roughness=0.4&f0=0.9,0.6,0.3&diffuse=0.1")
    return write_merl(tmp_path_factory.mktemp("merl") / "gold.binary", source), source


def angles(wi, wo):
    """Rusinkiewicz' angles of one pair, by rotation matrices and scalar math."""
    h = [a + b for a, b in zip(wi, wo, strict=True)]
    n = math.sqrt(sum(t * t for t in h))
    h = [t / n for t in h]
    theta_h, phi_h = math.acos(min(h[2], 1.0)), math.atan2(h[1], h[0])
    c, s = math.cos(-phi_h), math.sin(-phi_h)
    x, y, z = wi[0] * c - wi[1] * s, wi[0] * s + wi[1] * c, wi[2]
    c, s = math.cos(-theta_h), math.sin(-theta_h)
    x, z = x * c + z * s, z * c - x * s
    return theta_h, math.acos(max(min(z, 1.0), -1.0)), math.atan2(y, x)


def slow_nearest(table, wi, wo):
    """The look-up as the authors of the data describe it: square root spacing, then truncation."""
    theta_h, theta_d, phi_d = angles(wi, wo)
    if phi_d < 0:
        phi_d += math.pi
    a = min(int(math.sqrt(theta_h / (math.pi / 2)) * 90), 89)
    b = min(int(theta_d / (math.pi / 2) * 90), 89)
    return table[a, b, min(int(phi_d / math.pi * 180), 179)]


def slow_trilinear(table, wi, wo):
    """Weights over the eight surrounding cell centres; entries below 0 are left out."""
    theta_h, theta_d, phi_d = angles(wi, wo)
    at = (
        math.sqrt(theta_h / (math.pi / 2)) * 90 - 0.5,
        theta_d / (math.pi / 2) * 90 - 0.5,
        phi_d / math.pi * 180 - 0.5,
    )
    value, total = np.zeros(3), np.zeros(3)
    for da in (0, 1):
        for db in (0, 1):
            for dc in (0, 1):
                index, weight = [], 1.0
                for axis, step in enumerate((da, db, dc)):
                    t = at[axis] if axis == 2 else min(max(at[axis], 0), DIMS[axis] - 1)
                    k = math.floor(t)
                    weight *= t - k if step else 1 - (t - k)
                    index.append((k + step) % 180 if axis == 2 else min(k + step, DIMS[axis] - 1))
                entry = table[tuple(index)]
                value += np.where(entry >= 0, weight * entry, 0)
                total += np.where(entry >= 0, weight, 0)
    return value / total


def test_layout_of_the_file(tmp_path, smooth):
    path = write_merl(tmp_path / "a.binary", smooth)
    data = path.read_bytes()
    assert struct.unpack("<3i", data[:12]) == (90, 90, 180)
    assert len(data) == 12 + 3 * 8 * 90 * 90 * 180
    for channel, scale in enumerate((1 / 1500, 1.15 / 1500, 1.66 / 1500)):
        for a, b, c in ((0, 0, 0), (3, 70, 11), (89, 89, 179)):
            at = 12 + 8 * (channel * 90 * 90 * 180 + c + b * 180 + a * 180 * 90)
            assert struct.unpack("<d", data[at : at + 8])[0] * scale == pytest.approx(smooth[a, b, c, channel])


def test_round_trip_of_a_table(tmp_path, smooth):
    holes = smooth.copy()
    holes[4, 5, 6] = -1
    holes[7, 8, 9, 1] = np.nan
    source = read_merl(write_merl(tmp_path / "holes.binary", holes))
    assert source.name == "holes"
    assert source.masked == 4
    assert source.masked_above == 4
    assert source.notes == ("4 of 4374000 entries are masked (negative or not finite), 4 of them above the horizon",)
    again = read_merl(write_merl(tmp_path / "again.binary", smooth))
    assert again.masked == 0
    assert again.notes == ()
    at = centres(30)
    keep = above_horizon()[30].ravel()
    got = again.eval(*(w[keep] for w in at))
    np.testing.assert_allclose(got, smooth[30].reshape(-1, 3)[keep], rtol=2e-4)  # the angles are float32


@pytest.mark.parametrize(("lookup", "slow"), [("nearest", slow_nearest), ("trilinear", slow_trilinear)])
def test_lookup_matches_the_slow_one(rng, smooth, lookup, slow):
    holes = smooth.copy()
    holes[rng.random(DIMS) < 0.1] = -1
    source = MERL("x", holes, lookup)
    assert source.isotropic
    assert source.symmetry == "reciprocal"
    wi, wo = directions(rng, 400), directions(rng, 400)
    wi[:100] = wo[:100] * (-1, -1, 1) + 0.01 * rng.normal(size=(100, 3))  # near the mirror peak, where cells are small
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    use = (wi[:, 2] > 0.01) & (wo[:, 2] > 0.01)
    wi, wo = wi[use], wo[use]
    got = source.eval(wi, wo)
    expected = np.array([slow(holes, i, o) for i, o in zip(wi.astype(float), wo.astype(float), strict=True)])
    measured = (expected >= 0) & np.isfinite(expected)
    close = np.abs(got - expected) < 1e-3 * (1 + np.abs(expected))
    # float32 angles may fall on the other side of a cell's edge, where "nearest" jumps: 1 % of pairs at most.
    assert close[measured].mean() >= (0.99 if lookup == "nearest" else 1.0)
    assert measured.mean() > 0.85


def test_lookup_is_reciprocal_and_isotropic(rng, smooth):
    source = MERL("x", smooth)
    wi, wo = directions(rng, 5000), directions(rng, 5000)
    value = source.eval(wi, wo)
    np.testing.assert_allclose(source.eval(wo, wi), value, rtol=2e-4)
    c, s = np.float32(np.cos(1.1)), np.float32(np.sin(1.1))
    turn = np.float32([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(source.eval(wi @ turn, wo @ turn), value, rtol=2e-3)


def test_cells_below_the_horizon_are_minus_one(glossy):
    table = tabulate(glossy[1])
    below = ~above_horizon()
    assert (table[below] == -1).all()
    assert (table[~below] >= 0).all()
    # A grazing half vector and a difference along its azimuth: one direction is under the surface.
    assert below[89, 60:, 0].all()
    assert not below[0, :89].any()
    wi, wo = centres(60)
    both = (wi[:, 2] > 0) & (wo[:, 2] > 0)
    np.testing.assert_array_equal(both.reshape(90, 180), ~below[60])


def test_grazing_directions_are_not_darkened(glossy, rng):
    # Cells that the horizon cuts have centres below it. The last measured value stands there, not 0 and not −1.
    source = read_merl(glossy[0])
    wi, wo = directions(rng, 20_000, 1e-4), directions(rng, 20_000, 1e-4)
    wi[:, 2] *= 0.02
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    value, exact = source.eval(wi, wo), glossy[1].eval(wi, wo)
    assert (value > 0).all()
    assert np.median(np.abs(value - exact) / exact) < 0.1
    down = wi * (1, 1, -1)
    assert (source.eval(down, wo) == 0).all()
    assert (source.eval(wo, down) == 0).all()


@pytest.mark.parametrize("name", [None, "alum-bronze", "white-fabric"])
def test_tabulated_source_stays_close(glossy, data, tmp_path, rng, name):
    if name is None:
        path, source = glossy
    else:
        npz = data / "brdf" / "merl80_nbrdf.npz"
        if not npz.is_file():
            pytest.skip(f"no {npz}")
        source = open_brdf(f"{npz}:{name}")
        path = write_merl(tmp_path / f"{name}.binary", source)
    table = open_brdf(str(path))
    assert table.masked == 3 * np.count_nonzero(~above_horizon())
    assert "0 of them above the horizon" in table.notes[0]
    wi, wo = directions(rng, 20_000, 0.2), directions(rng, 20_000, 0.2)
    exact = 0.5 * (source.eval(wi, wo) + source.eval(wo, wi))
    error = np.abs(table.eval(wi, wo) - exact) / (exact + 1e-3)
    assert np.median(error) < 2e-3  # cells are 1° wide
    assert np.quantile(error, 0.99) < 0.05
    nearest = open_brdf(f"{path}?lookup=nearest").eval(wi, wo)
    assert np.median(error) < 0.5 * np.median(np.abs(nearest - exact) / (exact + 1e-3))


def test_wrong_files_are_explained(tmp_path, glossy):
    data = glossy[0].read_bytes()
    bad = tmp_path / "bad.binary"
    for content, message in (
        (b"", r"bad\.binary: not a MERL table, its dimensions are \[\]"),
        (struct.pack("<3i", 90, 90, 360) + data[12:], r"its dimensions are \[90, 90, 360\], not \[90, 90, 180\]"),
        (data[:-8], "holds 34992004 bytes where a MERL table has 34992012"),
        (data + b"x", "holds 34992013 bytes"),
        (data[:12] + b"\xff" * (len(data) - 12), "every entry is negative or not finite"),
    ):
        bad.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            read_merl(bad)
    with pytest.raises(ValueError, match="lookup must be 'trilinear' or 'nearest', got 'cubic'"):
        read_merl(glossy[0], "cubic")


def test_what_cannot_be_written_is_explained(tmp_path):
    with pytest.raises(ValueError, match="ggx: anisotropic, and a MERL table holds isotropic BRDFs only"):
        write_merl(tmp_path / "a.binary", open_brdf("analytic:ggx?anisotropy=0.5"))
    with pytest.raises(ValueError, match=r"must be float of shape \(90, 90, 180, 3\)"):
        write_merl(tmp_path / "a.binary", np.zeros((90, 90, 180)))
    assert not list(tmp_path.iterdir())
    np.testing.assert_allclose(SCALES * 1500, [1, 1.15, 1.66])
