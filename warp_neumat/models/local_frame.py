"""Directions as the feature grids see them: torch twin of ``reference.neubrdf`` (frames of docs/conventions.md)."""

from __future__ import annotations

import torch

from warp_neumat import ops
from warp_neumat.kernels.healpix_tree import directions


def to_local_frame(wi: torch.Tensor, wo: torch.Tensor, frame: str, symmetry: str = "none"):
    """Return what the grids of side 0 and side 1 are asked for, (B, 3) each, for unit directions above the horizon.

    - ``absolute``: ω_i and ω_o as they are (the paper's).
    - ``isotropic``: both turned about z until ω_o has azimuth 0, ω_i then mirrored to y ≥ 0.
    - ``half``: half vector, its polar angle stretched near the pole (sin θ' = √sin θ), and difference vector
      (Rusinkiewicz 1998). ``half-isotropic``: the same without the half vector's azimuth.
    - ``half-light``: the same half vector, and ω_i: what bent normals do to highlights and to diffuse light is then one
      product each of a direction's feature and the neural texture's.

    ``symmetry`` folds the difference vector: ``reciprocal`` takes (dx, dy) and (−dx, −dy) for one, ``bilateral`` also
    (dx, −dy).
    """
    if frame == "absolute":
        return wi, wo
    if frame == "isotropic":
        return _to_viewer(wi, wo)
    total = wi + wo
    length = total.norm(dim=1, keepdim=True)
    half = torch.where(length < 1e-6, total.new_tensor([0.0, 0.0, 1.0]), total / length.clamp_min(1e-6))
    square = half[:, 0] ** 2 + half[:, 1] ** 2
    pole = square < 1e-12
    sine = torch.sqrt(square)
    safe = torch.where(pole, 1.0, sine)
    cos, sin = torch.where(pole, 1.0, half[:, 0] / safe), torch.where(pole, 0.0, half[:, 1] / safe)
    # ω_i = |ω_i + ω_o|/2·h + (ω_i − ω_o)/2: written so, swapping the directions negates the rest exactly.
    rest = 0.5 * (wi - wo)
    dx = (rest[:, 0] * cos + rest[:, 1] * sin) * half[:, 2] - rest[:, 2] * sine
    dy = rest[:, 1] * cos - rest[:, 0] * sin
    dz = 0.5 * length[:, 0]
    if symmetry == "reciprocal":
        dx, dy = torch.where((dy < 0.0) | ((dy == 0.0) & (dx < 0.0)), -dx, dx), dy.abs()
    elif symmetry == "bilateral":
        dx, dy = dx.abs(), dy.abs()
    up = half[:, 2] / torch.sqrt(1.0 + sine)
    if frame == "half-isotropic":
        stretched = torch.stack([torch.sqrt(sine), torch.zeros_like(sine), up], 1)
    else:
        stretch = 1.0 / torch.sqrt(sine.clamp_min(1e-12))
        stretched = torch.stack([half[:, 0] * stretch, half[:, 1] * stretch, up], 1)
    if frame == "half-light":
        return stretched, wi
    return stretched, torch.stack([dx, dy, dz], 1)


def _to_viewer(wi, wo):
    square = wo[:, 0] ** 2 + wo[:, 1] ** 2
    pole = square < 1e-12
    sine = torch.sqrt(torch.where(pole, 1.0, square))
    cos, sin = torch.where(pole, 1.0, wo[:, 0] / sine), torch.where(pole, 0.0, wo[:, 1] / sine)
    turned = torch.stack([wi[:, 0] * cos + wi[:, 1] * sin, (wi[:, 1] * cos - wi[:, 0] * sin).abs(), wi[:, 2]], 1)
    view = torch.stack([torch.where(pole, wo[:, 0], sine), torch.where(pole, wo[:, 1], 0.0), wo[:, 2]], 1)
    return turned, view


def corner_weights(nside: int, direction: torch.Tensor, interpolation: str = "bilinear"):
    """Return the four corners of the pixels of ``direction``, (B, 4) int32, and their weights, (B, 4) float32.

    ``bilinear`` in the pixel's own coordinates, continuous; ``idw`` by inverse great-circle distance (paper [neubrdf],
    Sec. 3.2.2, training); ``uniform`` 1/4 each (the paper's run time).
    """
    corner, weight = ops.healpix_corners(nside, direction.contiguous())
    if interpolation == "uniform":
        weight = torch.full_like(weight, 0.25)
    elif interpolation == "idw":
        points = torch.from_numpy(directions(nside)).float().to(direction.device)
        chord = (points[corner.long()] - direction[:, None]).norm(dim=2)
        inverse = 1.0 / (2.0 * torch.asin((0.5 * chord).clamp_max(1.0))).clamp_min(1e-6)
        weight = inverse / inverse.sum(1, keepdim=True)
    return corner, weight
