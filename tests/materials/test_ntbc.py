"""NTBC at run time: blocks against float64 networks and packers, mips, outside decoders, rendering, bad assets."""

import copy
import types

import numpy as np
import pytest

from tests.block_oracles import bcdec, texture2d
from tests.fake_assets import fake_ntbc, random_ntbc
from tests.pipeline.test_renderer import LIGHTS, Still, _dome
from warp_neumat.io.asset import FormatError
from warp_neumat.io.block_formats import FORMATS, from_blocks, grid, mip_size, to_blocks
from warp_neumat.io.mipmaps import mip_chain, unit_normals
from warp_neumat.kernels.block_fit import bc1_encode, bc4_encode, bc7_encode
from warp_neumat.kernels.colour_metric import plane_metrics
from warp_neumat.materials import load
from warp_neumat.materials.block_maps import BlockMaps, decode_texture
from warp_neumat.materials.ntbc import NTBC
from warp_neumat.materials.ntbc_config import planes_of
from warp_neumat.pipeline.renderer import Renderer
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.reference import block_fit, ntbc

# Few shapes of networks, as each compiles a kernel of its own.
SHAPES = {
    "plain": {},
    "odd": {"size": (37, 21), "wrap": "clamp"},
    "bc7": {"textures": "bc7", "mode": "aggressive", "metric": "luma"},
    "naive": {"variant": "naive", "mode": "aggressive"},
    "fitted": {"endpoints": "fitted", "mode": "aggressive"},
    "5 bits": {"bits": 5, "levels": ((3, 5), (8, 8), (16, 16))},
}


def outputs(tensors, config, name, texels: bool):
    """Return what a network says of all blocks, or of their texels, in float64."""
    grids, levels = [], config["models"][int(name[5])][name.partition(".")[2]]["levels"]
    bits = config["models"][0]["texel"]["bits"]
    for n, (w, h) in enumerate(levels):
        stream = np.unpackbits(tensors[f"{name}.grid{n}"], bitorder="little")[: w * h * 2 * bits]
        stored = stream.reshape(h, w, 2, bits) @ (1 << np.arange(bits))
        # NTBC Eq. 2
        grids.append(tensors[f"{name}.scale"][n].astype(np.float64) * (stored - float(tensors[f"{name}.zero"][n])))
    layers = [(tensors[f"{name}.weight{n}"], tensors[f"{name}.bias{n}"]) for n in range(len(config["hidden"]) + 1)]
    rows, columns = grid(config["width"], config["height"])
    return ntbc.network(grids, layers, ntbc.positions(rows, columns, texels))


def predictions(tensors, config):
    """Return ({(texture, plane): endpoints (n, 2, k)}, {(texture, plane): colours (n, 16, k)}) in float64."""
    planes, ends, colours = {(p.texture, p.number): p for p in planes_of(config)}, {}, {}
    for i, model in enumerate(config["models"]):
        texel = outputs(tensors, config, f"model{i}.texel", True)
        texel = texel.reshape(-1, 16, texel.shape[1])
        end = None if model["endpoint"] is None else outputs(tensors, config, f"model{i}.endpoint", False)
        begin = 0
        for n, pair in enumerate(map(tuple, model["planes"])):
            k = planes[pair].components
            if end is not None:
                ends[pair] = end[:, 2 * begin : 2 * (begin + k)].reshape(-1, 2, k)
            if config["variant"] == "naive":
                w = texel[:, :, n : n + 1]
                colours[pair] = (1 - w) * ends[pair][:, None, 0] + w * ends[pair][:, None, 1]
            else:
                colours[pair] = texel[:, :, begin : begin + k]
            begin += k
    return ends, colours


def plane_blocks(texture, number, family, mip):
    """Return the blocks (n, 8 or 16) of a plane."""
    blocks = texture.levels[0][mip].reshape(-1, FORMATS[texture.format].block_bytes)
    if family == "bc5":
        return blocks[:, 8 * number : 8 * number + 8]
    return blocks[:, 8 * (1 - number) : 8 * (1 - number) + 8] if family == "bc3" else blocks  # bc1 is listed first


def metric_of(plane, config):
    """Return the metric of a plane, (k, k)."""
    numbers = [(plane.components, plane.channels)]
    return plane_metrics(config["metric"], numbers, config["channels"])[0, : plane.components, : plane.components]


def error(format, blocks, wanted, metric):
    """Return the error of each block (n,) to ``wanted`` (n, 16, k), decoded by bcdec."""
    k = wanted.shape[-1]
    difference = bcdec(format, blocks).reshape(len(blocks), 16, -1)[..., :k] / 255 - wanted
    return np.einsum("ntc,cd,ntd->n", difference, metric, difference)


@pytest.mark.parametrize("shape", ["plain", "odd", "naive", "bc7", "5 bits"])
def test_mip_0_is_what_the_networks_say(rng, shape, device):
    tensors, header = random_ntbc(rng, **SHAPES[shape])
    config = header["config"]
    material = NTBC(tensors, header, device=device)
    ends, colours = predictions(tensors, config)
    for plane in planes_of(config):
        key, texture = (plane.texture, plane.number), material.textures[plane.texture]
        got, metric = plane_blocks(texture, plane.number, FORMATS[texture.format].family, 0), metric_of(plane, config)
        if plane.format == "bc4":
            expected, _ = block_fit.bc4_pack(ends[key][..., 0], colours[key][..., 0])
        else:
            pack = {"bc1": block_fit.bc1_pack, "bc7": block_fit.bc7_pack}[plane.format]
            expected, _ = pack(ends[key], colours[key], metric)
        assert expected.std() > 20  # something is there to compare
        # Float32 rounds a few endpoints and ties the other way.
        assert (got == expected).all(axis=1).mean() > 0.85, plane
        errors = [error(plane.format, blocks, colours[key], metric).sum() for blocks in (got, expected)]
        assert abs(errors[0] / errors[1] - 1) < 2e-3, plane


@pytest.mark.parametrize("shape", ["plain", "odd", "bc7", "naive", "fitted"])
def test_mips_are_filtered_from_predicted_colours(rng, shape):
    tensors, header = random_ntbc(rng, **SHAPES[shape])
    config = header["config"]
    material = NTBC(tensors, header)
    width, height = config["width"], config["height"]
    _, colours = predictions(tensors, config)
    picture = np.empty((height, width, 7), np.float32)
    for plane in planes_of(config):
        texels = colours[plane.texture, plane.number].reshape(-1, 4, 4, plane.components)
        picture[..., plane.channels] = from_blocks(texels, width, height)[..., : len(plane.channels)]
    levels = mip_chain(picture, [types.SimpleNamespace(**channel) for channel in config["channels"]])
    assert {texture.mips for texture in material.textures} == {len(levels)}
    for plane in planes_of(config):
        texture, metric = material.textures[plane.texture], metric_of(plane, config)
        for mip in range(len(levels)) if shape == "fitted" else range(1, len(levels)):
            wanted = np.zeros((*levels[mip].shape[:2], plane.components), np.float32)
            wanted[..., : len(plane.channels)] = levels[mip][..., plane.channels]
            if plane.channels == (3, 4):
                wanted[..., 2] = 0.5 + 0.5 * unit_normals(wanted[..., :2])[..., 2]
            blocks = to_blocks(wanted).reshape(-1, 4, 4, plane.components)
            if mip == 0:
                blocks = np.float32(colours[plane.texture, plane.number]).reshape(blocks.shape)  # beyond the edge too
            encode = {
                "bc1": lambda b, g=metric: bc1_encode(b, metric=g),
                "bc4": lambda b: bc4_encode(b[..., 0]),
                "bc7": lambda b, g=metric: bc7_encode(b, metric=g),
            }[plane.format]
            got = plane_blocks(texture, plane.number, FORMATS[texture.format].family, mip)
            wanted = blocks.reshape(len(blocks), 16, -1)
            errors = [error(plane.format, b, wanted, metric).sum() for b in (got, encode(blocks))]
            # The last bits of its input decide where the search of an encoder ends, a block in a hundred.
            assert errors[0] <= 1.1 * errors[1] + 1e-4, (plane, mip)
            assert errors[0] / wanted.size < 0.02


@pytest.mark.parametrize("textures", ["bc1", "bc7"])
def test_channels_are_read_where_they_were_written(rng, textures):
    tensors, header = random_ntbc(rng, textures=textures, endpoints="fitted", mode="aggressive")
    config = header["config"]
    _, colours = predictions(tensors, config)
    u, v = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(64) + 0.5) / 64)
    encoded = NTBC(tensors, header).encoded(np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32), 0.0)
    for plane in planes_of(config):
        texels = colours[plane.texture, plane.number].reshape(-1, 4, 4, plane.components)
        picture = from_blocks(texels, 64, 64)
        for n, channel in enumerate(plane.channels):
            found = encoded[:, channel].reshape(64, 64)
            assert np.corrcoef(found.ravel(), picture[..., n].ravel())[0, 1] > 0.9, channel
            assert np.sqrt(np.square(found - picture[..., n]).mean()) < 0.1, channel


@pytest.mark.parametrize("shape", SHAPES)
def test_every_block_decodes_identically_everywhere(rng, shape):
    material = NTBC(*random_ntbc(rng, **SHAPES[shape]))
    for texture in material.textures:
        family = FORMATS[texture.format].family
        for blocks in texture.levels[0]:
            blocks = blocks.reshape(-1, blocks.shape[-1])
            if family in ("bc1", "bc3"):
                ends = blocks[:, -8:-4].copy().view("<u2")
                assert (ends[:, 0] > ends[:, 1]).all()  # no punch-through, nothing that decoders disagree on
        ours = decode_texture(texture)
        blocks = np.concatenate([b.reshape(-1, b.shape[-1]) for b in texture.levels[0]])
        np.testing.assert_array_equal(ours, bcdec(family, blocks))
        other = texture2d(family, blocks)[..., : ours.shape[-1]]
        # texture2ddecoder truncates the thirds of BC1, see kernels/bc1.py; the endpoints are the same.
        assert np.abs(ours.astype(int) - other).max() <= (1 if family in ("bc1", "bc3") else 0)


def test_facts_of_the_asset(rng, tmp_path):
    header = fake_ntbc(tmp_path / "stone.neumat", seed=3)
    material = load(tmp_path / "stone.neumat")
    assert (material.kind, material.name) == ("ntbc", "stone")
    assert material.channels == header["config"]["channels"]
    assert [(t.format, t.mips) for t in material.textures] == [
        ("bc1_srgb", 7), ("bc5_unorm", 7), ("bc4_unorm", 7), ("bc4_unorm", 7),
    ]  # fmt: skip
    blocks = sum(np.prod(grid(*mip_size(64, 64, m))) for m in range(7))
    assert material.block_bytes == blocks * (8 + 16 + 8 + 8)
    tensors, _ = random_ntbc(np.random.default_rng(3))
    assert material.bytes == sum(t.nbytes for t in tensors.values())
    assert set(material.load_ms) == {"networks", "filter", "fit", "decode"}
    again = NTBC(*random_ntbc(np.random.default_rng(3)))
    for a, b in zip(material.textures, again.textures, strict=True):
        for x, y in zip(a.levels[0], b.levels[0], strict=True):
            np.testing.assert_array_equal(x, y)


def test_a_frame_equals_that_of_its_textures(rng):
    material = NTBC(*random_ntbc(rng))
    plain = BlockMaps(material.textures, material.sources, material.config)
    points, faces, uv = _dome(8, 16)
    dome = MeshSequence.from_arrays(points, faces, uv, name="dome")
    shot = {"space": "screen", "size": (96, 64), "camera": Still((0, 0, 5.0), size=(96, 64)), "lights": LIGHTS}
    ours, theirs = (Renderer(dome, {"*": m}, **shot).frame(0).image for m in (material, plain))
    assert ours.std() > 0.01
    np.testing.assert_array_equal(ours, theirs)


# ---- bad assets ------------------------------------------------------------------------------------------------------


def spoil(change):
    return lambda tensors, header: change(tensors, header["config"])


BAD = {
    "config: must be an object": lambda t, h: h.pop("config"),
    "config.height: must be a whole number from 1": spoil(lambda t, c: c.update(height=0)),
    "config.mode: must be one of conservative, aggressive, got 'brave'": spoil(lambda t, c: c.update(mode="brave")),
    "config.variant: must be one of ntbc, naive": spoil(lambda t, c: c.pop("variant")),
    "config.metric: must be one of rgb, luma, got 'ssim'": spoil(lambda t, c: c.update(metric="ssim")),
    "config.endpoints: must be network for variant naive": spoil(
        lambda t, c: c.update(endpoints="fitted", variant="naive")
    ),
    r"config.models\[0\].endpoint: must be null where endpoints are fitted": spoil(
        lambda t, c: c.update(endpoints="fitted")
    ),
    r"config.textures: must list 1 to 64 textures, got \[\]": spoil(lambda t, c: c.update(textures=[])),
    r"config.textures\[0\].name: must be a name that files can have, got '../x'": spoil(
        lambda t, c: c["textures"][0].update(name="../x")
    ),
    "config.textures: must have different names, got base_color, base_color": spoil(
        lambda t, c: c["textures"][1].update(name="base_color")
    ),
    r"config.textures\[0\].format: must be one of bc1_unorm, .* got 'bc6h_uf16'": spoil(
        lambda t, c: c["textures"][0].update(format="bc6h_uf16")
    ),
    r"config.textures\[1\].planes: must be bc4 and bc4 for bc5_unorm, got bc4": spoil(
        lambda t, c: c["textures"][1]["planes"].pop()
    ),
    r"config.textures\[0\].planes\[0\].channels: must list 1 to 3 channels, got \[\]": spoil(
        lambda t, c: c["textures"][0]["planes"][0].update(channels=[])
    ),
    r"config.textures\[2\].planes\[0\].channels\[0\].channel: must be a whole number from 0 to 6, got 7": spoil(
        lambda t, c: c["textures"][2]["planes"][0].update(channels=[7])
    ),
    r"config.textures: must hold each of the 7 channels once, got \[0, 1, 2, 3, 4, 5, 5\]": spoil(
        lambda t, c: c["textures"][3]["planes"][0].update(channels=[5])
    ),
    r"config.models: must serve each of the planes .* once": spoil(lambda t, c: c["models"][1]["planes"].pop()),
    r"config.models\[0\].planes\[0\]: must be \[texture, plane\], got 3": spoil(
        lambda t, c: c["models"][0].update(planes=[3])
    ),
    r"config.models\[0\].texel.levels\[1\].width: must be a whole number from 1 to 65536, got None": spoil(
        lambda t, c: c["models"][0]["texel"]["levels"].__setitem__(1, [4])
    ),
    r"config.models\[1\].endpoint: must be an object, got None": spoil(
        lambda t, c: c["models"][1].update(endpoint=None)
    ),
    r"config.hidden\[1\].width: must be a whole number from 1 to 512, got 0": spoil(
        lambda t, c: c.update(hidden=[16, 0, 16])
    ),
    "config.constants.roughness: is also a map": spoil(lambda t, c: c["constants"].update(roughness=[1])),
    r"config.models\[0\].texel.bits: must be one of 1, 2, 3, 4, 5, 6, 7, 8, got 9": spoil(
        lambda t, c: c["models"][0]["texel"].update(bits=9)
    ),
    r"config.models\[1\].endpoint.features: must be one of 1, 2, 4, 8, got 3": spoil(
        lambda t, c: c["models"][1]["endpoint"].update(features=3)
    ),
    r"config.models\[0\]: must write fewer than 2\^31 numbers, got .* at 65535x65535": spoil(
        lambda t, c: c.update(width=65535, height=65535)
    ),
    "model0.texel.grid2: missing": spoil(lambda t, c: t.pop("model0.texel.grid2")),
    r"model1.endpoint.grid0: must have shape \(32,\), got \(30,\)": spoil(
        lambda t, c: t.update({"model1.endpoint.grid0": t["model1.endpoint.grid0"][:30]})
    ),
    "model0.endpoint.scale: must be float32, got float64": spoil(
        lambda t, c: t.update({"model0.endpoint.scale": t["model0.endpoint.scale"].astype(np.float64)})
    ),
    "model0.endpoint.zero: missing": spoil(lambda t, c: t.pop("model0.endpoint.zero")),
    r"model0.texel.weight3: must have shape \(3, 16\), got \(2, 16\)": spoil(
        lambda t, c: t.update({"model0.texel.weight3": t["model0.texel.weight3"][:2]})
    ),
    "model1.texel.bias1: missing": spoil(lambda t, c: t.pop("model1.texel.bias1")),
}


@pytest.mark.parametrize("message", BAD)
def test_a_bad_asset_is_named(message, rng, tmp_path):
    tensors, header = random_ntbc(rng)
    header = copy.deepcopy(header)
    BAD[message](tensors, header)
    with pytest.raises(FormatError, match=message) as caught:
        NTBC(tensors, header, path=tmp_path / "x.neumat")
    assert "\n" not in str(caught.value)
