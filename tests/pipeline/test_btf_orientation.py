"""One orientation from simulated slice to fitted asset to picture: the flank that a light brightens is the same."""

import numpy as np
import pytest

pytest.importorskip("torch")

from tests.pipeline.test_renderer import Still  # noqa: E402
from warp_neumat.materials import load  # noqa: E402
from warp_neumat.pipeline.lights import PointLights  # noqa: E402
from warp_neumat.pipeline.renderer import Renderer  # noqa: E402
from warp_neumat.pipeline.sequence import MeshSequence  # noqa: E402
from warp_neumat.reference.bcf import bilinear  # noqa: E402
from warp_neumat.simulation.gonioreflectometer import Gonioreflectometer  # noqa: E402
from warp_neumat.simulation.height_fields import MicroGeometry  # noqa: E402
from warp_neumat.simulation.open_btf import open_btf  # noqa: E402
from warp_neumat.training.fit import fit  # noqa: E402

SIDE, PIXELS, FAR = 16, 64, 90.0
SPEC = f"microgeometry:leather?size={SIDE}&pebbles=2&relief=0.4&pores=0&wrinkles=0&seed=1&directions=ubo2003&bounces=0"


def direction(theta, phi):
    theta, phi = np.radians((theta, phi))
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def test_a_light_brightens_the_flanks_that_face_it():
    """A hill whose top is off the middle: +x is to the right in a slice, +y is up."""
    y, x = np.mgrid[:SIDE, :SIDE]
    hill = 3 * np.exp(-((x - 9) ** 2 + (y - 6) ** 2) / 8)
    full = np.ones((SIDE, SIDE))
    m = MicroGeometry("hill", hill, 0.6 * np.ones((SIDE, SIDE, 3)), full, 0 * full, 0 * full, 0 * full)
    lights = [direction(45, phi) for phi in (0, 90, 180, 270)]
    source = Gonioreflectometer(m, lights, [direction(0, 0)], bounces=0, cache=False)
    value = source.slices(np.stack([np.arange(4), np.zeros(4, int)], 1))[..., 0]
    flank = np.array([value[:, 6, 11], value[:, 4, 9], value[:, 6, 7], value[:, 8, 9]])  # right, top, left, bottom
    assert (flank.argmax(0) == [0, 1, 2, 3]).all()
    assert (np.diag(flank) > 2 * flank[[2, 3, 0, 1], [0, 1, 2, 3]]).all()


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("orientation")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NEUMAT_CACHE", str(folder / "cache"))
        fit(SPEC, folder / "leather.neumat", steps=2000, teacher="none", mips=1, epochs=1)
        yield open_btf(SPEC), load(folder / "leather.neumat")


def picture(material, wi, wo):
    """Return a far picture of a square that holds the texture once, and the uv of its pixels."""
    points = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # v runs down
    square = MeshSequence.from_arrays(points, np.array([[0, 1, 2], [0, 2, 3]]), uv)
    lights = PointLights(FAR * wi[None], np.full((1, 3), FAR**2))
    size = (PIXELS, PIXELS)
    camera = Still(tuple(FAR * wo), fov=2.4 / FAR, size=size)
    renderer = Renderer(square, {"*": material}, space="screen", size=size, camera=camera, lights=lights)
    image = renderer.frame(0).image
    triangle, b = renderer.view.raster.triangle.numpy(), renderer.view.raster.barycentric.numpy()
    seen = triangle >= 0
    corners = square.uv[square.faces[triangle[seen]]]
    weights = np.concatenate([1 - b[seen].sum(-1, keepdims=True), b[seen]], -1)[..., None]
    return image[seen].mean(-1), (corners * weights).sum(1)


@pytest.mark.parametrize("view", [(0, 0), (30, 90), (45, 0)])
def test_a_rendered_square_shows_the_slice(fitted, view):
    """For lights from +x, +y, −x and −y, and a viewer above, above −v or above +u."""
    source, material = fitted
    wo = direction(*view)
    values = {}
    for phi in (0, 90, 180, 270):
        wi = direction(60, phi)
        rows = [int(np.abs(d - w).max(1).argmin()) for d, w in ((source.lights, wi), (source.views, wo))]
        assert np.abs(source.lights[rows[0]] - wi).max() < 1e-5
        assert np.abs(source.views[rows[1]] - wo).max() < 1e-5
        shown, uv = picture(material, wi, wo)
        values[phi] = shown, bilinear(source.slices(np.array([rows]))[0], *uv.T, "repeat").mean(-1)
    for phi, other in ((0, 180), (90, 270)):
        shown = values[phi][0] - values[other][0]
        expected = values[phi][1] - values[other][1]
        assert len(shown) > 1000
        assert shown.mean() == pytest.approx(expected.mean(), abs=0.3 * float(expected.std()))
        assert np.corrcoef(shown, expected)[0, 1] > 0.8
        assert np.corrcoef(values[phi][0], values[phi][1])[0, 1] > 0.7
