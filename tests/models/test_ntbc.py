"""The fitting side of NTBC: what is written by what, in how many bytes, and what is stored."""

import dataclasses

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from tests.tiny_maps import tiny_maps  # noqa: E402
from warp_neumat.io.asset import unpack_bits  # noqa: E402
from warp_neumat.io.texture_set import open_texture_set  # noqa: E402
from warp_neumat.kernels.ntbc_network import NetworkShape  # noqa: E402
from warp_neumat.kernels.ntbc_train import StepShape  # noqa: E402
from warp_neumat.models import ntbc_config  # noqa: E402
from warp_neumat.models.ntbc import (  # noqa: E402
    block_colours,
    build,
    configure,
    layers,
    level_views,
    metrics,
    plane_colours,
    quantise,
    quantiser,
    rounded_grid,
)
from warp_neumat.models.ntbc_config import Plane, levels  # noqa: E402
from warp_neumat.models.ntbc_plain import losses, network, places  # noqa: E402


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A set of 256 × 128 with base colour, normal and roughness."""
    return open_texture_set(tiny_maps(tmp_path_factory.mktemp("maps") / "tiny", 256, 128))


def stored_bytes(config) -> int:
    tensors, _ = build(config, 0).to_asset()
    return sum(t.nbytes for t in tensors.values())


# --- what is written --------------------------------------------------------------------------------------------------


def test_maps_become_the_formats_that_engines_use(source):
    config = configure(source, {})
    assert [(t.name, t.format) for t in config.textures] == [
        ("base_color", "bc1_srgb"),
        ("normal", "bc5_unorm"),
        ("roughness", "bc4_unorm"),
    ]
    others = configure(source, {"normals": "bc1", "colours": "bc7", "rate": 0.9})
    assert [t.format for t in others.textures] == ["bc7_srgb", "bc1_unorm", "bc4_unorm"]


def test_modes_share_planes_among_models_as_the_paper_does(source):
    one, two = (configure(source, {"mode": mode, "rate": 1.0}) for mode in ("aggressive", "conservative"))
    assert [m.planes for m in one.models] == [((0, 0), (1, 0), (1, 1), (2, 0))]
    assert [m.planes for m in two.models] == [((0, 0),), ((1, 0), (1, 1), (2, 0))]
    shape = one.shape(one.models[0])
    assert shape.planes == ((4, 3), (8, 1), (8, 1), (8, 1))
    # 6 N_RGB + 2 N_SC, 3 N_RGB + N_SC; the naive variant N_RGB + N_SC (NTBC §4.1).
    assert (shape.endpoint.outputs, shape.texel.outputs) == (6 + 2 * 3, 3 + 3)
    naive = configure(source, {"mode": "aggressive", "rate": 1.0, "variant": "naive"})
    assert naive.shape(naive.models[0]).texel.outputs == 4


def test_levels_of_the_paper():
    # §3.4: 7 levels to 1,024 and 8 to 2,048, coarsest 16, of a texture of 4,096 texels; 2 bytes each: 13.3 MiB (§4.1).
    ends, texels = levels(4096, 4096, 0.25), levels(4096, 4096, 0.5)
    assert [w for w, _ in ends] == [16, 32, 64, 128, 256, 512, 1024]
    assert [w for w, _ in texels] == [16, 32, 64, 128, 256, 512, 1024, 2048]
    assert sum(2 * w * h for w, h in (*ends, *texels)) / 2**20 == pytest.approx(13.33, abs=0.01)
    assert levels(256, 128, 0.5)[-1] == (128, 64)
    assert levels(8, 4, 1.0) == ((8, 4),)


@pytest.mark.parametrize("options", [{"endpoints": "network"}, {"endpoints": "fitted"}, {"variant": "naive"}])
@pytest.mark.parametrize("rate", [0.75, 0.9])
def test_a_rate_is_what_the_file_takes_at_most(source, options, rate):
    config = configure(source, {"mode": "aggressive", "rate": rate, **options})
    assert stored_bytes(config) == config.bytes
    assert 0.8 * rate < config.bytes / config.block_bytes <= rate


def test_small_maps_fit_by_default(source):
    config = configure(source, {"mode": "conservative"})
    assert config.models[0].texel.levels[-1] == (128, 64)  # the paper's
    assert 0.64 < config.bytes / config.block_bytes < 1.5


def test_bytes_are_the_same_in_bytes(source):
    config = configure(source, {"mode": "aggressive", "bytes": 90000})
    assert 70000 < stored_bytes(config) <= 90000


def test_a_mode_is_a_rate():
    class Set:
        """As large as a material is, without pixels."""

        name, width, height, constants = "big", 2048, 2048, {}  # noqa: RUF012
        channels = tuple(
            dataclasses.make_dataclass("C", ["map", "component", "encoding", "range"])(m, c, "linear", (0.0, 1.0))
            for m, c in (("a", "r"), ("a", "g"), ("a", "b"), ("b", "value"), ("c", "value"))
        )

    for mode, most in (("aggressive", 0.32), ("conservative", 0.64)):
        config = configure(Set, {"mode": mode})
        assert most - 0.09 < config.bytes / config.block_bytes <= most  # bits come whole
    Set.width = Set.height = 1 << 15
    with pytest.raises(ValueError, match=r"32768x32768 with 5 channels .* use mode=conservative"):
        configure(Set, {"mode": "aggressive"})
    Set.width = Set.height = 2048
    paper = configure(Set, {"mode": "aggressive", "rate": "paper", "endpoints": "network"})
    assert (paper.models[0].texel.levels[-1], paper.models[0].endpoint.levels[-1]) == ((1024, 1024), (512, 512))
    assert {grids.bits for grids in (paper.models[0].texel, paper.models[0].endpoint)} == {8}


def test_more_bytes_make_vertices_first_and_bits_then():
    budgets = (40_000, 80_000, 110_000, 140_000, 420_000)
    found = [ntbc_config._Budget((256, 256), 6, (64, 64, 64), budget).best() for budget in budgets]
    assert [(g.levels[-1][0], g.bits) for g in found] == [(90, 8), (152, 8), (256, 4), (256, 5), (256, 8)]
    assert ntbc_config._Budget((256, 256), 6, (64, 64, 64), 1000).best() is None


def test_the_least_rate_that_is_named_fits(source):
    for options in ({"endpoints": "network"}, {"endpoints": "fitted"}, {"variant": "naive"}):
        with pytest.raises(ValueError, match="give at least rate=") as caught:
            configure(source, {"mode": "aggressive", "rate": 0.05, **options})
        rate = float(str(caught.value).partition("rate=")[2].partition("rate=")[2].partition(",")[0])
        config = configure(source, {"mode": "aggressive", "rate": rate, **options})
        assert config.bytes / config.block_bytes <= rate


def test_refuses(source):
    cases = [
        ({"mode": "lossy"}, "mode must be conservative or aggressive, got 'lossy'"),
        ({"ratio": 0.4}, "no option 'ratio' of ntbc; nearest: rate"),
        ({"rate": 1.0, "bytes": 1000}, "give rate or bytes, not both"),
        ({"rate": -1}, "rate must lie above 0, at most 4, or be paper, got -1"),
        ({"rate": "half"}, "rate must lie above 0, at most 4, or be paper, got 'half'"),
        ({"bytes": 1.5}, "bytes must be a whole number above 0, got 1.5"),
        ({"rate": 0.01}, "rate=0.01 is too little for 256x128: the networks alone take .* give at least rate="),
        ({"bytes": 1000}, "bytes=1000 is too little for 256x128"),
        ({"joint": "abc", "rate": 1.0}, "joint must lie in 0 … 1, got 'abc'"),
        ({"normals": "bc4"}, "normals must be bc5 or bc1, got 'bc4'"),
        ({"colours": "bc6h"}, "colours must be bc1 or bc7, got 'bc6h'"),
        ({"variant": "naive", "endpoints": "fitted"}, "endpoints must be network for variant naive"),
        ({"hidden": 60, "rate": 1.0}, "hidden must be one to four multiples of 8 up to 128"),
        ({"temperature": 0, "rate": 1.0}, "temperature must lie in 0.0001 … 1, got 0"),
    ]
    for options, message in cases:
        with pytest.raises(ValueError, match=message):
            configure(source, options)


# --- what is learnt ---------------------------------------------------------------------------------------------------


def test_a_normal_in_bc1_has_its_z(source):
    x, y = (next(k for k, c in enumerate(source.channels) if c.component == name) for name in "xy")
    colours = plane_colours(Plane("bc1", (x, y)), source.pixels)
    normal = 2.0 * colours - 1.0
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, atol=1e-5)
    np.testing.assert_allclose(colours[..., :2], source.pixels[..., [x, y]], atol=1e-6)
    assert normal[..., 2].min() > 0.0


def test_colours_lie_block_by_block(source):
    planes = configure(source, {"mode": "aggressive", "rate": 1.0}).textures
    colours = block_colours([p for t in planes for p in t.planes], source.pixels)
    assert colours.shape == (64 * 32, 6, 16)
    # Block (5, 7), texel (x 2, y 1): picture row 4·5 + 1, column 4·7 + 2.
    expected = source.pixels[21, 30, [c for t in planes for p in t.planes for c in p.channels]]
    np.testing.assert_array_equal(colours[5 * 64 + 7, :, 4 * 1 + 2], expected)


def test_luma_tells_hue_from_grey(source):
    config = configure(source, {"mode": "aggressive", "rate": 1.0, "metric": "luma"})
    g = metrics(config, config.models[0])[0, :3, :3].double()
    grey, hue = torch.ones(3, dtype=torch.float64), torch.tensor([1.0, 0.0, -1.0], dtype=torch.float64)
    assert float(grey @ g @ grey) == pytest.approx(3.0)
    assert float(hue @ g @ hue) > 1.5 * 2.0
    plain = metrics(dataclasses.replace(config, metric="rgb"), config.models[0])
    np.testing.assert_array_equal(plain[0], np.diag([1, 1, 1, 0]))


# --- what is stored ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bits", [4, 5, 8])
def test_quantisation_is_that_of_the_equations(bits, rng):
    values = torch.from_numpy(rng.normal(0.1, 0.3, 5000).astype(np.float32))
    scale, zero = quantiser(values, bits)
    low, high = float(values.min()), float(values.max())
    assert scale == pytest.approx((high - low) / (2**bits - 1))  # Eq. 4
    assert zero == -round(low / scale)  # Eq. 5, corrected
    codes = quantise(values, scale, zero, bits)
    expected = np.clip(np.rint(values.double().numpy() / np.float64(scale)) + zero, 0, 2**bits - 1)  # Eq. 1
    assert np.mean(codes.numpy() != expected) < 1e-3  # halves, in float32
    assert float(((codes - zero) * scale - values).abs().max()) < 0.51 * scale  # Eq. 2; nothing is clamped away


def test_zero_stays_zero_and_constants_survive():
    for values in (torch.zeros(8), torch.full((8,), 0.3), torch.full((8,), -0.2)):
        scale, zero = quantiser(values, 8)
        back = (quantise(values, scale, zero, 8) - zero) * scale
        np.testing.assert_allclose(back, values, atol=0.002)


@pytest.mark.parametrize("endpoints", ["network", "fitted"])
def test_the_asset_holds_what_training_read(source, endpoints, rng):
    config = configure(source, {"mode": "conservative", "rate": 3.0, "endpoints": endpoints})
    model = build(config, 3)
    for pair in model.pairs:
        for *_, grid, _ in pair.networks():
            grid.copy_(torch.from_numpy(rng.normal(0, 0.5, grid.numel()).astype(np.float32)))
    tensors, header = model.to_asset()
    assert header["config"]["models"][0]["endpoint"] is None or endpoints == "network"
    for number, pair in enumerate(model.pairs):
        for name, shape, grids, grid, net in pair.networks():
            key = f"model{number}.{name}"
            if name == "endpoint" and endpoints == "fitted":
                assert not any(k.startswith(key) for k in tensors)
                continue
            used = torch.empty_like(grid)
            rounded_grid(shape, grid, grids.bits, used)
            for n, level in enumerate(level_views(shape, used)):
                codes = unpack_bits(tensors[f"{key}.grid{n}"], grids.bits, level.numel()).astype(np.float32)
                back = (codes - np.float32(tensors[f"{key}.zero"][n])) * tensors[f"{key}.scale"][n]
                np.testing.assert_array_equal(back, level.numpy().ravel())
            for n, (weight, bias) in enumerate(layers(shape, net)):
                np.testing.assert_array_equal(tensors[f"{key}.weight{n}"], weight.half().numpy())
                np.testing.assert_array_equal(tensors[f"{key}.bias{n}"], bias.half().numpy())


def test_the_same_seed_draws_the_same_and_padding_stays_zero(source):
    config = configure(source, {"mode": "aggressive", "rate": 1.0})
    first, again, other = (build(config, seed).pairs[0] for seed in (1, 1, 2))
    for name, value in first.named_buffers():
        assert torch.equal(value, getattr(again, name))
        assert not torch.equal(value, getattr(other, name))
    held = sum(w.numel() for w, _ in layers(first.shape.texel, first.texel_net))
    assert int((first.texel_net != 0).sum()) <= held
    assert float(first.texel_grid.abs().max()) <= 1e-4


def test_plain_torch_keeps_to_one_device():
    """The meta device refuses to be mixed with the CPU, as a GPU would."""
    ends, texels = (NetworkShape(((4, 4), (8, 8)), outputs) for outputs in (8, 4))
    shape = StepShape(ends, texels, ((4, 3), (8, 1)))

    def empty(*size):
        return torch.zeros(*size, device="meta")

    blocks = torch.zeros(8, dtype=torch.long, device="meta")
    said = network(ends, empty(ends.grid_words), empty(ends.weights), places(8, 8, blocks, False))
    x = network(texels, empty(texels.grid_words), empty(texels.weights), places(8, 8, blocks, True))
    assert losses(shape, said, x, empty(8, 8), empty(8, 4, 16), empty(2, 4, 4)).shape == (5,)
