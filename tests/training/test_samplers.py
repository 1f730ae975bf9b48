"""Training samples: unit, above the horizon, and where they are said to be."""

import numpy as np
import pytest

from warp_neumat.io.brdf import open_brdf, rusinkiewicz
from warp_neumat.training.samplers import MIXTURE, BRDFSampler, measured_directions


@pytest.mark.parametrize("draw", ["training", "measured"])
def test_directions_are_unit_and_above_the_horizon(rng, draw):
    if draw == "training":
        wi, wo = BRDFSampler(open_brdf("analytic:lambert"), rng).directions(20_000)
        assert len(wi) == 20_000
    else:
        wi, wo = measured_directions(20_000, rng)
        assert len(wi) > 8_000
    for d in (wi, wo):
        assert d.dtype == np.float32
        assert (d[:, 2] > 0).all()
        np.testing.assert_allclose(np.linalg.norm(d, axis=1), 1.0, atol=1e-6)


def test_mixture_sees_the_peak_and_the_horizon(rng):
    wi, wo = BRDFSampler(open_brdf("analytic:lambert"), rng).directions(50_000)
    sine_h = rusinkiewicz(wi, wo)[:, 0]
    # θ_h = (π/2)u² puts a share of sqrt(θ/90°) of the mirrored samples within θ: 7.5 % of them within half a degree.
    assert (sine_h < np.sin(np.radians(0.5))).mean() > 0.05 * MIXTURE["peak"]
    assert (np.minimum(wi[:, 2], wo[:, 2]) < 0.1).mean() > 0.05
    np.testing.assert_allclose(wi.mean(0), wo.mean(0), atol=0.02)  # both grids are treated alike


def test_measured_directions_are_spaced_as_merl(rng):
    wi, wo = measured_directions(100_000, rng)
    theta_h = np.arccos(np.clip(rusinkiewicz(wi, wo)[:, 2].astype(np.float64), -1, 1))
    near = np.sqrt(theta_h[theta_h < np.radians(10)] / np.radians(10))  # few of these fall below the horizon
    assert abs(near.mean() - 0.5) < 0.03  # uniform in the root


def test_values_belong_to_the_directions(rng):
    source = open_brdf("analytic:ggx?roughness=0.4")
    samples = BRDFSampler(source, rng).draw(100)
    np.testing.assert_array_equal(samples["value"], source.eval(samples["wi"], samples["wo"]))
