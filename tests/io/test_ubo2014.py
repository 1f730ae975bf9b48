"""UBO2014 files written here field by field, read back and compared with the colours that went in."""

import struct

import numpy as np
import pytest

from warp_neumat.io.asset import FormatError
from warp_neumat.io.btf_source import is_btf
from warp_neumat.io.ubo2014 import COLOUR_MODELS, _floats, open_ubo2014

LIGHTS = np.float32([(0, 0), (0.3, 0.2), (0.7, 2.0), (1.2, 4.0), (1.3, 6.0)])  # θ, φ
VIEWS = np.float32([(0, 0), (0.4, 1.0), (0.9, 3.0), (1.25, 5.5)])
WIDTH, HEIGHT, EPSILON = 6, 5, 1e-5
TYPES = {2: np.float16, 4: np.float32, 8: np.float64}
YUV_TO_RGB = np.array([[1, 0, 1.13983], [1, -0.39465, -0.5806], [1, 2.03211, 0]])
MATRIX = np.array([[0.6, 0.5, 0.6], [0.7, 0.1, -0.8], [0.3, -0.9, 0.2]])
MEAN = np.array([0.3, 0.2, 0.1])


def colours(rng, smallest=0.02):
    """Known RGB, (view, light, y, x, channel); smooth in no direction, so that any mix-up of indices shows."""
    return smallest + rng.random((len(VIEWS), len(LIGHTS), HEIGHT, WIDTH, 3))


def encoded(rgb, model):
    """The channels that a file of that colour model holds."""
    if model == 0:
        return rgb
    if model == 3:
        return (rgb - np.float32(MEAN)) @ np.linalg.inv(np.float32(MATRIX).astype(float))
    if model == 4:
        r, g, b = np.moveaxis(rgb, -1, 0)
        return np.stack([r / 4 + g / 2 + b / 4, (r - b) / 2, -r / 4 + g / 2 - b / 4], -1)
    if model == 12:
        return np.log(rgb + EPSILON)
    yuv = rgb @ np.linalg.inv(YUV_TO_RGB).T
    y, uv = yuv[..., :1], yuv[..., 1:]
    if model == 10:
        uv = np.sign(uv) * np.log(np.maximum(np.abs(uv) / EPSILON, 1))
    if model == 11:
        uv = uv / (y + EPSILON)
    return np.concatenate([y if model == 1 else np.log(y + EPSILON), uv], -1)


def matrix_bytes(table, size, swapped):
    """One factorised matrix: size, components, rows, columns, S, U, S·V."""
    u, s, v = np.linalg.svd(table.T if swapped else table, full_matrices=False)
    parts = [s, u, (s[:, None] * v).T]
    head = struct.pack("<BIII", size, len(s), len(u), len(parts[2]))
    return head + b"".join(np.ascontiguousarray(p, TYPES[size]).tobytes() for p in parts)


def meta_bytes(version=4, cosine=False, names=("R", "G", "B"), rgb_scale=(1, 1, 1), setup=b"a dome", stated=None):
    body = struct.pack("<I80s80s80sf3f", version, setup, b"camera", b"lamp", 10.0, *rgb_scale)
    if version > 1:
        body += struct.pack("<I", cosine)
    if version > 2:
        body += struct.pack("<I", 7) + b"<xml />"
    if version > 3:
        body += struct.pack("<I", len(names))
        body += b"".join(struct.pack("<I", len(n)) + n.encode() for n in names)
    return struct.pack("<I", len(body) + 4 if stated is None else stated) + body


def direction_bytes(lights=LIGHTS, views=VIEWS, other=None):
    parts = [struct.pack("<I", len(views))]
    for k, view in enumerate(views):
        own = other if other is not None and k == len(views) - 1 else lights
        parts += [np.float32(view).tobytes(), struct.pack("<I", len(own)), np.float32(own).tobytes()]
    return b"".join(parts)


def btf_bytes(
    rgb,
    signature=b"!DFMF08FCR",
    size=4,
    model=0,
    swapped=False,
    log=None,
    heights=None,
    fmf=2,
    rotations=0,
    directions=None,
    extent=(WIDTH, HEIGHT),
    **meta,
):
    """A whole file; ``log`` and ``heights`` count for !FMF12FCER, ``model`` for !DFMF08FCR."""
    out = [signature, meta_bytes(**meta), directions or direction_bytes(), struct.pack("<II", *extent)]
    if signature.endswith(b"R"):
        out.append(struct.pack("<I", rotations) + bytes(36 * rotations))
    if signature.startswith(b"!DFMF"):
        stored = encoded(rgb, model) if model in COLOUR_MODELS else rgb
        out.append(struct.pack("<Ii3f9f", 99, model, *MEAN, *MATRIX.ravel()))
        out += [matrix_bytes(stored[..., c].reshape(-1, WIDTH * HEIGHT), size, swapped) for c in range(3)]
        return b"".join(out)
    if signature == b"!FMF12FCER":
        out.append(struct.pack("<BI", fmf, bool(log)))
        if heights is None:
            out.append(struct.pack("<II", 0, 0))
        else:
            out.append(struct.pack("<II", *heights.shape[::-1]) + heights.astype(np.float16).tobytes())
    stored = np.log(rgb + EPSILON) if log else rgb
    if swapped:  # rows: texel, channel; columns: pairs
        table = stored.reshape(-1, WIDTH * HEIGHT * 3)
    else:  # rows: pair, channel; columns: texels
        table = np.moveaxis(stored, -1, 2).reshape(-1, WIDTH * HEIGHT)
    return b"".join([*out, struct.pack("<I", 99), matrix_bytes(table, size, swapped)])


def opened(tmp_path, data, **options):
    path = tmp_path / "cloth01_resampled_W6xH5_L5xV4.btf"
    path.write_bytes(data)
    return open_ubo2014(path, **options)


def all_pairs():
    return np.stack(np.meshgrid(range(len(LIGHTS)), range(len(VIEWS)), indexing="ij"), -1).reshape(-1, 2)


def expected(rgb, cosine):
    """Slices of all pairs, light slowest, as the protocol wants them."""
    theta = 0.0 if cosine else LIGHTS[:, 0].astype(float)
    factor = np.broadcast_to(np.cos(theta), len(LIGHTS))
    return (np.swapaxes(rgb, 0, 1) * factor[:, None, None, None, None]).reshape(-1, HEIGHT, WIDTH, 3)


def worst(source, rgb, cosine):
    truth = expected(rgb, cosine)
    return float((np.abs(source.slices(all_pairs()) - truth) / (1 + truth)).max())


@pytest.mark.parametrize("cosine", [False, True])
@pytest.mark.parametrize(("size", "bound"), [(2, 2e-3), (4, 4e-7), (8, 1e-7)])  # worst seen: 6e-4, 1.9e-7, 5e-8
@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("signature", [b"!DFMF08FCR", b"!FMF12FCER", b"!FMF06FCR", b"!FMF06FC"])
def test_slices_are_what_was_written(tmp_path, rng, signature, swapped, size, bound, cosine):
    rgb = colours(rng)
    source = opened(tmp_path, btf_bytes(rgb, signature, size, swapped=swapped, cosine=cosine))
    assert is_btf(source)
    assert (source.width, source.height, source.name) == (WIDTH, HEIGHT, "cloth01")
    got = source.slices(all_pairs())
    assert got.dtype == np.float32
    assert got.flags.c_contiguous
    assert worst(source, rgb, cosine) < bound
    if size > 2:  # one at a time, and any order, is the same
        np.testing.assert_allclose(source.slices(np.array([[3, 2], [0, 1]])), got[[3 * 4 + 2, 1]], atol=1e-6)
    assert source.slices(np.zeros((0, 2), int)).shape == (0, HEIGHT, WIDTH, 3)


@pytest.mark.parametrize("model", sorted(COLOUR_MODELS))
def test_colour_models(tmp_path, rng, model):
    rgb = colours(rng)
    source = opened(tmp_path, btf_bytes(rgb, size=8, model=model))
    # Worst seen: 1.2e-7; log U and V cannot hold what is below ε, 9e-6.
    assert worst(source, rgb, False) < (2e-5 if model == 10 else 4e-7)
    assert any(COLOUR_MODELS[model] in note for note in source.notes)


def test_half_precision_is_the_product_of_the_stored_halves(tmp_path, rng):
    rgb = colours(rng)
    source = opened(tmp_path, btf_bytes(rgb, size=2, cosine=True))
    truth = np.empty((len(VIEWS) * len(LIGHTS), WIDTH * HEIGHT, 3))
    for c in range(3):
        u, s, v = np.linalg.svd(rgb[..., c].reshape(-1, WIDTH * HEIGHT), full_matrices=False)
        truth[..., c] = u.astype(np.float16).astype(float) @ (s[:, None] * v).astype(np.float16).astype(float)
    truth = np.swapaxes(truth.reshape(rgb.shape), 0, 1).reshape(-1, HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(source.slices(all_pairs()), np.maximum(truth, 0), atol=2e-6)


def test_dynamic_range_reduction(tmp_path, rng):
    rgb = colours(rng) ** 4 * 30
    assert worst(opened(tmp_path, btf_bytes(rgb, b"!FMF12FCER", log=True)), rgb, False) < 4e-6  # worst seen: 1.4e-6


@pytest.mark.parametrize(("version", "fields"), [(1, False), (2, True), (3, True), (4, True)])
def test_versions_of_the_meta_data(tmp_path, rng, version, fields):
    rgb = colours(rng)
    source = opened(tmp_path, btf_bytes(rgb, version=version, cosine=True))
    assert worst(source, rgb, cosine=fields) < 2e-6


def test_r_of_the_signature_is_not_taken_from_the_next_field(tmp_path, rng):
    names = ("R", "G", "B" + "\0" * (0x152 - 298))  # meta data of 0x152 bytes: their first byte is an "R"
    data = btf_bytes(rgb := colours(rng), b"!FMF06FC", names=names)
    assert data[8:9] == b"R"
    assert worst(opened(tmp_path, data), rgb, False) < 2e-6


def test_directions_are_unit_and_in_the_local_frame(tmp_path, rng):
    data = btf_bytes(colours(rng))
    source = opened(tmp_path, data)
    x, y, z = (f(LIGHTS[2]) for f in (lambda a: np.sin(a[0]) * np.cos(a[1]), lambda a: np.sin(a[0]) * np.sin(a[1]),
                                      lambda a: np.cos(a[0])))  # fmt: skip
    np.testing.assert_allclose(source.lights[2], [x, y, z], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(source.views, axis=1), 1, atol=1e-6)
    assert source.lights.dtype == source.views.dtype == np.float32
    mirrored = opened(tmp_path, data, azimuth="clockwise")
    np.testing.assert_array_equal(mirrored.lights, source.lights * np.float32([1, -1, 1]))
    assert "clockwise" in mirrored.notes[-1]


def test_directions_at_the_horizon_are_left_out(tmp_path, rng):
    lights = LIGHTS.copy()
    lights[1, 0] = np.pi / 2
    rgb = colours(rng)
    source = opened(tmp_path, btf_bytes(rgb, directions=direction_bytes(lights), cosine=True))
    assert len(source.lights) == 4
    assert any("1 lights at the horizon" in note for note in source.notes)
    np.testing.assert_allclose(source.slices(np.array([[1, 3]]))[0], rgb[3, 2], atol=4e-6)


def test_scale_opening_and_heights(tmp_path, rng):
    rgb, heights = colours(rng), rng.random((HEIGHT, WIDTH)).astype(np.float16)
    data = btf_bytes(rgb, b"!FMF12FCER", heights=heights, rgb_scale=(1, 2, 1), names=("650", "550", "450"))
    source = opened(tmp_path, data, scale=2.0)
    assert worst(source, 2 * rgb, False) < 2e-6
    np.testing.assert_array_equal(source.heights, heights.astype(np.float32))
    notes = "\n".join(source.notes)
    for part in ("a dome", "650, 550, 450", "(1, 2, 1) is not applied", "times 2"):
        assert part in notes
    again = open_ubo2014(**source.opening)
    np.testing.assert_array_equal(again.slices(all_pairs()), source.slices(all_pairs()))


def test_values_below_zero_are_zero(tmp_path, rng):
    rgb = colours(rng) - 0.5
    got = opened(tmp_path, btf_bytes(rgb, cosine=True)).slices(all_pairs())
    np.testing.assert_allclose(got, np.maximum(expected(rgb, True), 0), atol=2e-6)
    assert got.min() == 0


@pytest.mark.parametrize("wrong", [np.inf, -np.inf, np.nan])
@pytest.mark.parametrize("size", [2, 4, 8])
def test_only_the_asked_slices_are_decoded(tmp_path, rng, size, wrong):
    """Numbers that are not finite matter to the slices that need them, and to no other."""
    data = bytearray(btf_bytes(colours(rng), size=size))
    k = len(LIGHTS) * len(VIEWS)
    start = len(data) - size * (k * WIDTH * HEIGHT + k * k)  # U of the last channel: rows of pairs, light fastest
    start += size * k * (2 * len(LIGHTS) + 3)
    data[start : start + size] = TYPES[size](wrong).tobytes()
    source = opened(tmp_path, bytes(data))
    others = all_pairs()[(all_pairs() != [3, 2]).any(1)]
    assert np.isfinite(source.slices(others)).all()
    with pytest.raises(ValueError, match=r"slice of light 3, view 2: must be finite"):
        source.slices(np.array([[0, 0], [3, 2]]))


def test_every_half_float():
    every = np.arange(65536, dtype=np.uint16).view(np.float16)
    finite = every[np.isfinite(every)]
    for stored in (finite, every):
        np.testing.assert_array_equal(_floats(stored), stored.astype(np.float32))


def broken(rng, **options):
    return btf_bytes(colours(rng), **options)


@pytest.mark.parametrize(
    ("make", "field", "rule"),
    [
        (lambda r: b"", "signature", "empty"),
        (lambda r: b"BTF file of another kind", "signature", "none of"),
        (lambda r: b"!PVF06FCR" + bytes(400), "signature", "per view"),
        (lambda r: broken(r, version=7), "version of the meta data", "7 is none of"),
        (lambda r: broken(r, stated=400), "meta data", "bytes long where the file says 400"),
        (lambda r: broken(r, names=("R",) * 29), "channels", "29"),
        (lambda r: broken(r, names=("B", "G", "R")), "channels", "in the order B, G, R"),
        (lambda r: broken(r, rotations=2), "rotations", "2 local frames"),
        (lambda r: broken(r, model=2), "colour model", "2 is none of"),
        (lambda r: broken(r, model=5), "colour model", "5 is none of"),
        (lambda r: broken(r, extent=(0, 5)), "width", "positive"),
        (lambda r: broken(r, extent=(7, 5)), "channel 0: rows and columns", "does not fit"),
        (lambda r: broken(r, signature=b"!FMF12FCER", fmf=3), "version of the FMF header", "3 is none of"),
        (lambda r: broken(r, signature=b"!FMF12FCER", heights=np.ones((3, 9))), "height map", "9x3"),
        (lambda r: broken(r, directions=direction_bytes(other=LIGHTS + 0.1)), "lights", "view 3 has other lights"),
        (lambda r: broken(r, directions=direction_bytes(other=LIGHTS[:3])), "lights", "view 3 has other lights"),
        (lambda r: broken(r, directions=direction_bytes(views=[(30.0, 0.0)])), "views", "θ = 30"),
        (lambda r: broken(r, directions=struct.pack("<I", 0)), "number of views", "positive"),
        (lambda r: broken(r, directions=struct.pack("<I2fI", 1, 0, 0, 1 << 31)), "lights of view 0", "too early"),
        (lambda r: broken(r) + b"!", "length", "1 bytes more"),
        (lambda r: broken(r)[:-1], "channel 2: S·V", "1 bytes too early"),
        (lambda r: broken(r)[:200], "measurement setup|image sensor", "too early"),
    ],
)
def test_broken_files_are_named_in_one_line(tmp_path, rng, make, field, rule):
    with pytest.raises(FormatError, match=rf"cloth01.*\.btf: .*({field}).*: .*{rule}.*; ") as caught:
        opened(tmp_path, make(rng))
    assert "\n" not in str(caught.value)


def test_every_truncation_is_refused(tmp_path, rng):
    data = btf_bytes(colours(rng), b"!FMF12FCER", heights=np.ones((HEIGHT, WIDTH)))
    for length in [*range(0, 480, 7), *range(480, len(data), 997), len(data) - 1]:
        with pytest.raises(FormatError):
            opened(tmp_path, data[:length])


@pytest.mark.parametrize("options", [{"azimuth": "left"}, {"scale": 0.0}, {"scale": np.nan}])
def test_wrong_options_are_named(tmp_path, rng, options):
    with pytest.raises(ValueError, match=f"{next(iter(options))} must be"):
        opened(tmp_path, btf_bytes(colours(rng)), **options)


def test_missing_file_and_wrong_pairs(tmp_path, rng):
    with pytest.raises(FileNotFoundError):
        open_ubo2014(tmp_path / "none.btf")
    with pytest.raises(ValueError, match=r"must be below \(5, 4\)"):
        opened(tmp_path, btf_bytes(colours(rng))).slices(np.array([[0, 4]]))
