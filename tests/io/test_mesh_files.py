"""OBJ, PLY and npz frames: corners, uv origin, natural order, topology, and errors that name the place."""

import numpy as np
import pytest

from warp_neumat.io.mesh_files import load_mesh_frames

OBJ = """# two materials, a quad, indices of every form
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1 0.5 0.5 0.5
vt 0 0
vt 1 0 0
vt 1 0.75
vt 0 1
vn 0 0 1
vn 1 0 0
o Box
usemtl Red
f 1/1/1 2/2/1 3/3/1 4/4/1
usemtl Blue
f 1//2 4//2 5//2
g Lid
f -5 -4 \\
  -1
"""
PLY = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
property float nx
property float ny
property float nz
property float s
property float t
element face 1
property list uchar int vertex_indices
end_header
0 0 0 0 0 1 0 0
1 0 0 0 0 1 1 0
0 1 0 0 1 0 0 0.25
3 0 1 {last}
"""
PLY_BARE = """ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
property list uchar float texcoord
end_header
0 0 0
1 0 0
0 1 0
3 0 1 {last} 6 0 0 1 0 0.5 0.75
"""
WEDGE = "property list uchar float texcoord\n"


def _write(path, text):
    path.write_text(text)
    return path


def _corners(frames, t=0):
    return frames.points[t][frames.faces]


def test_obj_corners_keep_their_own_position_uv_and_normal(tmp_path):
    frames = load_mesh_frames(_write(tmp_path / "box.obj", OBJ))
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    expected = points[[[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 1, 4]]]
    np.testing.assert_array_equal(_corners(frames), expected)
    np.testing.assert_array_equal(frames.uv[frames.faces[1]], [[0, 1], [1, 0.25], [0, 0]])  # v counted down
    assert np.isnan(frames.uv[frames.faces[2:]]).all()
    assert frames.normals[0][frames.faces[0]].tolist() == [[0, 0, 1]] * 3
    assert frames.normals[0][frames.faces[2]].tolist() == [[1, 0, 0]] * 3
    assert frames.normals[0][frames.faces[3]].tolist() == [[0, 0, 0]] * 3
    assert frames.parts == [("Box", "Red"), ("Box", "Blue"), ("Lid", "Blue")]
    assert frames.face_part.tolist() == [0, 0, 1, 2]


@pytest.mark.parametrize("name", ["spot.obj", "teapot.obj"])
def test_obj_matches_a_plain_reading_of_its_lines(data, name):
    path = data / "meshes" / name
    frames = load_mesh_frames(path)
    lines = [line.split() for line in path.read_text().splitlines() if line]
    table = {
        k: np.array([r[1:3] if k == "vt" else r[1:4] for r in lines if r[0] == k], np.float32)
        for k in ("v", "vt", "vn")
    }
    corners = []
    for row in lines:
        if row[0] == "f":
            ring = [[int(i) - 1 for i in corner.split("/")] for corner in row[1:]]
            corners += [[ring[0], ring[k], ring[k + 1]] for k in range(1, len(ring) - 1)]
    v, vt, vn = np.moveaxis(np.array(corners), 2, 0)
    np.testing.assert_array_equal(_corners(frames), table["v"][v])
    np.testing.assert_array_equal(frames.normals[0][frames.faces], table["vn"][vn])
    np.testing.assert_array_equal(frames.uv[frames.faces][..., 0], table["vt"][vt][..., 0])
    np.testing.assert_array_equal(frames.uv[frames.faces][..., 1], 1 - table["vt"][vt][..., 1])


def test_ply_brings_normals_and_flipped_uv(tmp_path):
    frames = load_mesh_frames(_write(tmp_path / "a.ply", PLY.format(last=2)))
    assert _corners(frames)[0].tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert frames.normals[0][frames.faces[0]].tolist() == [[0, 0, 1], [0, 0, 1], [0, 1, 0]]
    assert frames.uv[frames.faces[0]].tolist() == [[0, 1], [1, 1], [0, 0.75]]


@pytest.mark.parametrize("binary", [False, True])
def test_ply_uv_per_corner_splits_the_shared_vertices(tmp_path, binary):
    path = tmp_path / "a.ply"
    rows = [([0, 1, 2], [0, 0, 1, 0, 0.5, 0.75]), ([0, 2, 1], [0, 0, 0.5, 0.75, 0, 0.25])]
    head = PLY_BARE.split("end_header")[0].replace("face 1", "face 2") + "end_header\n"
    if binary:
        body = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
        for faces, uv in rows:
            body += b"\x03" + np.array(faces, "<i4").tobytes() + b"\x06" + np.array(uv, "<f4").tobytes()
        path.write_bytes(head.replace("ascii", "binary_little_endian").encode() + body)
    else:
        lines = [f"3 {' '.join(map(str, f))} 6 {' '.join(map(str, uv))}" for f, uv in rows]
        path.write_text(head + "0 0 0\n1 0 0\n0 1 0\n" + "\n".join(lines) + "\n")
    frames = load_mesh_frames(path)
    assert _corners(frames)[1].tolist() == [[0, 0, 0], [0, 1, 0], [1, 0, 0]]
    assert frames.uv[frames.faces].tolist() == [[[0, 1], [1, 1], [0.5, 0.25]], [[0, 1], [0.5, 0.25], [0, 0.75]]]
    assert frames.points.shape[1] == 4


def test_binary_ply_matches_trimesh(data):
    trimesh = pytest.importorskip("trimesh")
    path = data / "meshes" / "bunny.ply"
    frames, mesh = load_mesh_frames(path), trimesh.load(path, process=False)
    np.testing.assert_array_equal(_corners(frames), mesh.vertices.astype(np.float32)[mesh.faces])
    assert frames.uv is None
    assert frames.normals is None


def _triangle(x, *, normal="0 0 1", extra="", face="1//1 2//1 3//1"):
    return f"v {x} 0 0\nv 1 0 0\nv 0 1 0\n{extra}vn {normal}\nf {face}\n"


def test_folder_is_read_in_natural_order_with_progress(tmp_path):
    for number in (10, 9, 1):
        _write(tmp_path / f"walk_{number}.obj", _triangle(-number))
    _write(tmp_path / "notes.txt", "not a frame")
    calls = []
    frames = load_mesh_frames(tmp_path, progress=lambda done, total: calls.append((done, total)))
    assert frames.points[:, frames.faces[0, 0], 0].tolist() == [-1, -9, -10]
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert frames.name == tmp_path.name


def test_later_frames_may_number_their_normals_anew(tmp_path):
    """Exporters merge equal normals per frame, so that the same corner has another normal index in each file."""
    _write(tmp_path / "a1.obj", _triangle(0))
    text = _triangle(0, normal="1 0 0\nvn 0 1 0", face="1//2 2//2 3//2")
    _write(tmp_path / "a2.obj", text)
    frames = load_mesh_frames(tmp_path)
    assert frames.normals[:, 0].tolist() == [[0, 0, 1], [0, 1, 0]]


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (_triangle(0, extra="v 9 9 9\n"), "4 vertices instead of 3"),
        (_triangle(0) + "f 1 2 3\n", "2 faces instead of 1"),
        (_triangle(0, face="1//1 3//1 2//1"), "other corners at face 0"),
    ],
)
def test_changing_topology_names_both_files(tmp_path, second, message):
    _write(tmp_path / "f1.obj", _triangle(0))
    _write(tmp_path / "f2.obj", second)
    with pytest.raises(ValueError, match=rf"f2.obj: the topology changes, it has {message} as in .*f1.obj"):
        load_mesh_frames(tmp_path)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "a.obj",
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf 1 2 9\n",
            r"face 1 \(line 5\) has vertex index 8 .*there are 3",
        ),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -9\n", r"face 0 \(line 4\) has vertex index -2"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1/1 2/1 3/1\n", r"has uv index 0 counted from 0, but there are 0"),
        ("a.obj", "v 0 0 0\nv nan 0 0\nv 0 inf 0\nf 1 2 3\n", r"frame 0 has 2 NaN or Inf vertices of 3"),
        ("a.obj", "v 0 0 0\nv 1 0\n", r"line 2: cannot read 'v 1 0' \(too few numbers\)"),
        ("a.obj", "v 0 0 0\nf 1 x 1\n", r"line 2: cannot read 'f 1 x 1'"),
        ("a.obj", "v 0 0 0\nf 0 1 1\n", r"line 2: .*indices count from 1"),
        ("a.obj", "v 0 0 0\n", r"empty mesh, 1 vertices and 0 faces"),
        ("a.obj", "", r"empty mesh, 0 vertices and 0 faces"),
        (
            "a.ply",
            PLY_BARE.format(last=7).replace(WEDGE, ""),
            r"face 0 has vertex index 7 counted from 0, but there are 3",
        ),
        ("a.ply", PLY.format(last=7), r"a face has a vertex index out of range \(index 7 .*size 3\)"),
        (
            "a.ply",
            PLY.format(last=2).replace("1 0 0 0 0 1 1 0", "nan 0 0 0 0 1 1 0"),
            r"has 1 NaN or Inf vertices of 3",
        ),
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 9", r"not a readable PLY mesh"),
        ("a.ply", "nonsense", r"not a readable PLY mesh"),
        ("a.npz", "nonsense", r"not a readable .npz archive"),
    ],
)
def test_bad_file_is_one_line_that_names_it(tmp_path, name, text, message):
    path = _write(tmp_path / name, text)
    with pytest.raises(ValueError, match=message) as caught:
        load_mesh_frames(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_frame_with_bad_vertices_is_numbered(tmp_path):
    for number, x in enumerate(["0", "0", "nan"]):
        _write(tmp_path / f"f{number}.obj", _triangle(x))
    with pytest.raises(ValueError, match=r"f2.obj: frame 2 has 1 NaN or Inf vertices of 3"):
        load_mesh_frames(tmp_path)


def test_folder_without_frames_or_with_two_kinds_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no .obj or .ply frames"):
        load_mesh_frames(tmp_path)
    _write(tmp_path / "a.obj", _triangle(0))
    _write(tmp_path / "b.ply", PLY.format(last=2))
    with pytest.raises(ValueError, match=r"mixes .obj and .ply frames"):
        load_mesh_frames(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"nothing: no such file or folder"):
        load_mesh_frames(tmp_path / "nothing")


POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)


def test_npz_keeps_uv_as_it_is_and_one_frame_may_lack_its_axis(tmp_path):
    uv = np.array([[0, 0.25], [1, 0], [0, 1]])
    np.savez(tmp_path / "a.npz", points=POINTS, faces=[[0, 1, 2]], uv=uv, fps=24.0)
    frames = load_mesh_frames(tmp_path / "a.npz")
    assert frames.points.shape == (1, 3, 3)
    assert frames.points.dtype == np.float32
    assert frames.faces.dtype == np.int32
    np.testing.assert_array_equal(frames.uv, uv)
    assert frames.fps == 24.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": None}, r"array 'points' is missing; it holds faces"),
        ({"points": np.zeros((2, 3, 2))}, r"points must have shape \(T, V, 3\) or \(V, 3\), got \(2, 3, 2\)"),
        ({"points": np.zeros((0, 3, 3))}, r"empty mesh, 0 frames, 3 vertices and 1 faces"),
        ({"points": np.stack([POINTS, POINTS * np.nan])}, r"frame 1 has 3 NaN or Inf vertices of 3"),
        ({"faces": np.array([[0.0, 1.0, 2.0]])}, r"faces must be integers of shape \(F, 3\), got float64 \(1, 3\)"),
        ({"faces": np.array([[0, 1, 2], [0, -1, 2]])}, r"face 1 has vertex index -1 counted from 0, but there are 3"),
        ({"faces": np.array([[0, 1, 2**40]])}, r"face 0 has vertex index 1099511627776"),
        ({"uv": np.zeros((2, 2))}, r"uv must have shape \(3, 2\), got \(2, 2\)"),
        ({"normals": np.zeros((2, 3, 3))}, r"normals must have shape \(1, 3, 3\), got \(2, 3, 3\)"),
        ({"points": np.array([object()])}, r"not a readable .npz archive"),
    ],
)
def test_npz_with_wrong_arrays_names_the_rule(tmp_path, change, message):
    arrays = {"points": POINTS, "faces": np.array([[0, 1, 2]])} | change
    np.savez(tmp_path / "a.npz", **{k: v for k, v in arrays.items() if v is not None})
    with pytest.raises(ValueError, match=message):
        load_mesh_frames(tmp_path / "a.npz")


def test_truncated_npz_is_refused(tmp_path):
    np.savez(tmp_path / "a.npz", points=POINTS, faces=[[0, 1, 2]])
    whole = (tmp_path / "a.npz").read_bytes()
    for size in range(0, len(whole), 37):
        (tmp_path / "b.npz").write_bytes(whole[:size])
        with pytest.raises(ValueError, match=r"b.npz: not a readable .npz archive"):
            load_mesh_frames(tmp_path / "b.npz")
