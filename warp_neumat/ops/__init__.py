"""The bridge between torch and Warp: custom operators ``torch.ops.neumat.*``.

Each has a registered shape function, so that it works under ``torch.compile`` and passes ``torch.library.opcheck``.
"""

from warp_neumat.ops.bcf import Step, bcf_loss
from warp_neumat.ops.block_texture import block_decode
from warp_neumat.ops.grid import PARTS, grid_gather, grid_scatter, healpix_corners
from warp_neumat.ops.pyramid import pyramid_sample

__all__ = [
    "PARTS",
    "Step",
    "bcf_loss",
    "block_decode",
    "grid_gather",
    "grid_scatter",
    "healpix_corners",
    "pyramid_sample",
]
