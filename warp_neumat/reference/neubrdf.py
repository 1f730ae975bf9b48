"""NumPy float64 evaluation of a NeuBRDF asset: the plain form that the torch module and the Warp kernel must match.

Paper [neubrdf], Sec. 3.1–3.3 (Eq. 1–3). Differs: bilinear instead of inverse-distance (training) and 1/4 (runtime)
weights; ω_o has an index grid of its own with northern numbering instead of the mirrored southern hemisphere; the
decoder predicts log(1 + f). Frames: ω_i to the light, ω_o to the viewer, z = shading normal.
"""

from __future__ import annotations

import numpy as np

from warp_neumat.reference import healpix


def to_local_frame(wi: np.ndarray, wo: np.ndarray, frame: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions as the grids see them.

    ``"absolute"`` returns them unchanged. ``"isotropic"`` turns both about z until ω_o has azimuth 0, then mirrors ω_i
    to y ≥ 0; where ω_o is the pole (x² + y² < 1e-12) nothing is turned.
    """
    wi, wo = np.array(wi, np.float64), np.array(wo, np.float64)
    if frame == "absolute":
        return wi, wo
    square = wo[:, 0] ** 2 + wo[:, 1] ** 2
    pole = square < 1e-12
    sine = np.sqrt(np.where(pole, 1.0, square))
    cos, sin = np.where(pole, 1.0, wo[:, 0] / sine), np.where(pole, 0.0, wo[:, 1] / sine)
    x, y = wi[:, 0] * cos + wi[:, 1] * sin, wi[:, 1] * cos - wi[:, 0] * sin
    wi[:, 0], wi[:, 1] = x, np.abs(y)
    wo[:, 0], wo[:, 1] = np.where(pole, wo[:, 0], sine), np.where(pole, wo[:, 1], 0.0)
    return wi, wo


def unpack(data: np.ndarray, bits: int, count: int) -> np.ndarray:
    """Return ``count`` integers of ``bits`` bits each from a little-endian bit stream (uint8)."""
    stream = np.unpackbits(np.asarray(data, np.uint8), bitorder="little", count=count * bits).reshape(count, bits)
    return stream.astype(np.int64) @ (1 << np.arange(bits, dtype=np.int64))


def reference_eval(tensors: dict[str, np.ndarray], config: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """Return the BRDF in 1/sr (without the cosine), (N, 3) float64, from the stored fp16 tensors.

    Args:
        tensors: ``codebook``, ``indices``, ``weight0`` … ``bias2`` as stored in the asset.
        config: The asset's ``config``.
        wi, wo: Unit directions, (N, 3); values below the horizon are 0.
    """
    nside, bits = config["nside"], config["bits"]
    points = 6 * nside * nside + 6 * nside + 1
    indices = unpack(tensors["indices"], bits, 2 * points)
    codebook = tensors["codebook"].astype(np.float64)
    values = np.zeros((len(wi), 3))
    above = (np.asarray(wi)[:, 2] > 0) & (np.asarray(wo)[:, 2] > 0)
    local = to_local_frame(np.asarray(wi)[above], np.asarray(wo)[above], config["frame"])
    psi = []
    for side, direction in enumerate(local):
        corner, weight = healpix.corners(nside, direction)
        primitives = codebook[indices[side * points + corner]]
        psi.append((primitives * np.asarray(weight, np.float64)[..., None]).sum(1))
    x = np.concatenate(psi, 1)
    layers = len(config["hidden"])
    for layer in range(layers + 1):
        x = x @ tensors[f"weight{layer}"].astype(np.float64).T + tensors[f"bias{layer}"].astype(np.float64)
        if layer < layers:
            x = np.maximum(x, 0.0)
    values[above] = np.maximum(np.expm1(x), 0.0)
    return values
