"""Sets of PBR maps as a reflectance that varies over a surface: values, footprints, and what is refused."""

import numpy as np
import pytest

from tests.tiny_maps import tiny_maps, tiny_values
from warp_neumat.io.mipmaps import srgb_to_linear
from warp_neumat.io.svbrdf import SVBRDF, open_svbrdf
from warp_neumat.kernels.ggx import ggx_eval
from warp_neumat.reference.ggx import ggx


def directions(rng, count, least=0.02):
    """Unit directions above the horizon, (count, 3) float32."""
    v = rng.normal(size=(count, 3))
    v[:, 2] = np.abs(v[:, 2]) + least
    return (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return open_svbrdf(f"svbrdf:{tiny_maps(tmp_path_factory.mktemp('maps'))}", overrides={"metallic": 0.3})


def stored(name, size=32):
    return np.round(tiny_values(size, size)[name] * 255.0) / 255.0


def centres(size=32):
    """uv of every texel's centre, row by row, (size², 2) float32."""
    y, x = np.mgrid[:size, :size]
    return np.stack([(x.ravel() + 0.5) / size, (y.ravel() + 0.5) / size], 1).astype(np.float32)


def at_texels(source, texel, wi, wo):
    """Values of single texels: a footprint narrower than any, which the source itself never gives."""
    return source._shade(texel[:, None], np.float32(1.0), wi, wo)


def expected(texel, wi, wo, reference=ggx):
    """The same from the stored pictures, by the float64 reference."""
    normal = 2.0 * stored("normal_gl").reshape(-1, 3)[texel] - 1.0
    normal[:, 2] = np.sqrt(np.maximum(1.0 - normal[:, 0] ** 2 - normal[:, 1] ** 2, 0.0))
    base = srgb_to_linear(np.clip(stored("base_color"), 0, 1).reshape(-1, 3)[texel])
    rough = stored("roughness").ravel()[texel]
    return reference(wi, wo, base, rough, np.full(len(texel), 0.3), normal=normal)


def test_texels_match_the_float64_reference(source, rng):
    texel = rng.integers(0, 32 * 32, 20000)
    wi, wo = directions(rng, 20000), directions(rng, 20000)
    wo[:5000] = directions(rng, 5000, 1e-3) * (1, 1, 0.05)  # below many a bent horizon
    wo[:5000] /= np.linalg.norm(wo[:5000], axis=1, keepdims=True)
    wo[5000:9000] = wi[5000:9000] * (-1, -1, 1)  # highlights
    value = at_texels(source, texel, wi, wo) * wi[:, 2:]
    wanted = expected(texel, wi, wo)
    error = np.abs(value - wanted) / (wanted + 1e-3)
    assert error.max() < 4e-3
    assert np.median(error) < 2e-5
    assert (wanted == 0).any()
    np.testing.assert_array_equal(value[wanted == 0], 0)


def test_texels_match_the_shading_kernel(source, rng):
    texel = rng.integers(0, 32 * 32, 5000)
    wi, wo = directions(rng, 5000), directions(rng, 5000)

    def kernel(wi, wo, base, rough, metal, normal):
        as32 = [np.ascontiguousarray(a, np.float32) for a in (base, rough, metal, normal)]
        return ggx_eval(wi, wo, *as32[:3], normal=as32[3])

    wanted = expected(texel, wi, wo, kernel)
    value = at_texels(source, texel, wi, wo) * wi[:, 2:]
    assert (np.abs(value - wanted) / (wanted + 1e-3)).max() < 2e-3


def test_level_0_is_bilinear_in_the_reflectance(source, rng):
    count = 64
    uv, wi, wo = rng.random((count, 2), dtype=np.float32), directions(rng, count, 0.3), directions(rng, count, 0.3)
    x, y = uv[:, 0] * 32 - 0.5, uv[:, 1] * 32 - 0.5
    wanted = 0.0
    for dy in (0, 1):
        for dx in (0, 1):
            share = np.abs(1 - dx - (x - np.floor(x))) * np.abs(1 - dy - (y - np.floor(y)))
            texel = (np.floor(y).astype(int) + dy) % 32 * 32 + (np.floor(x).astype(int) + dx) % 32
            wanted = wanted + share[:, None] * at_texels(source, texel, wi, wo)
    np.testing.assert_allclose(source.eval(uv, 0.0, wi, wo), wanted, rtol=2e-4)


def footprints(source, rng, lod):
    """200 footprints of whole texels: uv, the mean of every texel in them, and the directions."""
    side = 1 << lod
    wi, wo = directions(rng, 1, 0.3), directions(rng, 1, 0.3)
    field = at_texels(source, np.arange(1024), *(np.repeat(w, 1024, 0) for w in (wi, wo))).reshape(32, 32, 3)
    corner = rng.integers(0, 32, (200, 2))  # the footprint's first column and row; many of them wrap around
    at = (corner[:, None, :] + np.arange(side)[None, :, None]) % 32
    mean = np.stack([field[np.ix_(a[:, 1], a[:, 0])].mean((0, 1)) for a in at])
    return ((corner + side / 2) / 32).astype(np.float32), mean, np.repeat(wi, 200, 0), np.repeat(wo, 200, 0)


@pytest.mark.parametrize(("lod", "strata"), [(1, 3), (1, 4), (2, 8), (3, 9)])
def test_small_footprints_are_exact(source, rng, lod, strata):
    uv, mean, wi, wo = footprints(source, rng, lod)
    np.testing.assert_allclose(source.refined(strata).eval(uv, float(lod), wi, wo), mean, rtol=5e-4)


@pytest.mark.parametrize("lod", [3, 4])
def test_large_footprints_converge_to_the_mean_of_their_texels(source, rng, lod):
    uv, mean, wi, wo = footprints(source, rng, lod)
    errors = []
    for strata in (2, 4, 8):
        off = source.refined(strata).eval(uv, float(lod), wi, wo) - mean
        errors.append(np.sqrt(np.square(off).mean()))
        assert abs(off.mean()) < 4 * off.std() / np.sqrt(len(off))  # no bias
    assert errors[0] > 1.4 * errors[1] > 1.4**2 * errors[2]


def test_draws_fill_the_footprint_evenly(rng):
    columns = np.zeros((10, 64 * 64), np.float32)
    columns[2], columns[3] = 1, 1
    y, x = np.mgrid[:64, :64]
    columns[4], columns[5] = x.ravel(), y.ravel()
    source = SVBRDF("ramps", 64, 64, columns, strata=3)
    uv, up = rng.uniform(0.25, 0.75, (2000, 2)).astype(np.float32), np.tile(np.float32([0, 0, 1]), (2000, 1))
    off = source.eval(uv, 5.0, up, up)[:, :2] - (64 * uv - 0.5)  # 32 texels wide, cells of 11
    np.testing.assert_allclose(off.mean(0), 0, atol=4 * off.std() / np.sqrt(len(off)))
    np.testing.assert_allclose(
        off.std(0), 32 / 3 / np.sqrt(12) / 3, rtol=0.1
    )  # nine even draws from the width of a cell


def test_the_coarsest_level_is_the_mean_of_all(source, rng):
    wi, wo = directions(rng, 1, 0.3), directions(rng, 1, 0.3)
    whole = at_texels(source, np.arange(1024), np.repeat(wi, 1024, 0), np.repeat(wo, 1024, 0)).mean(0)
    for lod in (5.0, 50.0):
        found = source.refined(64).eval(rng.random((8, 2)), lod, np.repeat(wi, 8, 0), np.repeat(wo, 8, 0))
        np.testing.assert_allclose(found, np.broadcast_to(whole, (8, 3)), rtol=1e-3)


def test_values_are_a_function_of_their_inputs_alone(source, rng):
    count = 3000
    uv, lod = rng.random((count, 2), dtype=np.float32), rng.random(count, dtype=np.float32) * 5
    wi, wo = directions(rng, count), directions(rng, count)
    value = source.eval(uv, lod, wi, wo)
    order = rng.permutation(count)
    np.testing.assert_array_equal(source.eval(uv[order], lod[order], wi[order], wo[order]), value[order])
    np.testing.assert_array_equal(source.eval(uv[7:8], lod[7:8], wi[7:8], wo[7:8]), value[7:8])
    assert value.dtype == np.float32
    assert np.isfinite(value).all()
    assert (value >= 0).all()


def test_hidden_and_broken_directions_give_0(source):
    up, below, flat, broken = (0, 0, 1), (0.6, 0, -0.8), (1, 0, 0), (np.nan, 0, 1)
    wi = np.array([below, up, flat, up, broken, up, up], np.float32)
    wo = np.array([up, below, up, flat, up, broken, up], np.float32)
    value = source.eval(np.full((7, 2), 0.5), 0.0, wi, wo)
    np.testing.assert_array_equal(value[:-1], 0)
    assert (value[-1] > 0).all()
    assert source.eval(np.zeros((0, 2)), 0.0, wi[:0], wo[:0]).shape == (0, 3)


def test_uv_starts_top_left_and_repeats(rng):
    columns = np.zeros((10, 4), np.float32)
    columns[2], columns[3] = 1, 1
    columns[4] = (1, 2, 3, 4)  # red, row by row
    source = SVBRDF("corners", 2, 2, columns)
    uv = np.array([(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75), (-0.25, 3.25)], np.float32)
    up = np.repeat(np.array([(0, 0, 1)], np.float32), 5, 0)
    np.testing.assert_allclose(source.eval(uv, 0.0, up, up)[:, 0], [1, 2, 3, 4, 2], rtol=1e-6)
    assert source.eval(uv[:1], 1.0, up[:1], up[:1])[0, 0] == pytest.approx(2.5)
    assert source.eval(uv[:1], 9.0, up[:1], up[:1])[0, 0] == pytest.approx(2.5)


def test_what_the_source_states_holds(source, tmp_path, rng):
    assert (source.isotropic, source.symmetry) == (False, "none")
    flat = open_svbrdf(f"svbrdf:{tiny_maps(tmp_path / 'flat')}", overrides={"normal": None})
    assert (flat.isotropic, flat.symmetry) == (True, "bilateral")
    wi, wo, texel = directions(rng, 500, 0.1), directions(rng, 500, 0.1), rng.integers(0, 1024, 500)
    mirror = np.array([-1, 1, 1], np.float32)
    value = at_texels(flat, texel, wi, wo)
    np.testing.assert_allclose(at_texels(flat, texel, wo, wi), value, rtol=1e-3)
    np.testing.assert_allclose(at_texels(flat, texel, wi * mirror, wo * mirror), value, rtol=1e-3)
    assert np.abs(at_texels(source, texel, wo, wi) - at_texels(source, texel, wi, wo)).max() > 0.1


def test_size_and_crop_in_the_specification_or_beside_it(tmp_path):
    folder = tiny_maps(tmp_path / "maps")
    a = open_svbrdf(f"svbrdf:{folder}?crop=8,0,16,8&size=8x4")
    b = open_svbrdf(f"svbrdf:{folder}", crop=(8, 0, 16, 8), size=(8, 4))
    assert (a.width, a.height) == (8, 4)
    assert a.opening == b.opening == {"crop": [8, 0, 16, 8], "size": [8, 4]}
    np.testing.assert_array_equal(a.columns, b.columns)
    assert open_svbrdf(f"svbrdf:{folder}?size=16").width == 16


def test_maps_that_reflect_nothing_are_noted(tmp_path):
    folder = tiny_maps(tmp_path / "maps")
    notes = open_svbrdf(f"svbrdf:{folder}", overrides={"emissive": [0.5, 0.5, 0.5]}).notes
    assert any("emissive: not part of the reflectance" in note for note in notes)


@pytest.mark.parametrize(
    ("spec", "error", "message"),
    [
        ("bricks", ValueError, "must begin with svbrdf:"),
        ("svbrdf:", ValueError, "names no folder"),
        ("svbrdf:nowhere/bricks", FileNotFoundError, "nowhere/bricks: no such folder"),
        ("svbrdf:bricks?sise=3", ValueError, "no option 'sise' here.*known: size, crop"),
        ("svbrdf:bricks?size=3&size=4", ValueError, "given twice"),
        ("svbrdf:bricks?crop=1,2", ValueError, "crop must be X,Y,W,H, as 0,0,512,512, got '1,2'"),
        ("svbrdf:bricks?size=-3", ValueError, "size must be WxH or the longer side"),
    ],
)
def test_wrong_specifications_are_explained(spec, error, message):
    with pytest.raises(error, match=message):
        open_svbrdf(spec)


def test_a_set_without_reflectance_is_refused(tmp_path):
    folder = tiny_maps(tmp_path / "maps")
    gone = dict.fromkeys(("base_color", "normal", "roughness"))
    with pytest.raises(ValueError, match=r"no map of base colour|no picture|nothing"):
        open_svbrdf(f"svbrdf:{folder}", overrides={**gone, "opacity": 0.5})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"uv": np.zeros((3, 2))}, r"uv must have shape \(2, 2\), got \(3, 2\)"),
        ({"uv": np.full((2, 2), np.nan)}, "uv must be finite"),
        ({"lod": np.zeros(3)}, r"lod must be one number or have shape \(2,\), got \(3,\)"),
        ({"lod": np.inf}, "lod must be finite"),
        ({"wi": np.zeros((2, 2))}, r"wi must have shape \(N, 3\)"),
    ],
)
def test_wrong_inputs_are_explained(source, change, message):
    given = {"uv": np.zeros((2, 2)), "lod": 0.0, "wi": np.ones((2, 3)), "wo": np.ones((2, 3))}
    with pytest.raises(ValueError, match=message):
        source.eval(**{**given, **change})
