"""The 675-weight network of Sztrajman et al. 2021, "Neural BRDF Representation and Importance Sampling", from scratch.

Input (h, d) after Rusinkiewicz as in :func:`warp_neumat.io.brdf.rusinkiewicz`, 6 → 21 → 21 → 3 with ReLU, output
max(exp(y) − 1, 0); loss mean |log(1 + f cosθ_i) − log(1 + f̂ cosθ_i)|. The functions in the npz files *are* such
networks, so on them an error of 0 is within this baseline's reach; from samples, like every other method here, it does
not get there. Isotropic: h is turned to azimuth 0.

Forward and backward are written out: at this size an automatic gradient costs more than the arithmetic. One thread: two
would wait for each other.
"""

from __future__ import annotations

import numpy as np
import torch

from warp_neumat.io.brdf import rusinkiewicz
from warp_neumat.training.samplers import BRDFSampler

SHAPES = ((6, 21), (21,), (21, 21), (21,), (21, 3), (3,))
"""Of w0, b0, w1, b1, w2, b2; 675 numbers."""

_BATCH = 2048
_RATE = 5e-3
_HIGHEST = 20.0  # of y in training; exp(20) is beyond any reflectance


def layers(flat: torch.Tensor) -> list[torch.Tensor]:
    """Return ``w0, b0, w1, b1, w2, b2`` as views of the 675 weights."""
    sizes = [int(np.prod(shape)) for shape in SHAPES]
    return [part.view(shape) for part, shape in zip(flat.split(sizes), SHAPES, strict=True)]


def nbrdf_value(flat: np.ndarray, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """Return f, (N, 3) float32 in 1/sr, for unit directions (N, 3)."""
    w0, b0, w1, b1, w2, b2 = layers(torch.from_numpy(flat))
    x = torch.from_numpy(rusinkiewicz(wi, wo))
    y = torch.addmm(b2, torch.addmm(b1, torch.addmm(b0, x, w0).relu_(), w1).relu_(), w2)
    return torch.expm1(y.clamp_(max=80.0)).clamp_(min=0.0).numpy()


def loss_and_gradient(flat, x, cosine, target) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the mean loss and its gradient by the 675 weights.

    Where y < 0 the output is cut to 0; there the loss goes on as a straight line, so that the gradient leads back.

    Args:
        flat: The weights.
        x: (h, d), (B, 6).
        cosine: cosθ_i, (B, 1).
        target: log(1 + f cosθ_i), (B, 3).
    """
    w0, b0, w1, b1, w2, b2 = layers(flat)
    a = torch.addmm(b0, x, w0).relu_()
    b = torch.addmm(b1, a, w1).relu_()
    y = torch.addmm(b2, b, w2)
    value = torch.expm1(y.clamp(0.0, _HIGHEST)).mul_(cosine)
    residual = torch.log1p(value).add_(y.clamp_max(0.0).mul_(cosine)).sub_(target)
    slope = (value + cosine).div_(value.add_(1.0))  # of log(1 + (e^y − 1) cosine) by y; where y < 0, the cosine
    back = residual.sign().mul_(slope).div_(residual.numel())
    gradient = torch.empty_like(flat)
    g0, h0, g1, h1, g2, h2 = layers(gradient)
    torch.mm(b.T, back, out=g2)
    torch.sum(back, 0, out=h2)
    back = torch.mm(back, w2.T).mul_(b > 0.0)
    torch.mm(a.T, back, out=g1)
    torch.sum(back, 0, out=h1)
    back = torch.mm(back, w1.T).mul_(a > 0.0)
    torch.mm(x.T, back, out=g0)
    torch.sum(back, 0, out=h0)
    return residual.abs().mean(), gradient


def fit_nbrdf(source, *, seed: int, steps: int) -> np.ndarray:
    """Return the 675 weights after ``steps`` of Adam with a cosine rate, on 2¹⁸ samples drawn once."""
    rng = np.random.default_rng(seed)
    drawn = BRDFSampler(source, rng).draw(1 << 18)
    x = torch.from_numpy(rusinkiewicz(drawn["wi"], drawn["wo"]))
    cosine = torch.from_numpy(np.ascontiguousarray(drawn["wi"][:, 2:]))
    target = torch.log1p(torch.from_numpy(drawn["value"]) * cosine)
    flat = torch.zeros(sum(int(np.prod(shape)) for shape in SHAPES))
    w0, _, w1, _, w2, b2 = layers(flat)
    for w, scale in ((w0, 1.0), (w1, 1.0), (w2, 0.1)):
        w[:] = torch.from_numpy(rng.normal(0.0, scale * np.sqrt(2.0 / len(w)), w.shape))
    b2[:] = torch.from_numpy(np.log1p(np.median(drawn["value"], axis=0)))
    mean, square = torch.zeros_like(flat), torch.zeros_like(flat)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            for step in range(1, steps + 1):
                first = int(rng.integers(0, len(x) - _BATCH))  # the samples lie in random order
                part = slice(first, first + _BATCH)
                _, gradient = loss_and_gradient(flat, x[part], cosine[part], target[part])
                mean.lerp_(gradient, 0.1)
                square.lerp_(gradient.square_(), 0.01)
                rate = _RATE * (0.001 + 0.999 * 0.5 * (1.0 + np.cos(np.pi * step / steps)))
                scale = rate * np.sqrt(1.0 - 0.99**step) / (1.0 - 0.9**step)
                flat.addcdiv_(mean, square.sqrt().add_(1e-8), value=-float(scale))
    finally:
        torch.set_num_threads(threads)
    return flat.numpy()
