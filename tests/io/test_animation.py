"""Key frames, hierarchy, skinning and morphing against closed forms."""

import math

import numpy as np
import pytest

from tests.tiny_gltf import TRIANGLE, TinyGltf
from warp_neumat.io.animation import Animator, Deformer, sample
from warp_neumat.io.gltf import Channel, load_gltf

HALF = math.sqrt(0.5)
QUARTER_Z = [0.0, 0.0, HALF, HALF]  # 90° around z
TIMES = np.array([0.5, 1.0, 3.0])


def _channel(interpolation, values, path="translation", times=TIMES):
    return Channel(0, path, interpolation, np.asarray(times, float), np.asarray(values, float))


def _about_z(degrees):
    half = math.radians(degrees) / 2
    return np.array([0.0, 0.0, math.sin(half), math.cos(half)])


@pytest.mark.parametrize(
    ("interpolation", "time", "expected"),
    [
        ("STEP", 0.0, 10.0),
        ("STEP", 0.999, 10.0),
        ("STEP", 1.0, 20.0),
        ("STEP", 9.0, -40.0),
        ("LINEAR", 0.0, 10.0),
        ("LINEAR", 0.75, 15.0),
        ("LINEAR", 1.5, 5.0),
        ("LINEAR", 3.0, -40.0),
        ("LINEAR", 9.0, -40.0),
    ],
)
def test_step_and_linear_keys(interpolation, time, expected):
    values = [[10.0, 0, 0], [20.0, 0, 0], [-40.0, 0, 0]]
    np.testing.assert_allclose(sample(_channel(interpolation, values), time), [expected, 0, 0], atol=1e-12)


def test_cubic_spline_reproduces_a_cubic_between_uneven_keys():
    """Hermite segments with the exact slopes are the polynomial itself, if tangents are scaled by the interval."""
    p, slope = (
        np.polynomial.Polynomial([1.0, -2.0, 0.5, 0.25]),
        np.polynomial.Polynomial([1.0, -2.0, 0.5, 0.25]).deriv(),
    )
    values = [[[slope(t)] * 3, [p(t)] * 3, [slope(t)] * 3] for t in TIMES]
    channel = _channel("CUBICSPLINE", values)
    for time in np.linspace(0.5, 3.0, 26):
        np.testing.assert_allclose(sample(channel, time), [p(time)] * 3, atol=1e-12)
    np.testing.assert_allclose(sample(channel, 0.0), [p(0.5)] * 3)
    np.testing.assert_allclose(sample(channel, 4.0), [p(3.0)] * 3)


def test_cubic_spline_uses_out_tangent_of_the_left_and_in_tangent_of_the_right_key():
    nan = [np.nan] * 3  # never read inside the only segment
    channel = _channel("CUBICSPLINE", [[nan, [0.0] * 3, [8.0] * 3], [[-4.0] * 3, [0.0] * 3, nan]], times=[0.0, 2.0])
    # h10 = h01' = 1/8 at u = 1/2: (2 · 8 − 2 · (−4)) / 8
    np.testing.assert_allclose(sample(channel, 1.0), [3.0] * 3)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("degrees", [0.5, 90.0, 179.0])
def test_linear_rotation_turns_at_constant_speed_along_the_short_arc(sign, degrees):
    channel = _channel("LINEAR", [_about_z(0), sign * _about_z(degrees)], "rotation", [0.0, 3.0])
    for time in (0.3, 1.0, 2.7):
        np.testing.assert_allclose(sample(channel, time), _about_z(degrees * time / 3.0), atol=1e-9)


def test_cubic_rotation_is_normalised():
    zero = [0.0] * 4
    channel = _channel("CUBICSPLINE", [[zero, _about_z(0), zero], [zero, _about_z(90), zero]], "rotation", [0.0, 1.0])
    np.testing.assert_allclose(sample(channel, 0.5), _about_z(45), atol=1e-12)
    assert abs(np.linalg.norm(sample(channel, 0.2)) - 1) < 1e-12


def _load(file, tmp_path):
    return load_gltf(file.write(tmp_path / "a.glb"))


def _points(document, time, node, *, animation=0):
    animation = document.animations[animation] if document.animations else None
    world, weights = Animator(document, animation).pose(time)
    entry = document.nodes[node]
    skin = None if entry.skin is None else document.skins[entry.skin]
    (primitive,) = document.meshes[entry.mesh].primitives
    return Deformer(primitive, node, skin, with_normals=False, with_tangents=False).points(world, weights).T


def test_hierarchy_multiplies_translation_rotation_scale_and_matrices(tmp_path):
    """Outer: 90° around z. Middle: a matrix that moves by (1, 2, 3). Inner: scale (2, 1, 1), moving along y."""
    file = TinyGltf()
    inner = file.node(mesh=file.mesh(), scale=[2, 1, 1], root=False)
    column_major = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 1, 2, 3, 1]
    middle = file.node(matrix=column_major, children=[inner], root=False)
    file.node(rotation=QUARTER_Z, children=[middle])
    file.animate(inner, "translation", [0, 2], [[0, 0, 0], [0, 8, 0]])
    document = _load(file, tmp_path)
    # (x, y, z) → scale (2x, y, z) → + (1, 2 + 4t, 3) → turn (−y, x, z)
    expected = [[-6, 1, 3], [-6, 3, 3], [-7, 1, 3]]
    np.testing.assert_allclose(_points(document, 1.0, inner), expected, atol=1e-6)


def test_animated_rotation_and_scale_keep_the_rest_of_the_node(tmp_path):
    file = TinyGltf()
    node = file.node(mesh=file.mesh(), translation=[5, 0, 0])
    file.animate(node, "rotation", [0, 1], [[0, 0, 0, 1], QUARTER_Z])
    file.animate(node, "scale", [0, 1], [[1, 1, 1], [3, 3, 3]], "STEP")
    expected = [[5, 0, 0], [5 + HALF, HALF, 0], [5 - HALF, HALF, 0]]  # 45°, still scale 1
    np.testing.assert_allclose(_points(_load(file, tmp_path), 0.5, node), expected, atol=1e-6)


def _arm(joints, weights, *, sets=1, **mesh_node):
    """Two joints along x: the second one sits at x = 1, below the first, and turns by 90° in a second."""
    file = TinyGltf()
    points = np.array([[0.5, 0, 0], [2, 0, 0], [1, 1, 0]], np.float32)
    attributes = {}
    for k in range(sets):
        attributes[f"JOINTS_{k}"] = file.add(joints[k], "VEC4", np.uint8)
        attributes[f"WEIGHTS_{k}"] = file.add(weights[k], "VEC4")
    mesh = file.mesh(points, **attributes)
    forearm = file.node(translation=[1, 0, 0], root=False)
    upper = file.node(children=[forearm])
    inverse = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
    inverse[1, :3, 3] = [-1, 0, 0]
    matrices = file.add(inverse.transpose(0, 2, 1), "MAT4")  # column-major in the file
    file.tree["skins"] = [{"joints": [upper, forearm], "inverseBindMatrices": matrices}]
    node = file.node(mesh=mesh, skin=0, **mesh_node)
    file.animate(forearm, "rotation", [0, 1], [[0, 0, 0, 1], QUARTER_Z])
    return file, node


def test_skin_bends_around_its_joint_and_ignores_the_mesh_node(tmp_path):
    joints = [[[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 0, 0]]]
    weights = [[[1, 0, 0, 0], [1, 0, 0, 0], [0.5, 0.5, 0, 0]]]
    file, node = _arm(joints, weights, translation=[100, 0, 0], scale=[-7, 7, 7])
    document = _load(file, tmp_path)
    np.testing.assert_allclose(_points(document, 0.0, node), [[0.5, 0, 0], [2, 0, 0], [1, 1, 0]], atol=1e-6)
    # about (1, 0): (2, 0) → (1, 1); (1, 1) → (0, 0), averaged with itself (0.5, 0.5)
    np.testing.assert_allclose(_points(document, 1.0, node), [[0.5, 0, 0], [1, 1, 0], [0.5, 0.5, 0]], atol=1e-6)


def test_second_joint_set_adds_and_weights_are_normalised(tmp_path):
    joints = [[[0, 0, 0, 0]] * 3, [[1, 0, 0, 0]] * 3]
    weights = [[[1, 0, 0, 0], [0, 0, 0, 0], [2, 0, 0, 0]], [[0, 0, 0, 0], [1, 0, 0, 0], [2, 0, 0, 0]]]
    file, node = _arm(joints, weights, sets=2)
    np.testing.assert_allclose(
        _points(_load(file, tmp_path), 1.0, node), [[0.5, 0, 0], [1, 1, 0], [0.5, 0.5, 0]], atol=1e-6
    )


def test_vertex_without_weights_follows_its_first_joint(tmp_path):
    file, node = _arm([[[1, 0, 0, 0]] * 3], [np.zeros((3, 4))])
    np.testing.assert_allclose(_points(_load(file, tmp_path), 1.0, node)[1], [1, 1, 0], atol=1e-6)


def _morphing(tmp_path, *, node_weights=None, animate=True):
    file = TinyGltf()
    dense = file.add([[0, 0, 1]] * 3, "VEC3")
    sparse = file.add_sparse(3, [2], [[4, 0, 0]])
    targets = {"targets": [{"POSITION": dense}, {"POSITION": sparse}]}
    mesh = file.mesh(primitive=targets, mesh={"weights": [0.5, 0.0]})
    node = file.node(mesh=mesh, **({"weights": node_weights} if node_weights else {}))
    if animate:
        file.animate(node, "weights", [0, 2], [[0, 0], [1, 0.5]])
    return _load(file, tmp_path), node


def test_morph_targets_add_up_under_animated_weights(tmp_path):
    document, node = _morphing(tmp_path)
    expected = TRIANGLE + [[0, 0, 0.5], [0, 0, 0.5], [1, 0, 0.5]]  # halfway: weights 0.5 and 0.25
    np.testing.assert_allclose(_points(document, 1.0, node), expected, atol=1e-6)


def test_morph_weights_of_the_node_override_those_of_the_mesh(tmp_path):
    document, node = _morphing(tmp_path, animate=False)
    np.testing.assert_allclose(_points(document, 0.0, node)[:, 2], 0.5)
    document, node = _morphing(tmp_path, animate=False, node_weights=[0.0, 1.0])
    np.testing.assert_allclose(_points(document, 0.0, node), TRIANGLE + [[0, 0, 0], [0, 0, 0], [4, 0, 0]])


def test_cubic_morph_weights_hold_their_tangents_apart(tmp_path):
    file = TinyGltf()
    mesh = file.mesh(primitive={"targets": [{"POSITION": file.add([[0, 0, 1]] * 3, "VEC3")}]})
    node = file.node(mesh=mesh)
    file.animate(node, "weights", [0, 1], [9, 0, 0, 0, 2, 9], "CUBICSPLINE")  # in-tangent, value, out-tangent per key
    np.testing.assert_allclose(_points(_load(file, tmp_path), 0.5, node)[:, 2], 1.0)


@pytest.mark.parametrize("skinned", [False, True])
@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_normals_follow_the_inverse_transpose_and_tangents_the_matrix(tmp_path, skinned, mirror):
    file = TinyGltf()
    attributes = {
        "NORMAL": file.add([[HALF, HALF, 0]] * 3, "VEC3"),
        "TANGENT": file.add([[HALF, -HALF, 0, 1]] * 3, "VEC4"),
    }
    if skinned:
        attributes["JOINTS_0"] = file.add(np.zeros((3, 4)), "VEC4", np.uint8)
        attributes["WEIGHTS_0"] = file.add([[1, 0, 0, 0]] * 3, "VEC4")
        file.tree["skins"] = [{"joints": [0]}]
    node = file.node(mesh=file.mesh(**attributes), scale=[2, 1, mirror], **({"skin": 0} if skinned else {}))
    document = _load(file, tmp_path)
    world, weights = Animator(document, None).pose(0.0)
    skin = document.skins[0] if skinned else None
    deformer = Deformer(document.meshes[0].primitives[0], node, skin, with_normals=True, with_tangents=True)
    _, normals, tangents = deformer(world, weights)
    unit = normals[:, 0] / np.linalg.norm(normals[:, 0])
    np.testing.assert_allclose(unit, np.array([1, 2, 0]) / math.sqrt(5), atol=1e-6)
    np.testing.assert_allclose(tangents[:, 0], [2 * HALF, -HALF, 0, mirror], atol=1e-6)
    assert deformer.mirrors(world) == (mirror < 0)


def test_fox_is_skinned_rigidly_where_one_joint_holds_it(data):
    """Edges between vertices of one joint keep their length in every animation: a rigid motion moves them."""
    document = load_gltf(data / "animation" / "Fox.glb")
    (primitive,) = document.meshes[0].primitives
    node = next(i for i, n in enumerate(document.nodes) if n.mesh is not None)
    deformer = Deformer(primitive, node, document.skins[0], with_normals=False, with_tangents=False)
    owner = np.where(
        primitive.weights.max(axis=1) > 0.999, primitive.joints[np.arange(1728), primitive.weights.argmax(axis=1)], -1
    )
    a, b = primitive.faces[:, :2].T
    rigid = (owner[a] == owner[b]) & (owner[a] >= 0)
    assert rigid.sum() > 50

    def lengths(animation, time):
        points = deformer.points(*Animator(document, animation).pose(time)).T
        assert np.isfinite(points).all()
        return np.linalg.norm(points[a] - points[b], axis=1)

    rest = lengths(None, 0.0)
    for animation in document.animations:
        for time in np.linspace(0.0, animation.duration, 7):
            now = lengths(animation, time)
            np.testing.assert_allclose(now[rigid], rest[rigid], rtol=2e-5)  # seen 3e-6, float32
            assert np.median(np.abs(now / rest - 1)) < 0.05


def test_fox_animations_close_their_loop(data):
    document = load_gltf(data / "animation" / "Fox.glb")
    for animation in document.animations:
        animator = Animator(document, animation)
        first, last = animator.pose(0.0)[0], animator.pose(animation.duration)[0]
        np.testing.assert_allclose(first, last, atol=1e-9)
