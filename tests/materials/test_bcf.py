"""BCf at run time against float64; strange places and scales; what it says about bad assets."""

import copy

import numpy as np
import pytest
import warp as wp

from tests.fake_assets import fake_bcf, random_bcf
from warp_neumat.io.asset import FormatError
from warp_neumat.kernels import bcf as kernels
from warp_neumat.kernels import dispatch
from warp_neumat.materials import load
from warp_neumat.materials.bcf import BCf
from warp_neumat.reference import bcf as reference


@pytest.fixture
def asset(rng):
    return random_bcf(rng, size=64, features=(32, 16, 8, 4), channels=13)


def exact(asset, uv, lod):
    tensors, header = asset
    weights, biases = ([tensors[f"{name}{n}"] for n in range(2)] for name in ("weight", "bias"))
    config = header["config"]
    return reference.encoded(reference.decoded(tensors, config), weights, biases, config, uv, lod)


def places(rng, count):
    return rng.random((count, 2)).astype(np.float32), (rng.random(count) * 7 - 0.5).astype(np.float32)


def test_encoded_matches_float64(asset, rng, device):
    uv, lod = places(rng, 5_003)
    got = BCf(*asset, device=device).encoded(wp.array(uv, device=device), wp.array(lod, device=device)).numpy()
    expected = exact(asset, uv, lod)
    assert got.dtype == np.float32
    assert ((expected > 0.01) & (expected < 0.99)).mean() > 0.3  # the network is alive
    # Worst seen 5e-6, of features up to 180 (Zen 3).
    assert np.abs(got - expected).max() < 2e-5


def test_maps_match_float64(asset, rng, device):
    uv, lod = places(rng, 2_000)
    config = asset[1]["config"]
    got = BCf(*asset, device=device).maps(wp.array(uv, device=device), wp.array(lod, device=device))
    y = exact(asset, uv, lod)
    expected = reference.maps(y, config)
    assert list(got) == [*dict.fromkeys(c["map"] for c in config["channels"]), "specular"]
    assert got["specular"].shape == (2_000, 1)
    normal = got["normal"].numpy()
    assert np.allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-6)
    for name, value in expected.items():
        # Where a normal lies in the plane, z = √(1 − x² − y²) turns an error ε into √ε.
        worst = np.abs(got[name].numpy() - value)
        if name == "normal":
            worst = worst[value[:, 2] > 0.1]
        assert worst.max() < 4e-5, name


def test_maps_keep_their_ranges(rng):
    tensors, header = random_bcf(rng, channels=9)
    tensors["weight1"][:] = 0
    tensors["bias1"][:] = [0, 1, 0.5, 0.5, 0.5, 1, 0, 2, -1]
    header["config"]["channels"][5]["range"] = [0.2, 3.0]
    maps = BCf(tensors, header).maps(np.zeros((1, 2), np.float32), 0.0)
    assert np.allclose(maps["base_color"], [[0, 1, 0.21404114]], atol=1e-6)
    assert np.allclose(maps["normal"], [[0, 0, 1]], atol=1e-6)
    assert np.allclose(maps["roughness"], 3.0)
    assert np.allclose(maps["metallic"], 0.0)
    assert np.allclose(maps["occlusion"], 1.0)
    assert np.allclose(maps["displacement"], 0.25)


def test_every_kind_of_array_comes_back_as_it_went_in(asset, rng):
    torch = pytest.importorskip("torch")
    material = BCf(*asset)
    uv, lod = places(rng, 300)
    expected = material.encoded(uv, lod)
    assert isinstance(expected, np.ndarray)
    assert torch.equal(material.encoded(torch.from_numpy(uv), torch.from_numpy(lod)), torch.from_numpy(expected))
    assert (material.encoded(wp.array(uv), wp.array(lod)).numpy() == expected).all()
    assert isinstance(material.maps(torch.from_numpy(uv), 1.0)["specular"], torch.Tensor)
    assert (material.encoded(uv, np.full(300, 1.5, np.float32)) == material.encoded(uv, 1.5)).all()
    assert material.encoded(uv[:0], lod[:0]).shape == (0, 13)
    assert {k: v.shape for k, v in material.maps(uv[:0], 0).items()}["normal"] == (0, 3)


def test_workers_do_not_change_a_bit(asset, rng):
    uv, lod = places(rng, 20_001)
    material = BCf(*asset)
    try:
        dispatch.set_worker_count(1)
        one = material.encoded(uv, lod)
        dispatch.set_worker_count(3)
        assert (material.encoded(uv, lod) == one).all()
    finally:
        dispatch.set_worker_count(None)


@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
def test_strange_places_and_scales_have_defined_results(rng, wrap, device):
    asset = random_bcf(rng, wrap=wrap)
    special = np.array(
        [0, -0.0, 1, -1, 0.5, 1e-30, -1e-30, -1e-9, 1 - 2**-24, 2**24 + 2, -(2.0**24), 3e38, -3e38,
         np.inf, -np.inf, np.nan, 2**23 + 0.5], np.float32
    )  # fmt: skip
    uv = np.stack([k.ravel() for k in np.meshgrid(special, special)], axis=1)
    lod = np.array([-np.inf, -1e30, -1, 0, 0.5, 5, 100, 1e30, np.inf, np.nan], np.float32)
    uv, lod = np.repeat(uv, len(lod), axis=0), np.tile(lod, len(uv))
    for storage in ("unquantised", "blocks") if wrap == "repeat" else ("unquantised",):
        material = BCf(*asset, device=device, storage=storage)
        got = material.encoded(wp.array(uv, device=device), wp.array(lod, device=device)).numpy()
        assert np.abs(got - exact(asset, uv, lod)).max() < 2e-5
        for value in material.maps(wp.array(uv, device=device), wp.array(lod, device=device)).values():
            assert np.isfinite(value.numpy()).all()


def test_a_material_opens_from_its_file(tmp_path):
    header = fake_bcf(tmp_path / "stone.neumat", seed=4, channels=5)
    material = load(tmp_path / "stone.neumat")
    assert (material.kind, material.name) == ("bcf", "stone")
    assert material.channels == header["config"]["channels"]
    assert [(t.width, t.mips, t.format) for t in material.textures] == [
        (32, 6, "bc6h_uf16"), (16, 5, "bc6h_uf16"), (8, 4, "bc6h_uf16"), (4, 3, "bc6h_uf16"),
    ]  # fmt: skip
    weights = 2 * (16 * 12 + 16 + 5 * 16 + 5)
    assert material.bytes == weights + sum(t.nbytes for t in material.textures)


def test_materials_share_buffers(rng):
    # Two materials in one texel, level and weight buffer differ in two offsets.
    assets = [random_bcf(rng), random_bcf(rng)]
    alone = [BCf(*a) for a in assets]
    uv, lod = places(rng, 700)
    expected = [m.encoded(uv, lod) for m in alone]
    first, second = (m._arguments for m in alone)
    levels = second.levels.numpy().reshape(4, -1).copy()
    levels[:, 4:] += first.texels.shape[0] // 64
    joined = {
        "texels": np.concatenate([first.texels.numpy(), second.texels.numpy()]),
        "tables": first.tables.numpy(),
        "levels": np.concatenate([first.levels.numpy(), levels.ravel()]),
        "weights": np.concatenate([first.weights.numpy(), second.weights.numpy()]),
    }
    both = kernels.device_arrays(joined, "cpu")
    for material, want in zip(alone, expected, strict=True):
        material._arguments = both
        assert (material.encoded(uv, lod) == want).all()
        both.level_at, both.weight_at = first.levels.shape[0], first.weights.shape[0]


def test_eval_shades_the_decoded_maps(asset, rng):
    uv, _ = places(rng, 400)
    w = rng.normal(size=(2, 400, 3)).astype(np.float32)
    value = BCf(*asset).eval(uv, w[0], w[1])
    below = (w[:, :, 2] <= 0).any(axis=0)
    assert (value[below] == 0).all()
    assert np.isfinite(value).all()
    assert (value >= 0).all()
    assert (value[~below] > 0).any()


# ---- bad assets ------------------------------------------------------------------------------------------------------


def spoil(change):
    def apply(tensors, header):
        change(tensors, header["config"])

    return apply


BAD = {
    "config: must be an object": lambda t, h: h.pop("config"),
    "config.width: must be a whole number from 1": spoil(lambda t, c: c.update(width=0)),
    "config.hidden: must be a whole number from 1 to 512, got 16.5": spoil(lambda t, c: c.update(hidden=16.5)),
    "config.signed: must be true or false": spoil(lambda t, c: c.update(signed=0)),
    "config.wrap: must be one of repeat, clamp, mirror, got 'wrap'": spoil(lambda t, c: c.update(wrap="wrap")),
    r"config.textures: must list 1 to 64 textures, got \[\]": spoil(lambda t, c: c.update(textures=[])),
    r"config.textures\[1\].mips: must be a whole number from 1 to 5, got 6": spoil(
        lambda t, c: c["textures"][1].update(mips=6)
    ),
    "config.channels: must list 1 to 16": spoil(lambda t, c: c.update(channels=c["channels"] * 2)),
    r"config.channels\[0\].map: must be a name": spoil(lambda t, c: c["channels"][0].pop("map")),
    r"config.channels\[3\].component: must be one of a, b, g, r, value, x, y, got 'z'": spoil(
        lambda t, c: c["channels"][3].update(component="z")
    ),
    r"config.channels\[0\].encoding: must be one of linear, srgb, normal, got 'sRGB'": spoil(
        lambda t, c: c["channels"][0].update(encoding="sRGB")
    ),
    r"config.channels\[5\].range: must be 2 finite numbers, got \[0.0, nan\]": spoil(
        lambda t, c: c["channels"][5].update(range=[0.0, float("nan")])
    ),
    r"components of base_color must be value, x y, or r g \(b \(a\)\), got b, g": spoil(
        lambda t, c: c["channels"].pop(0)
    ),
    "normal must have one encoding, normal for x and y alone, got linear, normal": spoil(
        lambda t, c: c["channels"][3].update(encoding="linear")
    ),
    "config.constants.roughness: is also a map of the channels": spoil(
        lambda t, c: c["constants"].update(roughness=[1])
    ),
    "config.constants.sheen: must be 1 or 2 or 3 or 4 finite numbers": spoil(
        lambda t, c: c["constants"].update(sheen=0.5)
    ),
    "texture2.mip1: missing": spoil(lambda t, c: t.pop("texture2.mip1")),
    r"texture0.mip0: must have shape \(8, 8, 16\), got \(8, 4, 16\)": spoil(
        lambda t, c: t.update({"texture0.mip0": t["texture0.mip0"][:, :4]})
    ),
    r"weight0: must have shape \(16, 12\), got \(16, 9\)": spoil(lambda t, c: t.update(weight0=t["weight0"][:, :9])),
    "bias1: must be float16, got float32": spoil(lambda t, c: t.update(bias1=t["bias1"].astype(np.float32))),
}


@pytest.mark.parametrize("message", BAD)
def test_a_bad_asset_is_named(message, rng, tmp_path):
    tensors, header = random_bcf(rng)
    header = copy.deepcopy(header)
    BAD[message](tensors, header)
    with pytest.raises(FormatError, match=message) as caught:
        BCf(tensors, header, path=tmp_path / "x.neumat")
    assert "\n" not in str(caught.value)


def test_a_block_that_decodes_to_infinity_is_refused(rng):
    tensors, header = random_bcf(rng, signed=True, modes=[14])
    tensors["texture1.mip0"][0, 0] = np.frombuffer(bytes([0x0F, 0, 0, 0, 0x80, 0, 0, 0]) + bytes(8), np.uint8)
    block = np.zeros(128, np.uint8)
    block[:5] = [1, 1, 1, 1, 0]
    block[39] = 1  # the sign of red's first endpoint, all other bits 0: −32768
    tensors["texture1.mip0"][0, 0] = np.packbits(block, bitorder="little")
    with pytest.raises(FormatError, match="decodes to −∞"):
        BCf(tensors, header)


def test_bad_arguments_are_named(asset, rng):
    material = BCf(*asset)
    with pytest.raises(ValueError, match="storage must be one of blocks, unquantised, half, got 'fp16'"):
        BCf(*asset, storage="fp16")
    with pytest.raises(ValueError, match=r"uv must have shape \[n, 2\], got \(4, 3\)"):
        material.encoded(np.zeros((4, 3), np.float32), 0)
    with pytest.raises(ValueError, match=r"lod must have shape \[4\], got \(3,\)"):
        material.encoded(np.zeros((4, 2), np.float32), np.zeros(3, np.float32))
