"""The shading kernel alone, with materials made for it: ranges, cones, skips, rates, change, and ratios."""

import functools
import types

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.shade import (
    COUNTERS,
    FIRST,
    LIGHT_SKIPS,
    MASK_SHIFT,
    RATE_SHIFT,
    ROW_SHIFT,
    SKIP_ALL,
    Surface,
    Viewer,
    assign_lights,
    make_lights,
    make_shade_kernel,
    words,
)
from warp_neumat.materials.proxy import Proxy, proxy_colors
from warp_neumat.pipeline.lights import LightState, PointLights
from warp_neumat.reference import shade as reference
from warp_neumat.reference.carry import proxy_radiance, shown, stored

WIDTH, HEIGHT, FACES = 52, 36, 40
EYE = (0.5, 0.25, 4.0)


class Layout:
    """A layout that asks for no scratch."""

    def scratch(self, lanes):
        return 0


LAYOUT = Layout()


@wp.struct
class Arguments:
    scale: float


def _value(wi, wo):
    return np.stack([0.5 + 0.4 * wi[:, 0] * wo[:, 1], 0.3 + 0.2 * wi[:, 2], np.full(len(wi), 0.25)], 1)


@functools.cache
def functions(layout, lanes):
    """A plain BRDF; what it is asked below the horizon, or for a vector that is not unit, is NaN."""
    L = lanes

    @wp.func
    def view(
        material: Arguments,
        wo: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
    ):
        pass

    @wp.func
    def light(
        material: Arguments,
        wi: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
        value: wp.array(dtype=wp.float32),
    ):
        # The kernel keeps ω_o [3][L] right before ω_i.
        wo = wp.array(ptr=wi.ptr - wp.uint64(12 * L), shape=(3 * L,), dtype=wp.float32)
        for k in range(count):
            l = active[k]
            w = wp.vec3(wi[l], wi[L + l], wi[2 * L + l])
            bad = w[2] <= 0.0 or wp.abs(wp.length(w) - 1.0) > 1.0e-5
            value[l] = wp.where(bad, wp.nan, 0.5 + 0.4 * w[0] * wo[L + l])
            value[L + l] = 0.3 + 0.2 * w[2]
            value[2 * L + l] = 0.25

    return types.SimpleNamespace(view=view, light=light, Arguments=Arguments)


@functools.cache
def level_functions(layout, lanes):
    """A textured material that shines by itself: its mip level + 40, its uv, and reflects nothing."""
    L = lanes

    @wp.func
    def view(
        material: Arguments,
        place: wp.array(dtype=wp.float32),
        wo: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
        emitted: wp.array(dtype=wp.float32),
    ):
        for k in range(count):
            l = active[k]
            emitted[l] = place[2 * L + l] + 40.0
            emitted[L + l] = place[l]
            emitted[2 * L + l] = place[L + l]

    @wp.func
    def light(
        material: Arguments,
        wi: wp.array(dtype=wp.float32),
        active: wp.array(dtype=wp.int32),
        count: int,
        scratch: wp.uint64,
        value: wp.array(dtype=wp.float32),
    ):
        pass

    return types.SimpleNamespace(view=view, light=light, Arguments=Arguments)


@pytest.fixture
def scene(rng):
    """Random triangles, one for each texel, and the words of all quads in random order, most of them whole."""
    columns, rows = WIDTH // 2, HEIGHT // 2
    masks = np.where(rng.random(columns * rows) < 0.8, 15, rng.integers(1, 16, columns * rows))
    quads = rng.permutation(columns * rows)
    return types.SimpleNamespace(
        triangle=rng.integers(0, FACES, (HEIGHT, WIDTH)),
        barycentric=0.5 * rng.random((HEIGHT, WIDTH, 2)),
        faces=np.arange(3 * FACES).reshape(FACES, 3),
        points=rng.uniform(-1, 1, (3 * FACES, 3)),
        normals=np.repeat(rng.normal(size=(FACES, 3)), 3, axis=0) + 0.2 * rng.normal(size=(3 * FACES, 3)),
        tangents=np.concatenate([rng.normal(size=(3 * FACES, 3)), np.ones((3 * FACES, 1))], 1),
        uv=rng.random((3 * FACES, 2)),
        least_lod=rng.integers(-8, 8, FACES),
        words=quads % columns | quads // columns << ROW_SHIFT | masks[quads] << MASK_SHIFT,
    )


def _wanted(listed):
    """Return rows, columns and rates of the texels that the words ask for."""
    q = np.arange(4)
    listed = np.asarray(listed, np.int64)[:, None]
    rate = np.broadcast_to(listed >> RATE_SHIFT & 3, (len(listed), 4))
    x = 2 * (listed & 0x1FFF) + (q & 1) << rate
    y = 2 * (listed >> ROW_SHIFT & 0x1FFF) + (q >> 1) << rate
    chosen = (listed >> MASK_SHIFT + q & 1) == 1
    return y[chosen], x[chosen], rate[chosen]


def _never():
    return np.tile(np.float16([0, 0, 0, -1]), (HEIGHT, WIDTH, 1))


def _shade(scene, state, device, *, skip=SKIP_ALL, gain=1.0, old=None, listed=None, make=functions, proxy=None):
    """Return the radiance texture [H, W, 4] and the sum of the counters."""
    listed = scene.words if listed is None else listed
    textured = make is level_functions

    def array(values, dtype=wp.float32):
        return wp.array(np.ascontiguousarray(values).ravel(), dtype=dtype, device=device)

    surface, viewer = Surface(), Viewer()
    surface.width = WIDTH
    for name in ("triangle", "faces"):
        setattr(surface, name, array(getattr(scene, name), wp.int32))
    for name in ("barycentric", "points", "normals", "tangents", "uv", "least_lod"):
        setattr(surface, name, array(getattr(scene, name)))
    surface.uv_gradient, surface.side = array(np.zeros((FACES, 6))), array(np.ones(FACES), wp.int8)
    viewer.eye, viewer.forward = wp.vec3(*EYE), wp.vec3(0.0, 0.0, -1.0)
    lights = make_lights(8, device)
    assign_lights(lights, state)
    lanes = dispatch.lanes(device)
    blocks = dispatch.blocks(4 * len(listed), lanes)
    radiance = array(_never() if old is None else old, wp.float16)
    counts = wp.zeros(COUNTERS * blocks, dtype=wp.int32, device=device)
    scratch = wp.zeros(dispatch.worker_count() * words(LAYOUT, lanes, textured), dtype=wp.float32, device=device)
    quads = array(np.asarray(listed, np.int64).astype(np.uint32).view(np.int32), wp.int32)
    dispatch.launch(
        make_shade_kernel(make, LAYOUT, lanes, textured),
        blocks,
        inputs=[
            Arguments(),
            quads,
            len(listed),
            surface,
            lights,
            viewer,
            scratch,
            skip,
            gain,
            proxy or proxy_colors(None, 0.0),
        ],
        outputs=[radiance, counts],
        device=device,
        grain=1,
    )
    return radiance.numpy().reshape(HEIGHT, WIDTH, 4), counts.numpy().reshape(-1, COUNTERS).sum(0)


def _samples(scene):
    y, x, _ = _wanted(scene.words)
    corners = scene.faces[scene.triangle[y, x]]
    b1, b2 = scene.barycentric[y, x].T
    return y, x, corners, np.stack([1 - b1 - b2, b1, b2], 1)


LIGHTS = PointLights(
    position=[[2, 3, 2], [-2, 1, 1], [0, -2, 1], [1, 0, 3], [0, 0, -9], [3, 0, 0]],
    intensity=[[9, 8, 7], [4, 5, 6], [6, 4, 3], [9, 9, 5], [30, 20, 30], [0, 0, 0]],
    range=[np.inf, 2.5, np.inf, 3.5, 0.5, np.inf],  # the last but one reaches nobody
    direction=[[0, -1, 0], [0, 1, 0], [0, 2, -0.5], [-0.5, 0, -2], [0, 0, 1], [1, 0, 0]],
    inner=[0, 0, 0.1, 0.25, 0, 0],
    outer=[np.pi, np.pi, 0.5, 0.3, np.pi, np.pi],
)
"""Without limits, with a range, two spots, the second with both; one that is too far, and one that is off."""

LIMITS = list(zip(LIGHTS.range, LIGHTS.direction, LIGHTS.inner, LIGHTS.outer, strict=True))


def test_range_and_cone_match_float64(scene, device):
    y, x, corners, weights = _samples(scene)
    radiance, _ = _shade(scene, LIGHTS.at(0), device)
    expected, without = (
        reference.shade(
            scene.points[corners],
            scene.normals[corners],
            scene.tangents[corners],
            weights,
            EYE,
            LIGHTS.position,
            LIGHTS.intensity,
            _value,
            limits=limits,
        )
        for limits in (LIMITS, None)
    )
    got = radiance[y, x, :3]
    assert (np.abs(without - expected).max(1) > 0.1).mean() > 0.5  # the limits matter
    assert expected.max() > 0.5
    # Half an ulp of float16 is 4.9e-4 of the value. Worst seen beyond that: 2.3e-8.
    assert (np.abs(got - expected) <= 4.9e-4 * expected + 1e-6).all()
    rest = np.ones((HEIGHT, WIDTH), bool)
    rest[y, x] = False
    assert (radiance[rest] == [0, 0, 0, -1]).all()


def _reasons(scene):
    """Return which of the pairs of texel and shining light are out of range, outside the cone, below the horizon."""
    _, _, corners, weights = _samples(scene)
    p = (scene.points[corners] * weights[..., None]).sum(1)
    n = (scene.normals[corners] * weights[..., None]).sum(1)
    away = p[None] - LIGHTS.position[:5, None]
    distance = np.linalg.norm(away, axis=2)
    gamma = np.arccos(np.einsum("lnc,lc->ln", away, LIGHTS.direction[:5]) / distance)
    far = distance >= LIGHTS.range[:5, None]
    outside = gamma >= LIGHTS.outer[:5, None]
    return far, outside, np.einsum("lnc,nc->ln", away, n) >= 0


@pytest.mark.parametrize("on", range(8))
def test_every_switch_saves_what_its_counter_says_and_changes_no_pixel(scene, device, on):
    full, _ = _shade(scene, LIGHTS.at(0), device)
    radiance, counts = _shade(scene, LIGHTS.at(0), device, skip=on)
    assert np.array_equal(radiance, full)
    left, expected = np.ones_like(_reasons(scene)[0]), []
    for k, reason in enumerate(_reasons(scene)):  # the first that holds has the pair
        mine = left & reason if on >> k & 1 else np.zeros_like(left)
        expected.append(mine.sum())
        left &= ~mine
    # A texel may lie on a limit within rounding.
    assert np.abs(counts - [left.sum(), *expected]).max() <= 1
    assert counts.sum() == left.size
    assert (counts[1:] > 50).tolist() == [bool(on >> k & 1) for k in range(len(LIGHT_SKIPS))]


def test_lights_without_limits_have_the_horizon_only(scene, device):
    lights = PointLights(LIGHTS.position[:3], LIGHTS.intensity[:3]).at(0)
    pairs = 3 * len(_wanted(scene.words)[0])
    with_skip, counts = _shade(scene, lights, device)
    without, all_evaluated = _shade(scene, lights, device, skip=0)
    assert np.array_equal(with_skip, without)
    assert all_evaluated.tolist() == [pairs, 0, 0, 0]
    assert counts[1:3].tolist() == [0, 0]
    assert counts[0] + counts[3] == pairs
    assert 0.3 * pairs < counts[0] < 0.7 * pairs


def test_a_texel_at_the_light_itself_stays_finite(scene, device):
    scene.points[:] = LIGHTS.position[3]
    for skip in (SKIP_ALL, 0):
        assert np.isfinite(_shade(scene, LIGHTS.at(0), device, skip=skip)[0]).all()


def test_more_lights_than_announced_are_refused():
    lights = make_lights(2, "cpu")
    with pytest.raises(ValueError, match="at most 2 lights were announced, got 6"):
        assign_lights(lights, LIGHTS.at(0))


DARK = LightState(*(a[:0] for a in LIGHTS.at(0)))


def test_words_of_each_rate_shade_their_texels_at_their_level(scene, device, rng):
    # Disjoint places: rate 2 in the upper left, rate 1 on the right, rate 0 below.
    listed = [c | r << ROW_SHIFT | 15 << MASK_SHIFT | 2 << RATE_SHIFT for c in range(3) for r in range(2)]
    listed += [c | r << ROW_SHIFT | 11 << MASK_SHIFT | 1 << RATE_SHIFT for c in range(7, 13) for r in range(4)]
    listed += [c | r << ROW_SHIFT | 7 << MASK_SHIFT for c in range(26) for r in range(9, 18)]
    listed = rng.permutation(listed)
    y, x, rate = _wanted(listed)
    assert set(rate) == {0, 1, 2}
    radiance, _ = _shade(scene, DARK, device, listed=listed, make=level_functions)
    shaded = np.zeros((HEIGHT, WIDTH), bool)
    shaded[y, x] = True
    assert np.array_equal(radiance[..., 3] != -1, shaded)
    assert np.array_equal(radiance[y, x, 0], scene.least_lod[scene.triangle[y, x]] + rate + 40)
    b1, b2 = scene.barycentric[y, x].T
    uv = (scene.uv[scene.faces[scene.triangle[y, x]]] * np.stack([1 - b1 - b2, b1, b2], 1)[..., None]).sum(1)
    np.testing.assert_allclose(radiance[y, x, 1:3], uv, atol=5e-4)


def _root(radiance, gain):
    shown = np.clip(gain * radiance[..., :3].astype(np.float64), 0, 1)
    return np.sqrt(shown @ [0.2126, 0.7152, 0.0722])


def test_the_fourth_channel_holds_the_change(scene, device):
    y, x, _ = _wanted(scene.words)
    first, _ = _shade(scene, LIGHTS.at(0), device)
    assert (first[y, x, 3] == FIRST).all()
    again, _ = _shade(scene, LIGHTS.at(0), device, old=first)
    assert np.array_equal(again[..., :3], first[..., :3])
    assert (again[y, x, 3] == 0).all()
    moved = LIGHTS.at(0)._replace(position=LIGHTS.at(0).position + np.float32([0.3, 0.0, 0.2]))
    for gain in (0.25, 1.0, 8.0):
        now, _ = _shade(scene, moved, device, old=again, gain=gain)
        expected = np.abs(_root(now, gain) - _root(again, gain))[y, x]
        np.testing.assert_allclose(now[y, x, 3], expected, rtol=1e-3, atol=1e-6)
        assert (expected > 0.05).mean() > 0.1
        assert expected.max() <= 1
    bright, _ = _shade(scene, LIGHTS.at(0), device, old=first, gain=1e6)  # all white, or black where no light comes
    assert (bright[y, x, 3] == 0).all()


def test_a_texel_that_held_nonsense_counts_as_never_shaded(scene, device):
    y, x, _ = _wanted(scene.words)
    radiance, _ = _shade(scene, LIGHTS.at(0), device, old=np.full((HEIGHT, WIDTH, 4), np.nan, np.float16))
    assert (radiance[y, x, 3] == FIRST).all()


EPSILON = 0.04
PROXY = Proxy(0.4, 0.2, 0.6, False, 0.4, 0.1, ((0.5, 0.3, 0.2), (0.1, 0.3, 0.6), (0.9, 0.5, 0.0)))


def _proxies(scene, position=LIGHTS.position):
    """Return the proxy's radiance of the listed texels; without light where the surface is seen from behind."""
    _, _, corners, weights = _samples(scene)
    points, normals = ((a[corners] * weights[..., None]).sum(1) for a in (scene.points, scene.normals))
    terms, alpha2 = np.tile(PROXY.colors, (len(points), 1, 1)), np.full(len(points), PROXY.roughness**4)
    return proxy_radiance(terms, alpha2, points, normals, EYE, position, LIGHTS.intensity, LIMITS)


def test_what_is_stored_with_a_proxy_matches_float64(scene, device):
    y, x, corners, weights = _samples(scene)
    geometry = (scene.points[corners], scene.normals[corners], scene.tangents[corners], weights, EYE)
    radiance = reference.shade(*geometry, LIGHTS.position, LIGHTS.intensity, _value, limits=LIMITS)
    proxies = _proxies(scene)
    assert ((proxies > EPSILON) & (proxies < 2)).mean() > 0.3
    for skip in (SKIP_ALL, 0):
        texels, _ = _shade(scene, LIGHTS.at(0), device, skip=skip, proxy=proxy_colors(PROXY, EPSILON))
        expected = stored(radiance, proxies, EPSILON)
        # Half an ulp of float16 is 4.9e-4 of the value; what is beyond is the proxy's own rounding.
        assert (np.abs(texels[y, x, :3] - expected) <= 5.2e-4 * expected + 1e-5).all()
        assert (texels[y, x, 3] == FIRST).all()


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_the_change_of_ratios_is_that_of_what_they_show_now(scene, device, gain):
    """Old and new ratio, both carried to the present: what the proxy already followed is no change."""
    y, x, _, _ = _samples(scene)
    options = {"proxy": proxy_colors(PROXY, EPSILON), "gain": gain}
    first, _ = _shade(scene, LIGHTS.at(0), device, **options)
    again, _ = _shade(scene, LIGHTS.at(0), device, old=first, **options)
    assert np.array_equal(again[y, x, :3], first[y, x, :3])
    assert (again[y, x, 3] == 0).all()
    shift = np.float32([0.3, 0.0, 0.2])
    moved = LIGHTS.at(0)._replace(position=LIGHTS.at(0).position + shift)
    now, _ = _shade(scene, moved, device, old=again, **options)
    proxies = _proxies(scene, LIGHTS.position + shift)
    old, new = (shown(a[y, x, :3].astype(np.float64), proxies, EPSILON) for a in (again, now))
    expected = np.abs(_root(new, gain) - _root(old, gain))
    assert (expected > 0.02).mean() > 0.2
    # Near black, the root is steep: 1e-7 of rounding is 3e-4.
    np.testing.assert_allclose(now[y, x, 3], expected, rtol=2e-3, atol=1e-3)
