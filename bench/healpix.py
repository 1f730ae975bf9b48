"""HEALPix: pixel of a direction and grid corners with weights, beside healpy.

Ours and the peer work on the same directions, in turns. Both allocate their result in every call; healpy takes x, y and
z as separate arrays, ours (N, 3). The corners' peer is healpy's four interpolation neighbours with weights, given
angles. healpy works on one core whatever the workers, so the ratio per core is that of the rows with one worker.
``error`` is the fraction of pixels that differ from healpy's (for corners: the worst deviation of an interpolated table
of values in [−1, 1] from the float64 reference).
"""

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels import healpix as ours
from warp_neumat.reference import healpix as reference

from .harness import interleave

COLUMNS = ["kernel", "nside", "n", "workers", "ms", "mvec_per_s", "peer", "peer_ms", "ratio", "error"]


def rows(*, device: str, quick: bool):
    """Yield one row per kernel, resolution and number of workers."""
    import healpy

    n, rounds = (1 << 16, 3) if quick else (1 << 20, 15)
    rng = np.random.default_rng(5)
    vec = rng.normal(size=(n, 3))
    vec /= np.linalg.norm(vec, axis=1, keepdims=True)
    single = vec.astype(np.float32)
    # What healpy is asked is float64 of the very numbers that ours gets.
    given = {"float32": (single, np.ascontiguousarray(single.T.astype(np.float64))), "float64": (vec, vec.T.copy())}
    theta, phi = healpy.vec2ang(single.astype(np.float64))
    on_device = {name: wp.array(value[0], device=device) for name, value in given.items()}

    def timed(run):
        def call():
            result = run()
            wp.synchronize_device(device)
            return result

        return call

    before = dispatch._threads
    try:
        for workers in sorted({1, dispatch.worker_count()}):
            dispatch.set_worker_count(workers)
            for nside in (64,) if quick else (64, 8192):
                for nest in (False, True):
                    for precision, (_, xyz) in given.items():
                        arrays = on_device[precision]

                        def pixels(nside=nside, nest=nest, arrays=arrays):
                            return ours.vec2pix(nside, arrays, nest=nest)

                        def peer(nside=nside, nest=nest, xyz=xyz):
                            return healpy.vec2pix(nside, *xyz, nest=nest)

                        seconds = interleave({"ours": timed(pixels), "peer": peer}, rounds)
                        yield {
                            **_row(f"vec2pix {'nest' if nest else 'ring'} {precision}", nside, n, workers, seconds),
                            "peer": "healpy vec2pix",
                            "error": float((pixels().numpy() != peer()).mean()),
                        }

            def weights():
                return ours.corners(64, on_device["float32"])

            seconds = interleave(
                {"ours": timed(weights), "peer": lambda: healpy.get_interp_weights(64, theta, phi)}, rounds
            )
            table = rng.uniform(-1.0, 1.0, ours.corner_point_count(64))
            found, expected = (
                (table[indices] * weight).sum(axis=1)
                for indices, weight in ([array.numpy() for array in weights()], reference.corners(64, single))
            )
            yield {
                **_row("corners", 64, n, workers, seconds),
                "peer": "healpy interp",
                "error": float(np.abs(found - expected).max()),
            }
    finally:
        dispatch.set_worker_count(before)


def _row(kernel: str, nside: int, n: int, workers: int, seconds: dict) -> dict:
    return {
        "kernel": kernel,
        "nside": nside,
        "n": n,
        "workers": workers,
        "ms": seconds["ours"] * 1e3,
        "mvec_per_s": n / seconds["ours"] / 1e6,
        "peer_ms": seconds["peer"] * 1e3,
        "ratio": seconds["peer"] / seconds["ours"],
    }
