"""The model in plain torch: Eq. 9 against real half floats, gradients against differences, blocks out and in again."""

import types
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from warp_neumat.io.mipmaps import mip_sizes  # noqa: E402
from warp_neumat.kernels.bc6h import bc6h_decode  # noqa: E402
from warp_neumat.kernels.bc6h_encode import bc6h_encode  # noqa: E402
from warp_neumat.kernels.bc6h_tables import PARTITIONS  # noqa: E402
from warp_neumat.materials.bcf import BCf as Material  # noqa: E402
from warp_neumat.models.bcf import (  # noqa: E402
    BCf,
    BCfConfig,
    configure,
    decode_reference,
    feature_sizes,
    reference_loss,
    sizes_for_bytes,
)

CHANNEL = {"map": "roughness", "component": "value", "encoding": "linear", "range": [0.0, 1.0]}


def config(features=((16, 8), (8, 4)), size=(32, 16), channels=2, **options) -> BCfConfig:
    names = tuple({**CHANNEL, "map": f"mask_{c}"} for c in range(channels))
    return BCfConfig(features, *size, names, {}, **options)


def model(**options) -> BCf:
    channels = options.get("channels", 2)
    return BCf(config(**options), np.full(channels, 0.5, np.float32), 1)


def test_decode_reference_is_the_half_reinterpretation():
    """Every finite half float, of either sign, subnormal ones among them."""
    bits = np.arange(31744)
    for sign in (1, -1):
        endpoints = torch.from_numpy(sign * bits / 31744.0).view(-1, 1, 1).expand(-1, 4, 3)
        got = decode_reference(endpoints, torch.zeros(len(bits), 16).double(), torch.full((len(bits),), 32))
        want = sign * bits.astype(np.uint16).view(np.float16).astype(np.float64)
        np.testing.assert_allclose(got[:, 0, 0].numpy(), want, rtol=1e-12)


def test_decode_reference_blends_within_the_region(rng):
    endpoints = torch.from_numpy(rng.uniform(0.1, 0.9, (32, 4, 3)))
    positions = torch.from_numpy(rng.random((32, 16)))
    got = decode_reference(endpoints, positions, torch.arange(32))
    for shape in range(32):
        for t in (0, 3, 7, 15):
            region = int(PARTITIONS[shape]) >> t & 1
            a, b = endpoints[shape, 2 * region], endpoints[shape, 2 * region + 1]
            y = 31744 * (a + positions[shape, t] * (b - a)).numpy()
            low = np.floor(y).astype(np.uint16)
            below, above = (v.view(np.float16).astype(np.float64) for v in (low, (low + 1).astype(np.uint16)))
            np.testing.assert_allclose(got[shape, t].numpy(), below + (above - below) * (y - low), rtol=1e-9)


@pytest.mark.parametrize("signed", [False, True])
def test_decode_reference_passes_gradcheck(rng, signed):
    endpoints = torch.from_numpy(rng.uniform(-0.9 if signed else 0.1, 0.9, (6, 4, 3)))
    positions = torch.from_numpy(rng.uniform(0.05, 0.95, (6, 16)))
    shapes = torch.tensor([0, 7, 13, 21, 31, 32])

    inputs = (endpoints.requires_grad_(), positions.requires_grad_())
    # Slopes differ by 2³⁰ between the octaves: each texel over its own size.
    fixed = decode_reference(*inputs, shapes).detach().abs()
    assert torch.autograd.gradcheck(
        lambda e, x: decode_reference(e, x, shapes) / fixed, inputs, eps=1e-8, atol=1e-4, rtol=1e-4
    )


def test_reference_loss_passes_gradcheck(rng):
    m = model()
    pictures = [torch.from_numpy(rng.random((1, 2, h, w))) for w, h in mip_sizes(32, 16)]
    patches = torch.tensor([[0.3, 1.0] + [0.0] * 6, [2.0, 0.5] + [0.0] * 6, [5.0, 0.5] + [0.0] * 6])
    uv = torch.from_numpy(rng.random((3, 20, 2)))
    texels = m.texels.double()[:, :3].clone().requires_grad_()
    net = m.net.double().requires_grad_()
    weight = torch.tensor([1.0, 2.0]).double()
    loss = lambda t, n: reference_loss(m, t, n, pictures, patches, uv, weight)  # noqa: E731
    assert torch.autograd.gradcheck(loss, (texels, net), fast_mode=True)


@pytest.mark.parametrize("modes", ["all", "single"])
@pytest.mark.parametrize("signed", [False, True], ids=["unsigned", "signed"])
def test_encoder_output_survives_as_parameters(rng, modes, signed):
    m = model(features=((64, 64), (12, 8)), signed=signed)
    count = len(m.shapes)
    pixels = 2.0 ** rng.uniform(-3, 2, (count, 1, 1, 3)) * (1 + 0.4 * rng.normal(size=(count, 4, 4, 3)))
    pixels[::4] = pixels[::4, :1, :1]  # flat blocks
    pixels[1::4] = np.where(rng.random((len(pixels[1::4]), 4, 4, 1)) < 0.5, pixels[1::4], 8 * pixels[1::4])
    pixels = (pixels * rng.choice([-1, 1], (count, 1, 1, 3)) if signed else np.abs(pixels)).astype(np.float16)
    blocks = bc6h_encode(pixels, signed, modes)
    m.load_blocks(blocks)
    if modes == "all":
        assert len(set(m.modes.tolist())) > 5
    np.testing.assert_array_equal(m.blocks(), blocks)


def test_encode_fills_the_blocks_of_the_texels(rng):
    m = model(features=((32, 32),))
    m.texels[:, :3] = torch.from_numpy(2.0 ** rng.uniform(-1, 1, m.texels[:, :3].shape))
    m.encode("all")
    decoded = bc6h_decode(m.blocks()).astype(np.float32).reshape(-1, 3)
    flat = m.texels[:, :3].numpy()
    mean = flat.reshape(-1, 16, 3).mean(1, keepdims=True)
    assert np.square(decoded - flat).mean() < 0.5 * np.square(flat.reshape(-1, 16, 3) - mean).mean()


def test_continuous_blocks_cannot_be_packed():
    with pytest.raises(ValueError, match="the blocks are continuous; encode them first"):
        model().blocks()


def test_random_blocks_lie_in_the_feature_range():
    m = model(features=((64, 64),))
    m.random_blocks(torch.Generator().manual_seed(0))
    values = decode_reference(m.endpoints, m.positions, m.shapes)
    low, high = m.config.feature_range
    assert low <= values.min() < low * (high / low) ** 0.3
    assert high * (low / high) ** 0.3 < values.max() <= high
    assert set(m.shapes.tolist()) == set(range(32))


def test_asset_evaluates_as_the_model(rng):
    """The material that reads the asset gives what plain torch gives for the decoded texels."""
    m = model(features=((16, 8), (8, 8)), size=(30, 14), wrap="clamp")
    m.texels[:, :3] = torch.from_numpy(2.0 ** rng.uniform(-1, 1, m.texels[:, :3].shape))
    m.encode("all")
    m.net.copy_(m.net.half().float())
    blocks = m.blocks()
    tensors, header = m.to_asset(blocks)
    material = Material(tensors, header, path=Path("a.neumat"), device="cpu")
    texels = torch.from_numpy(bc6h_decode(blocks).astype(np.float64).reshape(-1, 3))
    uv = rng.random((300, 2)).astype(np.float32)
    for s in (0.0, 0.6, 2.0, 4.0):
        # With a zero reference and one channel at a time, the loss is the mean square of the output.
        got = material.encoded(uv, np.full(len(uv), s, np.float32)).astype(np.float64)
        pictures = [torch.zeros(1, 2, h, w).double() for w, h in mip_sizes(30, 14)]
        patch = torch.tensor([[s, 1.0] + [0.0] * 6])
        free = (got > 0) & (got < 1)
        assert free.mean() > 0.5
        for n in np.flatnonzero(free.all(1))[:20]:
            at = torch.from_numpy(uv[n : n + 1].astype(np.float64))[None]
            for c in range(2):
                weight = torch.tensor([2.0 * (k == c) for k in range(2)]).double()
                loss = reference_loss(m, texels, m.net.double(), pictures, patch, at, weight)
                assert float(loss) ** 0.5 == pytest.approx(got[n, c], abs=2e-5)


def test_mips_stop_where_the_config_says():
    assert config(smallest_mip=1).mips[0] == ((16, 8), (8, 4), (4, 2), (2, 1), (1, 1))
    assert config(smallest_mip=4).mips == (((16, 8), (8, 4), (4, 2)), ((8, 4), (4, 2)))
    assert config(features=((4, 4),), smallest_mip=4).mips == (((4, 4),),)


@pytest.mark.parametrize(
    ("size", "features", "expected"),
    [
        ((2048, 2048), "1k", (1024, 512, 256, 128)),
        ((512, 512), "2k++", (512, 512, 128, 64)),
        ((100, 100), "0.5k", (28, 16, 8, 4)),
        ((3, 3), "1k", (4, 4, 4, 4)),
        ((512, 512), (30, 8), (32, 8)),
    ],
)
def test_feature_sizes(size, features, expected):
    assert feature_sizes(*size, features) == tuple((n, n) for n in expected)
    wide = feature_sizes(size[0], size[1] // 2 or 1, features)
    assert [w for w, _ in wide] == list(expected)
    assert all(h % 4 == 0 and h >= 4 for _, h in wide)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"wrap": "border"}, "wrap must be repeat, clamp or mirror, got 'border'"),
        ({"modes": "ten"}, "modes must be all or single"),
        ({"hidden": 0}, r"hidden must lie in 1 … 64, got 0"),
        ({"features": ((6, 4),)}, "features must be multiples of 4"),
        ({"features": ()}, "features must name 1 to 8 sizes, got 0"),
        ({"feature_range": (4.0, 0.25)}, "feature_range must lie"),
        ({"smallest_mip": 3}, "smallest_mip must be 1, 2 or 4"),
        ({"mip_decay": -1}, "mip_decay must lie"),
    ],
)
def test_wrong_configurations_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        config(**options)


def test_unknown_options_and_presets_are_named():
    class Source:
        name, width, height, channels, constants = "s", 8, 8, (), {}

    with pytest.raises(ValueError, match="s: every map is constant"):
        configure(Source, {})
    with pytest.raises(ValueError, match="no option 'hiden' of bcf; nearest: hidden"):
        configure(Source, {"hiden": 8})
    with pytest.raises(ValueError, match="no preset '3k'; nearest: 2k|1k"):
        feature_sizes(8, 8, "3k")
    with pytest.raises(ValueError, match="features must be whole numbers above 0"):
        feature_sizes(8, 8, (16.0, 8))


@pytest.mark.parametrize("size", [(512, 512), (2048, 1024), (100, 37)])
@pytest.mark.parametrize("budget", [3000, 40_000, 115_378])
def test_a_budget_of_bytes_is_used_and_kept(size, budget):
    rest = {"channels": 7, "hidden": 16, "smallest_mip": 1}
    sizes = sizes_for_bytes(*size, budget, **rest)
    channels = tuple({"map": f"m{n}", "component": "value"} for n in range(7))
    tensors, _ = BCf(BCfConfig(sizes, *size, channels, {}), np.zeros(7)).to_asset(np.zeros((1 << 20, 16), np.uint8))
    taken = sum(tensor.nbytes for tensor in tensors.values())
    assert 0.8 * budget < taken <= budget
    assert [max(s) for s in sizes] == sorted((max(s) for s in sizes), reverse=True)
    with pytest.raises(ValueError, match="bytes must be at least"):
        sizes_for_bytes(*size, 700, **rest)


def test_sizes_are_given_in_one_way():
    class Source:
        name, width, height, constants = "s", 64, 64, {}
        channels = (types.SimpleNamespace(map="m", component="value", encoding="linear", range=(0.0, 1.0)),)

    assert configure(Source, {"bytes": 3000}).features[0][0] > configure(Source, {"bytes": 2000}).features[0][0]
    with pytest.raises(ValueError, match="give a preset, features or bytes, not two of them"):
        configure(Source, {"bytes": 3000}, "1k")
    with pytest.raises(ValueError, match="bytes must be a whole number above 0, got '3k'"):
        configure(Source, {"bytes": "3k"})
