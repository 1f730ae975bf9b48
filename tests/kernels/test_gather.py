"""The gather: bilinear filtering is exact for a texture that is affine in its coordinates."""

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.gather import gather_kernel

SIDE = 64


def test_gather_is_exact_for_an_affine_texture(rng, device):
    faces, pixels = 50, 9000
    corners = rng.uniform(1, SIDE - 1, (faces, 3, 2)).astype(np.float32)
    triangle = rng.integers(-1, faces, pixels).astype(np.int32)
    triangle[4096:8192] = -1  # a whole block of background
    weights = rng.dirichlet((1, 1, 1), pixels).astype(np.float32)
    # Channels x, y and their sum in units of the side: multiples of 1/128, which float16 holds exactly.
    centre = (np.arange(SIDE) + 0.5) / SIDE
    texture = np.zeros((SIDE, SIDE, 4), np.float16)
    texture[..., 0], texture[..., 1] = centre[None, :], centre[:, None]
    texture[..., 2] = centre[None, :] + centre[:, None]
    background = np.array([0.25, 0.5, 0.75], np.float32)
    at = np.einsum("pk,pkc->pc", weights.astype(np.float64), corners[triangle].astype(np.float64)) / SIDE
    expected = np.concatenate([at, at.sum(1, keepdims=True)], axis=1)
    expected[triangle < 0] = background

    def array(values):
        return wp.array(np.ascontiguousarray(values).ravel(), device=device)

    image, blank = wp.zeros(3 * pixels, dtype=wp.float32, device=device), wp.zeros(3, dtype=wp.uint8, device=device)
    inputs = [array(triangle), array(weights[:, 1:]), pixels, 4096, array(corners), array(texture), SIDE, SIDE]
    for _ in range(2):  # the second time, the empty block is passed over
        dispatch.launch(gather_kernel, 3, inputs=[*inputs, wp.vec3(*background)], outputs=[blank, image], device=device)
        error = np.abs(image.numpy().reshape(pixels, 3) - expected)
        assert error.max() < 1e-6  # seen: 2.4e-7 (Zen 3)
    assert blank.numpy().tolist() == [0, 1, 0]
