"""Tangent frames and half vectors against NumPy float64."""

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels.frame import half_vectors, tangent_frames
from warp_neumat.reference import frame as reference


def _directions(rng, count):
    v = rng.normal(size=(count, 3))
    return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)


def test_half_vectors_match_float64(rng, device):
    wi, wo = _directions(rng, 20_000), _directions(rng, 20_000)
    keep = np.linalg.norm(wi + wo, axis=1) > 0.1
    got = half_vectors(wp.array(wi, device=device), wp.array(wo, device=device)).numpy()
    assert np.abs(got - reference.half_vectors(wi, wo))[keep].max() < 8e-7  # seen: 3.9e-7 at |wi + wo| = 0.1 (Zen 3)


def test_tangent_frames_match_float64(rng, device):
    n, t = rng.normal(size=(20_000, 3)).astype(np.float32), rng.normal(size=(20_000, 3)).astype(np.float32)
    cosine = np.abs(np.sum(n * t, 1)) / np.linalg.norm(n, axis=1) / np.linalg.norm(t, axis=1)
    keep = cosine < np.cos(0.1)
    t = np.concatenate([t, rng.choice([-1.0, 1.0], (20_000, 1))], axis=1).astype(np.float32)
    got = tangent_frames(wp.array(n, device=device), wp.array(t, device=device)).numpy()
    assert np.abs(got - reference.tangent_frames(n, t))[keep].max() < 4e-6  # seen: 1.9e-6 at 0.1 rad (Zen 3)


def test_frames_are_orthonormal_for_any_input():
    tiny, huge = np.float32(1e-42), np.float32(1e38)
    normals = [
        [0, 0, 0],
        [np.nan, 0, 1],
        [tiny, 0, 0],
        [huge, huge, huge],
        [0, 0, -1],
        [0, 0, 1],
        [0, 1, 0],
        [1e-20, 0, 0],
    ]
    tangents = [
        [1, 0, 0, 1],
        [1, 0, 0, 1],
        [1, 0, 0, -1],
        [1, 1, 1, 1],
        [0, 0, 1, 1],
        [0, 0, 0, 1],
        [0, 1, 0, 1],
        [0, 1, 0, 1],
    ]
    frames = tangent_frames(np.array(normals, np.float32), np.array(tangents, np.float32)).astype(np.float64)
    assert np.isfinite(frames).all()
    product = frames @ frames.transpose(0, 2, 1)
    assert np.abs(product - np.eye(3)).max() < 1e-6
    assert np.allclose(frames[2, 2], [1, 0, 0])  # a denormal normal still points where it points
    assert np.allclose(frames[0, 2], [0, 0, 1])


def test_opposite_directions_have_a_half_vector(rng):
    wi = _directions(rng, 100)
    assert np.array_equal(half_vectors(wi, -wi), np.tile(np.float32([0, 0, 1]), (100, 1)))


def test_no_directions_give_no_directions():
    assert half_vectors(np.zeros((0, 3)), np.zeros((0, 3))).shape == (0, 3)
    assert tangent_frames(np.zeros((0, 3)), np.zeros((0, 4))).shape == (0, 3, 3)


def test_frame_functions_name_the_wrong_shape():
    with pytest.raises(ValueError, match=r"wo must have shape \[4, 3\], got \(5, 3\)"):
        half_vectors(np.zeros((4, 3)), np.zeros((5, 3)))
    with pytest.raises(ValueError, match=r"tangents must have shape \[2, 4\]"):
        tangent_frames(np.zeros((2, 3)), np.zeros((2, 3)))
