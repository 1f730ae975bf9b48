"""Reflectance spectra to linear Rec. 709 RGB: the CIE 1931 observer under illuminant D65.

D65 rather than E: it is the white of Rec. 709, so a surface that reflects all wavelengths alike comes out as equal R, G
and B, and a light of RGB (1, 1, 1) in a render stands for the light that the conversion assumed. Under E the same
surface would come out pinkish.

Observer: the multi-lobe fit of Wyman, Sloan & Shirley, "Simple Analytic Approximations to the CIE XYZ Color Matching
Functions", JCGT 2013 (within 0.035 of the tables, whose peak is 1.78). D65: CIE 15, every 10 nm. Matrix: Rec.
ITU-R BT.709.
"""

from __future__ import annotations

import numpy as np

# Relative power of D65 at 360, 370, … 830 nm (CIE 15:2004, Table T.1).
_D65 = np.array(
    [46.6383, 52.0891, 49.9755, 54.6482, 82.7549, 91.4860, 93.4318, 86.6823, 104.865, 117.008, 117.812, 114.861]
    + [115.923, 108.811, 109.354, 107.802, 104.790, 107.689, 104.405, 104.046, 100.000, 96.3342, 95.7880, 88.6856]
    + [90.0062, 89.5991, 87.6987, 83.2886, 83.6992, 80.0268, 80.2146, 82.2778, 78.2842, 69.7213, 71.6091, 74.3490]
    + [61.6040, 69.8856, 75.0870, 63.5927, 46.4182, 66.8054, 63.3828, 64.3040, 59.4519, 51.9590, 57.4406, 60.3125]
)
_RGB_OF_XYZ = np.array(
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
)


def observer(nm: np.ndarray) -> np.ndarray:
    """Return x̄, ȳ, z̄ of the CIE 1931 observer at wavelengths in nm, (3, n) (Wyman et al. 2013, Eq. 4)."""

    def lobe(peak, below, above):
        t = (nm - peak) / np.where(nm < peak, below, above)
        return np.exp(-0.5 * t * t)

    return np.stack(
        [
            1.056 * lobe(599.8, 37.9, 31.0) + 0.362 * lobe(442.0, 16.0, 26.7) - 0.065 * lobe(501.1, 20.4, 26.2),
            0.821 * lobe(568.8, 46.9, 40.5) + 0.286 * lobe(530.9, 16.3, 31.1),
            1.217 * lobe(437.0, 11.8, 36.0) + 0.681 * lobe(459.0, 26.0, 13.8),
        ]
    )


def rgb_weights(wavelengths) -> np.ndarray:
    """Return (3, n) float64 weights so that ``weights @ spectrum`` is linear Rec. 709 RGB.

    The spectrum is taken as linear between its wavelengths (ascending, in nm) and as constant beyond them, and
    integrated in steps of 1 nm. Each row sums to 1: a flat spectrum of value v gives (v, v, v), which moves the white
    of the fitted observer onto that of Rec. 709 (by 0.06 %).

    Raises:
        ValueError: If the wavelengths do not ascend.
    """
    wavelengths = np.asarray(wavelengths, np.float64)
    if wavelengths.ndim != 1 or not len(wavelengths) or (np.diff(wavelengths) <= 0).any():
        raise ValueError("wavelengths must be one ascending row, in nm")
    nm = np.arange(360.0, 831.0)
    power = np.interp(nm, np.arange(360.0, 831.0, 10.0), _D65)
    density = _RGB_OF_XYZ @ (observer(nm) * power)
    density /= density.sum(1, keepdims=True)
    if len(wavelengths) == 1:
        return np.ones((3, 1))
    place = np.clip(np.searchsorted(wavelengths, nm, side="right") - 1, 0, len(wavelengths) - 2)
    t = np.clip((nm - wavelengths[place]) / np.diff(wavelengths)[place], 0.0, 1.0)
    weights = np.zeros((len(wavelengths), 3))
    np.add.at(weights, place, ((1.0 - t) * density).T)
    np.add.at(weights, place + 1, (t * density).T)
    return np.ascontiguousarray(weights.T)
