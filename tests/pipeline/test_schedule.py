"""Policies on small scenes: no unshaded texel is read, still scenes cost nothing, budgets hold, runs repeat."""

import dataclasses
import functools
import types

import numpy as np
import pytest
import warp as wp

from tests.fake_assets import random_neubrdf
from tests.pipeline.test_renderer import LIGHTS, SIZE, Still, Turning, _dome
from warp_neumat import metrics
from warp_neumat.materials.base import Material, Shader
from warp_neumat.materials.neubrdf import NeuBRDF
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.lights import PointLights
from warp_neumat.pipeline.policy import POLICIES, make_policy
from warp_neumat.pipeline.renderer import SKIPS, Renderer
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.pipeline.tonemap import tonemap

CARRIED = [(name, False) for name in POLICIES] + [(name, True) for name in POLICIES if name != "fixed"]
FRAMES = 14


@pytest.fixture(scope="module")
def material():
    tensors, header = random_neubrdf(np.random.default_rng(3), nside=2, bits=3)
    tensors["codebook"] = (0.25 * tensors["codebook"].astype(np.float32)).astype(np.float16)
    return NeuBRDF(tensors, header)


def _pair(frames):
    """Return a sequence of two balls, the right one turning about its axis."""
    points, faces, uv = _dome(10, 20)
    poses = []
    for k in range(frames):
        c, s = np.cos(0.3 * k), np.sin(0.3 * k)
        turned = points @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]], np.float32)
        poses.append(np.concatenate([points - [1.1, 0, 0], turned + [1.1, 0, 0]]))
    return MeshSequence.from_arrays(
        np.stack(poses).astype(np.float32),
        np.concatenate([faces, faces + len(points)]),
        np.concatenate([uv, uv]),
        face_mesh=np.repeat([0, 1], len(faces)),
        mesh_names=["left", "right"],
    )


@pytest.fixture(scope="module")
def pair():
    return _pair(FRAMES)


@pytest.fixture(scope="module")
def atlas(pair, tmp_path_factory):
    return Atlas.build(pair, 160, cache=tmp_path_factory.mktemp("cache"))


class Orbit(PointLights):
    """The lights of the test of the renderer, the first of which circles."""

    def __init__(self):
        super().__init__(LIGHTS.position, LIGHTS.intensity, turns=[1, 0, 0], axis=[[0, 1, 0]] * 3, frames=40)


def _renderer(pair, material, atlas, policy, carry=False, **options):
    shot = {"size": SIZE, "camera": Still((1.0, 1.5, 6.0)), "lights": LIGHTS, "interval": 2} | options
    return Renderer(pair, {"*": material}, atlas=atlas, policy=policy, carry=carry, **shot)


@pytest.mark.parametrize(("policy", "carry"), CARRIED)
def test_no_texel_is_read_that_nobody_shaded(pair, material, atlas, policy, carry):
    """Camera, light and mesh move, the camera by half a radian a frame, so that much comes into view at once."""
    moving = {"camera": Turning(0.5, 6.0), "lights": Orbit()}
    renderer = _renderer(pair, material, atlas, policy, carry, **moving)
    texels = renderer.view.shader.radiance
    poison = np.full((len(texels.numpy()) // 4, 4), np.nan, np.float16)
    poison[:, 3] = -1
    texels.assign(poison.ravel())
    for k in range(FRAMES):
        frame = renderer.frame(k)
        assert np.isfinite(frame.image).all(), f"frame {k} reads texels that nobody shaded"
        assert frame.image.max() > 0.05


@pytest.mark.parametrize(("policy", "carry"), CARRIED)
def test_a_still_scene_costs_nothing_and_stays(pair, material, atlas, policy, carry):
    renderer = _renderer(pair, material, atlas, policy, carry)
    # adaptive begins coarsely and needs some frames for every texel.
    first = [renderer.frame(0) for _ in range(60 if policy == "adaptive" else 3)][-1]
    picture, stats = first.image.copy(), first.stats
    for _ in range(8):
        frame = renderer.frame(0)
        assert frame.stats["evaluations"] == 0
        assert frame.stats["texels"]["shaded"] == 0
        assert frame.stats["skipped"]["unchanged"] == frame.stats["texels"]["seen"] == stats["texels"]["seen"]
        assert np.array_equal(frame.image, picture)
    assert renderer.frame(1).stats["evaluations"] > 0  # it notices when something moves


@pytest.mark.parametrize("policy", ["every", "staggered", "adaptive"])
def test_carrying_changes_nothing_where_nothing_moved(pair, material, atlas, policy):
    plain = [name for name in SKIPS if name != "rate"]
    carried, direct = (_renderer(pair, material, atlas, policy, carry, skip=plain) for carry in (True, False))
    one, other = carried.frame(0).image, direct.frame(0).image
    shown = other.max(axis=2) > 0
    assert shown.mean() > 0.1
    # Ratios are filtered where radiance is, and stored as float16 as well.
    error = np.abs(one - other)[shown]
    assert np.median(error) < 2e-3 * other.max()
    assert metrics.flip(tonemap(other), tonemap(one))[0] < 5e-3


@pytest.mark.parametrize(("policy", "carry"), [("fixed", False), ("staggered", True), ("adaptive", True)])
def test_a_restart_and_another_renderer_give_the_same_pictures(pair, material, atlas, policy, carry):
    moving = {"camera": Turning(0.2, 6.0), "lights": Orbit(), "seed": 5}
    one, two = (_renderer(pair, material, atlas, policy, carry, **moving) for _ in range(2))
    films = [[(f.image, f.stats["evaluations"]) for f in r.render(range(8))] for r in (one, two, one)]
    for film in films[1:]:
        for (image, evaluations), (expected, count) in zip(film, films[0], strict=True):
            assert evaluations == count
            assert np.array_equal(image, expected)


def test_another_seed_chooses_other_tiles(pair, material, atlas):
    moving = {"camera": Turning(0.1, 6.0), "lights": Orbit()}
    first, second = (
        [f.image for f in _renderer(pair, material, atlas, "staggered", seed=seed, **moving).render(range(4))]
        for seed in (0, 1)
    )
    assert np.array_equal(first[0], second[0])
    assert not np.array_equal(first[3], second[3])


@pytest.mark.parametrize("policy", ["staggered", "adaptive"])
def test_a_budget_holds_but_for_what_comes_into_view(pair, material, atlas, policy):
    """Nothing comes into view: the camera stands, the lights move."""
    still = MeshSequence.from_arrays(pair.frame(0).points, pair.faces, pair.uv)
    whole = _renderer(still, material, atlas, "every", lights=Orbit()).frame(0).stats["evaluations"]
    renderer = _renderer(still, material, atlas, policy, lights=Orbit(), budget=whole / 4)
    spent = [renderer.frame(k).stats["evaluations"] for k in range(16)][4:]
    # Costs are estimates: evaluations by texel of the frames before.
    assert max(spent) < 1.25 * whole / 4
    assert np.mean(spent) > 0.5 * whole / 4


def test_staggered_spreads_what_fixed_does_at_once(pair, material, atlas):
    still = MeshSequence.from_arrays(pair.frame(0).points, pair.faces, pair.uv)
    plain = [name for name in SKIPS if name != "rate"]
    spent = {}
    for policy in ("fixed", "staggered"):
        renderer = _renderer(still, material, atlas, policy, lights=Orbit(), interval=3, skip=plain)
        frames = [renderer.frame(k).stats["evaluations"] for k in range(20)]
        spent[policy] = np.array(frames[4:])
    assert (spent["fixed"] == 0).mean() == 0.75
    assert np.percentile(spent["staggered"], 95) < 1.3 * np.median(spent["staggered"])
    assert spent["staggered"].mean() == pytest.approx(spent["fixed"].mean(), rel=0.15)
    assert spent["staggered"].mean() < 1.02 * spent["fixed"].mean()


def _shaded_by_part(renderer, pair):
    """Return the texels that the last frame shaded of the left and of the right ball."""
    shader, atlas = renderer.view.shader, renderer.atlas
    tiles = np.zeros((2, shader.rows * 8, shader.columns * 8), bool)
    for part in (0, 1):
        owned = (atlas.triangle >= 0) & (pair.face_mesh[np.maximum(atlas.triangle, 0)] == part)
        tiles[part, : shader.height, : shader.width] = owned
    owners = tiles.reshape(2, shader.rows, 8, shader.columns, 8).any(axis=(2, 4)).reshape(2, -1)
    alone = owners & ~owners[::-1]
    shaded = shader.tile_shaded.numpy()
    return [int(shaded[alone[part]].sum()) for part in (0, 1)]


@pytest.mark.parametrize("carry", [False, True])
def test_what_stands_still_beside_what_moves_is_not_refreshed(pair, material, atlas, carry):
    renderer = _renderer(pair, material, atlas, "adaptive", carry, budget=1e6)
    shaded = []
    for k in range(FRAMES):
        renderer.frame(k)
        shaded.append(_shaded_by_part(renderer, pair))
    shaded = np.array(shaded)
    assert (shaded[0] > 100).all()
    assert (shaded[1:, 1] > 0).all()
    assert shaded[8:, 0].max() == 0, shaded.tolist()


def test_a_moving_light_ages_everything(pair, material, atlas):
    still = MeshSequence.from_arrays(
        pair.frame(0).points, pair.faces, pair.uv, face_mesh=pair.face_mesh, mesh_names=pair.mesh_names
    )
    renderer = _renderer(still, material, atlas, "staggered", lights=Orbit(), interval=2)
    reached = np.zeros(2, int)
    for k in range(6):
        frame = renderer.frame(k)
        if k:
            reached += _shaded_by_part(renderer, pair)
        assert frame.stats["skipped"]["unchanged"] == 0 or k == 0
    assert (reached > 0.8 * np.array(frame.stats["texels"]["seen"]) / 2).all()


@pytest.mark.parametrize("policy", ["staggered", "adaptive"])
def test_reuse_stays_near_what_every_frame_shades(pair, material, atlas, policy):
    """A slow light and a slow camera: the error of reuse is far below that of the first frame kept."""
    moving = {"camera": Turning(0.02, 6.0), "lights": Orbit()}
    every, reused = (_renderer(pair, material, atlas, name, name == "adaptive", **moving) for name in ("every", policy))
    first = tonemap(every.frame(0).image.copy())
    cost = np.zeros(2)
    for k in range(12):
        one, other = every.frame(k), reused.frame(k)
        cost += one.stats["evaluations"], other.stats["evaluations"]
    error = metrics.flip(tonemap(one.image), tonemap(other.image))[0]
    assert error < (0.6 if policy == "staggered" else 0.3) * metrics.flip(tonemap(one.image), first)[0]
    assert cost[1] < 0.6 * cost[0]


@wp.struct
class Albedo:
    color: wp.vec3


@dataclasses.dataclass(frozen=True)
class Bare:
    def scratch(self, lanes):
        return 0


@functools.cache
def _lambert(layout, lanes):
    L = lanes

    @wp.func
    def view(
        albedo: Albedo,
        wo: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
    ):
        pass

    @wp.func
    def light(
        albedo: Albedo,
        wi: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
        value: wp.array(dtype=wp.float32),
    ):
        for l in range(3 * L):
            value[l] = 0.318309886 * albedo.color[l / L]

    return types.SimpleNamespace(view=view, light=light, Arguments=Albedo)


class Chalk(Material):
    """Lambert's, so that its proxy is the material itself."""

    kind = name = "chalk"

    def __init__(self, color):
        self.color = color

    def eval(self, uv, wi, wo):
        return np.float32(self.color) / np.pi * np.maximum(wi[:, 2:], 0) * (wo[:, 2:] > 0)

    def shader(self):
        albedo = Albedo()
        albedo.color = wp.vec3(*self.color)
        return Shader(_lambert, Bare(), albedo)


@pytest.mark.parametrize("policy", ["every", "staggered", "adaptive"])
def test_what_the_proxy_knows_is_carried_without_error(pair, atlas, policy):
    """Mesh, viewer and lights move; stale chalk looks as chalk shaded per pixel, and without carrying it does not."""
    moving = {"camera": Turning(0.06, 6.0), "lights": Orbit(), "interval": 5}
    carried, direct = (_renderer(pair, Chalk((0.8, 0.6, 0.4)), atlas, policy, c, **moving) for c in (True, False))
    screen = carried.per_pixel()
    errors = []
    for k in range(10):
        expected = screen.frame(k).image
        shown = expected.max(axis=2) > 0.02
        pictures = [renderer.frame(k).image for renderer in (carried, direct)]
        errors.append([np.abs(p - expected)[shown] / expected.max() for p in pictures])
    with_it, without = (np.concatenate(e) for e in zip(*errors, strict=True))
    assert np.quantile(without, 0.99) > 0.1 or policy == "every"
    assert with_it.max() < 2e-3  # seen: 4.4e-4, half an ulp of the float16 ratio


class Cuts(Still):
    """Looks away from the second frame on, and back from frame 13."""

    def __init__(self):
        super().__init__((1.0, 1.5, 6.0))
        self._away = Still((1.0, 1.5, 6.0), target=(1.0, 1.5, 20.0)).at(0)

    def at(self, frame):
        return self._away if 1 <= frame < 13 else super().at(frame)


@pytest.mark.parametrize("policy", ["staggered", "adaptive"])
def test_what_comes_back_into_view_is_shaded_anew_when_it_is_old(pair, material, atlas, policy):
    """After a cut back to what was seen long ago, the first picture is as good as new."""
    static = MeshSequence.from_arrays(pair.frame(0).points, pair.faces, pair.uv)
    shot = {"camera": Cuts(), "lights": Orbit(), "budget": 1.0, "skip": [s for s in SKIPS if s != "rate"]}
    ours = _renderer(static, material, Atlas.build(static, 160, cache=False), policy, **shot)
    del shot["budget"]
    every = _renderer(static, material, ours.atlas, "every", **shot)
    for k in (*range(13), 13):
        frame, expected = ours.frame(k), every.frame(k)
        if k == 1:
            assert frame.image.max() == 0.0
    assert np.array_equal(frame.image, expected.image)


class Comes(Still):
    """Moves until frame 6, and rests."""

    def __init__(self):
        super().__init__((1.0, 1.5, 6.0))

    def at(self, frame):
        angle = 0.1 * min(frame, 6)
        return Still((6 * np.sin(angle), 1.5, 6 * np.cos(angle))).at(0)


@pytest.mark.parametrize(
    "options",
    [
        {"policy": "staggered", "budget": 300.0},
        {"policy": "staggered", "budget": 20.0},  # less than a tile costs
        {"policy": "adaptive", "budget": 300.0},
        {"policy": "adaptive", "milliseconds": 0.05},
        {"policy": "adaptive", "target_flip": 0.05},
    ],
)
def test_what_comes_to_rest_ends_up_to_date(pair, material, atlas, options):
    """Whatever the budget, a picture that has come to rest becomes the one that all-new shading gives, then is free."""
    static = MeshSequence.from_arrays(pair.frame(0).points, pair.faces, pair.uv)
    full = [s for s in SKIPS if s != "rate"]
    ours, every = (
        _renderer(static, material, Atlas.build(static, 160, cache=False), camera=Comes(), skip=full, **o)
        for o in (options, {"policy": "every"})
    )
    tail = [ours.frame(min(k, 10)).stats["evaluations"] for k in range(900)][-10:]
    for k in range(8):
        expected = every.frame(k)
    assert tail == [0] * 10
    assert np.array_equal(ours.frame(10).image, expected.image)


def test_a_still_scene_under_adaptive_reaches_the_rates_it_wants(pair, material, atlas):
    static = MeshSequence.from_arrays(pair.frame(0).points, pair.faces, pair.uv)
    ours, reference = (
        _renderer(
            static, material, atlas, p, p == "adaptive", size=(194, 122), camera=Still((1.0, 1.5, 6.0), size=(194, 122))
        )
        for p in ("adaptive", "every")
    )
    screen = reference.per_pixel().frame(0).image
    for _ in range(40):
        frame = ours.frame(0)
    every = metrics.flip(tonemap(screen), tonemap(reference.frame(0).image))[0]
    assert metrics.flip(tonemap(screen), tonemap(frame.image))[0] < 1.25 * every + 2e-3
    assert frame.stats["evaluations"] == 0


def test_rates_off_means_every_texel_under_adaptive_too(pair, material, atlas):
    far = _renderer(pair, material, atlas, "adaptive", True, camera=Still((0, 0, 40.0)), skip=set(SKIPS) - {"rate"})
    for k in range(3):
        frame = far.frame(k)
    assert frame.stats["skipped"]["rate"] == 0
    assert not far.view.shader.rate.numpy().any()


def test_a_policy_may_be_used_by_several_renderers(pair, material, atlas):
    policy = make_policy("adaptive", 2, target_flip=0.01)
    first = _renderer(pair, material, atlas, policy)
    first.frame(0)
    noted = first.policy.target.mean
    second = _renderer(pair, material, atlas, policy)
    assert second.policy is not first.policy
    assert first.policy.target.mean == noted
    with pytest.raises(ValueError, match="budget is for policies by name"):
        _renderer(pair, material, atlas, policy, budget=5.0)
