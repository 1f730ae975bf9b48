"""Mip chains and resampling against float64 written the slow way; nothing shifts, means stay, units are kept."""

import numpy as np
import pytest

from warp_neumat.io import mipmaps
from warp_neumat.io.texture_set import Channel

SIZES = [(64, 64), (37, 21), (3, 50), (1, 7), (1, 1), (33, 32)]
MIXED = (
    *(Channel("base_color", c, "srgb") for c in "rgb"),
    *(Channel("normal", c, "normal") for c in "xy"),
    Channel("roughness", "value", "linear"),
)


def decode64(v):
    v = np.float64(v)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def encode64(v):
    return np.where(v <= 0.0031308, v * 12.92, 1.055 * v ** (1 / 2.4) - 0.055)


def area64(values, width, height):
    """Average over the exact footprint of every texel, looped."""
    old_h, old_w, _ = values.shape
    out = np.zeros((height, width, values.shape[2]))
    for r in range(height):
        for c in range(width):
            top, bottom = r * old_h / height, (r + 1) * old_h / height
            left, right = c * old_w / width, (c + 1) * old_w / width
            total = 0.0
            for i in range(int(top), min(old_h, int(np.ceil(bottom)))):
                for j in range(int(left), min(old_w, int(np.ceil(right)))):
                    part = (min(bottom, i + 1) - max(top, i)) * (min(right, j + 1) - max(left, j))
                    out[r, c] += part * values[i, j]
                    total += part
            out[r, c] /= total
    return out


def chain64(pixels):
    p = pixels.astype(np.float64)
    xy = 2 * p[..., 3:5] - 1
    z = np.sqrt(np.maximum(1 - (xy**2).sum(-1, keepdims=True), 0))
    values = np.concatenate([decode64(p[..., :3]), xy, z, p[..., 5:]], -1)
    levels = [p]
    while values.shape[:2] != (1, 1):
        values = area64(values, max(1, values.shape[1] // 2), max(1, values.shape[0] // 2))
        n = values[..., 3:6] / np.linalg.norm(values[..., 3:6], axis=-1, keepdims=True)
        levels.append(np.concatenate([encode64(values[..., :3]), 0.5 + 0.5 * n[..., :2], values[..., 6:]], -1))
    return levels


@pytest.fixture
def mixed(rng):
    def make(width, height):
        pixels = rng.random((height, width, 6), dtype=np.float32)
        pixels[..., 3:5] = 0.5 + 0.3 * (pixels[..., 3:5] - 0.5)
        return pixels

    return make


def test_srgb_round_trip_matches_float64():
    v = np.linspace(0, 1, 40001, dtype=np.float32).reshape(1, -1).repeat(2, 0)
    linear = mipmaps.srgb_to_linear(v)
    assert np.abs(linear - decode64(v)).max() < 3e-7
    assert np.abs(mipmaps.linear_to_srgb(linear) - v).max() < 3e-7
    assert linear.dtype == np.float32
    np.testing.assert_array_equal(mipmaps.srgb_to_linear(-v), -linear)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_chain_matches_float64(mixed, width, height):
    pixels = mixed(width, height)
    levels = mipmaps.mip_chain(pixels, MIXED)
    expected = chain64(pixels)
    assert [level.shape for level in levels] == [level.shape for level in expected]
    assert levels[0] is pixels
    for level, reference in zip(levels, expected, strict=True):
        assert level.dtype == np.float32
        assert np.abs(level - reference).max() < 2e-6
    assert levels[-1].shape == (1, 1, 6)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_no_level_changes_the_mean(rng, width, height):
    pixels = rng.random((height, width, 4), dtype=np.float32)
    channels = [*(Channel("base_color", c, "srgb") for c in "rgb"), Channel("roughness", "value", "linear")]
    means = []
    for level in mipmaps.mip_chain(pixels, channels):
        linear = np.concatenate([decode64(level[..., :3]), level[..., 3:]], -1)
        means.append(linear.mean((0, 1)))
    np.testing.assert_allclose(means, np.broadcast_to(means[0], (len(means), 4)), atol=2e-6)


@pytest.mark.parametrize("old", [64, 37, 96, 5])
def test_no_level_shifts_the_picture(old):
    """A ramp over texel centres stays the same ramp over the centres of the smaller picture: no half-texel drift."""
    ramp = ((np.arange(old) + 0.5) / old).astype(np.float32)
    pixels = np.broadcast_to(ramp[None, :, None], (8, old, 1)).copy()
    for level in mipmaps.mip_chain(pixels, [Channel("displacement", "value", "linear")])[:-1]:
        new = level.shape[1]
        np.testing.assert_allclose(
            level[0, :, 0], (np.arange(new) + 0.5) / new, atol=2e-6 if old % new == 0 else 0.25 / old
        )


def test_edges_average_as_light():
    """Black and white give the grey of half the light, 188 of 255, not half the code."""
    pixels = np.float32([[[0.0], [1.0]]])
    (_, level) = mipmaps.mip_chain(pixels, [Channel("base_color", "value", "srgb")])
    assert round(float(level[0, 0, 0]) * 255) == 188
    (_, level) = mipmaps.mip_chain(pixels, [Channel("roughness", "value", "linear")])
    assert level[0, 0, 0] == 0.5


def test_normals_average_as_vectors():
    """45° and flat give 22.5°, of unit length; averaging x alone would give 20.7°."""
    tilt = 0.5 + 0.5 * np.float32(np.sin(np.pi / 4))
    pixels = np.float32([[[tilt, 0.5], [0.5, 0.5]]])
    level = mipmaps.mip_chain(pixels, MIXED[3:5])[1]
    np.testing.assert_allclose(np.degrees(np.arcsin(2 * level[0, 0, 0] - 1)), 22.5, atol=1e-3)


def test_opposite_normals_give_flat_not_nan():
    pixels = np.float32([[[0.0, 0.5], [1.0, 0.5]]])
    level = mipmaps.mip_chain(pixels, MIXED[3:5])[1]
    np.testing.assert_allclose(level[0, 0], 0.5, atol=1e-3)


def test_toksvig_raises_roughness_where_normals_disagree(mixed):
    pixels = mixed(16, 16)
    pixels[..., 5] = 0.2
    pixels[:8, :, 3:5] = 0.5  # the upper half is flat
    levels = mipmaps.mip_chain(pixels, MIXED, toksvig_roughness=True)
    np.testing.assert_array_equal(levels[0][..., 5], np.float32(0.2))
    np.testing.assert_allclose(levels[1][:4, :, 5], 0.2, atol=1e-4)
    assert (levels[1][4:, :, 5] > 0.22).all()


def test_toksvig_matches_the_exponent_formula():
    r, n = np.meshgrid(np.linspace(0.1, 1.0, 20), np.linspace(0.3, 1.0, 20))
    s = 2 / r**4 - 2
    s2 = n * s / (n + s * (1 - n))
    np.testing.assert_allclose(mipmaps.toksvig(np.float32(r), np.float32(n)), (2 / (s2 + 2)) ** 0.25, atol=1e-5)


def test_toksvig_without_a_roughness_map_is_refused(mixed):
    with pytest.raises(ValueError, match="needs a learnt roughness"):
        mipmaps.mip_chain(mixed(4, 4)[..., :5], MIXED[:5], toksvig_roughness=True)


@pytest.mark.parametrize("size", [(9, 5), (16, 16), (1, 1), (36, 20)])
def test_smaller_is_the_exact_area_filter(rng, size):
    pixels = rng.random((21, 37, 1), dtype=np.float32)
    small = mipmaps.resample(pixels, [Channel("roughness", "value", "linear")], *size)
    np.testing.assert_allclose(small, area64(pixels.astype(np.float64), *size), atol=5e-7)


def test_larger_is_bilinear_between_centres():
    pixels = np.float32([0.0, 1.0]).reshape(1, 2, 1)
    large = mipmaps.resample(pixels, [Channel("roughness", "value", "linear")], 4, 3)
    np.testing.assert_allclose(large[..., 0], np.broadcast_to([0, 0.25, 0.75, 1], (3, 4)))


@pytest.mark.parametrize("old", [2, 3, 7, 64, 100])
def test_area_weights_use_every_texel_alike(old):
    for size in range(1, old + 1):
        first, weights = mipmaps.area_weights(old, size)
        np.testing.assert_allclose(weights.sum(1), 1)
        used = np.zeros(old + weights.shape[1])
        for k in range(weights.shape[1]):
            np.add.at(used, first + k, weights[:, k])
        np.testing.assert_allclose(used[:old], size / old, atol=1e-9)
        np.testing.assert_allclose(used[old:], 0, atol=1e-9)


def test_sizes_halve_with_floor():
    assert mipmaps.mip_sizes(5, 3) == [(5, 3), (2, 1), (1, 1)]
    assert mipmaps.mip_sizes(1, 1) == [(1, 1)]


@pytest.mark.parametrize(
    ("pixels", "channels", "message"),
    [
        (np.zeros((4, 4, 2), np.float32), MIXED, r"must have shape \(H, W, 6\), got \(4, 4, 2\)"),
        (np.zeros((4, 4, 1), np.float32), [Channel("a", "value", "gamma")], "got 'gamma'"),
        (np.zeros((4, 4, 1), np.float32), [Channel("normal", "x", "normal")], "components x and y"),
    ],
)
def test_wrong_input_is_refused(pixels, channels, message):
    with pytest.raises(ValueError, match=message):
        mipmaps.mip_chain(pixels, channels)
