"""Grid features without a codebook: plain half floats, or four bits each in the range of their channel.

The alternatives of [neubrdf] Table 4. ``raw`` keeps every feature as fp16. ``4bit`` rounds it to one of 16 levels
between the least and the largest value of its channel; in training the forward pass sees the rounded values and the
gradient passes straight through (Bengio et al. 2013). Ranges are stored as fp16 and rounded outwards, so that what is
trained is what is stored.
"""

from __future__ import annotations

import torch

LEVELS = 16


def feature_bytes(points: int, features: int, storage: str, bits: int = 9) -> int:
    """Return the bytes of two grids of ``points`` × ``features``: without the decoder, with codebook or ranges.

    ``storage``: ``"raw"`` 2 bytes a feature; ``"4bit"`` half a byte, and two fp16 a channel and grid; ``"vq"`` ``bits``
    bits a point and a codebook of 2^bits fp16 rows.
    """
    values = 2 * points * features
    if storage == "raw":
        return 2 * values
    if storage == "4bit":
        return -(-values // 2) + 2 * 2 * 2 * features
    if storage == "vq":
        return -(-2 * points * bits // 8) + 2 * 2**bits * features
    raise ValueError(f"storage must be raw, 4bit or vq, got {storage!r}")


def ranges(features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return (low, high), (k,) each, of features (n, k): fp16 numbers that enclose every channel, as float32."""
    low, high = (x.detach().float() for x in (features.amin(0), features.amax(0)))
    down, up = low.half().float(), high.half().float()
    # fp16 rounds to nearest: step outwards where that went inwards.
    lowest, highest = torch.tensor(-torch.inf).half(), torch.tensor(torch.inf).half()
    down = torch.where(down > low, torch.nextafter(down.half(), lowest).float(), down)
    up = torch.where(up < high, torch.nextafter(up.half(), highest).float(), up)
    return down, up


def quantise4(features: torch.Tensor, low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
    """Return the nearest level 0 … 15 of each feature (n, k) between ``low`` and ``high`` (k,), uint8."""
    scale = (LEVELS - 1) / (high - low).clamp_min(1e-12)
    return ((features - low) * scale).round().clamp(0, LEVELS - 1).to(torch.uint8)


def dequantise4(codes: torch.Tensor, low: torch.Tensor, high: torch.Tensor) -> torch.Tensor:
    """Return the features that levels ``codes`` (n, k) stand for, float32; inverse of :func:`quantise4`."""
    return low + codes.float() * ((high - low) / (LEVELS - 1))


def rounded4(features: torch.Tensor, low=None, high=None) -> torch.Tensor:
    """Return features (n, k) as 4 bits hold them; the gradient passes unchanged.

    Without ``low`` and ``high`` the ranges are those of ``features`` now.
    """
    if low is None:
        low, high = ranges(features)
    return features + (dequantise4(quantise4(features, low, high), low, high) - features).detach()


def pack4(codes: torch.Tensor) -> torch.Tensor:
    """Return levels 0 … 15 of any shape as bytes, two in each, the first in the low half; an odd end is padded by 0."""
    flat = codes.flatten().to(torch.uint8)
    if len(flat) % 2:
        flat = torch.cat([flat, flat.new_zeros(1)])
    return flat[0::2] | (flat[1::2] << 4)


def unpack4(stream: torch.Tensor, shape: tuple[int, ...]) -> torch.Tensor:
    """Return the levels that :func:`pack4` stored, in their ``shape``, uint8."""
    count = 1
    for extent in shape:
        count *= extent
    if stream.numel() != -(-count // 2):
        raise ValueError(f"stream must have {-(-count // 2)} bytes for shape {tuple(shape)}, got {stream.numel()}")
    return torch.stack([stream & 15, stream >> 4], 1).flatten()[:count].reshape(shape)
