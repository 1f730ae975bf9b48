"""A material that joins a group: codebook and decoder stay as they are, its own indices alone are fitted."""

from __future__ import annotations

import torch

from warp_neumat.models import codebook as vq
from warp_neumat.models import reassign
from warp_neumat.models.neubrdf import NeuBRDF


class JoinedNeuBRDF(NeuBRDF):
    """A NeuBRDF of which only features and then indices are trained.

    Args:
        like: A member of the group, from :func:`warp_neumat.models.neubrdf.from_asset`: its primitives and decoder are
            taken as they are, its features as a start.
    """

    def __init__(self, like: NeuBRDF, seed: int = 0):
        super().__init__(like.config, seed)
        with torch.no_grad():
            self.codebook.copy_(like.codebook)
            self.net.copy_(like.net)
            self.table.copy_(like.codebook[like.indices.long()])
            self.level.fill_(len(self._levels) - 1)
        if self.texture is not None:
            raise ValueError("a material with a neural texture cannot join a group")

    def stages(self) -> list[dict]:
        return [
            {"name": "features", "kind": "features", "share": 0.85, "lr": (4e-3, 2e-4), "events": 0},
            {"name": "indices", "kind": "codebook", "share": 0.15, "lr": (0.0, 0.0), "events": 8},
        ]

    def trainable(self, stage: dict):
        return [self.table]

    def begin(self, stage: dict, batches, loss, generator) -> None:
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

    def event(self, stage: dict, batches, loss) -> None:
        reassign.sweep(self, list(batches()), loss)
