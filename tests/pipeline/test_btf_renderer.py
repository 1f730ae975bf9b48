"""Neural BTFs in the renderer: quads of screen and atlas against float64, their cost, and several at once."""

import numpy as np
import pytest

from tests.fake_assets import random_btf
from tests.pipeline.test_renderer import LIGHTS, SIZE, Still, _dome
from warp_neumat.kernels.shade import COLUMN_MASK, MASK_SHIFT, ROW_SHIFT
from warp_neumat.materials.btf import BTF
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.lights import PointLights
from warp_neumat.pipeline.renderer import Renderer
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.reference import btf as reference
from warp_neumat.reference.shade import HORIZON, pixel_lod

SHOT = {"size": SIZE, "camera": Still((1.0, 1.5, 4.0)), "lights": LIGHTS}


@pytest.fixture(scope="module")
def sphere():
    points, faces, uv = _dome()
    return MeshSequence.from_arrays(points, faces, uv, name="sphere")


@pytest.fixture(scope="module")
def asset():
    return random_btf(np.random.default_rng(5), width=64, height=48)


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def _expected(sequence, tensors, config, renderer):
    """Radiance of each pixel (h, w, 3) in float64, in quads of 2 × 2 pixels; 0 where nothing is seen."""
    triangle = renderer.view.raster.triangle.numpy()
    height, width = triangle.shape
    padded = np.full((height + height % 2, width + width % 2), -1)
    padded[:height, :width] = triangle
    wanted = padded >= 0
    b = np.zeros((*padded.shape, 2))
    b[:height, :width] = renderer.view.raster.barycentric.numpy()
    corners = sequence.faces[np.maximum(padded, 0)]
    weights = np.concatenate([1 - b.sum(-1, keepdims=True), b], -1)[..., None]
    mesh = sequence.frame(0)
    uv = (sequence.uv[corners] * weights).sum(2)
    p = (mesh.points[corners].astype(np.float64) * weights).sum(2)
    n = _unit((mesh.normals[corners].astype(np.float64) * weights).sum(2))
    t = (mesh.tangents[corners].astype(np.float64)[..., :3] * weights).sum(2)
    t = _unit(t - n * (n * t).sum(-1, keepdims=True))
    frame = np.stack([t, np.cross(n, t) * mesh.tangents[corners][..., 0, 3:], n], -2)
    camera = renderer.camera.at(0)
    wo = np.einsum("yxij,yxj->yxi", frame, _unit(camera.eye - p))
    flat = wo[..., :2] / np.maximum(np.linalg.norm(wo[..., :2], axis=-1, keepdims=True), 1e-12)
    low = np.concatenate([flat * np.sqrt(1 - HORIZON**2), np.full((*flat.shape[:2], 1), HORIZON)], -1)
    wo = np.where(wo[..., 2:] < HORIZON, low, wo)
    y, x = np.nonzero(wanted)
    lod = np.zeros(padded.shape)
    lod[wanted] = pixel_lod(
        mesh.points[corners][wanted], sequence.uv[corners][wanted], camera.ray, x + 0.5, y + 0.5,
        (config["width"], config["height"]),
    )  # fmt: skip

    def quads(a):
        h, w = a.shape[0] // 2, a.shape[1] // 2
        return a.reshape(h, 2, w, 2, *a.shape[2:]).swapaxes(1, 2).reshape(h * w, 4, *a.shape[2:])

    def pixels(a):
        h, w = padded.shape[0] // 2, padded.shape[1] // 2
        return a.reshape(h, w, 2, 2, 3).swapaxes(1, 2).reshape(2 * h, 2 * w, 3)[:height, :width]

    radiance = np.zeros((height, width, 3))
    for at, power in zip(*renderer.lights.at(0)[:2], strict=True):
        d = at - p
        wi = np.einsum("yxij,yxj->yxi", frame, _unit(d))
        lit = wanted & (wi[..., 2] > 0)
        value = reference.btf_quads(
            tensors, config, quads(uv), quads(wi), quads(wo), quads(lod), wanted=quads(wanted), lit=quads(lit)
        )
        value = np.where(lit[:height, :width, None], pixels(value), 0)
        radiance += value * power / (d**2).sum(-1)[:height, :width, None]
    return radiance


def test_screen_space_matches_float64(sphere, asset):
    tensors, header = asset
    renderer = Renderer(sphere, {"*": BTF(tensors, header)}, space="screen", **SHOT)
    frame = renderer.frame(0)
    expected = _expected(sphere, tensors, header["config"], renderer)
    seen = renderer.view.raster.triangle.numpy() >= 0
    error = (np.abs(frame.image - expected) / (expected + 0.05))[seen]
    assert seen.sum() > 1000
    assert expected.std() > 0.1
    # Radiance is stored as float16. Of the pixels, a few fall on a border of mips or of seams in one of both.
    assert np.quantile(error.max(1), 0.99) < 1e-3
    assert (error.max(1) > 2e-3).sum() < 0.005 * seen.sum()


def test_texture_space_is_close_to_screen_space(sphere, tmp_path):
    tensors, header = random_btf(np.random.default_rng(5), width=8, height=8, mips=1)  # smooth: texels are large
    material = BTF(tensors, header)
    screen = Renderer(sphere, {"*": material}, space="screen", **SHOT).frame(0).image
    atlas = Atlas.build(sphere, 512, cache=tmp_path)
    ours = Renderer(sphere, {"*": material}, atlas=atlas, policy="every", **SHOT).frame(0).image
    error = np.abs(ours - screen).max(2)
    assert np.median(error[screen.sum(2) > 0]) < 0.02 * screen.max()


def test_texture_space_shades_quads_that_a_chart_cuts(sphere, asset, tmp_path):
    """The atlas holds a radiance for every texel that is listed, and whole and cut quads are among them."""
    material = BTF(*asset)
    atlas = Atlas.build(sphere, 256, cache=tmp_path)
    renderer = Renderer(sphere, {"*": material}, atlas=atlas, policy="every", **SHOT)
    stats = renderer.frame(0).stats
    shader = renderer.view.shader
    shaded = shader.radiance.numpy().reshape(shader.height, shader.width, 4)
    assert (shaded[..., 3] > 0).sum() >= stats["texels"]["shaded"] > 500
    assert np.isfinite(shaded).all()
    assert (shaded[..., :3] >= 0).all()
    words = shader._quads.numpy()[: shader._segments[0][1]]
    masks = words >> MASK_SHIFT & 15
    columns, rows = words & COLUMN_MASK, words >> ROW_SHIFT & COLUMN_MASK
    assert (columns < shader.width).all()
    assert (rows < shader.height).all()
    assert set(np.unique(masks)) >= {15, 3, 5}  # whole quads, and such as a chart's edge cuts


def test_a_light_below_the_horizon_costs_nothing(sphere, asset):
    """Behind the sphere, no texel that is seen is lit; one in front costs an evaluation for each that faces it."""
    material = BTF(*asset)

    def evaluations(*places):
        lights = PointLights(np.array(places, float), np.full((len(places), 3), 30.0))
        shot = {**SHOT, "lights": lights, "camera": Still((0, 0, 4.0))}
        return Renderer(sphere, {"*": material}, space="screen", **shot).frame(0).stats["evaluations"]

    front, back = (0.0, 0.0, 50.0), (0.0, 0.0, -50.0)
    assert evaluations(back) < 0.01 * evaluations(front)
    assert evaluations(front, back) == evaluations(front) + evaluations(back)
    assert 0.3 < evaluations((50.0, 0.0, 0.0)) / evaluations(front) < 0.7


def test_materials_of_one_layout_share_buffers_and_show_their_own_textures(rng):
    points, faces, uv = _dome(8, 16)
    count = 3
    row = MeshSequence.from_arrays(
        np.concatenate([points + (2.2 * (k - 1), 0, 0) for k in range(count)]).astype(np.float32),
        np.concatenate([faces + k * len(points) for k in range(count)]),
        np.tile(uv, (count, 1)),
        face_mesh=np.repeat(np.arange(count), len(faces)),
        mesh_names=[f"ball{k}" for k in range(count)],
    )
    materials = [BTF(*random_btf(rng, width=16 + 8 * k, height=24, mips=1 + k)) for k in range(count)]
    size = (150, 60)
    shot = {"space": "screen", "size": size, "camera": Still((0, 0, 10.0), size=size, fov=0.25), "lights": LIGHTS}
    renderer = Renderer(row, {f"ball{k}": m for k, m in enumerate(materials)}, **shot)
    jobs = renderer.view.shader._jobs
    assert len({job.kernel for job in jobs}) == len({job._arguments[0].texels.ptr for job in jobs}) == 1
    together = renderer.frame(0).image
    triangle = renderer.view.raster.triangle.numpy()
    part = np.where(triangle >= 0, row.face_mesh[triangle], -1)
    for k, material in enumerate(materials):
        alone = Renderer(row, {"*": material}, **shot).frame(0).image
        mine = part == k
        assert mine.sum() > 300
        assert np.array_equal(together[mine], alone[mine])
        assert alone[mine].std() > 0.01
