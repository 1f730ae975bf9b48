"""Evaluate a material on arrays: numpy in, numpy out; torch in, torch out.

Run: python examples/evaluate_material.py [FILE.neumat]
"""

import sys

import numpy as np
import warp as wp

import warp_neumat as nm
from warp_neumat.pipeline import demo


def main(arguments=None) -> np.ndarray:
    wp.config.log_level = wp.LOG_WARNING
    path = arguments[0] if arguments else demo.material_paths()["knot"]
    material = nm.load(path)
    angle = np.radians(np.linspace(0, 85, 18))
    wi = np.stack([np.sin(angle), np.zeros(18), np.cos(angle)], axis=1).astype(np.float32)
    wo = wi * [-1, 1, 1]  # mirror configurations, from normal incidence to grazing
    values = material.eval(None, wi, wo.astype(np.float32))
    for degrees, rgb in zip(np.degrees(angle), values, strict=True):
        print(f"{degrees:5.1f} degrees: {rgb[0]:.4f} {rgb[1]:.4f} {rgb[2]:.4f}")
    return values


if __name__ == "__main__":
    main(sys.argv[1:])
