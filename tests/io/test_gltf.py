"""glTF reading against hand-written files, against trimesh on real ones, and with broken bytes."""

import json

import numpy as np
import pytest

from tests.tiny_gltf import TRIANGLE, TinyGltf, pack_glb
from warp_neumat.io.gltf import load_gltf

QUAD = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0]], np.float32)


def _primitive(path):
    return load_gltf(path).meshes[0].primitives[0]


@pytest.mark.parametrize(
    ("dtype", "stored", "expected"),
    [
        (np.uint8, [0, 51, 255], [0.0, 0.2, 1.0]),
        (np.int8, [-128, -127, 127], [-1.0, -1.0, 1.0]),
        (np.uint16, [0, 13107, 65535], [0.0, 0.2, 1.0]),
        (np.int16, [-32768, 0, 32767], [-1.0, 0.0, 1.0]),
        (np.float32, [-0.5, 0.25, 3.0], [-0.5, 0.25, 3.0]),
    ],
)
def test_normalised_components_decode_as_the_specification_says(tmp_path, dtype, stored, expected):
    file = TinyGltf()
    uv = file.add(np.repeat(np.array(stored), 2), "VEC2", dtype, normalized=dtype is not np.float32)
    file.node(mesh=file.mesh(TEXCOORD_0=uv))
    np.testing.assert_allclose(_primitive(file.write(tmp_path / "a.glb")).uv[:, 1], expected, atol=1e-7)


def test_quantised_positions_need_no_normalisation(tmp_path):
    file = TinyGltf()
    mesh = file.mesh()
    points = file.add([[0, 0, 0], [100, 0, 0], [0, -7, 0]], "VEC3", np.int16)
    file.tree["meshes"][mesh]["primitives"][0]["attributes"]["POSITION"] = points
    file.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    file.node(mesh=mesh)
    assert _primitive(file.write(tmp_path / "a.glb")).points.tolist() == [[0, 0, 0], [100, 0, 0], [0, -7, 0]]


def test_interleaved_attributes_follow_the_byte_stride(tmp_path):
    file = TinyGltf()
    mesh = file.mesh()
    rows = np.arange(18, dtype=np.float32).reshape(3, 6)  # position and normal side by side
    view = file.view(rows.tobytes(), byteStride=24)
    for name, offset in (("POSITION", 0), ("NORMAL", 12)):
        entry = {"bufferView": view, "byteOffset": offset, "componentType": 5126, "type": "VEC3", "count": 3}
        file.tree["accessors"].append(entry)
        attributes = file.tree["meshes"][mesh]["primitives"][0]["attributes"]
        attributes[name] = len(file.tree["accessors"]) - 1
    primitive = _primitive(file.write(tmp_path / "a.glb"))
    np.testing.assert_array_equal(primitive.points, rows[:, :3])
    np.testing.assert_array_equal(primitive.normals, rows[:, 3:])


def test_sparse_accessor_replaces_rows_of_a_base_and_of_zeros(tmp_path):
    file = TinyGltf()
    mesh = file.mesh(NORMAL=file.add_sparse(3, [1], [[0, 0, 5]]))
    sparse = file.tree["accessors"][file.add_sparse(3, [0, 2], [[9, 9, 9], [8, 8, 8]])]["sparse"]
    points = file.tree["meshes"][mesh]["primitives"][0]["attributes"]["POSITION"]
    file.tree["accessors"][points]["sparse"] = sparse
    primitive = _primitive(file.write(tmp_path / "a.glb"))
    assert primitive.points.tolist() == [[9, 9, 9], [1, 0, 0], [8, 8, 8]]
    assert primitive.normals.tolist() == [[0, 0, 0], [0, 0, 5], [0, 0, 0]]


@pytest.mark.parametrize(
    ("mode", "indices", "expected"),
    [
        (4, None, [[0, 1, 2]]),  # five vertices hold one whole triangle
        (4, [4, 3, 2, 0, 1, 2], [[4, 3, 2], [0, 1, 2]]),
        (5, None, [[0, 1, 2], [1, 3, 2], [2, 3, 4]]),
        (5, [4, 3, 2, 1], [[4, 3, 2], [3, 1, 2]]),
        (6, None, [[1, 2, 0], [2, 3, 0], [3, 4, 0]]),
    ],
)
def test_lists_strips_and_fans_become_triangles(tmp_path, mode, indices, expected):
    file = TinyGltf()
    file.node(mesh=file.mesh(QUAD, indices, primitive={"mode": mode}))
    assert _primitive(file.write(tmp_path / "a.glb")).faces.tolist() == expected


def test_points_and_lines_are_left_out(tmp_path):
    file = TinyGltf()
    file.node(mesh=file.mesh(primitive={"mode": 1}))
    assert load_gltf(file.write(tmp_path / "a.glb")).meshes[0].primitives == ()


def test_glb_external_and_embedded_buffers_read_the_same(tmp_path):
    file = TinyGltf()
    file.node(mesh=file.mesh(QUAD))
    paths = file.write(tmp_path / "a.glb"), file.write(tmp_path / "b.gltf"), file.write_embedded(tmp_path / "c.gltf")
    for path in paths:
        np.testing.assert_array_equal(_primitive(path).points, QUAD)


def test_default_scene_decides_which_nodes_count(tmp_path):
    file = TinyGltf()
    mesh = file.mesh()
    inner = file.node(mesh=mesh, root=False)
    file.node(mesh=mesh, root=False)
    file.node(children=[inner])
    file.tree["scenes"].insert(0, {"nodes": [1]})
    file.tree["scene"] = 1
    assert load_gltf(file.write(tmp_path / "a.glb")).scene_nodes == (2, 0)
    del file.tree["scene"], file.tree["scenes"]
    assert load_gltf(file.write(tmp_path / "a.glb")).scene_nodes == (1, 2, 0)


# ---- broken files


def _break(name):
    """Return a file that breaks one rule."""
    file = TinyGltf()
    mesh = file.mesh(QUAD, [0, 1, 2])
    file.node(mesh=mesh)
    tree, primitive = file.tree, file.tree["meshes"][0]["primitives"][0]
    points = tree["accessors"][primitive["attributes"]["POSITION"]]
    if name == "out of buffer":
        points["count"] = 50
    elif name == "view out of buffer":
        points["count"], tree["bufferViews"][0]["byteLength"] = 50, 6000
    elif name == "face index":
        primitive["indices"] = file.add([0, 1, 7], "SCALAR", np.uint16)
    elif name == "nan":
        primitive["attributes"]["POSITION"] = file.add(np.where(QUAD == 1, np.nan, QUAD), "VEC3")
    elif name == "draco":
        tree["extensionsRequired"] = ["KHR_materials_unlit", "KHR_draco_mesh_compression"]
    elif name == "version":
        tree["asset"]["version"] = "1.0"
    elif name == "cycle":
        tree["nodes"] += [{"children": [2]}, {"children": [1]}]
    elif name == "two parents":
        tree["nodes"] += [{"children": [0]}, {"children": [0]}]
    elif name == "lengths":
        primitive["attributes"]["NORMAL"] = file.add(TRIANGLE, "VEC3")
    elif name == "width":
        primitive["attributes"]["TEXCOORD_0"] = file.add(QUAD, "VEC3")
    elif name == "mesh index":
        tree["nodes"][0]["mesh"] = 3
    elif name == "no position":
        del primitive["attributes"]["POSITION"]
    elif name == "sparse":
        primitive["attributes"]["NORMAL"] = file.add_sparse(5, [6], [[0, 0, 1]])
    elif name == "matrix":
        tree["nodes"][0]["matrix"] = [1, 0, 0]
    elif name == "keys":
        file.animate(0, "translation", [0, 1], [[0, 0, 0]])
    elif name == "key times":
        file.animate(0, "translation", [1, 0], np.zeros((2, 3)))
    return file


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("out of buffer", r"accessor 0 reaches out of its buffer: it ends at byte 600, bufferView 0 ends at 60"),
        ("view out of buffer", r"accessor 0 reaches out of .*, bufferView 0 ends at 6000, the buffer at 68"),
        ("face index", r"mesh 0 \(unnamed\), primitive 0: face 0 has index 7, but there are 5 vertices"),
        ("nan", r"3 of 5 vertices are NaN or Inf"),
        ("draco", r"requires the unsupported extension KHR_draco_mesh_compression; export the file without it"),
        ("version", r"glTF version is 1.0, only 2.x is supported"),
        ("cycle", r"node 1 is its own ancestor"),
        ("two parents", r"node 0 has two parents, 1 and 2"),
        ("lengths", r"NORMAL has 3 elements, POSITION has 5"),
        ("width", r"TEXCOORD_0 must have 2 components, got 3"),
        ("mesh index", r"index 3 into meshes is out of range, there are 1"),
        ("no position", r"malformed glTF, property 'POSITION' is missing"),
        ("sparse", r"accessor 2: sparse index 6 is out of range, it has 5 elements"),
        ("matrix", r"node 0: matrix must be 16 finite numbers, got \[1, 0, 0\]"),
        ("keys", r"animation move, channel 0: 2 keys of translation need 6 numbers, got 3"),
        ("key times", r"keys must be finite and their times must increase"),
    ],
)
def test_broken_rule_is_one_line_that_names_the_file(tmp_path, name, message):
    path = _break(name).write(tmp_path / "bad.glb")
    with pytest.raises(ValueError, match=message) as caught:
        load_gltf(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_missing_file_and_missing_buffer_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none.glb: no such file"):
        load_gltf(tmp_path / "none.glb")
    path = _break("nothing").write(tmp_path / "a.gltf")
    (tmp_path / "a buffer.bin").unlink()
    with pytest.raises(FileNotFoundError, match=r"a.gltf: its buffer .*a buffer.bin is missing"):
        load_gltf(path)


def test_broken_json_names_its_place(tmp_path):
    path = tmp_path / "a.gltf"
    path.write_text('{"asset": {"version": "2.0"},\n "nodes": [}')
    with pytest.raises(ValueError, match=r"a.gltf: broken JSON at line 2, column 12"):
        load_gltf(path)
    path.write_bytes(b"\xff\xfe\x00binary")
    with pytest.raises(ValueError, match=r"neither a GLB file nor JSON text"):
        load_gltf(path)


def test_glb_cut_anywhere_says_truncated(tmp_path):
    whole = _break("nothing").write(tmp_path / "a.glb").read_bytes()
    for size in range(4, len(whole), 7):
        (tmp_path / "cut.glb").write_bytes(whole[:size])
        with pytest.raises(ValueError, match="truncated GLB"):
            load_gltf(tmp_path / "cut.glb")


def test_random_damage_never_escapes_as_another_error(tmp_path, rng):
    """2000 files with a damaged JSON value each either load or raise one readable line."""
    file = _break("nothing")
    file.animate(0, "rotation", [0, 1], np.eye(4)[:2])
    file.tree["skins"] = [{"joints": [0]}]
    text = json.dumps(file.tree | {"buffers": [{"byteLength": len(file.blob)}]})
    spots = [i for i, c in enumerate(text) if c.isdigit() or c in '"[]{}']
    replacements = ["-1", "99", "null", '"x"', "{}", "[]", "1e9", ""]
    messages = []
    for _ in range(2000):
        spot = spots[rng.integers(len(spots))]
        damaged = text[:spot] + replacements[rng.integers(len(replacements))] + text[spot + 1 :]
        try:
            tree = json.loads(damaged)
        except json.JSONDecodeError:
            continue
        path = tmp_path / "damaged.glb"
        path.write_bytes(pack_glb(tree, bytes(file.blob)))
        try:
            load_gltf(path)
        except ValueError as error:
            messages.append(str(error))
    assert len(messages) > 100
    assert all(m.startswith(str(path)) and "\n" not in m for m in messages)


# ---- real files


@pytest.mark.parametrize("name", ["boombox.glb", "shaderball.glb", "FlightHelmet/FlightHelmet.gltf"])
def test_geometry_and_node_transforms_match_trimesh(data, name):
    trimesh = pytest.importorskip("trimesh")
    from warp_neumat.io.animation import Animator, Deformer

    path = data / "meshes" / name
    document = load_gltf(path)
    scene = trimesh.load(path, process=False)
    theirs = {n: scene.graph[n] for n in scene.graph.nodes_geometry}
    world, weights = Animator(document, None).pose(0.0)
    placed = [i for i in document.scene_nodes if document.nodes[i].mesh is not None]
    assert len(placed) == len(theirs)
    for i in placed:
        node = document.nodes[i]
        transform, geometry = theirs[node.name]
        np.testing.assert_allclose(world[i], transform, atol=1e-9)
        (primitive,) = document.meshes[node.mesh].primitives
        mesh = scene.geometry[geometry]
        np.testing.assert_array_equal(primitive.faces, mesh.faces)
        np.testing.assert_array_equal(primitive.points, mesh.vertices.astype(np.float32))
        if hasattr(mesh.visual, "uv"):  # trimesh drops uv where there is no material, and turns v upside down
            np.testing.assert_allclose(primitive.uv, np.array(mesh.visual.uv) * [1, -1] + [0, 1], atol=1e-6)
        deformer = Deformer(primitive, i, None, with_normals=True, with_tangents=False)
        expected = trimesh.transform_points(mesh.vertices, transform)
        np.testing.assert_allclose(deformer.points(world, weights).T, expected, atol=1e-5 * np.abs(expected).max())


def test_fox_loads_whole(data):
    fox = load_gltf(data / "animation" / "Fox.glb")
    assert [(a.name, len(a.channels)) for a in fox.animations] == [("Survey", 21), ("Walk", 21), ("Run", 21)]
    assert [round(a.duration, 3) for a in fox.animations] == [3.417, 0.708, 1.158]
    assert len(fox.skins[0].joints) == 24
    assert [m.name for m in fox.materials] == ["fox_material"]
