"""The tree of corner grids against geometry: parents around their points, ancestors found by direction."""

import zlib

import numpy as np
import pytest

from warp_neumat.io.asset import pack_bits
from warp_neumat.kernels import healpix_tree
from warp_neumat.reference import healpix
from warp_neumat.reference.neubrdf import all_indices


def _points(nside):
    return healpix.corner_directions(nside)[: healpix.hemisphere_point_count(nside)]


@pytest.mark.parametrize("nside", [1, 2, 3, 6, 8])
def test_directions_are_the_grids(nside):
    assert np.abs(healpix_tree.directions(nside) - _points(nside)).max() < 1e-12


@pytest.mark.parametrize("nside", [2, 4, 6, 12])
def test_a_parent_is_a_corner_of_the_coarse_pixel_around_its_point(nside, rng):
    parent, place = healpix_tree.parents(nside), _points(nside)
    # A point on a border has several pixels around it: each is met by some step aside.
    around = np.zeros(len(place), bool)
    for _ in range(24):
        corner, _ = healpix.corners(nside // 2, place + rng.normal(size=place.shape) * 1e-5)
        around |= (corner == parent[:, None]).any(1)
    assert around.all()


@pytest.mark.parametrize("nside", [2, 4, 6, 12])
def test_a_point_of_both_grids_is_its_own_parent(nside):
    fine, coarse = _points(nside), _points(nside // 2)
    cosine = fine @ coarse.T
    shared = cosine.max(1) > 1 - 1e-12
    # All but the last ring of the coarse grid, which lies beyond the fine one's.
    assert shared.sum() == len(coarse) - 2 * nside
    assert np.array_equal(healpix_tree.parents(nside)[shared], cosine.argmax(1)[shared])
    assert not np.array_equal(healpix_tree.parents(nside), cosine.argmax(1))  # others go towards the pole


def test_odd_sides_have_no_parents():
    with pytest.raises(ValueError, match="nside must be even to have a grid of half of it, got 3"):
        healpix_tree.parents(3)


@pytest.mark.parametrize(("nside", "share"), [(8, 0.3), (8, 0.02), (6, 0.1), (3, 0.2), (4, 1.0)])
def test_expand_matches_the_reference_point_by_point(nside, share, rng):
    points = len(_points(nside))
    live = rng.random(2 * points) < share
    live[[points - 1, points + 1]] = True
    indices = rng.integers(0, 1 << 9, int(live.sum()))
    stored = {
        "indices": pack_bits(indices, 9),
        "live": np.frombuffer(zlib.compress(np.packbits(live, bitorder="little").tobytes()), np.uint8),
    }
    got = healpix_tree.expand(nside, live, indices)
    assert np.array_equal(got[live], indices)
    assert np.array_equal(got, all_indices(stored, {"nside": nside, "bits": 9}))


def test_a_live_coarse_grid_serves_every_point():
    nside = 8
    place, coarse = _points(nside), _points(2)
    live = (place @ coarse.T).max(1) > 1 - 1e-12
    source = healpix_tree.sources(nside, live)
    assert np.array_equal(source[live], np.flatnonzero(live))
    assert live[source].all()
    # No further than the longest diagonal of a pixel of the coarse grid.
    assert np.arccos(np.clip((place * place[source]).sum(1), -1, 1)).max() < 1.05


def test_lone_live_point_serves_its_side():
    points = len(_points(6))
    live = np.zeros(2 * points, bool)
    live[[5, points + 77]] = True
    assert np.array_equal(healpix_tree.expand(6, live, np.array([3, 4])), np.repeat([3, 4], points))


@pytest.mark.parametrize(
    ("live", "indices", "message"),
    [
        (np.ones(73, bool), np.zeros(73), r"live must have shape \(74,\) for nside 2"),
        (np.ones(74, bool), np.zeros(73), r"indices must have shape \(74,\), one for each live point"),
        (np.arange(74) < 9, np.zeros(9), "live must hold at least one point of each side"),
    ],
)
def test_wrong_lengths_are_named(live, indices, message):
    with pytest.raises(ValueError, match=message):
        healpix_tree.expand(2, live, indices)
