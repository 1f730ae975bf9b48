"""Analytic BRDF sources: Lambert, and GGX with a choice of Fresnel terms over a diffuse base (`analytic:MODEL?…`).

Conventions are those of :mod:`warp_neumat.io.brdf_source`, formulas and papers those of
:mod:`warp_neumat.io.microfacet`; the layered model has :mod:`warp_neumat.io.layered_brdf` to itself.
"""

from __future__ import annotations

import dataclasses
import urllib.parse
from typing import ClassVar

import numpy as np

from .brdf_source import BRDFSource, in_chunks, suggest
from .microfacet import conductor, dielectric, ggx, half_vector, schlick


@dataclasses.dataclass(frozen=True)
class Lambert:
    """A perfectly diffuse surface: f = albedo/π."""

    albedo: tuple = (0.5, 0.5, 0.5)
    """Reflected fraction, RGB in [0, 1]."""

    name: ClassVar[str] = "lambert"
    isotropic: ClassVar[bool] = True
    symmetry: ClassVar[str] = "bilateral"
    notes: ClassVar[tuple] = ()

    def eval(self, wi, wo):
        """Return (N, 3) float32 in 1/sr, without the cosine."""
        return in_chunks(lambda i, o: np.broadcast_to(np.float32(self.albedo) / np.float32(np.pi), i.shape), wi, wo)


@dataclasses.dataclass(frozen=True)
class GGX:
    """GGX reflection over a diffuse base: f = diffuse/π + F·D·V, V = G₂/(4 cosθ_i cosθ_o).

    alpha = roughness². With anisotropy a, aspect = sqrt(1 − 0.9 a): alpha_x = alpha/aspect along x, alpha_y =
    alpha·aspect; or ``alpha_x`` and ``alpha_y`` say so directly. F is Schlick's with ``f0``, or exact: of a dielectric
    where ``ior`` is given, of a conductor where ``eta`` and ``k`` are.

    Energy: the diffuse part is not dimmed unless ``dim_diffuse``; without, the model conserves energy only for
    diffuse + f0 < 1. With it, diffuse·(1 − F(θ_i))·(1 − F(θ_o))/π, and the albedo stays ≤ 1
    (test_white_furnace_of_dimmed_ggx); reciprocal either way.
    """

    roughness: float = 0.3
    """Perceptual roughness in [0.01, 1]; alpha = roughness²."""
    f0: tuple | None = None
    """Reflectance at normal incidence, RGB in [0, 1]; 0.04 where nothing else says what F is."""
    diffuse: tuple = (0.0, 0.0, 0.0)
    """Albedo of the diffuse part, RGB in [0, 1]."""
    anisotropy: float = 0.0
    """0 is isotropic, towards 1 the highlight stretches across x; in [0, 1]."""
    ior: float | None = None
    """Index of refraction in [1, 10] of a dielectric; exact Fresnel."""
    eta: tuple | None = None
    """Real part of a conductor's index of refraction, RGB in [0, 20]; exact Fresnel, needs ``k``."""
    k: tuple | None = None
    """Imaginary part of a conductor's index of refraction, RGB in [0, 20]."""
    alpha_x: float | None = None
    """Width of the distribution along x in [1e-4, 1], instead of ``roughness`` and ``anisotropy``."""
    alpha_y: float | None = None
    """Width of the distribution along y in [1e-4, 1]; ``alpha_x`` where not given."""
    dim_diffuse: float = 0.0
    """1: the diffuse part gets only what the surface lets through, (1 − F(θ_i))(1 − F(θ_o)); 0: all of it."""

    name: ClassVar[str] = "ggx"
    notes: ClassVar[tuple] = ()
    rivals: ClassVar[tuple] = (("f0", "ior"), ("f0", "eta"), ("ior", "eta"), *(
        (alpha, other) for alpha in ("alpha_x", "alpha_y") for other in ("roughness", "anisotropy")
    ))  # fmt: skip
    """Pairs of parameters of which only one may be given."""

    def __post_init__(self):
        if (self.eta is None) != (self.k is None):
            raise ValueError("ggx: eta and k belong together; give both, as eta=R,G,B&k=R,G,B")
        if self.alpha_y is not None and self.alpha_x is None:
            raise ValueError("ggx: alpha_y needs alpha_x beside it")
        if sum(given is not None for given in (self.f0, self.ior, self.eta)) > 1:
            raise ValueError("ggx: give one of f0, ior, and eta with k")

    @property
    def alphas(self) -> tuple[float, float]:
        """(alpha_x, alpha_y)."""
        if self.alpha_x is not None:
            return self.alpha_x, self.alpha_x if self.alpha_y is None else self.alpha_y
        alpha, aspect = self.roughness**2, float(np.sqrt(1.0 - 0.9 * self.anisotropy))
        return alpha / aspect, alpha * aspect

    @property
    def isotropic(self) -> bool:
        """Whether alpha_x = alpha_y."""
        return self.alphas[0] == self.alphas[1]

    @property
    def symmetry(self) -> str:
        """ "bilateral" where isotropic, else "reciprocal"."""
        return "bilateral" if self.isotropic else "reciprocal"

    def fresnel(self, cosine: np.ndarray) -> np.ndarray:
        """Return F at cosines (N, 1): (N, 3), or (N, 1) where it has no colour."""
        if self.ior is not None:
            return dielectric(cosine, self.ior)
        if self.eta is not None:
            return conductor(cosine, self.eta, self.k)
        return schlick(cosine, (0.04,) * 3 if self.f0 is None else self.f0)

    def eval(self, wi, wo):
        """Return (N, 3) float32 in 1/sr, without the cosine."""
        return in_chunks(self._eval, wi, wo)

    def _eval(self, wi, wo):
        half = half_vector(wi, wo)
        base = np.float32(self.diffuse) / np.float32(np.pi)
        if self.dim_diffuse:
            base = base * (1.0 - self.fresnel(wi[:, 2:])) * (1.0 - self.fresnel(wo[:, 2:]))
        return self.fresnel((wi * half).sum(1, keepdims=True)) * ggx(wi, wo, half, *self.alphas) + base


_RANGES = {
    "roughness": (0.01, 1.0),
    "f0": (0, 1),
    "diffuse": (0, 1),
    "albedo": (0, 1),
    "anisotropy": (0, 1),
    "ior": (1, 10),
    "eta": (0, 20),
    "k": (0, 20),
    "alpha_x": (1e-4, 1.0),
    "alpha_y": (1e-4, 1.0),
    "dim_diffuse": (0, 1),
    "thickness": (0, 100),
    "absorption": (0, 100),
    "base_roughness": (0.01, 1.0),
    "base_f0": (0, 1),
    "base_eta": (0, 20),
    "base_k": (0, 20),
    "base_diffuse": (0, 1),
}
_COLOURS = ("f0", "diffuse", "albedo", "eta", "k", "absorption", "base_f0", "base_eta", "base_k", "base_diffuse")


def open_analytic(spec: str) -> BRDFSource:
    """Return the model that ``analytic:MODEL?KEY=VALUE&…`` names.

    Raises:
        ValueError: If model, key or value is wrong, or two parameters exclude one another.
    """
    from .layered_brdf import Layered

    models = {"ggx": GGX, "lambert": Lambert, "layered": Layered}
    kind, _, query = spec.removeprefix("analytic:").partition("?")
    if kind not in models:
        raise ValueError(f"{spec}: no analytic model {kind!r}; {suggest(kind, models)}")
    fields = {field.name for field in dataclasses.fields(models[kind]) if field.init}
    values = {}
    for part in filter(None, query.split("&")):
        key, equals, text = part.partition("=")
        if key not in fields:
            raise ValueError(f"{spec}: {kind} has no parameter {key!r}; {suggest(key, fields)}")
        if not equals or key in values:
            raise ValueError(f"{spec}: parameter {key!r} must be given once, as {key}=VALUE")
        values[key] = _parse(spec, key, urllib.parse.unquote(text))
    for first, second in getattr(models[kind], "rivals", ()):
        if first in values and second in values:
            raise ValueError(f"{spec}: {first} and {second} exclude one another; give one of them")
    return models[kind](**values)


def _parse(spec: str, key: str, text: str):
    low, high = _RANGES[key]
    try:
        numbers = [float(t) for t in text.split(",")]
    except ValueError:
        numbers = []
    wanted = (1, 3) if key in _COLOURS else (1,)
    if len(numbers) not in wanted or not all(low <= x <= high for x in numbers):
        form = "one number or R,G,B" if key in _COLOURS else "one number"
        raise ValueError(f"{spec}: {key} must be {form} in [{low}, {high}], got {text!r}")
    if key in _COLOURS:
        return tuple(numbers * 3 if len(numbers) == 1 else numbers)
    return numbers[0]
