"""Pixelations: points and corners against float64 and brute force, continuity, degenerate directions, counts."""

import numpy as np
import pytest

from warp_neumat.kernels import healpix
from warp_neumat.kernels.fibonacci import CAP, fibonacci_sphere
from warp_neumat.kernels.pixelations import PIXELATIONS
from warp_neumat.reference import healpix as healpix_reference
from warp_neumat.reference import pixelations as reference

NSIDE = 64
GRIDS = list(PIXELATIONS)
CONTINUOUS = ["healpix", "lonlat", "sukharev"]


def hemisphere(rng, count):
    vec = rng.normal(size=(count, 3))
    vec[:, 2] = np.abs(vec[:, 2])
    vec[: count // 8] *= (0.02, 0.02, 1.0)  # around the pole
    vec[count // 8 : count // 4] *= (1.0, 1.0, 0.01)  # at the horizon
    return (vec / np.linalg.norm(vec, axis=1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("nside", [4, 7, 32, 64])
def test_counts_and_positions(name, nside):
    grid, wanted = PIXELATIONS[name], healpix.hemisphere_point_count(nside)
    points = grid.positions(nside)
    assert len(points) == grid.points(nside)
    assert abs(len(points) - wanted) <= 2.1 * np.sqrt(wanted)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, atol=1e-12)
    below = (points[:, 2] < -1e-9).mean()
    assert below < 4.0 / np.sqrt(wanted)
    assert len(np.unique(np.round(points, 7), axis=0)) == len(points)


def test_healpix_positions_are_the_corner_grid():
    expected = healpix_reference.corner_directions(16)[: healpix.hemisphere_point_count(16)]
    np.testing.assert_allclose(PIXELATIONS["healpix"].positions(16), expected, atol=1e-14)


@pytest.mark.parametrize("name", GRIDS)
@pytest.mark.parametrize("nside", [4, 64])
def test_a_point_is_its_own_corner(name, nside):
    """The formula of the positions and the search for corners agree on every point, to float32's rounding."""
    grid = PIXELATIONS[name]
    points = grid.positions(nside)
    inside = np.flatnonzero(points[:, 2] >= 0.0)
    index, weight = grid.corners(nside, points[inside].astype(np.float32))
    own = np.where(index == inside[:, None], weight, 0.0).sum(axis=1)
    assert own.min() > 1.0 - (2e-2 if name == "fibonacci" else 1e-3)


@pytest.mark.parametrize("name", GRIDS)
def test_weights_sum_to_one_and_corners_surround(name, rng, device):
    grid, vec = PIXELATIONS[name], hemisphere(rng, 20011)
    index, weight = grid.corners(NSIDE, vec, device=device)
    assert index.dtype == np.int32
    assert weight.dtype == np.float32
    assert index.shape == weight.shape == (20011, 4)
    assert index.min() >= 0
    assert index.max() < grid.points(NSIDE)
    assert weight.min() >= 0.0
    np.testing.assert_allclose(weight.sum(axis=1), 1.0, atol=3e-7)
    # Four spacings: lon-lat cells near the pole are slim, Sukharev's at the cube's middle wide.
    far = np.linalg.norm(grid.positions(NSIDE)[index] - vec[:, None], axis=2)
    assert far.max() < 4.0 * np.sqrt(2.0 * np.pi / grid.points(NSIDE))


@pytest.mark.parametrize("name", ["lonlat", "sukharev"])
def test_corners_match_reference(name, rng):
    grid, vec = PIXELATIONS[name], hemisphere(rng, 4000)
    table = rng.uniform(-1.0, 1.0, grid.points(NSIDE))
    index, weight = grid.corners(NSIDE, vec)
    found = (table[index] * weight).sum(axis=1)
    expected_index, expected_weight = getattr(reference, f"{name}_corners")(grid.size(NSIDE), vec)
    expected = (table[expected_index] * expected_weight).sum(axis=1)
    # Worst seen on the CPU, 2026-11: 3.2e-5.
    assert np.abs(found - expected).max() < 8e-5


@pytest.mark.parametrize("name", CONTINUOUS)
def test_interpolation_is_continuous(name, rng):
    """A step of 1e-4 rad across pole, seams, wrap-around and cell borders moves the result by its share of a cell."""
    grid = PIXELATIONS[name]
    table = rng.uniform(-1.0, 1.0, grid.points(NSIDE))
    t = np.linspace(0.0, 1.0, 20001)[:, None]
    ends = [((-0.3, 0.2, 1.0), (0.3, -0.2, 1.0)), ((1, -0.1, 0.6), (1, 0.1, 0.6)), ((-1, -0.1, 0.2), (-1, 0.1, 0.2))]
    ends += [((0.5, 0.3, 1.0), (1.0, 0.3, 0.5)), ((1.0, 0.7, 0.4), (0.7, 1.0, 0.4))]
    for a, b in ends:
        path = np.asarray(a) * (1.0 - t) + np.asarray(b) * t
        path = (path / np.linalg.norm(path, axis=1, keepdims=True)).astype(np.float32)
        index, weight = grid.corners(NSIDE, path)
        jump = np.abs(np.diff((table[index] * weight).sum(axis=1)))
        step = np.linalg.norm(np.diff(path.astype(np.float64), axis=0), axis=1).max()
        slope = 4.0 * PIXELATIONS["lonlat"].size(NSIDE) / np.pi  # of a table in [−1, 1], along a side of a cell
        if name == "lonlat":  # a parallel of sine s has cells s times as wide
            jump *= np.hypot(path[1:, 0], path[1:, 1])
        assert jump.max() < 4.0 * slope * step


def test_lonlat_is_one_value_at_the_pole(rng):
    grid = PIXELATIONS["lonlat"]
    table = rng.uniform(-1.0, 1.0, grid.points(NSIDE))
    phi = np.linspace(0.0, 2.0 * np.pi, 50)
    vec = np.stack([1e-6 * np.cos(phi), 1e-6 * np.sin(phi), np.ones_like(phi)], 1).astype(np.float32)
    index, weight = grid.corners(NSIDE, vec)
    np.testing.assert_allclose((table[index] * weight).sum(axis=1), table[0], atol=2e-4)


@pytest.mark.parametrize("nside", [4, 5, 11, 64])
def test_fibonacci_pixel_is_the_nearest_point(nside, rng, device):
    grid, vec = PIXELATIONS["fibonacci"], hemisphere(rng, 3000)
    nearest, distance = reference.fibonacci_nearest(grid.positions(nside), vec, 2)
    found = grid.pixels(nside, vec, device=device)
    clear = distance[:, 1] - distance[:, 0] > 2e-6  # float32 decides the rest either way
    assert clear.mean() > 0.99
    np.testing.assert_array_equal(found[clear], nearest[clear, 0])


@pytest.mark.parametrize("nside", [4, 64])
def test_fibonacci_cap_finds_the_nearest_four(nside, rng):
    grid = PIXELATIONS["fibonacci"]
    sphere = fibonacci_sphere(grid.points(nside))
    z = 1.0 - 2.0 * CAP / sphere * rng.random(2000)
    phi = 2.0 * np.pi * rng.random(2000)
    sine = np.sqrt(1.0 - z * z)
    vec = np.stack([sine * np.cos(phi), sine * np.sin(phi), z], 1).astype(np.float32)
    nearest, distance = reference.fibonacci_nearest(grid.positions(nside), vec, 5)
    index, weight = grid.corners(nside, vec)
    clear = distance[:, 4] - distance[:, 3] > 1e-5
    np.testing.assert_array_equal(np.sort(index[clear], axis=1), np.sort(nearest[clear, :4], axis=1))
    expected = 1.0 / np.maximum(distance[:, :4], 1e-7)
    expected /= expected.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(np.sort(weight[clear], axis=1), np.sort(expected[clear], axis=1), atol=2e-3)


def test_fibonacci_weights_reproduce_the_lattice_coordinates(rng):
    """Bilinear in a cell of the lattice is exact for functions that are linear in longitude and height."""
    grid, vec = PIXELATIONS["fibonacci"], hemisphere(rng, 20000)
    points = grid.positions(NSIDE)
    sphere = fibonacci_sphere(len(points))
    index, weight = grid.corners(NSIDE, vec)
    here = reference.fibonacci_coordinates(sphere, vec)
    corner = reference.fibonacci_coordinates(sphere, points[index].reshape(-1, 3)).reshape(-1, 4, 2)
    turned = corner[:, :, 0] - here[:, None, 0]
    corner[:, :, 0] = turned - np.round(turned)
    outside = here[:, 1] > CAP
    offset = (weight * corner[:, :, 0]).sum(axis=1)[outside]
    height = (weight * corner[:, :, 1]).sum(axis=1)[outside] - here[outside, 1]
    assert np.abs(offset).max() < 6e-6  # turns (worst seen 2.9e-6); a step along the lattice is 1e-3 and more
    assert np.abs(height).max() < 0.05  # indices; a step is 89 and more
    # The cell is small: its farthest corner is among the nearest points.
    nearest, _ = reference.fibonacci_nearest(points, vec[:3000], 12)
    assert (index[:3000, :, None] == nearest[:, None, :]).any(axis=2).mean() > 0.95


@pytest.mark.parametrize("name", GRIDS)
def test_degenerate_directions_stay_in_range(name):
    tiny, nan, inf = np.float32(1e-42), np.nan, np.inf
    vec = [(0, 0, 1), (0, 0, -1), (1, 0, 0), (-1, 0, 0), (-1, -0.0, 0), (0, 0, 0), (1, 1, 1), (-1, 1, 1), (-1, -1, 0)]
    vec += [(tiny, 0, 0), (0, 0, tiny), (tiny, tiny, 1), (1e30, -1e30, 1e30), (nan, 0, 1), (0, nan, nan), (inf, 0, 1)]
    vec = np.array(vec, np.float32)
    grid = PIXELATIONS[name]
    for nside in (4, 64):
        index, weight = grid.corners(nside, vec)
        assert index.min() >= 0
        assert index.max() < grid.points(nside)
        finite = np.isfinite(vec).all(axis=1)
        np.testing.assert_allclose(weight[finite].sum(axis=1), 1.0, atol=1e-6)
        pixel = grid.pixels(nside, vec)
        assert pixel[finite].max() < grid.cells(grid.size(nside))


@pytest.mark.parametrize("name", GRIDS)
def test_pixels_are_all_met(name, rng):
    grid = PIXELATIONS[name]
    vec = rng.normal(size=(60000, 3)).astype(np.float32)
    vec[:, 2] = np.abs(vec[:, 2])
    pixel = grid.pixels(8, vec)
    met = np.unique(pixel)
    assert met[0] == 0
    # Fibonacci points beyond the equator are nobody's nearest; HEALPix counts pixels that the equator halves.
    assert len(met) > (0.85 if name == "fibonacci" else 0.95) * grid.cells(grid.size(8))


def test_kinds_of_arrays_and_errors(rng):
    torch = pytest.importorskip("torch")
    grid, vec = PIXELATIONS["sukharev"], hemisphere(rng, 100)
    index, weight = grid.corners(8, torch.from_numpy(vec))
    assert isinstance(index, torch.Tensor)
    assert index.dtype == torch.int32
    np.testing.assert_array_equal(weight.numpy(), grid.corners(8, vec)[1])
    assert grid.corners(8, vec[:0])[0].shape == (0, 4)
    with pytest.raises(ValueError, match=r"nside must be a whole number in \[4, 512\], got 3"):
        grid.corners(3, vec)
    with pytest.raises(ValueError, match=r"directions must have shape \[n, 3\]"):
        grid.corners(8, vec[:, :2])
