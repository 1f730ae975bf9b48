"""Multilayer perceptron in float64: the twin of ``kernels/mlp.py``."""

import numpy as np


def mlp(x, weights, biases) -> np.ndarray:
    """Evaluate dense layers with ReLU between them and a linear output, in float64.

    Args:
        x: Inputs, shape [n, inputs].
        weights: One matrix per layer, shape [out, in].
        biases: One vector per layer, shape [out].

    Returns: Outputs, shape [n, outputs].
    """
    h = np.asarray(x, np.float64)
    for layer, (w, b) in enumerate(zip(weights, biases, strict=True)):
        h = h @ np.asarray(w, np.float64).T + np.asarray(b, np.float64)
        if layer < len(weights) - 1:
            h = np.maximum(h, 0.0)
    return h
