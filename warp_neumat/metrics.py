"""How far a picture is from its reference: MAE, RMSE, PSNR, SSIM, FLIP, flicker; of maps, also angles of normals.

The first group compares display-referred pictures: sRGB-encoded, shape (H, W, 3), float32, values in [0, 1] (tonemap
first). The second, from :func:`channel_mse` on, compares texture maps of any number of channels, as encoded, and any
size down to one texel; what cannot be measured there is ``None``, never NaN or infinite, so that it can go into JSON.
SSIM and FLIP come from the libraries whose figures others report, scikit-image and flip-evaluator, which are imported
when they are first needed.
"""

import importlib
import math

import numpy as np


def _pair(reference, test) -> tuple[np.ndarray, np.ndarray]:
    reference, test = np.asarray(reference), np.asarray(test)
    for name, picture in (("reference", reference), ("test", test)):
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.size == 0:
            raise ValueError(f"{name} must have shape (H, W, 3), got {picture.shape}")
        if picture.dtype.kind != "f":
            raise TypeError(f"{name} must be floating point with values in [0, 1], got {picture.dtype}; divide by 255")
    if reference.shape != test.shape:
        raise ValueError(f"test must have the reference's shape {reference.shape}, got {test.shape}")
    return reference.astype(np.float32, copy=False), test.astype(np.float32, copy=False)


def _library(module: str, package: str):
    try:
        return importlib.import_module(module)
    except ImportError as error:
        if (error.name or "").split(".")[0] != module.split(".")[0]:
            raise
        raise ImportError(f"{package} is not installed; pip install 'warp-neumat[report]' brings it") from None


def mae(reference, test) -> float:
    """Return the mean absolute difference over pixels and channels."""
    reference, test = _pair(reference, test)
    return float(np.abs(test - reference).mean(dtype=np.float64))


def rmse(reference, test) -> float:
    """Return the root of the mean squared difference over pixels and channels."""
    reference, test = _pair(reference, test)
    return math.sqrt(np.square(test - reference).mean(dtype=np.float64))


def psnr(reference, test) -> float:
    """Return the peak signal-to-noise ratio, −20 log10(RMSE) [dB] for a peak of 1; infinite if equal."""
    error = rmse(reference, test)
    return math.inf if error == 0.0 else -20.0 * math.log10(error)


def ssim(reference, test) -> float:
    """Return the mean structural similarity, 1 for equal pictures.

    Wang et al., "Image Quality Assessment: From Error Visibility to Structural Similarity", 2004, with its constants:
    Gaussian window of σ = 1.5 px, K1 = 0.01, K2 = 0.03; each channel by itself, then their mean.

    Raises:
        ImportError: If scikit-image is missing; names the extra that brings it.
        ValueError: If a side is shorter than the window of 11 px.
    """
    reference, test = _pair(reference, test)
    if min(reference.shape[:2]) < 11:
        raise ValueError(f"SSIM needs pictures of at least 11x11 pixels, got {reference.shape[1]}x{reference.shape[0]}")
    return _structural_similarity(reference, test)


def _structural_similarity(reference: np.ndarray, test: np.ndarray) -> float:
    structural_similarity = _library("skimage.metrics", "scikit-image").structural_similarity
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return float(structural_similarity(reference, test, channel_axis=2, data_range=1.0, **window))


def flip(reference, test, *, pixels_per_degree: float | None = None) -> tuple[float, np.ndarray]:
    """Return LDR-FLIP, the mean and the map (H, W) float32, 0 for equal pictures and at most 1.

    Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", 2020, by its authors' own evaluator, run
    on the window in which the pictures differ: an unchanged background costs nothing.

    Args:
        reference: Display-referred picture.
        test: Display-referred picture of the same shape.
        pixels_per_degree: Of the viewer's visual angle. Default 67, the evaluator's own: a 0.7 m wide 3840-pixel screen
            seen from 0.7 m.

    Raises:
        ImportError: If flip-evaluator is missing; names the extra that brings it.
    """
    reference, test = _pair(reference, test)
    if pixels_per_degree is not None and not 0 < pixels_per_degree < math.inf:
        raise ValueError(f"pixels_per_degree must be above 0, got {pixels_per_degree}")
    for name, picture in (("reference", reference), ("test", test)):
        low, high = float(picture.min()), float(picture.max())
        if not (low >= 0 and high <= 1):  # also catches NaN
            raise ValueError(f"{name} must hold values in [0, 1], got {low:g} to {high:g}; tonemap it first")
    evaluate = _library("flip_evaluator", "flip-evaluator").evaluate
    parameters = {} if pixels_per_degree is None else {"ppd": float(pixels_per_degree)}
    errors = np.zeros(reference.shape[:2], dtype=np.float32)
    window = _differing(reference, test, margin=2 + 2 * math.ceil(_FLIP_REACH * (pixels_per_degree or 67.1)))
    if window is not None:
        pictures = (np.ascontiguousarray(picture[window]) for picture in (reference, test))
        # sRGB-encoded values are what its LDR mode takes; the map is not to be coloured.
        part, _, _ = evaluate(*pictures, "LDR", inputsRGB=True, applyMagma=False, parameters=parameters)
        errors[window] = np.asarray(part, dtype=np.float32).reshape(errors[window].shape)
    return float(errors.mean(dtype=np.float64)), errors


def flicker(reference, test, last_reference, last_test) -> float:
    """Return the mean absolute difference between how a picture changed and how its reference did.

    That is mean |(test − last_test) − (reference − last_reference)| over pixels and channels: what is wrong in the
    same way in both frames does not flicker, what jumps where the reference glides does.

    Args:
        reference, test: Display-referred pictures of a frame.
        last_reference, last_test: Those of the frame before it, of the same shape.
    """
    reference, test = _pair(reference, test)
    last_reference, last_test = _pair(last_reference, last_test)
    if reference.shape != last_reference.shape:
        raise ValueError(f"both frames must have the same shape, got {reference.shape} and {last_reference.shape}")
    change = (test - reference) - (last_test - last_reference)
    return float(np.abs(change, out=change).mean(dtype=np.float64))


# Degrees from a pixel to the farthest one that its filters see: 3 σ of the widest Gaussian, of the blue-yellow channel.
_FLIP_REACH = 3.0 * math.sqrt(0.04 / (2.0 * math.pi**2))


def _differing(reference, test, margin: int) -> tuple[slice, slice] | None:
    """The window that holds every differing pixel and ``margin`` more: outside, an error of bounded reach is 0."""
    unequal = (reference != test).any(axis=2)
    window = []
    for axis in (1, 0):
        hit = np.flatnonzero(unequal.any(axis=axis))
        if not hit.size:
            return None
        window.append(slice(max(0, int(hit[0]) - margin), int(hit[-1]) + 1 + margin))
    return window[0], window[1]


def channel_mse(reference, test) -> np.ndarray:
    """Return the mean squared difference of each channel, shape (C,), float64, of maps (H, W, C) in [0, 1]."""
    reference, test = _maps(reference, test)
    total = np.zeros(reference.shape[2])
    for row in range(0, len(reference), 64):  # temporaries stay small
        difference = test[row : row + 64] - reference[row : row + 64]
        total += np.square(difference, dtype=np.float64).sum(axis=(0, 1))
    return total / (reference.shape[0] * reference.shape[1])


def psnr_of_mse(mse) -> float | None:
    """Return −10 log10 of the mean of mean squared errors [dB] for a peak of 1; ``None`` where the error is 0.

    Averaging errors first is how papers on texture compression aggregate over channels and mips.
    """
    mean = float(np.mean(mse))
    return None if mean == 0.0 else -10.0 * math.log10(mean)


def map_ssim(reference, test) -> float | None:
    """Return :func:`ssim` of maps (H, W, C), the mean over channels; ``None`` if a side is shorter than 11 px."""
    reference, test = _maps(reference, test)
    return None if min(reference.shape[:2]) < 11 else _structural_similarity(reference, test)


def map_flip(reference, test) -> float:
    """Return the mean LDR-FLIP of maps (H, W, C) seen as :func:`colour_picture` shows them."""
    return flip(colour_picture(reference), colour_picture(test))[0]


def colour_picture(values) -> np.ndarray:
    """Return a map (H, W, C) as a picture (H, W, 3), float32, clipped to [0, 1].

    One channel becomes grey, two become red and green, three are shown as they are; of more, the first three.
    """
    values = np.asarray(values)
    if values.ndim != 3 or values.size == 0:
        raise ValueError(f"values must have shape (H, W, C), got {values.shape}")
    picture = np.zeros((*values.shape[:2], 3), np.float32)
    picture[..., : values.shape[2]] = values[..., :3]
    if values.shape[2] == 1:
        picture[..., 1:] = values
    return np.clip(picture, 0.0, 1.0, out=picture)


def angular_error(reference, test) -> tuple[float, float]:
    """Return mean and 95th percentile of the angle [degree] between unit vectors, shape (..., 3)."""
    reference, test = np.asarray(reference, np.float32), np.asarray(test, np.float32)
    if reference.shape != test.shape or reference.shape[-1:] != (3,) or reference.size == 0:
        raise ValueError(f"both must have the same shape (..., 3), got {reference.shape} and {test.shape}")
    # The arctangent keeps its precision at small angles, where an arccosine of float32 has a floor of 0.03 degrees.
    sine = np.linalg.norm(np.cross(reference, test), axis=-1)
    angle = np.degrees(np.arctan2(sine, (reference * test).sum(axis=-1)))
    return float(angle.mean(dtype=np.float64)), float(np.percentile(angle, 95.0))


def _maps(reference, test) -> tuple[np.ndarray, np.ndarray]:
    reference, test = np.asarray(reference), np.asarray(test)
    if reference.ndim != 3 or reference.size == 0:
        raise ValueError(f"reference must have shape (H, W, C), got {reference.shape}")
    if reference.shape != test.shape:
        raise ValueError(f"test must have the reference's shape {reference.shape}, got {test.shape}")
    for name, values in (("reference", reference), ("test", test)):
        if values.dtype.kind != "f":
            raise TypeError(f"{name} must be floating point with values in [0, 1], got {values.dtype}; divide by 255")
        if not np.isfinite(values).all():
            raise ValueError(f"{name} must be finite, and holds NaN or infinite values")
    return reference.astype(np.float32, copy=False), test.astype(np.float32, copy=False)
