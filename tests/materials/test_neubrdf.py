"""The NeuBRDF run-time evaluation against NumPy float64, and what it makes of bad assets and bad directions."""

import numpy as np
import pytest
import warp as wp

from tests.fake_assets import random_neubrdf
from warp_neumat.io.asset import FormatError, write_asset
from warp_neumat.kernels import dispatch
from warp_neumat.materials import load
from warp_neumat.materials.neubrdf import NeuBRDF
from warp_neumat.reference.neubrdf import reference_eval

LAYOUTS = [
    {"hidden": (64, 64), "frame": "isotropic"},
    {"hidden": (24, 40, 7), "frame": "absolute"},  # uneven widths are padded
]

# Worst seen over 20 000 random pairs: 3e-6 of 1 + f (Zen 3). A corner table of random entries amplifies the rounding of
# the direction by nside, a fitted one does not.
TOLERANCE = 2e-5


def _directions(rng, count):
    v = rng.normal(size=(count, 3))
    return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture(params=LAYOUTS, ids=lambda p: p["frame"])
def asset(request, rng):
    return random_neubrdf(rng, **request.param)


def test_neubrdf_kernel_matches_float64(asset, rng, device):
    tensors, header = asset
    wi, wo = _directions(rng, 20_003), _directions(rng, 20_003)
    material = NeuBRDF(tensors, header, device=device)
    got = material.eval(None, wp.array(wi, device=device), wp.array(wo, device=device)).numpy()
    expected = reference_eval(tensors, header["config"], wi, wo) * np.maximum(wi[:, 2:], 0)
    assert expected.max() > 0.5  # the network is alive
    assert (np.abs(got - expected) / (1 + expected)).max() < TOLERANCE


def test_below_horizon_is_zero_and_nothing_is_negative(asset, rng):
    tensors, header = asset
    wi, wo = _directions(rng, 5_000), _directions(rng, 5_000)
    value = NeuBRDF(tensors, header).eval(None, wi, wo)
    below = (wi[:, 2] <= 0) | (wo[:, 2] <= 0)
    assert below.any()
    assert (value[below] == 0).all()
    assert (value >= 0).all()


def test_extreme_directions_give_finite_values(asset):
    tiny = 1e-42
    special = np.array(
        [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [1, 0, tiny], [tiny, 0, 1], [0, 0, tiny], [0, 0, 0],
         [np.nan, 0, 1], [0, 0, np.inf], [3e38, 3e38, 3e38], [0.6, 0, 0.8], [-0.6, 0, 0.8]], np.float32
    )  # fmt: skip
    wi, wo = (special[k.ravel()] for k in np.meshgrid(range(len(special)), range(len(special))))
    value = NeuBRDF(*asset).eval(None, wi, wo)
    assert np.isfinite(value).all()
    assert (value >= 0).all()


def test_isotropic_material_turns_with_its_frame(rng):
    tensors, header = random_neubrdf(rng)
    material = NeuBRDF(tensors, header)
    wi, wo = _directions(rng, 2_000), _directions(rng, 2_000)
    turn = np.array([[np.cos(1.1), -np.sin(1.1), 0], [np.sin(1.1), np.cos(1.1), 0], [0, 0, 1]], np.float32)
    a, b = material.eval(None, wi, wo), material.eval(None, wi @ turn.T, wo @ turn.T)
    assert np.median(np.abs(a - b)) < 1e-5


def test_eval_is_the_same_on_one_worker_and_keeps_the_callers_kind(asset, rng):
    torch = pytest.importorskip("torch")
    material = NeuBRDF(*asset)
    wi, wo = _directions(rng, 3_000), _directions(rng, 3_000)
    several = material.eval(None, wi, wo)
    try:
        dispatch.set_worker_count(1)
        assert np.array_equal(material.eval(None, wi, wo), several)
    finally:
        dispatch.set_worker_count(None)
    got = material.eval(None, torch.from_numpy(wi), torch.from_numpy(wo))
    assert isinstance(got, torch.Tensor)
    assert np.array_equal(got.numpy(), several)
    assert material.eval(None, wi[:0], wo[:0]).shape == (0, 3)


def test_brdf_is_value_without_cosine_at_any_length(asset, rng):
    material = NeuBRDF(*asset)
    wi, wo = _directions(rng, 500), _directions(rng, 500)
    value = material.brdf(wi, wo)
    above = (wi[:, 2] > 0.05) & (wo[:, 2] > 0)
    assert np.allclose(value[above] * wi[above, 2:], material.eval(None, wi, wo)[above], rtol=1e-5)
    assert np.allclose(material.brdf(2 * wi, wo)[above], value[above], rtol=1e-3, atol=1e-4)
    assert (value[~((wi[:, 2] > 0) & (wo[:, 2] > 0))] == 0).all()


def test_eval_names_the_wrong_shape(asset):
    with pytest.raises(ValueError, match=r"wo must have shape \[2, 3\], got \(3, 3\)"):
        NeuBRDF(*asset).eval(None, np.zeros((2, 3)), np.zeros((3, 3)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, h: t.pop("weight1"), "weight1: missing"),
        (lambda t, h: t.update(codebook=t["codebook"][:-1]), r"codebook: must have shape \(64, 8\)"),
        (lambda t, h: t.update(indices=t["indices"][:-1]), "indices: must have shape"),
        (lambda t, h: t.update(bias2=t["bias2"].astype(np.float32)), "bias2: must be float16"),
        (lambda t, h: h["config"].pop("nside"), "config: lacks or misstates 'nside'"),
        (lambda t, h: h["config"].update(nside=0), "config: is out of range"),
        (lambda t, h: h["config"].update(frame="round"), 'config.frame: must be "absolute" or "isotropic"'),
    ],
)
def test_damaged_assets_are_named(rng, tmp_path, change, message):
    tensors, header = random_neubrdf(rng)
    change(tensors, header)
    path = tmp_path / "damaged.neumat"
    write_asset(path, tensors, header)
    with pytest.raises(FormatError, match=message) as caught:
        load(path)
    assert "damaged.neumat" in str(caught.value)


def test_truncated_asset_is_one_line(rng, tmp_path):
    path = tmp_path / "short.neumat"
    write_asset(path, *random_neubrdf(rng))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(FormatError, match="short.neumat") as caught:
        load(path)
    assert "\n" not in str(caught.value)
