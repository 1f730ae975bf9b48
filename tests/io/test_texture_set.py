"""Texture sets: what is understood of a folder, a manifest and overrides, and what is said when it cannot be."""

import json
import re
import struct
import zlib

import numpy as np
import pytest

from warp_neumat.io.image import write_exr, write_png
from warp_neumat.io.map_pixels import integrability, png_color_space
from warp_neumat.io.map_sources import list_sources
from warp_neumat.io.mipmaps import srgb_to_linear
from warp_neumat.io.texture_set import Channel, open_texture_set

SIZE = 8


@pytest.fixture
def put(tmp_path, rng):
    """put(name, values): write a picture; values are uint8, uint16 (PNG), floats (EXR), or a number of channels."""

    def write(name, values=3, size=(SIZE, SIZE)):
        if isinstance(values, int):
            values = rng.integers(0, 256, (size[1], size[0], values), dtype=np.uint8)
        values = np.asarray(values)
        values = values[..., None] if values.ndim == 2 else values
        if name.endswith(".exr"):
            write_exr(tmp_path / name, values.astype(np.float32), half=False)
        elif values.dtype == np.uint16:
            (tmp_path / name).write_bytes(png16(values))
        else:
            write_png(tmp_path / name, values)
        return values

    return write


def png16(values, extra=b""):
    """A 16-bit PNG without any statement of its colours, one or three channels; ``extra`` chunks come before it."""
    height, width, count = values.shape

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    head = struct.pack(">IIBBBBB", width, height, 16, {1: 0, 3: 2}[count], 0, 0, 0)
    parts = chunk(b"IHDR", head) + extra + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


def gamma_chunk(value):
    data = b"gAMA" + struct.pack(">I", value)
    return struct.pack(">I", 4) + data + struct.pack(">I", zlib.crc32(data))


def flat_normal(size=(SIZE, SIZE)):
    return np.broadcast_to(np.uint8([128, 128, 255]), (size[1], size[0], 3)).copy()


def bumpy_normal(size=64, dx=False):
    """Normals of a smooth height field, +Y up unless ``dx``."""
    at = 2 * np.pi * (np.arange(size) + 0.5) / size
    x, y = np.meshgrid(at, -at)  # y goes up, rows go down
    p, q = 0.8 * np.cos(x) * np.sin(2 * y), 1.6 * np.sin(x) * np.cos(2 * y)  # gradient of 0.8 sin(x) sin(2y)
    n = np.stack([-p, -q, np.ones_like(p)], -1) / np.sqrt(1 + p * p + q * q)[..., None]
    if dx:
        n[..., 1] *= -1
    return np.uint8(np.round(127.5 * (n + 1)))


def plane(found, name, component="value"):
    at = [(c.map, c.component) for c in found.channels].index((name, component))
    return found.pixels[..., at]


def maps_of(found):
    return list(dict.fromkeys(c.map for c in found.channels))


def said(found, text):
    return any(text in note for note in found.notes)


# --- what is understood -----------------------------------------------------------------------------------------------


def test_folder_gives_channels_in_the_encoded_domain(tmp_path, put):
    color, rough = put("oak_color.png", 3), put("oak_roughness.png", 1)
    found = open_texture_set(tmp_path)
    assert (found.name, found.width, found.height) == (tmp_path.name, SIZE, SIZE)
    assert found.channels == (
        *(Channel("base_color", c, "srgb", (0.0, 1.0)) for c in "rgb"),
        Channel("roughness", "value", "linear", (0.0, 1.0)),
    )
    assert found.pixels.dtype == np.float32
    assert found.pixels.flags.c_contiguous
    np.testing.assert_array_equal(np.round(found.pixels * 255), np.concatenate([color, rough], -1))
    assert found.files == {"base_color": "oak_color.png", "roughness": "oak_roughness.png"}


def test_table_says_what_was_understood(tmp_path, put):
    put("oak_color.png"), put("oak_arm.png"), put("oak_lichen.png", 1)
    put("oak_metallic.png", np.zeros((SIZE, SIZE), np.uint8))
    text = open_texture_set(tmp_path).table()
    assert "6 channels to learn" in text
    for line in (
        r"base_color +oak_color.png +r g b +srgb +8×8 +uint8 +learnt",
        r"roughness +oak_arm.png:g +value +linear +8×8 +uint8 +learnt",
        r"metallic +oak_metallic.png +value +linear +8×8 +uint8 +constant 0",
        r"note: oak_lichen.png: no known map in its name; kept as the extra map lichen, linear",
        r"note: oak_arm.png:b: not used for metallic, oak_metallic.png is a map of its own",
    ):
        assert re.search(line, text), f"{line}\n{text}"


def test_packed_maps_are_taken_apart(tmp_path, put):
    packed = put("x_occlusionRoughnessMetallic.png", 3)
    found = open_texture_set(tmp_path)
    for name, c in (("occlusion", 0), ("roughness", 1), ("metallic", 2)):
        np.testing.assert_array_equal(np.round(255 * plane(found, name)), packed[..., c])
    assert found.files["roughness"] == "x_occlusionRoughnessMetallic.png:g"


def test_gloss_becomes_roughness_unless_there_is_one(tmp_path, put):
    gloss = put("x_gloss.png", 1)
    found = open_texture_set(tmp_path)
    np.testing.assert_array_equal(np.round(255 * plane(found, "roughness")), 255 - gloss[..., 0])
    rough = put("x_roughness.png", 1)
    found = open_texture_set(tmp_path)
    np.testing.assert_array_equal(np.round(255 * plane(found, "roughness")), rough[..., 0])
    assert said(found, "a roughness map is there")


def test_bump_is_the_displacement_unless_there_is_one(tmp_path, put):
    put("x_color.png"), put("x_bump.png", 1)
    assert maps_of(open_texture_set(tmp_path)) == ["base_color", "displacement"]
    put("x_displacement.png", 1)
    assert maps_of(open_texture_set(tmp_path)) == ["base_color", "displacement", "bump"]


def test_a_picture_without_a_word_is_the_base_colour(tmp_path, put):
    put("floor.png"), put("floor_roughness.png", 1)
    found = open_texture_set(tmp_path)
    assert maps_of(found) == ["base_color", "roughness"]
    assert said(found, "taken as base_color")


def test_previews_texts_and_folders_are_ignored_with_a_note(tmp_path, put):
    put("oak_color.png"), put("oak_preview.png"), put("oak.png")
    (tmp_path / "licence.txt").write_text("CC0")
    (tmp_path / "raw").mkdir()
    (tmp_path / ".DS_Store").write_bytes(b"\0")
    found = open_texture_set(tmp_path)
    assert maps_of(found) == ["base_color"]
    assert [note.split(":")[0] for note in found.notes] == ["licence.txt", "raw", "oak.png", "oak_preview.png"]


SETS = {
    "bishop_black": "base_color normal roughness metallic",
    "boombox": "base_color normal roughness:g metallic:b occlusion:r emissive",
    "brick": "base_color normal roughness mask mask_dirt mask_variation",
    "castle_white": "base_color normal roughness metallic",
    "chessboard": "base_color normal roughness metallic",
    "floor_tiles": "base_color normal displacement",
    "knight_white": "base_color normal roughness",
}


@pytest.mark.parametrize("name", SETS)
def test_real_sets_are_understood(data, name):
    found = list_sources(data / "textures" / name)
    assert " ".join(s.map + (f":{s.channel}" if s.channel else "") for s in found.sources) == SETS[name]


def test_a_real_set_is_read_and_filtered(data):
    found = open_texture_set(data / "textures" / "boombox", crop=(900, 700, 512, 1024), size=64)
    assert found.pixels.shape == (64, 32, 11)
    assert 0 <= found.pixels.min() < found.pixels.max() <= 1
    assert [level.shape[:2] for level in found.mips()] == [(64 >> m, max(1, 32 >> m)) for m in range(7)]


def test_real_normals_of_floor_tiles_are_found_to_be_directx(data):
    found = open_texture_set(
        data / "textures" / "floor_tiles", size=8, overrides={"base_color": None, "displacement": None}
    )
    assert said(found, "looks like DirectX (curl correlation -0.8")


def test_extra_maps_keep_their_alpha_where_it_says_something(tmp_path, put, rng):
    values = rng.integers(0, 256, (SIZE, SIZE, 4), dtype=np.uint8)
    put("x_color.png"), put("x_01.png", values)
    found = open_texture_set(tmp_path)
    assert [c.component for c in found.channels if c.map == "map_01"] == list("rgba")
    np.testing.assert_array_equal(open_texture_set(found.manifest()).pixels, found.pixels)
    values[..., 3] = 255
    put("x_01.png", values)
    assert [c.component for c in open_texture_set(tmp_path).channels if c.map == "map_01"] == list("rgb")


# --- constants, grey, alpha, sizes ------------------------------------------------------------------------------------


def test_constant_maps_become_linear_scalars(tmp_path, put):
    put("x_roughness.png", 1)
    put("x_color.png", np.full((SIZE, SIZE, 3), 188, np.uint8) + np.uint8([0, 1, 2]))
    put("x_metallic.png", np.zeros((SIZE, SIZE), np.uint8))
    put("x_normal.png", flat_normal())
    found = open_texture_set(tmp_path)
    assert maps_of(found) == ["roughness"]
    assert found.constants["metallic"] == (0.0,)
    np.testing.assert_allclose(found.constants["base_color"], [0.5029, 0.5089, 0.5149], atol=1e-3)
    np.testing.assert_allclose(found.constants["normal"], [1 / 255, 1 / 255, 1], atol=1e-4)
    assert [row.use for row in found.rows] == ["constant", "constant", "learnt", "constant"]


def test_a_nearly_constant_map_is_learnt_with_a_note(tmp_path, put):
    """JPEG noise around black: one texel off by one step of 8 bits is enough to be kept."""
    values = np.zeros((SIZE, SIZE), np.uint8)
    values[3, 4] = 1
    put("x_metallic.png", values)
    found = open_texture_set(tmp_path)
    assert maps_of(found) == ["metallic"]
    assert said(found, "nearly constant (stored values 0 … 0.00392) but learnt")


def test_constancy_is_half_a_step_of_8_bits(tmp_path, put):
    values = np.full((SIZE, SIZE), 0.25)
    values[0, 0] += 0.49 / 255
    put("a_roughness.exr", values)
    values[0, 0] = 0.25 + 0.51 / 255
    put("a_metallic.exr", values)
    found = open_texture_set(tmp_path)
    assert maps_of(found) == ["metallic"]
    assert list(found.constants) == ["roughness"]


def test_grey_pictures_of_scalar_maps_give_one_channel(tmp_path, put, rng):
    grey = rng.integers(1, 255, (SIZE, SIZE, 1), dtype=np.uint8).repeat(3, 2)
    put("x_color.png", grey)
    grey[2, 3, 1] += 1
    put("x_roughness.png", grey)
    put("x_emissive.png", grey)
    put("x_specular.png", grey)
    found = open_texture_set(tmp_path)
    counts = {m: sum(c.map == m for c in found.channels) for m in maps_of(found)}
    assert counts == {"base_color": 1, "roughness": 1, "emissive": 3, "specular": 1}
    np.testing.assert_allclose(255 * plane(found, "roughness"), grey.mean(-1), atol=1e-4)


def test_a_coloured_scalar_map_is_averaged_with_a_note(tmp_path, put):
    values = put("x_roughness.png", 3)
    found = open_texture_set(tmp_path)
    np.testing.assert_allclose(255 * plane(found, "roughness"), values.mean(-1), atol=1e-3)
    assert said(found, "the picture is coloured")


def test_alpha_of_the_base_colour_is_opacity_where_it_says_something(tmp_path, put, rng):
    values = rng.integers(0, 256, (SIZE, SIZE, 4), dtype=np.uint8)
    put("x_basecolor.png", values)
    found = open_texture_set(tmp_path)
    assert maps_of(found) == ["base_color", "opacity"]
    np.testing.assert_array_equal(np.round(255 * plane(found, "opacity")), values[..., 3])
    np.testing.assert_array_equal(np.round(255 * plane(found, "base_color", "g")), values[..., 1])
    assert said(found, "the alpha channel of the base colour")
    values[..., 3] = 255
    put("x_basecolor.png", values)
    assert maps_of(open_texture_set(tmp_path)) == ["base_color"]
    assert not open_texture_set(tmp_path).constants
    values[..., 3] = 51
    put("x_basecolor.png", values)
    assert open_texture_set(tmp_path).constants["opacity"] == pytest.approx((0.2,))


def test_alpha_steps_back_for_an_opacity_map(tmp_path, put):
    put("x_basecolor.png", 4)
    opacity = put("x_opacity.png", 1)
    found = open_texture_set(tmp_path)
    np.testing.assert_array_equal(np.round(255 * plane(found, "opacity")), opacity[..., 0])


def test_a_1x1_map_is_a_scalar(tmp_path, put):
    put("x_color.png", 3), put("x_roughness.png", np.full((1, 1), 51, np.uint8))
    found = open_texture_set(tmp_path)
    assert found.constants["roughness"] == pytest.approx((0.2,))
    assert (found.width, found.height) == (SIZE, SIZE)


def test_a_set_of_1x1_maps_has_nothing_to_learn(tmp_path, put):
    put("x_color.png", 3, (1, 1)), put("x_roughness.png", 1, (1, 1))
    found = open_texture_set(tmp_path)
    assert (found.pixels.shape, set(found.constants)) == ((1, 1, 0), {"base_color", "roughness"})
    assert said(found, "nothing is left to learn")


@pytest.mark.parametrize("size", [(3, 50), (3, 1), (7, 3)])
def test_narrow_maps_open(tmp_path, put, size):
    put("x_color.png", 3, size), put("x_normal.png", 3, size)
    found = open_texture_set(tmp_path)
    assert found.pixels.shape == (size[1], size[0], 5)
    assert np.isfinite(found.pixels).all()
    assert found.mips()[-1].shape == (1, 1, 5)


def test_smaller_maps_are_brought_to_the_largest(tmp_path, put):
    put("x_color.png", 3, (16, 16))
    rough = put("x_roughness.png", 1, (8, 8))
    found = open_texture_set(tmp_path)
    assert found.pixels.shape == (16, 16, 4)
    large = 255 * plane(found, "roughness")
    np.testing.assert_allclose(large[0, 0], rough[0, 0, 0], atol=1e-3)
    np.testing.assert_allclose(large[0, 1], 0.75 * rough[0, 0, 0] + 0.25 * rough[0, 1, 0], atol=1e-3)
    assert said(found, "8×8 brought to the set's 16×16")


def test_crop_then_size(tmp_path, put):
    color = put("x_color.png", 3, (16, 12))
    put("x_roughness.png", 1, (8, 6))
    whole = open_texture_set(tmp_path)
    found = open_texture_set(tmp_path, crop=(4, 2, 8, 6))
    np.testing.assert_array_equal(found.pixels, whole.pixels[2:8, 4:12])
    small = open_texture_set(tmp_path, crop=(4, 2, 8, 6), size=4)
    assert (small.width, small.height) == (4, 3)
    light = srgb_to_linear(color[2:8, 4:12] / np.float32(255)).reshape(3, 2, 4, 2, 3).mean((1, 3))
    np.testing.assert_allclose(srgb_to_linear(small.pixels[..., :3]), light, atol=1e-6)


# --- numbers ----------------------------------------------------------------------------------------------------------


def test_16_bit_maps_keep_their_bits(tmp_path, put, rng):
    values = put("x_displacement.png", rng.integers(0, 65536, (SIZE, SIZE, 1), dtype=np.uint16))
    found = open_texture_set(tmp_path)
    np.testing.assert_array_equal(np.round(plane(found, "displacement") * 65535), values[..., 0])
    assert found.rows[0].dtype == "uint16"


@pytest.mark.parametrize(
    ("chunk", "space"), [(b"", "linear"), (gamma_chunk(45455), "srgb"), (gamma_chunk(100000), "linear")]
)
def test_a_16_bit_base_colour_is_srgb_only_if_it_says_so(tmp_path, rng, chunk, space):
    values = rng.integers(0, 65536, (SIZE, SIZE, 3), dtype=np.uint16)
    (tmp_path / "x_color.png").write_bytes(png16(values, chunk))
    found = open_texture_set(tmp_path)
    assert {c.encoding for c in found.channels} == {space}
    assert said(found, "taken as linear") == (chunk == b"")
    assert png_color_space(tmp_path / "x_color.png") == {b"": None}.get(chunk, space)


def test_exr_is_linear_and_keeps_its_range(tmp_path, put, rng):
    color, height = rng.random((SIZE, SIZE, 3)), 5 * rng.random((SIZE, SIZE)) - 2
    put("x_color.exr", color), put("x_height.exr", height)
    found = open_texture_set(tmp_path)
    np.testing.assert_allclose(found.pixels[..., :3], color, atol=1e-7)
    assert {c.encoding for c in found.channels} == {"linear"}
    low, high = found.channels[3].range
    assert (low, high) == pytest.approx((height.min(), height.max()))
    assert 0 <= found.pixels.min() <= found.pixels.max() <= 1
    np.testing.assert_allclose(low + (high - low) * plane(found, "displacement"), height, atol=1e-6)
    assert said(found, "stored with this range")


def test_a_constant_beyond_one_keeps_its_value(tmp_path, put):
    put("x_color.exr", 3), put("x_emissive.exr", np.full((SIZE, SIZE, 3), 20.0))
    assert open_texture_set(tmp_path).constants["emissive"] == (20.0,)  # grey throughout: one channel


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused_or_replaced(tmp_path, put, rng, bad):
    values = rng.random((SIZE, SIZE))
    values[2, 5] = values[6, 1] = bad
    put("x_color.png"), put("x_roughness.exr", values)
    with pytest.raises(
        ValueError, match=r"x_roughness.exr: map roughness: 2 pixels are NaN or infinite, the first at x=5, y=2"
    ):
        open_texture_set(tmp_path)
    found = open_texture_set(tmp_path, overrides={"roughness": {"replace_nan": 0.5}})
    assert plane(found, "roughness")[2, 5] == 0.5
    assert said(found, "2 pixels were NaN")
    assert maps_of(open_texture_set(tmp_path, overrides={"roughness": None})) == ["base_color"]


# --- normals ----------------------------------------------------------------------------------------------------------


def test_directx_normals_are_flipped_or_dropped(tmp_path, put):
    values = put("x_NormalDX.png", bumpy_normal(dx=True))
    found = open_texture_set(tmp_path)
    np.testing.assert_allclose(255 * plane(found, "normal", "x"), values[..., 0], atol=0.02)
    np.testing.assert_allclose(255 * plane(found, "normal", "y"), 255 - values[..., 1], atol=0.02)
    assert said(found, "green flipped")
    values = put("x_NormalGL.png", bumpy_normal())
    found = open_texture_set(tmp_path)
    np.testing.assert_allclose(255 * plane(found, "normal", "y"), values[..., 1], atol=0.02)
    assert said(found, "x_NormalDX.png: not used for normal, the OpenGL one is there")


def test_orientation_is_told_from_the_curl_and_left_alone(tmp_path, put):
    values = put("x_normal.png", bumpy_normal(dx=True))
    found = open_texture_set(tmp_path)
    assert said(found, "orientation not named and it looks like DirectX (curl correlation -")
    np.testing.assert_allclose(255 * plane(found, "normal", "y"), values[..., 1], atol=0.02)
    turned = open_texture_set(tmp_path, overrides={"normal": {"orientation": "dx"}})
    np.testing.assert_allclose(plane(turned, "normal", "y"), 1 - plane(found, "normal", "y"), atol=1e-6)
    assert not said(turned, "looks like")
    put("x_normal.png", bumpy_normal())
    assert open_texture_set(tmp_path).notes == ()


def test_integrability_is_signed(rng):
    gl, dx = (bumpy_normal(dx=d) / 127.5 - 1 for d in (False, True))
    assert integrability(np.float32(gl)) > 0.95
    assert integrability(np.float32(dx)) < -0.95
    assert abs(integrability(rng.normal(0, 0.3, (64, 64, 3)).astype(np.float32) + np.float32([0, 0, 1]))) < 0.15
    assert integrability(np.float32(flat_normal((64, 64)) / 127.5 - 1)) == 0


def test_normals_of_odd_lengths_are_normalised(tmp_path, put):
    unit = bumpy_normal().astype(np.float32) / 127.5 - 1
    put("x_normal.exr", 0.5 * unit)  # signed floats, and short
    found = open_texture_set(tmp_path)
    xyz = unit / np.linalg.norm(unit, axis=-1, keepdims=True)
    np.testing.assert_allclose(2 * found.pixels - 1, xyz[..., :2], atol=1e-5)
    assert said(found, "normalised")


def test_normals_never_leave_the_unit_circle(tmp_path, put):
    put("x_normal.png", np.uint8([[[255, 255, 128], [0, 255, 128], [128, 128, 255]]]).repeat(3, 0))
    xy = 2 * open_texture_set(tmp_path).pixels - 1
    assert (xy**2).sum(-1).max() <= 1 + 1e-6


def test_a_two_channel_normal_is_one_and_a_one_channel_normal_is_not(tmp_path, put):
    put("x_normal.png", 1)
    with pytest.raises(ValueError, match=r"x_normal.png: map normal: has one channel, a normal map needs two"):
        open_texture_set(tmp_path)
    put("x_normal.png", bumpy_normal(16))
    found = open_texture_set(tmp_path, overrides={"normal": {"channel": "rg"}})
    assert [c.component for c in found.channels] == ["x", "y"]


# --- complaints -------------------------------------------------------------------------------------------------------


def test_two_files_for_one_map_are_refused_and_can_be_chosen(tmp_path, put):
    put("a_roughness.png", 1)
    second = put("b_roughness.png", 1)
    with pytest.raises(
        ValueError, match=r"a_roughness.png and b_roughness.png both claim the map roughness; choose one with overrides"
    ):
        open_texture_set(tmp_path)
    found = open_texture_set(tmp_path, overrides={"roughness": {"file": "b_roughness.png"}})
    np.testing.assert_array_equal(np.round(255 * plane(found, "roughness")), second[..., 0])


@pytest.mark.parametrize(
    "names", [("x_color.png", "x_albedo.png"), ("x_orm.png", "x_arm.png"), ("x_ao_1k.png", "x_ao_2k.png")]
)
def test_synonyms_are_one_map(tmp_path, put, names):
    for name in names:
        put(name)
    with pytest.raises(ValueError, match="both claim the map"):
        open_texture_set(tmp_path)


@pytest.mark.parametrize("keep", [0, 20, 60, 0.5, 0.95])
def test_a_broken_png_is_named(tmp_path, put, keep):
    put("x_color.png", 3, (64, 64)), put("x_roughness.png", 1)
    data = (tmp_path / "x_color.png").read_bytes()
    (tmp_path / "x_color.png").write_bytes(data[: int(keep * len(data)) if isinstance(keep, float) else keep])
    with pytest.raises(OSError, match=r"x_color\.png: (is damaged|cannot be read)") as error:
        open_texture_set(tmp_path)
    assert "\n" not in str(error.value)
    assert maps_of(open_texture_set(tmp_path, overrides={"base_color": None})) == ["roughness"]


def test_a_truncated_jpeg_is_named(tmp_path, data):
    whole = (data / "textures" / "castle_white" / "castle_shared_metallic.jpg").read_bytes()
    (tmp_path / "x_metallic.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(OSError, match=r"x_metallic\.jpg: is damaged: .*Premature end"):
        open_texture_set(tmp_path)


def test_a_text_called_png_is_named(tmp_path):
    (tmp_path / "x_color.png").write_text("not a picture")
    with pytest.raises(OSError, match=r"x_color\.png: cannot be read as a picture"):
        open_texture_set(tmp_path)


def test_folders_without_maps_are_refused(tmp_path, put):
    with pytest.raises(ValueError, match="holds no pictures"):
        open_texture_set(tmp_path)
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(ValueError, match="holds no pictures"):
        open_texture_set(tmp_path)
    put("x_preview.png")
    with pytest.raises(ValueError, match="holds previews only"):
        open_texture_set(tmp_path)
    with pytest.raises(FileNotFoundError, match="nothing: no such folder or manifest"):
        open_texture_set(tmp_path / "nothing")
    with pytest.raises(ValueError, match=r"must be a folder of maps or a \.json manifest"):
        open_texture_set(tmp_path / "a.txt")


def test_more_than_16_channels_are_listed(tmp_path, put):
    for i in range(6):
        put(f"x_layer{'abcdef'[i]}.png")
    with pytest.raises(
        ValueError, match=r"18 channels, at most 16 fit: .*layerf \(3\); drop maps with overrides=.*None"
    ):
        open_texture_set(tmp_path)
    found = open_texture_set(tmp_path, overrides={"x_layera": None})
    assert len(found.channels) == 15


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"roughnes": {"channel": "r"}}, "overrides: roughnes: the set has no such map; nearest: roughness"),
        ({"roughness": {"chanel": "r"}}, "overrides: roughness: unknown field 'chanel'; nearest: channel"),
        ({"roughness": {"color_space": "lineer"}}, "color_space must be srgb or linear, got 'lineer'; nearest: linear"),
        ({"roughness": {"orientation": "gl"}}, "orientation is for normal maps"),
        ({"normal": {"orientation": "up"}}, "orientation must be gl or dx, got 'up'"),
        ({"normal": {"color_space": "srgb"}}, "a normal map is never sRGB"),
        ({"normal": 1.0}, "constant of a normal map is a vector of 3 numbers"),
        ({"roughness": {"channel": "q"}}, "channel must be letters"),
        ({"roughness": {"channel": "a"}}, "has no channel a; its channels are Y"),
        ({"roughness": {"file": "x_roughnes.png"}}, "no such file; nearest: x_roughness.png"),
        ({"roughness": {"constant": float("nan")}}, "constant must be a finite number"),
        ({"roughness": {"constant": 1, "file": "x_color.png"}}, "both a file and a constant"),
        ({"roughness": {"invert": 1}}, "invert must be true or false"),
        ({"roughness": "x.png"}, "must be a dictionary of fields"),
        ({"Rough ness": 0.5}, "a map's name must be lower-case"),
        ({"roughness": None, "normal": None, "base_color": None}, "every map is dropped"),
    ],
)
def test_wrong_overrides_are_explained_in_one_line(tmp_path, put, overrides, message):
    put("x_color.png"), put("x_roughness.png", 1), put("x_normal.png")
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        open_texture_set(tmp_path, overrides=overrides)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"size": 0}, "size must be"),
        ({"size": (4, 4, 4)}, "size must be"),
        ({"size": "4k"}, "size must be"),
        ({"crop": (0, 0, 9, 8)}, "must lie within the set's 8×8 pixels"),
        ({"crop": (-1, 0, 4, 4)}, "must lie within"),
        ({"crop": (0, 0, 4)}, "crop must be"),
    ],
)
def test_wrong_size_and_crop_are_refused(tmp_path, put, option, message):
    put("x_color.png")
    with pytest.raises(ValueError, match=message):
        open_texture_set(tmp_path, **option)


# --- overrides and manifests ------------------------------------------------------------------------------------------


def test_overrides_choose_files_channels_spaces_and_constants(tmp_path, put):
    put("x_color.png"), put("x_mask.png", 1)
    odd = put("odd.png", 3)
    overrides = {
        "roughness": {"file": "odd.png", "channel": "g", "invert": True},
        "base_color": {"color_space": "linear"},
        "metallic": 0.25,
        "mask": None,
    }
    found = open_texture_set(tmp_path, overrides=overrides)
    assert maps_of(found) == ["base_color", "roughness"]  # odd.png is no extra map any more
    np.testing.assert_array_equal(np.round(255 * plane(found, "roughness")), 255 - odd[..., 1])
    assert found.channels[0].encoding == "linear"
    assert found.constants == {"metallic": (0.25,)}


def test_flip_turns_the_picture_upside_down(tmp_path, put):
    values = put("x_roughness.png", 1)
    found = open_texture_set(tmp_path, overrides={"roughness": {"flip": True}})
    np.testing.assert_array_equal(np.round(255 * plane(found, "roughness")), values[::-1, :, 0])


def test_manifest_opens_to_the_same_set(tmp_path, put, rng):
    folder = tmp_path
    put("x_basecolor.png", 4, (16, 16)), put("x_orm.png"), put("x_NormalDX.png", bumpy_normal(16, dx=True))
    put("x_height.exr", 3 * rng.random((SIZE, SIZE))), put("x_lichen.png", 3), put("y_gloss.png", 1)
    values = rng.integers(0, 65536, (SIZE, SIZE, 3), dtype=np.uint16)
    put("x_emissive.png", values)
    first = open_texture_set(folder, crop=(2, 2, 12, 8), size=(6, 6), overrides={"metallic": 0.5})
    out = tmp_path / "elsewhere"
    out.mkdir()
    (out / "set.json").write_text(json.dumps(first.manifest(out)))
    assert "../x_orm.png" in (out / "set.json").read_text()
    for source in (first.manifest(), out / "set.json"):
        second = open_texture_set(source)
        assert (second.name, second.channels, second.constants) == (first.name, first.channels, first.constants)
        np.testing.assert_array_equal(second.pixels, first.pixels)
        assert second.manifest() == first.manifest()


def test_ntc_manifest_is_read(tmp_path, put):
    color, packed, normal = put("a.png", 3), put("b.png", 3), put("c_normal.png", bumpy_normal(SIZE))
    tree = {
        "textures": [
            {"fileName": "a.png", "name": "Diffuse", "isSRGB": True, "bcFormat": "BC7", "semantics": {"Albedo": "RGB"}},
            {
                "fileName": "b.png",
                "channelSwizzle": "BGR",
                "semantics": {"Metalness": "R", "AO": "G", "Glossiness": "B"},
            },
            {"fileName": "c_normal.png", "verticalFlip": True},
            {"fileName": "c_normal.png", "mipLevel": 1},
        ]
    }
    (tmp_path / "set.json").write_text(json.dumps(tree))
    found = open_texture_set(tmp_path / "set.json")
    assert maps_of(found) == ["base_color", "normal", "roughness", "metallic", "occlusion"]
    assert {c.encoding for c in found.channels if c.map == "base_color"} == {"srgb"}
    np.testing.assert_array_equal(np.round(255 * plane(found, "metallic")), packed[..., 2])
    np.testing.assert_array_equal(np.round(255 * plane(found, "occlusion")), packed[..., 1])
    np.testing.assert_array_equal(np.round(255 * plane(found, "roughness")), 255 - packed[..., 0])
    np.testing.assert_allclose(255 * plane(found, "normal", "x"), normal[::-1, :, 0], atol=0.02)
    np.testing.assert_array_equal(np.round(255 * found.pixels[..., :3]), color)
    assert said(found, "mip 1 is not used")


def test_ntc_manifest_sets_the_size_and_is_linear_unless_it_says_so(tmp_path, put):
    put("a.png")
    textures = [{"fileName": str(tmp_path / "a.png"), "semantics": {"Albedo": "RGB"}}]
    found = open_texture_set({"textures": textures, "width": 4, "height": 2})
    assert (found.width, found.height, found.channels[0].encoding) == (4, 2, "linear")
    (tmp_path / "old.json").write_text(json.dumps(textures))  # the bare list of older versions
    assert open_texture_set(tmp_path / "old.json").width == SIZE


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is no JSON manifest"),
        ("{}", 'must have an object "maps"'),
        ('{"maps": {"roughness": {}}}', "needs a file or a constant"),
        ('{"maps": {"roughness": {"fil": "a"}}}', "unknown field 'fil'; nearest: file"),
        ('{"maps": {"roughness": {"constant": 1}}, "sise": 4}', "unknown key 'sise'; nearest: size"),
        ('{"maps": {"roughness": {"constant": 1}}, "version": 2}', "update warp-neumat"),
        ('{"maps": {"roughness": {"file": "gone.png"}}}', "gone.png: no such file"),
        ('{"textures": []}', "at least one"),
        (
            '{"textures": [{"fileName": "x.png", "semantics": {"Albdo": "RGB"}}]}',
            "unknown semantic 'Albdo'; nearest: albedo",
        ),
        ('{"textures": [{"fileName": "x.png", "semantics": {"Albedo": "BGR"}}]}', "must name a run of RGBA"),
        ('{"textures": [{"fileName": "x.png", "channelSwizzle": "XY"}]}', "channelSwizzle must be"),
    ],
)
def test_wrong_manifests_are_explained(tmp_path, put, text, message):
    put("x.png")
    (tmp_path / "set.json").write_text(text)
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        open_texture_set(tmp_path / "set.json")
    assert message in str(error.value)
    assert "\n" not in str(error.value)
