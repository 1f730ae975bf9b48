"""Tiles of a sample image: 8×8 texels that are scheduled together and shaded at one rate.

At rate r a tile is shaded at every 2^r-th texel in each direction: the *anchors*, whose column and row are multiples
of the step 2^r. A point of the tile reads the four anchors around it, bilinearly. Rate 0 is every texel.
"""

import numpy as np
import warp as wp

TILE_SHIFT = 3
TILE = 1 << TILE_SHIFT
"""Side of a tile [texel]: the largest step has one quad of anchors in it."""

RATE_MAX = 2
"""Coarsest rate: every fourth texel in each direction."""


def tile_count(width: int, height: int) -> tuple[int, int]:
    """Return how many tiles lie side by side and one above the other, the last ones cut."""
    return -(-width // TILE), -(-height // TILE)


@wp.func
def anchors(x: int, y: int, u: float, v: float, rate: int):
    """Return (x, y, u, v): upper left anchor around a point at ``rate``, and the fractions between the anchors.

    Args:
        x, y: Upper left texel of the point's bilinear footprint.
        u, v: The footprint's fractions.
        rate: Rate of the tile that texel (x, y) lies in.
    """
    step = 1 << rate
    x0 = (x >> rate) << rate
    y0 = (y >> rate) << rate
    scale = 1.0 / float(step)
    return x0, y0, (float(x - x0) + u) * scale, (float(y - y0) + v) * scale


def rate_limits(chart_map: np.ndarray, footprint_map: np.ndarray) -> np.ndarray:
    """Return the coarsest rate of each tile at which no point reads an anchor of another chart.

    Args:
        chart_map: Chart of each texel, −1 = unowned, shape (height, width).
        footprint_map: The same for those texels alone that the footprint of some point covers.

    Returns: (rows, columns) of tiles, uint8, 0 … :data:`RATE_MAX`.
    """
    height, width = footprint_map.shape
    columns, rows = tile_count(width, height)
    limit = np.zeros((rows, columns), np.uint8)
    first = footprint_map[:-1, :-1]  # a point's footprint has it as upper left texel only if all four are covered
    first = np.where(
        (first == footprint_map[:-1, 1:]) & (first == footprint_map[1:, :-1]) & (first == footprint_map[1:, 1:]),
        first,
        -1,
    )
    padded = np.full((rows * TILE, columns * TILE), -1, np.int32)
    padded[: height - 1, : width - 1] = first
    for rate in range(1, RATE_MAX + 1):
        step = 1 << rate
        anchor = np.full((rows * TILE // step + 1, columns * TILE // step + 1), -2, np.int32)
        own = chart_map[::step, ::step]
        anchor[: own.shape[0], : own.shape[1]] = own
        cells = padded.reshape(rows * TILE // step, step, columns * TILE // step, step)
        good = np.ones(cells.shape, bool)
        for j in (0, 1):
            for i in (0, 1):
                corner = anchor[j : j + cells.shape[0], i : i + cells.shape[2]]
                good &= cells == corner[:, None, :, None]
        good |= cells < 0
        per_tile = good.reshape(rows, TILE, columns, TILE).all(axis=(1, 3))
        limit[per_tile & (limit == rate - 1)] = rate
    return limit
