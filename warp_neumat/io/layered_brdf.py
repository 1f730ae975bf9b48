"""A layered BRDF in closed form: rough dielectric coat, absorbing medium, and a rough conductor or diffuse base.

    f = F·D·V (coat) + T_i T_o · A · f_base(ω_i', ω_o') · M / η²

with ω' refracted into the coat of index η (Snell), T = 1 − F(θ) of the coat, and A = exp(−σ d (1/cosθ_i' + 1/cosθ_o')),
Beer-Lambert over the way in and out. 1/η² is what refraction does to solid angles: cosθ dω = η² cosθ' dω'. This is
Weidlich & Wilkie, "Arbitrarily Layered Micro-Facet Surfaces", 2007, Eq. 2-7, with the factor 1/η² that makes a diffuse
base under a clear coat obey Kubelka-Munk's boundary condition (Saunderson 1942) instead of gaining energy.

M is light that the coat throws back onto the base. Over a diffuse base of albedo ρ it is 1/(1 − ρ r), the sum of a
geometric series with the mean inner reflectance r = ∫ F_in(μ) exp(−2 σ d/μ) 2μ dμ, and exact for a smooth coat. Over a
conductor it is 1/(1 − min(F_i, F_o)·F_base·A), exact between two mirrors; taking the lesser F keeps
T_i T_o M ≤ min(T_i, T_o), so the energy is bounded, and the exchange of ω_i and ω_o changes nothing.

A rough conductor also throws light at the coat beyond the critical angle. Of the light T_o that enters, the share
e(θ_o) that does not leave by the term above under a white base and a clear medium is found by quadrature when first
needed, and leaves after further bounces as a lobe c·A·e_i T_i·e_o T_o/(π κ), κ = ∫ e T 2μ dμ (the reciprocal form of
Kelemen & Szirmay-Kalos, "A Microfacet Based Coupled Specular-Matte BRDF Model", 2001). Each bounce takes R, the mean
reflectance of the base, and q, what absorption leaves of diffuse light on the way up and down, so
c = R² q (1 − r)/(1 − R q r) with the r of the clear medium.

Roughness of the coat widens the base's lobe: a microfacet slope s turns a reflected ray by 2s and a refracted one by
(1 − 1/η) s, twice, so alpha² = alpha_base² + ½(1 − 1/η)² alpha_coat² (variances add as in Belcour, "Efficient Rendering
of Layered Materials using an Atomic Decomposition with Statistical Operators", 2018). What a rough coat itself loses to
multiple scattering stays lost, so the albedo is ≤ 1, not = 1.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import ClassVar

import numpy as np

from .brdf_source import in_chunks
from .microfacet import conductor, dielectric, ggx, half_vector, schlick


@dataclasses.dataclass(frozen=True)
class Layered:
    """A coated surface; formula and sources in the module's docstring. Isotropic, reciprocal, albedo ≤ 1.

    The base is diffuse (``base_diffuse``), or a conductor (``base_f0`` for Schlick's Fresnel term, ``base_eta`` with
    ``base_k`` for the exact one). Albedo ≤ 1 is held by test_white_furnace_of_layered.
    """

    roughness: float = 0.1
    """Perceptual roughness of the coat in [0.01, 1]; alpha = roughness²."""
    ior: float = 1.5
    """Index of refraction of the coat in [1, 10]."""
    thickness: float = 1.0
    """Thickness d of the medium in [0, 100], in the unit that ``absorption`` is per."""
    absorption: tuple = (0.0, 0.0, 0.0)
    """Absorption σ per unit length, RGB in [0, 100]."""
    base_roughness: float = 0.3
    """Perceptual roughness of a conductor base in [0.01, 1]."""
    base_diffuse: tuple | None = None
    """Albedo of a diffuse base, RGB in [0, 1]; 0.5 where nothing else says what the base is."""
    base_f0: tuple | None = None
    """Reflectance of a conductor base at normal incidence, RGB in [0, 1]."""
    base_eta: tuple | None = None
    """Real part of a conductor base's index relative to the coat, RGB in [0, 20]; needs ``base_k``."""
    base_k: tuple | None = None
    """Imaginary part of it, RGB in [0, 20]."""

    name: ClassVar[str] = "layered"
    isotropic: ClassVar[bool] = True
    symmetry: ClassVar[str] = "bilateral"
    notes: ClassVar[tuple] = ()
    rivals: ClassVar[tuple] = (
        ("base_diffuse", "base_f0"),
        ("base_diffuse", "base_eta"),
        ("base_f0", "base_eta"),
        ("base_diffuse", "base_roughness"),
    )

    def __post_init__(self):
        if (self.base_eta is None) != (self.base_k is None):
            raise ValueError("layered: base_eta and base_k belong together; give both")
        if sum(given is not None for given in (self.base_diffuse, self.base_f0, self.base_eta)) > 1:
            raise ValueError("layered: give one of base_diffuse, base_f0, and base_eta with base_k")

    @property
    def _diffuse(self) -> bool:
        return self.base_f0 is None and self.base_eta is None

    @property
    def _wide(self) -> float:
        """alpha of the base's lobe as seen through the coat."""
        spread = 0.5 * (1.0 - 1.0 / self.ior) ** 2 * self.roughness**4
        return min(float(np.sqrt(self.base_roughness**4 + spread)), 1.0)

    def inner_reflectance(self, clear: bool = False) -> np.ndarray:
        """Return r, (3,) float64: what the coat throws back of diffuse light from below, absorbed on the way both ways.

        r = ∫₀¹ F_in(μ) exp(−2 σ d/μ) 2μ dμ; with ``clear``, σ = 0.
        """
        depth = np.zeros(3) if clear else np.asarray(self.absorption, np.float64) * self.thickness
        node, weight = np.polynomial.legendre.leggauss(256)
        critical = np.sqrt(1.0 - 1.0 / self.ior**2)
        total = np.zeros(3)
        for low, high in ((0.0, critical), (critical, 1.0)):  # F_in is 1 in the first, and kinks between the two
            if low == high:
                continue
            mu = low + (high - low) * 0.5 * (node + 1.0)
            fresnel = dielectric(self._outer(mu), self.ior) if high == 1.0 else np.ones_like(mu)
            part = (weight * 0.5 * (high - low) * 2.0 * mu * fresnel)[:, None]
            total += (part * np.exp(-2.0 * depth / mu[:, None])).sum(0)
        return total

    def _outer(self, mu):
        return np.sqrt(np.maximum(1.0 - self.ior**2 * (1.0 - mu * mu), 0.0))

    @functools.cached_property
    def _bounces(self) -> np.ndarray:
        """Diffuse base: what T_i T_o A is multiplied by. Conductor: c/(π κ). RGB float32."""
        if self._diffuse:
            albedo = np.array((0.5,) * 3 if self.base_diffuse is None else self.base_diffuse)
            return np.float32(albedo / (1.0 - albedo * self.inner_reflectance()) / (np.pi * self.ior**2))
        clear = np.maximum(self.inner_reflectance(clear=True), 1e-12)  # 0 where the coat has index 1
        through = self.inner_reflectance() / clear
        node, weight = np.polynomial.legendre.leggauss(64)
        mu, weight = 0.5 * (node + 1.0)[:, None], 0.5 * weight[:, None]
        mean = (weight * 2.0 * mu * self._fresnel(mu)).sum(0)
        lost = (weight * 2.0 * mu * self._lost(mu) * (1.0 - dielectric(mu, self.ior))).sum()
        return np.float32(
            mean**2 * through * (1.0 - clear) / (1.0 - mean * through * clear) / (np.pi * max(lost, 1e-9))
        )

    @functools.cached_property
    def _lost_table(self) -> tuple[np.ndarray, np.ndarray]:
        """cosθ_o outside, and e there: the share of entering light that a white base does not send straight out."""
        cosine = np.linspace(0.03, 1.0, 32) ** 2
        alpha, n = self._wide, 4181
        u, v = (np.arange(n) + 0.5) / n, np.arange(n) * 2584 / n % 1.0  # a Fibonacci lattice
        hz = np.sqrt((1.0 - u) / (1.0 + (alpha * alpha - 1.0) * u))  # half vectors as D·cosθ_h has them
        sine = np.sqrt(1.0 - hz * hz)
        half = np.stack([sine * np.cos(2 * np.pi * v), sine * np.sin(2 * np.pi * v), hz], 1)
        kept = np.empty(len(cosine))
        for k, z in enumerate(cosine):
            o = self._refract(np.array([[np.sqrt(1.0 - z * z), 0.0, z]]))
            i = 2.0 * (half @ o[0])[:, None] * half - o
            outside = self._outer(i[:, 2:])
            leaves = (i[:, 2:] > 0) & (outside > 0)
            fi, fo = dielectric(outside, self.ior), float(dielectric(z, self.ior))
            stretch = ((half[:, :2] / alpha) ** 2).sum(1) + hz * hz
            density = hz / (np.pi * alpha**2 * stretch**2) / np.maximum(4.0 * (half @ o[0]), 1e-9)
            lobe = ggx(i, np.broadcast_to(o, i.shape), half, alpha, alpha)[:, 0] * i[:, 2] / density
            out = (1.0 - fi) / np.maximum(1.0 - np.minimum(fi, fo), 1e-7)
            kept[k] = np.where(leaves, out, 0.0)[:, 0] @ lobe / len(lobe)
        return cosine, np.clip(1.0 - kept, 0.0, 1.0)

    def _lost(self, cosine: np.ndarray) -> np.ndarray:
        return np.interp(cosine, *self._lost_table).astype(cosine.dtype)

    def _fresnel(self, cosine: np.ndarray) -> np.ndarray:
        if self.base_eta is not None:
            return conductor(cosine, self.base_eta, self.base_k)
        return schlick(cosine, self.base_f0)

    def eval(self, wi, wo):
        """Return (N, 3) float32 in 1/sr, without the cosine."""
        return in_chunks(self._eval, wi, wo)

    def _eval(self, wi, wo):
        alpha = self.roughness**2
        half = half_vector(wi, wo)
        value = dielectric((wi * half).sum(1, keepdims=True), self.ior) * ggx(wi, wo, half, alpha, alpha)
        fi, fo = dielectric(wi[:, 2:], self.ior), dielectric(wo[:, 2:], self.ior)
        i, o = self._refract(wi), self._refract(wo)
        depth = np.float32(self.absorption) * np.float32(self.thickness)
        absorbed = np.exp(-depth * (1.0 / i[:, 2:] + 1.0 / o[:, 2:]))
        through = (1.0 - fi) * (1.0 - fo) * absorbed
        if self._diffuse:
            return value + through * self._bounces
        half = half_vector(i, o)
        fresnel = self._fresnel((i * half).sum(1, keepdims=True))
        again = np.maximum(1.0 - np.minimum(fi, fo) * fresnel * absorbed, np.float32(1e-7))
        lobe = fresnel * ggx(i, o, half, self._wide, self._wide) / (again * np.float32(self.ior**2))
        return value + through * (lobe + self._bounces * self._lost(wi[:, 2:]) * self._lost(wo[:, 2:]))

    def _refract(self, w):
        inner = w / w.dtype.type(self.ior)
        sine2 = inner[:, 0] ** 2 + inner[:, 1] ** 2
        inner[:, 2] = np.sqrt(np.maximum(1.0 - sine2, 1e-6))
        return inner
