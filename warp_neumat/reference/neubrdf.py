"""NumPy float64 evaluation of a NeuBRDF asset: the plain form that the torch module and the Warp kernel must match.

Paper [neubrdf], Sec. 3.1–3.3 (Eq. 1–4). Differs: bilinear weights beside inverse-distance and 1/4; side 1 has an index
grid of its own with northern numbering instead of the mirrored southern hemisphere; the decoder predicts log(1 + f).
Frames: ω_i to the light, ω_o to the viewer, z = shading normal.
"""

from __future__ import annotations

import zlib

import numpy as np

from warp_neumat.reference import healpix


def to_local_frame(wi: np.ndarray, wo: np.ndarray, frame: str, symmetry: str = "none") -> tuple[np.ndarray, np.ndarray]:
    """Return the two directions that the grids see, (N, 3) each.

    - ``"absolute"`` returns them unchanged.
    - ``"isotropic"`` turns both about z until ω_o has azimuth 0, then mirrors ω_i to y ≥ 0; where ω_o is the pole (x² +
      y² < 1e-12) nothing is turned.
    - ``"half"`` returns half and difference vector (Rusinkiewicz 1998: d = ω_i turned by −φ_h about z, then by −θ_h
      about y), the half vector's sin θ replaced by its root; ``"half-isotropic"`` also sets its azimuth to 0.
    - ``"half-light"`` returns the same half vector, and ω_i.

    Args:
        wi, wo: Unit directions with z ≥ 0, (N, 3).
        frame: Which of these.
        symmetry: With half frames: ``"reciprocal"`` turns the difference vector by π about z where its y is negative
            (or 0, and x negative), ``"bilateral"`` mirrors it to x, y ≥ 0.
    """
    wi, wo = np.array(wi, np.float64), np.array(wo, np.float64)
    if frame == "absolute":
        return wi, wo
    if frame == "half-light":
        return _half_frame(wi, wo, False, "none")[0], wi
    if frame in ("half", "half-isotropic"):
        return _half_frame(wi, wo, frame == "half-isotropic", symmetry)
    square = wo[:, 0] ** 2 + wo[:, 1] ** 2
    pole = square < 1e-12
    sine = np.sqrt(np.where(pole, 1.0, square))
    cos, sin = np.where(pole, 1.0, wo[:, 0] / sine), np.where(pole, 0.0, wo[:, 1] / sine)
    x, y = wi[:, 0] * cos + wi[:, 1] * sin, wi[:, 1] * cos - wi[:, 0] * sin
    wi[:, 0], wi[:, 1] = x, np.abs(y)
    wo[:, 0], wo[:, 1] = np.where(pole, wo[:, 0], sine), np.where(pole, wo[:, 1], 0.0)
    return wi, wo


def _half_frame(wi, wo, isotropic: bool, symmetry: str):
    total = wi + wo
    length = np.linalg.norm(total, axis=1, keepdims=True)
    h = np.where(length < 1e-6, [0.0, 0.0, 1.0], total / np.maximum(length, 1e-6))
    square = h[:, 0] ** 2 + h[:, 1] ** 2
    pole, sine = square < 1e-12, np.sqrt(square)
    cos = np.where(pole, 1.0, h[:, 0] / np.where(pole, 1.0, sine))
    sin = np.where(pole, 0.0, h[:, 1] / np.where(pole, 1.0, sine))
    along, y = wi[:, 0] * cos + wi[:, 1] * sin, wi[:, 1] * cos - wi[:, 0] * sin
    x, z = along * h[:, 2] - wi[:, 2] * sine, np.maximum(along * sine + wi[:, 2] * h[:, 2], 0.0)
    if symmetry == "reciprocal":
        turned = (y < 0) | ((y == 0) & (x < 0))
        x, y = np.where(turned, -x, x), np.where(turned, -y, y)
    elif symmetry == "bilateral":
        x, y = np.abs(x), np.abs(y)
    cosine = h[:, 2] / np.sqrt(1.0 + sine)
    if isotropic:
        warped = np.stack([np.sqrt(sine), np.zeros_like(sine), cosine], 1)
    else:
        root = 1.0 / np.sqrt(np.maximum(sine, 1e-12))
        warped = np.stack([h[:, 0] * root, h[:, 1] * root, cosine], 1)
    return warped, np.stack([x, y, z], 1)


def corner_weights(nside: int, direction: np.ndarray, interpolation: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the four grid points around each direction and their weights, (N, 4) each; weights sum to 1.

    Args:
        nside: Resolution of the grid.
        direction: (N, 3) with z ≥ 0.
        interpolation: ``"bilinear"``; ``"idw"``, inverse great-circle distances, at least 1e-6 rad each (paper, Sec.
            3.2.2); ``"uniform"``, 1/4 (paper, run time).
    """
    corner, weight = healpix.corners(nside, direction)
    if interpolation == "bilinear":
        return corner, weight
    if interpolation == "uniform":
        return corner, np.full(corner.shape, 0.25)
    unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    chord = np.linalg.norm(healpix.corner_directions(nside)[corner] - unit[:, None], axis=2)
    inverse = 1.0 / np.maximum(2.0 * np.arcsin(np.minimum(chord / 2.0, 1.0)), 1e-6)
    return corner, inverse / inverse.sum(1, keepdims=True)


def unpack(data: np.ndarray, bits: int, count: int) -> np.ndarray:
    """Return ``count`` integers of ``bits`` bits each from a little-endian bit stream (uint8)."""
    stream = np.unpackbits(np.asarray(data, np.uint8), bitorder="little", count=count * bits).reshape(count, bits)
    return stream.astype(np.int64) @ (1 << np.arange(bits, dtype=np.int64))


def all_indices(tensors: dict[str, np.ndarray], config: dict) -> np.ndarray:
    """Return the index of every grid point of both sides, (2n,) int64; pruned points take that of their ancestors.

    Written point by point: the ancestor of a point is the corner nearest the pole of the pixel of half the resolution
    that holds it, found by its direction.
    """
    nside, bits = config["nside"], config["bits"]
    points = healpix.hemisphere_point_count(nside)
    if "live" not in tensors:
        return unpack(tensors["indices"], bits, 2 * points)
    mask = np.frombuffer(zlib.decompress(tensors["live"].tobytes()), np.uint8)
    live = np.unpackbits(mask, count=2 * points, bitorder="little").astype(bool)
    result = np.zeros(2 * points, np.int64)
    result[live] = unpack(tensors["indices"], bits, int(live.sum()))
    place = healpix.corner_directions(nside)[:points]
    for side in range(2):
        own = slice(side * points, (side + 1) * points)
        alive, values = live[own], result[own]
        for p in np.flatnonzero(~alive):
            at, n = p, nside
            while not alive[at] and n % 2 == 0:
                n //= 2
                at = _ancestor(n, nside, place[at], place)
            if not alive[at]:
                at = np.flatnonzero(alive)[np.argmax(np.round(place[alive] @ place[at], 12))]
            values[p] = values[at]
    return result


def _ancestor(coarse: int, nside: int, direction: np.ndarray, place: np.ndarray) -> int:
    """Return the number, on the grid of ``nside``, of the coarse pixel's corner nearest the pole."""
    # A point on a border belongs to the pixel south of it: the one that a step down and along both diagonals reaches.
    # In a polar cap the borders between quarters belong to the eastern one.
    z = direction[2]
    phi = np.arctan2(direction[1], direction[0]) + 1e-7 / max(np.sqrt(1 - z * z), 1e-3)
    z -= 1e-6
    sine = np.sqrt(1 - z * z)
    corner, _ = healpix.corners(coarse, np.array([[sine * np.cos(phi), sine * np.sin(phi), z]]))
    apex = corner[0, 0] if z >= 0 else corner[0, 3]
    return int(np.argmax(place @ healpix.corner_directions(coarse)[apex]))


def sample_texture(mips: list[np.ndarray], uv: np.ndarray, lod: np.ndarray) -> np.ndarray:
    """Return the neural texture at ``uv`` (N, 2) and level ``lod`` (N,), (N, channels) float64.

    Trilinear; repeat; texel i is centred at (i + 0.5)/W, v runs down. What is not finite counts as 0.
    """
    uv = np.nan_to_num(np.where(np.isfinite(uv), uv, 0.0).astype(np.float64))
    level = np.clip(np.nan_to_num(np.asarray(lod, np.float64), nan=0.0), 0, len(mips) - 1)
    low = np.floor(level).astype(int)
    result = np.zeros((len(uv), mips[0].shape[2]))
    for m, mip in enumerate(mips):
        share = np.where(low == m, 1 - (level - low), np.where(low + 1 == m, level - low, 0.0))
        height, width = mip.shape[:2]
        x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
        x0, y0 = np.floor(x), np.floor(y)
        for dx in (0, 1):
            for dy in (0, 1):
                weight = (x - x0 if dx else 1 - (x - x0)) * (y - y0 if dy else 1 - (y - y0)) * share
                column, row = (x0 + dx).astype(np.int64) % width, (y0 + dy).astype(np.int64) % height
                result += mip[row, column].astype(np.float64) * weight[:, None]
    return result


def reference_eval(
    tensors: dict[str, np.ndarray], config: dict, wi: np.ndarray, wo: np.ndarray, uv=None, lod=0.0
) -> np.ndarray:
    """Return the BRDF in 1/sr (without the cosine), (N, 3) float64, from the stored fp16 tensors.

    Args:
        tensors: ``codebook``, ``indices``, ``weight0`` … as stored in the asset.
        config: The asset's ``config``, of version 1 or 2.
        wi, wo: Unit directions, (N, 3); values below the horizon are 0.
        uv, lod: Texture coordinates (N, 2) and mip level, a number or (N,), where there is a texture.
    """
    nside = config["nside"]
    indices = all_indices(tensors, config)
    codebook = tensors["codebook"].astype(np.float64)
    values = np.zeros((len(wi), 3))
    above = (np.asarray(wi)[:, 2] > 0) & (np.asarray(wo)[:, 2] > 0)
    symmetry, interpolation = config.get("symmetry", "none"), config.get("interpolation", "bilinear")
    local = to_local_frame(np.asarray(wi)[above], np.asarray(wo)[above], config["frame"], symmetry)
    psi = []
    for side, direction in enumerate(local):
        corner, weight = corner_weights(nside, direction, interpolation)
        primitives = codebook[indices[side * (len(indices) // 2) + corner]]
        psi.append((primitives * np.asarray(weight, np.float64)[..., None]).sum(1))
    if config.get("texture"):
        mips = [tensors[f"texture.mip{m}"] for m in range(config["texture"]["mips"])]
        psi.append(sample_texture(mips, np.asarray(uv)[above], np.broadcast_to(lod, len(wi))[above]))
    x = np.concatenate(psi, 1)
    layers = len(config["hidden"])
    for layer in range(layers + 1):
        x = x @ tensors[f"weight{layer}"].astype(np.float64).T + tensors[f"bias{layer}"].astype(np.float64)
        if layer < layers:
            x = np.maximum(x, 0.0)
    values[above] = np.maximum(np.expm1(np.minimum(x, 11.0)), 0.0)
    return values
