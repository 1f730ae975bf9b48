"""What every material offers, and how an asset becomes one."""

import abc
import dataclasses
import importlib
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import numpy as np

from warp_neumat.io.shared_asset import read_whole_asset
from warp_neumat.materials import brdf_sampling

KINDS = {
    "bcf": "warp_neumat.materials.bcf:BCf",
    "btf": "warp_neumat.materials.btf:BTF",
    "neubrdf": "warp_neumat.materials.neubrdf:NeuBRDF",
    "ntbc": "warp_neumat.materials.ntbc:NTBC",
}
"""Where the class of each kind lives: a kind that a scene does not use is never imported, so never compiled."""


class Material(abc.ABC):
    """A fitted material on one device.

    Frames, units and the cosine are those of docs/conventions.md: ω_i to the light, ω_o to the viewer, both unit,
    local, z = shading normal; :meth:`eval` returns value × cosine.
    """

    kind: str
    """Kind of the asset, as ``"neubrdf"``."""
    name: str
    """File name without suffix, for reports."""
    header: dict
    """The asset's JSON header: config, source, training facts, metrics."""
    bytes: int
    """Size of the asset's tensors in bytes, as stored."""
    device: Any
    """Warp device that it is on."""

    @abc.abstractmethod
    def eval(self, uv, wi, wo):
        """Return value × cos θ_i [1/sr] for pairs of directions, shape [n, 3], float32, of the kind of ``wi``.

        Args:
            uv: Texture coordinates, shape [n, 2]; ignored, and may be None, where a material does not vary in space.
            wi: Directions to the light, shape [n, 3]; numpy, torch or Warp.
            wo: Directions to the viewer, shape [n, 3].

        Below-horizon pairs give 0; no input gives a NaN or a negative value.
        """

    def brdf(self, wi, wo, uv=None):
        """Return the value without the cosine [1/sr] for numpy pairs of directions, shape [n, 3]; 0 below the horizon.

        Directions are normalised, as :meth:`eval` does it.
        """
        wi = np.asarray(wi, np.float32)
        cosine = wi[:, 2:] / np.maximum(np.linalg.norm(wi, axis=1, keepdims=True), np.float32(1e-30))
        return self.eval(uv, wi, wo) / np.where(cosine > 0, cosine, 1)

    def sample(self, uv, wo, u):
        """Return (ω_i [n, 3], weight = value × cos θ_i / pdf [n, 3], pdf [n] in 1/sr) for a path tracer.

        Args:
            uv: Texture coordinates, shape [n, 2], or None.
            wo: Directions to the viewer, shape [n, 3]; numpy, torch or Warp.
            u: Random numbers in [0, 1), shape [n, 3].

        Drawn from a mixture that is fitted to the material once, at the first call
        (:mod:`warp_neumat.materials.brdf_sampling`). Where ω_i falls below the horizon, weight and pdf are 0.
        """
        return brdf_sampling.sample(self, uv, wo, u)

    def pdf(self, uv, wi, wo):
        """Return the density [1/sr] with which :meth:`sample` draws ``wi``, shape [n]; ``uv`` is ignored."""
        return brdf_sampling.pdf(self, wi, wo)

    @abc.abstractmethod
    def shader(self) -> "Shader":
        """Return what ``kernels.shade`` needs to evaluate this material inside its own loop."""


@dataclasses.dataclass(frozen=True)
class Shader:
    """How a shading kernel evaluates a material.

    Attributes:
        functions: ``functions(layout, lanes)`` gives the Warp functions ``view`` and ``light`` and the struct
            ``Arguments`` for blocks of ``lanes`` lanes. ``view`` is called once per sample, ``light`` for each light:

            - ``view(arguments, wo, active, count, scratch)``, local ω_o [3][L];
            - ``light(arguments, wi, active, count, scratch, value)``, local ω_i [3][L], writes the value [3][L] without
              the cosine.

            Those of a textured material know what varies over it, so they differ in two points:

            - ``view(arguments, place, wo, active, count, scratch, emitted)``: ``place`` [3][L] is u, v and the mip
              level, ``emitted`` [3][L] receives the radiance that needs no light (it comes as 0);
            - ``light`` writes value × cosine with the normal that its maps say.

            Either works for the first ``count`` lanes listed in ``active``, all above the local horizon; a light's
            are among the view's, and for the rest of those it writes finite numbers.
        layout: Hashable compile-time layout with ``scratch(lanes)``, the float32 words a block needs.
        arguments: Instance of ``Arguments``: the material's device arrays.
        texels: Width and height of the finest mip level of a textured material, which levels are counted from;
            None = the material does not vary over the surface, and its kernel holds no code for uv.
        share: ``share(layout, arguments)`` takes those of all materials of one layout and returns them with common
            buffers.
    """

    functions: Callable
    layout: Hashable
    arguments: Any
    texels: tuple[int, int] | None = None
    share: Callable | None = None


def load(path, *, device=None) -> Material:
    """Open the asset at ``path`` on ``device`` (default: Warp's current device).

    Raises:
        FileNotFoundError: If there is no such file.
        FormatError: If it is not an asset that this release reads; the message names file, field and rule.
    """
    tensors, header = read_whole_asset(path)
    module, _, name = KINDS[header["kind"]].partition(":")
    return getattr(importlib.import_module(module), name)(tensors, header, path=Path(path), device=device)
