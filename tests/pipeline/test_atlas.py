"""Layouts of real and made-up meshes: the footprint guarantee, which layout is chosen, failures, and the cache."""

import dataclasses
import hashlib

import numpy as np
import pytest

from warp_neumat.kernels.dispatch import set_worker_count
from warp_neumat.pipeline import atlas as atlas_module
from warp_neumat.pipeline import unwrap
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.sequence import MeshSequence


@dataclasses.dataclass
class Mesh:
    """What an atlas needs of a sequence, from plain arrays."""

    points: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    face_mesh: np.ndarray
    mesh_names: list

    def frame(self, index):
        return self

    def digest(self):
        return hashlib.sha256(b"".join(a.tobytes() for a in (self.points, self.faces, self.uv))).hexdigest()


def quads(*placed):
    """Return a mesh of unit-square parts; each of ``placed`` is (uv corners [4, 2], size on the mesh)."""
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    points = np.concatenate([square * size + [0, 0, 5 * i] for i, (_, size) in enumerate(placed)])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(len(placed))])
    uv = np.concatenate([np.asarray(uv, np.float32) for uv, _ in placed])
    part = np.repeat(np.arange(len(placed)), 2).astype(np.int32)
    names = [f"quad{i}" for i in range(len(placed))]
    return Mesh(points.astype(np.float32), faces.astype(np.int32), uv, part, names)


WHOLE = [[0, 0], [1, 0], [1, 1], [0, 1]]
NONE = np.full((4, 2), np.nan)


def check_guarantee(atlas, rng, count=200_000):
    """Assert that bilinear footprints of random points, corners and edge points stay in their chart, computed anew."""
    size, corners = atlas.resolution, atlas.corner_uv.astype(np.float64)
    assert atlas.corner_uv.dtype == np.float32
    assert atlas.triangle.shape == (size, size)
    assert atlas.barycentric.shape == (size, size, 2)
    faces = np.concatenate([np.arange(len(corners)).repeat(3), rng.integers(0, len(corners), count)])
    weights = rng.dirichlet([0.5, 0.5, 0.5], len(faces))
    weights[: 3 * len(corners)] = np.tile(np.eye(3), (len(corners), 1))
    edge = rng.random(len(faces)) < 0.3
    weights[edge, 0] = 0.0
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    weights[weights.sum(axis=1) == 0] = [0, 1, 0]
    point = (weights[:, :, None] * corners[faces]).sum(axis=1)
    base = np.floor(point - 0.5).astype(int)
    assert base.min() >= 0
    assert base.max() <= size - 2
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        owner = atlas.triangle[base[:, 1] + dy, base[:, 0] + dx]
        assert (owner >= 0).all()
        np.testing.assert_array_equal(atlas.chart[owner], atlas.chart[faces])


def density(atlas, sequence):
    """Return texels² on the sheet per unit of surface, for each part."""
    points = np.asarray(sequence.frame(0).points)[sequence.faces].astype(np.float64)
    surface = np.bincount(sequence.face_mesh, unwrap.triangle_areas(points))
    return np.bincount(sequence.face_mesh, np.abs(unwrap.triangle_areas(atlas.corner_uv.astype(np.float64)))) / surface


@pytest.mark.parametrize(
    ("file", "resolution", "source", "least"),
    [
        ("animation/Fox.glb", 1200, "authored", 0.37),
        ("meshes/bunny_low.ply", 500, "xatlas", 0.4),
        ("meshes/spot.obj", 500, "repacked", 0.55),
        ("meshes/FlightHelmet/FlightHelmet.gltf", 500, "repacked", 0.4),
    ],
    ids=["Fox", "bunny_low", "spot", "FlightHelmet"],
)
def test_real_meshes_hold_the_guarantee(data, rng, file, resolution, source, least):
    sequence = MeshSequence.load(data / file)
    atlas = Atlas.build(sequence, resolution, cache=False)
    check_guarantee(atlas, rng)
    assert atlas.sources == dict.fromkeys(sequence.mesh_names, source)
    assert atlas.utilisation >= least
    assert atlas.utilisation < atlas.owned / resolution**2 < 1
    if len(sequence.mesh_names) > 1:  # xatlas rounds charts up to whole texels, 5 % of the smallest ones
        parts = density(atlas, sequence)
        np.testing.assert_allclose(parts, parts.mean(), rtol=0.08)


@pytest.mark.parametrize("resolution", [64, 1200])
def test_fallback_holds_the_guarantee(data, rng, resolution):
    sequence = MeshSequence.load(data / "animation/Fox.glb")
    atlas = Atlas.build(sequence, resolution, uv="fallback", cache=False)
    check_guarantee(atlas, rng)
    assert set(atlas.sources.values()) == {"fallback"}
    assert atlas.utilisation > (0.75 if resolution == 1200 else 0.1)
    visible = unwrap.triangle_areas(sequence.frame(0).points[sequence.faces].astype(np.float64)) > 0
    if resolution == 1200:  # each triangle gets its share: cells are sized by area
        share = np.abs(unwrap.triangle_areas(atlas.corner_uv.astype(np.float64)))[visible]
        assert share.min() > 0


def test_authored_layout_is_kept_to_the_texel(data):
    sequence = MeshSequence.load(data / "animation/Fox.glb")
    atlas = Atlas.build(sequence, 800, cache=False)
    np.testing.assert_allclose(atlas.corner_uv, sequence.uv[sequence.faces] * 800, atol=1e-4)


def test_uvs_up_to_the_border_shrink_by_the_rim(rng):
    atlas = Atlas.build(quads((WHOLE, 1)), 64, cache=False)
    check_guarantee(atlas, rng)
    assert atlas.sources == {"quad0": "authored"}
    assert 0.5 < atlas.corner_uv.min() < 0.6
    assert 63.4 < atlas.corner_uv.max() < 63.5


def test_parts_share_one_texel_density(rng):
    mesh = quads((WHOLE, 1), (np.multiply(WHOLE, 0.1), 3), (NONE, 2))
    atlas = Atlas.build(mesh, 256, cache=False)
    check_guarantee(atlas, rng)
    assert atlas.sources == {"quad0": "repacked", "quad1": "repacked", "quad2": "xatlas"}
    np.testing.assert_allclose(density(atlas, mesh), density(atlas, mesh).mean(), rtol=0.03)  # whole texels, again


def test_mirrored_halves_get_places_of_their_own(rng):
    """Two squares joined along an edge that lie on each other in UV, as artists mirror a face."""
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [-1, 0, 0], [-1, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 5], [0, 5, 4]], np.int32)
    uv = np.array([[0.2, 0.2], [0.8, 0.2], [0.8, 0.8], [0.2, 0.8], [0.8, 0.2], [0.8, 0.8]], np.float32)
    mesh = Mesh(points, faces, uv, np.zeros(4, np.int32), ["mirrored"])
    atlas = Atlas.build(mesh, 128, cache=False)
    check_guarantee(atlas, rng)
    assert atlas.sources == {"mirrored": "repacked"}
    assert atlas.chart_count == 2


def test_charts_on_each_other_get_places_of_their_own(rng):
    mesh = quads((WHOLE, 1), (WHOLE, 1))
    mesh.face_mesh[:] = 0
    atlas = Atlas.build(mesh, 128, cache=False)
    check_guarantee(atlas, rng)
    assert atlas.sources == {"quad0": "repacked"}
    assert atlas.chart_count == 2


def winding_fan():
    """Return a fan that turns 1.5 times around its centre in UV: one chart, one winding, and still lying on itself."""
    angle = np.linspace(0, 3 * np.pi, 25)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate([[[0, 0, 0]], np.column_stack([ring, angle])]).astype(np.float32)
    uv = np.concatenate([[[0.5, 0.5]], 0.5 + 0.4 * ring]).astype(np.float32)
    faces = np.array([[0, i, i + 1] for i in range(1, 25)], np.int32)
    return Mesh(points, faces, uv, np.zeros(24, np.int32), ["fan"])


def test_a_chart_that_lies_on_itself_is_unwrapped_anew(rng):
    atlas = Atlas.build(winding_fan(), 256, cache=False)
    check_guarantee(atlas, rng)
    assert atlas.sources == {"fan": "xatlas"}
    assert "overlap" in atlas.notes[0]
    with pytest.raises(ValueError, match="the UVs of 'fan' cannot be kept: .* overlap"):
        Atlas.build(winding_fan(), 256, uv="authored", cache=False)


def test_degenerate_triangles_stay_beside_their_neighbours(rng):
    mesh = quads((WHOLE, 1))
    mesh.faces = np.concatenate([mesh.faces, [[0, 0, 2], [1, 2, 1]]]).astype(np.int32)
    mesh.face_mesh = np.zeros(4, np.int32)
    for uv in ("auto", "xatlas", "fallback"):
        atlas = Atlas.build(mesh, 64, uv=uv, cache=False)
        check_guarantee(atlas, rng, 1000)
        assert not np.isin(atlas.triangle, [2, 3]).any()
    mesh.points[:] = 0
    with pytest.raises(ValueError, match="none of the 4 triangles has an area in frame 0"):
        Atlas.build(mesh, 64, cache=False)


# --- xatlas fails -----------------------------------------------------------------------------------------------------


def test_time_out_gives_the_fallback(data, rng):
    sequence = MeshSequence.load(data / "meshes/bunny_low.ply")
    atlas = Atlas.build(sequence, 256, time_limit=1e-3, cache=False)
    check_guarantee(atlas, rng)
    assert atlas.sources == {"bunny_low": "fallback"}
    assert "time limit of 0.001 s reached" in atlas.notes[-1]


def test_fallback_keeps_authored_charts(rng):
    mesh = quads((WHOLE, 1), (WHOLE, 3), (NONE, 2))
    atlas = Atlas.build(mesh, 256, time_limit=1e-3, cache=False)
    check_guarantee(atlas, rng)
    assert atlas.sources == {"quad0": "repacked", "quad1": "repacked", "quad2": "fallback"}
    np.testing.assert_allclose(density(atlas, mesh), density(atlas, mesh).mean(), rtol=1e-3)


def test_a_crash_gives_the_fallback_and_is_not_cached(monkeypatch, tmp_path, rng):
    broken = tmp_path / "broken.py"
    broken.write_text("raise SystemError('no charts today')")
    with monkeypatch.context() as patched:
        patched.setattr(unwrap, "__file__", str(broken))
        atlas = Atlas.build(quads((NONE, 1)), 64, cache=tmp_path / "cache")
    check_guarantee(atlas, rng)
    assert atlas.sources == {"quad0": "fallback"}
    assert "no charts today" in atlas.notes[-1]
    assert Atlas.build(quads((NONE, 1)), 64, cache=tmp_path / "cache").sources == {"quad0": "xatlas"}


def test_a_child_killed_after_its_first_packing_still_counts(monkeypatch, tmp_path, rng):
    slow = tmp_path / "slow.py"
    slow.write_text(
        "import runpy, sys, time\n"
        f"child = runpy.run_path({unwrap.__file__!r})\n"
        "child['_child'](sys.argv[1])\n"
        "time.sleep(60)\n"
    )
    monkeypatch.setattr(unwrap, "__file__", str(slow))
    atlas = Atlas.build(quads((NONE, 1)), 64, time_limit=4.0, cache=False)
    check_guarantee(atlas, rng)
    assert atlas.sources == {"quad0": "xatlas"}
    assert "stopped after 4 s" in atlas.notes[-1]


def test_a_layout_that_breaks_the_guarantee_is_refused(monkeypatch, rng):
    def overlapping(points, faces, part, uv, chart, **options):
        corners = np.tile([[10.0, 10.0], [30.0, 10.0], [10.0, 30.0]], (len(faces), 1, 1))
        return corners, np.arange(len(faces)), True

    monkeypatch.setattr(atlas_module, "xatlas_unwrap", overlapping)
    atlas = Atlas.build(quads((NONE, 1), (NONE, 1)), 64, cache=False)
    check_guarantee(atlas, rng)
    assert set(atlas.sources.values()) == {"fallback"}
    assert "charts overlap" in atlas.notes[-1]


def test_too_many_triangles_name_the_resolution_that_fits(data, rng):
    sequence = MeshSequence.load(data / "meshes/bunny_low.ply")
    with pytest.raises(
        ValueError, match=r"948 triangles in \d+ charts do not fit a resolution of 16; .* is (\d+)"
    ) as e:
        Atlas.build(sequence, 16, uv="fallback", cache=False)
    least = int(str(e.value).rsplit(" ", 1)[1])
    check_guarantee(Atlas.build(sequence, least, uv="fallback", cache=False), rng)
    with pytest.raises(ValueError, match="do not fit"):
        Atlas.build(sequence, least - 2, uv="fallback", cache=False)


def test_progress_rises_to_one(data):
    calls = []
    Atlas.build(quads((NONE, 1)), 64, cache=False, progress=lambda fraction, text: calls.append((fraction, text)))
    fractions = [fraction for fraction, _ in calls]
    assert fractions == sorted(fractions)
    assert fractions[0] >= 0
    assert fractions[-1] == 1
    assert any("packing" in text for _, text in calls)


# --- cache and options ------------------------------------------------------------------------------------------------


def assert_same(one, two):
    for field in ("corner_uv", "chart", "triangle", "barycentric"):
        np.testing.assert_array_equal(getattr(one, field), getattr(two, field))
    assert (one.sources, one.notes) == (two.sources, two.notes)


def no_child(*args, **options):
    raise AssertionError("xatlas ran although the layout is cached")


def test_cache_gives_the_same_atlas_without_xatlas(monkeypatch, tmp_path):
    mesh = quads((WHOLE, 1), (NONE, 2))
    monkeypatch.setenv("NEUMAT_CACHE", str(tmp_path / "new" / "folder"))
    first = Atlas.build(mesh, 128)
    monkeypatch.setattr(unwrap, "_run_child", no_child)
    assert_same(first, Atlas.build(mesh, 128))
    assert_same(first, Atlas.build(mesh, 128, cache=tmp_path / "new" / "folder"))
    for other in ({"resolution": 130}, {"padding": 6}, {"uv": "xatlas"}):
        with pytest.raises(AssertionError, match="xatlas ran"):
            Atlas.build(mesh, **{"resolution": 128, **other})


@pytest.mark.parametrize("damage", ["truncated", "empty", "garbage", "flipped byte", "other mesh", "overlapping"])
def test_a_damaged_cache_file_is_made_anew(tmp_path, damage):
    mesh = quads((WHOLE, 1), (WHOLE, 2))
    first = Atlas.build(mesh, 64, uv="fallback", cache=tmp_path)
    (file,) = tmp_path.iterdir()
    content = file.read_bytes()
    if damage == "overlapping":
        with np.load(file) as data:
            arrays = dict(data)
        arrays["corner_uv"][:2] = arrays["corner_uv"][2:]
        np.savez(file, **arrays)
    elif damage == "other mesh":
        Atlas.build(quads((WHOLE, 1), (WHOLE, 2), (WHOLE, 2)), 64, uv="fallback", cache=tmp_path / "other")
        file.write_bytes(next((tmp_path / "other").iterdir()).read_bytes())
    else:
        flipped = content[:200] + bytes([content[200] ^ 255]) + content[201:]
        file.write_bytes(
            {"truncated": content[:-300], "empty": b"", "garbage": b"x" * 999, "flipped byte": flipped}[damage]
        )
    assert_same(first, Atlas.build(mesh, 64, uv="fallback", cache=tmp_path))
    assert file.read_bytes() == content


def test_a_timed_out_layout_serves_no_longer_limit(tmp_path):
    mesh = quads((NONE, 1), (NONE, 2))
    assert set(Atlas.build(mesh, 64, time_limit=1e-3, cache=tmp_path).sources.values()) == {"fallback"}
    assert set(Atlas.build(mesh, 64, time_limit=1e-4, cache=tmp_path).sources.values()) == {"fallback"}
    assert set(Atlas.build(mesh, 64, time_limit=60, cache=tmp_path).sources.values()) == {"xatlas"}
    assert set(Atlas.build(mesh, 64, time_limit=1e-3, cache=tmp_path).sources.values()) == {"xatlas"}


def test_an_unwritable_cache_is_a_note(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    atlas = Atlas.build(quads((WHOLE, 1)), 64, cache=blocked)
    assert "not cached" in atlas.notes[-1]


def test_atlas_does_not_depend_on_workers(data):
    sequence = MeshSequence.load(data / "animation/Fox.glb")
    try:
        set_worker_count(1)
        one = Atlas.build(sequence, 256, uv="xatlas", cache=False)
        set_worker_count(2)
        assert_same(one, Atlas.build(sequence, 256, uv="xatlas", cache=False))
    finally:
        set_worker_count(None)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": 1201}, "resolution must be even and in 16 … 16384, got 1201"),
        ({"resolution": 8}, "resolution must be even"),
        ({"resolution": 16386}, "resolution must be even"),
        ({"padding": 1}, "padding must be in 2 … 64 texels, got 1"),
        ({"uv": "best"}, "uv must be one of auto, authored, xatlas, fallback, got 'best'"),
        ({"time_limit": 0.0}, "time_limit must be a positive number of seconds, got 0"),
        ({"uv": "authored"}, "the UVs of 'quad0' cannot be kept: 2 of 2 triangles have no UVs; use uv='auto'"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        Atlas.build(quads((NONE, 1)), **{"resolution": 64, "cache": False, **options})
