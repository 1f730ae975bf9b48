"""BC7: bit for bit as bcdec and texture2ddecoder in every mode."""

import numpy as np
import pytest

from tests.block_oracles import bcdec, check_cuda, check_kinds, falcor, texture2d
from warp_neumat.io.block_formats import from_blocks
from warp_neumat.kernels import bc7, bc7_tables


def _blocks(rng, mode: int, count: int) -> np.ndarray:
    """Return random blocks of one mode."""
    blocks = rng.integers(0, 256, (count, 16), dtype=np.uint8)
    blocks[:, 0] = (blocks[:, 0] << np.uint8(mode + 1 & 7) if mode < 7 else 0) | 1 << mode
    return blocks


@pytest.mark.parametrize("count", [25_000, pytest.param(1_250_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("mode", range(8))
def test_bc7_decode_matches_bcdec(rng, mode, count):
    blocks = _blocks(rng, mode, count)
    texels = bc7.bc7_decode(blocks)
    np.testing.assert_array_equal(texels, bcdec("bc7", blocks))
    np.testing.assert_array_equal(texels, texture2d("bc7", blocks))


def test_mixed_modes_match_bcdec(rng):
    blocks = np.concatenate([_blocks(rng, mode, 500) for mode in range(8)])
    rng.shuffle(blocks)
    np.testing.assert_array_equal(bc7.bc7_decode(blocks), bcdec("bc7", blocks))


@pytest.mark.parametrize("mode", [0, 1, 2, 3, 7])
def test_every_partition_matches_bcdec(rng, mode):
    bits = bc7_tables.MODES[mode].partition
    blocks = _blocks(rng, mode, 4 << bits).reshape(-1, 4, 16)
    words = blocks.view("<u8")
    cleared = words[..., 0] & ~np.uint64((1 << bits) - 1 << mode + 1)
    words[..., 0] = cleared | np.arange(1 << bits, dtype=np.uint64)[:, None] << np.uint64(mode + 1)
    blocks = blocks.reshape(-1, 16)
    np.testing.assert_array_equal(bc7.bc7_decode(blocks), bcdec("bc7", blocks))


def test_reserved_blocks_are_zero(rng):
    blocks = rng.integers(0, 256, (1000, 16), dtype=np.uint8)
    blocks[:, 0] = 0
    assert not bc7.bc7_decode(blocks).any()


def test_falcor_reference(data):
    texture, want = falcor(data, "BC7Unorm")
    picture = from_blocks(bc7.bc7_decode(texture.levels[0][0].reshape(-1, 16)), *texture.size())
    np.testing.assert_array_equal(picture, want)


def test_tables_are_whole():
    assert [mode.number for mode in bc7_tables.MODES] == list(range(8))
    assert {mode.bits for mode in bc7_tables.MODES} == {128}
    for bits, weights in bc7_tables.WEIGHTS.items():
        steps = 2**bits - 1
        assert list(weights) == [int(np.floor(64 * i / steps + 0.5)) for i in range(steps + 1)]
    assert len(bc7_tables.PARTITIONS_2) == len(bc7_tables.PARTITIONS_3) == 64
    for mask, anchor in zip(bc7_tables.PARTITIONS_2, bc7_tables.ANCHORS_2, strict=True):
        assert not mask & 1
        assert mask >> anchor & 1
    for (one, two), (a, b) in zip(bc7_tables.PARTITIONS_3, bc7_tables.ANCHORS_3, strict=True):
        assert not (one | two) & 1
        assert not one & two
        assert one >> a & 1
        assert two >> b & 1


def test_kinds_and_refusals(rng):
    check_kinds(bc7.bc7_decode, rng.integers(0, 256, (700, 16), dtype=np.uint8), (4, 4, 4))


def test_kernel_compiles_for_cuda(tmp_path):
    check_cuda(bc7.make_bc7_kernel(1), tmp_path)
