"""The level table, and that bad sizes are named; the sampling itself is tested in test_bcf."""

import numpy as np
import pytest

from warp_neumat.kernels.filter import RECORD, level_table


def test_level_table_numbers_blocks_mip_after_mip():
    table, after = level_table([(10, 6), (4, 4)], [-1.5, 0.0], [4, 1], first=100)
    record = table.reshape(-1, RECORD)
    assert record[0, :3].tolist() == [10, 6, 4]
    assert record[0, 3:4].view(np.float32)[0] == -1.5
    # 10x6 is 3 · 2 blocks, 5x3 is 2 · 1, 2x1 and 1x1 are one each.
    assert record[0, 4:8].tolist() == [100, 106, 108, 109]
    assert record[1, 4] == 110
    assert after == 111


def test_level_table_names_too_many_texels():
    with pytest.raises(ValueError, match=r"fewer than 2\^25 blocks of 4 x 4 texels, got 33554432"):
        level_table([(1 << 14, 1 << 15)], [0.0], [1])
