"""The renderer on small scenes: against float64 shading, and what reuse and each skip save."""

import numpy as np
import pytest

from tests.fake_assets import random_neubrdf
from warp_neumat import metrics
from warp_neumat.materials.neubrdf import NeuBRDF
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.camera import Camera, CameraPath
from warp_neumat.pipeline.lights import PointLights
from warp_neumat.pipeline.renderer import SKIPS, Renderer
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.pipeline.tonemap import tonemap
from warp_neumat.reference import shade as reference
from warp_neumat.reference.neubrdf import reference_eval

SIZE = (97, 61)  # odd, so that the last quads are cut


class Still(CameraPath):
    """One camera for every frame."""

    def __init__(self, eye, target=(0, 0, 0), fov=0.7, size=SIZE):
        self._camera = Camera.look_at(eye, target, fov_y=fov, width=size[0], height=size[1], near=0.1, far=100.0)

    def at(self, frame):
        return self._camera


class Turning(CameraPath):
    """A camera that runs around the origin, by ``step`` [rad] a frame."""

    def __init__(self, step=0.5, distance=4.0):
        self._step, self._distance = step, distance

    def at(self, frame):
        angle = self._step * frame
        eye = (self._distance * np.sin(angle), 1.0, self._distance * np.cos(angle))
        return Camera.look_at(eye, (0, 0, 0), fov_y=0.7, width=SIZE[0], height=SIZE[1], near=0.1, far=100.0)


def _dome(rows=16, columns=32, radius=1.0, lower=0.95):
    """Return points, faces and uv of a sphere without its poles: smooth normals, one chart."""
    v, u = np.meshgrid(np.linspace(1 - lower, lower, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    theta, phi = np.pi * v, 2 * np.pi * u
    points = radius * np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], -1)
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a = (i * (columns + 1) + j).ravel()
    faces = np.concatenate(
        [np.stack([a, a + columns + 1, a + 1], 1), np.stack([a + 1, a + columns + 1, a + columns + 2], 1)]
    )
    return points.reshape(-1, 3).astype(np.float32), faces.astype(np.int32), np.stack([u, v], -1).reshape(-1, 2)


@pytest.fixture(scope="module")
def sphere():
    points, faces, uv = _dome()
    return MeshSequence.from_arrays(points, faces, uv, name="sphere")


@pytest.fixture(scope="module")
def asset():
    """A smooth random material: few codewords and small weights, so that neighbouring texels differ little."""
    tensors, header = random_neubrdf(np.random.default_rng(3), nside=2, bits=3)
    tensors["codebook"] = (0.25 * tensors["codebook"].astype(np.float32)).astype(np.float16)
    return tensors, header


@pytest.fixture(scope="module")
def material(asset):
    return NeuBRDF(*asset)


@pytest.fixture(scope="module")
def atlas(sphere, tmp_path_factory):
    return Atlas.build(sphere, 128, cache=tmp_path_factory.mktemp("cache"))


LIGHTS = PointLights(
    np.array([[2.0, 3.0, 2.0], [-3.0, 1.0, 1.0], [0.0, -4.0, 2.0]]), np.array([[30.0, 28, 25], [8, 10, 14], [3, 5, 3]])
)


def _renderer(sphere, material, **options):
    shot = {"size": SIZE, "camera": Still((1.0, 1.5, 4.0)), "lights": LIGHTS, "policy": "fixed"} | options
    return Renderer(sphere, {"*": material}, **shot)


def test_screen_space_matches_float64(sphere, asset, material):
    renderer = _renderer(sphere, material, space="screen", background=(0.25, 0.5, 0.75))
    frame = renderer.frame(0)
    triangle = renderer.view.raster.triangle.numpy()
    weights = renderer.view.raster.barycentric.numpy().astype(np.float64)
    covered = triangle >= 0
    assert covered.sum() > 1000
    b1, b2 = weights[covered].T
    mesh = sphere.frame(0)
    corners = sphere.faces[triangle[covered]]
    tensors, header = asset
    expected = reference.shade(
        mesh.points[corners],
        mesh.normals[corners],
        mesh.tangents[corners],
        np.stack([1 - b1 - b2, b1, b2], axis=1),
        renderer.camera.at(0).eye,
        *LIGHTS.at(0)[:2],
        lambda wi, wo: reference_eval(tensors, header["config"], wi, wo),
    )
    got = frame.image[covered]
    assert expected.max() > 0.3
    # Radiance is stored as float16: half an ulp is 4.9e-4 of the value. Worst seen beyond that: 3e-5.
    assert (np.abs(got - expected) <= 5e-4 * expected + 2e-4).all()
    assert (frame.image[~covered] == np.float32([0.25, 0.5, 0.75])).all()
    assert frame.stats["texels"]["shaded"] == covered.sum()


def test_a_neural_texture_is_shaded_where_it_lies(sphere):
    tensors, header = random_neubrdf(np.random.default_rng(5), nside=2, bits=3, texture=(4, 3, 3, 1))
    tensors["codebook"] = (0.25 * tensors["codebook"].astype(np.float32)).astype(np.float16)
    renderer = _renderer(sphere, NeuBRDF(tensors, header), space="screen")
    frame = renderer.frame(0)
    triangle = renderer.view.raster.triangle.numpy()
    covered = triangle >= 0
    b1, b2 = renderer.view.raster.barycentric.numpy().astype(np.float64)[covered].T
    weights, mesh, corners = np.stack([1 - b1 - b2, b1, b2], axis=1), sphere.frame(0), sphere.faces[triangle[covered]]
    uv = (sphere.uv[corners] * weights[..., None]).sum(1)

    def shaded(uv):
        return reference.shade(
            mesh.points[corners],
            mesh.normals[corners],
            mesh.tangents[corners],
            weights,
            renderer.camera.at(0).eye,
            *LIGHTS.at(0)[:2],
            lambda wi, wo, lit: reference_eval(tensors, header["config"], wi, wo, uv=uv[lit]) * wi[:, 2:],
            projected=True,
        )

    expected = shaded(uv)
    close = np.abs(frame.image[covered] - expected) <= 2e-3 * expected + 2e-3
    assert close.mean() > 0.999
    assert (np.abs(shaded(1 - uv) - expected) > 0.02).mean() > 0.3  # it does vary over the surface


def test_texture_space_without_reuse_is_close_to_screen_space(sphere, material, atlas):
    ours = _renderer(sphere, material, atlas=atlas, policy="every").frame(0).image.copy()
    screen = _renderer(sphere, material, space="screen").frame(0).image
    inside = screen.sum(2) > 0
    error = np.abs(ours - screen).max(2)
    assert np.median(error[inside]) < 0.02 * screen.max()
    assert error.mean() < 0.01 * screen.max()


def test_reuse_shades_only_what_comes_into_view(sphere, material, atlas):
    plain = [name for name in SKIPS if name != "rate"]  # rates follow from what the frame before has seen
    unchanged = [name for name in plain if name != "unchanged"]
    for skip, third in ((plain, 0), (unchanged, 1)):
        renderer = _renderer(sphere, material, atlas=atlas, interval=2, skip=skip)
        frame = renderer.frame(0)
        first, evaluations = frame.image.copy(), [frame.stats["evaluations"]]
        for _ in range(5):
            frame = renderer.frame(0)
            evaluations.append(frame.stats["evaluations"])
            assert np.array_equal(frame.image, first)  # nothing moves, so the picture stays
        assert evaluations[0] > 0
        assert evaluations == [evaluations[0], 0, 0, third * evaluations[0], 0, 0]


def test_evaluations_follow_what_is_seen(sphere, material, atlas):
    near, far = (
        _renderer(sphere, material, atlas=atlas, policy="every", camera=Still(eye)).frame(0).stats
        for eye in ((0, 0, 4.0), (0, 0, 14.0))
    )
    seen = far["texels"]["seen"] / near["texels"]["seen"]
    assert seen < 0.3
    assert far["texels"]["owned"] == near["texels"]["owned"]
    assert near["texels"]["shaded"] == near["texels"]["seen"]  # what is read and nothing else
    assert 0.7 * seen < far["evaluations"] / near["evaluations"] < 1.4 * seen
    away = Still((0, 0, 4.0), target=(0, 0, 9))
    assert _renderer(sphere, material, atlas=atlas, camera=away).frame(0).stats["evaluations"] == 0


def test_texel_skips_nest_and_change_no_pixel(sphere, material, atlas):
    plain = [name for name in SKIPS if name != "rate"]
    off, shots = [], []
    for name in (None, "occluded", "offscreen", "backfacing", "unowned"):
        off += [name]
        skip = [each for each in plain if each not in off]
        camera = Still((0.5, 0.8, 2.2), target=(0.6, 0, 0))  # cuts the sphere
        frame = _renderer(sphere, material, atlas=atlas, policy="every", skip=skip, camera=camera).frame(0)
        shots.append((frame.image.copy(), frame.stats))
    for picture, _ in shots[1:]:
        assert np.array_equal(picture, shots[0][0])
    shaded = [stats["texels"]["shaded"] for _, stats in shots]
    skipped, texels = shots[0][1]["skipped"], shots[0][1]["texels"]
    assert shaded == sorted(set(shaded))
    assert shaded[0] == texels["seen"]
    assert shaded[4] == 128 * 128
    for k, name in enumerate(("occluded", "offscreen", "backfacing", "unowned")):
        # A texel that is read may belong to a triangle that faces away: it is counted as such too.
        assert shaded[k + 1] - shaded[k] == pytest.approx(skipped[name], rel=0.05)
        assert skipped[name] > 100
    assert shaded[3] == texels["owned"]
    assert shaded[2] == pytest.approx(texels["facing"], rel=0.02)


SPOTS = PointLights(
    [[2.0, 3.0, 2.0], [-3.0, 1.0, 1.0], [0.0, -1.5, 1.0]],
    [[30.0, 28, 25], [8, 10, 14], [9, 15, 9]],
    range=[np.inf, np.inf, 1.5],
    direction=[[-2, -3, -2], [3, -1, -1], [0, 0, 1]],
    inner=[0, 0, 0],
    outer=[np.pi, 0.3, np.pi],
)


def test_light_skips_change_no_pixel_and_save_what_they_count(sphere, material, atlas):
    def shot(*off):
        skip = [name for name in SKIPS if name not in off]
        frame = _renderer(sphere, material, atlas=atlas, policy="every", lights=SPOTS, skip=skip).frame(0)
        return frame.image.copy(), frame.stats

    full, stats = shot()
    for name in ("range", "spot", "horizon"):
        picture, without = shot(name)
        assert np.array_equal(picture, full)
        assert without["skipped"][name] == 0 < stats["skipped"][name]
        assert without["evaluations"] > stats["evaluations"]
    picture, without = shot("range", "spot", "horizon")
    assert np.array_equal(picture, full)
    assert without["evaluations"] == 3 * without["texels"]["shaded"]
    saved = sum(stats["skipped"][name] for name in ("range", "spot", "horizon"))
    assert without["evaluations"] == stats["evaluations"] + saved


def test_minified_tiles_are_shaded_coarsely_and_look_the_same(material):
    """A square whose texels are a little smaller than half a pixel, so that one in four is enough."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]])
    square = MeshSequence.from_arrays(square, np.array([[0, 1, 2], [0, 2, 3]]), uv)
    options = {"atlas": Atlas.build(square, 128, cache=False), "policy": "every", "camera": Turning(0.02, 3.0)}
    coarse, fine = (
        _renderer(square, material, skip=[name for name in SKIPS if name != off], **options) for off in ("", "rate")
    )
    for k in range(3):  # the first frame does not know yet what is minified
        one, other = coarse.frame(k), fine.frame(k)
    assert one.stats["evaluations"] < 0.5 * other.stats["evaluations"]
    assert one.stats["skipped"]["rate"] > 2 * one.stats["texels"]["shaded"]
    assert other.stats["skipped"]["rate"] == 0
    assert 0 < metrics.flip(tonemap(other.image), tonemap(one.image))[0] < 2e-3


def test_a_larger_atlas_costs_no_more_at_the_same_view(sphere, material):
    """Evaluations follow the pixels: twice the side of the sheet, the same view, minified in both."""
    small, large = (
        _renderer(sphere, material, atlas=Atlas.build(sphere, side), policy="every", camera=Turning(distance=12.0))
        for side in (256, 512)
    )
    for k in range(4):
        costs = [renderer.frame(k).stats["evaluations"] for renderer in (small, large)]
    assert 0 < costs[1] < 1.2 * costs[0]


def test_laziness_changes_no_pixel(sphere, material, atlas):
    """What is shaded when it is first seen equals what would have been shaded at the update."""
    plain = [name for name in SKIPS if name != "rate"]
    eagerly = [name for name in plain if name not in ("backfacing", "offscreen", "occluded")]
    moving = [
        _renderer(sphere, material, atlas=atlas, interval=3, camera=Turning(), skip=skip) for skip in (plain, eagerly)
    ]
    for k in range(8):
        lazy, eager = (renderer.frame(k) for renderer in moving)
        assert np.array_equal(lazy.image, eager.image)
    # The eager one did all its work at the updates.
    assert eager.stats["evaluations"] == 0
    assert lazy.stats["evaluations"] > 0


def test_a_light_below_every_horizon_costs_nothing(sphere, material, atlas):
    inside = PointLights(np.array([[0.0, 0.0, 0.0]]), np.array([[5.0, 5.0, 5.0]]))
    frame = _renderer(sphere, material, atlas=atlas, lights=inside).frame(0)
    assert frame.stats["evaluations"] == 0
    assert frame.image.max() == 0.0


def test_light_falls_off_with_the_square_of_its_distance(sphere, material):
    def peak(distance):
        lights = PointLights(np.array([[0.0, 0.0, distance]]), np.array([[100.0, 100, 100]]))
        return _renderer(sphere, material, space="screen", lights=lights, camera=Still((0, 0, 4.0))).frame(0).image

    centre = np.s_[28:33, 45:52]
    near, far = peak(11.0)[centre].mean(), peak(21.0)[centre].mean()  # 10 and 20 from the surface
    assert near / far == pytest.approx(4.0, rel=0.03)


def test_two_materials_each_shade_their_own_faces(material, tmp_path):
    points, faces, uv = _dome(8, 16)
    both = np.concatenate([points - [1.1, 0, 0], points + [1.1, 0, 0]]).astype(np.float32)
    pair = MeshSequence.from_arrays(
        both,
        np.concatenate([faces, faces + len(points)]),
        np.concatenate([uv, uv]),
        face_mesh=np.repeat([0, 1], len(faces)),
        mesh_names=["left", "right"],
    )
    dark_tensors, dark_header = random_neubrdf(np.random.default_rng(3), nside=2, bits=3)
    dark_tensors["weight2"][...] = 0
    dark_tensors["bias2"][...] = 0  # exp(0) - 1: a perfectly black material
    options = {"atlas": Atlas.build(pair, 128, cache=tmp_path), "lights": LIGHTS, "size": (96, 48), "policy": "every"}
    camera = Still((0, 0, 6.0), size=(96, 48))
    materials = {"*": material, "right": NeuBRDF(dark_tensors, dark_header)}
    for space in ("texture", "screen"):
        frame = Renderer(pair, materials, camera=camera, space=space, **options).frame(0)
        assert frame.image[:, :48].max() > 0.1
        assert frame.image[:, 48:].max() == 0.0
        assert frame.stats["evaluations"] > 0
    with pytest.raises(ValueError, match="no material for 'right'; name one"):
        Renderer(pair, {"left": material}, camera=camera, **options)
    with pytest.raises(ValueError, match="no mesh or material matches 'middle'"):
        Renderer(pair, {"middle": material}, camera=camera, **options)


def test_double_sided_surfaces_are_lit_from_both_sides(material):
    quad = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    faces, uv = np.array([[0, 1, 2], [0, 2, 3]]), np.array([[0, 1], [1, 1], [1, 0], [0, 0]])
    lights = PointLights(np.array([[0.5, 0.5, -3.0]]), np.array([[20.0, 20, 20]]))
    behind = Still((0.3, 0.2, -4.0))
    means = []
    for double in (False, True):
        sheet = MeshSequence.from_arrays(quad, faces, uv, double_sided=double)
        renderer = Renderer(sheet, {"*": material}, camera=behind, lights=lights, size=SIZE, atlas=64)
        means.append(renderer.frame(0).image.mean())
    assert means[0] == 0.0
    assert means[1] > 0.01


def test_a_failed_frame_leaves_the_renderer_as_it_was(material):
    points, faces, uv = _dome(8, 16)
    moving = MeshSequence.from_arrays(np.stack([points, 1.1 * points]), faces, uv)
    renderer = Renderer(moving, {"*": material}, atlas=64, size=SIZE, camera=Still((1, 1, 4)), lights=LIGHTS)
    with pytest.raises(IndexError, match="frame 99 does not exist"):
        renderer.frame(99)
    frame = renderer.frame(0)
    assert frame.stats["updated"]
    assert frame.image.max() > 0.1


def test_pictures_of_render_stay_and_those_of_frame_are_read_only(sphere, material, atlas):
    renderer = _renderer(sphere, material, atlas=atlas, camera=Turning())
    pictures = [frame.image for frame in renderer.render(range(2))]
    assert not np.array_equal(*pictures)
    with pytest.raises(ValueError, match="read-only"):
        renderer.frame(0).image[0] = 1


def test_bad_options_are_named(sphere, material, atlas):
    with pytest.raises(ValueError, match="camera must be made for 200x50 pixels, got 97x61"):
        _renderer(sphere, material, atlas=atlas, size=(200, 50))
    with pytest.raises(ValueError, match="size must be 1 to 16384 pixels each way, got 0x50"):
        _renderer(sphere, material, atlas=atlas, size=(0, 50))
    triangle = MeshSequence.from_arrays(np.eye(3, dtype=np.float32), [[0, 1, 2]])
    with pytest.raises(ValueError, match="atlas must be built for this sequence of 1 faces, got one of 1024"):
        _renderer(triangle, material, atlas=atlas)
    with pytest.raises(ValueError, match="interval must be a whole number"):
        _renderer(sphere, material, interval=-1)
    with pytest.raises(ValueError, match='space must be "texture" or "screen"'):
        _renderer(sphere, material, space="time")
    with pytest.raises(ValueError, match="skip must be among unowned, .*, horizon, got invisible"):
        _renderer(sphere, material, skip=("invisible",))


def test_changing_the_worker_count_between_frames_changes_nothing(sphere, material, atlas):
    from warp_neumat.kernels import dispatch

    skip = [name for name in SKIPS if name not in ("rate", "unchanged")]
    renderer = _renderer(sphere, material, atlas=atlas, policy="every", skip=skip)
    first = renderer.frame(0).image.copy()
    try:
        for workers in (1, 3):
            dispatch.set_worker_count(workers)
            assert np.array_equal(renderer.frame(0).image, first)
    finally:
        dispatch.set_worker_count(None)
