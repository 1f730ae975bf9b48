"""HEALPix kernels against healpy, the float64 reference, and the properties that interpolation needs."""

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels import healpix
from warp_neumat.reference import healpix as reference

healpy = pytest.importorskip("healpy")

POWERS = [2**k for k in range(14)]
OTHERS = [3, 5, 6, 7, 12, 100, 4999, 8191]
ORDERS = [(n, nest) for n in POWERS for nest in (False, True)] + [(n, False) for n in OTHERS]
AXES = np.array([v for v in np.ndindex(3, 3, 3) if v != (1, 1, 1)], dtype=np.float64) - 1.0


def unit(rng, count: int, dtype=np.float64) -> np.ndarray:
    vec = rng.normal(size=(count, 3))
    return (vec / np.linalg.norm(vec, axis=1, keepdims=True)).astype(dtype)


def some_pixels(rng, nside: int, count: int) -> np.ndarray:
    """All pixels, or a sample with the first and last rings and those around the equator and the cap borders."""
    npix = 12 * nside * nside
    if npix <= count:
        return np.arange(npix)
    cap = 2 * nside * (nside + 1)
    edges = [np.arange(m - 40, m + 40) for m in (cap, npix // 2, npix - cap)]
    sample = np.concatenate([rng.integers(0, npix, count), np.arange(40), np.arange(npix - 40, npix), *edges])
    return np.clip(sample, 0, npix - 1)


def border_points(rng, nside: int, count: int, step: int = 3) -> np.ndarray:
    """Corners and points along the edges of pixels."""
    points = healpy.boundaries(nside, some_pixels(rng, nside, count), step=step)
    return np.ascontiguousarray(points.transpose(0, 2, 1).reshape(-1, 3))


def border_distance(nside: int, vec: np.ndarray) -> np.ndarray:
    """How far each direction is from the border of its pixel, in pixels."""
    weights = reference.corners(nside, vec)[1]
    u, v = weights[:, 1] + weights[:, 3], weights[:, 2] + weights[:, 3]
    return np.min([u, 1.0 - u, v, 1.0 - v], axis=0)


def interpolate(table: np.ndarray, indices: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return (table[indices] * weights).sum(axis=1)


# ---------------------------------------------------------------------------------------------- vec2pix, float64


@pytest.mark.parametrize(("nside", "nest"), ORDERS)
def test_vec2pix_equals_healpy_on_random_directions(device, rng, nside, nest):
    vec = unit(rng, 10**6 // len(ORDERS))
    expected = healpy.vec2pix(nside, *vec.T, nest=nest)
    assert np.array_equal(healpix.vec2pix(nside, vec, nest=nest, device=device), expected)
    assert np.array_equal(reference.vec2pix(nside, vec[:5000], nest=nest), expected[:5000])


@pytest.mark.slow
@pytest.mark.parametrize("nest", [False, True])
def test_vec2pix_equals_healpy_on_ten_million_directions(rng, nest):
    for _ in range(10):
        vec = unit(rng, 10**6)
        for nside in POWERS:
            assert np.array_equal(healpix.vec2pix(nside, vec, nest=nest), healpy.vec2pix(nside, *vec.T, nest=nest)), (
                nside
            )


@pytest.mark.parametrize(("nside", "nest"), ORDERS)
def test_vec2pix_equals_healpy_on_centres_borders_and_axes(rng, nside, nest):
    """On a border only rounding decides. The oracle is healpy on the same libm, so this runs on the CPU alone."""
    pixels = some_pixels(rng, nside, 3000)
    centres = np.stack(healpy.pix2vec(nside, pixels), axis=1)
    borders = border_points(rng, nside, 3000)
    ring = np.round(borders * nside) / nside  # lands on poles with signed zeros, on meridians and on the equator
    for vec in (centres, borders, 1.37 * borders, ring[np.abs(ring).sum(axis=1) > 0.0], AXES):
        vec = np.ascontiguousarray(vec)
        expected = healpy.vec2pix(nside, *vec.T, nest=nest)
        assert np.array_equal(healpix.vec2pix(nside, vec, nest=nest, device="cpu"), expected)
        assert np.array_equal(reference.vec2pix(nside, vec, nest=nest), expected)
    index = healpy.ring2nest(nside, pixels) if nest else pixels
    assert np.array_equal(healpix.vec2pix(nside, centres, nest=nest, device="cpu"), index)


def test_vec2pix_ignores_length(device, rng):
    vec = unit(rng, 4000)
    for nest in (False, True):
        expected = healpix.vec2pix(64, vec, nest=nest, device=device)
        for exponent in (-1020, -490, -170, 170, 490, 1020):
            assert np.array_equal(healpix.vec2pix(64, vec * 2.0**exponent, nest=nest, device=device), expected)
        expected = healpix.vec2pix(64, vec.astype(np.float32), nest=nest, device=device)
        for exponent in (-100, -50, 50, 100, 126):
            scaled = vec.astype(np.float32) * np.float32(2.0**exponent)
            assert np.array_equal(healpix.vec2pix(64, scaled, nest=nest, device=device), expected)


# ---------------------------------------------------------------------------------------------- vec2pix, float32

BORDER32 = 3.5 * 2.0**-24
"""[pixel / nside] Worst seen 1.82 · 2⁻²⁴ on random directions and pixel borders, AVX2, 2026-11; about twice that."""


@pytest.mark.parametrize("nside", [1, 2, 4, 7, 64, 100, 1024, 8192])
def test_vec2pix_float32_errs_only_at_borders(device, rng, nside):
    vec = np.concatenate([unit(rng, 60_000), border_points(rng, nside, 2000), AXES]).astype(np.float32)
    vec = vec[np.abs(vec).sum(axis=1) > 0]
    exact = vec.astype(np.float64)
    distance = border_distance(nside, exact)
    for nest in (False, True)[: 1 if nside & (nside - 1) else 2]:
        expected = healpy.vec2pix(nside, *exact.T, nest=nest)
        found = healpix.vec2pix(nside, vec, nest=nest, device=device)
        wrong = found != expected
        assert distance[wrong].max(initial=0.0) <= BORDER32 * nside
        neighbours = healpy.get_all_neighbours(nside, expected[wrong], nest=nest)
        assert (neighbours == found[wrong]).any(axis=0).all()


def test_vec2pix_precision_can_be_forced(rng):
    vec = unit(rng, 200_000)
    expected = healpy.vec2pix(8192, *vec.T)
    rounded = healpy.vec2pix(8192, *vec.astype(np.float32).astype(np.float64).T)
    single = vec.astype(np.float32)
    assert np.array_equal(healpix.vec2pix(8192, single, nest=False, precision="float64"), rounded)
    assert (healpix.vec2pix(8192, vec, nest=False, precision="float32") != expected).any()
    assert np.array_equal(
        healpix.vec2pix(8192, vec, nest=False, precision="float32"), healpix.vec2pix(8192, single, nest=False)
    )


# ---------------------------------------------------------------------------------------------- corners

CORNER_NSIDES = [1, 2, 3, 4, 7, 64, 1024]


@pytest.mark.parametrize("nside", [1, 2, 3, 4, 7, 64])
def test_corner_directions_are_the_pixels_corners(nside):
    grid = reference.corner_directions(nside)
    assert grid.shape == (healpix.corner_point_count(nside), 3)
    pixels = np.arange(12 * nside * nside)
    centres = np.stack(healpy.pix2vec(nside, pixels), axis=1)
    indices, weights = reference.corners(nside, centres)
    assert np.allclose(weights, 0.25, atol=1e-12 * nside)
    north, west, south, east = healpy.boundaries(nside, pixels, step=1).transpose(2, 0, 1)
    upper = (centres[:, 2] >= 0.0)[:, None]
    expected = np.stack([np.where(upper, north, south), east, west, np.where(upper, south, north)], axis=1)
    assert np.abs(grid[indices] - expected).max() < 1e-14
    assert len(np.unique(indices)) == len(grid)
    below = grid[healpix.hemisphere_point_count(nside) :, 2]
    assert (below < 0.0).all()


@pytest.mark.parametrize("nside", CORNER_NSIDES)
def test_corners_match_reference(device, rng, nside):
    vec = np.concatenate([unit(rng, 100_000), border_points(rng, nside, 2000), AXES]).astype(np.float32)
    indices, weights = healpix.corners(nside, vec, device=device)
    assert (indices.dtype, weights.dtype) == (np.int32, np.float32)
    assert indices.min() >= 0
    assert indices.max() < healpix.corner_point_count(nside)
    assert weights.min() >= 0.0
    assert weights.max() <= 1.0
    assert np.abs(weights.astype(np.float64).sum(axis=1) - 1.0).max() < 2.5e-7
    # On a border either pixel's corners are right, so what is compared is the interpolated value.
    table = rng.uniform(-1.0, 1.0, reference.corner_point_count(nside))
    expected = interpolate(table, *reference.corners(nside, vec.astype(np.float64)))
    assert np.abs(interpolate(table, indices, weights) - expected).max() < 6e-7 * nside  # worst seen 3.4e-7, 2026-11
    same = border_distance(nside, vec.astype(np.float64)) > BORDER32 * nside
    inside = vec[same].astype(np.float64)
    assert np.array_equal(indices[same], reference.corners(nside, inside)[0])


@pytest.mark.parametrize("nside", [1, 2, 3, 4, 8])
def test_corner_weights_are_continuous_over_every_edge(device, rng, nside):
    """Across all edges of all pixels: |∇a|, |∇b| ≤ 1.5 nside, so values in [−1, 1] change by ≤ 6 nside a radian."""
    points = np.concatenate([border_points(rng, nside, 10**6, step=7), AXES])
    points = np.repeat(points / np.linalg.norm(points, axis=1, keepdims=True), 6, axis=0)
    for step in (1e-6, 1e-4, 1e-2):
        offset = unit(rng, len(points)) * step
        ends = [(points + side * offset).astype(np.float32) for side in (-1.0, 1.0)]
        table = rng.uniform(-1.0, 1.0, reference.corner_point_count(nside))
        before, after = (interpolate(table, *healpix.corners(nside, end, device=device)) for end in ends)
        jump = np.abs(after - before)
        bound = 6.0 * nside * np.linalg.norm(ends[1].astype(np.float64) - ends[0], axis=1) * 1.02
        assert (jump <= bound + 2.0 * 6e-7 * nside).all()
        assert jump.max() > 0.1 * nside * step  # the table is not flat: the bound has something to hold


@pytest.mark.parametrize("nside", [1, 2, 3, 64])
def test_corner_weights_have_linear_precision(device, rng, nside):
    """Rings are linear in (a, b) everywhere, z is in the belt: both are reproduced."""
    vec = unit(rng, 50_000, np.float32)
    indices, weights = healpix.corners(nside, vec, device=device)
    z = vec[:, 2].astype(np.float64) / np.linalg.norm(vec.astype(np.float64), axis=1)
    grid = reference.corner_directions(nside)
    belt = (np.abs(grid[indices, 2]) < 2.0 / 3.0 + 1e-9).all(axis=1)
    assert belt.mean() > 0.2
    assert np.abs(interpolate(grid[:, 2], indices, weights) - z)[belt].max() < 1e-6
    sizes = np.diff(reference._ring_starts(nside))
    ring = np.repeat(np.arange(4 * nside + 1), sizes)
    radius = np.where(np.abs(z) > 2 / 3, np.sqrt(3.0 * (1.0 - np.abs(z))), 2.0 - 1.5 * np.abs(z)) * nside
    expected = np.where(z >= 0.0, radius, 4 * nside - radius)
    assert np.abs(interpolate(ring, indices, weights) - expected).max() < 2e-6 * nside


@pytest.mark.parametrize("nside", [1, 2, 7, 64])
def test_corners_of_upper_directions_stay_on_the_hemisphere_grid(device, rng, nside):
    vec = np.concatenate([unit(rng, 50_000), border_points(rng, nside, 2000), AXES]).astype(np.float32)
    vec[:, 2] = np.abs(vec[:, 2])
    flat = vec * np.float32([1, 1, 0])
    upper = np.concatenate([vec, flat[np.abs(flat).sum(axis=1) > 0]])
    assert healpix.corners(nside, upper, device=device)[0].max() < healpix.hemisphere_point_count(nside)


def test_poles_get_their_own_point(device):
    tiny = np.float32(1e-45)
    for x, y in [(0, 0), (tiny, 0), (-tiny, tiny), (tiny, -tiny), (1e-20, -1e-20)]:
        indices, weights = healpix.corners(8, np.float32([[x, y, 1], [x, y, -1]]), device=device)
        assert indices[:, 0].tolist() == [0, healpix.corner_point_count(8) - 1]
        assert np.abs(weights[:, 0] - 1.0).max() < 1e-6


# ---------------------------------------------------------------------------------------------- odd input


def test_zero_and_non_finite_vectors_stay_in_range(device):
    bad = [np.nan, np.inf, -np.inf, 0.0, 1.0]
    vec = np.array(list(np.ndindex(5, 5, 5)))
    vec = np.array(bad, dtype=np.float32)[vec]
    valid = np.isfinite(vec).all(axis=1) & (np.abs(vec).sum(axis=1) > 0)
    for nside in (1, 8192):
        indices, weights = healpix.corners(nside, vec, device=device)
        assert indices.min() >= 0
        assert indices.max() < healpix.corner_point_count(nside)
        sums = weights.sum(axis=1)
        assert (np.isnan(sums) | (np.abs(sums - 1.0) < 1e-6)).all()
        for nest in (False, True):
            for dtype in (np.float32, np.float64):
                ipix = healpix.vec2pix(nside, vec.astype(dtype), nest=nest, device=device)
                assert (ipix[~valid] == -1).all()
                assert ((ipix[valid] >= 0) & (ipix[valid] < 12 * nside * nside)).all()
    zero = healpix.corners(4, np.zeros((1, 3), np.float32), device=device)
    assert zero[0][0, 0] == 0
    assert zero[1][0].tolist() == [1.0, 0.0, 0.0, 0.0]


def test_denormal_directions_keep_their_direction(device):
    tiny = np.float32([[1, 2, 3], [-4, 5, -6], [7, 0, 0], [0, 0, -8]]) * np.float32(2.0**-149)
    direction = tiny.astype(np.float64) * 2.0**149
    for nest in (False, True):
        expected = healpy.vec2pix(4, *direction.T, nest=nest)
        assert np.array_equal(healpix.vec2pix(4, tiny, nest=nest, device=device), expected)
    found, expected = healpix.corners(4, tiny, device=device), reference.corners(4, direction)
    assert np.abs(found[1] - expected[1])[:2].max() < 2e-6


@pytest.mark.parametrize("count", [0, 1, 255, 256, 257, 1000])
def test_any_count_of_vectors_is_handled(device, rng, count):
    vec = unit(rng, count)
    for dtype in (np.float32, np.float64):
        out = np.full(count + 8, 77, np.int64)
        found = healpix.vec2pix(16, vec.astype(dtype), nest=True, device=device)
        assert (found.shape, found.dtype) == ((count,), np.int64)
        assert np.array_equal(found, healpy.vec2pix(16, *vec.T, nest=True) if count else found)
        if device == "cpu":
            assert healpix.vec2pix(16, vec.astype(dtype), nest=True, out=out[:count], device=device).base is out
            assert np.array_equal(out[:count], found)
            assert (out[count:] == 77).all()
    indices, weights = healpix.corners(16, vec, device=device)
    assert indices.shape == weights.shape == (count, 4)


def test_the_kind_of_array_that_goes_in_comes_out(rng):
    torch = pytest.importorskip("torch")
    vec = unit(rng, 300, np.float32)
    expected = healpix.vec2pix(32, vec, nest=False)
    indices, weights = healpix.corners(32, vec)
    warp_vec = wp.array(vec, dtype=wp.vec3, device="cpu")
    for given, kind in ((torch.from_numpy(vec), torch.Tensor), (warp_vec, wp.array)):
        results = [healpix.vec2pix(32, given, nest=False), *healpix.corners(32, given)]
        for result, wanted in zip(results, (expected, indices, weights), strict=True):
            assert isinstance(result, kind)
            assert np.array_equal(result.numpy(), wanted)
    double = torch.from_numpy(vec.astype(np.float64))
    assert np.array_equal(healpix.vec2pix(32, double, nest=True), healpy.vec2pix(32, *vec.T.astype(float), nest=True))
    vec3d = wp.array(vec.astype(np.float64), dtype=wp.vec3d, device="cpu")
    assert np.array_equal(healpix.vec2pix(8192, vec3d, nest=True).numpy(), healpix.vec2pix(8192, double, nest=True))


def test_wrong_arguments_are_named():
    vec = np.ones((4, 3), np.float32)
    with pytest.raises(TypeError, match="nest"):
        healpix.vec2pix(8, vec)
    with pytest.raises(TypeError, match="nest must be True"):
        healpix.vec2pix(8, vec, nest="ring")
    with pytest.raises(ValueError, match="nside must be a power of two in NESTED order, got 12"):
        healpix.vec2pix(12, vec, nest=True)
    for nside in (0, -4, 8193):
        with pytest.raises(ValueError, match=f"nside must be between 1 and 8192, got {nside}"):
            healpix.corners(nside, vec)
    with pytest.raises(TypeError, match="nside must be a whole number, got 8.0"):
        healpix.vec2pix(8.0, vec, nest=False)
    with pytest.raises(ValueError, match=r"vec must have shape \[n, 3\], got \(4, 2\)"):
        healpix.vec2pix(8, vec[:, :2], nest=False)
    with pytest.raises(ValueError, match="precision must be 'auto', 'float32' or 'float64', got 'half'"):
        healpix.vec2pix(8, vec, nest=False, precision="half")
    with pytest.raises(ValueError, match="out must be a C-contiguous numpy array of int64"):
        healpix.vec2pix(8, vec, nest=False, out=np.empty(4, np.int32))
