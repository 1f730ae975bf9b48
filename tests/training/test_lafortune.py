"""The Lafortune fit of a whole material: what it recovers, what it beats, and that it is the same every time."""

import numpy as np
import pytest

from warp_neumat.kernels import dispatch
from warp_neumat.kernels import lafortune as kernel
from warp_neumat.training import lafortune
from warp_neumat.training.lafortune import fit_lafortune, stratified_pairs


def dome(count):
    """Return ``count`` directions spread evenly over most of the hemisphere."""
    z = 1.0 - 0.97 * (np.arange(count) + 0.5) / count
    around, r = 2.399963 * np.arange(count), np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(around), r * np.sin(around), z], 1).astype(np.float32)


class Bumpy:
    """A BTF source: GGX over a diffuse base on waves, with the foreshortening in the value."""

    name, notes, opening = "bumpy", (), {}

    def __init__(self, size=6, directions=60):
        self.width, self.height = size + 1, size
        self.lights, self.views = dome(directions), dome(directions - 1)
        y, x = np.mgrid[0 : self.height, 0 : self.width] * 2 * np.pi / size
        n = np.stack([-0.3 * np.cos(x), 0.2 * np.sin(2 * y), np.ones_like(x)], -1)
        self.normals = (n / np.linalg.norm(n, axis=-1, keepdims=True)).reshape(-1, 3)
        self.rough = (0.3 + 0.15 * np.sin(y)).reshape(-1, 1)
        self.base = np.array([0.3, 0.2, 0.1]) * (0.6 + 0.4 * np.cos(x)).reshape(-1, 1)

    def slices(self, pairs):
        rows = [self._slice(self.lights[i].astype(float), self.views[o].astype(float)) for i, o in pairs]
        return np.float32(rows).reshape(-1, self.height, self.width, 3)

    def _slice(self, wi, wo):
        half = (wi + wo) / np.linalg.norm(wi + wo)
        ci, co = (np.maximum(self.normals @ d, 1e-3)[:, None] for d in (wi, wo))
        a = self.rough**2
        d = a / (np.pi * (((self.normals @ half) ** 2)[:, None] * (a - 1) + 1) ** 2)
        v = 0.5 / (co * np.sqrt(ci * ci * (1 - a) + a) + ci * np.sqrt(co * co * (1 - a) + a))
        return ci * (self.base / np.pi + 0.05 * d * v)


class Lobes:
    """A BTF source that is Lafortune lobes: two of them, of random shape."""

    name, notes, opening = "lobes", (), {}

    def __init__(self, rng, height=4, width=5):
        self.width, self.height = width, height
        self.lights, self.views = dome(60), dome(60)
        p = np.zeros((height * width, 4, 13))
        p[..., 12] = 1.0
        for j, (diagonal, n) in enumerate((((-1, -1, 1), 15), ((0.8, 0.8, 0.9), 4))):
            p[:, j, :3] = rng.uniform(0.2, 1.0, (len(p), 3))
            p[:, j, 3:12] = (np.diag(diagonal) + 0.1 * rng.normal(size=(len(p), 3, 3))).reshape(-1, 9)
            p[:, j, 12] = n * rng.uniform(0.7, 1.4, len(p))
        diffuse = rng.uniform(0.05, 0.3, (len(p), 3))
        self.parameters = np.concatenate([diffuse, p.reshape(len(p), -1)], 1).astype(np.float32)

    def slices(self, pairs):
        wi, wo = self.lights[pairs[:, 0]], self.views[pairs[:, 1]]
        return kernel.evaluate(self.parameters, wi, wo, cosine="diffuse").reshape(-1, self.height, self.width, 3)


def held_out(source, count=300):
    rng = np.random.default_rng(5)
    return np.stack([rng.integers(0, len(source.lights), count), rng.integers(0, len(source.views), count)], 1)


@pytest.fixture(scope="module")
def bumpy():
    return Bumpy()


@pytest.fixture(scope="module")
def fitted(bumpy):
    return fit_lafortune(bumpy, pairs=600)


def test_known_lobes_are_recovered(rng):
    source = Lobes(rng)
    fit = fit_lafortune(source, pairs=900, iterations=150, loss="l2", ridge=0.0)
    pairs = held_out(source)
    error = np.abs(fit.evaluate(pairs) - source.slices(pairs)).mean((0, 3)) / source.slices(pairs).mean((0, 3))
    assert np.median(error) < 2e-3, error
    assert error.max() < 2e-2, error


def test_the_fit_beats_what_is_simpler(bumpy, fitted):
    pairs = held_out(bumpy)
    truth = bumpy.slices(pairs)
    mean = np.abs(truth - truth.mean(0)).mean()
    lambert = bumpy.lights[pairs[:, 0], 2][:, None, None, None]
    albedo = (truth * lambert).sum(0) / (lambert**2).sum(0)
    flat = np.abs(truth - albedo * lambert).mean()
    found = fitted.l1(bumpy, pairs)
    assert np.isclose(found, np.abs(fitted.evaluate(pairs) - truth).mean(), rtol=1e-5)
    assert found < min(0.3 * mean, 0.45 * flat), (found, mean, flat)
    assert fitted.l1(bumpy, fitted.pairs) < found < 1.5 * fitted.l1(bumpy, fitted.pairs)


def test_smooth_l1_lowers_the_l1(bumpy, fitted):
    squares = fit_lafortune(bumpy, pairs=600, loss="l2")
    pairs = held_out(bumpy)
    assert fitted.l1(bumpy, pairs) < 0.97 * squares.l1(bumpy, pairs)


def test_more_starts_and_neighbours_are_never_worse(bumpy, fitted, monkeypatch):
    alone = fit_lafortune(bumpy, pairs=600, neighbours=0)
    assert fitted.l1(bumpy, fitted.pairs) <= alone.l1(bumpy, fitted.pairs) * 1.002
    one = lafortune.starts
    monkeypatch.setattr(lafortune, "starts", lambda n: tuple(a[3:4] for a in one(n)))
    single = fit_lafortune(bumpy, pairs=600, neighbours=0)
    assert alone.l1(bumpy, fitted.pairs) < single.l1(bumpy, fitted.pairs)


def test_the_fit_says_what_it_is(bumpy, fitted):
    assert fitted.parameters.shape == (6, 7, 55)
    assert fitted.parameters.dtype == np.float32
    assert fitted.bytes == 6 * 7 * 55 * 4
    assert 400 * 400 * 55 * 4 == 35_200_000  # Table 1: 35.2 MB
    assert fitted.seconds > 0
    assert fitted.steps > 5
    assert 0.3 < fitted.converged <= 1.0
    below = fitted.value([[0.6, 0.0, -0.8], [0.6, 0.0, 0.8]], [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    assert (below[0] == 0).all()
    assert (below[1] > 0).all()
    assert fitted.evaluate(np.zeros((0, 2), int)).shape == (0, 6, 7, 3)


def test_the_same_seed_gives_the_same_bits_on_any_number_of_threads(bumpy):
    try:
        dispatch.set_worker_count(1)
        one = fit_lafortune(bumpy, pairs=300, iterations=10, seed=3)
        dispatch.set_worker_count(3)
        three = fit_lafortune(bumpy, pairs=300, iterations=10, seed=3)
    finally:
        dispatch.set_worker_count(None)
    assert np.array_equal(one.parameters, three.parameters)
    other = fit_lafortune(bumpy, pairs=300, iterations=10, seed=4)
    assert not np.array_equal(one.parameters, other.parameters)


def test_bands_of_rows_change_only_the_neighbours(bumpy, monkeypatch):
    whole = fit_lafortune(bumpy, pairs=300, iterations=10, neighbours=0)
    monkeypatch.setattr(lafortune, "BAND_BYTES", 12 * len(whole.pairs) * 7 * 2 + 1)
    monkeypatch.setattr(lafortune, "SLICES_BYTES", 12 * 42 * 50)
    told = []
    bands = fit_lafortune(
        bumpy, pairs=300, iterations=10, neighbours=0, progress=lambda done, text: told.append((done, text))
    )
    assert np.array_equal(whole.parameters, bands.parameters)
    parts = [done for done, _ in told]
    assert parts == sorted(parts)
    assert parts[-1] == 1.0
    assert len(parts) > 6


def test_pairs_are_stratified():
    lights, views = dome(60), dome(59)
    pairs = stratified_pairs(lights, views, 420, 0)
    assert pairs.shape == (420, 2)
    assert len(np.unique(pairs, axis=0)) == 420
    assert (np.bincount(pairs[:, 0]) == 7).all()
    mirrored = lights * np.float32([-1, -1, 1])
    rank = np.argsort(np.argsort(-(mirrored @ views.T), axis=1), axis=1)[pairs[:, 0], pairs[:, 1]].reshape(60, 7)
    seventh = np.searchsorted(np.arange(8) * 59 // 7, np.sort(rank, 1), side="right") - 1
    assert (seventh == np.arange(7)).all()  # one view of each
    assert len(stratified_pairs(lights, views, 10**6, 0)) == 60 * 59
    assert len(stratified_pairs(lights, views, 20, 0)) == 20


def test_degenerate_materials_give_finite_numbers(bumpy):
    class Odd(Bumpy):
        def slices(self, pairs):
            found = super().slices(pairs)
            found[:, 0, 0] = 0.0
            found[:, 0, 1] = 0.5
            found[:, 0, 2] *= 1e25
            found[:, 0, 3] *= 1e-35
            found[::5, 0, 4] = 1e6
            return found

    fit = fit_lafortune(Odd(), pairs=300, iterations=10, cosine="none")
    assert np.isfinite(fit.parameters).all()
    value = fit.evaluate(held_out(bumpy))
    assert np.isfinite(value).all()
    assert (value >= 0).all()
    assert (value[:, 0, 0] == 0).all()
    assert np.abs(value[:, 0, 1] - 0.5).max() < 0.01


def test_bad_arguments_are_refused(bumpy):
    for options, message in (
        ({"cosine": "both"}, "cosine must be one of none, diffuse, all, got 'both'"),
        ({"iterations": -1}, "iterations must be at least 0, got -1"),
        ({"loss": "l3"}, "loss must be l1 or l2, got 'l3'"),
        ({"pairs": 0}, "pairs must be at least 1, got 0"),
        ({"pairs": np.zeros((0, 2), int)}, "pairs must hold at least one pair"),
        ({"pairs": np.array([[0, 59]])}, "pairs must be below"),
    ):
        with pytest.raises(ValueError, match=message):
            fit_lafortune(bumpy, **options)

    class Broken(Bumpy):
        def slices(self, pairs):
            found = super().slices(pairs)
            found[pairs[:, 0] == 3] = np.nan
            return found

    with pytest.raises(ValueError, match="bumpy: the slice of light 3, view .* not finite"):
        fit_lafortune(Broken(), pairs=200)
