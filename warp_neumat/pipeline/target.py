"""Holding a mean FLIP: what the schedule predicts, corrected by probes.

The schedule predicts each tile's change since it was shaded. Summed over the pixels with FLIP's exponent that is a
number in units of FLIP, which leaves out much: the eye's filters, the error of the texture itself (:data:`FLOOR`, a
share of the pixels that show the mesh), how well the prediction holds in this scene. Probes (``probe.py``) measure
FLIP in small windows, and prediction is multiplied by the ratio of what they measured to what was predicted for them:
over the last ones for the frame to be made, whose error is like theirs, and over all for the sum so far.

The mean of all frames shall be the target, and the first ones, where all is new, are better than that. So each frame
aims for the target plus its share of what the frames so far have left over.
"""

FLOOR = 0.002
"""FLIP of fresh texture-space shading against per-pixel shading, where a pixel shows the mesh."""

RATIO = 1.8
"""Measured over predicted, before the first probe."""

HORIZON = 6
"""Frames within which what earlier ones left over is used up."""

_MEMORY = 0.85  # weight that a probe keeps in the ratio of late when the next one comes
_TRUST = 0.03  # predicted error that the first ratio counts for: about that of two windows


class _Ratio:
    """Measured over predicted, with a memory."""

    def __init__(self, memory: float):
        self._memory, self._measured, self._predicted = memory, 0.0, 0.0

    def add(self, measured: float, predicted: float) -> None:
        self._measured = self._memory * self._measured + measured
        self._predicted = self._memory * self._predicted + predicted

    @property
    def value(self) -> float:
        return (RATIO * _TRUST + self._measured) / (_TRUST + self._predicted)


class TargetFlip:
    """Says how much predicted error a frame may keep.

    Args:
        target: Mean FLIP over all frames.
    """

    def __init__(self, target: float):
        self.target = target
        self.reset()

    def reset(self) -> None:
        """Begin anew, with no frame and no probe."""
        self._late, self._all = _Ratio(_MEMORY), _Ratio(1.0)
        self._frames, self._sum, self._coverage = 0, 0.0, 0.0

    @property
    def mean(self) -> float:
        """Estimated mean FLIP of the frames so far."""
        return self._all.value * self._sum / max(self._frames, 1)

    def allowance(self) -> float:
        """Return the predicted error that the frame may keep."""
        left = self.target + (self.target - self.mean) * self._frames / HORIZON
        return max(0.0, left / self._late.value - FLOOR * self._coverage)

    def note(self, predicted: float, coverage: float) -> None:
        """Take note of a frame: the predicted error that it kept, and its share of pixels that show the mesh."""
        self._coverage = coverage
        self._frames += 1
        self._sum += predicted + FLOOR * coverage

    def probe(self, flip: float, predicted: float, coverage: float) -> None:
        """Take note of a window: its measured mean FLIP, its predicted error and its coverage."""
        for ratio in (self._late, self._all):
            ratio.add(flip, predicted + FLOOR * coverage)
