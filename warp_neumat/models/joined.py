"""A material that joins a group: codebook and decoder stay as they are, its own indices alone are fitted."""

from __future__ import annotations

import torch
from torch import nn

from warp_neumat.models import codebook as vq
from warp_neumat.models import reassign
from warp_neumat.models.neubrdf import NeuBRDF


class JoinedNeuBRDF(NeuBRDF):
    """A NeuBRDF of which only features and then indices are trained.

    Args:
        like: A member of the group, from :func:`warp_neumat.models.neubrdf.from_asset`: its primitives and decoder are
            taken as they are, its features as a start.
        rows: Primitives that the group's file holds; no index names another.
        seed: As for :class:`NeuBRDF`.
    """

    SWEEPS = 8
    """Times that every point chooses its primitive anew, after the first."""

    def __init__(self, like: NeuBRDF, rows: int, seed: int = 0):
        if like.texture is not None:
            raise ValueError("a material with a neural texture has no group to join")
        super().__init__(like.config, seed)
        self.codebook = nn.Parameter(like.codebook.detach()[:rows].clone())
        with torch.no_grad():
            self.net.copy_(like.net)
            self.table.copy_(like.codebook[like.indices.long()])
            self.level.fill_(len(self._levels) - 1)

    def stages(self) -> list[dict]:
        """Return the stages: features are trained, then indices chosen, which takes no steps."""
        return [
            {"name": "features", "kind": "features", "share": 1.0, "lr": (4e-3, 2e-4), "events": 0},
            {"name": "indices", "kind": "codebook", "share": 0.0, "lr": (0.0, 0.0), "events": self.SWEEPS},
        ]

    def trainable(self, stage: dict):
        """Return the features: all that is ever trained."""
        return [self.table]

    def begin(self, stage: dict, batches, loss, generator) -> None:
        """Give every point the primitive nearest to its features, under the metric of the loss."""
        if stage["kind"] == "features":
            return
        batches = list(batches())
        self._observe(batches)
        live = torch.nonzero(self.live).flatten()
        metric = reassign.metric(self, batches, loss)[live]
        weight = metric.diagonal(dim1=1, dim2=2).mean(1)
        metric = metric + (1e-3 * weight + 1e-12)[:, None, None] * torch.eye(self.config.features)
        with torch.no_grad():
            self.indices[live] = vq.assign(self.table.detach()[live], metric, self.codebook)[0].int()
            self.quantised.fill_(True)
        self._inherit()

    def event(self, stage: dict, batches, loss) -> None:
        """Choose the primitive of every point anew; see :func:`warp_neumat.models.reassign.sweep`."""
        reassign.sweep(self, list(batches()), loss)
        self._inherit()
