"""Names, sizes and shapes of block-compressed textures."""

import numpy as np
import pytest

from warp_neumat.io.block_formats import (
    FORMATS,
    BlockTexture,
    from_blocks,
    grid,
    mip_limit,
    mip_shape,
    mip_size,
    to_blocks,
)


def test_numbers_are_those_of_dxgi_and_vulkan():
    # From dxgiformat.h and vulkan_core.h.
    assert {name: (f.block_bytes, f.dxgi, f.vk) for name, f in FORMATS.items()} == {
        "bc1_unorm": (8, 71, 133),
        "bc1_srgb": (8, 72, 134),
        "bc3_unorm": (16, 77, 137),
        "bc3_srgb": (16, 78, 138),
        "bc4_unorm": (8, 80, 139),
        "bc4_snorm": (8, 81, 140),
        "bc5_unorm": (16, 83, 141),
        "bc5_snorm": (16, 84, 142),
        "bc6h_uf16": (16, 95, 143),
        "bc6h_sf16": (16, 96, 144),
        "bc7_unorm": (16, 98, 145),
        "bc7_srgb": (16, 99, 146),
    }
    assert [f.name for f in FORMATS.values() if f.signed] == ["bc4_snorm", "bc5_snorm", "bc6h_sf16"]
    assert [f.family for f in FORMATS.values() if f.srgb] == ["bc1", "bc3", "bc7"]


def test_sizes_of_mips():
    assert [mip_size(409, 204, m) for m in range(mip_limit(409, 204))] == [
        (409, 204), (204, 102), (102, 51), (51, 25), (25, 12), (12, 6), (6, 3), (3, 1), (1, 1),
    ]  # fmt: skip
    assert mip_limit(256, 1) == 9
    assert grid(409, 204) == (51, 103)
    assert mip_shape("bc1_unorm", 409, 204, 7) == (1, 1, 8)


@pytest.mark.parametrize("size", [(8, 4), (5, 7), (1, 1), (3, 9)])
@pytest.mark.parametrize("rest", [(), (3,)])
def test_blocks_and_back(rng, size, rest):
    width, height = size
    picture = rng.normal(size=(height, width, *rest)).astype(np.float16)
    blocks = to_blocks(picture)
    assert blocks.shape == (*grid(width, height), 4, 4, *rest)
    np.testing.assert_array_equal(from_blocks(blocks, width, height), picture)
    np.testing.assert_array_equal(from_blocks(blocks.reshape(-1, 4, 4, *rest), width, height), picture)
    # Padding repeats the edge, and texel (y, x) lies in block (y // 4, x // 4).
    y, x = height - 1, width - 1
    np.testing.assert_array_equal(blocks[y // 4, x // 4, y % 4, x % 4], picture[y, x])
    np.testing.assert_array_equal(blocks[-1, -1, -1, -1], picture[-1, -1])


def test_what_is_no_picture_is_refused():
    with pytest.raises(ValueError, match=r"picture must have shape \(H, W\) or \(H, W, C\) .* got \(0, 4\)"):
        to_blocks(np.zeros((0, 4)))
    with pytest.raises(ValueError, match=r"texels must have shape \(4, 4, 4, …\) or \(2, 2, 4, 4, …\) for 5x5, got"):
        from_blocks(np.zeros((3, 4, 4, 3)), 5, 5)


def _blocks(*shape):
    return np.zeros(shape, np.uint8)


@pytest.mark.parametrize(
    ("error", "message", "arguments"),
    [
        (ValueError, "format must be one of bc1_unorm, .*, got 'dxt1'", ("dxt1", 4, 4, [[_blocks(1, 1, 8)]])),
        (ValueError, "width and height must be at least 1, got 0 and 4", ("bc1_unorm", 0, 4, [[_blocks(1, 1, 8)]])),
        (ValueError, "at least one layer of 1 to 3 mips for 4x4", ("bc1_unorm", 4, 4, [])),
        (ValueError, "at least one layer of 1 to 3 mips for 4x4", ("bc1_unorm", 4, 4, [[_blocks(1, 1, 8)] * 4])),
        (
            ValueError,
            r"levels\[1\] must have 1 mips like layer 0, got 2",
            ("bc1_unorm", 4, 4, [[_blocks(1, 1, 8)], [_blocks(1, 1, 8)] * 2]),
        ),
        (
            ValueError,
            r"levels\[0\]\[0\] must have shape \(2, 1, 8\), got \(1, 1, 8\)",
            ("bc1_unorm", 4, 5, [[_blocks(1, 1, 8)]]),
        ),
        (
            TypeError,
            r"levels\[0\]\[0\] must be a numpy array of uint8, got float64",
            ("bc1_unorm", 4, 4, [[np.zeros((1, 1, 8))]]),
        ),
    ],
)
def test_impossible_textures_are_refused(error, message, arguments):
    with pytest.raises(error, match=message):
        BlockTexture(*arguments)


def test_a_texture_knows_its_size():
    texture = BlockTexture("bc5_unorm", 9, 5, [[_blocks(2, 3, 16), _blocks(1, 1, 16)]] * 2)
    assert (texture.layers, texture.mips, texture.nbytes) == (2, 2, 2 * 7 * 16)
    assert [texture.size(m) for m in range(2)] == [(9, 5), (4, 2)]
