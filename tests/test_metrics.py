"""Metrics against closed forms, and their complaints."""

import math
import sys

import numpy as np
import pytest

from warp_neumat import metrics


def flat(colour, size=(48, 64)):
    return np.broadcast_to(np.float32(colour), (*size, 3)).copy()


@pytest.fixture
def picture(rng):
    return rng.random((48, 64, 3), dtype=np.float32)


def test_psnr_of_a_known_offset():
    assert metrics.psnr(flat(0.5), flat(0.6)) == pytest.approx(20.0, abs=1e-5)
    assert metrics.rmse(flat(0.25), flat(0.75)) == pytest.approx(0.5, rel=1e-6)
    assert metrics.mae(flat([0.0, 0.5, 1.0]), flat([0.25, 0.5, 0.5])) == pytest.approx(0.25, rel=1e-6)


def test_rmse_weighs_large_errors_more_than_mae():
    test = flat(0.0)
    test[:24] = 1.0
    assert metrics.mae(flat(0.0), test) == pytest.approx(0.5)
    assert metrics.rmse(flat(0.0), test) == pytest.approx(math.sqrt(0.5))
    assert metrics.psnr(flat(0.0), test) == pytest.approx(10 * math.log10(2))


def test_equal_pictures_are_perfect(picture):
    assert metrics.psnr(picture, picture.copy()) == math.inf
    assert metrics.mae(picture, picture) == 0
    assert metrics.ssim(picture, picture) == pytest.approx(1.0, abs=1e-6)
    mean, errors = metrics.flip(picture, picture)
    assert mean == 0
    assert not errors.any()


def test_ssim_of_flat_pictures_is_the_luminance_term():
    a, b = 0.4, 0.7
    expected = (2 * a * b + 0.01**2) / (a**2 + b**2 + 0.01**2)  # variances are 0, so the second factor is 1
    assert metrics.ssim(flat(a), flat(b)) == pytest.approx(expected, rel=1e-4)


def test_ssim_sees_noise_that_leaves_the_mean(picture, rng):
    mild, strong = (np.clip(picture + rng.normal(0, s, picture.shape), 0, 1) for s in (0.02, 0.2))
    assert 1 > metrics.ssim(picture, mild) > metrics.ssim(picture, strong) > 0


def flip_of_flat(a, b):
    """FLIP of two flat pictures in closed form: no edges, no points, so only the colour pipeline is left."""
    # sRGB primaries, white D65.
    linear_to_xyz = np.array(
        [
            [0.41238656, 0.35759149, 0.18045049],
            [0.21263682, 0.71518298, 0.0721802],
            [0.01933062, 0.11919716, 0.95037259],
        ]
    )
    white = linear_to_xyz @ np.ones(3)

    def hunt_lab(colour):
        c = np.asarray(colour, dtype=np.float64)
        c = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
        t = linear_to_xyz @ c / white
        d = 6 / 29
        t = np.where(t > d**3, np.cbrt(t), t / (3 * d * d) + 4 / 29)
        lightness = 116 * t[1] - 16
        return np.array([lightness, *(0.01 * lightness * np.array([500 * (t[0] - t[1]), 200 * (t[1] - t[2])]))])

    def hyab(p, q):
        return (abs(p[0] - q[0]) + np.hypot(*(p - q)[1:])) ** 0.7

    largest = hyab(hunt_lab([0, 1, 0]), hunt_lab([0, 0, 1]))
    distance, knee = hyab(hunt_lab(a), hunt_lab(b)), 0.4 * largest
    return distance * 0.95 / knee if distance < knee else 0.95 + 0.05 * (distance - knee) / (largest - knee)


@pytest.mark.parametrize(
    ("a", "b"),
    [([0, 1, 0], [0, 0, 1]), ([0, 0, 0], [1, 1, 1]), ([0.2] * 3, [0.25] * 3), ([0.8, 0.3, 0.1], [0.7, 0.35, 0.1])],
)
def test_flip_of_flat_pictures_matches_the_colour_pipeline_in_closed_form(a, b):
    mean, errors = metrics.flip(flat(a), flat(b))
    # Grey against grey tells sRGB from linear input: read as linear, 0.2 and 0.25 are 0.183 apart and not 0.195.
    assert mean == pytest.approx(flip_of_flat(a, b), rel=2e-3)
    assert errors.shape == (48, 64)
    assert errors.dtype == np.float32
    assert errors.mean() == pytest.approx(mean, rel=1e-6)


def test_flip_map_is_where_the_error_is(picture):
    test = picture.copy()
    test[10:14, 30:34] = 1 - test[10:14, 30:34]
    _, errors = metrics.flip(picture, test)
    assert errors[10:14, 30:34].mean() > 10 * errors[30:, :].mean()
    assert errors[40:, :20].max() < 1e-4


def test_flip_fades_with_distance_to_the_screen():
    checkers = flat(0.5)
    checkers[::2, ::2] = checkers[1::2, 1::2] = 0.6
    checkers[::2, 1::2] = checkers[1::2, ::2] = 0.4
    near, _ = metrics.flip(flat(0.5), checkers, pixels_per_degree=20)
    far, _ = metrics.flip(flat(0.5), checkers, pixels_per_degree=200)
    assert far < 0.3 * near


@pytest.mark.parametrize("pixels_per_degree", [None, 30, 120])
def test_flip_of_the_differing_window_is_flip_of_the_whole(rng, pixels_per_degree):
    import flip_evaluator

    reference = rng.random((150, 200, 3), dtype=np.float32)
    test = reference.copy()
    test[70:78, 90:101] = rng.random((8, 11, 3), dtype=np.float32)
    parameters = {"ppd": pixels_per_degree} if pixels_per_degree else {}
    whole, _, _ = flip_evaluator.evaluate(reference, test, "LDR", applyMagma=False, parameters=parameters)
    _, errors = metrics.flip(reference, test, pixels_per_degree=pixels_per_degree)
    np.testing.assert_allclose(errors, whole[..., 0], atol=2e-6)
    assert (errors > 0).sum() > 88


@pytest.mark.parametrize("metric", [metrics.mae, metrics.rmse, metrics.psnr, metrics.ssim, metrics.flip])
def test_bad_pictures_are_named(metric):
    with pytest.raises(ValueError, match=r"test must have the reference's shape \(48, 64, 3\), got \(48, 63, 3\)"):
        metric(flat(0), flat(0, (48, 63)))
    with pytest.raises(ValueError, match=r"reference must have shape \(H, W, 3\), got \(48, 64\)"):
        metric(flat(0)[..., 0], flat(0))
    with pytest.raises(TypeError, match="test must be floating point with values in .* divide by 255"):
        metric(flat(0), np.zeros((48, 64, 3), np.uint8))


def test_flip_and_ssim_refuse_what_they_cannot_judge():
    with pytest.raises(ValueError, match=r"test must hold values in \[0, 1\], got 0 to 2; tonemap"):
        metrics.flip(flat(0), flat([0, 1, 2]))
    with pytest.raises(ValueError, match="reference must hold values in"):
        metrics.flip(flat([0, 0, math.nan]), flat(0))
    with pytest.raises(ValueError, match="pixels_per_degree must be above 0"):
        metrics.flip(flat(0), flat(0), pixels_per_degree=-1)
    with pytest.raises(ValueError, match="at least 11x11 pixels, got 64x5"):
        metrics.ssim(flat(0, (5, 64)), flat(0, (5, 64)))


@pytest.mark.parametrize(
    ("metric", "module", "package"),
    [(metrics.ssim, "skimage", "scikit-image"), (metrics.flip, "flip_evaluator", "flip-evaluator")],
)
def test_a_missing_library_names_the_extra(monkeypatch, metric, module, package):
    for name in [name for name in sys.modules if name.split(".")[0] == module]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, module, None)  # importing it now fails
    with pytest.raises(ImportError, match=rf"{package} is not installed; pip install 'warp-neumat\[report\]'"):
        metric(flat(0), flat(1))


def test_channel_mse_by_hand_and_psnr_of_its_mean():
    reference = np.zeros((70, 3, 2), np.float32)  # more rows than are taken at a time
    test = reference.copy()
    test[..., 1] = 0.1
    test[69, 2, 0] = 0.5
    mse = metrics.channel_mse(reference, test)
    assert mse.dtype == np.float64
    np.testing.assert_allclose(mse, [0.25 / 210, 0.01], rtol=1e-6)
    assert metrics.psnr_of_mse(mse) == pytest.approx(-10 * math.log10((0.25 / 210 + 0.01) / 2))
    assert metrics.psnr_of_mse([0.0, 0.0]) is None


def test_map_metrics_are_the_picture_metrics_of_what_is_seen(picture, rng):
    test = np.clip(picture + rng.normal(0, 0.1, picture.shape), 0, 1).astype(np.float32)
    assert metrics.map_ssim(picture, test) == pytest.approx(metrics.ssim(picture, test))
    assert metrics.map_flip(picture, test) == metrics.flip(picture, test)[0]
    grey = [np.repeat(values[..., :1], 3, axis=2) for values in (picture, test)]
    assert metrics.map_ssim(picture[..., :1], test[..., :1]) == pytest.approx(metrics.ssim(*grey), abs=1e-6)
    assert metrics.map_flip(picture[..., :1], test[..., :1]) == pytest.approx(metrics.flip(*grey)[0])


def test_small_maps_have_no_ssim_and_a_flip():
    small = np.full((10, 64, 1), 0.5, np.float32)
    assert metrics.map_ssim(small, small) is None
    assert metrics.map_ssim(np.full((11, 11, 1), 0.5, np.float32), np.full((11, 11, 1), 0.5, np.float32)) == 1
    one = np.full((1, 1, 1), 0.5, np.float32)
    assert metrics.map_flip(one, one) == 0
    assert 0 < metrics.map_flip(one, one + 0.1) < 1


def test_colour_picture_of_any_number_of_channels():
    values = np.float32([[[0.1, 0.2, 0.3, 0.4]]])
    for count, expected in ((1, [0.1, 0.1, 0.1]), (2, [0.1, 0.2, 0]), (3, [0.1, 0.2, 0.3]), (4, [0.1, 0.2, 0.3])):
        np.testing.assert_array_equal(metrics.colour_picture(values[..., :count])[0, 0], np.float32(expected))
    np.testing.assert_array_equal(metrics.colour_picture(np.float32([[[-1, 0.5, 2]]]))[0, 0], [0, 0.5, 1])


def test_angular_error_keeps_small_angles():
    angles = np.radians([0.0, 0.001, 90.0, 180.0])
    up = np.broadcast_to(np.float32([0, 0, 1]), (4, 3))
    tilted = np.stack([np.sin(angles), np.zeros(4), np.cos(angles)], axis=1).astype(np.float32)
    mean, high = metrics.angular_error(up[:2], tilted[:2])
    assert mean == pytest.approx(0.0005, rel=1e-4)
    assert high == pytest.approx(0.00095, rel=1e-4)
    assert metrics.angular_error(up, tilted)[0] == pytest.approx((0.001 + 90 + 180) / 4)
    with pytest.raises(ValueError, match=r"the same shape \(..., 3\), got \(4, 3\) and \(2, 3\)"):
        metrics.angular_error(up, tilted[:2])


@pytest.mark.parametrize("metric", [metrics.channel_mse, metrics.map_ssim])
def test_bad_maps_are_named(metric):
    good = np.zeros((12, 12, 2), np.float32)
    with pytest.raises(ValueError, match=r"test must have the reference's shape \(12, 12, 2\), got \(12, 12, 1\)"):
        metric(good, good[..., :1])
    with pytest.raises(ValueError, match="test must be finite, and holds NaN or infinite values"):
        metric(good, np.full_like(good, math.nan))
    with pytest.raises(TypeError, match="reference must be floating point"):
        metric(good.astype(np.uint8), good)
