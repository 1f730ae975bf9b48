"""Run-time materials: assets opened, held on a device, and evaluated."""

from warp_neumat.materials.base import Material, load

__all__ = ["Material", "load"]
