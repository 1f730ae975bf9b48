"""BCf materials in the renderer: against float64 shading of their own maps, level of detail, and several at once."""

import copy

import numpy as np
import pytest

from tests.fake_assets import fake_bcf, random_bcf
from tests.pipeline.test_renderer import LIGHTS, SIZE, Still, _dome
from warp_neumat.kernels.bc6h_tables import MODES
from warp_neumat.materials.bcf import BCf
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.lights import PointLights
from warp_neumat.pipeline.renderer import SKIPS, Renderer
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.reference import shade as reference
from warp_neumat.reference.ggx import ggx


@pytest.fixture(scope="module")
def sphere():
    points, faces, uv = _dome()
    return MeshSequence.from_arrays(points, faces, uv, name="sphere")


@pytest.fixture(scope="module")
def material():
    """Twelve channels: all that shading reads, and two that it does not."""
    return BCf(*random_bcf(np.random.default_rng(7), channels=12))


def _samples(renderer, sequence, texels):
    """Vertices, weights, uv and level of every covered pixel of the raster."""
    triangle = renderer.view.raster.triangle.numpy()
    covered = triangle >= 0
    b1, b2 = renderer.view.raster.barycentric.numpy()[covered].astype(np.float64).T
    weights = np.stack([1 - b1 - b2, b1, b2], 1)
    corners = sequence.faces[triangle[covered]]
    uv = (sequence.uv[corners] * weights[..., None]).sum(1)
    y, x = np.nonzero(covered)
    points, ray = sequence.frame(0).points[corners], renderer.camera.at(0).ray
    lod = reference.pixel_lod(points, sequence.uv[corners], ray, x + 0.5, y + 0.5, texels)
    return covered, corners, weights, uv.astype(np.float32), lod.astype(np.float32)


def _expected(sequence, material, renderer, samples):
    _, corners, weights, uv, lod = samples
    maps = {name: values.astype(np.float64) for name, values in material.maps(uv, lod).items()}

    def evaluate(wi, wo, lit):
        return ggx(
            wi,
            wo,
            maps["base_color"][lit],
            maps["roughness"][lit, 0],
            maps["metallic"][lit, 0],
            dielectric=0.08 * maps["specular"][lit, 0],
            normal=maps["normal"][lit],
        )

    mesh = sequence.frame(0)
    radiance = reference.shade(
        mesh.points[corners],
        mesh.normals[corners],
        mesh.tangents[corners],
        weights,
        renderer.camera.at(0).eye,
        *renderer.lights.at(0)[:2],
        evaluate,
        projected=True,
    )
    return radiance + maps["emissive"]


def test_screen_space_matches_float64(sphere, material):
    renderer = Renderer(
        sphere, {"*": material}, space="screen", size=SIZE, camera=Still((1.0, 1.5, 4.0)), lights=LIGHTS
    )
    frame = renderer.frame(0)
    samples = _samples(renderer, sphere, (64, 64))
    covered = samples[0]
    expected = _expected(sphere, material, renderer, samples)
    got = frame.image[covered]
    assert covered.sum() > 1000
    assert expected.std() > 0.1
    # Radiance is stored as float16, half an ulp of which is 4.9e-4 of the value. Worst seen (AVX2): 4.7e-4.
    assert (np.abs(got - expected) / (expected + 0.05)).max() < 8e-4
    assert frame.stats["texels"]["shaded"] == covered.sum()


def test_texture_space_without_reuse_is_close_to_screen_space(sphere, material, tmp_path):
    options = {"size": SIZE, "camera": Still((1.0, 1.5, 4.0)), "lights": LIGHTS}
    screen = Renderer(sphere, {"*": material}, space="screen", **options).frame(0).image
    atlas = Atlas.build(sphere, 512, cache=tmp_path)
    ours = Renderer(sphere, {"*": material}, atlas=atlas, policy="every", **options).frame(0).image
    error = np.abs(ours - screen).max(2)
    assert np.median(error[screen.sum(2) > 0]) < 0.02 * screen.max()


def test_materials_of_one_layout_share_buffers_and_show_their_own_maps(rng):
    """Five spheres with five random materials look as each of them does alone."""
    points, faces, uv = _dome(8, 16)
    count = 5
    places = [(2.2 * (k - 2), 0, 0) for k in range(count)]
    row = MeshSequence.from_arrays(
        np.concatenate([points + p for p in places]).astype(np.float32),
        np.concatenate([faces + k * len(points) for k in range(count)]),
        np.tile(uv, (count, 1)),
        face_mesh=np.repeat(np.arange(count), len(faces)),
        mesh_names=[f"ball{k}" for k in range(count)],
    )
    materials = [
        BCf(*random_bcf(rng, size=64 << (k % 3), features=(32 << (k % 2), 16, 8, 4), channels=12)) for k in range(count)
    ]
    size = (240, 60)
    shot = {"space": "screen", "size": size, "camera": Still((0, 0, 16.0), size=size, fov=0.2), "lights": LIGHTS}
    renderer = Renderer(row, {f"ball{k}": m for k, m in enumerate(materials)}, **shot)
    kernels = {job.kernel for job in renderer.view.shader._jobs}
    buffers = {job._arguments[0].maps.texels.ptr for job in renderer.view.shader._jobs}
    weights = {job._arguments[0].maps.weights.ptr for job in renderer.view.shader._jobs}
    assert (len(kernels), len(buffers), len(weights)) == (1, 1, 1)
    together = renderer.frame(0).image
    triangle = renderer.view.raster.triangle.numpy()
    part = np.where(triangle >= 0, row.face_mesh[triangle], -1)
    for k, material in enumerate(materials):
        alone = Renderer(row, {"*": material}, **shot).frame(0).image
        mine = part == k
        assert mine.sum() > 500
        assert np.array_equal(together[mine], alone[mine])
        assert alone[mine].std() > 0.01
        assert not np.allclose(together[part == (k + 1) % count], alone[part == (k + 1) % count], rtol=0.01)


def _flat_block(color) -> np.ndarray:
    """Return the BC6H block of one colour of zeros and ones, in the mode of two 10-bit endpoints."""
    (mode,) = (m for m in MODES if m.regions == 1 and not m.transformed)
    bits = np.zeros(128, np.uint8)
    bits[: mode.mode_bits] = (mode.bits >> np.arange(mode.mode_bits)) & 1
    for position, (channel, _, bit) in enumerate(mode.fields, mode.mode_bits):
        bits[position] = (495 * int(color[channel]) >> bit) & 1  # 495 becomes 31712, and that the half float 1.0
    return np.packbits(bits, bitorder="little")


def _pictured(picture, size=8):
    """A rough BCf whose base colour is the first texture: ``picture(level)`` gives rows of colours, one per block."""
    tensors, header = random_bcf(np.random.default_rng(0), channels=12, size=size, features=(size, 4, 4, 4))
    for name in [name for name in tensors if name.startswith("texture0")]:
        blocks = [[_flat_block(color) for color in row] for row in picture(int(name.rpartition("mip")[2]))]
        tensors[name][...] = np.array(blocks)[: len(tensors[name]), : tensors[name].shape[1]]
    for name in ("weight0", "bias0", "weight1"):
        tensors[name][...] = 0
    for c in range(3):
        tensors["weight0"][c, c] = tensors["weight1"][c, c] = 1
    tensors["bias1"][...] = (0, 0, 0, 0.5, 0.5, 1.0, *[0.0] * 6)  # flat, rough, no metal, dark
    return BCf(tensors, header)


RED, GREEN, BLUE, WHITE = (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 1)
FLASH = PointLights(np.array([[0.0, 0.0, 1000.0]]), np.full((1, 3), 3e6))


def test_a_texture_stands_the_right_way_up():
    square = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], np.float32)
    quad = MeshSequence.from_arrays(square, [[0, 3, 2], [0, 2, 1]], [[0, 0], [1, 0], [1, 1], [0, 1]])
    material = _pictured(lambda level: [[RED, GREEN], [BLUE, WHITE]])
    shot = {"camera": Still((0, 0, 3.0), size=(64, 64)), "size": (64, 64), "lights": FLASH}
    for space in ("screen", "texture"):
        image = Renderer(quad, {"*": material}, space=space, atlas=128, **shot).frame(0).image
        for y, x, color in ((20, 20, RED), (20, 44, GREEN), (44, 20, BLUE), (44, 44, WHITE)):
            seen = image[y, x]
            assert seen.max() > 0.5
            assert ((seen > 0.3 * seen.max()) == np.array(color, bool)).all()


def test_coarser_mips_are_read_when_the_picture_is_small(sphere):
    """A white texture whose coarser mips are black: the farther the surface, the darker."""
    material = _pictured(lambda level: [[WHITE if level == 0 else (0, 0, 0)] * 16] * 16, size=64)
    for options in ({"space": "screen"}, {"atlas": 1024, "policy": "every"}):
        means = []
        for distance in (2.0, 4.0, 8.0, 16.0, 64.0):
            shot = {"size": (64, 64), "camera": Still((0, 0, distance), size=(64, 64), fov=0.1), "lights": FLASH}
            means.append(Renderer(sphere, {"*": material}, **options, **shot).frame(0).image[30:34, 30:34].mean())
        assert means[0] > 0.8
        assert (np.diff(means) <= 1e-3).all()
        assert means[-1] < 0.1


def test_a_glowing_surface_needs_no_light_and_costs_no_evaluation(sphere):
    tensors, header = random_bcf(np.random.default_rng(5), channels=12)
    header = copy.deepcopy(header)  # the channels are shared by all random assets
    dark = PointLights(np.array([[0.0, 0.0, 0.0]]), np.array([[5.0, 5.0, 5.0]]))  # inside
    shot = {"space": "screen", "size": SIZE, "camera": Still((1.0, 1.5, 4.0)), "lights": dark}
    frame = Renderer(sphere, {"*": BCf(tensors, header)}, **shot).frame(0)
    assert frame.stats["evaluations"] == 0
    assert frame.image.max() > 0.1
    for channel in header["config"]["channels"][9:]:
        channel["map"] = "mask_glow"
    assert Renderer(sphere, {"*": BCf(tensors, header)}, **shot).frame(0).image.max() == 0.0


def test_what_a_material_does_not_say_is_gltfs_default(sphere):
    """A roughness map alone: a white dielectric with a flat normal; constants stand in where there are any."""
    tensors, header = random_bcf(np.random.default_rng(6), channels=12, constants={})
    header = copy.deepcopy(header)
    for k, channel in enumerate(header["config"]["channels"]):
        if channel["map"] != "roughness":
            channel.update(map=f"mask_{k}", component="value", encoding="linear")
    bare = BCf(tensors, header)
    header["config"]["constants"] |= {"base_color": [0.2, 0.4, 0.6], "metallic": [1.0], "specular": [0.0]}
    metal = BCf(tensors, copy.deepcopy(header))
    rng = np.random.default_rng(0)
    uv = rng.random((100, 2)).astype(np.float32)
    wi, wo = (np.abs(rng.normal(size=(100, 3))).astype(np.float32) for _ in range(2))
    rough = bare.maps(uv, 0.0)["roughness"][:, 0]
    assert bare.eval(uv, wi, wo) == pytest.approx(ggx(wi, wo, (1, 1, 1), rough), rel=2e-3, abs=1e-4)
    assert metal.eval(uv, wi, wo) == pytest.approx(ggx(wi, wo, (0.2, 0.4, 0.6), rough, 1.0), rel=2e-3, abs=1e-4)


def test_six_materials_dress_the_flight_helmet(data, tmp_path):
    paths = {}
    path = next((data / "meshes" / "FlightHelmet").rglob("*.gltf"))
    helmet = MeshSequence.load(path)
    assert len(helmet.material_names) == 6
    for seed, name in enumerate(helmet.material_names):
        paths[name] = tmp_path / f"{name}.neumat"
        fake_bcf(paths[name], seed=seed, channels=12, size=256, features=(128, 64, 32, 16))
    shot = {"atlas": 512, "size": (160, 120), "lights": 2, "policy": "every", "skip": set(SKIPS) - {"rate"}}
    renderer = Renderer(helmet, paths, **shot)
    frame = renderer.frame(0)
    assert len(renderer.materials) == 6
    assert len({job._arguments[0].maps.texels.ptr for job in renderer.view.shader._jobs}) == 1
    assert np.isfinite(frame.image).all()
    screen = renderer.per_pixel().frame(0).image
    assert screen.max() > 0.1
    assert np.abs(frame.image - screen).mean() < 0.1 * screen.mean()


def test_eval_is_the_brdf_of_the_finest_maps(material, rng):
    n = 5000
    uv = rng.uniform(-1, 2, (n, 2)).astype(np.float32)
    wi, wo = (rng.normal(size=(n, 3)).astype(np.float32) for _ in range(2))
    maps = {name: values.astype(np.float64) for name, values in material.maps(uv, 0.0).items()}
    rest = maps["roughness"][:, 0], maps["metallic"][:, 0]
    expected = ggx(wi, wo, maps["base_color"], *rest, dielectric=0.08 * maps["specular"][:, 0], normal=maps["normal"])
    got = material.eval(uv, wi, wo)
    assert (expected > 0).any(1).mean() > 0.1
    assert (np.abs(got - expected) / (expected + 1e-2)).max() < 1e-3
    assert (got[(wi[:, 2] <= 0) | (wo[:, 2] <= 0)] == 0).all()
    assert material.eval(uv[:0], wi[:0], wo[:0]).shape == (0, 3)
    # Lanes without work are left out of a block: the others must come out the same.
    assert np.array_equal(material.eval(uv[::7], wi[::7], wo[::7]), got[::7])
