"""Block compression of maps: packing, sizes, sampling, and the encoders judged by other decoders and naive blocks."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from warp_neumat.training import baselines
from warp_neumat.training.baselines import METHODS, Baseline, pack, texture_bytes, upsample

GAMES = [method for method in METHODS if method != "bc_same"]
"""Those that pack maps by themselves."""


def channel(map, encoding="linear"):
    return SimpleNamespace(map=map, encoding=encoding)


def channels_of(*maps):
    """``"base_color"`` and ``"emissive"`` are RGB, ``"normal"`` is xy, all else one channel."""
    made = []
    for name in maps:
        if name in ("base_color", "emissive"):
            made += [channel(name, "srgb")] * 3
        elif name == "normal":
            made += [channel(name, "normal")] * 2
        else:
            made.append(channel(name))
    return made


def smooth(rng, height, width, count):
    """Waves of a few texels and up, with fine grain: what a photographed map looks like to a block."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    waves = np.zeros((height, width, count), np.float32)
    for _ in range(6):
        direction = rng.normal(size=2) * rng.uniform(0.02, 0.5)
        phase = direction[0] * x + direction[1] * y + rng.uniform(0, 6.28)
        waves += np.sin(phase)[..., None] * rng.uniform(-1, 1, count).astype(np.float32)
    waves = 0.5 + 0.1 * waves + 0.01 * rng.normal(size=waves.shape).astype(np.float32)
    return np.clip(waves, 0, 1).astype(np.float32)


def chain(pixels):
    """Mips by plain 2×2 means, down to 1×1."""
    mips = [pixels]
    while max(mips[-1].shape[:2]) > 1:
        h, w = (max(1, n // 2) for n in mips[-1].shape[:2])
        source = mips[-1][: 2 * h, : 2 * w]
        mips.append(source.reshape(h, source.shape[0] // h, w, source.shape[1] // w, -1).mean(axis=(1, 3)))
    return mips


def test_maps_are_packed_as_a_game_packs_them():
    maps = ("base_color", "displacement", "normal", "metallic", "roughness", "occlusion", "emissive", "mask")
    channels = [*channels_of(*maps), channel("grey", "srgb")]
    packed = {t.name: (t.kind, t.channels) for t in pack(channels)}
    assert packed == {
        "base_color": ("colour", (0, 1, 2)),
        "normal": ("normal", (4, 5)),
        "emissive": ("colour", (9, 10, 11)),
        "occlusion+roughness+metallic": ("scalars", (8, 7, 6)),
        "displacement+mask": ("scalars", (3, 12)),
        "grey": ("scalars", (13,)),
    }
    four = [channel("base_color", "srgb")] * 4
    assert [(t.name, t.channels) for t in pack(four)] == [("base_color", (0, 1, 2)), ("base_color.1", (3,))]


def test_formats_follow_the_rules(rng):
    pytest.importorskip("quicktex")
    pytest.importorskip("etcpak")
    pytest.importorskip("astc_encoder")
    channels = channels_of("base_color", "normal", "occlusion", "roughness", "metallic", "opacity")
    mips = chain(smooth(rng, 8, 8, len(channels)))
    names = ("normal", "base_color", "occlusion+roughness+metallic", "opacity")
    formats = {m: [Baseline(m, channels, mips).formats[name] for name in names] for m in GAMES}
    assert formats["bc_full"] == formats["bc_half"] == ["bc5", "bc1", "bc1", "bc1"]
    assert formats["bc7_full"] == ["bc5", "bc7", "bc7", "bc4"]
    assert formats["astc12"] == ["astc12"] * 4


def test_bytes_are_those_of_whole_blocks_of_all_mips(rng):
    pytest.importorskip("quicktex")
    assert texture_bytes("bc1", [(8, 8), (4, 4), (2, 2), (1, 1)]) == 8 * (4 + 1 + 1 + 1)
    assert texture_bytes("bc7", [(5, 9)]) == 16 * 2 * 3
    assert texture_bytes("astc12", [(24, 25), (12, 12)]) == 16 * (2 * 3 + 1)
    channels = channels_of("base_color", "normal")
    mips = chain(smooth(rng, 64, 64, 5))
    full, half = (Baseline(m, channels, mips).bytes for m in ("bc_full", "bc_half"))
    assert full == (8 + 16) * (256 + 64 + 16 + 4 + 1 + 1 + 1)
    assert half == full - (8 + 16) * 256


def test_sizes_of_the_paper():
    """Table 2, for sets of which 7 of 19 have a fourth texture: it counts BC in MiB and ASTC in 10⁶ bytes."""
    sizes = [(2048 >> m, 2048 >> m) for m in range(12)]
    for used, expected in ((sizes, 11.65), (sizes[1:], 2.91)):
        bc = (2 + 7 / 19) * texture_bytes("bc1", used) + texture_bytes("bc5", used)
        assert bc / 2**20 == pytest.approx(expected, abs=0.005)
    for used, expected in ((sizes, 2.11), (sizes[1:], 0.53)):
        assert (3 + 7 / 19) * texture_bytes("astc12", used) / 1e6 == pytest.approx(expected, abs=0.005)


@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
def test_upsample_is_bilinear_between_texel_centres(rng, wrap):
    source = rng.random((3, 4, 2)).astype(np.float32)
    got = upsample(source, 7, 8, wrap)
    fold = {
        "repeat": lambda i, n: i % n,
        "clamp": lambda i, n: min(max(i, 0), n - 1),
        "mirror": lambda i, n: i % (2 * n) if i % (2 * n) < n else 2 * n - 1 - i % (2 * n),
    }[wrap]
    for y, x in np.ndindex(7, 8):
        v, u = (y + 0.5) / 7 * 3 - 0.5, (x + 0.5) / 8 * 4 - 0.5
        y0, x0 = int(np.floor(v)), int(np.floor(u))
        expected = sum(
            (1 - abs(v - j)) * (1 - abs(u - i)) * source[fold(j, 3), fold(i, 4)].astype(float)
            for j in (y0, y0 + 1)
            for i in (x0, x0 + 1)
        )
        np.testing.assert_allclose(got[y, x], expected, atol=1e-6)
    with pytest.raises(ValueError, match="wrap must be repeat, clamp or mirror, got 'border'"):
        upsample(source, 7, 8, "border")


@pytest.mark.parametrize("format", ["bc1", "bc4", "bc5", "bc7"])
def test_blocks_decode_the_same_with_bcdec(rng, format):
    """imagecodecs wraps bcdec, which shares no code with the decoder that the figures come from."""
    pytest.importorskip("quicktex")
    pytest.importorskip("etcpak")
    imagecodecs = pytest.importorskip("imagecodecs")
    count = {"bc4": 1, "bc5": 2}.get(format, 3)
    pixels = smooth(rng, 32, 48, count)
    encode, decode = baselines._bc_coder(format)
    rgba, size = baselines._rgba8(pixels)
    blocks = encode(rgba, *size)
    assert len(blocks) == texture_bytes(format, [(32, 48)])
    number = int(format[2:])
    shape = (32, 48, 4) if number in (1, 7) else (32, 48, 2) if number == 5 else (32, 48)
    other = np.asarray(imagecodecs.bcn_decode(blocks, number, shape=shape)).reshape(32, 48, -1)[..., :count]
    ours = baselines._round_trip(format, "colour", 0)(pixels) * 255
    # BC1's and BC4's interpolated colours are not defined to the last bit: both round, not alike.
    assert np.abs(ours - other).max() <= (0 if format == "bc7" else 1)
    assert np.abs(ours / 255 - pixels).max() < 0.15


def test_astc_decodes_the_same_with_another_decoder(rng):
    pytest.importorskip("astc_encoder")
    texture2ddecoder = pytest.importorskip("texture2ddecoder")
    pixels = smooth(rng, 30, 50, 3)
    context = baselines._astc_context(False, baselines.THOROUGH)
    kept = []
    spy = SimpleNamespace(
        compress=lambda *a: kept.append(context.compress(*a)) or kept[-1], decompress=context.decompress
    )
    ours = baselines._astc(spy, False, pixels)
    assert len(kept[0]) == texture_bytes("astc12", [(30, 50)])
    bgra = np.frombuffer(texture2ddecoder.decode_astc(kept[0], 50, 30, 12, 12), np.uint8).reshape(30, 50, 4)
    assert np.abs(ours - bgra[..., 2::-1] / 255).max() < 1.01 / 255
    assert ((ours - pixels) ** 2).mean() < 0.05**2


def naive_bc1(pixels):
    """BC1 without any search: the block's box corners in 5:6:5 bits and the nearest of four colours."""
    levels = np.array([31, 63, 31], np.float32)
    result = np.empty_like(pixels)
    for y, x in np.ndindex(pixels.shape[0] // 4, pixels.shape[1] // 4):
        window = np.s_[4 * y : 4 * y + 4, 4 * x : 4 * x + 4]
        block = pixels[window]
        low, high = (np.rint(end * levels) / levels for end in (block.min(axis=(0, 1)), block.max(axis=(0, 1))))
        palette = np.array([low + (high - low) * w for w in (0, 1 / 3, 2 / 3, 1)])
        distance = ((block[:, :, None] - palette) ** 2).sum(axis=-1)
        result[window] = palette[distance.argmin(axis=-1)]
    return result


def test_astc_leaves_the_strings_of_the_process_alone(rng):
    """The encoder's swizzle turns its argument into capitals in place, and a literal is one object for all modules."""
    pytest.importorskip("astc_encoder")
    channels = [SimpleNamespace(map="base_color", component=c, encoding="srgb") for c in ("red", "green", "blue")]
    channels += [SimpleNamespace(map="normal", component=c, encoding="normal") for c in ("x", "y")]
    channels += [SimpleNamespace(map="roughness", component="value", encoding="linear")]
    Baseline("astc12", channels, [rng.random((12, 12, 6)).astype(np.float32)], astc_quality=0).level(0)
    for literal, codes in (("rgba", "72676261"), ("rgb1", "72676231"), ("rrrg", "72727267"), ("ra01", "72613031")):
        assert literal.encode().hex() == codes


def test_bc1_beats_blocks_made_without_search(rng):
    pytest.importorskip("quicktex")
    pixels = smooth(rng, 64, 64, 3)
    best = ((Baseline("bc_full", channels_of("base_color"), chain(pixels)).level(0) - pixels) ** 2).mean()
    assert best < 0.8 * ((naive_bc1(pixels) - pixels) ** 2).mean()


@pytest.mark.parametrize("method", GAMES)
def test_every_level_keeps_its_maps(rng, method):
    """Sizes that are no multiple of a block, down to 1×1, and no channel lands in another's place."""
    for package in ("quicktex", "etcpak", "astc_encoder", "texture2ddecoder"):
        pytest.importorskip(package)
    channels = channels_of("roughness", "normal", "base_color", "metallic", "occlusion", "mask")
    pixels = smooth(rng, 44, 52, len(channels)) * 0.25 + np.linspace(0.1, 0.75, len(channels), dtype=np.float32)
    mips = chain(pixels)
    baseline = Baseline(method, channels, mips, astc_quality=60)
    for mip, reference in enumerate(mips):
        level = baseline.level(mip)
        assert level.dtype == np.float32
        assert level.shape == reference.shape
        np.testing.assert_allclose(level.mean(axis=(0, 1)), reference.mean(axis=(0, 1)), atol=0.02)
        assert ((level - reference) ** 2).mean() < 0.04**2


def test_half_resolution_is_the_second_mip_seen_through_a_sampler(rng):
    pytest.importorskip("quicktex")
    channels = channels_of("base_color")
    mips = chain(smooth(rng, 32, 32, 3))
    full, half = (Baseline(m, channels, mips, wrap="clamp") for m in ("bc_full", "bc_half"))
    np.testing.assert_array_equal(half.level(1), full.level(1))
    np.testing.assert_array_equal(half.level(0), upsample(full.level(1), 32, 32, "clamp"))
    assert np.abs(half.level(0) - mips[0]).mean() > np.abs(full.level(0) - mips[0]).mean()


def test_one_texel_set_has_no_half(rng):
    pytest.importorskip("quicktex")
    baseline = Baseline("bc_half", channels_of("base_color"), chain(smooth(rng, 1, 1, 3)))
    assert baseline.bytes == 8
    assert baseline.level(0).shape == (1, 1, 3)


def test_mistakes_are_named(rng):
    with pytest.raises(ValueError, match="method must be one of bc_same, bc_full, bc_half, .*, got 'bc9'"):
        Baseline("bc9", channels_of("base_color"), chain(smooth(rng, 4, 4, 3)))


@pytest.mark.parametrize(
    ("method", "module", "package"),
    [("bc_full", "quicktex", "quicktex"), ("bc7_full", "etcpak", "etcpak"), ("astc12", "astc_encoder", "astc-encoder")],
)
def test_a_missing_encoder_names_the_extra(monkeypatch, rng, method, module, package):
    baselines._bc_coder.cache_clear()
    baselines._astc_context.cache_clear()
    monkeypatch.setitem(sys.modules, module, None)  # importing it now fails
    with pytest.raises(ImportError, match=rf"{package}.* is not installed.*pip install 'warp-neumat\[bench\]'"):
        Baseline(method, channels_of("base_color"), chain(smooth(rng, 4, 4, 3)))


def test_same_is_what_the_material_writes(rng):
    names = [("base_color", c) for c in "rgba"] + [("normal", "x"), ("normal", "y"), ("height", "value")]
    channels = [SimpleNamespace(map=name, component=c, encoding="linear") for name, c in names]
    written = [
        {"name": "base_color", "format": "bc3_srgb", "planes": [
            {"format": "bc1", "channels": [0, 1, 2]}, {"format": "bc4", "channels": [3]}]},
        {"name": "normal", "format": "bc5_unorm", "planes": [
            {"format": "bc4", "channels": [4]}, {"format": "bc4", "channels": [5]}]},
        {"name": "height", "format": "bc4_unorm", "planes": [{"format": "bc4", "channels": [6]}]},
    ]  # fmt: skip
    y, x = np.mgrid[:8, :12] / 12.0
    picture = np.stack([0.5 + 0.3 * np.sin(4 * x + k * y) for k in range(7)], 2).astype(np.float32)
    baseline = Baseline("bc_same", channels, [picture], written=written)
    assert list(baseline.formats.values()) == ["bc1", "bc4", "bc5", "bc4"]
    assert baseline.bytes == 2 * 3 * (8 + 8 + 16 + 8)
    error = np.abs(baseline.level(0) - picture).max(axis=(0, 1))
    assert error[3:].max() < 0.05
    assert error[:3].max() < 0.12
    whole = [{"name": "base_color", "format": "bc7_srgb", "planes": [{"format": "bc7", "channels": [0, 1, 2, 3]}]}]
    again = Baseline("bc_same", channels[:4], [picture[..., :4]], written=whole)
    assert np.abs(again.level(0) - picture[..., :4]).max() < 0.1  # alpha, too
    with pytest.raises(ValueError, match="bc_same is for a material that writes BC textures"):
        Baseline("bc_same", channels, [picture])
