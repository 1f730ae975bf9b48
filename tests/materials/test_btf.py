"""BTF at run time against float64, and what it makes of bad assets, directions and texture coordinates."""

import functools

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fake_assets import random_btf
from tests.kernels.test_btf import directions, quad_uv
from warp_neumat.io.asset import FormatError, write_asset
from warp_neumat.materials import load
from warp_neumat.materials.btf import BTF
from warp_neumat.reference import btf as reference

# The paper's student, what it is compared with, and odd sizes; few, because each is compiled.
LAYOUTS = {
    "coarse-to-fine": {},
    "400 wide": {"width": 400, "height": 300},
    "bc6h": {"features": "bc6h", "width": 21, "height": 13},
    "single level": {"coarse": None, "fine": 30, "hidden": [8] * 7},
    "neumip": {"coarse": None, "fine": 14, "hidden": [25] * 5},
    "teacher": {"coarse": None, "fine": 14, "hidden": [128] * 4, "mips": 1},
    "odd": {"half_vector": False, "fine": 3, "hidden": [17], "coarse": (9, [5, 12], 3), "width": 7, "height": 50},
}

# Worst seen over 40 000 rows and quads at uv to ±8, of textures to 1024²: 1.6e-6 of the largest value for rows, 5.4e-6
# for quads, whose mean uv is rounded to float32 (Zen 3).
TOLERANCE = 1e-5


@functools.cache
def made(name):
    tensors, header = random_btf(np.random.default_rng(11), **LAYOUTS[name])
    return tensors, BTF(tensors, header)


def _samples(rng, n, mips):
    lod = rng.integers(-1, mips + 1, n) + rng.uniform(-0.4, 0.4, n)
    return directions(rng, n), directions(rng, n), lod.astype(np.float32)


@pytest.mark.parametrize("name", LAYOUTS)
def test_rows_match_float64(rng, name):
    tensors, material = made(name)
    wi, wo, lod = _samples(rng, 1003, material.config["mips"])
    wi[::50, 2] *= -1
    wo[7::50, 2] *= -1
    uv = rng.uniform(-8, 8, (1003, 2)).astype(np.float32)
    got = material.eval(uv, wi, wo, lod)
    expected = reference.btf_rows(tensors, material.config, uv, wi, wo, lod)
    assert expected.std() > 0.02
    assert np.abs(got - expected).max() < TOLERANCE * expected.max()
    assert (got[::50] == 0).all()
    assert (got[7::50] == 0).all()


@pytest.mark.parametrize("name", ["coarse-to-fine", "400 wide", "bc6h", "single level", "odd"])
def test_quads_match_float64(rng, name):
    tensors, material = made(name)
    wi, wo, lod = _samples(rng, 515, material.config["mips"])
    wi[::50, 2] *= -1
    uv = quad_uv(rng, 515, 3 / max(material.config["width"], material.config["height"]))
    uv += rng.integers(-8, 8, (515, 1, 2)).astype(np.float32)
    got = material.eval_quads(uv, wi, wo, lod)
    expected = reference.btf_quads(tensors, material.config, uv, wi, wo, lod)
    assert got.shape == (515, 4, 3)
    assert np.abs(got - expected).max() < TOLERANCE * expected.max()
    assert (got[::50] == 0).all()


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (5, 400)])
def test_places_on_centres_and_borders_of_texels_match_float64(rng, size):
    """And one step of float32 beside them, periods away, where a rounded product may fall into the next texel."""
    tensors, header = random_btf(rng, width=size[0], height=size[1], mips=1)
    material, axes = BTF(tensors, header), []
    for n in size:
        on = (np.arange(-4 * n, 4 * n + 1) / (2 * n)).astype(np.float32)
        axes.append(np.concatenate([on, np.nextafter(on, np.float32(9)), np.nextafter(on, np.float32(-9))]))
    uv = np.stack([rng.choice(axis, 5000) for axis in axes], 1)
    wi, wo, _ = _samples(rng, 5000, 1)
    expected = reference.btf_rows(tensors, material.config, uv, wi, wo)
    assert np.abs(material.eval(uv, wi, wo) - expected).max() < TOLERANCE * expected.max()


def test_quads_of_one_place_are_rows(rng):
    """Four texels at one place see the same coarse features as a row there."""
    _, material = made("coarse-to-fine")
    wi, wo, lod = _samples(rng, 200, 3)
    uv = rng.random((200, 2)).astype(np.float32)
    rows = material.eval(uv, wi, wo, lod)
    quads = material.eval_quads(np.repeat(uv[:, None], 4, 1), wi, wo, lod)
    assert np.abs(quads - rows[:, None]).max() < 1e-6 + 1e-5 * rows.max()


def test_quads_share_coarse_features(rng):
    """Within a quad the coarse texture is read once: quads differ from rows, and single levels do not."""
    for name, differs in (("coarse-to-fine", True), ("single level", False)):
        _, material = made(name)
        wi, wo, lod = _samples(rng, 200, 3)
        uv = quad_uv(rng, 200)
        quads = material.eval_quads(uv, wi, wo, lod)
        rows = material.eval(uv.reshape(-1, 2), *(x.repeat(4, 0) for x in (wi, wo, lod))).reshape(-1, 4, 3)
        assert (np.abs(quads - rows).max() > 0.01) == differs


numbers = st.one_of(
    st.floats(width=32), st.sampled_from([0.0, -0.0, 1e-45, -1e-45, 1e-38, 3e38, -3e38, 1e30, 1.0, -1.0])
)
triples = st.lists(st.tuples(numbers, numbers, numbers), min_size=3, max_size=3)


@settings(max_examples=150, deadline=None)
@given(triples, triples, st.lists(numbers, min_size=12, max_size=12), st.floats(width=32))
def test_no_input_gives_a_nan_or_a_negative_value(wi, wo, places, lod):
    wi[2] = tuple(-c for c in wo[2])  # opposite directions
    wi, wo = np.array(wi, np.float32), np.array(wo, np.float32)
    uv = np.array(places, np.float32)
    for name in ("coarse-to-fine", "single level"):
        _, material = made(name)
        for got in (
            material.eval(uv[:6].reshape(3, 2), wi, wo, lod),
            material.eval_quads(np.resize(uv, (3, 4, 2)), wi, wo, np.full(3, lod, np.float32)),
        ):
            assert np.isfinite(got).all()
            assert (got >= 0).all()


def test_weights_at_the_end_of_float16_stay_finite(rng):
    tensors, header = random_btf(rng)
    for name, tensor in tensors.items():
        tensor[...] = np.where(rng.random(tensor.shape) < 0.5, 65504, -65504)
        if "mip" in name:
            tensor[...] = 65504
    material = BTF(tensors, header)
    wi, wo, lod = _samples(rng, 300, 3)
    got = material.eval_quads(quad_uv(rng, 300), wi, wo, lod)
    assert np.isfinite(got).all()
    assert (got >= 0).all()


def test_texture_coordinates_that_are_not_finite_count_as_zero(rng):
    _, material = made("coarse-to-fine")
    wi, wo, _ = _samples(rng, 4, 3)
    bad = np.array([[np.nan, 0.3], [0.3, np.inf], [-np.inf, 0.3], [1e30, 0.3]], np.float32)
    good = np.array([[0, 0.3], [0.3, 0], [0, 0.3], [0, 0.3]], np.float32)
    assert np.array_equal(material.eval(bad, wi, wo), material.eval(good, wi, wo))


def test_every_kind_of_array_gives_the_same(rng):
    torch = pytest.importorskip("torch")
    _, material = made("coarse-to-fine")
    wi, wo, lod = _samples(rng, 65, 3)
    uv = quad_uv(rng, 65)
    expected = material.eval_quads(uv, wi, wo, lod)
    ours = material.eval_quads(*(torch.from_numpy(x) for x in (uv, wi, wo, lod)))
    assert isinstance(ours, torch.Tensor)
    assert np.array_equal(ours.numpy(), expected)
    ours = material.eval_quads(*(wp.array(x, dtype=wp.float32, device="cpu") for x in (uv, wi, wo, lod)))
    assert isinstance(ours, wp.array)
    assert np.array_equal(ours.numpy(), expected)
    assert material.eval(uv[:0, 0], wi[:0], wo[:0]).shape == (0, 3)
    assert material.eval_quads(uv[:0], wi[:0], wo[:0]).shape == (0, 4, 3)


def test_wrong_arguments_are_named(rng):
    _, material = made("coarse-to-fine")
    wi, wo, _ = _samples(rng, 5, 3)
    uv = rng.random((5, 2)).astype(np.float32)
    with pytest.raises(ValueError, match=r"wo must have shape \[5, 3\], got \(4, 3\)"):
        material.eval(uv, wi, wo[:4])
    with pytest.raises(ValueError, match="uv must be given for asset, which varies in space"):
        material.eval(None, wi, wo)
    with pytest.raises(ValueError, match=r"uv must have shape \[5, 4, 2\]"):
        material.eval_quads(uv, wi, wo)
    with pytest.raises(ValueError, match=r"lod must have shape \[5\]"):
        material.eval(uv, wi, wo, np.zeros(3, np.float32))


def test_an_asset_is_opened_by_its_kind(rng, tmp_path):
    tensors, header = random_btf(rng)
    write_asset(tmp_path / "cloth.neumat", tensors, header)
    material = load(tmp_path / "cloth.neumat")
    assert (material.kind, material.name, material.weights) == ("btf", "cloth", 779)
    assert material.bytes == sum(t.nbytes for t in tensors.values())
    assert material.shader().texels == (32, 24)


def _broken(change):
    tensors, header = random_btf(np.random.default_rng(0))
    change(tensors, header["config"])
    return tensors, header


BROKEN = {
    r"config.width: must be a whole number from 1 to 65535, got 0": lambda t, c: c.update(width=0),
    r"config.mips: must be a whole number from 1 to 6, got 7": lambda t, c: c.update(mips=7),
    r"config.fine: must be an object, got None": lambda t, c: c.update(fine=None),
    r"config.coarse: must be an object or null, got 3": lambda t, c: c.update(coarse=3),
    r"config.coarse: is missing": lambda t, c: c.pop("coarse"),
    r"config.fine.channels: must be a whole number": lambda t, c: c["fine"].update(channels=True),
    r"config.fine.hidden: must be 1 to 16 widths, each from 1 to 512, got \[\]": lambda t, c: c["fine"].update(
        hidden=[]
    ),
    r"config.coarse.hidden: must be 1 to 16 widths": lambda t, c: c["coarse"].update(hidden=[8.0]),
    r"config.coarse.latent: must be a whole number": lambda t, c: c["coarse"].pop("latent"),
    r"config.half_vector: must be true or false, got 1": lambda t, c: c.update(half_vector=1),
    r"config.features: must be one of half, bc6h, got 'float'": lambda t, c: c.update(features="float"),
    r"fine.weight0: ": lambda t, c: t.pop("fine.weight0"),
    r"coarse.bias3: ": lambda t, c: t.update({"coarse.bias3": t["coarse.bias3"][:7]}),
    r"fine.mip1: ": lambda t, c: t.update({"fine.mip1": t["fine.mip1"].astype(np.float32)}),
    r"coarse.mip0: ": lambda t, c: t.update({"coarse.mip0": t["fine.mip0"]}),
    r"fine.mip2: must be finite": lambda t, c: t["fine.mip2"].fill(np.nan),
    r"coarse.weight1: must be finite": lambda t, c: t["coarse.weight1"].fill(np.inf),
    r"coarse.block0.mip0: missing": lambda t, c: c.update(features="bc6h"),
}


@pytest.mark.parametrize("rule", BROKEN)
def test_a_bad_asset_is_one_readable_line(rule):
    tensors, header = _broken(BROKEN[rule])
    with pytest.raises(FormatError, match=rule) as caught:
        BTF(tensors, header)
    assert "\n" not in str(caught.value)


def test_a_config_that_is_no_object_is_refused():
    with pytest.raises(FormatError, match="config: must be an object"):
        BTF({}, {"kind": "btf", "version": 1})
