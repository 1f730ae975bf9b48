"""The judging picture: known radiance, known errors."""

import numpy as np
import pytest

from warp_neumat.io.brdf import open_brdf
from warp_neumat.training.sphere import render_sphere, sphere_error, sphere_pixels, tone_map

KEY = (((0.0, 0.0, 1.0), (np.pi, np.pi, np.pi)),)


def test_white_sphere_shows_the_cosine():
    image = render_sphere(open_brdf("analytic:lambert?albedo=1").eval, 64, KEY)
    mask, normal = sphere_pixels(64)
    np.testing.assert_allclose(image[mask], np.repeat(normal[:, 2:], 3, 1), atol=1e-5)
    assert (image[~mask] == 0).all()


def test_light_comes_from_where_it_is_said_to():
    image = render_sphere(open_brdf("analytic:lambert").eval, 64, (((0.0, 1.0, 0.0), (1, 1, 1)),))
    assert image[:32].sum() > 0  # from above, and row 0 is on top
    assert image[33:].sum() == 0


def test_tangent_runs_along_x():
    # A highlight stretched across x is wider along x than along y.
    image = render_sphere(open_brdf("analytic:ggx?roughness=0.5&anisotropy=0.9&f0=1").eval, 65, KEY)
    bright = image[..., 0] > 0.3 * image.max()
    assert bright[32].sum() > 1.5 * bright[:, 32].sum()


def test_errors_of_a_known_difference():
    mask, _ = sphere_pixels(64)
    a = np.zeros((64, 64, 3), np.float32)
    b = a.copy()
    b[mask, 0] = 1.0
    error = sphere_error(b, a)
    assert error["mae"] == pytest.approx(1 / 3)
    assert error["rmse"] == pytest.approx(np.sqrt(1 / 3))
    assert sphere_error(a, a)["mae"] == 0
    assert sphere_error(b, b).get("ssim", 1.0) == pytest.approx(1.0)


def test_tone_map_is_srgb():
    np.testing.assert_allclose(
        tone_map(np.array([-1, 0, 0.002, 0.2140411, 1, 7])), [0, 0, 0.02584, 0.5, 1, 1], atol=1e-5
    )
