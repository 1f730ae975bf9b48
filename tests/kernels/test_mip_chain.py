"""Mip levels in Warp against the same chain in numpy."""

import types

import numpy as np
import pytest
import warp as wp

from tests.fake_assets import CHANNELS
from warp_neumat.io.block_formats import to_blocks
from warp_neumat.io.mipmaps import mip_chain
from warp_neumat.kernels import mip_chain as kernels
from warp_neumat.kernels.dispatch import module_options


@wp.kernel(module="unique", module_options=module_options())
def _srgb_kernel(linear: wp.array(dtype=wp.float32), encoded: wp.array(dtype=wp.float32)):
    i = wp.tid()
    encoded[i] = kernels.linear_to_srgb(linear[i])


def test_srgb_matches_float64():
    x = np.concatenate([np.linspace(0, 1, 100_001), np.linspace(0, 0.01, 10_001)]).astype(np.float32)
    got = wp.zeros(len(x), dtype=wp.float32, device="cpu")
    wp.launch(_srgb_kernel, len(x), inputs=[wp.array(x, device="cpu")], outputs=[got], device="cpu")
    v = x.astype(np.float64)
    expected = np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)
    assert np.abs(got.numpy() - expected).max() < 1e-6


@pytest.mark.parametrize("size", [(64, 64), (37, 21), (1, 9), (130, 4), (1, 1)])
def test_levels_match_mip_chain(rng, size, device):
    width, height = size
    pixels = rng.random((height, width, 7)).astype(np.float32)
    pixels[..., 3:5] = 0.5 + 0.6 * (pixels[..., 3:5] - 0.5)
    blocks = to_blocks(pixels).reshape(-1, 16, 7)
    # Two sources, and in one of them the normal's components the other way round.
    orders = ((4, 2, 3, 0, 1), (6, 5))
    sources = {}
    for order in orders:
        array = wp.array(np.ascontiguousarray(blocks[..., order].swapaxes(1, 2)).ravel(), device=device)
        sources |= {k: (array, len(order), row) for row, k in enumerate(order)}
    got, counts = kernels.mip_blocks(CHANNELS[:7], [sources[k] for k in range(7)], width, height, device)
    levels = mip_chain(pixels, [types.SimpleNamespace(**channel) for channel in CHANNELS[:7]])[1:]
    assert len(counts) == len(levels)
    begin, texels = 0, got.numpy()
    for level, count in zip(levels, counts, strict=True):
        expected = to_blocks(level).reshape(-1, 16, 7)
        assert len(expected) == count
        np.testing.assert_allclose(texels[begin : begin + count], expected, atol=3e-6)
        begin += count
    assert begin == len(texels)


def test_kernels_compile_for_cuda(tmp_path):
    codes = (kernels.LINEAR, kernels.SRGB, kernels.NORMAL)
    for kernel in (
        *(kernels.make_first_kernel(1, code, False) for code in codes),
        *(kernels.make_blocks_kernel(1, code) for code in codes),
        kernels.make_next_kernel(1, True),
    ):
        wp.compile_aot_module(kernel.module, arch=80, module_dir=tmp_path, use_ptx=True)
