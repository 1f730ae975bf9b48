"""The proxy predicts how much materials change under small turns: rank and size against the materials themselves."""

import dataclasses

import numpy as np
import pytest

from tests.fake_assets import random_bcf, random_btf, random_neubrdf
from warp_neumat.io.brdf import open_brdf
from warp_neumat.kernels.proxy import proxy_eval
from warp_neumat.materials import load
from warp_neumat.materials.bcf import BCf
from warp_neumat.materials.btf import BTF
from warp_neumat.materials.neubrdf import NeuBRDF
from warp_neumat.materials.proxy import CEILING, Proxy, fit_proxy, turned_pairs
from warp_neumat.pipeline.demo import material_paths

LUMINANCE = np.float64([0.2126, 0.7152, 0.0722])


class Source:
    """A reflectance as a material: what ``fit_proxy`` needs of one."""

    def __init__(self, spec):
        self.source = open_brdf(spec)

    def eval(self, uv, wi, wo):
        return self.source.eval(wi, wo) * np.maximum(wi[:, 2:], 0)


class Formula:
    """Value × cosine by a function of (uv, wi, wo)."""

    def __init__(self, function):
        self.function = function

    def eval(self, uv, wi, wo):
        return self.function(uv, wi, wo)


def changes(rng, material, found, centred, count=8000, white=1.0):
    """Return true and predicted |Δ√Y| of small turns, Y at most ``white``, uniform directions or ``centred``."""
    lights, viewers, _ = turned_pairs(2 * count, rng.random((2 * count, 7)))
    lights, viewers = (d[:, int(centred) :: 2] for d in (lights, viewers))
    uv = np.full((lights.shape[1], 2), 0.37, np.float32)

    def root(y):
        return np.sqrt(np.minimum(np.pi * y, white))

    true = [root(material.eval(uv, i, o).astype(np.float64) @ LUMINANCE) for i, o in zip(lights, viewers, strict=True)]
    made = [root(proxy_eval(found.params, (0.0, 0.0, 1.0), i, o)) for i, o in zip(lights, viewers, strict=True)]
    above = (lights[..., 2] > 0).all(0) & (viewers[..., 2] > 0).all(0)
    return np.abs(true[1] - true[0])[above], np.abs(made[1] - made[0])[above]


def rank_correlation(a, b):
    """Return Spearman's ρ; ties share their mean rank."""

    def ranks(x):
        _, inverse, counts = np.unique(x, return_inverse=True, return_counts=True)
        return (np.cumsum(counts) - 0.5 * (counts + 1))[inverse]

    return np.corrcoef(ranks(a), ranks(b))[0, 1]


def painted():
    """A BCf of smooth lacquer whose colour alone varies."""
    constants = {"specular": [0.5], "roughness": [0.3], "metallic": [0.0]}
    return BCf(*random_bcf(np.random.default_rng(5), channels=3, constants=constants))


# Material, then least ρ and largest |ln(predicted size/true size)|, for uniform directions and for those about the
# highlight. Measured ρ and ln, Zen 3: bronze 0.874 -0.041, 0.993 -0.008; lacquer 0.970 -0.003, 0.993 -0.013; mirror
# 1.000 -0.001, 1.000 -0.002; matt 1.000 -0.001, 0.999 -0.016; lambert 1.000 0.000, 1.000 -0.000; painted BCf 0.992
# 0.054, 0.965 -0.145 (one place of its colours, the mean of which was fitted). Bronze's 0.874 are ranks among changes
# far from its highlight, where the asset is a fit itself.
FOLLOWED = {
    "bronze": (lambda: load(material_paths()["knot"]), (0.82, 0.1), (0.97, 0.05)),
    "lacquer": (lambda: load(material_paths()["cloth"]), (0.93, 0.05), (0.97, 0.06)),
    "mirror": (lambda: Source("analytic:ggx?roughness=0.12&f0=0.9&diffuse=0"), (0.99, 0.02), (0.99, 0.02)),
    "matt": (lambda: Source("analytic:ggx?roughness=0.9&f0=0.04&diffuse=0.5,0.4,0.3"), (0.99, 0.02), (0.99, 0.05)),
    "lambert": (lambda: Source("analytic:lambert?albedo=0.8,0.6,0.4"), (0.99, 0.01), (0.99, 0.01)),
    "painted bcf": (painted, (0.97, 0.15), (0.92, 0.25)),
}


@pytest.mark.parametrize("name", FOLLOWED)
def test_changes_rank_as_the_material_s(rng, name):
    make, *bounds = FOLLOWED[name]
    material = make()
    found = fit_proxy(material)
    for centred, (least, most) in enumerate(bounds):
        true, predicted = changes(rng, material, found, centred)
        assert true.mean() > 1e-3
        rho, size = rank_correlation(true, predicted), np.log(predicted.mean() / true.mean())
        assert rho > least
        assert abs(size) < most


MEASURED = ("brass", "pink-fabric", "white-acrylic", "yellow-paint")


def test_measured_materials_on_average(rng, data):
    rhos = []
    for name in MEASURED:
        material = Source(f"{data / 'brdf' / 'merl80_nbrdf.npz'}:{name}")
        found = fit_proxy(material)
        for centred in (False, True):
            rhos.append(rank_correlation(*changes(rng, material, found, centred, 4000)))
    # Measured: uniform 0.55, 0.86, 0.86, 0.89; about the highlight 0.91, 0.82, 0.88, 0.63; mean 0.80.
    assert np.mean(rhos) > 0.75
    assert min(rhos) > 0.48


@pytest.mark.parametrize(
    ("roughness", "f0", "diffuse"), [(0.15, 0.05, 0.3), (0.38, 0.6, 0.0), (0.5, 0.04, 0.5), (0.8, 0.3, 0.1)]
)
def test_its_own_family_is_recovered(roughness, f0, diffuse):
    spec = f"analytic:ggx?roughness={roughness}&f0={f0},{f0},{f0}&diffuse={diffuse},{diffuse},{diffuse}"
    found = fit_proxy(Source(spec))
    assert found.fresnel
    assert found.roughness == pytest.approx(roughness, rel=0.06)
    assert found.specular == pytest.approx(f0, rel=0.15)
    assert found.diffuse == pytest.approx(diffuse, abs=0.04)
    assert found.error < 0.08


def test_a_scaled_material_is_scaled():
    """Diffuse alone: twice the albedo is twice the number, and √2 in the change."""
    one, two = (fit_proxy(Source(f"analytic:lambert?albedo={a},{a},{a}")) for a in (0.3, 0.6))
    assert one.diffuse == pytest.approx(0.3, rel=0.01)
    assert two.diffuse == pytest.approx(0.6, rel=0.01)
    assert two.luminance == pytest.approx(2 * one.luminance, rel=1e-4)
    assert one.luminance == pytest.approx(0.15, rel=0.02)
    assert max(one.error, two.error) < 0.02


@pytest.mark.parametrize("kind", ["neubrdf", "textured neubrdf", "bcf", "btf"])
def test_every_kind_gets_one(kind):
    rng = np.random.default_rng(3)
    material = {
        "neubrdf": lambda: NeuBRDF(*random_neubrdf(rng)),
        "textured neubrdf": lambda: NeuBRDF(*random_neubrdf(rng, texture=(32, 32, 8, 4))),
        "bcf": lambda: BCf(*random_bcf(rng, channels=3)),
        "btf": lambda: BTF(*random_btf(rng)),
    }[kind]()
    found = fit_proxy(material)
    assert np.isfinite(np.concatenate([np.ravel(v) for v in dataclasses.astuple(found)])).all()
    # Noise in every direction: nothing follows it, but no change at all (error 1) would be a worse answer.
    assert 0 < found.error < 1
    assert found.diffuse + found.specular > 0
    assert found.luminance > 0
    assert fit_proxy(material) == found


def test_varying_colour_is_averaged_over_uv():
    """Two albedos in equal parts of uv: the mean of √Y, so a diffuse term near the square of the mean root."""

    def striped(uv, wi, wo):
        albedo = np.where(uv[:, 0] < 0.5, 0.1, 0.9)
        return np.repeat((albedo / np.pi * np.maximum(wi[:, 2], 0) * (wo[:, 2] > 0))[:, None], 3, axis=1)

    found = fit_proxy(Formula(striped))
    assert found.diffuse == pytest.approx((0.5 * (np.sqrt(0.1) + np.sqrt(0.9))) ** 2, rel=0.05)
    assert found.error > 0.2


def test_lod_is_used_where_there_is_one():
    levels = []

    class Levelled:
        def eval(self, uv, wi, wo, lod=0.0):
            levels.append(lod)
            return np.zeros((len(wi), 3), np.float32)

    fit_proxy(Levelled())
    assert set(levels) == {2.0}


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0])
def test_what_is_no_light_gives_zeros(value):
    found = fit_proxy(Formula(lambda uv, wi, wo: np.full((len(wi), 3), value, np.float32)))
    assert found == Proxy(0.0, 0.0, 1.0, False, 0.0, 0.0)
    assert not proxy_eval(found.params, (0.0, 0.0, 1.0), np.eye(3), np.eye(3)).any()


@pytest.mark.parametrize("value", [1e-12, 1e-4, 0.3, 1e4, 1e30])
def test_extreme_sizes_stay_finite(value):
    """The same everywhere, even below the horizon, and from next to nothing to far above the ceiling."""
    found = fit_proxy(Formula(lambda uv, wi, wo: np.full((len(wi), 3), value, np.float32)))
    assert np.isfinite(np.concatenate([np.ravel(v) for v in dataclasses.astuple(found)])).all()
    assert min(found.diffuse, found.specular) >= 0
    assert 0 < found.roughness <= 1


def test_a_second_broad_lobe_leaves_the_highlight(rng):
    """A sharp coat over a rough metal: about the highlight, the change is still that of the coat."""

    def coated(uv, wi, wo):
        lobes = ((0.05, 0.04, 0.03**2), (0.0, 0.3, 0.35**2))
        return np.repeat(sum(proxy_eval(p, (0.0, 0.0, 1.0), wi, wo) for p in lobes)[:, None], 3, axis=1)

    material = Formula(coated)
    true, predicted = changes(rng, material, fit_proxy(material), True, white=CEILING)
    assert rank_correlation(true, predicted) > 0.7
    assert 0.7 < predicted.mean() / true.mean() < 1.4


def test_each_channel_has_its_own_colour_of_one_lobe():
    """Coloured base under a coloured lobe: what is fitted per channel are the factors that made it."""
    base, lobe, alpha2 = np.array([0.6, 0.3, 0.05]), np.array([0.02, 0.2, 0.5]), 0.3**4

    def formula(uv, wi, wo):
        parts = [proxy_eval(p, (0.0, 0.0, 1.0), wi, wo)[:, None] for p in ((1.0, 0.0, alpha2), (0.0, 1.0, alpha2))]
        return parts[0] * base + parts[1] * lobe

    found = fit_proxy(Formula(formula))
    diffuse, specular, grazing = np.array(found.colors)
    np.testing.assert_allclose(diffuse, base, atol=0.02)
    np.testing.assert_allclose(specular, lobe, rtol=0.1, atol=0.01)
    assert grazing.max() < 0.1
    assert found.color_terms == (*diffuse, *specular, *grazing, found.roughness**4)
    assert len(found.color_terms) == 10


@pytest.mark.parametrize("name", ["bronze", "lacquer", "matt"])
def test_colours_follow_the_channels_of_the_material(rng, name):
    """√ of each channel, over uniform directions: the proxies' error against what the material shows."""
    material = FOLLOWED[name][0]()
    found = fit_proxy(material)
    lights, viewers, _ = turned_pairs(4000, rng.random((4000, 7)))
    lights, viewers = lights[0, ::2], viewers[0, ::2]
    true = np.minimum(np.pi * material.eval(np.full((len(lights), 2), 0.37, np.float32), lights, viewers), 1)
    d, s, g = np.array(found.colors)[:, None]
    up, alpha2 = (0.0, 0.0, 1.0), found.roughness**4
    cosine, lobe = (proxy_eval((a, b, alpha2), up, lights, viewers)[:, None] for a, b in ((1, 0), (0, 1)))
    grazing = np.maximum(1 - 0.5 * np.linalg.norm(lights + viewers, axis=1, keepdims=True), 0) ** 5
    made = np.minimum(np.pi * (d * cosine + (s + g * grazing) * lobe), 1)
    error = np.sqrt(np.maximum(made, 0)) - np.sqrt(np.maximum(true, 0))
    size = np.sqrt((true**2).mean())
    assert np.sqrt((error**2).mean()) < 0.05 * size  # seen: 0.027, 0.011, 0.003


@pytest.mark.parametrize("specular", [0.0, 0.04, 0.7, 1.3])
@pytest.mark.parametrize("fresnel", [False, True])
def test_luminance_terms_say_what_params_say(rng, specular, fresnel):
    found = Proxy(0.3, specular, 0.6, fresnel and specular > 0, 0.2, 0.1)
    diffuse, size, grazing, alpha2 = found.luminance_terms
    wi, wo = (rng.normal(size=(500, 3)) for _ in range(2))
    wi, wo = (np.abs(w / np.linalg.norm(w, axis=1, keepdims=True)).astype(np.float32) for w in (wi, wo))
    up = (0.0, 0.0, 1.0)
    cosine, lobe = (proxy_eval((a, b, alpha2), up, wi, wo) for a, b in ((1, 0), (0, 1)))
    rise = np.maximum(1 - 0.5 * np.linalg.norm(wi + wo, axis=1), 0) ** 5
    expected = diffuse * cosine + (size + grazing * rise) * lobe
    np.testing.assert_allclose(proxy_eval(found.params, up, wi, wo), expected, rtol=1e-4, atol=1e-6)
