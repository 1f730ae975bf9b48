"""BC4 and BC5: bit for bit as bcdec and texture2ddecoder, and as the real numbers say."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.block_oracles import bcdec, check_cuda, check_kinds, falcor, texture2d
from warp_neumat.io.block_formats import from_blocks
from warp_neumat.kernels import bc4
from warp_neumat.reference.block_colors import bc4_reals

ROUNDS = [1, pytest.param(50, marks=pytest.mark.slow)]  # of 200 000 blocks
ROOT = Path(__file__).resolve().parents[2]


def _every_ramp() -> np.ndarray:
    """Return a block for each pair of endpoints, with every index twice."""
    blocks = np.empty((65536, 8), np.uint8)
    pairs = np.arange(65536)
    blocks[:, 0], blocks[:, 1] = pairs >> 8, pairs & 255
    stream = sum((t % 8) << 3 * t for t in range(16))
    blocks[:, 2:] = np.frombuffer(stream.to_bytes(6, "little"), np.uint8)
    return blocks


@pytest.mark.parametrize("rounds", ROUNDS)
def test_bc4_decode_matches_bcdec(rng, rounds):
    for _ in range(rounds):
        blocks = rng.integers(0, 256, (200_000, 8), dtype=np.uint8)
        values = bc4.bc4_decode(blocks)
        np.testing.assert_array_equal(values, bcdec("bc4", blocks)[..., 0])
        np.testing.assert_array_equal(values, texture2d("bc4", blocks)[..., 0])


@pytest.mark.parametrize("rounds", ROUNDS)
def test_bc5_decode_matches_bcdec(rng, rounds):
    for _ in range(rounds):
        blocks = rng.integers(0, 256, (200_000, 16), dtype=np.uint8)
        values = bc4.bc5_decode(blocks)
        np.testing.assert_array_equal(values, bcdec("bc5", blocks))
        np.testing.assert_array_equal(values, texture2d("bc5", blocks)[..., :2])


@pytest.mark.parametrize("signed", [False, True])
def test_bc4_drops_less_than_one_step(signed):
    # Every pair of endpoints with every index: the byte is the real number without its fraction.
    blocks = _every_ramp()
    values, reals = bc4.bc4_decode(blocks, signed), bc4_reals(blocks, signed)
    assert values.dtype == (np.int8 if signed else np.uint8)
    np.testing.assert_array_equal(values, np.trunc(reals))
    assert np.abs(values - reals).max() == pytest.approx(6 / 7)


def test_bc4_unsigned_of_every_ramp_matches_bcdec():
    blocks = _every_ramp()
    np.testing.assert_array_equal(bc4.bc4_decode(blocks), bcdec("bc4", blocks)[..., 0])


def test_bc4_signed_least_is_minus_127():
    blocks = np.array([[0x7F, 0x80, 0, 0, 0, 0, 0, 0], [0x80, 0x7F, 0, 0, 0, 0, 0, 0]], np.uint8)
    blocks[:, 2] = 0b001_000
    values = bc4.bc4_decode(blocks, True).reshape(2, 16)
    assert values[0, :2].tolist() == [127, -127]
    assert values[1, :2].tolist() == [-127, 127]
    assert bc4.bc4_decode(_every_ramp(), True).min() == -127


def test_bc4_signed_matches_a_texture_unit(tmp_path):
    # No decoder on PyPI reads BC4_SNORM. A Vulkan device does: Mesa's software one approximates the divisions by 7 and
    # 5, and was seen up to 1.8 steps from the reals; a GPU's is nearer. Pairs of -127 and -128 are left out: whether
    # they differ is up to the decoder.
    blocks = _every_ramp()
    np.save(tmp_path / "in.npy", blocks.reshape(256, 256, 8))
    command = [sys.executable, "-m", "tests.kernels.bc4_on_vulkan", str(tmp_path / "in.npy"), str(tmp_path / "out.npy")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=120)
    if done.returncode == 77:
        pytest.skip(done.stdout.strip())
    assert done.returncode == 0, done.stderr
    want = np.load(tmp_path / "out.npy") * 127
    values = from_blocks(bc4.bc4_decode(blocks, True), 1024, 1024)
    ends = blocks[:, :2].view(np.int8)
    alike = from_blocks(np.broadcast_to((ends < -126).all(1)[:, None, None], (65536, 4, 4)), 1024, 1024)
    assert np.abs(values - want)[~alike].max() < 2.5


def test_bc5_signed_is_two_bc4(rng):
    blocks = rng.integers(0, 256, (1000, 16), dtype=np.uint8)
    values = bc4.bc5_decode(blocks, True)
    assert values.dtype == np.int8
    np.testing.assert_array_equal(values[..., 0], bc4.bc4_decode(blocks[:, :8], True))
    np.testing.assert_array_equal(values[..., 1], bc4.bc4_decode(blocks[:, 8:], True))


@pytest.mark.parametrize(
    ("name", "decode", "channels"), [("BC4Unorm", bc4.bc4_decode, 1), ("BC5Unorm", bc4.bc5_decode, 2)]
)
def test_falcor_reference(data, name, decode, channels):
    # A GPU made the references: it interpolates with its own rounding and differs by up to 2 on a fifth of the texels.
    texture, want = falcor(data, name)
    blocks = texture.levels[0][0]
    picture = from_blocks(decode(blocks.reshape(-1, blocks.shape[-1])), *texture.size()).reshape(256, 256, channels)
    difference = np.abs(picture.astype(int) - want[..., :channels])
    assert difference.max() <= 2
    assert difference.mean() < 0.25


def test_kinds_and_refusals(rng):
    check_kinds(bc4.bc4_decode, rng.integers(0, 256, (700, 8), dtype=np.uint8), (4, 4))
    check_kinds(bc4.bc5_decode, rng.integers(0, 256, (700, 16), dtype=np.uint8), (4, 4, 2))


@pytest.mark.parametrize("which", [0, 1], ids=["bc4", "bc5"])
def test_kernel_compiles_for_cuda(which, tmp_path):
    check_cuda(bc4.make_kernels(1)[which], tmp_path)
