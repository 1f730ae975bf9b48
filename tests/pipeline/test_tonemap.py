"""Tone mapping: the table against the formulas, exposure in stops, and what is out of range."""

import math

import numpy as np
import pytest

from warp_neumat.pipeline.tonemap import OPERATORS, curve, srgb_decode, srgb_encode, tonemap


@pytest.mark.parametrize("operator", OPERATORS)
def test_tonemap_matches_the_formulas(operator, rng):
    picture = (
        np.concatenate([np.geomspace(1e-9, 1e3, 200000), rng.random(400000)]).astype(np.float32).reshape(-1, 100, 3)
    )
    error = np.abs(tonemap(picture, operator=operator) - curve(picture, operator))
    assert error.max() <= 1e-4  # 8.1e-5 and 6.8e-5 seen


def test_srgb_values_of_the_standard():
    np.testing.assert_allclose(srgb_encode([0, 0.0031308, 0.214041, 1]), [0, 0.04045, 0.5, 1], atol=2e-6)
    x = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(srgb_decode(srgb_encode(x)), x, atol=1e-7)


def test_exposure_is_in_stops(rng):
    picture = rng.random((8, 8, 3), dtype=np.float32)
    np.testing.assert_array_equal(tonemap(picture, exposure=2), tonemap(4 * picture))
    np.testing.assert_array_equal(tonemap(picture, exposure=-1), tonemap(0.5 * picture))


def test_black_is_black_white_is_white_and_nothing_leaves_the_range():
    values = np.float32([0, -0.0, -3, -math.inf, 1, 7, 3e38, math.inf, math.nan, -math.nan])
    np.testing.assert_array_equal(tonemap(values, exposure=1), [0, 0, 0, 0, 1, 1, 1, 1, 1, 1])


@pytest.mark.parametrize("operator", OPERATORS)
def test_brighter_never_gets_darker(operator):
    shown = tonemap(np.geomspace(1e-8, 20, 100001, dtype=np.float32), operator=operator)
    assert (np.diff(shown) >= 0).all()


def test_filmic_is_the_published_curve():
    x = 0.18
    y = x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)
    np.testing.assert_allclose(curve(x, "filmic"), srgb_encode(y))
    assert y == pytest.approx(0.267, abs=1e-3)


def test_any_layout_goes_in_and_out_is_used(rng):
    picture = rng.random((300, 400, 3), dtype=np.float32)
    out = np.empty_like(picture)
    assert tonemap(picture, out=out) is out
    np.testing.assert_array_equal(tonemap(picture[::2, ::-3]), out[::2, ::-3])
    np.testing.assert_array_equal(tonemap(picture.astype(np.float64)), out)
    assert tonemap(picture[:0]).shape == (0, 400, 3)


def test_bad_arguments_are_named():
    picture = np.zeros((2, 2, 3), np.float32)
    with pytest.raises(ValueError, match="operator must be one of srgb, filmic, got 'aces'"):
        tonemap(picture, operator="aces")
    with pytest.raises(ValueError, match="exposure must be between -60 and 60 stops, got nan"):
        tonemap(picture, math.nan)
    with pytest.raises(ValueError, match=r"out must be float32, C-contiguous, of shape \(2, 2, 3\)"):
        tonemap(picture, out=np.zeros((2, 2, 3)))
