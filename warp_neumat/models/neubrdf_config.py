"""What decides the shape of a NeuBRDF, and the defaults that a source suggests."""

from __future__ import annotations

import dataclasses
import difflib

from warp_neumat.kernels.healpix import hemisphere_point_count
from warp_neumat.kernels.neubrdf_frame import FRAMES, INTERPOLATIONS, SYMMETRIES

STORAGES = ("codebook", "raw", "4bit")


@dataclasses.dataclass(frozen=True)
class NeuBRDFConfig:
    """Everything that decides the shape of a NeuBRDF; the paper's default unless said otherwise."""

    nside: int = 64
    """HEALPix resolution N of both grids, 1 … 512; 6N² + 6N + 1 points each. Paper: 64."""
    features: int = 16
    """Width k of a primitive, 4 … 64. Paper: 16."""
    bits: int = 9
    """Bits b of an index, 1 … 16; the codebook holds 2^b primitives. Paper: 9."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the decoder's 1 … 4 hidden layers, multiples of 8. Paper: 64, 64."""
    interpolation: str = "bilinear"
    """Corner weights: ``"bilinear"`` and ``"idw"`` in training and at run time; ``"uniform"`` = the paper: inverse
    distance in training and 1/4 at run time."""
    frame: str = "absolute"
    """What the grids are asked for: ``"absolute"`` (paper: ω_i and ω_o), ``"isotropic"``, ``"half"``,
    ``"half-isotropic"`` or ``"half-light"``; see :func:`warp_neumat.models.local_frame.to_local_frame`."""
    symmetry: str = "none"
    """What the half frames take for one: ``"none"``, ``"reciprocal"`` or ``"bilateral"``."""
    output: str = "expm1"
    """Decoder's output map; only ``"expm1"``: f = exp(y) − 1. Paper: linear."""
    texture: tuple[int, int, int] | None = None
    """Width, height and channels of the neural texture's finest mip (paper Eq. 4), or None."""
    storage: str = "codebook"
    """``"codebook"``, or for comparison, and without a file: ``"raw"`` (a feature per point) or ``"4bit"``."""
    pixelation: str = "healpix"
    """Grid of the directions; others than ``"healpix"`` are for comparison, and without a file."""

    def __post_init__(self):
        hidden = self.hidden if isinstance(self.hidden, (tuple, list)) else (self.hidden,)
        object.__setattr__(self, "hidden", tuple(hidden))
        for name, low, high in (("nside", 1, 512), ("features", 4, 64), ("bits", 1, 16)):
            value = getattr(self, name)
            if not isinstance(value, int) or not low <= value <= high:
                raise ValueError(f"{name} must be a whole number in [{low}, {high}], got {value!r}")
        if not 1 <= len(self.hidden) <= 4 or any(
            not isinstance(w, int) or w < 8 or w % 8 or w > 512 for w in self.hidden
        ):
            raise ValueError(f"hidden must be 1 to 4 multiples of 8 up to 512, as 64,64, got {self.hidden}")
        for name, allowed in (
            ("interpolation", INTERPOLATIONS),
            ("frame", FRAMES),
            ("symmetry", SYMMETRIES),
            ("output", ("expm1",)),
            ("storage", STORAGES),
            ("pixelation", ("healpix", "lonlat", "sukharev", "fibonacci")),
        ):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {getattr(self, name)!r}")
        if self.symmetry != "none" and self.frame not in ("half", "half-isotropic"):
            raise ValueError(f"symmetry {self.symmetry!r} needs frame half or half-isotropic, got frame {self.frame!r}")
        if self.symmetry == "bilateral" and self.frame != "half-isotropic":
            raise ValueError("symmetry 'bilateral' needs frame half-isotropic; use reciprocal")
        if self.pixelation != "healpix" and self.interpolation != "bilinear":
            raise ValueError(f"pixelation {self.pixelation!r} has weights of its own: leave out interpolation")
        if self.texture is not None:
            texture = tuple(self.texture)
            if len(texture) != 3 or not all(isinstance(v, int) and v >= 1 for v in texture) or texture[2] > 64:
                raise ValueError(f"texture must be WIDTH,HEIGHT,CHANNELS, as 128,128,4, got {self.texture!r}")
            object.__setattr__(self, "texture", texture)

    @property
    def points(self) -> int:
        """Grid points of one hemisphere, with one ring beyond the equator."""
        return hemisphere_point_count(self.nside)

    @property
    def training_interpolation(self) -> str:
        """Corner weights that the fit sees."""
        return "idw" if self.interpolation == "uniform" else self.interpolation


def configure(source, options: dict) -> NeuBRDFConfig:
    """Return the config for ``source``: ``options`` over the defaults.

    Sources get the half-vector frame with the symmetry that they state: highlights lie along the half vector, so a few
    primitives describe them, while ω_i and ω_o leave their place to the network. Isotropic ones lose an angle and get a
    grid that 2^b primitives nearly fill point by point. ``bench brdf`` compares the frames.

    Raises:
        ValueError: If an option is unknown (names the nearest) or out of range.
    """
    fields = [field.name for field in dataclasses.fields(NeuBRDFConfig)]
    options = dict(options)
    reciprocal = options.pop("reciprocal", False)
    if reciprocal and options.get("symmetry") == "none":
        raise ValueError("reciprocal and symmetry 'none' contradict each other: give one of them")
    for key in options:
        if key not in fields:
            close = difflib.get_close_matches(key, [*fields, "reciprocal"], n=1, cutoff=0.0)[0]
            raise ValueError(f"neubrdf has no option {key!r}; nearest: {close}; known: {', '.join(fields)}, reciprocal")
    isotropic = bool(source.isotropic)
    frame = options.get("frame", "half-isotropic" if isotropic else "half")
    defaults: dict = {"frame": frame}
    if frame in ("half", "half-isotropic"):
        symmetry = getattr(source, "symmetry", "none")
        if symmetry == "bilateral" and frame != "half-isotropic" or reciprocal and symmetry == "none":
            symmetry = "reciprocal"
        defaults["symmetry"] = symmetry
    elif reciprocal:
        raise ValueError(f"reciprocal needs frame half or half-isotropic, got frame {frame!r}")
    if frame == "half-isotropic":
        defaults |= ISOTROPIC
    if getattr(source, "samples", None) is not None and frame.startswith("half"):
        defaults |= {"nside": _sparse_nside(len(source.samples[0])), "bits": 9}
    elif frame == "isotropic":
        defaults["nside"] = 32
    return NeuBRDFConfig(**{**defaults, **options})


def _sparse_nside(samples: int) -> int:
    """Return the resolution with at least four samples a point, a power of two in [2, 16].

    576 samples of alum-bronze: sphere MAE 0.0027 with 4, 0.0062 with 8, 0.0070 with 16; of red-plastic 0.0027, 0.0040,
    0.0051.
    """
    return next((nside for nside in (16, 8, 4) if samples >= 24 * nside * nside), 2)


ISOTROPIC = {"nside": 16, "bits": 11}
"""Grid and codebook of isotropic materials in the half-vector frame."""
