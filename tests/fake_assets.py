"""Assets with random contents, for tests of what a material computes rather than of how well it was fitted."""

import numpy as np

from warp_neumat.io.asset import pack_bits


def random_neubrdf(rng, *, nside=8, features=8, bits=6, hidden=(64, 64), frame="isotropic"):
    """Return (tensors, header) of a NeuBRDF whose values are of order one and vary with both directions."""
    points = 6 * nside * nside + 6 * nside + 1
    widths = (2 * features, *hidden, 3)
    tensors = {
        "codebook": rng.normal(size=(2**bits, features)).astype(np.float16),
        "indices": pack_bits(rng.integers(0, 2**bits, 2 * points), bits),
    }
    for n, (i, o) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
        tensors[f"weight{n}"] = (rng.normal(size=(o, i)) * np.sqrt(1.5 / i)).astype(np.float16)
        tensors[f"bias{n}"] = np.full(o, 0.2, np.float16)
    config = {"nside": nside, "features": features, "bits": bits, "hidden": list(hidden), "frame": frame}
    config |= {"interpolation": "bilinear", "output": "expm1"}
    return tensors, {"kind": "neubrdf", "version": 1, "config": config}
