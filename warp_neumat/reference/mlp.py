"""Multilayer perceptron in float64: the twin of ``kernels/mlp.py``."""

import numpy as np

ACTIVATIONS = {
    "relu": lambda x: np.maximum(x, 0.0),
    "hardswish": lambda x: x * np.clip(x / 6 + 0.5, 0.0, 1.0),
}


def mlp(x, weights, biases, activation: str = "relu") -> np.ndarray:
    """Evaluate dense layers with an activation between them and a linear output, in float64.

    Args:
        x: Inputs, shape [n, inputs].
        weights: One matrix per layer, shape [out, in].
        biases: One vector per layer, shape [out].
        activation: One of :data:`ACTIVATIONS`.

    Returns: Outputs, shape [n, outputs].
    """
    h = np.asarray(x, np.float64)
    for layer, (w, b) in enumerate(zip(weights, biases, strict=True)):
        h = h @ np.asarray(w, np.float64).T + np.asarray(b, np.float64)
        if layer < len(weights) - 1:
            h = ACTIVATIONS[activation](h)
    return h
