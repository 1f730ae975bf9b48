"""Choosing primitives anew while a fit goes on: one Gauss–Seidel sweep over all grid points.

Vector quantisation point by point ignores that a sample sees a mean of four primitives. Points of one colour share no
pixel, so with all others fixed each sees an exact least-squares problem of its own (but for the decoder's curvature).
What one colour leaves over, the next takes into account: neighbours learn to average to values that no primitive holds.
"""

from __future__ import annotations

import functools

import torch
from torch.nn.functional import embedding_bag

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.neubrdf import LOG_LIMIT
from warp_neumat.models import codebook as vq
from warp_neumat.models.healpix_grid import colours
from warp_neumat.ops.brdf import BRDFStep

METRIC_BATCHES = 12
"""Batches that the curvature is estimated from; the gradient sees all."""

_DAMPING = 0.02  # of a point's own curvature; keeps directions that the decoder ignores from running away


def _scatter(out: torch.Tensor, corner: torch.Tensor, weight: torch.Tensor, rows: torch.Tensor) -> None:
    """Add weight[b, t]·rows[b] to out[corner[b, t]], as one sorted segment sum."""
    order = torch.argsort(corner.flatten(), stable=True)
    target = corner.flatten()[order]
    hit, count = torch.unique_consecutive(target, return_counts=True)
    start = torch.cumsum(count, 0) - count
    source, weight = torch.div(order, corner.shape[1], rounding_mode="floor"), weight.flatten()[order]
    out[hit] += embedding_bag(source, rows, start, mode="sum", per_sample_weights=weight)


def _corners(batch):
    """Return the grid corners (2B, 4) and weights of a batch, side by side."""
    return batch["corner"][:, :8].reshape(-1, 4), batch["weight"][:, :8].reshape(-1, 4)


def metric(model, batches, loss) -> torch.Tensor:
    """Return H = Σ w² JᵀJ of every grid point, (n, k, k), J the derivative of the residuals by ψ, w the weight."""
    k, total = model.config.features, len(model.indices)
    result = model.table.new_zeros(total, k * k)
    for batch in batches:
        inputs = model.gather(batch).detach().requires_grad_()
        residual = loss.residual(torch.expm1(model.decode(inputs).clamp_max(LOG_LIMIT)), batch)
        jacobian = [torch.autograd.grad(residual[:, c].sum(), inputs, retain_graph=c < 2)[0] for c in range(3)]
        jacobian = torch.stack([j[:, : 2 * k] for j in jacobian], 2).view(-1, 2, k, 3)
        square = (jacobian @ jacobian.transpose(2, 3)).view(-1, k * k)
        corner, weight = _corners(batch)
        _scatter(result, corner, weight**2, square)
    return result.view(total, k, k)


def gradient(model, batches, loss, backward: bool = True) -> tuple[torch.Tensor, torch.Tensor]:
    """Return Σ w Jᵀr of every grid point, (n, k), half the gradient of Σ r², and Σ r² of its samples, (n,).

    Through torch: for CUDA, and what :class:`Probe` is tested against.
    """
    k, total = model.config.features, len(model.indices)
    pulls, error = model.table.new_zeros(total, k), model.table.new_zeros(total, 1)
    for batch in batches:
        inputs = model.gather(batch).detach().requires_grad_(backward)
        residual = loss.residual(torch.expm1(model.decode(inputs).clamp_max(LOG_LIMIT)), batch)
        corner, weight = _corners(batch)
        square = residual.detach().square().sum(1, keepdim=True).repeat_interleave(2, 0)
        _scatter(error, corner, (weight > 0).float(), square)
        if backward:
            pull = torch.autograd.grad((0.5 * residual * residual).sum(), inputs)[0][:, : 2 * k].reshape(-1, k)
            _scatter(pulls, corner, weight, pull)
    return pulls, error[:, 0]


class Probe:
    """:func:`gradient` through the fused kernel: called again and again on one list of batches. It runs with a
    table of one row per point, and a softness s so large that the loss is quadratic: √(r² + s²) ≈ s + r²/(2s).
    """

    SOFTNESS = 1e4

    def __init__(self, model, batches, loss):
        self.model, self.batches = model, batches
        texels = [] if model.texture is None else [model.texture.texels.detach().reshape(-1)]
        self.words = len(model.indices) * model.config.features
        table = torch.cat([torch.zeros(self.words), *texels])
        batch = len(batches[0]["corner"])
        self.step = BRDFStep(
            model.shape, table, [0, 0, self.words][: len(model.shape.groups)], model.net.detach().clone(), batch=batch,
            parts=min(4, dispatch.worker_count()), sharpness=loss.sharpness, softness=self.SOFTNESS,
        )  # fmt: skip

    def __call__(self, backward: bool = True) -> tuple[torch.Tensor, torch.Tensor]:
        """Return Σ w Jᵀr of every point, (n, k), half the gradient of Σ r², and Σ r² of its samples, (n,)."""
        model, step = self.model, self.step
        step.table[: self.words] = model.codebook.detach()[model.indices.long()].view(-1)
        pulls, error = torch.zeros(self.words), torch.zeros(len(model.indices))
        for batch in self.batches:
            step.run(batch["corner"], batch["weight"], batch["cosine"], batch["target"], backward=backward)
            corner, weight = batch["corner"][:, :8], batch["weight"][:, :8]
            seen = (weight > 0) * step.errors[:, None]
            error.index_add_(0, corner.reshape(-1), seen.reshape(-1))
            if backward:
                pulls += step.table_gradient[: self.words]
        scale = 3.0 * step.batch * self.SOFTNESS
        return scale * pulls.view(-1, model.config.features), error


def sweep(model, batches, loss) -> None:
    """Choose the primitive of every grid point of ``model`` anew, on a list of prepared ``batches`` of one size.

    A change that does not lower the error of a point's samples is undone.
    """
    local_metric = metric(model, batches[:METRIC_BATCHES], loss)
    if model.net.device.type == "cpu":
        probe = Probe(model, batches, loss)
    else:
        probe = functools.partial(gradient, model, batches, loss)
    words, points = model.codebook.detach(), model.points
    # The metric saw a part of the samples that the gradient sees.
    local_metric *= len(batches) / len(batches[:METRIC_BATCHES])
    size = local_metric.diagonal(dim1=1, dim2=2).mean(1)
    number = torch.arange(len(model.indices), device=words.device)
    side, colour = number // points % 2, number % 4
    if model.config.pixelation == "healpix":
        colour = colours(model.config.nside).to(words.device)[number % points]
    eye = torch.eye(model.config.features, device=words.device)
    for part in range(8):
        live = torch.nonzero(model.live & (size > 0) & (side == part // 4) & (colour == part % 4)).flatten()
        if not len(live):
            continue
        pull, error = probe()
        local = local_metric[live] + (_DAMPING * size[live])[:, None, None] * eye
        before = model.indices[live]
        target = words[before] - torch.linalg.solve(local, pull[live])
        model.indices[live] = vq.assign(target, local, words)[0].int()
        worse = probe(backward=False)[1][live] >= error[live]
        model.indices[live] = torch.where(worse, before, model.indices[live])
