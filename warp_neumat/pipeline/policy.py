"""When a tile is shaded anew: the policies, and the budgets they keep.

A policy is asked twice a frame. :meth:`Policy.begins_epoch` says whether the frame takes pose, viewer and lights as
they are now, and forgets all that was shaded before; :meth:`Policy.choose` says which of the tiles that the last
picture read are due. What is read and was never shaded is shaded in any case, by every policy.

- ``every`` shades all that is seen, every frame.
- ``fixed`` shades every N + 1 frames and holds the pose in between: the paper's, [mobilevr], Sec. 4.2.
- ``staggered`` does the same work spread evenly: the oldest tiles first, as many as the budget allows.
- ``adaptive`` takes the tiles first whose refresh removes most visible error for its cost,

      value = pixels · change^(3/4) / evaluations,

  with the change that is predicted since they were shaded (``schedule.py``), in √Y; the exponent is about FLIP's for a
  colour difference, 0.7 (Andersson et al. 2020, Sec. 4.1.2). It takes as many as the budget allows, or as must be for a
  mean FLIP (``target.py``). A tile younger than ``age_min`` waits; one far older than ``age_max`` comes first.
"""

import abc
import dataclasses
import numbers
import operator

import numpy as np

from warp_neumat.pipeline.target import TargetFlip

POLICIES = ("every", "fixed", "staggered", "adaptive")

FLIP_OF_ROOT = 0.95 / 0.4 * (100.0 / 308.0) ** 0.7
"""FLIP of a change of 1 in √Y, ^0.7: a √Y of 1 is about L* = 100, and HyAB from green to blue, FLIP's largest, 308."""


@dataclasses.dataclass
class Tiles:
    """The tiles that the last picture read, and what is known of them; arrays of shape (n,).

    Attributes:
        index: Number of the tile.
        pixels: Pixels that read it.
        cost: Evaluations that shading it takes.
        age: Frames since it was shaded in which something moved.
        change: Predicted visible change since, in √Y; None where the policy does not ask for it.
        new: Evaluations that texels which come into view are expected to take in this frame.
        whole: Evaluations that all that is seen would take, were no tile shaded coarsely for being smooth.
        picture: Pixels of the picture.
        moved: Whether anything has moved since the last frame.
        tie: Number in [0, 1) of each, which decides between equals.
    """

    index: np.ndarray
    pixels: np.ndarray
    cost: np.ndarray
    age: np.ndarray
    change: np.ndarray | None
    new: float
    whole: float
    picture: int
    moved: bool
    tie: np.ndarray


class Policy(abc.ABC):
    """When tiles are shaded anew."""

    name: str
    predicts = False
    """Whether it wants :attr:`Tiles.change`."""
    holds_pose = False
    """Whether pose, viewer and lights stay as they are between epochs."""
    keeps = False
    """Whether what was shaded before an epoch stays until it is due."""

    def begins_epoch(self, since: int) -> bool:
        """Return whether the frame ``since`` frames after the last epoch began, 0 for the first, begins one."""
        return since == 0

    @abc.abstractmethod
    def choose(self, tiles: Tiles) -> np.ndarray:
        """Return which tiles are due, shape (n,) bool."""

    def learn(self, milliseconds: float, evaluations: int) -> None:  # noqa: B027  (most have nothing to learn)
        """Take note of what a frame's shading cost."""

    def reset(self) -> None:  # noqa: B027
        """Begin anew, as before the first frame."""


class Every(Policy):
    """All that is seen, every frame."""

    name = "every"

    def begins_epoch(self, since: int) -> bool:
        return True

    def choose(self, tiles: Tiles) -> np.ndarray:
        return np.zeros(len(tiles.index), bool)  # the epoch forgot them all


class Fixed(Policy):
    """All that is seen, every ``interval`` + 1 frames, as of the frame that began the epoch."""

    name, holds_pose = "fixed", True

    def __init__(self, interval: int):
        self.interval = interval

    def begins_epoch(self, since: int) -> bool:
        return since % (self.interval + 1) == 0

    def choose(self, tiles: Tiles) -> np.ndarray:
        return np.zeros(len(tiles.index), bool)


class Budget:
    """Evaluations that a frame may spend: so many, so many milliseconds' worth, or a share of what is seen.

    Args:
        evaluations: Number a frame, or None.
        milliseconds: Of the shading stage, or None; turned into evaluations by what the frames so far have cost.
        share: Of the evaluations that all that is seen would take (:attr:`Tiles.whole`), where neither is given.
    """

    def __init__(self, evaluations: float | None = None, milliseconds: float | None = None, share: float = 1.0):
        self.evaluations, self.milliseconds, self.share = evaluations, milliseconds, share
        self._rate: float | None = None  # evaluations a millisecond
        self._saved = 0.0

    def learn(self, milliseconds: float, evaluations: int) -> None:
        """Take note of what a frame's shading cost."""
        if milliseconds > 0 and evaluations > 0:
            rate = evaluations / milliseconds
            self._rate = rate if self._rate is None else 0.8 * self._rate + 0.2 * rate

    def choose(self, value: np.ndarray, tiles: Tiles) -> np.ndarray:
        """Return the tiles of largest ``value`` that can be paid; what is left over is kept for the next frame.

        It is kept up to the price of one tile, so that the dearest has its turn even under the smallest budget.
        """
        left = self.left(tiles)
        chosen = affordable(value, tiles.cost, left) & (value > 0)
        rest = left - float(tiles.cost[chosen].sum())
        self._saved = min(rest, float(tiles.cost.max(initial=0.0)))
        return chosen

    def reset(self) -> None:
        """Begin anew, with nothing kept."""
        self._saved, self._rate = 0.0, None

    def left(self, tiles: Tiles) -> float:
        """Return the evaluations that remain for refreshing ``tiles`` once the new texels are paid."""
        if self.evaluations is not None:
            whole = self.evaluations
        elif self.milliseconds is not None:
            whole = self.milliseconds * self._rate if self._rate else 0.0
        else:
            whole = self.share * tiles.whole
        return max(0.0, whole + self._saved - tiles.new)


class Staggered(Policy):
    """The oldest tiles first, as many as the budget allows."""

    name, keeps = "staggered", True

    def __init__(self, budget: Budget):
        self.budget = budget

    def choose(self, tiles: Tiles) -> np.ndarray:
        return self.budget.choose(np.where(tiles.age > 0, tiles.age + tiles.tie, 0.0), tiles)

    def learn(self, milliseconds: float, evaluations: int) -> None:
        self.budget.learn(milliseconds, evaluations)

    def reset(self) -> None:
        self.budget.reset()


class Adaptive(Policy):
    """The tiles first whose refresh removes most visible error for its cost.

    Args:
        budget: What a frame may spend; None with a target.
        target: The mean FLIP to hold; None with a budget.
        age_min, age_max: Frames (in which something moves) that a tile waits at least, and at most, on the average:
            each has its own limit between half of the latter and one and a half.
    """

    name, predicts, keeps = "adaptive", True, True

    def __init__(self, budget: Budget | None, target: TargetFlip | None = None, *, age_min: int = 1, age_max: int = 48):
        self.budget, self.target = budget, target
        self.age_min, self.age_max = age_min, age_max

    def choose(self, tiles: Tiles) -> np.ndarray:
        error = flip_of(tiles.change, tiles.pixels)
        value = error / np.maximum(tiles.cost, 1.0)
        value[(tiles.age < self.age_min) | (tiles.change <= 0)] = 0.0
        if not tiles.moved:  # time to mend what nobody predicted
            value = np.maximum(value, np.float32(1e-9) * tiles.age)
        late = tiles.age >= self.age_max * (0.5 + tiles.tie)  # not all that began together at once
        value[late] += _LATE
        if self.target is None:
            return self.budget.choose(value, tiles)
        if not tiles.moved:
            return affordable(value, tiles.cost, _AT_REST * tiles.whole) & (value > 0)
        excess = float(error.sum()) / tiles.picture - self.target.allowance()
        return late | (needed(value, error / tiles.picture, excess) & (value > 0))

    def learn(self, milliseconds: float, evaluations: int) -> None:
        if self.budget is not None:
            self.budget.learn(milliseconds, evaluations)

    def reset(self) -> None:
        (self.target or self.budget).reset()


_LATE = 1e6  # value of a tile that may not wait
_AT_REST = 0.25  # share of what is seen that is mended a frame, where a target is held and nothing moves


def flip_of(change: np.ndarray, pixels) -> np.ndarray:
    """Return what changes in √Y, at least 0, add to the FLIP of so many pixels, in pixels.

    The exponent is 3/4, not 0.7: two roots cost a tenth of a power.
    """
    root = np.sqrt(change)
    return FLIP_OF_ROOT * pixels * (root * np.sqrt(root))


_BINS = 512


def affordable(value: np.ndarray, cost: np.ndarray, budget: float) -> np.ndarray:
    """Return those of largest ``value`` that together cost at most ``budget``, shape (n,) bool.

    Taken in order of value until the next would break the budget; equal values in order of place.
    """
    return _first(value, cost, budget, inside=True)


def needed(value: np.ndarray, gain: np.ndarray, aim: float) -> np.ndarray:
    """Return those of largest ``value`` whose ``gain`` together reaches ``aim``, shape (n,) bool."""
    return _first(value, gain, aim, inside=False)


def _first(value, weight, limit: float, *, inside: bool) -> np.ndarray:
    # Binned by rank-preserving quantisation of the logarithm's bits, so that one pass finds the bin that the limit
    # falls in and only that bin is sorted: a whole sort would cost several times as much.
    n = len(value)
    if n == 0 or (limit <= 0 and not inside):
        return np.zeros(n, bool)
    bits = np.maximum(value, 0.0).astype(np.float32).view(np.int32)
    low, high = int(bits.min()), int(bits.max())
    shift = max(0, (high - low).bit_length() - _BINS.bit_length() + 1)
    bins = (bits - low) >> shift
    totals = np.bincount(bins, weights=weight)
    above = np.cumsum(totals[::-1])[::-1]  # weight of a bin and all above it
    over = np.flatnonzero(above > limit if inside else above >= limit)
    if not len(over):
        return np.ones(n, bool)
    cut = over[-1]
    chosen = bins > cut
    rest = np.flatnonzero(bins == cut)
    rest = rest[np.argsort(-bits[rest], kind="stable")]
    sums = np.cumsum(weight[rest]) + (above[cut] - totals[cut])
    count = np.searchsorted(sums, limit, side="right") if inside else np.searchsorted(sums, limit) + 1
    chosen[rest[:count]] = True
    return chosen


def make_policy(name: str, interval: int, *, budget=None, milliseconds=None, target_flip=None) -> Policy:
    """Return the policy of that name.

    Args:
        name: One of :data:`POLICIES`.
        interval: Frames that reuse the shading of the one before them; for ``staggered`` and ``adaptive`` the measure
            of their default budgets: what ``fixed`` spends on the average, and a third of it.
        budget: Evaluations a frame.
        milliseconds: Of shading, a frame.
        target_flip: Mean FLIP that ``adaptive`` aims for.

    Raises: ValueError: If the name is unknown, the interval no whole number of at least 0, or a limit is given that
        the policy does not keep.
    """
    try:
        interval = operator.index(interval)
    except TypeError:
        raise ValueError(f"interval must be a whole number of frames, 0 or more, got {interval!r}") from None
    if interval < 0:
        raise ValueError(f"interval must be a whole number of frames, 0 or more, got {interval!r}")
    if name not in POLICIES:
        raise ValueError(f"policy must be one of {', '.join(POLICIES)}, got {name!r}")
    limits = {"budget": budget, "milliseconds": milliseconds, "target_flip": target_flip}
    given = [key for key, value in limits.items() if value is not None]
    if len(given) > 1:
        raise ValueError(f"{given[0]} and {given[1]} exclude each other; give one")
    if target_flip is not None and name != "adaptive":
        raise ValueError(f"{name} aims for no target_flip; use the policy adaptive")
    if given and name in ("every", "fixed"):
        raise ValueError(f"{name} keeps no {given[0]}; use the policy staggered or adaptive")
    for key in given:
        if not isinstance(limits[key], numbers.Real) or not 0 < limits[key] < float("inf"):
            raise ValueError(f"{key} must be a positive number, got {limits[key]!r}")
    if target_flip is not None and target_flip >= 1:
        raise ValueError(f"target_flip must be below 1, which FLIP never exceeds, got {target_flip!r}")
    if name == "every":
        return Every()
    if name == "fixed":
        return Fixed(interval)
    if name == "staggered":
        return Staggered(Budget(budget, milliseconds, 1.0 / (interval + 1)))
    if target_flip is not None:
        return Adaptive(None, TargetFlip(target_flip))
    return Adaptive(Budget(budget, milliseconds, 1.0 / (3 * (interval + 1))))
