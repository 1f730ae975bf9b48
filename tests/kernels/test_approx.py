"""Elementary functions of lane loops against NumPy float64."""

import numpy as np
import warp as wp

from warp_neumat.kernels.approx import exp2


@wp.kernel
def exp2_kernel(x: wp.array(dtype=float), y: wp.array(dtype=float)):
    i = wp.tid()
    y[i] = exp2(x[i])


def test_exp2_matches_float64(device):
    x = np.concatenate([np.linspace(-126, 127, 400_001), np.arange(-126, 128), [-1e9, -127.5]]).astype(np.float32)
    y = wp.empty(len(x), dtype=float, device=device)
    wp.launch(exp2_kernel, dim=len(x), inputs=[wp.array(x, device=device)], outputs=[y], device=device)
    expected = np.exp2(np.maximum(x.astype(np.float64), -126))
    assert (np.abs(y.numpy() - expected) / expected).max() < 2.5e-7  # seen: 1.2e-7
