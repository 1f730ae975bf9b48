"""Reflectance that varies over a surface: the protocol of such sources, and sets of PBR maps shaded with GGX as one.

ω_i points to the light and ω_o to the viewer, unit, in the **geometric** tangent frame: x along u, y along −v (up in
the picture), z = the surface's normal. uv has its origin top left, v goes down, and both repeat. A value is the BRDF
in 1/sr, linear Rec. 709, without the cosine. A footprint is a box of 2^lod × 2^lod texels of the source's finest data
around uv, and its value the mean of the reflectance in it; at lod 0 that is bilinear interpolation of the texels'
reflectance. Means are taken of reflectance, never of maps: a highlight spread by bumps cannot be had otherwise.

The GGX is that of ``kernels/ggx.py``, and which map feeds what is said in ``kernels/bcf_shade.py``: a set, and the bcf
fitted to it, look alike. Its value times n·ω_i / cos θ_i, n the normal of the normal map, is the apparent BRDF of the
flat surface: 0 where ω_i is below n's horizon, and for bent normals neither reciprocal nor isotropic.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import json
import os
import re
from pathlib import Path
from typing import Protocol

import numpy as np

from .brdf_source import CHUNK, checked, cores
from .mipmaps import srgb_to_linear, unit_normals
from .texture_set import TextureSet, open_texture_set

PREFIX = "svbrdf:"
"""What a specification of such a source begins with."""

STRATA = 4
"""Texels looked at along each side of a large footprint, by default."""

ALPHA_MIN, LEAST_COSINE = 1e-3, 1e-2  # as in kernels/ggx.py; held by test_texels_match_the_float64_reference
_UNUSED = ("emissive", "occlusion", "opacity", "displacement")


class SpatialSource(Protocol):
    """What a fit needs of a reflectance that varies over a surface; what a reader of measured BTFs must provide.

    Beyond the conventions above: ``eval`` is a pure function (whatever it draws, it draws from a hash of its inputs),
    takes a quarter of a million samples a call in a few seconds, and gives finite values of at least 0, and 0 where a
    direction is not above the geometric horizon. Directions between measured ones are interpolated. What parallax and
    shadows do is part of the value: uv is where the ray meets the flat surface.
    """

    name: str
    isotropic: bool
    """Whether turning both directions about the geometric normal changes nothing, at every point."""
    symmetry: str
    """As :class:`warp_neumat.io.brdf_source.BRDFSource`, if it holds at every point."""
    notes: tuple[str, ...]
    """Readable lines about the data: what was left out, converted or assumed."""
    width: int
    """Texels of the finest data along u."""
    height: int
    """Texels along v."""

    def eval(self, uv: np.ndarray, lod: np.ndarray, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        """Return the mean BRDF of the footprints, (N, 3) float32 in 1/sr, without the cosine.

        Args:
            uv: Centres of the footprints, (N, 2).
            lod: log2 of their side in texels of the finest data, (N,) or one number; below 0 counts as 0.
            wi, wo: Unit directions (N, 3).
        """

    def refined(self) -> SpatialSource:
        """Return the same source with less noise in its means, for measuring rather than for training."""


def is_spatial(source) -> bool:
    """Return whether ``source`` varies over a surface, as :class:`SpatialSource`."""
    return hasattr(source, "width") and hasattr(source, "height")


@dataclasses.dataclass(frozen=True, eq=False)
class SVBRDF:
    """A set of PBR maps as a :class:`SpatialSource`; made by :func:`open_svbrdf`.

    ``columns`` (10, texels) float32 are what GGX needs of every texel, row by row: normal, α², diffuse [1/sr] and F₀.
    ``strata`` bounds the texels that a footprint's mean is taken of. Where strata² are all that it can touch, side up
    to strata − 1, the mean is exact; else they are drawn, one from each cell of a grid of strata² over the footprint.
    What is drawn is a hash of all inputs: equal calls give equal values. ``opening`` holds the keyword arguments that
    open the same source again.
    """

    name: str
    width: int
    height: int
    columns: np.ndarray
    notes: tuple[str, ...] = ()
    opening: dict = dataclasses.field(default_factory=dict)
    strata: int = STRATA

    @property
    def isotropic(self) -> bool:
        """Whether no normal is bent."""
        return not self.columns[:2].any()

    @property
    def symmetry(self) -> str:
        """``"bilateral"`` without bent normals, else ``"none"``."""
        return "bilateral" if self.isotropic else "none"

    def refined(self, strata: int = 4 * STRATA) -> SVBRDF:
        """Return the source with up to ``strata``² texels in a footprint's mean."""
        return dataclasses.replace(self, strata=strata)

    def eval(self, uv, lod, wi, wo) -> np.ndarray:
        """Return the mean BRDF of footprints, (N, 3) float32 in 1/sr, without the cosine; see :class:`SpatialSource`.

        Raises:
            ValueError: If a shape is wrong or uv or lod is not finite.
        Error: of one texel, relative to the value × cosine + 1e-3, at most 4e-3 against ``reference.ggx`` in float64,
            held by test_texels_match_the_float64_reference.
        """
        wi, wo = checked(wi, wo)
        uv = np.ascontiguousarray(uv, np.float32)
        if uv.shape != (len(wi), 2):
            raise ValueError(f"uv must have shape ({len(wi)}, 2), got {uv.shape}")
        lod = np.asarray(lod, np.float32)
        if lod.ndim and lod.shape != (len(wi),):
            raise ValueError(f"lod must be one number or have shape ({len(wi)},), got {lod.shape}")
        lod = np.ascontiguousarray(np.broadcast_to(lod, len(wi)))
        for what, given in (("uv", uv), ("lod", lod)):
            if not np.isfinite(given).all():
                raise ValueError(f"{what} must be finite; leave such samples out")
        side = np.exp2(np.clip(lod, 0.0, np.log2(max(self.width, self.height))))
        cells = np.ceil(side).astype(np.int64) + 1  # along each side, as many texels as a footprint can touch
        cells[cells > self.strata] = -self.strata
        with np.errstate(invalid="ignore"):
            cells[~((wi[:, 2] > 0) & (wo[:, 2] > 0) & np.isfinite(wi + wo).all(1))] = 0  # not above the horizon
        values, jobs = np.zeros((len(wi), 3), np.float32), []
        for count in np.unique(cells[cells != 0]):
            chosen = np.flatnonzero(cells == count)
            step = max(64, CHUNK // int(count) ** 2)
            jobs += [(int(count), chosen[at : at + step]) for at in range(0, len(chosen), step)]

        def fill(job) -> None:
            count, rows = job
            at, level, i, o, width = (array[rows] for array in (uv, lod, wi, wo, side))
            if count > 0:
                texel, share = self._covered(at, width, count)
            else:
                texel, share = self._drawn(at, level, i, o, width, -count), np.float32(1.0 / count**2)
            values[rows] = self._shade(texel, share, i, o)

        workers = min(len(jobs), cores())
        if workers > 1:
            with concurrent.futures.ThreadPoolExecutor(workers) as pool:
                list(pool.map(fill, jobs))
        else:
            for job in jobs:
                fill(job)
        return values

    def _covered(self, uv, side, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers of the count² texels that footprints can touch, and their shares, (n, count²) each."""
        step, found, shares = np.arange(count), [], []
        for axis, size in enumerate((self.width, self.height)):
            low = ((uv[:, axis] - np.floor(uv[:, axis])) * np.float32(size) - np.float32(0.5) * side)[:, None]
            cell = np.floor(low) + step.astype(np.float32)
            high = low + side[:, None]
            shares.append(np.maximum(np.minimum(high, cell + 1.0) - np.maximum(low, cell), 0.0) / side[:, None])
            found.append(cell.astype(np.int64) % size)
        texel = found[1][:, :, None] * self.width + found[0][:, None, :]
        share = shares[1][:, :, None] * shares[0][:, None, :]
        return texel.reshape(len(uv), -1), share.reshape(len(uv), -1)

    def _drawn(self, uv, lod, wi, wo, side, count: int) -> np.ndarray:
        """Return the numbers of texels drawn from footprints, one from each of count² cells, (n, count²)."""
        seed = _hash(np.concatenate([uv, lod[:, None], wi, wo], 1))[:, None]
        stratum = np.arange(count * count, dtype=np.uint32)
        found = []
        for axis, size in enumerate((self.width, self.height)):
            cell = stratum % count if axis == 0 else stratum // count
            jitter = _scrambled(seed + np.uint32(2) * stratum + np.uint32(axis)) * np.float32(2.0**-32)
            place = (cell + jitter) * np.float32(1.0 / count) - np.float32(0.5)
            at = (uv[:, axis] - np.floor(uv[:, axis]))[:, None] * np.float32(size) + place * side[:, None]
            found.append(np.floor(at).astype(np.int64) % size)
        return found[1] * self.width + found[0]

    def _shade(self, texel: np.ndarray, share, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        """Return GGX × n·ω_i / cos θ_i, summed over the texels (n, K) of each sample times ``share``, (n, 3)."""
        i, o = ([column[:, None] for column in np.ascontiguousarray(w.T)] for w in (wi, wo))
        n = [column.take(texel) for column in self.columns[:3]]
        alpha2 = self.columns[3].take(texel)
        rest = 1.0 - alpha2
        nl, nv = (n[0] * w[0] + n[1] * w[1] + n[2] * w[2] for w in (i, o))
        lit = nl > 0.0
        low = nv < LEAST_COSINE
        if low.any():  # the viewer is raised to the least cosine over the bent horizon
            along = [a - b * nv for a, b in zip(o, n, strict=True)]
            scale = np.sqrt((1.0 - LEAST_COSINE**2) / np.maximum(along[0] ** 2 + along[1] ** 2 + along[2] ** 2, 1e-12))
            o = [np.where(low, a * scale + b * LEAST_COSINE, c) for a, b, c in zip(along, n, o, strict=True)]
            nv = np.maximum(nv, np.float32(LEAST_COSINE))
        s = [a + b for a, b in zip(i, o, strict=True)]
        s2 = np.maximum(s[0] * s[0] + s[1] * s[1] + s[2] * s[2], np.float32(1e-20))
        # sin² θ_h by the cross product: the difference from 1 would leave nothing of a sharp lobe.
        c = (n[1] * s[2] - n[2] * s[1], n[2] * s[0] - n[0] * s[2], n[0] * s[1] - n[1] * s[0])
        spread = alpha2 + rest * np.minimum((c[0] * c[0] + c[1] * c[1] + c[2] * c[2]) / s2, 1.0)
        l = np.maximum(nl, 0.0)
        masking = l * np.sqrt(alpha2 + rest * nv * nv) + nv * np.sqrt(alpha2 + rest * l * l)
        lobe = np.float32(0.5 / np.pi) * alpha2 / (spread * spread) * l / np.maximum(masking, 1e-12)
        u = np.maximum(1.0 - 0.5 * np.sqrt(s2), 0.0)
        w = u * u * u * u * u
        base, weak = l * (1.0 - w), 1.0 - w
        result = np.empty((len(texel), 3), np.float32)
        for channel in range(3):
            diffuse, f0 = (self.columns[first + channel].take(texel) for first in (4, 7))
            value = np.where(lit, diffuse * base + (f0 * weak + w) * lobe, 0.0)
            result[:, channel] = (value * share).sum(1) / i[2][:, 0]
        return result


def open_svbrdf(spec, *, size=None, crop=None, overrides=None) -> SVBRDF:
    """Return the set of PBR maps that ``spec`` names, as a reflectance that varies over a surface.

    Args:
        spec: ``svbrdf:FOLDER`` or a manifest as for :func:`warp_neumat.io.texture_set.open_texture_set`; size and crop
            may follow as ``?size=256&crop=0,0,512,512``. What is opened is taken to repeat.
        size, crop, overrides: As for :func:`~warp_neumat.io.texture_set.open_texture_set`; what ``spec`` says itself
            comes first.

    Raises:
        FileNotFoundError: If there is no such folder or manifest.
        ValueError: If the specification, an option, or a map is wrong; one line with the way out.
    """
    spec = os.fspath(spec)
    if not spec.startswith(PREFIX):
        raise ValueError(f"{spec!r} must begin with {PREFIX}, as {PREFIX}textures/bricks")
    folder, given = _split(spec.removeprefix(PREFIX))
    if not folder:
        raise ValueError(f"{spec!r} names no folder; use {PREFIX}FOLDER")
    given = {"size": size, "crop": crop, **given}
    if not Path(folder).exists():
        raise FileNotFoundError(f"{folder}: no such folder; {PREFIX} needs a folder of PBR maps or its manifest")
    maps = open_texture_set(folder, **given, overrides=overrides)
    settled = maps.manifest()
    opening = {name: settled[name] for name in ("size", "crop") if name in settled}
    if overrides:
        opening["overrides"] = json.loads(json.dumps(overrides, default=os.fspath))
    return from_texture_set(maps, opening)


def from_texture_set(maps: TextureSet, opening: dict | None = None) -> SVBRDF:
    """Return an opened set as a :class:`SVBRDF`. Maps that it does not hold have glTF 2.0's defaults.

    Raises:
        ValueError: If the set holds no map that changes the reflectance.
    """
    base = [_plane(maps, "base_color", component, 1.0) for component in "rgb"]
    rough, metal = _plane(maps, "roughness", "value", 1.0), _plane(maps, "metallic", "value", 0.0)
    dielectric = np.float32(0.08) * _plane(maps, "specular", "value", 0.5)
    present = {channel.map for channel in maps.channels} | set(maps.constants)
    if not present & {"base_color", "roughness", "metallic", "specular", "normal"}:
        raise ValueError(
            f"{maps.name}: no map of base colour, normal, roughness, metallic or specular; name the files in overrides"
        )
    normal = unit_normals(0.5 + 0.5 * np.stack([_plane(maps, "normal", axis, 0.0) for axis in "xy"], -1))
    alpha = np.maximum(np.clip(rough, 0.0, 1.0) ** 2, np.float32(ALPHA_MIN))
    diffuse = [colour * (1.0 - metal) * (1.0 - dielectric) * np.float32(1 / np.pi) for colour in base]
    f0 = [dielectric + (colour - dielectric) * metal for colour in base]
    columns = np.stack([*np.moveaxis(normal, -1, 0), alpha * alpha, *diffuse, *f0]).reshape(10, -1)
    unused = tuple(f"{name}: not part of the reflectance, left out" for name in _UNUSED if name in present)
    columns = np.ascontiguousarray(columns, np.float32)
    return SVBRDF(maps.name, maps.width, maps.height, columns, (*maps.notes, *unused), opening or {})


def _plane(maps: TextureSet, name: str, component: str, default: float) -> np.ndarray:
    """Return one component of a map as linear values (H, W) float32; a map of one channel stands for all of them."""
    known = {(c.map, c.component): (k, c) for k, c in enumerate(maps.channels)}
    found = known.get((name, component)) or known.get((name, "value"))
    if found is None:
        values = np.ravel(maps.constants.get(name, default))
        place = {"g": 1, "b": 2, "y": 1}.get(component, 0)
        return np.full((maps.height, maps.width), values[min(place, len(values) - 1)], np.float32)
    number, channel = found
    low, high = channel.range
    value = low + (high - low) * maps.pixels[..., number]
    if channel.encoding == "normal":
        return 2.0 * value - 1.0
    return srgb_to_linear(value) if channel.encoding == "srgb" else value


def _split(text: str) -> tuple[str, dict]:
    """Split FOLDER?size=…&crop=…; a question mark that belongs to an existing path stays there."""
    folder, mark, options = text.rpartition("?")
    if not mark or Path(text).exists():
        return text, {}
    found: dict = {}
    for part in filter(None, options.split("&")):
        key, _, value = part.partition("=")
        if key not in ("size", "crop") or key in found:
            raise ValueError(f"{PREFIX}{text}: no option {key!r} here, or it is given twice; known: size, crop")
        numbers = re.fullmatch(r"(\d+)(?:[x,](\d+))?(?:,(\d+),(\d+))?", value)
        parts = tuple(int(n) for n in numbers.groups() if n) if numbers else ()
        if len(parts) not in ((4,) if key == "crop" else (1, 2)):
            form = "X,Y,W,H, as 0,0,512,512" if key == "crop" else "WxH or the longer side, as 256"
            raise ValueError(f"{PREFIX}{text}: {key} must be {form}, got {value!r}")
        found[key] = parts[0] if len(parts) == 1 else parts
    return folder, found


def _hash(rows: np.ndarray) -> np.ndarray:
    """Return a uint32 for each row of float32 numbers, by their bits."""
    bits = np.ascontiguousarray((rows + np.float32(0.0)).T).view(np.uint32)  # −0 counts as 0
    state = np.full(bits.shape[1], 0x9E3779B9, np.uint32)
    for row in bits:
        state = _scrambled(state ^ row)
    return state


def _scrambled(state: np.ndarray) -> np.ndarray:
    """Return a well-mixed uint32 for each of ``state``: xor-shifts and odd multipliers, each of them invertible."""
    state = (state ^ (state >> np.uint32(16))) * np.uint32(0x7FEB352D)
    state = (state ^ (state >> np.uint32(15))) * np.uint32(0x846CA68B)
    return state ^ (state >> np.uint32(16))
