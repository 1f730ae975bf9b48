"""What a textured material is told of a sample, uv and mip level, seen through a material that shows just that."""

import dataclasses
import functools
import types

import numpy as np
import pytest
import warp as wp

from warp_neumat.materials.base import Material, Shader
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.camera import Camera, CameraPath
from warp_neumat.pipeline.lights import PointLights
from warp_neumat.pipeline.renderer import SKIPS, Renderer
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.reference.shade import pixel_lod

SIZE = (97, 61)
DARK = PointLights(np.array([[0.0, 0.0, 9.0]]), np.array([[0.0, 0.0, 0.0]]))


@wp.struct
class Nothing:
    unused: int


@dataclasses.dataclass(frozen=True)
class Bare:
    def scratch(self, lanes):
        return 0


@functools.cache
def _functions(layout, lanes):
    L = lanes

    @wp.func
    def view(
        arguments: Nothing,
        place: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
        emitted: wp.array(dtype=wp.float32),
    ):
        for l in range(3 * L):
            emitted[l] = place[l]

    @wp.func
    def light(
        arguments: Nothing,
        wi: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
        value: wp.array(dtype=wp.float32),
    ):
        for l in range(3 * L):
            value[l] = 0.0

    return types.SimpleNamespace(view=view, light=light, Arguments=Nothing)


class Probe(Material):
    """Emits (u, v, mip level)."""

    kind = name = "probe"

    def __init__(self, texels):
        self.texels = texels

    def eval(self, uv, wi, wo):
        raise NotImplementedError

    def shader(self):
        return Shader(_functions, Bare(), Nothing(), self.texels)


class Still(CameraPath):
    def __init__(self, eye, target=(0, 0, 0), size=SIZE):
        self._camera = Camera.look_at(eye, target, fov_y=0.7, width=size[0], height=size[1], near=0.1, far=100.0)

    def at(self, frame):
        return self._camera


def _sheet(middle=(-0.2, 0.5)):
    """A square of 3×3 quads in z = 0, uv the right way up; its rows and columns are stretched differently."""
    x = np.array([-1.0, *middle, 1.0])
    points = np.stack([*np.meshgrid(x, -x), np.zeros((4, 4))], -1).reshape(-1, 3).astype(np.float32)
    u = np.array([0.0, 0.25, 0.5, 1.0])
    uv = np.stack(np.meshgrid(u, u), -1).reshape(-1, 2).astype(np.float32)
    i, j = (k.ravel() for k in np.meshgrid(range(3), range(3), indexing="ij"))
    a = 4 * i + j
    faces = np.concatenate([np.stack([a, a + 4, a + 1], 1), np.stack([a + 1, a + 4, a + 5], 1)])
    return MeshSequence.from_arrays(points, faces, uv, name="sheet")


def _reference(renderer, sequence, texels):
    """uv and level of every covered pixel, in float64."""
    triangle = renderer.view.raster.triangle.numpy()
    covered = triangle >= 0
    b1, b2 = renderer.view.raster.barycentric.numpy()[covered].astype(np.float64).T
    corners = sequence.faces[triangle[covered]]
    uv = (sequence.uv[corners].astype(np.float64) * np.stack([1 - b1 - b2, b1, b2], 1)[..., None]).sum(1)
    y, x = np.nonzero(covered)
    camera = renderer.camera.at(0)
    lod = pixel_lod(sequence.frame(0).points[corners], sequence.uv[corners], camera.ray, x + 0.5, y + 0.5, texels)
    return covered, uv, lod


@pytest.mark.parametrize("eye", [(0.3, 0.2, 3.0), (2.0, 1.6, 0.8)], ids=["facing", "grazing"])
def test_uv_and_level_of_a_pixel_match_float64(eye):
    sheet, texels = _sheet(), (512, 2048)
    renderer = Renderer(sheet, {"*": Probe(texels)}, space="screen", size=SIZE, camera=Still(eye), lights=DARK)
    frame = renderer.frame(0)
    covered, uv, lod = _reference(renderer, sheet, texels)
    assert covered.sum() > 500
    assert np.ptp(lod) > 1
    # Radiance is float16: half an ulp is 2.4e-4 in [0.5, 1] and 4e-3 in [4, 8].
    assert np.abs(frame.image[covered][:, :2] - uv).max() < 3e-4
    assert np.abs(frame.image[covered][:, 2] - lod).max() < 5e-3


def test_uv_stands_the_right_way_up():
    """u runs to the right and v down on a sheet that is seen from the front, its first row on top."""
    renderer = Renderer(
        _sheet(), {"*": Probe((64, 64))}, space="screen", size=SIZE, camera=Still((0, 0, 3.5)), lights=DARK
    )
    image = renderer.frame(0).image
    rows, columns = np.nonzero(image[..., 2] != 0)
    top, bottom = rows.min() + 1, rows.max() - 1
    left, right = columns.min() + 1, columns.max() - 1
    assert (image[top, left, :2] < 0.1).all()
    assert image[top, right, 0] > 0.9
    assert image[top, right, 1] < 0.1
    assert image[bottom, left, 0] < 0.1
    assert image[bottom, left, 1] > 0.9


def test_texture_space_takes_the_coarser_of_atlas_and_picture(tmp_path):
    sheet, texels, size = _sheet((-0.5, 0.0)), (1024, 1024), (200, 200)  # no stretch
    near, far = Still((0, 0, 3.0), size=size), Still((0, 0, 30.0), size=size)
    middle = np.s_[95:105, 95:105]

    def levels(camera, **options):
        shot = {"size": size, "camera": camera, "lights": DARK, "policy": "every", "skip": set(SKIPS) - {"rate"}}
        return Renderer(sheet, {"*": Probe(texels)}, **shot, **options).frame(0).image

    coarse = Atlas.build(sheet, 64, cache=tmp_path)
    fine = Atlas.build(sheet, 1024, cache=tmp_path)
    screen_near, screen_far = (levels(c, space="screen")[middle][..., 2].mean() for c in (near, far))
    assert screen_far == pytest.approx(screen_near + np.log2(10), abs=0.02)
    # From afar a pixel covers more than a texel of either atlas; nearby only a texel of the coarse one is larger.
    assert levels(far, atlas=coarse)[middle][..., 2].mean() == pytest.approx(screen_far, abs=0.02)
    assert levels(near, atlas=fine)[middle][..., 2].mean() == pytest.approx(screen_near, abs=0.02)
    face = coarse.triangle[32, 32]
    corners, uv = coarse.corner_uv[face], sheet.uv[sheet.faces[face]] * 1024
    per_texel = np.linalg.solve((corners[1:] - corners[0]).astype(np.float64), uv[1:] - uv[0])
    expected = np.log2(np.linalg.norm(per_texel, axis=1).max())
    assert expected > screen_near + 0.5
    assert levels(near, atlas=coarse)[middle][..., 2].max() >= expected - 0.02


def test_the_level_follows_a_mesh_that_grows():
    sheet = _sheet()
    points = sheet.frame(0).points
    growing = MeshSequence.from_arrays(np.stack([points, 2 * points]), sheet.faces, sheet.uv)
    renderer = Renderer(
        growing, {"*": Probe((512, 512))}, space="screen", size=SIZE, camera=Still((0, 0, 4.0)), lights=DARK
    )
    first, second = (renderer.frame(k).image[30, 48, 2] for k in (0, 1))
    assert second == pytest.approx(first - 1, abs=0.01)


def test_maps_need_texture_coordinates():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    bare = MeshSequence.from_arrays(square, [[0, 1, 2], [0, 2, 3]], name="bare")
    with pytest.raises(
        ValueError, match="bare: 'bare' has no texture coordinates on 2 faces, which the maps of 'probe'"
    ):
        Renderer(bare, {"*": Probe((64, 64))}, space="screen", size=SIZE, camera=Still((0, 0, 4.0)), lights=DARK)
