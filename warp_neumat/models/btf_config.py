"""What decides the shape of a BTF model and how it is trained: MobileVR's student, its rivals and its teacher."""

from __future__ import annotations

import dataclasses
import difflib

from warp_neumat.io.block_formats import mip_limit

_WIDEST = 256
VARIANTS = {
    "coarse-to-fine": {},
    "single-level": {"channels": 30, "hidden": (8,) * 7, "coarse_channels": 0, "coarse": ()},
    "neumip": {"activation": "relu", "channels": 14, "hidden": (25,) * 5, "coarse_channels": 0, "coarse": ()},
    "neumip-max": {"activation": "relu", "channels": 14, "hidden": (128,) * 5, "coarse_channels": 0, "coarse": ()},
    "teacher": {"channels": 16, "hidden": (128,) * 4, "coarse_channels": 0, "coarse": ()},
}
"""Models of MobileVR §4.1, 4.3, 5.2 and 5.6 by name. ``single-level`` has the 779 weights of ``coarse-to-fine`` and as
many features a texel; ``neumip`` is the modified one, without pyramid of its own and offsets, whose 6.6 KB of weights
are a layer 23→25, four 25→25 and 25→3 in half precision."""

ALONE = ("neumip", "neumip-max", "teacher")
"""Variants that are trained without a teacher by default."""

RATES = ((16, (1.6e-2, 1e-4)), (64, (8e-3, 8e-5)), (_WIDEST, (4e-3, 4e-5)))
"""Learning rates that reach the lowest error in some ten thousand steps, by the widest layer."""

FEATURES = ("half", "bc6h")
ACTIVATIONS = ("relu", "hardswish")
SCHEDULES = ("cosine", "plateau")


@dataclasses.dataclass(frozen=True)
class BTFConfig:
    """Everything that decides a BTF model and its training; the paper's unless said otherwise."""

    width: int
    """Texels of the fine texture's finest mip along u; default: the source's."""
    height: int
    """Texels along v."""
    mips: int = 0
    """Mips of both textures; 0 = all down to 2 texels along the shorter side. Paper: 1."""
    variant: str = "coarse-to-fine"
    """One of :data:`VARIANTS`; the other fields overrule what it stands for."""
    channels: int = 16
    """Features of a fine texel."""
    hidden: tuple[int, ...] = (8, 8, 8)
    """Widths of the fine network's hidden layers."""
    coarse_channels: int = 14
    """Features of a coarse texel."""
    coarse: tuple[int, ...] = (8, 8, 8, 8)
    """Widths of the coarse network's layers, the latents last; empty = single level."""
    half_vector: bool = True
    """Whether the networks see h beside ω_i and ω_o."""
    activation: str = "hardswish"
    """What follows a hidden layer: ``"hardswish"``, x · clamp(x/6 + 1/2, 0, 1), which multiplies where ReLU selects;
    or ``"relu"``. The paper names none."""
    features: str = "half"
    """How features are stored: ``"half"``, or ``"bc6h"``, blocks at 3/16 of the bytes."""
    teacher: str = "auto"
    """``"auto"`` (from the cache, or trained first), ``"none"`` (no distillation), or the file of a fitted model."""
    teacher_hidden: tuple[int, ...] = (128, 128, 128, 128)
    """Widths of the teacher's hidden layers where it is trained here."""
    teacher_steps: int = 0
    """Its steps; 0 = half of the student's."""
    sigma: float = 1.0
    """Weight of the teacher's outputs in the loss (Eq. 5). Paper: 0.1."""
    lambda1: float = 0.01
    """Weight of the latents (Eq. 5). Paper: 0.1."""
    lambda2: float = 0.01
    """Weight of the last hidden layer (Eq. 5). Paper: 0.1."""
    lr: tuple[float, float] | None = None
    """First and last learning rate; None: by the widest layer (:data:`RATES`). Paper: 5e-4, 1e-7."""
    schedule: str = "cosine"
    """``"cosine"``; or ``"plateau"``, the paper's: halved where the test error falls by less than 1e-4 in an epoch."""
    epochs: int = 20
    """How often the test error is taken."""

    def __post_init__(self):
        for name in ("hidden", "coarse", "teacher_hidden"):
            value = getattr(self, name)
            value = tuple(value) if isinstance(value, (tuple, list)) else (value,)
            good = 1 <= len(value) <= 8 and all(_is_whole(w) and 1 <= w <= _WIDEST for w in value)
            if name == "coarse" and len(value) == 1:
                raise ValueError(f"coarse must be hidden widths and that of the latents, as 8,8,8,8, got {value}")
            if not good and not (name == "coarse" and not value):
                raise ValueError(f"{name} must be 1 to 8 widths from 1 to {_WIDEST}, as 8,8,8, got {value}")
            object.__setattr__(self, name, value)
        if bool(self.coarse) != bool(self.coarse_channels):
            raise ValueError(
                f"coarse widths and coarse_channels go together, got {self.coarse} and {self.coarse_channels}; "
                "variant=single-level has neither"
            )
        limit = mip_limit(self.width, self.height)
        for name, low, high in (
            ("width", 2, 8192), ("height", 2, 8192), ("mips", 0, limit), ("channels", 1, 64), ("epochs", 1, 1000),
            ("coarse_channels", 0, 64), ("teacher_steps", 0, 1 << 30),
        ):  # fmt: skip
            value = getattr(self, name)
            if not _is_whole(value) or not low <= value <= high:
                raise ValueError(f"{name} must be a whole number in [{low}, {high}], got {value!r}")
        if not self.mips:
            levels = [m for m in range(limit) if min(self.width >> m, self.height >> m) >= 2]
            object.__setattr__(self, "mips", len(levels))
        for name in ("sigma", "lambda1", "lambda2"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value < 1e6:
                raise ValueError(f"{name} must be a number of at least 0, got {value!r}")
        if self.lr is None:
            widest = max(*self.hidden, *self.coarse, 1)
            object.__setattr__(self, "lr", next(rates for most, rates in RATES if widest <= most))
        rates = tuple(self.lr) if isinstance(self.lr, (tuple, list)) else (self.lr,)
        good = all(isinstance(rate, (int, float)) and not isinstance(rate, bool) for rate in rates)
        rates = (*rates, rates[0] / 100) if good and len(rates) == 1 else rates
        if not good or len(rates) != 2 or not 0 < rates[1] <= rates[0] <= 1:
            raise ValueError(f"lr must be the first and the last rate, as 4e-3,4e-5, got {self.lr!r}")
        object.__setattr__(self, "lr", rates)
        if not isinstance(self.teacher, str) or not self.teacher:
            raise ValueError(f"teacher must be auto, none or the file of a fitted btf, got {self.teacher!r}")
        for name, allowed in (
            ("variant", tuple(VARIANTS)),
            ("features", FEATURES),
            ("schedule", SCHEDULES),
            ("activation", ACTIVATIONS),
        ):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {getattr(self, name)!r}")
        if not isinstance(self.half_vector, bool):
            raise ValueError(f"half_vector must be true or false, got {self.half_vector!r}")

    @property
    def angles(self) -> int:
        """Numbers that say the directions."""
        return 9 if self.half_vector else 6

    @property
    def distilled(self) -> bool:
        """Whether a teacher is asked at all."""
        return self.teacher != "none" and (self.sigma > 0 or self.lambda1 > 0 or self.lambda2 > 0)

    def asset(self) -> dict:
        """Return the config that an asset's header holds."""
        coarse = None
        if self.coarse:
            coarse = {"channels": self.coarse_channels, "hidden": list(self.coarse[:-1]), "latent": self.coarse[-1]}
        return {
            "width": self.width, "height": self.height, "mips": self.mips,
            "fine": {"channels": self.channels, "hidden": list(self.hidden)}, "coarse": coarse,
            "half_vector": self.half_vector, "activation": self.activation, "features": self.features,
        }  # fmt: skip


def _is_whole(value) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def configure(source, options: dict) -> BTFConfig:
    """Return the config for ``source``: ``options`` over those of the variant over the defaults.

    Raises:
        ValueError: If an option is unknown (names the nearest) or out of range.
    """
    fields = [field.name for field in dataclasses.fields(BTFConfig)]
    for key in options:
        if key in ("width", "height"):
            raise ValueError(f"{key} is the source's, {source.width}×{source.height}; fit a source of another size")
        if key not in fields:
            close = difflib.get_close_matches(key, fields, n=1, cutoff=0.0)[0]
            raise ValueError(f"btf has no option {key!r}; nearest: {close}; known: {', '.join(fields)}")
    variant = options.get("variant", "coarse-to-fine")
    if variant not in VARIANTS:
        raise ValueError(f"variant must be one of {', '.join(VARIANTS)}, got {variant!r}")
    defaults = {"width": source.width, "height": source.height, **VARIANTS[variant]}
    if variant in ALONE:
        defaults["teacher"] = "none"
    return BTFConfig(**{**defaults, **options})


def from_header(config: dict) -> BTFConfig:
    """Return the config of a stored model; how it was trained is not part of it."""
    coarse, fine = config["coarse"], config["fine"]
    return BTFConfig(
        width=config["width"], height=config["height"], mips=config["mips"],
        channels=fine["channels"], hidden=tuple(fine["hidden"]),
        coarse_channels=coarse["channels"] if coarse else 0,
        coarse=(*coarse["hidden"], coarse["latent"]) if coarse else (),
        half_vector=config["half_vector"], activation=config["activation"], features=config["features"], teacher="none",
    )  # fmt: skip
