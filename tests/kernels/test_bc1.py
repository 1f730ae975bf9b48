"""BC1 and BC3: bit for bit as bcdec, the reals rounded to the nearest byte."""

import numpy as np
import pytest

from tests.block_oracles import bcdec, check_cuda, check_kinds, falcor, texture2d
from warp_neumat.io.block_formats import from_blocks
from warp_neumat.io.dds import read_dds
from warp_neumat.kernels import bc1
from warp_neumat.kernels.bc4 import bc4_decode
from warp_neumat.reference.block_colors import bc1_reals

ROUNDS = [1, pytest.param(50, marks=pytest.mark.slow)]  # of 200 000 blocks


@pytest.mark.parametrize("rounds", ROUNDS)
def test_bc1_decode_matches_bcdec(rng, rounds):
    for _ in range(rounds):
        blocks = rng.integers(0, 256, (200_000, 8), dtype=np.uint8)
        texels = bc1.bc1_decode(blocks)
        np.testing.assert_array_equal(texels, bcdec("bc1", blocks))
        # texture2ddecoder widens endpoints to bytes before it interpolates, truncates, and knows no transparency.
        other = texture2d("bc1", blocks)
        assert np.abs(texels[..., :3].astype(np.int16) - other[..., :3]).max() == 1
        assert (other[..., 3] == 255).all()


@pytest.mark.parametrize("rounds", ROUNDS)
def test_bc3_decode_matches_bcdec(rng, rounds):
    for _ in range(rounds):
        blocks = rng.integers(0, 256, (200_000, 16), dtype=np.uint8)
        texels = bc1.bc3_decode(blocks)
        np.testing.assert_array_equal(texels, bcdec("bc3", blocks))
        other = texture2d("bc3", blocks)
        np.testing.assert_array_equal(texels[..., 3], other[..., 3])
        ends = blocks[:, 8:12].view("<u2")
        four = ends[:, 0] > ends[:, 1]  # where they are not, it takes the block for a three-colour one
        assert np.abs(texels[four][..., :3].astype(np.int16) - other[four][..., :3]).max() == 1


def test_bc1_rounds_to_the_nearest(rng):
    # Every pair of 5-bit endpoints in red and blue and of 6-bit ones in green, in both orders, with every index.
    pairs = np.arange(4096)
    a, b = pairs >> 6, pairs & 63
    blocks = np.empty((4096, 2), "<u4")
    blocks[:, 0] = ((a & 31) << 11 | a << 5 | (b & 31)) | ((b & 31) << 11 | b << 5 | (a & 31)) << 16
    blocks[:, 1] = 0xE4E4E4E4
    blocks = blocks.view(np.uint8)
    ends = blocks[:, :4].view("<u2")
    assert (ends[:, 0] > ends[:, 1]).any()
    assert (ends[:, 0] < ends[:, 1]).any()
    np.testing.assert_array_equal(bc1.bc1_decode(blocks), np.floor(bc1_reals(blocks) + 0.5))


def test_bc1_punch_through():
    # c0 = c1 is a three-colour block too.
    blocks = np.array([[0x00, 0xF8, 0x00, 0xF8, 0xE4, 0, 0, 0], [0x00, 0xF8, 0x1F, 0x00, 0xE4, 0, 0, 0]], np.uint8)
    first, second = bc1.bc1_decode(blocks)[:, 0]
    assert first.tolist() == [[255, 0, 0, 255], [255, 0, 0, 255], [255, 0, 0, 255], [0, 0, 0, 0]]
    assert second.tolist() == [[255, 0, 0, 255], [0, 0, 255, 255], [170, 0, 85, 255], [85, 0, 170, 255]]


def test_bc3_has_always_four_colours():
    block = np.zeros((1, 16), np.uint8)
    block[0, 0] = 200
    block[0, 8:] = [0x1F, 0x00, 0x00, 0xF8, 0xE4, 0, 0, 0]
    assert bc1.bc3_decode(block)[0, 0].tolist() == [
        [0, 0, 255, 200],
        [255, 0, 0, 200],
        [85, 0, 170, 200],
        [170, 0, 85, 200],
    ]


def test_bc3_alpha_is_bc4(rng):
    blocks = rng.integers(0, 256, (1000, 16), dtype=np.uint8)
    np.testing.assert_array_equal(bc1.bc3_decode(blocks)[..., 3], bc4_decode(blocks[:, :8]))


def test_kodim23_matches_bcdec(data):
    texture = read_dds(data / "bc" / "kodim23_bc1.dds")
    blocks = texture.levels[0][0].reshape(-1, 8)
    np.testing.assert_array_equal(bc1.bc1_decode(blocks), bcdec("bc1", blocks))


def test_falcor_reference(data):
    # A GPU made the reference: its green differs by up to 3 from the reals, as Direct3D allows.
    texture, want = falcor(data, "BC1Unorm")
    picture = from_blocks(bc1.bc1_decode(texture.levels[0][0].reshape(-1, 8)), *texture.size())
    difference = np.abs(picture[..., :3].astype(int) - want[..., :3])
    assert difference.max(axis=(0, 1)).tolist() == [1, 3, 1]
    assert (picture[..., 3] == 255).all()


def test_kinds_and_refusals(rng):
    check_kinds(bc1.bc1_decode, rng.integers(0, 256, (700, 8), dtype=np.uint8), (4, 4, 4))
    check_kinds(bc1.bc3_decode, rng.integers(0, 256, (700, 16), dtype=np.uint8), (4, 4, 4))


@pytest.mark.parametrize("which", [0, 1], ids=["bc1", "bc3"])
def test_kernel_compiles_for_cuda(which, tmp_path):
    check_cuda(bc1.make_kernels(1)[which], tmp_path)
