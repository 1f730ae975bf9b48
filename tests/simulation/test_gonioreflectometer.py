"""The virtual gonioreflectometer: against paths traced one by one, against physics, and as a source that is kept."""

import dataclasses

import numpy as np
import pytest

from warp_neumat.io.analytic_brdf import GGX
from warp_neumat.io.btf_directions import ubo2003_directions, ubo2014_directions
from warp_neumat.io.btf_source import is_btf
from warp_neumat.kernels import dispatch
from warp_neumat.reference.height_field import PathTracer
from warp_neumat.simulation.gonioreflectometer import Gonioreflectometer, open_microgeometry
from warp_neumat.simulation.height_fields import MicroGeometry, make_pattern
from warp_neumat.simulation.periodic_noise import band_noise

DIRECTIONS = ubo2014_directions()


def _random(rng, size=12, high=1.2):
    full = (size, size)
    return MicroGeometry(
        "random", band_noise(rng, size, 3) * high, rng.uniform(0.1, 0.9, (*full, 3)), rng.uniform(0.2, 0.9, full),
        rng.uniform(0.02, 0.6, full), rng.uniform(0, 0.9, full), rng.uniform(0, 3, full),
    )  # fmt: skip


def _even(size, albedo=0.5, roughness=0.4, f0=0.04, anisotropy=0.0, fibre=0.0, height=None):
    full = np.ones((size, size))
    height = 0 * full if height is None else height
    rgb = np.broadcast_to(albedo, (size, size, 3))
    return MicroGeometry("even", height, rgb, roughness * full, f0 * full, anisotropy * full, fibre * full)


def _all(lights, views):
    return np.array([(i, j) for i in range(lights) for j in range(views)])


def test_slices_match_paths_traced_one_by_one(rng):
    """Worst of 3 fields × 6 pairs: 1.2e-6, no texel apart (AVX2, 2026-11-22)."""
    for _ in range(2):
        lights, views = (DIRECTIONS[rng.integers(0, 151, 2)] for _ in range(2))
        m = _random(rng)
        got = Gonioreflectometer(m, lights, views, bounces=2, rays=8, cache=False)
        slices = got.slices(_all(2, 2)).reshape(2, 2, 12, 12, 3)
        tracer = PathTracer(m.height, m.albedo, m.alpha, m.f0, m.fibre, 2, got._ways)
        expected = np.array([[tracer.slice(i, o, 2) for o in views] for i in lights])
        apart = np.abs(slices - expected) > 2e-6 + 2e-5 * expected
        assert apart.any(-1).mean() < 1 / 500
        assert expected.mean() > 0.01
        no_bounce = np.array([[tracer.slice(i, o, 0) for o in views] for i in lights])
        assert expected.mean() > 1.02 * no_bounce.mean()  # bounces are part of what was compared


def test_a_flat_field_is_its_brdf():
    for aniso, angle in ((0.0, 0.0), (0.8, 0.0)):
        m = _even(8, (0.2, 0.5, 0.7), 0.45, 0.05, aniso, angle)
        value = Gonioreflectometer(m, DIRECTIONS, DIRECTIONS[::7], cache=False).slices(_all(151, 22))
        i, o = np.repeat(DIRECTIONS, 22, 0), np.tile(DIRECTIONS[::7], (151, 1))
        along, across = m.alpha[0, 0].tolist()
        brdf = GGX(alpha_x=along, alpha_y=across, f0=(0.05,) * 3, diffuse=(0.2, 0.5, 0.7), dim_diffuse=1.0)
        expected = (brdf.eval(i, o) * i[:, 2:])[:, None, None]
        assert (np.abs(value - expected) / (expected + 1e-3)).max() < 1e-4  # worst 3e-5
        there = value.reshape(151, 22, -1)[::7] / DIRECTIONS[::7, None, None, 2]
        assert np.allclose(there, there.swapaxes(0, 1), rtol=1e-4, atol=2e-6)  # reciprocal


def test_no_more_light_leaves_than_came():
    """White micro-geometry: ∫ L cos θ_o dω_o, per unit of the mean plane, is at most the cos θ_i of the light."""
    rng = np.random.default_rng(3)
    z, phi = (np.arange(24) + 0.5) / 24, (np.arange(48) + 0.5) / 48 * 2 * np.pi
    z, phi = (a.ravel() for a in np.meshgrid(z, phi))
    sphere = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], 1)
    m = _even(32, 1.0, 0.6, 0.04, height=2.0 * band_noise(rng, 32, 4))
    lights = DIRECTIONS[[0, 20, 80, 140]]
    views = Gonioreflectometer(m, lights, sphere, bounces=8, rays=64, cache=False)
    mean = views.slices(_all(4, len(sphere))).mean((1, 2, 3)).reshape(4, len(sphere))
    share = (mean * sphere[:, 2]).sum(1) * 2 * np.pi / len(sphere) / lights[:, 2]
    assert (share < 1.01).all(), share
    assert (share > 0.6).all(), share


def test_light_and_view_can_be_exchanged():
    """Of the mean over a period, which is a BRDF of the mean plane: shadows, masks and bounces included."""
    rng = np.random.default_rng(5)
    m = dataclasses.replace(_random(rng, 48), height=2.5 * band_noise(rng, 48, 3), roughness=np.full((48, 48), 0.5))
    chosen = DIRECTIONS[[0, 30, 77, 110, 131, 149]]
    source = Gonioreflectometer(m, chosen, chosen, sub=4, bounces=3, rays=64, cache=False)
    brdf = source.slices(_all(6, 6)).mean((1, 2)).reshape(6, 6, 3) / chosen[:, None, 2:]
    asymmetry = np.abs(brdf - brdf.swapaxes(0, 1)) / np.maximum(brdf, brdf.swapaxes(0, 1))
    assert asymmetry.max() < 0.02, asymmetry.max()
    assert brdf.std() > 0.1 * brdf.mean()


def test_shadows_and_masks():
    height = np.zeros((32, 32), np.float32)
    height[:, 12:20] = 5.0
    m = _even(32, height=height, f0=0.0)
    low = np.float32([[-0.9, 0, np.sqrt(0.19)], [0, 0, 1]])
    slices = Gonioreflectometer(m, low, low, bounces=0, cache=False).slices(_all(2, 2)).reshape(2, 2, 32, 32, 3)
    from_left_seen_above = slices[0, 1, 16, :, 0]
    assert (from_left_seen_above[22:27] == 0).all()  # in the shadow of the ridge
    assert from_left_seen_above[2:8].min() > 0.05
    # Seen from the left, the ridge's lit top covers ground behind it and is displaced against it.
    assert np.abs(slices[1, 0] - slices[1, 1]).max() > 0.05
    bounced = Gonioreflectometer(m, low, low, bounces=3, cache=False).slices(np.array([[0, 1]]))[0, 16, 22:27, 0]
    assert bounced.min() > 0  # the shadow is not black


def test_a_mirrored_field_gives_mirrored_slices(rng):
    size = 24
    half = band_noise(rng, size, 4)
    m = _even(size, height=half + half[:, ::-1], fibre=0.5 * np.pi, anisotropy=0.5)
    lights, views = DIRECTIONS[[30, 77]], DIRECTIONS[[90, 120]]
    mirror = np.float32([-1, 1, 1])
    one = Gonioreflectometer(m, lights, views, cache=False).slices(_all(2, 2))
    other = Gonioreflectometer(m, lights * mirror, views * mirror, cache=False).slices(_all(2, 2))
    close = np.isclose(one, other[:, :, ::-1], rtol=1e-4, atol=1e-5).all(-1)
    assert close.mean() > 0.995  # rays along the mirror's line may end on either side
    assert not np.allclose(one, other, atol=1e-3)


def test_rolling_the_field_rolls_the_slices(rng):
    m, pairs = _random(rng, 24), _all(2, 2)
    lights, views = DIRECTIONS[[30, 140]], DIRECTIONS[[90, 149]]
    one = Gonioreflectometer(m, lights, views, cache=False).slices(pairs)
    other = Gonioreflectometer(m.rolled(5, -7), lights, views, cache=False).slices(pairs)
    assert np.roll(one, (5, -7), (1, 2)) == pytest.approx(other, rel=1e-4, abs=1e-6)


def test_grazing_directions_are_finite(rng):
    grazing = [[1, 0, 0], [0, -1, 1e-9], [0.7, 0.7, 0.02], [0, 0, 1]]
    m = dataclasses.replace(_random(rng, 16), roughness=np.full((16, 16), 0.05))
    value = Gonioreflectometer(m, grazing, grazing, cache=False).slices(_all(4, 4))
    assert np.isfinite(value).all()
    assert value.min() >= 0


def test_any_number_of_workers_and_any_memory_gives_the_same_bits(tmp_path):
    spec, rng = "microgeometry:weave?size=32&threads=2&seed=5", np.random.default_rng(0)
    pairs = rng.integers(0, 151, (60, 2))
    expected = open_microgeometry(spec, cache=False).slices(pairs)
    try:
        dispatch.set_worker_count(1)
        assert np.array_equal(open_microgeometry(spec, cache=False).slices(pairs), expected)
    finally:
        dispatch.set_worker_count(None)
    small = open_microgeometry(spec, cache=False, memory=400_000)
    assert small._rows[0] < 20
    assert np.array_equal(small.slices(pairs), expected)
    assert np.array_equal(small.slices(pairs[::-1])[::-1], expected)


def test_tables_are_kept_on_disk_and_damage_is_found(tmp_path):
    spec, pairs = "microgeometry:leather?size=32&pebbles=4", np.array([[0, 0], [3, 40], [150, 90]])
    first = open_microgeometry(spec, cache=tmp_path).slices(pairs)
    files = sorted(tmp_path.glob("*.table"))
    assert len(files) == 6
    again = open_microgeometry(spec, cache=tmp_path)
    again._make_lights = again._make_views = None  # all is there: nothing is traced
    assert np.array_equal(again.slices(pairs), first)
    files[0].write_bytes(files[0].read_bytes()[:-7])
    files[1].write_bytes(b"")
    data = bytearray(files[4].read_bytes())
    data[100] ^= 1
    files[4].write_bytes(data)
    assert np.array_equal(open_microgeometry(spec, cache=tmp_path).slices(pairs), first)
    assert sorted(tmp_path.glob("*")) == files  # written again, nothing left beside them
    assert min(f.stat().st_size for f in files) > 32 * 32 * 4 * 4
    other = open_microgeometry(spec + "&seed=1", cache=tmp_path, cache_limit=10 * len(data))
    assert not np.array_equal(other.slices(pairs), first)
    assert sum(f.stat().st_size for f in tmp_path.glob("*.table")) <= 10 * len(data)


def test_a_folder_that_cannot_be_written_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    source = open_microgeometry("wood?size=16", cache=tmp_path / "file" / "x")
    assert source.slices(np.array([[0, 0]])).shape == (1, 16, 16, 3)
    assert any("not cached" in note for note in source.notes)


def test_it_is_a_source():
    source = open_microgeometry("microgeometry:carpet?size=16&tufts=3&directions=ubo2003&samples=16", cache=False)
    assert is_btf(source)
    assert (source.width, source.height, source.lights.shape, source.views.shape) == (16, 16, (81, 3), (81, 3))
    assert open_microgeometry(**source.opening, cache=False).name == source.name
    value = source.slices(np.array([[80, 0], [0, 0]]))
    assert value.dtype == np.float32
    assert value.mean() > 0.003
    assert source.slices(np.zeros((0, 2), int)).shape == (0, 16, 16, 3)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("weav", "no pattern 'weav'; nearest: weave"),
        ("weave?thread=4", "weave has no parameter 'thread'; nearest: threads"),
        ("weave?relief=9", r"relief must be a number in \[0.0, 2.0\], got 9"),
        ("weave?threads=5", "threads must be a multiple of 2"),
        ("weave?threads=6&twill=1", "threads must be a multiple of 4 for twill"),
        ("leather?color=1,2", r"color must be R,G,B in \[0.0, 1.0\]"),
        ("leather?size=8", r"size must be a whole number in \[16, 1024\], got 8$"),
        ("leather?size=many", "size must be a number or R,G,B, got 'many'"),
        ("wood?size=16&size=32", "'size' must be given once"),
        ("wood?samples=5", "samples must be 4 or 16, got 5"),
        ("wood?bounces=9", r"bounces must be a whole number in \[0, 8\]"),
        ("wood?directions=merl", "directions must be one of ubo2014, ubo2003, got 'merl'"),
    ],
)
def test_errors_say_the_way_out(spec, message):
    with pytest.raises(ValueError, match=message) as error:
        open_microgeometry("microgeometry:" + spec)
    assert "\n" not in str(error.value)


def test_directions_must_be_directions():
    for bad in (np.zeros((2, 3)), np.ones((2, 2)), [[0, 0, -1]], [[np.nan, 0, 1]]):
        with pytest.raises(ValueError, match="lights must be"):
            Gonioreflectometer(make_pattern("wood", size=16), bad, cache=False)
    with pytest.raises(ValueError, match="pairs must be below"):
        open_microgeometry("wood?size=16", cache=False).slices(np.array([[151, 0]]))


def test_the_directions_of_the_databases():
    for directions, count, rings in ((ubo2003_directions(), 81, 6), (ubo2014_directions(), 151, 10)):
        assert directions.shape == (count, 3)
        assert np.linalg.norm(directions, axis=1) == pytest.approx(1, abs=1e-6)
        assert len(np.unique(directions[:, 2].round(4))) == rings
        assert directions[:, 2].min() == pytest.approx(np.cos(np.radians(75)))
        assert len({tuple(d) for d in directions.round(4)}) == count
        assert directions.sum(0)[:2] == pytest.approx(0, abs=1e-5)
    pair = [
        [np.sin(np.radians(60)) * np.cos(np.radians(p)), np.sin(np.radians(60)) * np.sin(np.radians(p)), 0.5]
        for p in (270, 135)
    ]
    assert all(np.abs(ubo2014_directions() - w).max(1).min() < 1e-6 for w in pair)  # carpet01's first pair
