"""What a fitted NeuBRDF is compared with, by name: analytic lobes and a small network, fitted to the same samples."""

from __future__ import annotations

import difflib
import time

from warp_neumat.training.analytic_fit import FittedBRDF, fit_analytic, ggx_value, in_numpy, two_lobe_value
from warp_neumat.training.nbrdf import fit_nbrdf, nbrdf_value

STEPS = {"ggx": 900, "two_lobe": 1500, "nbrdf": 6000}
"""Baseline → steps of its fit where none are given: about 5 s a material on two cores."""

_MODELS = {
    "ggx": in_numpy(ggx_value),
    "two_lobe": in_numpy(two_lobe_value),
    "nbrdf": nbrdf_value,
}


def fit(name: str, source, *, seed: int = 0, steps: int | None = None) -> FittedBRDF:
    """Fit baseline ``name`` to ``source`` and return it.

    Args:
        name: ``"ggx"``, ``"two_lobe"`` (both :mod:`warp_neumat.training.analytic_fit`) or ``"nbrdf"``
            (:mod:`warp_neumat.training.nbrdf`).
        source: As returned by :func:`warp_neumat.io.brdf.open_brdf`.
        seed: Decides every random draw.
        steps: Optimiser steps; default: :data:`STEPS`.

    Raises:
        ValueError: If the name is unknown or the steps are no positive number.
    """
    if name not in STEPS:
        close = difflib.get_close_matches(str(name), STEPS, n=1, cutoff=0.0)[0]
        raise ValueError(f"no baseline {name!r}; nearest: {close}; known: {', '.join(STEPS)}")
    steps = STEPS[name] if steps is None else steps
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 3:
        raise ValueError(f"steps must be a whole number of at least 3, got {steps!r}")
    start = time.perf_counter()
    if name == "nbrdf":
        weights, values = fit_nbrdf(source, seed=seed, steps=steps), {}
    else:
        weights, values = fit_analytic(name, source, seed=seed, steps=steps)
    isotropic = name != "ggx" or source.isotropic
    symmetry = "none" if name == "nbrdf" else "bilateral" if isotropic else "reciprocal"
    seconds = time.perf_counter() - start
    return FittedBRDF(name, weights, _MODELS[name], values, seconds, isotropic, symmetry)
