"""The renderer on a sheet that charts stream onto, beside a whole atlas."""

import numpy as np
import pytest

from tests.fake_assets import random_neubrdf
from tests.pipeline.test_renderer import LIGHTS, SIZE, Still, Turning, _dome
from warp_neumat import metrics
from warp_neumat.materials.neubrdf import NeuBRDF
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.renderer import Renderer
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.pipeline.tonemap import tonemap

BALLS, LAYOUT, SHEET = 9, 512, 256


@pytest.fixture(scope="module")
def balls():
    """A ring of balls: a camera among them sees a few at a time."""
    points, faces, uv = _dome(10, 20, radius=0.5)
    at = np.arange(BALLS) * 2 * np.pi / BALLS
    places = 3.0 * np.stack([np.sin(at), 0 * at, np.cos(at)], axis=1)
    return MeshSequence.from_arrays(
        np.concatenate([points + p for p in places]).astype(np.float32),
        np.concatenate([faces + k * len(points) for k in range(BALLS)]),
        np.tile(uv, (BALLS, 1)),
        face_mesh=np.repeat(np.arange(BALLS), len(faces)),
        mesh_names=[f"ball{k}" for k in range(BALLS)],
    )


@pytest.fixture(scope="module")
def material():
    tensors, header = random_neubrdf(np.random.default_rng(3), nside=2, bits=3)
    tensors["codebook"] = (0.25 * tensors["codebook"].astype(np.float32)).astype(np.float16)
    return NeuBRDF(tensors, header)


@pytest.fixture(scope="module")
def layout(balls, tmp_path_factory):
    return Atlas.layout(balls, LAYOUT, cache=tmp_path_factory.mktemp("cache"))


class Inside(Turning):
    """Turns about itself in the middle of the ring, a sixth of a radian a frame."""

    def at(self, frame):
        target = (4 * np.sin(frame / 6), 0.0, 4 * np.cos(frame / 6))
        return Still((0.0, 0.0, 0.0), target=target, fov=0.9).at(0)


def _renderer(balls, material, atlas, **options):
    shot = {"size": SIZE, "camera": Inside(), "lights": LIGHTS, "interval": 2} | options
    return Renderer(balls, {"*": material}, atlas=atlas, **shot)


@pytest.mark.parametrize("policy", ["every", "fixed", "staggered", "adaptive"])
def test_charts_stream_and_the_picture_is_that_of_the_whole(balls, material, layout, policy):
    streamed = _renderer(balls, material, layout, resident=SHEET, policy=policy)
    texture = streamed.view.texture.shader.radiance
    poison = np.full((SHEET * SHEET, 4), np.nan, np.float16)
    poison[:, 3] = -1
    texture.assign(poison.ravel())
    reference, seen, moved = streamed.per_pixel(), set(), 0
    for k in range(16):
        frame = streamed.frame(k)
        assert np.isfinite(frame.image).all(), f"frame {k} reads texels that nobody shaded"
        charts = frame.stats["charts"]
        seen.add(charts["seen"])
        moved += charts["streamed_in"]
        error = metrics.flip(tonemap(reference.frame(k).image), tonemap(frame.image))[0]
        assert error < 0.04, f"frame {k}"  # worst seen 0.022, with fixed
    assert moved > charts["resident"]  # they came and went
    assert charts["charts"] >= BALLS > max(seen)


@pytest.mark.parametrize("share", [None, 0.02])
def test_two_eyes_stream_too(balls, material, layout, share):
    streamed = _renderer(balls, material, layout, resident=SHEET, stereo=True, share=share, eye_distance=0.1)
    reference = streamed.per_pixel()
    for k in range(8):
        frame, expected = streamed.frame(k), reference.frame(k)
        for ours, theirs in ((frame.image, expected.image), (frame.right, expected.right)):
            assert metrics.flip(tonemap(theirs), tonemap(ours))[0] < 0.04


def test_a_layout_needs_a_sheet(balls, material, layout):
    with pytest.raises(ValueError, match="atlas is a layout without texels; give resident"):
        _renderer(balls, material, layout)
    with pytest.raises(ValueError, match="resident must be a multiple of 8"):
        _renderer(balls, material, layout, resident=100)


def test_tiles_that_are_due_may_be_replaced(balls, material, layout):
    """All that is seen is due, and then other charts lie there: no tile is both due and new."""
    streamed = _renderer(balls, material, layout, resident=SHEET, policy="staggered", interval=0)
    for k in range(3):
        streamed.frame(k)
    schedule = streamed.view.schedule
    schedule.plan(True)
    due = np.flatnonzero(schedule.shader.due.numpy())
    assert len(due) > 20
    schedule.void([(0, 0, SHEET, SHEET // 2)])
    below = due[due >= schedule.shader.tiles // 2]
    assert 0 < len(below) < len(due)
    assert np.array_equal(schedule._due, below)


def test_a_film_is_the_same_again(balls, material, layout):
    streamed = _renderer(balls, material, layout, resident=SHEET, policy="adaptive")
    first, again = (list(streamed.render(range(10))) for _ in range(2))
    for one, other in zip(first, again, strict=True):
        assert one.stats["evaluations"] == other.stats["evaluations"]
        assert np.array_equal(one.image, other.image)
