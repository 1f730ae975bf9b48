"""Metrics of colour differences: what a grey and a change of hue count."""

import numpy as np
import pytest

from tests.fake_assets import CHANNELS
from warp_neumat.kernels.colour_metric import METRICS, colour_metric, plane_metrics


def test_luma_counts_grey_as_rgb_does_and_hue_more():
    luma, rgb = (colour_metric(name, 3, True)[:3, :3] for name in ("luma", "rgb"))
    np.testing.assert_array_equal(rgb, np.eye(3))
    np.testing.assert_allclose(luma, luma.T)
    grey, hue = np.ones(3), np.array([0.114, 0.0, -0.299])  # no luminance
    assert grey @ luma @ grey == pytest.approx(grey @ rgb @ grey, rel=1e-6)
    assert hue @ luma @ hue > 1.4 * (hue @ rgb @ hue)
    assert np.linalg.eigvalsh(luma).min() > 0.5  # no difference is free


def test_only_colours_have_a_metric_of_their_own():
    planes = [(3, (0, 1, 2)), (3, (2, 1, 0)), (3, (5, 6)), (1, (5,)), (4, (0, 1, 2, 5))]
    found = plane_metrics("luma", planes, CHANNELS)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found[0], colour_metric("luma", 3, True))
    for row, (components, _) in zip(found[1:4], planes[1:4], strict=True):
        np.testing.assert_array_equal(row, np.diag(np.arange(4) < components).astype(np.float32))
    np.testing.assert_array_equal(found[4, :3, :3], found[0, :3, :3])
    assert found[4, 3].tolist() == [0, 0, 0, 1]
    np.testing.assert_array_equal(plane_metrics("rgb", planes[:1], CHANNELS)[0], colour_metric("rgb", 3, True))
    assert set(METRICS) == {"rgb", "luma"}
    with pytest.raises(ValueError, match="metric must be one of rgb, luma, got 'lab'"):
        colour_metric("lab", 3, True)
