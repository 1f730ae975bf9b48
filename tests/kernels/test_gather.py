"""The gather: bilinear filtering is exact, at every rate, for a texture that is affine in its coordinates."""

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.gather import gather_kernel
from warp_neumat.kernels.tiles import TILE, tile_count

SIDE = 64


@pytest.mark.parametrize("rate", [0, 1, 2, None], ids=["every", "second", "fourth", "mixed"])
def test_gather_is_exact_for_an_affine_texture(rng, device, rate):
    faces, pixels = 50, 9000
    corners = rng.uniform(1, SIDE - 1, (faces, 3, 2)).astype(np.float32)
    triangle = rng.integers(-1, faces, pixels).astype(np.int32)
    triangle[4096:8192] = -1  # a whole block of background
    weights = rng.dirichlet((1, 1, 1), pixels).astype(np.float32)
    columns, rows = tile_count(SIDE, SIDE)
    rates = rng.integers(0, 3, (rows, columns)) if rate is None else np.full((rows, columns), rate)
    rates[-1] = rates[:, -1] = 0  # beyond the last anchors of a coarser rate there are none
    # Channels x, y and their sum in units of the side: multiples of 1/128, which float16 holds exactly. Texels that are
    # no anchors of a tile, nor the first beyond it, hold none.
    centre = (np.arange(SIDE) + 0.5) / SIDE
    texture = np.zeros((SIDE, SIDE, 4), np.float16)
    texture[..., 0], texture[..., 1] = centre[None, :], centre[:, None]
    texture[..., 2] = centre[None, :] + centre[:, None]
    y, x = np.mgrid[:SIDE, :SIDE]
    step = 1 << rates[y // TILE, x // TILE]
    border = (x % TILE == 0) | (y % TILE == 0)
    texture[((x % step != 0) | (y % step != 0)) & ~border] = np.nan
    background = np.array([0.25, 0.5, 0.75], np.float32)
    at = np.einsum("pk,pkc->pc", weights.astype(np.float64), corners[triangle].astype(np.float64)) / SIDE
    expected = np.concatenate([at, at.sum(1, keepdims=True)], axis=1)
    expected[triangle < 0] = background

    def array(values):
        return wp.array(np.ascontiguousarray(values).ravel(), device=device)

    image, blank = wp.zeros(3 * pixels, dtype=wp.float32, device=device), wp.zeros(3, dtype=wp.uint8, device=device)
    inputs = [array(triangle), array(weights[:, 1:]), pixels, 4096, array(corners), array(texture), SIDE, SIDE]
    inputs += [array(rates.astype(np.uint8)), columns, wp.vec3(*background)]
    for _ in range(2):  # the second time, the empty block is passed over
        dispatch.launch(gather_kernel, 3, inputs=inputs, outputs=[blank, image], device=device)
        error = np.abs(image.numpy().reshape(pixels, 3) - expected)
        assert error.max() < 1e-6  # seen: 3.2e-7 (Zen 3)
    assert blank.numpy().tolist() == [0, 1, 0]
