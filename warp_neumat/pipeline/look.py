"""What all views of a renderer have in common."""

import dataclasses

import warp as wp

from warp_neumat.materials.base import Material
from warp_neumat.pipeline.skips import Skips
from warp_neumat.pipeline.surface_mesh import SurfaceMesh


@dataclasses.dataclass(frozen=True)
class Look:
    """What all views of a renderer have in common.

    Attributes:
        mesh: The mesh.
        materials: Materials by index.
        light_capacity: Most lights that will shine.
        size: (width, height) of the pictures [px].
        background: Radiance where nothing is seen.
        gain: What radiance is multiplied by before it is shown.
        skips: What is left out.
        tonemap: How the pictures will be shown, as :func:`tonemap` names it.
    """

    mesh: SurfaceMesh
    materials: list[Material]
    light_capacity: int
    size: tuple[int, int]
    background: wp.vec3
    gain: float
    skips: Skips
    tonemap: str = "srgb"
