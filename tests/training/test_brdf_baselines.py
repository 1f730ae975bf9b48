"""Baselines: each recovers a source of its own kind, beats a constant, and gives back what its seed says."""

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from warp_neumat.io.brdf import NetworkBRDF, open_brdf  # noqa: E402
from warp_neumat.training import nbrdf  # noqa: E402
from warp_neumat.training.analytic_fit import in_numpy, two_lobe_value  # noqa: E402
from warp_neumat.training.brdf_baselines import STEPS, fit  # noqa: E402
from warp_neumat.training.losses import LogCosine  # noqa: E402
from warp_neumat.training.samplers import BRDFSampler  # noqa: E402
from warp_neumat.training.sphere import render_sphere, sphere_error  # noqa: E402


class Source:
    """A BRDF of given values."""

    name, isotropic = "source", True

    def __init__(self, eval):
        self.eval = eval


def sphere_mae(source, eval_fn) -> float:
    return sphere_error(render_sphere(eval_fn, 64), render_sphere(source.eval, 64))["mae"]


def constant(source):
    """The constant that is best under the fit's own loss: the median of what the samples hold."""
    value = np.median(BRDFSampler(source, np.random.default_rng(1)).draw(4096)["value"], axis=0)
    return lambda wi, wo: np.broadcast_to(value, wi.shape)


@pytest.mark.parametrize("anisotropy", [0.0, 0.6])
def test_ggx_recovers_its_own_parameters(anisotropy):
    source = open_brdf(f"analytic:ggx?roughness=0.35&f0=0.9,0.6,0.3&diffuse=0.05,0.1,0.2&anisotropy={anisotropy}")
    fitted = fit("ggx", source, steps=300)
    aspect = np.sqrt(1.0 - 0.9 * anisotropy)
    alpha = [0.35**2] if anisotropy == 0 else [0.35**2 / aspect, 0.35**2 * aspect]
    np.testing.assert_allclose(fitted.values["alpha"], alpha, rtol=3e-3)
    np.testing.assert_allclose(fitted.values["f0"], [0.9, 0.6, 0.3], rtol=5e-3)
    np.testing.assert_allclose(fitted.values["diffuse"], [0.05, 0.1, 0.2], rtol=1e-2)
    assert (fitted.parameters, fitted.bytes) == ((7, 28) if anisotropy == 0 else (8, 32))
    assert fitted.isotropic == (anisotropy == 0)
    assert sphere_mae(source, fitted.eval) < 1e-3


def test_two_lobes_recover_two_lobes():
    lobes = [0.5, 0.4, 0.3, 4000.0, 1.6, 0.3, 0.03, 0.04, 0.05, 100.0, 1.2, 0.05]
    free = [np.log(v) if n % 6 != 5 else np.log(v / (1 - v)) for n, v in enumerate(lobes)]
    truth = np.array([*np.log([0.05, 0.1, 0.2]), *free], np.float32)
    model = in_numpy(two_lobe_value)
    source = Source(lambda wi, wo: np.where((wi[:, 2:] > 0) & (wo[:, 2:] > 0), model(truth, wi, wo), 0))
    fitted = fit("two_lobe", source, steps=450)
    assert (fitted.parameters, fitted.bytes) == (15, 60)
    np.testing.assert_allclose(fitted.values["diffuse"], [0.05, 0.1, 0.2], rtol=0.15)
    found = sorted((fitted.values[f"lobe{n}"] for n in (0, 1)), key=lambda lobe: lobe["b"])
    np.testing.assert_allclose([lobe["b"] for lobe in found], [100.0, 4000.0], rtol=0.3)
    np.testing.assert_allclose(found[1]["a"], [0.5, 0.4, 0.3], rtol=0.5)
    assert sphere_mae(source, fitted.eval) < 0.3 * sphere_mae(source, constant(source))


def test_a_lambertian_surface_has_no_lobe():
    source = open_brdf("analytic:lambert?albedo=0.2,0.4,0.6")
    fitted = fit("two_lobe", source, steps=150)
    assert sphere_mae(source, fitted.eval) < 4e-3


def test_nbrdf_gradient_is_that_of_the_loss(rng):
    flat = torch.from_numpy(rng.normal(0, 0.4, 675)).requires_grad_()
    x, cosine = (torch.from_numpy(a) for a in (rng.normal(size=(64, 6)), rng.random((64, 1))))
    target = torch.from_numpy(rng.random((64, 3)))
    w0, b0, w1, b1, w2, b2 = nbrdf.layers(flat)
    y = torch.relu(torch.relu(x @ w0 + b0) @ w1 + b1) @ w2 + b2
    assert 0.1 < float((y < 0).double().mean()) < 0.9
    guess = torch.where(y > 0, torch.log1p(torch.expm1(y.clamp_min(0)) * cosine), y * cosine)
    (guess - target).abs().mean().backward()
    loss, gradient = nbrdf.loss_and_gradient(flat.detach(), x, cosine, target)
    torch.testing.assert_close(loss, (guess - target).abs().mean().detach())
    torch.testing.assert_close(gradient, flat.grad)


def test_nbrdf_learns_a_network_of_its_own_shape(rng):
    names = ("w0", "b0", "w1", "b1", "w2", "b2")
    weights = {k: rng.normal(0, 0.45, shape).astype(np.float32) for k, shape in zip(names, nbrdf.SHAPES, strict=True)}
    source = NetworkBRDF("random", weights)
    fitted = fit("nbrdf", source, steps=500)
    assert (fitted.parameters, fitted.bytes, fitted.name) == (675, 2700, "nbrdf")
    assert sphere_mae(source, fitted.eval) < 0.2 * sphere_mae(source, constant(source))


def test_nbrdf_of_the_true_weights_is_the_source(data):
    file = data / "brdf/merl80_nbrdf.npz"
    source = open_brdf(f"{file}:alum-bronze")
    with np.load(file) as archive:
        flat = np.concatenate([archive[f"alum-bronze/{k}"].ravel() for k in ("w0", "b0", "w1", "b1", "w2", "b2")])
    wi, wo = BRDFSampler(source, np.random.default_rng(2)).directions(2000)
    np.testing.assert_allclose(nbrdf.nbrdf_value(flat, wi, wo), source.eval(wi, wo), rtol=2e-5, atol=1e-6)


@pytest.mark.parametrize("name", STEPS)
def test_baselines_beat_a_constant_on_a_measured_material(name, data):
    source = open_brdf(f"{data}/brdf/merl80_nbrdf.npz:blue-acrylic")
    fitted = fit(name, source, steps=150)
    assert sphere_mae(source, fitted.eval) < 0.85 * sphere_mae(source, constant(source))
    samples = BRDFSampler(source, np.random.default_rng(9)).draw(4096)
    loss = LogCosine()
    batch = {key: torch.from_numpy(value) for key, value in samples.items()}
    batch.update(loss.target(batch))
    worth = [
        float(loss(torch.from_numpy(np.ascontiguousarray(f(samples["wi"], samples["wo"]))), batch))
        for f in (fitted.eval, constant(source))
    ]
    assert worth[0] < 0.75 * worth[1]


@pytest.mark.parametrize("name", STEPS)
def test_same_seed_same_fit(name):
    source = open_brdf("analytic:ggx?roughness=0.3&diffuse=0.2")
    first, second, other = (fit(name, source, seed=seed, steps=3) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.weights, second.weights)
    assert not np.array_equal(first.weights, other.weights)
    wi = np.array([[0, 0, 1], [0, 0.6, -0.8]], np.float32)
    value = first.eval(wi, wi[[0, 0]])
    assert value.shape == (2, 3)
    assert (value[0] >= 0).all()
    assert (value[1] == 0).all()


def test_mistakes_are_named():
    source = open_brdf("analytic:ggx?roughness=0.3")
    with pytest.raises(ValueError, match="no baseline 'gxx'; nearest: ggx"):
        fit("gxx", source)
    with pytest.raises(ValueError, match="steps must be a whole number of at least 3, got 0"):
        fit("ggx", source, steps=0)
