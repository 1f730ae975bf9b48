"""The sampling proxy: kernels against float64, samples against their density (chi-square), and odd input."""

import numpy as np
import pytest
import warp as wp
from scipy.stats import chi2

from warp_neumat.kernels import brdf_sample
from warp_neumat.kernels.brdf_sample import NODES, make_proxy, pdf_proxy, quantize_weights, sample_proxy, sample_weights
from warp_neumat.reference import brdf_sample as reference

SHARP = [[0.005, 0.005], [0.03, 0.03], [0.25, 0.25]]
BROAD = [[0.1, 0.1], [0.5, 0.5], [1.0, 1.0]]
STRETCHED = [[0.02, 0.2], [0.4, 0.08], [1.0, 0.3]]


def mixed_weights(rng):
    """Rows that change with θ_o, each lobe with some weight."""
    return quantize_weights(0.1 / 4 + 0.9 * rng.dirichlet(np.ones(4), NODES))


def viewers(rng, count):
    """Unit ω_o, float32, a fifth of them within a degree of the horizon."""
    v = rng.normal(size=(count, 3))
    v[:, 2] = np.abs(v[:, 2]) + 1e-4
    v[: count // 5, 2] *= 1e-2
    return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)


def numbers(rng, count):
    return rng.random((count, 3), dtype=np.float32)


# Worst seen over 10⁶ samples on a CPU (Zen 3, 2026-11): ω_i 8.5e-4 at α = 0.005, 1.1e-4 else. Density 1.2e-2 near the
# horizon, where ω_i and ω_o nearly cancel in h; elsewhere 7e-4: close to the normal, 1 − cos θ_o keeps few digits, and
# the weights follow it.
@pytest.mark.parametrize(("alphas", "density_tolerance"), [(SHARP, 2.5e-2), (BROAD, 1.4e-3), (STRETCHED, 1.4e-3)])
def test_sample_matches_float64(alphas, density_tolerance, rng, device):
    weights = mixed_weights(rng)
    proxy = make_proxy(alphas, weights, device)
    wo, u = viewers(rng, 100_000), numbers(rng, 100_000)
    wi, density = sample_proxy(proxy, wp.array(wo, device=device), wp.array(u, device=device))
    want_wi, want = reference.proxy_sample(alphas, weights, wo, u)
    far = np.abs(wi.numpy() - want_wi).max(1)
    other_lobe = far > 0.01  # u[0] so close to an edge of the mixture that rounding decides
    assert other_lobe.sum() <= 3
    assert far[~other_lobe].max() < 1.7e-3
    assert np.abs(np.linalg.norm(wi.numpy(), axis=1) - 1).max() < 2e-6
    horizon = np.abs(want_wi[:, 2]) < 1e-5
    error = np.abs(density.numpy() - want) / (want + 1e-3)
    assert error[~other_lobe & ~horizon].max() < density_tolerance
    # Away from the horizon the density is that of float64 to rounding.
    inner = ~other_lobe & (wo[:, 2] > 0.05) & (np.abs(want_wi[:, 2]) > 0.05)
    assert error[inner].max() < 1.4e-3


@pytest.mark.parametrize(("alphas", "tolerance"), [(SHARP, 2.5e-2), (BROAD, 1.4e-3), (STRETCHED, 3.4e-3)])
def test_pdf_matches_float64(alphas, tolerance, rng, device):
    weights = mixed_weights(rng)
    proxy = make_proxy(alphas, weights, device)
    wo = viewers(rng, 100_000)
    wi = viewers(rng, 100_000)
    wi[:50_000], _ = reference.proxy_sample(alphas, weights, wo[:50_000], numbers(rng, 50_000))  # where it is large
    below = rng.random(len(wi)) < 0.1
    wi[below, 2] *= -1
    got = pdf_proxy(proxy, wp.array(wi, device=device), wp.array(wo, device=device)).numpy()
    want = reference.proxy_pdf(alphas, weights, wi, wo)
    assert (got[wi[:, 2] <= 0] == 0).all()
    assert (np.abs(got - want) / (want + 1e-3)).max() < tolerance
    assert want.max() > 10


# --- chi-square -------------------------------------------------------------------------------------------------------

RADIAL, AROUND, POINTS = 24, 32, 8
CASES = [
    (name, alphas, degrees)
    for name, alphas in (("sharp", SHARP), ("broad", BROAD), ("stretched", STRETCHED))
    for degrees in (0.0, 30.0, 60.0, 80.0, 89.0)
]
LEVEL = 1 - (1 - 0.01) ** (1 / len(CASES))
"""Significance of one test, so that all together raise a false alarm in one of a hundred runs (Šidák)."""
AZIMUTH = 0.6


def viewer(degrees):
    t = np.radians(degrees)
    return np.array([np.sin(t) * np.cos(AZIMUTH), np.sin(t) * np.sin(AZIMUTH), np.cos(t)])


def widest(phi, wo):
    """The half vector's θ at which ω_i meets the horizon, for its azimuth ``phi`` from that of ω_o."""
    return np.pi / 4 + 0.5 * np.arctan2(np.hypot(*wo[:2]) * np.cos(phi), wo[2])


def bin_masses(density, wo):
    """Integrate ``density(wi, wo)`` over bins even in (θ_h/widest)^(1/4) and φ_h: highlights fill many of them."""
    x, w = np.polynomial.legendre.leggauss(POINTS)
    x, w = 0.5 + 0.5 * x, 0.5 * w
    v = ((np.arange(RADIAL)[:, None] + x) / RADIAL).ravel()
    phi = 2 * np.pi * ((np.arange(AROUND)[:, None] + x) / AROUND).ravel()
    top = widest(phi, wo)
    theta = np.outer(v**4, top)
    jacobian = np.outer(4 * v**3, top) * np.sin(theta) * 2 * np.pi
    half = np.stack([np.sin(theta) * np.cos(phi + AZIMUTH), np.sin(theta) * np.sin(phi + AZIMUTH), np.cos(theta)], -1)
    along = half @ wo
    wi = (2 * along[..., None] * half - wo).reshape(-1, 3)
    p = density(wi, np.broadcast_to(wo, wi.shape)).reshape(theta.shape) * jacobian * 4 * along
    p = p.reshape(RADIAL, POINTS, AROUND, POINTS)
    return np.einsum("apbq,p,q->ab", p, w, w) / (RADIAL * AROUND)


def bin_counts(wi, wo):
    half = wi + wo
    phi = (np.arctan2(half[:, 1], half[:, 0]) - AZIMUTH) % (2 * np.pi)
    theta = np.arctan2(np.hypot(half[:, 0], half[:, 1]), half[:, 2])
    v = (theta / widest(phi, wo)) ** 0.25
    return np.histogram2d(v, phi, bins=(RADIAL, AROUND), range=((0, 1), (0, 2 * np.pi)))[0]


def p_value(density, wi, drawn, wo):
    """Pearson's test of ``wi``; ``drawn`` says which are above the horizon, bins that expect less than 8 are pooled."""
    expected = bin_masses(density, wo).ravel() * len(wi)
    observed = bin_counts(np.asarray(wi[drawn], np.float64), wo).ravel()
    assert observed.sum() > 0.999 * drawn.sum()  # all that is above the horizon lies in a bin, but for rounding
    expected = np.append(expected, max(len(wi) - expected.sum(), 0.0))  # lost below the horizon
    observed = np.append(observed, len(wi) - observed.sum())
    order = np.argsort(expected)
    expected, observed = expected[order], observed[order]
    pooled = np.searchsorted(expected, 8.0)
    while 0 < pooled < len(expected) and expected[:pooled].sum() < 8.0:
        pooled += 1
    e = np.append(expected[pooled:], expected[:pooled].sum())
    o = np.append(observed[pooled:], observed[:pooled].sum())
    o, e = o[e > 1e-6], e[e > 1e-6]
    return chi2.sf(((o - e) ** 2 / e).sum(), len(e) - 1)


def draw(alphas, degrees, count=200_000):
    rng = np.random.default_rng(7)
    weights = mixed_weights(rng)
    wo = viewer(degrees)
    proxy = make_proxy(alphas, weights)
    wi, density = sample_proxy(proxy, np.tile(np.float32(wo), (count, 1)), numbers(rng, count))
    return weights, wo, wi, density > 0


@pytest.mark.parametrize(("name", "alphas", "degrees"), CASES, ids=lambda v: f"{v}" if not isinstance(v, list) else "")
def test_samples_follow_the_density(name, alphas, degrees):
    weights, wo, wi, drawn = draw(alphas, degrees)

    def density(i, o):
        # The kernel's own density where it is accurate; in float32 grazing pairs' half vectors carry rounding.
        got = pdf_proxy(make_proxy(alphas, weights), i.astype(np.float32), np.ascontiguousarray(o, np.float32))
        return np.where((i[:, 2] > 0.02) & (o[:, 2] > 0.02), got, reference.proxy_pdf(alphas, weights, i, o))

    assert bin_masses(density, wo).sum() < 1.0 + 1e-4
    assert p_value(density, wi, drawn, wo) > LEVEL


@pytest.mark.parametrize("wrong", ["alpha", "weights", "bound", "azimuth"])
def test_a_wrong_density_is_found(wrong, monkeypatch):
    alphas = BROAD if wrong == "bound" else STRETCHED  # sharp lobes hardly need the bound
    weights, wo, wi, drawn = draw(alphas, 60.0)
    shown, table = np.array(alphas), weights
    if wrong == "alpha":
        shown = np.minimum(shown * 1.06, 1.0)
    elif wrong == "weights":
        table = weights.copy()
        table[:, :2] += [[0.01, -0.01]]
    elif wrong == "azimuth":
        shown = shown[:, ::-1]
    else:
        monkeypatch.setattr(reference, "_bound", lambda wo, alpha: np.ones(len(wo)))  # all visible normals
    assert p_value(lambda i, o: reference.proxy_pdf(shown, table, i, o), wi, drawn, wo) < LEVEL


def test_density_integrates_to_one_less_what_falls_below():
    rng = np.random.default_rng(3)
    for alphas in (SHARP, BROAD, STRETCHED):
        weights = mixed_weights(rng)
        for degrees in (0.0, 45.0, 75.0, 88.0):
            wo = viewer(degrees)
            mass = bin_masses(lambda i, o, a=alphas, w=weights: reference.proxy_pdf(a, w, i, o), wo).sum()
            u = numbers(rng, 100_000)
            _, density = sample_proxy(make_proxy(alphas, weights), np.tile(np.float32(wo), (len(u), 1)), u)
            assert mass <= 1 + 1e-4
            assert mass == pytest.approx((density > 0).mean(), abs=0.008)  # five standard deviations


# --- edges ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("alphas", [SHARP, BROAD, STRETCHED, [[0.002, 1.0]] * 3])
def test_extreme_input_gives_finite_output(alphas, rng):
    tiny = 1e-42
    special = np.array(
        [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [1, 0, tiny], [tiny, 0, 1], [0, 0, tiny], [0, 0, 0],
         [np.nan, 0, 1], [0, 0, np.inf], [3e38, 3e38, 3e38], [0.6, 0, 0.8], [1, 0, 1e-6], [-1, 0, 1e-6]], np.float32
    )  # fmt: skip
    edges = np.array([0, 1e-30, 0.5, 0.25, np.nextafter(np.float32(1), 0), 1, 2, -1, np.nan, np.inf], np.float32)
    u = np.stack(np.meshgrid(edges, edges, edges), -1).reshape(-1, 3)
    tables = [mixed_weights(rng)]
    tables += [np.eye(4)[[lobe]].repeat(NODES, 0) for lobe in range(4)]  # each lobe alone
    for table in tables:
        proxy = make_proxy(alphas, table)
        wo = special.repeat(len(u), 0)
        wi, density = sample_proxy(proxy, wo, np.tile(u, (len(special), 1)))
        assert np.isfinite(wi).all()
        assert np.isfinite(density).all()
        assert (density >= 0).all()
        assert np.abs(np.linalg.norm(wi, axis=1) - 1).max() < 1e-5
        assert (density[wi[:, 2] <= 0] == 0).all()
        i, o = (special[k.ravel()] for k in np.meshgrid(range(len(special)), range(len(special))))
        both = pdf_proxy(proxy, i, o)
        assert np.isfinite(both).all()
        assert (both >= 0).all()


def test_a_lobe_of_weight_zero_is_never_drawn(rng):
    table = np.eye(4)[[2]].repeat(NODES, 0)
    wo, u = viewers(rng, 50_000), numbers(rng, 50_000)
    u[:1000, 0] = np.nextafter(np.float32(1), 0)
    u[1000:2000, 0] = 0
    got, _ = sample_proxy(make_proxy([[1, 1], [0.05, 0.05], [1, 1]], table), wo, u)
    want, _ = sample_proxy(make_proxy([[0.05, 0.05]] * 3, table), wo, u)
    assert np.array_equal(got, want)


def test_samples_depend_on_the_numbers_alone_and_keep_the_callers_kind(rng):
    torch = pytest.importorskip("torch")
    proxy = make_proxy(SHARP, mixed_weights(rng))
    wo, u = viewers(rng, 3_000), numbers(rng, 3_000)
    wi, density = sample_proxy(proxy, wo, u)
    again = sample_proxy(proxy, 2 * wo[::-1], u[::-1])
    assert np.abs(again[0][::-1] - wi).max() < 1e-3
    there = sample_proxy(proxy, torch.from_numpy(wo), torch.from_numpy(u))
    assert all(isinstance(t, torch.Tensor) for t in there)
    assert np.array_equal(there[0].numpy(), wi)
    assert np.array_equal(there[1].numpy(), density)
    assert np.allclose(pdf_proxy(proxy, wi, wo)[wo[:, 2] > 0.1], density[wo[:, 2] > 0.1], rtol=2e-3)
    empty = sample_proxy(proxy, wo[:0], u[:0])
    assert empty[0].shape == (0, 3)
    assert empty[1].shape == (0,)


def test_weights_are_quotients(rng):
    value, density = rng.random((1_000, 3), dtype=np.float32), rng.random(1_000, dtype=np.float32)
    density[::7] = 0
    got = sample_weights(value, density)
    want = value.astype(np.float64) / np.where(density > 0, density, np.inf)[:, None]
    assert np.allclose(got, want, rtol=2e-7, atol=0)
    assert (got[::7] == 0).all()


def test_quantized_weights_add_up(rng):
    got = quantize_weights(rng.dirichlet(np.ones(4) * 0.2, NODES))
    assert np.array_equal((got * 65535).round().sum(1), np.full(NODES, 65535.0))
    assert np.array_equal(quantize_weights(got), got)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make_proxy([[0.1, 0.1]], np.full((NODES, 4), 0.25)), r"alphas must have shape \(3, 2\), got \(1, 2\)"),
        (lambda: make_proxy([[0.1, 9]] * 3, np.full((NODES, 4), 0.25)), r"alphas must be in \[0.002, 1.0\], got"),
        (lambda: make_proxy(SHARP, np.full((NODES, 3), 0.25)), r"weights must have shape \(32, 4\), got \(32, 3\)"),
        (lambda: make_proxy(SHARP, np.full((NODES, 4), 0.3)), "weights must be at least 0 and add up to 1"),
    ],
)
def test_wrong_proxies_are_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_wrong_shapes_are_named(rng):
    proxy = make_proxy(SHARP, mixed_weights(rng))
    with pytest.raises(ValueError, match=r"u must have shape \[2, 3\], got \(2, 2\)"):
        sample_proxy(proxy, np.ones((2, 3)), np.ones((2, 2)))
    with pytest.raises(ValueError, match=r"wo must have shape \[2, 3\], got \(3, 3\)"):
        pdf_proxy(proxy, np.ones((2, 3)), np.ones((3, 3)))


def test_the_kernels_compile_for_cuda(tmp_path):
    wp.init()
    module = brdf_sample._make_kernels(1)[0].module
    wp.compile_aot_module(module, arch=80, module_dir=tmp_path, use_ptx=True)
