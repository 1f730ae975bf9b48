"""Mesh sequences: merging, names, looping, normals, tangents, bounds, digests, and what bad input says."""

import subprocess
import sys

import numpy as np
import pytest

from tests.tiny_gltf import TRIANGLE, TinyGltf
from warp_neumat.pipeline.sequence import MeshSequence

QUARTER_Y = [0.0, 0.5**0.5, 0.0, 0.5**0.5]


def _sphere(rings=12, sectors=24):
    """A unit sphere with uv: u along the equator to the east, v from the north pole down."""
    v, u = np.meshgrid(np.linspace(0, 1, rings + 1), np.linspace(0, 1, sectors + 1), indexing="ij")
    theta, phi = np.pi * v, 2 * np.pi * u
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    index = np.arange(u.size).reshape(u.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    return points.reshape(-1, 3), faces, np.stack([u, v], -1).reshape(-1, 2)


def _face_normals(points, faces):
    a, b, c = (points[faces[:, k]] for k in range(3))
    n = np.cross(b - a, c - a)
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def _check_frame(frame, count):
    for array, width in ((frame.points, 3), (frame.normals, 3), (frame.tangents, 4)):
        assert array.shape == (count, width)
        assert array.dtype == np.float32
        assert array.flags.c_contiguous
        assert np.isfinite(array).all()
    t = frame.tangents[:, :3]
    np.testing.assert_allclose(np.linalg.norm(frame.normals, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(t, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose((frame.normals * t).sum(axis=1), 0, atol=2e-6)
    assert set(np.unique(frame.tangents[:, 3])) <= {-1.0, 1.0}


# ---- merging and names


def _scene(tmp_path):
    """Two nodes place one mesh of two primitives; a third node, mirrored, a mesh of one."""
    file = TinyGltf()
    file.tree["materials"] = [{"name": "Bronze", "doubleSided": True}, {"name": "Glass"}]
    uv = file.add([[0, 0], [1, 0], [0, 1]], "VEC2")
    normal = file.add([[0, 0, 1]] * 3, "VEC3")
    mesh = file.mesh(TRIANGLE, [0, 1, 2], name="Shield", primitive={"material": 0}, NORMAL=normal, TEXCOORD_0=uv)
    second = {"attributes": {"POSITION": file.add(TRIANGLE, "VEC3"), "NORMAL": normal}, "material": 1}
    file.tree["meshes"][mesh]["primitives"].append(second)
    file.node(mesh=mesh, name="Left", translation=[-5, 0, 0])
    file.node(mesh=mesh, name="Right", translation=[5, 0, 0])
    lone = file.mesh(TRIANGLE, [0, 1, 2], name="Plate", NORMAL=normal, TEXCOORD_0=uv)
    file.node(mesh=lone, name="Left", scale=[-1, 1, 1])
    return file.write(tmp_path / "scene.glb")


def test_scene_becomes_one_vertex_and_one_face_array(tmp_path):
    scene = MeshSequence.load(_scene(tmp_path))
    assert scene.frame_count == 1
    assert scene.vertex_count == 15
    assert scene.faces.dtype == np.int32
    assert scene.faces[:4].tolist() == [[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 10, 11]]
    assert scene.face_mesh.tolist() == [0, 1, 2, 3, 4]
    assert scene.mesh_names == ["Left:Bronze", "Left:Glass", "Right:Bronze", "Right:Glass", "Left"]
    assert scene.mesh_aliases[0] == ("Left:Bronze", "Left", "Shield", "Bronze")
    assert scene.material_names == ["Bronze", "Glass", "default"]
    assert scene.face_material.tolist() == [0, 1, 0, 1, 2]
    assert scene.face_double_sided.tolist() == [True, False, True, False, False]
    assert np.isfinite(scene.uv[:3]).all()
    assert np.isnan(scene.uv[3:6]).all()
    points = scene.frame(0).points
    np.testing.assert_array_equal(points[6:9], TRIANGLE + np.float32([5, 0, 0]))


def test_mirrored_node_flips_its_winding_and_keeps_its_normals(tmp_path):
    scene = MeshSequence.load(_scene(tmp_path))
    frame = scene.frame(0)
    _check_frame(frame, 15)
    np.testing.assert_allclose(_face_normals(frame.points, scene.faces), [[0, 0, 1]] * 5, atol=1e-6)
    np.testing.assert_allclose(frame.normals, [[0, 0, 1]] * 15, atol=1e-6)
    np.testing.assert_allclose(frame.tangents[12:], [[-1, 0, 0, 1]] * 3, atol=1e-6)  # u runs to −x now, v still to +y
    np.testing.assert_allclose(frame.tangents[:3], [[1, 0, 0, -1]] * 3, atol=1e-6)


@pytest.mark.parametrize(
    ("pattern", "expected"),
    [("left", [0, 1, 4]), ("*GLASS", [1, 3]), ("shield", [0, 1, 2, 3]), ("Right:Bronze", [2]), ("*", [0, 1, 2, 3, 4])],
)
def test_select_takes_node_mesh_and_material_names_in_any_case(tmp_path, pattern, expected):
    assert MeshSequence.load(_scene(tmp_path)).select(pattern).tolist() == expected


def test_select_without_a_match_lists_the_names(tmp_path):
    message = (
        r"scene: no mesh or material matches 'gold'; there are Left:Bronze, Left, Shield, Bronze, Left:Glass, Glass"
    )
    with pytest.raises(ValueError, match=message):
        MeshSequence.load(_scene(tmp_path)).select("gold")


def test_equal_names_become_unique(tmp_path):
    file = TinyGltf()
    for name in ("A", "A", "A#2", None):
        file.node(mesh=file.mesh(TRIANGLE, name="M"), **({"name": name} if name else {}))
    names = MeshSequence.load(file.write(tmp_path / "a.glb")).mesh_names
    assert names[0] == "A"
    assert names[2:] == ["A#2", "M"]
    assert len(set(names)) == 4


def test_double_sided_can_be_overridden(tmp_path):
    path = _scene(tmp_path)
    assert MeshSequence.load(path, double_sided=True).face_double_sided.all()
    assert not MeshSequence.load(path, double_sided=False).face_double_sided.any()


# ---- frames over time


def _moving(tmp_path, duration=1.5):
    file = TinyGltf()
    node = file.node(mesh=file.mesh(TRIANGLE, [0, 1, 2]))
    file.animate(node, "translation", [0, duration], [[0, 0, 0], [duration, 0, 0]], name="Slide")
    file.animate(node, "rotation", [0, 1], [[0, 0, 0, 1], QUARTER_Y], name="Turn")
    return file.write(tmp_path / "moving.glb")


def test_gltf_animation_loops_at_its_duration(tmp_path):
    slide = MeshSequence.load(_moving(tmp_path), fps=10)
    assert (slide.animation, slide.animation_names) == ("Slide", ["Slide", "Turn"])
    assert slide.frame_count == 15
    for index, x in ((0, 0.0), (4, 0.4), (14, 1.4), (15, 0.0), (34, 0.4), (-1, 1.4)):
        np.testing.assert_allclose(slide.frame(index).points[0], [x, 0, 0], atol=1e-6)


def test_animation_is_chosen_by_name_in_any_case(tmp_path):
    turn = MeshSequence.load(_moving(tmp_path), animation="turn", fps=8)
    assert turn.animation == "Turn"
    assert turn.frame_count == 8
    half = 0.5**0.5
    np.testing.assert_allclose(turn.frame(4).points[1], [half, 0, -half], atol=1e-6)
    np.testing.assert_allclose(turn.frame(4).normals, [[half, 0, half]] * 3, atol=1e-6)


def test_static_scene_repeats_one_cached_frame(tmp_path):
    scene = MeshSequence.load(_scene(tmp_path))
    assert scene.frame(0) is scene.frame(7)
    with pytest.raises(ValueError, match="read-only"):
        scene.frame(0).points[0] = 0


def test_animation_that_moves_nothing_is_static(tmp_path):
    file = TinyGltf()
    file.node(mesh=file.mesh())
    file.animate(file.node(), "translation", [0, 2], np.zeros((2, 3)))
    assert MeshSequence.load(file.write(tmp_path / "a.glb")).frame_count == 1


def test_array_sequence_ends(tmp_path):
    points, faces, uv = _sphere()
    stretch = np.stack([points * [1, 1, s] for s in (1.0, 2.0, 3.0)])
    np.savez(tmp_path / "a.npz", points=stretch, faces=faces, uv=uv, fps=12)
    sequence = MeshSequence.load(tmp_path / "a.npz")
    assert (sequence.frame_count, sequence.fps, sequence.animation_names) == (3, 12.0, [])
    np.testing.assert_array_equal(sequence.frame(2).points, stretch[2].astype(np.float32))
    assert MeshSequence.load(tmp_path / "a.npz", fps=5).fps == 5.0
    for index in (3, -1):
        with pytest.raises(IndexError, match=rf"a: frame {index} does not exist, there are 3 \(0 to 2\)"):
            sequence.frame(index)


def test_folder_of_frames_plays(tmp_path):
    for k in range(11):
        (tmp_path / f"f{k}.obj").write_text(f"v {k} 0 0\nv {k + 1} 0 0\nv {k} 1 0\nf 1 2 3\n")
    sequence = MeshSequence.load(tmp_path)
    assert sequence.frame_count == 11
    assert [sequence.frame(k).points[0, 0] for k in (2, 10)] == [2, 10]


def test_bounds_cover_all_frames(tmp_path):
    slide = MeshSequence.load(_moving(tmp_path), fps=10)
    low, high = slide.bounds()
    np.testing.assert_allclose(low, [0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(high, [2.4, 1, 0], atol=1e-6)
    np.testing.assert_allclose(slide.bounds([5])[1], [1.5, 1, 0], atol=1e-6)


def test_digest_names_shape_and_not_animation(tmp_path):
    path = _moving(tmp_path)
    digest = MeshSequence.load(path).digest()
    assert digest == MeshSequence.load(path, animation="Turn", fps=5).digest()
    assert len(digest) == 32
    points, faces, uv = _sphere()
    digests = {
        MeshSequence.from_arrays(*arrays).digest()
        for arrays in ((points, faces, uv), (points, faces), (points * 2, faces, uv), (points, faces[::-1], uv))
    }
    assert len(digests) == 4


# ---- normals and tangents


def test_smooth_normals_of_a_sphere_point_outward_across_its_seam():
    points, faces, uv = _sphere(24, 48)
    frame = MeshSequence.from_arrays(points, faces, uv).frame(0)
    _check_frame(frame, len(points))
    assert (frame.normals * points).sum(axis=1).min() > 0.9999  # seen 0.999996
    seam = np.flatnonzero(uv[:, 0] == 0)[1:-1]
    np.testing.assert_allclose(frame.normals[seam], frame.normals[seam + 48], atol=1e-6)


def test_corner_angles_and_not_areas_weigh_smooth_normals():
    """At a cube's corner three right angles count alike, although one face is split into two triangles there."""
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]], float)
    faces = [[0, 2, 4], [0, 4, 1], [0, 3, 2], [0, 1, 3]]
    n = MeshSequence.from_arrays(x, np.array(faces)).frame(0).normals[0]
    np.testing.assert_allclose(n, -np.ones(3) / np.sqrt(3), atol=1e-6)


def test_tangents_follow_u_and_bitangents_run_up_in_the_picture():
    points, faces, uv = _sphere(24, 48)
    frame = MeshSequence.from_arrays(points, faces, uv).frame(0)
    inner = np.abs(points[:, 2]) < 0.95
    east = np.stack([-points[:, 1], points[:, 0], 0 * points[:, 0]], 1)
    east /= np.maximum(np.linalg.norm(east, axis=1, keepdims=True), 1e-9)
    north = np.cross(points, east)  # v falls to the north
    bitangent = np.cross(frame.normals, frame.tangents[:, :3]) * frame.tangents[:, 3:]
    assert (frame.tangents[:, :3] * east).sum(axis=1)[inner].min() > 0.99
    assert (bitangent * north).sum(axis=1)[inner].min() > 0.99


def test_mirrored_uv_turns_the_handedness():
    points, faces, uv = _sphere()
    plain = MeshSequence.from_arrays(points, faces, uv).frame(0).tangents
    turned = MeshSequence.from_arrays(points, faces, uv * [-1, 1]).frame(0).tangents
    inner = np.abs(points[:, 2]) < 0.95
    np.testing.assert_allclose(turned[inner], -plain[inner], atol=1e-5)


def test_computed_tangents_match_the_authored_ones(data):
    """Khronos' FlightHelmet stores tangents; those from its uv agree in direction and handedness."""
    helmet = MeshSequence.load(data / "meshes" / "FlightHelmet" / "FlightHelmet.gltf")
    authored = helmet.frame(0)
    computed = MeshSequence.from_arrays(
        authored.points, helmet.faces, helmet.uv, vertex_normals=authored.normals
    ).frame(0)
    cosine = (authored.tangents[:, :3] * computed.tangents[:, :3]).sum(axis=1)
    assert np.percentile(cosine, 5) > 0.99  # seen 0.996; the rest lies at uv seams that the exporter split otherwise
    assert (authored.tangents[:, 3] == computed.tangents[:, 3]).mean() > 0.999


def test_gltf_without_normals_is_flat_with_split_vertices(tmp_path):
    file = TinyGltf()
    quad = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.5], [0, 1, 0]], np.float32)
    uv = file.add(quad[:, :2], "VEC2")
    joints, weights = file.add(np.zeros((4, 4)), "VEC4", np.uint8), file.add([[1, 0, 0, 0]] * 4, "VEC4")
    mesh = file.mesh(quad, [0, 1, 2, 0, 2, 3], TEXCOORD_0=uv, JOINTS_0=joints, WEIGHTS_0=weights)
    file.tree["skins"] = [{"joints": [0]}]
    node = file.node(mesh=mesh, skin=0)
    file.animate(node, "rotation", [0, 1], [[0, 0, 0, 1], QUARTER_Y])
    path = file.write(tmp_path / "a.glb")
    flat, smooth = MeshSequence.load(path, fps=4), MeshSequence.load(path, normals="smooth")
    assert (flat.vertex_count, smooth.vertex_count) == (6, 4)
    np.testing.assert_array_equal(flat.uv, quad[[0, 1, 2, 0, 2, 3], :2])
    for index in (0, 3):
        frame = flat.frame(index)
        _check_frame(frame, 6)
        expected = np.repeat(_face_normals(frame.points, flat.faces), 3, axis=0)
        np.testing.assert_allclose(frame.normals, expected, atol=1e-6)


def test_flat_is_forced_on_a_mesh_with_normals():
    points, faces, uv = _sphere()
    sequence = MeshSequence.from_arrays(points, faces, uv, vertex_normals=points, normals="flat")
    frame = sequence.frame(0)
    _check_frame(frame, 3 * len(faces))
    corner = frame.normals[sequence.faces]
    np.testing.assert_array_equal(corner[:, 0], corner[:, 2])
    solid = np.abs(frame.points[sequence.faces].mean(axis=1)[:, 2]) < 0.95  # faces at the poles have no area
    expected = _face_normals(frame.points, sequence.faces[solid])
    np.testing.assert_allclose(corner[solid, 1], expected, atol=1e-5)


def test_unusable_normals_fall_back_to_the_face_and_then_to_z():
    points = np.array([[0, 0, 0], [0, 1, 0], [0, 0, 1], [5, 5, 5]], float)  # a triangle that faces +x, a loose vertex
    normals = np.array([[0, 0, 0], [np.nan, 0, 1], [0, 3, 0], [0, 0, 0]], float)
    frame = MeshSequence.from_arrays(points, [[0, 1, 2]], vertex_normals=normals).frame(0)
    _check_frame(frame, 4)
    np.testing.assert_allclose(frame.normals, [[1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], atol=1e-6)


def test_degenerate_faces_are_counted_and_never_spoil_a_frame():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [3e-6, 0, 0], [0.1, 0.3, 7]], float)
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 2], [4, 4, 4], [0, 3, 1]])
    for normals in ("smooth", "flat"):
        sequence = MeshSequence.from_arrays(points, faces, np.zeros((6, 2)), normals=normals)
        assert sequence.degenerate_faces == 4
        assert len(sequence.faces) == 5
        _check_frame(sequence.frame(0), sequence.vertex_count)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_scale_does_not_change_directions(scale):
    points, faces, uv = _sphere()
    plain = MeshSequence.from_arrays(points, faces, uv).frame(0)
    scaled = MeshSequence.from_arrays(points * scale, faces, uv).frame(0)
    _check_frame(scaled, len(points))
    np.testing.assert_allclose(scaled.normals, plain.normals, atol=1e-5)
    np.testing.assert_allclose(scaled.tangents, plain.tangents, atol=1e-4)


def test_parts_from_arrays_keep_their_faces():
    points, faces, _ = _sphere()
    face_mesh = (points[faces].mean(axis=1)[:, 2] > 0).astype(int)
    sequence = MeshSequence.from_arrays(points, faces, face_mesh=face_mesh, mesh_names=["south", "north"])
    north = sequence.faces[sequence.face_mesh == sequence.select("north")[0]]
    np.testing.assert_allclose(sequence.frame(0).points[north], points[faces[face_mesh == 1]], atol=1e-6)


# ---- real scenes


@pytest.mark.parametrize(("animation", "frames"), [("Survey", 103), ("Walk", 21), ("Run", 35)])
def test_fox_plays_whole(data, animation, frames):
    fox = MeshSequence.load(data / "animation" / "Fox.glb", animation=animation)
    assert fox.frame_count == frames  # round(duration · 30)
    assert (fox.vertex_count, len(fox.faces), fox.degenerate_faces) == (1728, 576, 0)
    assert fox.mesh_aliases == [("fox", "fox1", "fox_material")]
    for index in range(0, frames, 7):
        frame = fox.frame(index)
        _check_frame(frame, 1728)
        size = np.ptp(frame.points, axis=0)
        assert (size > [20, 60, 130]).all()
        assert (size < [60, 100, 190]).all()
        corners = frame.normals[fox.faces].mean(axis=1)
        np.testing.assert_allclose(corners, _face_normals(frame.points, fox.faces), atol=1e-4)


def test_flight_helmet_loads_whole(data):
    helmet = MeshSequence.load(data / "meshes" / "FlightHelmet" / "FlightHelmet.gltf")
    assert len(helmet.mesh_names) == 6
    assert helmet.mesh_aliases[0] == ("Hose_low", "HoseMat")
    assert (helmet.vertex_count, len(helmet.faces), helmet.frame_count) == (55392, 94722, 1)
    assert np.isfinite(helmet.uv).all()
    assert helmet.face_double_sided.sum() == (helmet.face_material == helmet.material_names.index("HoseMat")).sum()
    frame = helmet.frame(0)
    _check_frame(frame, helmet.vertex_count)
    agree = (frame.normals[helmet.faces].mean(axis=1) * _face_normals(frame.points, helmet.faces)).sum(axis=1) > 0
    assert agree.mean() > 0.99


def test_spot_and_bunny_load(data):
    spot = MeshSequence.load(data / "meshes" / "spot.obj")
    assert "spot" in spot.mesh_aliases[0]
    assert spot.vertex_count == 3225
    bunny = MeshSequence.load(data / "meshes" / "bunny.ply")
    assert np.isnan(bunny.uv).all()
    for sequence in (spot, bunny):
        _check_frame(sequence.frame(0), sequence.vertex_count)


# ---- what goes wrong


def test_missing_file_unknown_suffix_and_animation_are_readable(tmp_path, data):
    with pytest.raises(FileNotFoundError, match=r"nowhere.glb: no such file or folder"):
        MeshSequence.load(tmp_path / "nowhere.glb")
    (tmp_path / "a.blend").write_text("")
    with pytest.raises(ValueError, match=r"a.blend: unknown suffix .blend; use .glb .gltf .obj .ply .npz or a folder"):
        MeshSequence.load(tmp_path / "a.blend")
    with pytest.raises(ValueError, match=r"no animation named 'Sleep'; it has Survey, Walk, Run"):
        MeshSequence.load(data / "animation" / "Fox.glb", animation="Sleep")
    with pytest.raises(ValueError, match=r"boombox.glb: no animation named 'Run'; it has none"):
        MeshSequence.load(data / "meshes" / "boombox.glb", animation="Run")
    with pytest.raises(ValueError, match=r"spot.obj: no animation named 'Run'"):
        MeshSequence.load(data / "meshes" / "spot.obj", animation="Run")


def test_scene_without_triangles_is_empty(tmp_path):
    file = TinyGltf()
    file.mesh()  # placed by no node
    with pytest.raises(ValueError, match=r"a.glb: empty mesh, the scene holds no triangles"):
        MeshSequence.load(file.write(tmp_path / "a.glb"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"normals": "soft"}, r"normals must be one of auto, smooth, flat, got 'soft'"),
        ({"fps": 0}, r"fps must be a positive number, got 0"),
        ({"uv": np.zeros((2, 2))}, r"mesh: uv must have shape \(3, 2\), got \(2, 2\)"),
        ({"face_mesh": [1], "mesh_names": ["a"]}, r"face_mesh must be \(1,\) indices into 1 names"),
    ],
)
def test_wrong_options_are_readable(options, message):
    with pytest.raises(ValueError, match=message):
        MeshSequence.from_arrays(TRIANGLE, [[0, 1, 2]], **options)


def test_import_stays_light():
    code = "import sys, warp_neumat.pipeline.sequence; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"trimesh", "torch", "warp", "scipy"} & set(run.stdout.split())
