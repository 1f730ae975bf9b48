"""Two eyes: each the picture of its own camera, and what they share is within the tolerance."""

import json

import numpy as np
import pytest

from tests.fake_assets import random_neubrdf
from warp_neumat import metrics
from warp_neumat.io.image import read_image
from warp_neumat.materials.base import load
from warp_neumat.materials.neubrdf import NeuBRDF
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.camera import Camera, CameraPath
from warp_neumat.pipeline.demo import material_paths
from warp_neumat.pipeline.lights import PointLights
from warp_neumat.pipeline.renderer import Renderer
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.pipeline.shot import render_shot
from warp_neumat.pipeline.stereo import quadrant_samples
from warp_neumat.pipeline.tonemap import tonemap

SIZE = (193, 121)  # odd, so that the last tiles are cut

LIGHTS = PointLights(
    np.array([[2.0, 3.0, 2.0], [-3.0, 1.0, 1.0], [0.0, -4.0, 2.0]]), np.array([[30.0, 28, 25], [8, 10, 14], [3, 5, 3]])
)


class EyePath(CameraPath):
    """A camera path, ``offset`` [scene unit] to the right of another."""

    def __init__(self, path: CameraPath, offset: float):
        self.path, self.offset = path, offset

    def at(self, frame: float) -> Camera:
        """Return the camera of ``frame``."""
        return self.path.at(frame).moved(self.offset)


class Turning(CameraPath):
    """A camera that runs around the origin, ``step`` [rad] a frame."""

    def __init__(self, step=0.05):
        self.step = step

    def at(self, frame):
        angle = self.step * frame
        eye = (4 * np.sin(angle), 1.0, 4 * np.cos(angle))
        return Camera.look_at(eye, (0, 0, 0), fov_y=0.7, width=SIZE[0], height=SIZE[1], near=0.1, far=100.0)


def _dome(rows=16, columns=32):
    """Return a sphere without its poles: smooth normals, one chart."""
    v, u = np.meshgrid(np.linspace(0.05, 0.95, rows + 1), np.linspace(0, 1, columns + 1), indexing="ij")
    theta, phi = np.pi * v, 2 * np.pi * u
    points = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], -1)
    i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    a = (i * (columns + 1) + j).ravel()
    b, c, d = a + 1, a + columns + 1, a + columns + 2
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)]).astype(np.int32)
    uv = np.stack([u, v], -1).reshape(-1, 2)
    return MeshSequence.from_arrays(points.reshape(-1, 3).astype(np.float32), faces, uv, name="sphere")


@pytest.fixture(scope="module")
def sphere():
    return _dome()


@pytest.fixture(scope="module")
def atlas(sphere, tmp_path_factory):
    return Atlas.build(sphere, 250, cache=tmp_path_factory.mktemp("cache"))  # no multiple of a tile


@pytest.fixture(scope="module")
def glossy():
    return load(material_paths()["knot"])


@pytest.fixture(scope="module")
def matt():
    """A material that changes little with the viewer."""
    tensors, header = random_neubrdf(np.random.default_rng(3), nside=2, bits=3)
    tensors["codebook"] = (0.02 * tensors["codebook"].astype(np.float32)).astype(np.float16)
    return NeuBRDF(tensors, header)


@pytest.fixture(scope="module")
def make(sphere, atlas, glossy):
    def renderer(material=glossy, **options):
        shot = {"size": SIZE, "camera": Turning(), "lights": LIGHTS, "stereo": True, "atlas": atlas} | options
        return Renderer(sphere, {"*": material}, **shot)

    return renderer


class _Walk(CameraPath):
    """The frames of another path one by one, whichever frame is asked for: a sequence of one frame can then move."""

    def __init__(self, path):
        self.path, self.step = path, 0

    def at(self, frame):
        return self.path.at(self.step)


def _film(make, frames=4, **options):
    """Return what ``frames`` frames of a turning camera look like: [(images of the eyes, stats)]."""
    camera = _Walk(options.pop("camera", Turning()))
    renderer = make(camera=camera, **options)
    return renderer, [_step(renderer, camera, k) for k in range(frames)]


def _step(renderer, camera, k):
    camera.step = k
    frame = renderer.frame(0)
    return [eye.copy() for eye in frame.eyes], frame.stats


POLICIES = {
    "every": {"policy": "every"},
    "fixed": {"policy": "fixed", "interval": 2},
    "staggered": {"policy": "staggered", "carry": True},
    "adaptive": {"policy": "adaptive"},
    "screen": {"space": "screen"},
}


@pytest.mark.parametrize("options", POLICIES.values(), ids=POLICIES)
def test_each_eye_is_the_picture_of_its_camera(make, options):
    _, both = _film(make, **options, eye_distance=0.4)
    for k, offset in enumerate((-0.2, 0.2)):
        _, alone = _film(make, **options, camera=EyePath(Turning(), offset), stereo=False)
        for (eyes, stats), ((picture,), expected) in zip(both, alone, strict=True):
            assert np.array_equal(eyes[k], picture)
            assert stats["eyes"][k]["texels"] == expected["texels"]
            assert stats["eyes"][k]["evaluations"] == expected["evaluations"]
    for eyes, stats in both:
        assert stats["evaluations"] == sum(eye["evaluations"] for eye in stats["eyes"])
        assert not np.array_equal(*eyes)
    assert both[0][1]["evaluations"] > 1000


def test_a_budget_holds_for_both_eyes(make):
    options = {"policy": "staggered", "eye_distance": 0.4}
    budget = 4000
    _, both = _film(make, **options, budget=budget)
    _, left = _film(make, policy="staggered", budget=budget / 2, camera=EyePath(Turning(), -0.2), stereo=False)
    assert all(np.array_equal(eyes[0], alone[0]) for (eyes, _), (alone, _) in zip(both, left, strict=True))
    for share in (None, 0.02):
        _, film = _film(make, **options, budget=budget, share=share, frames=7)
        spent = [stats["evaluations"] for _, stats in film[2:]]
        assert np.mean(spent) < 1.2 * budget
        assert np.mean(spent) > 0.6 * budget


@pytest.mark.parametrize("options", list(POLICIES.values())[:4], ids=list(POLICIES)[:4])
def test_no_tolerance_shares_nothing(make, options):
    _, apart = _film(make, **options)
    _, shared = _film(make, **options, share=0.0)
    for (eyes, stats), (same, others) in zip(apart, shared, strict=True):
        assert np.array_equal(eyes, same)
        assert stats["evaluations"] == others["evaluations"]
        assert stats["texels"] == others["texels"]
        assert stats["skipped"] == others["skipped"]
        assert others["shared"]["tiles"] == 0


@pytest.fixture(scope="module")
def references(make):
    pictures = {}

    def reference(material, frames):
        key = id(material), frames
        if key not in pictures:
            pictures[key] = [eyes for eyes, _ in _film(make, material=material, space="screen", frames=frames)[1]]
        return pictures[key]

    return reference


def _flip(expected, eyes):
    return np.mean([metrics.flip(tonemap(a), tonemap(b))[0] for a, b in zip(expected, eyes, strict=True)])


# Share of the evaluations that is left, FLIP to the unshared pictures, and by how much that to per-pixel shading rises.
# Seen: 0.71, 0.0036, 0.0020; 0.63, 0.0052, 0.0000; 0.55, 0.0016, 0.0012; 0.57, 0.0029, 0.0006.
BOUNDS = {
    ("glossy", "every"): (0.80, 0.0050, 0.0030),
    ("glossy", "adaptive"): (0.75, 0.0070, 0.0015),
    ("matt", "every"): (0.65, 0.0022, 0.0017),
    ("matt", "adaptive"): (0.70, 0.0040, 0.0015),
}


@pytest.mark.parametrize(("look", "policy"), BOUNDS, ids=map("-".join, BOUNDS))
def test_sharing_saves_evaluations_for_little(make, references, request, look, policy):
    material = request.getfixturevalue(look)
    _, apart = _film(make, material=material, **POLICIES[policy])
    renderer, shared = _film(make, material=material, **POLICIES[policy], share=0.01)
    expected = references(material, 4)
    spent = [sum(stats["evaluations"] for _, stats in film) for film in (apart, shared)]
    changed = max(_flip(a[0], b[0]) for a, b in zip(apart, shared, strict=True))
    errors = [
        np.mean([_flip(e, eyes) for e, (eyes, _) in zip(expected, film, strict=True)]) for film in (apart, shared)
    ]
    saving, most, worse = BOUNDS[look, policy]
    assert spent[1] < saving * spent[0]
    assert 0 < changed < most
    assert errors[1] < errors[0] + worse
    for _, stats in shared:
        assert stats["evaluations"] == stats["shared"]["evaluations"] + sum(e["evaluations"] for e in stats["eyes"])
        assert stats["shared"]["texels"] > 500
    # What both eyes see is as before: sharing changes who shades it.
    seen = [film[0][1]["texels"]["seen"] for film in (apart, shared)]
    assert seen[0] == pytest.approx(seen[1], rel=0.01)  # shared tiles have the rate of the viewer midway


def test_shared_tiles_are_shaded_for_a_viewer_midway(make):
    renderer, _ = _film(make, policy="every", share=1.0, frames=2)
    middle, _ = _film(make, policy="every", stereo=False, frames=2)
    view, alone = renderer.view, middle.view
    left, right = (eye.shader.radiance.numpy().reshape(-1, 4)[:, :3] for eye in (view.left, view.right))
    expected = alone.shader.radiance.numpy().reshape(-1, 4)[:, :3]
    both = (view.middle.shader.done.numpy() > 0) & (alone.shader.done.numpy() > 0)
    assert both.sum() > 5000
    assert expected[both].max() > 0.3
    assert np.array_equal(left[both], expected[both])
    assert np.array_equal(right[both], expected[both])
    rates = [t.shader.rate.numpy()[view.shared > 0] for t in (view.left, view.right, view.middle)]
    assert np.array_equal(rates[0], rates[2])
    assert np.array_equal(rates[1], rates[2])


def test_tiles_that_change_sides_are_shaded_at_once(make):
    """A budget that refreshes next to nothing: what is shaded then came into view or changed sides."""
    camera = _Walk(Turning(0.08))
    renderer = make(camera=camera, policy="staggered", budget=1.0, share=0.02)
    view = renderer.view
    _step(renderer, camera, 0)
    became = {True: 0, False: 0}
    for k in range(1, 8):
        before = view.shared.copy()
        _step(renderer, camera, k)
        for shared in (True, False):
            changed = (view.shared != before) & (view.shared == shared)
            for texture in (view.middle,) if shared else (view.left.texture, view.right.texture):
                seen, shaded = texture.shader.tile_seen.numpy()[changed], texture.shader.tile_shaded.numpy()[changed]
                assert np.array_equal(seen, shaded)
                became[shared] += int((seen > 0).sum())
    assert min(became.values()) > 5


def test_a_still_scene_costs_nothing(make):
    for share in (None, 0.01):
        renderer = make(policy="adaptive", share=share)
        frames = [renderer.frame(0) for _ in range(60)]
        spent = [frame.stats["evaluations"] for frame in frames]
        assert spent[0] > 1000
        assert spent[-2:] == [0, 0]
        before = [eye.copy() for eye in renderer.frame(0).eyes]
        assert np.array_equal(before, renderer.frame(0).eyes)


def test_a_second_run_repeats_the_first(make):
    for options in (POLICIES["adaptive"], POLICIES["staggered"]):
        renderer, _ = _film(make, **options, share=0.01, frames=3)
        runs = []
        for _ in range(2):
            renderer.restart()
            runs.append([_step(renderer, renderer.camera, k) for k in range(3)])
        for (eyes, stats), (same, others) in zip(*runs, strict=True):
            assert np.array_equal(eyes, same)
            assert stats["evaluations"] == others["evaluations"]


def test_the_right_eye_sees_things_further_left(make):
    distance = 0.3
    eyes = make(space="screen", eye_distance=distance).frame(0).eyes
    columns = [np.flatnonzero((eye.sum(2) > 0).any(axis=0)) for eye in eyes]
    middle = [0.5 * (c[0] + c[-1]) for c in columns]
    camera = Turning().at(0)
    disparity = distance / np.linalg.norm(camera.eye) * 0.5 * SIZE[1] / np.tan(0.5 * camera.fov_y)
    assert disparity > 10
    # A sphere is seen a little nearer than its centre, and its outline is found to a pixel.
    assert middle[0] - middle[1] == pytest.approx(disparity, abs=0.08 * disparity + 1)


def test_the_eyes_stand_a_thirtieth_of_the_distance_apart(make):
    renderer = make(space="screen")
    left, right = renderer.view.cameras(renderer.camera.at(0))
    assert renderer.eye_distance == pytest.approx(np.linalg.norm(renderer.camera.at(0).eye) / 30)
    assert np.linalg.norm(right.eye - left.eye) == pytest.approx(renderer.eye_distance)
    assert np.allclose(left.view[:3, :3], right.view[:3, :3])
    assert np.allclose(0.5 * (left.eye + right.eye), renderer.camera.at(0).eye)
    reference = make(policy="every").per_pixel()
    assert np.array_equal(reference.frame(0).eyes, renderer.frame(0).eyes)


def test_samples_lie_in_their_quadrants():
    triangle = np.full((20, 19), -1, np.int32)
    triangle[2:13, 3:17] = 4
    found = quadrant_samples(triangle)
    assert found.shape == (9, 4)
    for tile, quadrant in np.ndindex(found.shape):
        y, x = 8 * (tile // 3) + 4 * (quadrant // 2), 8 * (tile % 3) + 4 * (quadrant % 2)
        cell = triangle[y : y + 4, x : x + 4]
        at = found[tile, quadrant]
        assert (at >= 0) == (cell >= 0).any()
        if at >= 0:
            assert y <= at // 19 < y + 4
            assert x <= at % 19 < x + 4
            assert triangle.flat[at] == 4
    assert found[4, 0] == 9 * 19 + 9  # a whole quadrant's inner texel


BAD = {
    "eye_distance must": ({"eye_distance": 0.0}, "eye distance must be a positive number"),
    "eye_distance nan": ({"eye_distance": float("nan")}, "eye distance must be a positive number"),
    "mono distance": ({"stereo": False, "eye_distance": 0.1}, "eye_distance takes two eyes"),
    "mono share": ({"stereo": False, "share": 0.1}, "share takes two eyes"),
    "negative": ({"share": -0.1}, r"share must be a difference in \[0, 1\]"),
    "nan": ({"share": float("nan")}, r"share must be a difference in \[0, 1\]"),
    "screen": ({"share": 0.1, "space": "screen"}, "share takes textures"),
    "target": ({"share": 0.1, "policy": "adaptive", "target_flip": 0.02}, "share and target_flip exclude each other"),
}


@pytest.mark.parametrize(("options", "message"), BAD.values(), ids=BAD)
def test_bad_options_are_one_line(make, options, message):
    with pytest.raises(ValueError, match=message) as caught:
        make(**options)
    assert "\n" not in str(caught.value)


def test_a_shot_holds_both_eyes_side_by_side(make, tmp_path):
    renderer = make(policy="every", share=0.01)
    twin = renderer.per_pixel()
    report = render_shot(renderer, tmp_path, range(1), reference=twin, exr=True)
    renderer.restart()
    eyes = [tonemap(eye) for eye in renderer.frame(0).eyes]
    expected = [tonemap(eye) for eye in twin.frame(0).eyes]
    picture = read_image(tmp_path / "frames" / "0000.png")[0]
    assert picture.shape == (SIZE[1], 2 * SIZE[0], 3)
    assert np.abs(picture - np.hstack(eyes)).max() < 3e-3
    assert read_image(tmp_path / "frames" / "0000.exr")[0].shape == picture.shape
    assert read_image(tmp_path / "reference" / "0000.png")[0].shape == picture.shape
    error = report["frames"][0]["error"]
    for name, measure in (("psnr", metrics.psnr), ("ssim", metrics.ssim), ("flip", lambda a, b: metrics.flip(a, b)[0])):
        each = [measure(a, b) for a, b in zip(expected, eyes, strict=True)]
        assert error[name] == pytest.approx(np.mean(each), rel=1e-4)
    summary = json.loads((tmp_path / "report.json").read_text())["summary"]
    assert summary["stereo"]["eye_distance"] == pytest.approx(renderer.eye_distance, rel=1e-5)
    assert summary["shared"]["tiles"] > 10
    with pytest.raises(ValueError, match="as many eyes"):
        render_shot(renderer, tmp_path, range(1), reference=make(stereo=False, space="screen"))
