"""The proxy of a material against its float64 twin, and at the edges of its domain."""

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels.proxy import proxy_eval
from warp_neumat.reference.proxy import proxy as reference


def _unit(vectors):
    vectors = np.asarray(vectors, np.float64)
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


def _rows(rng, count, least, most, spread=None):
    """Return (params, n, l, v) in a frame of any orientation; l near the mirror direction where ``spread`` is given."""
    n, v = _unit(rng.normal(size=(count, 3))), _unit(rng.normal(size=(count, 3)))
    v = np.where((n * v).sum(1, keepdims=True) < 0, -v, v)
    l = _unit(rng.normal(size=(count, 3)))
    if spread is not None:
        l = _unit(2 * (n * v).sum(1, keepdims=True) * n - v + rng.normal(size=(count, 3)) * spread)
    alpha = np.exp(rng.uniform(np.log(least), np.log(most), count))
    params = np.stack([rng.random(count), rng.uniform(-1.2, 1.2, count), alpha**2], 1).astype(np.float32)
    return params, n, l, v


@pytest.mark.parametrize(
    ("least", "most", "spread", "bound"),
    # Worst of 10 seeds (Zen 3): 4.8e-5, 2.0e-4, 2.7e-3; all where a cosine is next to 0, which float32 rounds by 1e-7.
    [(0.3, 1.0, None, 2e-4), (0.3, 1.0, 0.1, 6e-4), (0.01, 0.3, 0.02, 8e-3)],
    ids=["rough", "rough highlight", "sharp highlight"],
)
def test_proxy_matches_float64(rng, device, least, most, spread, bound):
    rows = _rows(rng, 100_003, least, most, spread)
    got = proxy_eval(*(wp.array(r, dtype=wp.float32, device=device) for r in rows)).numpy()
    expected = reference(*rows)
    assert (expected > 0.05).mean() > 0.2
    assert (np.abs(got - expected) / (expected + 1e-3)).max() < bound
    below = ((rows[1] * rows[2]).sum(1) <= -1e-6) | ((rows[1] * rows[3]).sum(1) <= -1e-6)
    assert not got[below].any()


def test_lambert_alone_is_the_cosine(rng):
    _, n, l, v = _rows(rng, 1000, 0.1, 1.0, 0.3)
    got = proxy_eval((0.7, 0.0, 1.0), n, l, v)
    above = (n * l).sum(1) > 0
    np.testing.assert_allclose(got[above], (0.7 / np.pi * (n * l).sum(1))[above], atol=1e-6)


@pytest.mark.parametrize(("specular", "end"), [(0.04, 1.0), (0.5, 1.0), (0.01, 1.0), (1.5, 1.5)])
def test_a_negative_specular_rises_at_grazing_angles(specular, end):
    for degrees in (0.0, 60.0, 89.0):
        theta = np.radians(degrees)
        l, v = (_unit([[sign * np.sin(theta), 0, np.cos(theta)]]) for sign in (1, -1))
        constant, rising = (proxy_eval((0.0, s, 1e-2), (0.0, 0.0, 1.0), l, v)[0] for s in (specular, -specular))
        expected = specular + (end - specular) * (1 - np.cos(theta)) ** 5
        assert rising / constant == pytest.approx(expected / specular, rel=1e-4)


def test_nothing_makes_a_nan():
    directions = _unit([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [1, 0, 1e-7], [-1, 0, 1e-7], [0, 1, 1]])
    l, v = np.repeat(directions, 7, axis=0), np.tile(directions, (7, 1))
    for params in ((0, 0, 0), (0, 0, 1), (1, 1, 0), (1, -1, 0), (1, -2, 1e-12), (0.5, -1e-9, 1.0)):
        value = proxy_eval(params, (0.0, 0.0, 1.0), l, v)
        assert np.isfinite(value).all()
        assert (value >= 0).all()
    assert not proxy_eval((0, 0, 1), (0.0, 0.0, 1.0), l, v).any()
    assert proxy_eval((1, 1, 1), (0, 0, 1), l[:0], v[:0]).shape == (0,)


def test_wrong_shapes_are_named():
    rows = np.zeros((4, 3), np.float32)
    with pytest.raises(ValueError, match="viewer must have shape"):
        proxy_eval((1, 1, 1), (0, 0, 1), rows, rows[:3])
    with pytest.raises(ValueError, match="params must have shape"):
        proxy_eval(rows[:2], (0, 0, 1), rows, rows)
