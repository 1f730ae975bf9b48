"""Maps in block-compressed textures: texels as outside decoders give them, filtering, shading, and bad arguments."""

import numpy as np
import pytest
import warp as wp

from tests.block_oracles import bcdec
from tests.fake_assets import CHANNELS, random_bcf, random_block_maps
from tests.pipeline.test_renderer import LIGHTS, Still, _dome
from warp_neumat.io.asset import FormatError
from warp_neumat.io.block_formats import BlockTexture, from_blocks, mip_size
from warp_neumat.kernels import bcf_shade, dispatch
from warp_neumat.materials.bcf import BCf
from warp_neumat.materials.block_maps import BlockMaps
from warp_neumat.pipeline.renderer import Renderer
from warp_neumat.pipeline.sequence import MeshSequence


def centres(width, height):
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    return np.stack([u, v], axis=-1).reshape(-1, 2).astype(np.float32)


def oracle(material, mip):
    """Return the channels of a mip (h, w, C) uint8, decoded by bcdec."""
    width, height = mip_size(material.config["width"], material.config["height"], mip)
    planes = []
    for t, component in material.sources:
        blocks = material.textures[t].levels[0][mip]
        family = material.textures[t].format.split("_")[0]
        texels = bcdec(family, blocks.reshape(-1, blocks.shape[-1]))
        planes.append(from_blocks(texels, width, height)[..., component])
    return np.stack(planes, axis=-1)


@pytest.mark.parametrize(
    ("size", "wrap"), [((32, 32), "repeat"), ((36, 20), "repeat"), ((32, 32), "clamp"), ((32, 32), "mirror")]
)
def test_texel_centres_are_exact(rng, size, wrap, device):
    material = BlockMaps(*random_block_maps(rng, *size, wrap=wrap), device=device)
    for mip in range(material.textures[0].mips):
        expected = oracle(material, mip)
        uv = wp.array(centres(*expected.shape[1::-1]), device=device)
        got = material.encoded(uv, float(mip)).numpy().reshape(expected.shape)
        # Odd sides have centres that float32 misses by a part of a texel in 2^24.
        assert np.abs(got - expected / 255).max() < (2e-7 if size[0] == size[1] else 4e-6)


def test_filtering_is_bilinear_between_texels_and_linear_between_mips(rng):
    material = BlockMaps(*random_block_maps(rng, 32, 32))
    uv, lod = rng.random((500, 2)).astype(np.float32), 1.3
    expected = 0
    for mip, weight in ((1, 0.7), (2, 0.3)):
        texels = oracle(material, mip) / 255
        side = len(texels)
        x, y = (uv.astype(np.float64) * side - 0.5).T
        i, j = np.floor(x).astype(int), np.floor(y).astype(int)
        for di in (0, 1):
            for dj in (0, 1):
                share = (x - i if di else 1 - x + i) * (y - j if dj else 1 - y + j)
                expected = expected + weight * share[:, None] * texels[(j + dj) % side, (i + di) % side]
    assert np.abs(material.encoded(uv, lod) - expected).max() < 2e-6


def test_maps_are_linear_light_and_unit_normals(rng):
    material = BlockMaps(*random_block_maps(rng, 32, 32))
    uv = rng.random((300, 2)).astype(np.float32)
    encoded, maps = material.encoded(uv, 0.0).astype(np.float64), material.maps(uv, 0.0)
    srgb = encoded[:, :3]
    light = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(maps["base_color"], light, atol=2e-6)
    assert np.allclose(np.linalg.norm(maps["normal"], axis=1), 1, atol=1e-6)
    flat = np.linalg.norm(2 * encoded[:, 3:5] - 1, axis=1)
    inside = flat < 0.99
    assert inside.mean() > 0.5
    np.testing.assert_allclose(maps["normal"][inside, :2], 2 * encoded[inside, 3:5] - 1, atol=1e-5)
    np.testing.assert_allclose(maps["displacement"][:, 0], 0.25 + 0.5 * encoded[:, 8], atol=1e-6)
    np.testing.assert_array_equal(maps["specular"], np.full((300, 1), 0.5, np.float32))


def test_workers_and_kinds_of_arrays(rng):
    torch = pytest.importorskip("torch")
    material = BlockMaps(*random_block_maps(rng, 32, 32))
    uv, lod = rng.random((20_001, 2)).astype(np.float32), (6 * rng.random(20_001)).astype(np.float32)
    try:
        dispatch.set_worker_count(1)
        one = material.encoded(uv, lod)
        dispatch.set_worker_count(3)
        assert (material.encoded(uv, lod) == one).all()
    finally:
        dispatch.set_worker_count(None)
    assert isinstance(material.encoded(torch.from_numpy(uv), 1.0), torch.Tensor)
    assert material.encoded(uv[:0], 0).shape == (0, 9)
    for strange in (np.nan, np.inf, -np.inf):
        assert np.isfinite(material.encoded(np.full((3, 2), strange, np.float32), strange)).all()


# ---- shading ---------------------------------------------------------------------------------------------------------


def test_eval_shades_the_maps(rng):
    """What is shaded are the maps: a BCf and block textures of the same constant values agree."""
    tensors, header = random_bcf(rng, channels=12, constants={})
    tensors["weight1"][:] = 0
    values = np.array([51, 102, 204, 128, 140, 90, 77, 255, 0, 0, 0, 0])
    tensors["bias1"][:] = values / 255
    flat = BCf(tensors, header)
    textures = []
    for value in values:  # a BC4 block of one value for each channel
        blocks = np.zeros((1, 1, 8), np.uint8)
        blocks[..., :2] = value
        textures.append(BlockTexture("bc4_unorm", 4, 4, [[blocks]]))
    config = {"width": 4, "height": 4, "wrap": "repeat", "channels": CHANNELS[:12], "constants": {}}
    ours = BlockMaps(textures, [(k, 0) for k in range(12)], config)
    w = rng.normal(size=(2, 400, 3)).astype(np.float32)
    w[..., 2] = np.abs(w[..., 2]) + 0.05
    uv = rng.random((400, 2)).astype(np.float32)
    got, expected = ours.eval(uv, *w), flat.eval(uv, *w)
    assert expected.max() > 0.1
    np.testing.assert_allclose(got, expected, rtol=1.5e-2, atol=1e-4)  # the network's biases are float16


def test_materials_of_several_kinds_in_one_scene(rng):
    points, faces, uv = _dome(8, 16)
    places = [(2.2 * (k - 1), 0, 0) for k in range(3)]
    row = MeshSequence.from_arrays(
        np.concatenate([points + p for p in places]).astype(np.float32),
        np.concatenate([faces + k * len(points) for k in range(3)]),
        np.tile(uv, (3, 1)),
        face_mesh=np.repeat(np.arange(3), len(faces)),
        mesh_names=[f"ball{k}" for k in range(3)],
    )
    materials = [
        BlockMaps(*random_block_maps(rng, 32, 32)),
        BCf(*random_bcf(rng, channels=12)),
        BlockMaps(*random_block_maps(rng, 36, 20)),
    ]
    size = (180, 60)
    shot = {"space": "screen", "size": size, "camera": Still((0, 0, 12.0), size=size, fov=0.25), "lights": LIGHTS}
    renderer = Renderer(row, {f"ball{k}": m for k, m in enumerate(materials)}, **shot)
    jobs = [job for job in renderer.view.shader._jobs if job._arguments[0].maps.weights.size == 2]
    assert len({job._arguments[0].maps.texels.ptr for job in jobs}) == 1  # both block maps in one buffer
    together = renderer.frame(0).image
    triangle = renderer.view.raster.triangle.numpy()
    part = np.where(triangle >= 0, row.face_mesh[triangle], -1)
    for k, material in enumerate(materials):
        alone = Renderer(row, {"*": material}, **shot).frame(0).image
        assert (part == k).sum() > 300
        assert alone[part == k].std() > 0.01
        np.testing.assert_array_equal(together[part == k], alone[part == k])


def test_kernels_compile_for_cuda(rng, tmp_path):
    layout = bcf_shade.Layout(BlockMaps(*random_block_maps(rng, 32, 32)).layout)
    kernel = bcf_shade.make_eval_kernel(layout, 1)
    wp.compile_aot_module(kernel.module, arch=80, module_dir=tmp_path, use_ptx=True)
    assert "bcf_shade_kernel" in "".join(f.read_text(errors="replace") for f in tmp_path.glob("*.ptx"))


# ---- bad arguments ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, s, c: t.clear(), "textures must hold at least one"),
        (lambda t, s, c: s.pop(), "sources must name 9 channels, got 8"),
        (lambda t, s, c: s.__setitem__(2, (1, 2)), r"sources\[2\]: there is no component 2 of texture 1"),
        (lambda t, s, c: s.__setitem__(2, (9, 0)), r"sources\[2\]: there is no component 0 of texture 9"),
        (lambda t, s, c: c.update(width=64), r"textures\[0\] must be 64x32 as the config says, got 32x32"),
        (lambda t, s, c: c.update(wrap="wrap"), "config.wrap: must be one of repeat"),
        (
            lambda t, s, c: t.__setitem__(1, BlockTexture("bc5_unorm", 32, 32, [t[1].levels[0][:2]])),
            r"textures\[1\] must have one layer, and 6 mips up to 16, got 1 and 2",
        ),
        (
            lambda t, s, c: t.__setitem__(1, BlockTexture("bc5_snorm", 32, 32, t[1].levels)),
            r"textures\[1\] must be unsigned BC1, BC3, BC4, BC5 or BC7, got bc5_snorm",
        ),
    ],
)
def test_bad_arguments_are_named(rng, change, message):
    textures, sources, config = random_block_maps(rng, 32, 32)
    change(textures, sources, config)
    with pytest.raises((ValueError, FormatError), match=message) as caught:
        BlockMaps(textures, sources, config)
    assert "\n" not in str(caught.value)
