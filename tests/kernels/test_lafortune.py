"""Lafortune kernels against float64 and finite differences, and what Levenberg–Marquardt promises."""

import numpy as np
import pytest

from warp_neumat.kernels import dispatch
from warp_neumat.kernels import lafortune as kernel
from warp_neumat.reference import lafortune as reference


def directions(rng, count):
    v = rng.normal(size=(count, 3))
    v[:, 2] = np.abs(v[:, 2]) + 0.05
    return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)


def lobes(rng, texels, spread=0.1):
    """Return parameters (texels, 55) of a mirror, a retro-reflective, a forward and a diffuse-like lobe, all lit."""
    p = np.zeros((texels, 55))
    p[:, :3] = rng.uniform(0.05, 0.3, (texels, 3))
    shapes = (((-1, -1, 1), 30), ((1, 1, 1), 8), ((-0.5, -0.5, 0.8), 3), ((0.1, 0.1, 1), 1))
    for j, (diagonal, n) in enumerate(shapes):
        at = 3 + 13 * j
        p[:, at : at + 3] = rng.uniform(0.1, 1.0, (texels, 3))
        p[:, at + 3 : at + 12] = (np.diag(diagonal) + spread * rng.normal(size=(texels, 3, 3))).reshape(texels, 9)
        p[:, at + 12] = n * rng.uniform(0.7, 1.4, texels)
    return p.astype(np.float32)


@pytest.fixture
def scene(rng):
    """150 pairs, of which the last chunk is not whole, and 11 texels, of which the last block is not."""
    return directions(rng, 150), directions(rng, 150), lobes(rng, 11), lobes(rng, 11)


def fit(data, pairs, state, lights, **options):
    options = {"iterations": 1, "restart": False, **options}
    kernel.fit_steps(data, pairs, lights, np.arange(len(state)), state, **options)


@pytest.mark.parametrize("cosine", kernel.COSINES)
def test_values_match_float64(scene, cosine):
    wi, wo, p, _ = scene
    found = kernel.evaluate(p, wi, wo, cosine=cosine)
    wanted = np.stack([reference.value(row, wi, wo, cosine) for row in p], 1)
    assert found.shape == (150, 11, 3)
    assert np.abs(found / wanted - 1.0).max() < 1.2e-5  # measured 4e-6 at n ≤ 42
    p[:, 15] = 200.0
    wanted = np.stack([reference.value(row, wi, wo, cosine) for row in p], 1)
    assert np.abs(kernel.evaluate(p, wi, wo, cosine=cosine) / wanted - 1.0).max() < 6e-5


def test_jacobian_matches_finite_differences(scene):
    wi, wo, p, _ = scene
    p = p[0].astype(np.float64)
    exact = reference.jacobian(p, wi, wo, "diffuse")
    order = [3 * 0 + c if j == 0 else 3 + 13 * (j - 1) + c for c in range(3) for j in range(5)]
    order += [3 + 13 * j + 3 + m for j in range(4) for m in range(10)]
    away = np.all(np.abs(reference.lobe_values(p, wi, wo)[1]) > 2e-3, 1)  # from the edge where a lobe ends
    assert away.sum() > 100
    for unknown, place in enumerate(order):
        h = 1e-6
        up, down = p.copy(), p.copy()
        exponent = place >= 3 and (place - 3) % 13 == 12
        up[place], down[place] = (
            (p[place] * np.exp(h), p[place] * np.exp(-h)) if exponent else (p[place] + h, p[place] - h)
        )
        slope = (reference.value(up, wi, wo, "diffuse") - reference.value(down, wi, wo, "diffuse")) / (2 * h)
        difference = np.abs(slope - exact[:, :, unknown])[away].max()
        assert difference < 1e-6 * max(1.0, np.abs(slope).max()), (unknown, difference)


@pytest.mark.parametrize("softness", [0.0, 0.1])
@pytest.mark.parametrize("cosine", kernel.COSINES)
def test_normal_equations_match_float64(scene, cosine, softness):
    wi, wo, truth, p = scene
    data = kernel.evaluate(truth, wi, wo, cosine=cosine)
    scale = data.mean((0, 2), dtype=np.float64)
    found, gradient = kernel.normal_equations(
        data, kernel.Pairs.of(wi, wo, cosine), p, scale=scale, softness=softness
    )  # fmt: skip
    assert np.array_equal(found, found.transpose(0, 2, 1))
    for i, row in enumerate(p.astype(np.float64)):
        row[:3] /= scale[i]
        row[3:].reshape(4, 13)[:, :3] /= scale[i]
        data_i = data[:, i] / scale[i]
        wanted, slope = reference.normal_equations(row, wi, wo, data_i, cosine, softness)
        size = np.sqrt(np.diag(wanted))
        assert (np.abs(found[i] - wanted) / np.outer(size, size)).max() < 4e-5  # measured 2.1e-5
        rest = data_i - reference.value(row, wi, wo, cosine)
        weight = 1 / np.sqrt((rest**2).sum(1) + softness**2) if softness else np.ones(len(rest))
        length = np.sqrt((weight * (rest**2).sum(1)).sum())
        assert (np.abs(gradient[i] - slope) / (size * length)).max() < 4e-5


@pytest.mark.parametrize("softness", [0.0, 0.05])
def test_a_step_never_increases_the_loss(rng, scene, softness):
    wi, wo, _, p = scene
    data = rng.uniform(0.0, 1.0, (150, 11, 3)).astype(np.float32) ** 4
    state, pairs = kernel.state_of(p), kernel.Pairs.of(wi, wo, "diffuse")
    fit(data, pairs, state, wi, iterations=0, restart=True, softness=softness)
    losses = [state[:, kernel.LOSS].copy()]
    for _ in range(40):
        fit(data, pairs, state, wi, softness=softness)
        losses.append(state[:, kernel.LOSS].copy())
    losses = np.array(losses)
    assert (np.diff(losses, axis=0) <= 2e-6 * losses[:-1]).all()  # a launch sums the old loss anew
    assert (losses[-1] < 0.95 * losses[0]).all()


@pytest.mark.parametrize("softness", [0.0, 0.05])
def test_the_loss_is_that_of_the_parameters(scene, softness):
    wi, wo, truth, p = scene
    data = kernel.evaluate(truth, wi, wo, cosine="diffuse")
    state = kernel.state_of(p)
    fit(data, kernel.Pairs.of(wi, wo, "diffuse"), state, wi, iterations=2, restart=True, softness=softness, ridge=0.0)
    scale = state[:, kernel.SCALE].astype(np.float64)
    assert np.allclose(scale, data.mean((0, 2), dtype=np.float64), rtol=1e-5)
    for i, row in enumerate(kernel.parameters_of(state)):
        rest = (((reference.value(row, wi, wo, "diffuse") - data[:, i]) / scale[i]) ** 2).sum(1)
        wanted = 2 * (np.sqrt(rest + softness**2) - softness) if softness else rest
        assert np.isclose(state[i, kernel.LOSS], wanted.mean(), rtol=1e-4, atol=1e-9)


def test_colours_are_the_best_that_are_not_negative(rng, scene):
    from scipy.optimize import nnls

    wi, wo, _, p = scene
    data = rng.uniform(0.0, 1.0, (150, 11, 3)).astype(np.float32) ** 4
    state = kernel.state_of(p)
    fit(data, kernel.Pairs.of(wi, wo, "none"), state, wi, iterations=0, restart=True, ridge=0.0)
    zeros = 0
    for i, row in enumerate(kernel.parameters_of(state)):
        _, _, power = reference.lobe_values(row, wi, wo)
        columns = np.concatenate([np.ones((150, 1)), power], 1)
        own = np.concatenate([row[None, :3], row[3:].reshape(4, 13)[:, :3]])
        assert (own >= 0).all()
        for c in range(3):
            wanted, length = nnls(columns, data[:, i, c].astype(np.float64))
            assert np.allclose(own[:, c], wanted, atol=2e-4 * wanted.max()), (i, c)
            assert np.linalg.norm(columns @ own[:, c] - data[:, i, c]) <= length * (1 + 1e-6)
            zeros += (wanted == 0).sum()
    assert zeros > 10  # the bounds were needed


def test_nearby_lobes_are_recovered(rng):
    wi, wo, truth = directions(rng, 800), directions(rng, 800), lobes(rng, 16)
    data = kernel.evaluate(truth, wi, wo, cosine="diffuse")
    start = truth.copy()
    start[:, 3:].reshape(16, 4, 13)[..., 3:12] += 0.05 * rng.normal(size=(16, 4, 9))
    start[:, 3:].reshape(16, 4, 13)[..., 12] *= rng.uniform(0.8, 1.25, (16, 4))
    state = kernel.state_of(start)
    fit(data, kernel.Pairs.of(wi, wo, "diffuse"), state, wi, iterations=200, restart=True, ridge=0.0, tolerance=1e-3)
    rest = kernel.evaluate(kernel.parameters_of(state), wi, wo, cosine="diffuse") - data
    error = np.abs(rest).mean((0, 2)) / data.mean((0, 2))
    assert (error < 1e-5).sum() >= 15, error  # measured 1e-7 … 2e-6; one start lies in the valley of another minimum
    assert error.max() < 0.03


def test_every_number_of_threads_gives_the_same_bits(rng, scene):
    wi, wo, truth, p = scene
    data, pairs = kernel.evaluate(truth, wi, wo, cosine="all"), kernel.Pairs.of(wi, wo, "all")
    found = []
    try:
        for workers in (1, 2, 5):
            dispatch.set_worker_count(workers)
            state = kernel.state_of(p)
            fit(data, pairs, state, wi, iterations=5, restart=True, softness=0.05)
            found.append(state)
    finally:
        dispatch.set_worker_count(None)
    assert np.array_equal(found[0], found[1])
    assert np.array_equal(found[0], found[2])


def test_a_texel_does_not_depend_on_its_company(scene):
    wi, wo, truth, p = scene
    data, pairs = kernel.evaluate(truth, wi, wo, cosine="all"), kernel.Pairs.of(wi, wo, "all")
    all_states, some = kernel.state_of(p), kernel.state_of(p)
    fit(data, pairs, all_states, wi, iterations=5, restart=True)
    before = some.copy()
    kernel.fit_steps(data, pairs, wi, [9, 2], some, iterations=5, restart=True)
    assert np.array_equal(some[[9, 2]], all_states[[9, 2]])
    others = np.setdiff1d(np.arange(11), [9, 2])
    assert np.array_equal(some[others], before[others])


@pytest.mark.parametrize("softness", [0.0, 0.05])
def test_degenerate_texels_give_finite_numbers(rng, scene, softness):
    wi, wo, _, p = scene
    data = rng.uniform(0.0, 1.0, (150, 11, 3)).astype(np.float32)
    data[:, 0] = 0.0  # black
    data[:, 1] = 0.25  # constant
    data[:, 2] *= 1e30
    data[:, 3] *= 1e-35
    data[:, 4] = 0.0
    data[7, 4] = 3e38  # one spark
    data[:, 5, 1:] = 0.0  # one channel
    data[:, 6] = 1e36
    p[7, 3:] = 0.0  # lobes that are nothing
    p[8, 3:].reshape(4, 13)[:, 3:12] = -np.eye(3).ravel()  # lobes that no pair sees
    p[9, 3:].reshape(4, 13)[:] = p[9, 3:16]  # four times the same
    state, pairs = kernel.state_of(p), kernel.Pairs.of(wi, wo, "none")
    fit(data, pairs, state, wi, iterations=25, restart=True, softness=softness)
    found = kernel.parameters_of(state)
    assert np.isfinite(state).all()
    assert np.isfinite(found).all()
    value = kernel.evaluate(found, wi, wo, cosine="none").astype(np.float64)
    assert np.isfinite(value).all()
    assert (value >= 0).all()
    assert (value[:, 0] == 0).all()
    assert np.abs(value[:, 1] - 0.25).max() < 1e-3
    assert np.abs(value[:, 6] / 1e36 - 1.0).max() < 1e-3
    assert (found[:, 3:].reshape(-1, 4, 13)[..., 12] >= 0.5).all()
    assert (found[:, 3:].reshape(-1, 4, 13)[..., 12] <= 200.0).all()


def test_bad_arguments_are_refused(scene):
    wi, wo, _, p = scene
    with pytest.raises(ValueError, match="cosine must be one of none, diffuse, all, got 'both'"):
        kernel.Pairs.of(wi, wo, "both")
    with pytest.raises(ValueError, match=r"one shape \(N, 3\)"):
        kernel.Pairs.of(wi, wo[:3], "none")
    pairs, data = kernel.Pairs.of(wi, wo, "none"), np.zeros((150, 11, 3), np.float32)
    with pytest.raises(ValueError, match="jobs must be rows of state, below 11"):
        kernel.fit_steps(data, pairs, wi, [11], kernel.state_of(p), iterations=1, restart=True)
    with pytest.raises(ValueError, match="state must be contiguous float32"):
        kernel.fit_steps(data, pairs, wi, [0], p, iterations=1, restart=True)
    with pytest.raises(ValueError, match="data must have shape"):
        kernel.fit_steps(data[:5], pairs, wi, [0], kernel.state_of(p), iterations=1, restart=True)
