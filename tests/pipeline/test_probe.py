"""A target for FLIP, held through the renderer by probes."""

import numpy as np
import pytest

from tests.fake_assets import random_neubrdf
from tests.pipeline.test_renderer import LIGHTS, Turning, _dome
from warp_neumat import metrics
from warp_neumat.materials.neubrdf import NeuBRDF
from warp_neumat.pipeline.camera import Camera
from warp_neumat.pipeline.probe import EVERY, WINDOW
from warp_neumat.pipeline.renderer import Renderer
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.pipeline.tonemap import tonemap

SIZE = (224, 160)


class Slow(Turning):
    """A camera that runs around the origin, a tenth of a radian a frame."""

    def at(self, frame):
        eye = (3 * np.sin(0.1 * frame), 1.0, 3 * np.cos(0.1 * frame))
        return Camera.look_at(eye, (0, 0, 0), fov_y=0.7, width=SIZE[0], height=SIZE[1], near=0.1, far=100.0)


def _renderer(target):
    points, faces, uv = _dome(20, 40)
    tensors, header = random_neubrdf(np.random.default_rng(3), nside=2, bits=3)
    tensors["codebook"] = (0.25 * tensors["codebook"].astype(np.float32)).astype(np.float16)
    sphere = MeshSequence.from_arrays(points, faces, uv)
    shot = {"atlas": 256, "size": SIZE, "camera": Slow(), "lights": LIGHTS, "gain": 0.5}
    return Renderer(sphere, {"*": NeuBRDF(tensors, header)}, target_flip=target, **shot)


@pytest.mark.parametrize("target", [0.03, 0.06])
def test_a_target_is_held(target):
    ours, flips, spent = _renderer(target), [], []
    reference = ours.per_pixel()
    for k in range(48):
        frame = ours.frame(k)
        shown, expected = (tonemap(image, -1.0) for image in (frame.image, reference.frame(k).image))
        flips.append(metrics.flip(expected, shown)[0])
        spent.append(frame.stats["probe"])
        assert frame.stats["evaluations"] >= spent[-1]
    assert np.mean(flips) == pytest.approx(target, rel=0.25)  # of a small picture few windows are seen
    assert ours.policy.target.mean == pytest.approx(np.mean(flips), rel=0.3)
    probed = np.array(spent) > 0
    assert probed[EVERY - 1 :: EVERY].mean() > 0.9  # a window may lie where no light falls
    assert not probed[::EVERY].any()
    assert max(spent) <= len(LIGHTS) * WINDOW**2


def test_a_picture_of_nothing_is_not_probed():
    ours = _renderer(0.05)
    ours.camera = Slow()
    ours.camera.at = lambda frame: Camera.look_at(
        (3, 0, 0), (9, 0.1 * frame, 0), fov_y=0.7, width=SIZE[0], height=SIZE[1], near=0.1, far=100.0
    )
    for k in range(4):
        frame = ours.frame(k)
        assert (frame.stats["probe"], frame.stats["evaluations"]) == (0, 0)
