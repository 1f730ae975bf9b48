"""Elementary functions that stay vector code in a lane loop, where a call into libm would not."""

import warp as wp

from warp_neumat.kernels import dispatch

wp.set_module_options(dispatch.module_options())


@wp.func
def exp2(x: float) -> float:
    """Return 2**x for x in [-126, 127], and 2**-126 below; a polynomial on [-1/2, 1/2] times a power of two.

    Error: at most 2.5e-7 relative; held by test_exp2_matches_float64.
    """
    t = wp.max(x, -126.0)
    whole = wp.floor(t + 0.5)
    f = t - whole
    # Minimax of the relative error (1.9e-9 before rounding) over [-1/2, 1/2], degree 6, by Lawson's iteration.
    p = 1.534581182e-4
    p = p * f + 1.339993122e-3
    p = p * f + 9.618488958e-3
    p = p * f + 5.550328777e-2
    p = p * f + 2.402264689e-1
    p = p * f + 6.931472057e-1
    p = p * f + 1.0
    return p * wp.cast((int(whole) + 127) << 23, wp.float32)
