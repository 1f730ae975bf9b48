"""Pictures of BTFs: every value of a source that states its own indices lands where it should."""

import dataclasses

import numpy as np
import pytest

from warp_neumat.io.btf_directions import ubo2003_directions
from warp_neumat.training.btf_pictures import apparent_brdf, brdf_strip, slice_strip, telling_pairs


@dataclasses.dataclass
class Counted:
    """A source whose values tell light, view, row and column."""

    lights: np.ndarray
    views: np.ndarray
    width: int = 4
    height: int = 3
    asked: int = 0

    def slices(self, pairs):
        self.asked = max(self.asked, len(pairs))
        light, view = np.asarray(pairs).T[:, :, None, None]
        y, x = np.mgrid[: self.height, : self.width]
        channels = 0.04 + 0.01 * light + 0 * y, 0.02 + 0.01 * view + 0 * x, 0.01 * (y * self.width + x) + 0 * light
        return np.stack(np.broadcast_arrays(*channels), -1).astype(np.float32)


@pytest.fixture
def source():
    directions = ubo2003_directions()
    return Counted(directions[:7], directions[:5])


def encode(value):
    """IEC 61966-2-1 of what is shown."""
    v = np.clip(np.pi * np.asarray(value, float), 0, 1)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)


def test_strip_shows_reference_asset_and_difference(source):
    pairs = np.array([[6, 1], [0, 4]])
    strip = slice_strip(source, lambda p: source.slices(p) + np.float32(0.002), pairs)
    assert strip.shape == (9, 8, 3)
    assert strip.dtype == np.float32
    truth = source.slices(pairs)
    reference, asset = encode(truth), encode(truth + 0.002)
    for k in range(2):
        columns = slice(4 * k, 4 * k + 4)
        np.testing.assert_allclose(strip[:3, columns], reference[k], atol=1e-5)
        np.testing.assert_allclose(strip[3:6, columns], asset[k], atol=1e-5)
        np.testing.assert_allclose(strip[6:, columns], np.minimum(10 * (asset - reference)[k], 1), atol=2e-4)
    np.testing.assert_array_equal(slice_strip(source, source.slices, pairs)[6:], 0)


def test_white_diffuser_facing_the_light_shows_white(source):
    white = slice_strip(source, lambda p: np.full((len(p), 3, 4, 3), 1 / np.pi, np.float32), np.array([[0, 0]]))
    np.testing.assert_allclose(white[3:6], 1, atol=1e-6)


@pytest.mark.parametrize(
    ("uv", "x", "y"), [((0.3, 0.5), 1, 1), ((0.0, 0.0), 0, 0), ((-0.1, 1.9), 3, 2), ((1, 1), 0, 0)]
)
@pytest.mark.parametrize("chunk", [1, 4, 1000])
def test_apparent_brdf_of_a_texel(source, uv, x, y, chunk):
    got = apparent_brdf(source, uv, chunk=chunk)
    assert got.shape == (7, 5, 3)
    np.testing.assert_allclose(got[..., 0], (0.04 + 0.01 * np.arange(7))[:, None].repeat(5, 1), atol=1e-6)
    np.testing.assert_allclose(got[..., 1], (0.02 + 0.01 * np.arange(5))[None].repeat(7, 0), atol=1e-6)
    np.testing.assert_allclose(got[..., 2], 0.01 * (y * 4 + x), atol=1e-6)
    assert source.asked <= chunk


def test_brdf_strip_sets_source_and_asset_side_by_side(source):
    reference = apparent_brdf(source, (0, 0))
    asset = apparent_brdf(source, (0, 0), eval_slices=lambda p: 2 * source.slices(p))
    np.testing.assert_allclose(asset, 2 * reference)
    strip = brdf_strip(reference, asset, gap=2)
    assert strip.shape == (7, 5 + 2 + 5 + 2 + 5, 3)
    np.testing.assert_allclose(strip[:, :5], encode(reference), atol=1e-5)
    np.testing.assert_array_equal(strip[:, 5:7], 1)
    np.testing.assert_allclose(strip[:, 7:12], encode(2 * reference), atol=1e-5)


def test_telling_pairs_span_the_hemisphere():
    source = Counted(ubo2003_directions(), ubo2003_directions())
    pairs = telling_pairs(source, 6)
    assert pairs.shape == (6, 2)
    assert pairs[0].tolist() == [0, 0]
    theta = np.degrees(np.arccos(source.lights[pairs[:, 0], 2]))
    assert (np.diff(theta) > 0).all()
    assert theta[-1] >= 60
    assert len({tuple(p) for p in pairs.tolist()}) == 6
    assert telling_pairs(source, 1).tolist() == [[0, 0]]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: slice_strip(s, s.slices, np.zeros((0, 2), int)), "at least one pair"),
        (lambda s: slice_strip(s, s.slices, np.array([[7, 0]])), r"must be below \(7, 5\)"),
        (lambda s: slice_strip(s, lambda p: np.zeros((1, 2, 2, 3)), np.array([[0, 0]])), r"shape \(1, 3, 4, 3\), got"),
        (lambda s: apparent_brdf(s, (0.5, np.nan)), "uv must be two finite numbers"),
        (lambda s: apparent_brdf(s, (0.5,)), "uv must be two finite numbers"),
        (lambda s: apparent_brdf(s, (0, 0), chunk=0), "chunk must be at least 1"),
        (lambda s: brdf_strip(np.zeros((2, 3, 3)), np.zeros((3, 2, 3))), "must have one shape"),
        (lambda s: telling_pairs(s, 0), "count must be at least 1"),
    ],
)
def test_wrong_arguments_are_named(source, call, message):
    with pytest.raises(ValueError, match=message):
        call(source)
