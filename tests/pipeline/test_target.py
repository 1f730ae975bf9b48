"""Holding a mean FLIP against a simulated scene."""

import numpy as np
import pytest

from warp_neumat.pipeline.target import FLOOR, TargetFlip


@pytest.mark.parametrize("truth", [0.6, 1.8, 4.0])
@pytest.mark.parametrize("target", [0.005, 0.02])
def test_the_mean_ends_at_the_target_whatever_the_prediction_is_worth(truth, target):
    """The scene's error is ``truth`` times the prediction; frames keep what they are allowed, windows are noisy."""
    rng = np.random.default_rng(5)
    control, flips, coverage = TargetFlip(target), [], 0.15
    kept = 0.0
    for frame in range(96):
        kept = min(control.allowance(), kept + 0.002)  # error takes time to grow
        flips.append(truth * (kept + FLOOR * coverage))
        control.note(kept, coverage)
        if frame % 2:
            window = np.exp(0.4 * rng.normal()) * kept / coverage  # of a window that the mesh fills
            control.probe(truth * (window + FLOOR) * np.exp(0.3 * rng.normal()), window, 1.0)
    assert np.mean(flips) == pytest.approx(target, rel=0.15)
    assert control.mean == pytest.approx(np.mean(flips), rel=0.25)


def test_it_begins_anew():
    control = TargetFlip(0.01)
    first = control.allowance()
    for _ in range(5):
        control.note(0.02, 0.5)
        control.probe(0.1, 0.02, 1.0)
    assert control.allowance() < first
    control.reset()
    assert control.allowance() == first


def test_a_target_below_the_floor_allows_nothing():
    control = TargetFlip(1e-4)
    control.note(0.0, 1.0)
    assert control.allowance() == 0.0
