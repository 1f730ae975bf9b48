"""The corner grid of a HEALPix hemisphere, as a fit needs it: how its levels nest, and who is whose neighbour."""

from __future__ import annotations

import torch

from warp_neumat import ops
from warp_neumat.kernels.healpix_tree import directions


def colours(nside: int) -> torch.Tensor:
    """Return a colour 0 … 3 of every grid point, (n,), such that the corners of a pixel differ.

    The corners of a pixel are one point of ring r, two neighbours of ring r + 1 and one of ring r + 2. (Along the seams
    of the base pixels and at |z| = 2/3 some pixels have two corners of one colour: harmless, they are then moved
    together.)
    """
    rings = []
    for ring in range(2 * nside + 2):
        cap = ring < nside
        count = 1 if ring == 0 else 4 * ring if cap else 4 * nside
        rings.append(2 * (ring & 1) + (torch.arange(count) + (0 if cap else ring >> 1)) % 2)
    return torch.cat(rings)


def levels(nside: int, coarsest: int = 8) -> list[int]:
    """Return the resolutions to go through, coarse to fine: halves of ``nside`` down to ``coarsest``, 3 at most."""
    found = [nside]
    while len(found) < 3 and found[0] % 2 == 0 and found[0] // 2 >= coarsest:
        found.insert(0, found[0] // 2)
    return found


def refine(table: torch.Tensor, nside: int) -> torch.Tensor:
    """Return the features of the grid of 2·``nside`` that show what ``table`` (n, k) shows on that of ``nside``.

    The grids nest: a coarse point keeps its features, a new one takes the bilinear value of the coarse pixel.
    """
    points = torch.from_numpy(directions(2 * nside))
    # The ring beyond the equator lies outside the coarse hemisphere grid: it mirrors the ring this side of it.
    points = torch.cat([points[:, :2], points[:, 2:].abs()], 1).float().to(table.device)
    corner, weight = ops.healpix_corners(nside, points)
    return ops.grid_gather(table, corner, weight)
