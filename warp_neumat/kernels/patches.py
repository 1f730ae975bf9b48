"""What a training step samples, and where: the pyramids in memory, and the patches of a step (BCf §5.1).

Texels of features lie as rows of four float32 (r, g, b, unused), block by block as BC6H stores them: 16 rows a block,
the blocks of a mip row by row, the mips of a texture one after another, the textures likewise. The reference lies mip
after mip, each padded by :data:`PAD` texels on every side as the wrap mode says, so that a bicubic footprint never
leaves it; its channels are padded to a multiple of 8, as float16.

A patch is a jittered 16 × 16 grid of samples over a square of the texture, as in the paper, but small: it spans
:data:`SPACING` texels of its mip per sample, so that its fetches meet each other in the cache. Its scale s is one
number; the patches of a step are stratified in s and, by an additive recurrence, in their place.
"""

import dataclasses
import math

import numpy as np

PATCH = 256
"""Samples of a patch: a jittered grid of 16 × 16."""

SPACING = 2.0
"""Texels of the patch's mip from one sample of its grid to the next."""

PAD = 2
"""Texels that each mip of the reference is padded by."""


def stored_texels(size: tuple[int, int]) -> int:
    """Return the texels of the blocks that hold a mip of ``size`` (width, height)."""
    return 16 * -(-size[0] // 4) * -(-size[1] // 4)


@dataclasses.dataclass(frozen=True)
class Pyramids:
    """Where everything lies: feature textures and the reference, by mip.

    Attributes:
        features: For each texture its (width, height) by mip, finest first.
        reference: (width, height) of the reference by mip.
        repeat: Whether textures repeat; else they clamp.
    """

    features: tuple[tuple[tuple[int, int], ...], ...]
    reference: tuple[tuple[int, int], ...]
    repeat: bool = True

    @property
    def texel_count(self) -> int:
        """Texels of all feature textures, in whole blocks."""
        return sum(stored_texels(size) for mips in self.features for size in mips)

    @property
    def biases(self) -> tuple[float, ...]:
        """The bias b_i of Eq. 11 for each texture."""
        width, height = self.reference[0]
        return tuple(math.log2(max(m[0][1] / height, m[0][0] / width)) for m in self.features)

    @property
    def feature_offsets(self) -> tuple[tuple[int, ...], ...]:
        """First texel of each mip of each texture."""
        at, result = 0, []
        for mips in self.features:
            row = []
            for size in mips:
                row.append(at)
                at += stored_texels(size)
            result.append(tuple(row))
        return tuple(result)

    @property
    def reference_offsets(self) -> tuple[int, ...]:
        """First texel of each padded mip of the reference, and the total."""
        sizes = [(w + 2 * PAD) * (h + 2 * PAD) for w, h in self.reference]
        return tuple(int(n) for n in np.concatenate([[0], np.cumsum(sizes)]))

    def table(self) -> np.ndarray:
        """Return the kernel's int32 table: (offset, width, height) of 16 mips a texture, then of the reference's."""
        rows = np.zeros((16 * (len(self.features) + 1), 3), np.int32)
        for t, (mips, offsets) in enumerate(zip(self.features, self.feature_offsets, strict=True)):
            for m, ((w, h), offset) in enumerate(zip(mips, offsets, strict=True)):
                rows[16 * t + m] = offset, w, h
        for m, ((w, h), offset) in enumerate(zip(self.reference, self.reference_offsets[:-1], strict=True)):
            rows[16 * len(self.features) + m] = offset, w, h
        return rows


def _wrapped(index: np.ndarray, side: int, wrap: str) -> np.ndarray:
    """Return the texels that a sampler reads for ``index``, which may lie outside 0 … side − 1."""
    if wrap == "repeat":
        return index % side
    if wrap == "clamp":
        return index.clip(0, side - 1)
    turned = index % (2 * side)
    return np.minimum(turned, 2 * side - 1 - turned)


def pad_reference(mips, stride: int, wrap: str) -> np.ndarray:
    """Return the reference pyramid as the kernel reads it, flat float16; ``mips`` are (h, w, C) in [0, 1]."""
    parts = []
    for mip in mips:
        h, w, c = mip.shape
        rows, columns = (_wrapped(np.arange(-PAD, side + PAD), side, wrap) for side in (h, w))
        padded = np.zeros((h + 2 * PAD, w + 2 * PAD, stride), np.float16)
        padded[..., :c] = mip[rows][:, columns]
        parts.append(padded.reshape(-1))
    return np.concatenate(parts)


def draw_patches(
    seed: int, step: int, count: int, pyramids: Pyramids, *, decay: float = 0.5, aligned: float = 0.5
) -> np.ndarray:
    """Return the patches of one step, (count, 8) float32.

    Columns: scale s, weight in the loss, origin u and v, extent u and v, and where the samples lie on the texel centres
    of a mip its width and height, else zeros. The share ``aligned`` of the patches does; there the reference is what
    its texels say, while in between it is an interpolation.

    The density of s falls as 2^(−decay·s), because finer mips have more to learn; the weight makes up for it, so that
    every mip counts the same in the loss, as in the paper's metric. Half a unit of magnification below s = 0 falls on
    mip 0 itself, as it does on a screen, and likewise at the coarse end.
    """
    draw = np.random.default_rng([seed, 7, step])
    top = len(pyramids.reference) - 1
    low, high = -0.5, top + 0.5
    q = (np.arange(count) + draw.random(count)) / count
    if decay > 1e-3:
        edge = 2.0 ** (-decay * (high - low))
        raw = low - np.log2(1.0 - q * (1.0 - edge)) / decay
        weight = (1.0 - edge) / ((high - low) * decay * math.log(2.0)) * 2.0 ** (decay * (raw - low))
    else:
        raw, weight = low + q * (high - low), np.ones(count)
    s = raw.clip(0.0, top)
    # Every so many patches in a row of rising s: strata stay strata.
    snapped = (np.arange(count) * aligned + draw.random()) % 1.0 < aligned
    s = np.where(snapped, np.rint(s), s)
    sizes = np.array(pyramids.reference)
    centres = np.where(snapped[:, None], sizes[s.astype(int)], 0)
    extent = (16.0 * SPACING * 2.0 ** s[:, None] / sizes[0]).clip(None, 1.0)
    # Additive recurrence with the plastic number: any run of it covers the square evenly.
    place = (draw.random(2) + np.arange(count)[:, None] * (0.7548776662466927, 0.5698402909980532)) % 1.0
    origin = place if pyramids.repeat else place * (1.0 - extent)
    return np.concatenate([s[:, None], weight[:, None], origin, extent, centres], axis=1).astype(np.float32)
