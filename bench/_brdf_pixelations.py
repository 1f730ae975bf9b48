"""Grids over the hemisphere measured: time to index a frame, evenness, nesting, latitudes ([neubrdf], Table 1).

- ``ms``: the pixels of ω_i and ω_o of every pixel of a frame, directions in random order, resident and unit; all
  methods in turns. ``corners_ms``: four points and weights instead.
- ``area_ratio``: largest over smallest pixel, by counting evenly spread directions, 256 a pixel on average, so
  that equal areas are seen as 1.1 or 1.2 and the slivers at the pole of longitude-latitude within a factor of two;
  pixels that reach the equator are left out.
- ``spacing_ratio``: largest over smallest distance of a point to its nearest neighbour.
- ``nested``: the share of pixels of twice the resolution that lie in one pixel of this one; ``hierarchy`` where it is
  all. The paper says no for longitude-latitude and the cube; their cells do nest, but those of a level differ in area.
- ``latitudes``: different heights of points; ``iso_latitude`` where they are far fewer than the points.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_neumat.kernels.pixelations import PIXELATIONS, Pixelation

from .harness import interleave

TRIES = 256
"""Directions a point, to measure areas."""


def even_directions(count: int) -> np.ndarray:
    """Return ``count`` directions of the hemisphere, evenly spread (a rank-1 lattice), (count, 3) float32."""
    i = np.arange(count) + 0.5
    z, phi = i / count, 2.0 * np.pi * (i * 0.7548776662466927 % 1.0)
    sine = np.sqrt(1.0 - z * z)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], 1).astype(np.float32)


def area_ratio(grid: Pixelation, size: int, directions: np.ndarray) -> float:
    """Return largest over smallest area of the pixels that keep off the equator."""
    pixel = grid.pixels_at(size, directions)
    counts = np.bincount(pixel)
    cut = np.unique(pixel[directions[:, 2] < 4.0 / size_of(grid, size)])
    counts[cut] = 0
    met = counts[counts > 0]
    return float(met.max() / met.min())


def size_of(grid: Pixelation, size: int) -> float:
    """Return about how many pixels lie along a quarter of a great circle."""
    return (grid.count(size) * np.pi / 8) ** 0.5


def spacing_ratio(points: np.ndarray) -> float:
    """Return largest over smallest distance of a point above the equator to its nearest neighbour."""
    nearest = np.empty(len(points))
    single = points.astype(np.float32)
    for start in range(0, len(points), 1024):
        cosine = single[start : start + 1024] @ single.T
        cosine[np.arange(len(cosine)), start + np.arange(len(cosine))] = -1.0
        found = cosine.argmax(axis=1)
        nearest[start : start + 1024] = np.linalg.norm(points[start : start + 1024] - points[found], axis=1)
    above = nearest[points[:, 2] >= 0.0]
    return float(above.max() / above.min())


def nested(grid: Pixelation, size: int, directions: np.ndarray) -> float:
    """Return the share of the pixels of twice the resolution that lie in one pixel of ``size``."""
    # Twice as many along a side: for Fibonacci, whose size is its count, four times the points.
    fine = grid.pixels_at(4 * size if grid.name == "fibonacci" else 2 * size, directions)
    coarse = grid.pixels_at(size, directions)
    order = np.lexsort((coarse, fine))
    fine, coarse = fine[order], coarse[order]
    first = np.flatnonzero(np.diff(fine, prepend=-1))
    last = np.append(first[1:], len(fine)) - 1
    # A direction within float32 rounding of a border may fall on either side: one stray in a pixel is not a crossing.
    inner = last - first >= 4
    same = coarse[first[inner] + 1] == coarse[last[inner] - 1]
    return float(same.mean())


def rows(*, device: str, pixels: int, rounds: int, nside: int):
    """Yield one row a grid."""
    rng = np.random.default_rng(5)
    pair = rng.normal(size=(2 * pixels, 3))
    pair[:, 2] = np.abs(pair[:, 2])
    pair /= np.linalg.norm(pair, axis=1, keepdims=True)
    vec = wp.array(pair.astype(np.float32), dtype=wp.float32, device=device)
    pixel = wp.empty(2 * pixels, dtype=wp.int32, device=device)
    corner = wp.empty((2 * pixels, 4), dtype=wp.int32, device=device)
    weight = wp.empty((2 * pixels, 4), dtype=wp.float32, device=device)

    def indexing(grid, what):
        def call():
            if what == "pixels":
                grid.pixels(nside, vec, out=pixel)
            else:
                grid.corners_at(grid.size(nside), vec, out=(corner, weight))
            wp.synchronize_device(device)

        return call

    seconds = {
        what: interleave({name: indexing(grid, what) for name, grid in PIXELATIONS.items()}, rounds)
        for what in ("pixels", "corners")
    }
    spread = even_directions(TRIES * PIXELATIONS["healpix"].points(nside))
    some = even_directions(64 * PIXELATIONS["healpix"].points(max(nside // 2, 4)))
    for name, grid in PIXELATIONS.items():
        points, size = grid.positions(nside), grid.size(nside)
        latitudes = len(np.unique(np.round(points[:, 2], 9)))
        share = nested(grid, grid.size(max(nside // 4, 4)), some)
        row = {
            "table": "table1",
            "method": name,
            "points": len(points),
            "pixels": pixels,
            "ms": seconds["pixels"][name] * 1e3,
            "corners_ms": seconds["corners"][name] * 1e3,
            "area_ratio": area_ratio(grid, size, spread),
            "spacing_ratio": spacing_ratio(points),
            "nested": share,
            "hierarchy": share > 0.999,
            "latitudes": latitudes,
            "iso_latitude": latitudes < 4 * len(points) ** 0.5,
        }
        if name != "healpix":  # the paper's choice beside each of the others, in the same rounds
            row |= {"peer": "healpix", "peer_ms": seconds["pixels"]["healpix"] * 1e3}
            row["ratio"] = row["peer_ms"] / row["ms"]
        yield row
