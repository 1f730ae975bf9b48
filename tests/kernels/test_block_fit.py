"""Encoders of BC1, BC4 and BC7: beside quicktex and etcpak on real maps, flat and odd blocks, other decoders, kinds."""

import functools

import numpy as np
import pytest
import warp as wp

from tests.block_oracles import check_cuda
from tests.kernels.test_block_pack import assert_same_everywhere, own_error
from warp_neumat.io.image import read_image, to_uint8
from warp_neumat.kernels.bc1 import bc1_decode
from warp_neumat.kernels.bc4 import bc4_decode
from warp_neumat.kernels.bc7 import bc7_decode
from warp_neumat.kernels.block_fit import (
    bc1_encode,
    bc1_endpoints,
    bc4_encode,
    bc4_endpoints,
    bc7_encode,
    bc7_endpoints,
    make_fit_kernel,
)
from warp_neumat.reference import block_fit as twin

COLOURS = (
    "bishop_black/bishop_black_base_color.jpg",
    "boombox/BoomBox_baseColor.png",
    "brick/brick_normal.jpg",
    "castle_white/castle_white_base_color.jpg",
    "chessboard/chessboard_base_color.jpg",
    "floor_tiles/floor_tiles.jpg",
    "knight_white/knight_white_normal.jpg",
)
GREYS = (
    "brick/brick_dirt_mask.jpg",
    "castle_white/castle_shared_roughness.jpg",
    "chessboard/chessboard_roughness.jpg",
    "floor_tiles/floor_tiles_bumpmap.png",
    "knight_white/knight_white_roughness.jpg",
)
SIZE = 96
LUMA = np.array([[0.25, 0.5, 0.25], [0.5, 0.0, -0.5], [-0.25, 0.5, -0.25]])  # luminance and two chrominances
METRIC = LUMA.T @ np.diag([4.0, 1.0, 1.0]) @ LUMA
ENCODERS = {"bc1": bc1_encode, "bc4": bc4_encode, "bc7": bc7_encode, "bc7_alpha": bc7_encode}
TEXELS = {"bc1": (4, 4, 3), "bc4": (4, 4), "bc7": (4, 4, 3), "bc7_alpha": (4, 4, 4)}


@functools.cache
def crop(path) -> np.ndarray:
    """Return (SIZE, SIZE, 3) bytes of a map; a grey one has three times the same."""
    picture = to_uint8(read_image(path)[0])
    y, x = picture.shape[0] // 3, picture.shape[1] // 3
    picture = picture[y : y + SIZE, x : x + SIZE, :3]
    return np.ascontiguousarray(np.broadcast_to(picture, (SIZE, SIZE, 3)))


def tile(picture) -> np.ndarray:
    """Cut (SIZE, SIZE, k) into blocks (N, 4, 4, k)."""
    count = SIZE // 4
    return picture.reshape(count, 4, count, 4, -1).swapaxes(1, 2).reshape(count * count, 4, 4, -1)


def psnr(decoded, bytes_) -> float:
    mse = np.mean((decoded.astype(np.float64) - bytes_) ** 2)
    return 10 * np.log10(255**2 / max(mse, 1e-9))


def rgba(picture) -> np.ndarray:
    return np.concatenate([picture, np.full((SIZE, SIZE, 1), 255, np.uint8)], axis=2)


def blocks_of(name: str, rng, count: int = 1500) -> np.ndarray:
    """Return pixels of every kind: lines with noise, chaos, flat, two colours, extremes, NaN and what lies outside."""
    shape = TEXELS[name]
    k = shape[2] if len(shape) == 3 else 1
    a, b = rng.random((2, count, 1, k))
    line = a + (b - a) * rng.random((count, 16, 1)) + rng.normal(0, 0.02, (count, 16, k))
    chaos = rng.random((count, 16, k))
    flat = np.repeat(rng.random((count, 1, k)), 16, 1)
    close = flat + rng.normal(0, 0.004, (count, 16, k))
    two = np.where(rng.random((count, 16, 1)) < 0.5, a, b)
    extreme = rng.integers(0, 2, (count, 16, k)).astype(float)
    outside = rng.normal(0.5, 2, (count, 16, k))
    holes = np.where(rng.random((count, 16, k)) < 0.1, np.nan, line)
    same = [np.zeros((1, 16, k)), np.ones((1, 16, k)), np.full((1, 16, k), np.nan), np.full((1, 16, k), np.inf)]
    all_ = np.concatenate([line, chaos, flat, close, two, extreme, outside, holes, *same])
    return all_.reshape(-1, *shape).astype(np.float32)


# ------------------------------------------------------------------------------------------------------------ quality


@pytest.mark.parametrize("path", COLOURS)
def test_bc1_beside_quicktex_and_etcpak(data, path):
    quicktex = pytest.importorskip("quicktex")
    etcpak = pytest.importorskip("etcpak")
    from quicktex.s3tc.bc1 import BC1Encoder

    picture = crop(data / "textures" / path)
    pixels = tile(picture)

    def quality(blocks):
        blocks = np.frombuffer(bytes(blocks), np.uint8).reshape(-1, 8)
        return psnr(bc1_decode(blocks)[..., :3], pixels)

    raw = quicktex.RawTexture.frombytes(rgba(picture).tobytes(), SIZE, SIZE)
    four = quality(BC1Encoder(18, BC1Encoder.ColorMode.FourColor).encode(raw).tobytes())
    three = quality(BC1Encoder(18, BC1Encoder.ColorMode.ThreeColor).encode(raw).tobytes())
    fast = max(
        quality(etcpak.compress_bc1(x.tobytes(), SIZE, SIZE)) for x in (rgba(picture), rgba(picture)[..., [2, 1, 0, 3]])
    )
    ours = quality(bc1_encode((pixels / 255).astype(np.float32)).tobytes())
    assert ours >= max(four, three) - 0.02  # worst: 0.005 above
    assert ours >= fast


@pytest.mark.parametrize("path", GREYS)
def test_bc4_beside_quicktex_and_etcpak(data, path):
    quicktex = pytest.importorskip("quicktex")
    etcpak = pytest.importorskip("etcpak")
    from quicktex.s3tc.bc4 import BC4Encoder

    picture = crop(data / "textures" / path)
    pixels = tile(picture)[..., 0]

    def quality(blocks):
        return psnr(bc4_decode(np.frombuffer(bytes(blocks), np.uint8).reshape(-1, 8)), pixels)

    raw = quicktex.RawTexture.frombytes(rgba(picture).tobytes(), SIZE, SIZE)
    others = [BC4Encoder(0).encode(raw).tobytes(), etcpak.compress_bc4(rgba(picture).tobytes(), SIZE, SIZE)]
    ours = quality(bc4_encode((pixels / 255).astype(np.float32)).tobytes())
    assert ours >= max(quality(x) for x in others) + 1  # worst: 1.5 above


@pytest.mark.parametrize("path", COLOURS)
def test_bc7_beside_etcpaks_mode_6(data, path):
    etcpak = pytest.importorskip("etcpak")
    picture = crop(data / "textures" / path)
    pixels = tile(picture)
    parameters = etcpak.BC7CompressBlockParams()
    parameters.init_linear_weights()
    parameters.m_uber_level, parameters.m_mode_mask = 4, 1 << 6
    other = np.frombuffer(etcpak.compress_bc7(rgba(picture).tobytes(), SIZE, SIZE, parameters), np.uint8)
    blocks = bc7_encode((pixels / 255).astype(np.float32))
    ours = psnr(bc7_decode(blocks)[..., :3], pixels)
    theirs = psnr(bc7_decode(other.reshape(-1, 16))[..., :3], pixels)
    assert ours >= theirs - 0.15  # worst: 0.09 below


def test_flat_blocks_are_the_best_there_are(rng):
    # The nearest third of a code in each channel, by trying every pair.
    colours = np.concatenate([np.repeat(np.arange(256)[:, None] / 255, 3, 1), rng.random((2000, 3))])
    best = np.zeros(len(colours))
    for c, most in enumerate((31, 63, 31)):
        a, b = np.meshgrid(np.arange(most + 1), np.arange(most + 1))
        entries = np.unique(2 * a + b) / (3 * most)
        best += 16 * np.abs(colours[:, c, None] - entries).min(1) ** 2
    pixels = np.broadcast_to(colours[:, None, None], (len(colours), 4, 4, 3)).astype(np.float32)
    error = own_error("bc1", bc1_encode(pixels), pixels.reshape(-1, 16, 3), None)
    np.testing.assert_allclose(error, best, rtol=1e-3, atol=1e-7)


@pytest.mark.parametrize("name", ["bc1", "bc7"])
def test_metric_is_what_is_lessened(rng, name):
    pixels = blocks_of(name, rng)[:3000]
    colours = pixels.reshape(-1, 16, 3)
    plain, measured = ENCODERS[name](pixels), ENCODERS[name](pixels, metric=METRIC)
    for metric, better, worse in ((None, plain, measured), (METRIC, measured, plain)):
        a, b = (own_error(name, blocks, colours, metric).mean() for blocks in (better, worse))
        assert a < 0.99 * b
    brightness = np.outer([0.299, 0.587, 0.114], [0.299, 0.587, 0.114])  # two of its three eigenvalues are 0
    assert_same_everywhere(name, ENCODERS[name](pixels, metric=brightness))


def test_bc4_endpoints_cannot_be_stepped(rng):
    # No pair of endpoints within two steps of those found is better by much.
    values = np.clip(rng.random((300, 1)) + rng.normal(0, 0.08, (300, 16)), 0, 1)
    blocks = bc4_encode(values.reshape(-1, 4, 4).astype(np.float32))
    error = own_error("bc4", blocks, values[..., None], None)
    ends = blocks[:, :2].astype(int)
    best = error.copy()
    for da in range(-2, 3):
        for db in range(-2, 3):
            tried = np.clip(ends + [da, db], 0, 255) / 255
            best = np.minimum(best, twin.bc4_pack(tried, values)[1])
    assert error.mean() < 1.02 * best.mean()


# ---------------------------------------------------------------------------------------------------- blocks and lanes


@pytest.mark.parametrize("name", ENCODERS)
def test_blocks_decode_the_same_everywhere(rng, name):
    assert_same_everywhere(name, ENCODERS[name](blocks_of(name, rng)))


def test_opaque_blocks_stay_opaque(rng):
    pixels = blocks_of("bc7_alpha", rng)
    pixels[..., 3] = 1
    blocks = bc7_encode(pixels)
    assert (bc7_decode(blocks)[..., 3] == 255).all()
    error = own_error("bc7_alpha", blocks, pixels.reshape(-1, 16, 4), None)
    three = np.ascontiguousarray(pixels[..., :3])
    alone = own_error("bc7", bc7_encode(three), three.reshape(-1, 16, 3), None)
    np.testing.assert_allclose(error.mean(), alone.mean(), rtol=1e-3)
    pixels[..., 3] = rng.uniform(0.9982, 1, pixels.shape[:3])  # nearer to 255 than to 254 throughout
    assert (bc7_decode(bc7_encode(pixels))[..., 3] == 255).all()


@pytest.mark.parametrize("name", ENCODERS)
def test_a_block_does_not_depend_on_its_neighbours(rng, name):
    pixels = blocks_of(name, rng, 40)[::9]
    together = ENCODERS[name](pixels)
    alone = np.concatenate([ENCODERS[name](one[None]) for one in pixels])
    np.testing.assert_array_equal(together, alone)


# ----------------------------------------------------------------------------------------------------------- endpoints


def test_endpoints_give_the_same_blocks(rng):
    light = np.array([0.299, 0.587, 0.114])
    for name, read, k in (
        ("bc1", bc1_endpoints, 3),
        ("bc7", lambda b: bc7_endpoints(b, 3), 3),
        ("bc7_alpha", bc7_endpoints, 4),
    ):
        blocks = ENCODERS[name](blocks_of(name, rng, 200))
        ends = read(blocks)
        assert ends.dtype == np.float32
        assert ends.shape == (len(blocks), 2 * k)
        assert (ends[:, :3] @ light >= ends[:, k : k + 3] @ light - 1e-6).all()
        decode = bc1_decode if name == "bc1" else bc7_decode
        decoded = decode(blocks).reshape(-1, 16, 4)
        repack = twin.bc1_pack if name == "bc1" else twin.bc7_pack
        again, _ = repack(ends.reshape(-1, 2, k), decoded[..., :k] / 255)
        np.testing.assert_array_equal(decode(again).reshape(-1, 16, 4), decoded)
    blocks = bc4_encode(blocks_of("bc4", rng, 200))
    ends = bc4_endpoints(blocks)
    assert (ends[:, 0] >= ends[:, 1]).all()
    again, error = twin.bc4_pack(ends, bc4_decode(blocks).reshape(-1, 16) / 255)
    assert error.max() < 1e-12
    np.testing.assert_array_equal(bc4_decode(again), bc4_decode(blocks))


def test_endpoints_of_known_blocks():
    red_blue = np.array([[0x00, 0xF8, 0x1F, 0x00, 0, 0, 0, 0], [0x1F, 0x00, 0x00, 0xF8, 0, 0, 0, 0]], np.uint8)
    np.testing.assert_array_equal(bc1_endpoints(red_blue), [[1, 0, 0, 0, 0, 1]] * 2)
    ramps = np.array([[255, 51, 0, 0, 0, 0, 0, 0], [51, 255, 0, 0, 0, 0, 0, 0]], np.uint8)
    np.testing.assert_allclose(bc4_endpoints(ramps), [[1, 0.2]] * 2, rtol=1e-6)


# ---------------------------------------------------------------------------------------------------- kinds and errors


@pytest.mark.parametrize("name", ENCODERS)
def test_kinds(rng, name):
    torch = pytest.importorskip("torch")
    encode = ENCODERS[name]
    pixels = blocks_of(name, rng, 30)
    want = encode(pixels)
    assert isinstance(want, np.ndarray)
    assert want.dtype == np.uint8
    from_torch = encode(torch.from_numpy(pixels))
    assert isinstance(from_torch, torch.Tensor)
    np.testing.assert_array_equal(from_torch.numpy(), want)
    from_warp = encode(wp.array(pixels, dtype=wp.float32, device="cpu"))
    assert isinstance(from_warp, wp.array)
    np.testing.assert_array_equal(from_warp.numpy(), want)
    np.testing.assert_array_equal(encode(pixels[::2]), want[::2])
    np.testing.assert_array_equal(encode(pixels.astype(np.float64)), want)
    assert encode(pixels[:0]).shape == (0, want.shape[1])
    out = wp.empty(want.shape, dtype=wp.uint8, device="cpu")
    assert encode(pixels, out=out) is out
    np.testing.assert_array_equal(out.numpy(), want)
    with pytest.raises(
        ValueError, match=r"out must be uint8 of shape \(\d+, \d+\) on cpu, got uint8 of shape \(3, 8\)"
    ):
        encode(pixels, out=wp.empty((3, 8), dtype=wp.uint8, device="cpu"))
    with pytest.raises(TypeError, match=r"pixels must be floats in \[0, 1\], got uint8; divide bytes by 255"):
        encode(np.zeros(pixels.shape, np.uint8))
    with pytest.raises(ValueError, match=r"pixels must have shape \[N, 4, 4.*, got \(2, 3\)"):
        encode(np.zeros((2, 3), np.float32))


def test_refusals():
    pixels = np.zeros((1, 4, 4, 3), np.float32)
    with pytest.raises(
        ValueError, match=r"metric must be a symmetric matrix of 3 x 3 finite numbers, got shape \(4, 4\)"
    ):
        bc1_encode(pixels, metric=np.eye(4))
    with pytest.raises(ValueError, match="metric must be a symmetric matrix"):
        bc1_encode(pixels, metric=np.triu(np.ones((3, 3))))
    with pytest.raises(ValueError, match="metric must have no negative and some positive eigenvalue"):
        bc7_encode(pixels, metric=np.diag([1.0, 1.0, -1.0]))
    for read, size in ((bc1_endpoints, 8), (bc4_endpoints, 8), (bc7_endpoints, 16)):
        with pytest.raises(TypeError, match="blocks must be uint8, got float64; view it as bytes"):
            read(np.zeros((2, size)))
        with pytest.raises(ValueError, match=rf"blocks must have shape \[N, {size}\], got \(2, 5\)"):
            read(np.zeros((2, 5), np.uint8))
    with pytest.raises(ValueError, match="block 1 is not of mode 6"):
        bc7_endpoints(np.array([[64] + 15 * [0], [1] + 15 * [0]], np.uint8))
    with pytest.raises(ValueError, match="channels must be 3 or 4, got 2"):
        bc7_endpoints(np.zeros((0, 16), np.uint8), 2)


@pytest.mark.parametrize("name", ENCODERS)
def test_kernel_compiles_for_cuda(name, tmp_path):
    check_cuda(make_fit_kernel(1, name), tmp_path)


def test_two_colours_are_the_endpoints(rng):
    """Their best real endpoints lie anywhere on the line, also out of the gamut; the nearest codes do not."""
    codes = np.array([31, 63, 31], np.float32)
    pairs = np.rint(rng.random((500, 2, 3)).astype(np.float32) * codes) / codes
    which = rng.integers(0, 2, (500, 16))
    pixels = pairs[np.arange(500)[:, None], which].reshape(-1, 4, 4, 3)
    decoded = bc1_decode(bc1_encode(pixels))[..., :3] / np.float32(255)
    assert np.abs(decoded - pixels).max() < 0.51 / 255
