"""Procedural micro-geometry: periodic height fields with what their surface reflects.

Every pattern is a function of its parameters and a seed, drawn with row 0 on top and repeating in both directions.
Lengths in parameters are in units of the pattern (a thread's spacing, a pebble's size), heights in the result in
texels, so that a slope does not depend on the resolution.
"""

from __future__ import annotations

import dataclasses
import inspect
import urllib.parse

import numpy as np

from warp_neumat.io.brdf_source import suggest

from .periodic_noise import band_noise, cells, grid, sampled, smoothstep


@dataclasses.dataclass(frozen=True)
class MicroGeometry:
    """A periodic height field and the GGX-like micro-BRDF of its surface; arrays float32, row 0 on top."""

    name: str
    height: np.ndarray
    """Height [texel], (H, W)."""
    albedo: np.ndarray
    """Diffuse albedo in [0, 1], linear Rec. 709, (H, W, 3)."""
    roughness: np.ndarray
    """Perceptual roughness in [0.05, 1], (H, W); α = roughness²."""
    f0: np.ndarray
    """Specular reflectance at normal incidence in [0, 1], (H, W)."""
    anisotropy: np.ndarray
    """0: the highlight is round; towards 1 it stretches across the fibre. (H, W), in [0, 1)."""
    fibre: np.ndarray
    """Direction of the fibre from +x (along u) towards +y (up in the picture) [rad], (H, W)."""

    def __post_init__(self):
        shape = np.shape(self.height)
        if len(shape) != 2 or min(shape) < 1:
            raise ValueError(f"{self.name}: height must have shape (H, W), got {shape}")
        ranges = {
            "height": (-1e4, 1e4), "albedo": (0, 1), "roughness": (0.05, 1), "f0": (0, 1),
            "anisotropy": (0, 0.999), "fibre": (-100, 100),
        }  # fmt: skip
        for name, (low, high) in ranges.items():
            value = np.ascontiguousarray(getattr(self, name), np.float32)
            want = (*shape, 3) if name == "albedo" else shape
            if value.shape != want:
                raise ValueError(f"{self.name}: {name} must have shape {want}, got {value.shape}")
            if not ((value >= np.float32(low)) & (value <= np.float32(high))).all():
                raise ValueError(f"{self.name}: {name} must lie in [{low}, {high}] everywhere")
            object.__setattr__(self, name, value)

    @property
    def alpha(self) -> np.ndarray:
        """GGX widths along and across the fibre, (H, W, 2); the aspect is that of Disney's principled BRDF."""
        aspect = np.sqrt(1.0 - 0.9 * self.anisotropy)
        return np.stack([self.roughness**2 * aspect, self.roughness**2 / aspect], -1)

    def rolled(self, rows: int, columns: int) -> MicroGeometry:
        """Return the same surface with its period begun elsewhere, as ``numpy.roll`` moves a picture."""
        arrays = {f.name: np.roll(getattr(self, f.name), (rows, columns), (0, 1)) for f in dataclasses.fields(self)[1:]}
        return dataclasses.replace(self, **arrays)


def _surface(name, height, albedo, roughness, f0, anisotropy=0.0, fibre=0.0) -> MicroGeometry:
    shape = height.shape
    full = lambda x: np.broadcast_to(np.asarray(x, np.float64), shape)  # noqa: E731
    return MicroGeometry(
        name, height - height.mean(), np.clip(np.broadcast_to(albedo, (*shape, 3)), 0.0, 1.0),
        np.clip(full(roughness), 0.05, 1.0), np.clip(full(f0), 0.0, 1.0), full(anisotropy), full(fibre),
    )  # fmt: skip


def _shade(color, amount) -> np.ndarray:
    """Return ``color`` times a field (H, W), as (H, W, 3)."""
    return np.asarray(color, np.float64) * np.asarray(amount)[..., None]


def weave(
    size=128, seed=0, threads=8, relief=0.3, twill=0, fibres=7, fuzz=0.5, shine=0.6,
    warp=(0.03, 0.06, 0.30), weft=(0.62, 0.50, 0.30),
) -> MicroGeometry:  # fmt: skip
    """Return woven cloth: yarns of twisted fibres that pass over and under each other, in two colours.

    Args:
        size: Texels along both sides.
        seed: Of the random fields.
        threads: Yarns along both sides, warp (along v) and weft (along u) each; a multiple of 4 for twill, else of 2.
        relief: How far a yarn rises and sinks, in spacings.
        twill: 0 plain weave, 1 the diagonal ribs of a 2/2 twill.
        fibres: Fibres across a yarn.
        fuzz: Irregularity of yarns and fibres, 0 to 1.
        shine: How smooth the fibres are, 0 cotton to 1 silk.
        warp, weft: Albedo of the yarns, R,G,B.
    """
    period = 4 if twill else 2
    if threads % period:
        raise ValueError(f"weave: threads must be a multiple of {period}{' for twill' if twill else ''}, got {threads}")
    rng = np.random.default_rng((seed, 1))
    u, v = grid(size)
    spacing = size / threads
    wobble = [0.05 * fuzz * band_noise(rng, size, threads / 2) for _ in range(2)]
    tint = rng.uniform(-0.12, 0.12, (2, threads)) * fuzz
    slub = band_noise(rng, size, threads / 2, octaves=3)
    strands = band_noise(rng, size, threads * fibres / 3)

    def yarns(along, across, wobbling, sign, mirrored):
        """Yarns of one direction: height, direction of the fibres, number, and the fibre pattern."""
        across = across * threads + wobbling
        along = along * threads
        number = np.floor(across).astype(np.int64) % threads
        local = 2.0 * (across - np.floor(across)) - 1.0  # −1 … 1 over the spacing
        cross = np.floor(along - 0.5).astype(np.int64)
        t = along - 0.5 - cross
        over = [np.where(_over(number, (cross + k) % threads, twill, mirrored), 1.0, -1.0) * sign for k in (0, 1)]
        wave = over[0] + (over[1] - over[0]) * (0.5 - 0.5 * np.cos(np.pi * t))
        radius = 0.94 + 0.05 * fuzz * slub
        dome = np.sqrt(np.clip(1.0 - (local / radius) ** 2, 0.0, 1.0))
        # Fibres wind about the yarn: on the visible half they run askew by the twist.
        phase = fibres * np.arcsin(np.clip(local / radius, -1.0, 1.0)) / np.pi + along * 1.1
        ply = 0.5 + 0.5 * np.cos(2.0 * np.pi * phase + 0.9 * fuzz * strands)
        height = 0.5 * relief * wave + 0.42 * dome + 0.055 * ply * dome
        return np.where(np.abs(local) < radius, height, -1.0), number, ply, dome

    u2, v2 = np.broadcast_arrays(u, v)
    warp_h, warp_n, warp_ply, warp_dome = yarns(v2, u2, wobble[0], 1.0, False)
    weft_h, weft_n, weft_ply, weft_dome = yarns(u2, v2, wobble[1], -1.0, True)
    top = warp_h >= weft_h
    ply, dome = np.where(top, warp_ply, weft_ply), np.where(top, warp_dome, weft_dome)
    gap = np.maximum(warp_h, weft_h) <= -1.0
    height = np.where(gap, -0.5 * relief - 0.1, np.maximum(warp_h, weft_h)) * spacing
    height += 0.03 * fuzz * spacing * strands * dome
    brightness = (0.72 + 0.28 * ply) * (0.8 + 0.2 * dome) * np.where(gap, 0.25, 1.0) * (1.0 + 0.08 * fuzz * slub)
    albedo = np.where(
        top[..., None],
        _shade(warp, brightness * (1 + tint[0][warp_n])),
        _shade(weft, brightness * (1 + tint[1][weft_n])),
    )
    angle = np.where(top, 0.5 * np.pi, 0.0) + 0.3
    rough = np.where(gap, 0.9, 0.8 - 0.42 * shine + 0.05 * strands)
    return _surface(
        "weave", height, albedo, np.clip(rough, 0.2, 0.95), 0.045, np.where(gap, 0.0, 0.35 + 0.4 * shine), angle
    )


def _over(yarn, crossing, twill, mirrored):
    """Return whether the warp lies on top where these yarns cross."""
    i, j = (crossing, yarn) if mirrored else (yarn, crossing)
    return (i + j) % 4 < 2 if twill else (i + j) % 2 == 0


def leather(
    size=128, seed=0, pebbles=14, relief=0.24, wrinkles=0.6, pores=0.5, polish=0.5, color=(0.46, 0.20, 0.085)
) -> MicroGeometry:
    """Return grained leather: pebbles of two sizes between creases, crossed by wrinkles, with pores.

    Args:
        size: Texels along both sides.
        seed: Of the random fields.
        pebbles: Pebbles along both sides.
        relief: Depth of the creases, in pebbles.
        wrinkles: Depth of the wrinkles, 0 to 1.
        pores: Depth of the pores, 0 to 1.
        polish: How smooth the pebbles are worn, 0 to 1.
        color: Albedo, R,G,B.
    """
    rng = np.random.default_rng((seed, 2))
    u, v = np.broadcast_arrays(*grid(size))
    bend = [band_noise(rng, size, pebbles / 3, octaves=2) * 0.16 / pebbles for _ in range(2)]
    d1, d2, number = cells(rng, u + bend[0], v + bend[1], pebbles, max(2, round(pebbles * 0.8)))
    e1, e2, _ = cells(rng, u + 2 * bend[1], v + 2 * bend[0], 2 * pebbles)
    gap = d2 - d1
    edge = smoothstep(-0.05, 0.42, gap)
    edge = edge * (2.0 - edge)  # round shoulders that fall steeply into a narrow crease
    fine = smoothstep(0.0, 0.4, e2 - e1)
    ridge = band_noise(rng, size, 3.0, 1.5, octaves=2)
    wrinkle = np.exp(-((ridge / 0.16) ** 2)) * wrinkles * smoothstep(-0.5, 1.0, band_noise(rng, size, 2.0))
    p1, _, pit = cells(rng, u, v, 2 * pebbles)
    pore = (1.0 - smoothstep(0.04, 0.2, p1)) * pores * (rng.random(4 * pebbles**2)[pit] < 0.35) * edge
    level = rng.normal(0.0, 0.10, number.max() + 1)[number]
    height = edge * (0.8 + 0.18 * np.minimum(gap, 1.0) + level * edge) + 0.07 * fine * edge - 0.5 * wrinkle - 0.4 * pore
    grain = band_noise(rng, size, size / 6.0)
    height = (height + 0.012 * grain) * relief * size / pebbles
    patina = 1.0 + 0.12 * band_noise(rng, size, 2.5, octaves=3)
    brightness = (0.4 + 0.6 * edge * (0.85 + 0.15 * fine)) * (1.0 - 0.45 * wrinkle) * (1.0 - 0.5 * pore) * patina
    rough = 0.72 - 0.5 * polish * edge * (0.8 + 0.2 * fine) + 0.2 * wrinkle + 0.03 * grain
    return _surface("leather", height, _shade(color, brightness), np.clip(rough, 0.22, 0.95), 0.05)


def carpet(
    size=128, seed=0, tufts=10, relief=0.6, strands=6, lean=0.5, color=(0.72, 0.20, 0.13), accent=(0.20, 0.24, 0.55)
) -> MicroGeometry:
    """Return a cut-pile carpet: tufts of twisted strands that lean, with deep gaps, in two colours.

    Args:
        size: Texels along both sides.
        seed: Of the random fields.
        tufts: Tufts along both sides.
        relief: Height of the pile, in spacings of the tufts.
        strands: Strands across a tuft.
        lean: How far the strands lean over, 0 to 1.
        color, accent: Albedo of most tufts and of the others, R,G,B.
    """
    rng = np.random.default_rng((seed, 3))
    u, v = np.broadcast_arrays(*grid(size))
    bend = [band_noise(rng, size, tufts, octaves=2) * 0.10 / tufts for _ in range(2)]
    d1, d2, number = cells(rng, u + bend[0], v + bend[1], tufts, jitter=0.45)
    body = np.sqrt(np.clip(1.0 - (d1 / 0.8) ** 2, 0.0, 1.0)) * smoothstep(-0.1, 0.25, d2 - d1)
    count = tufts * tufts
    lean_u, lean_v = (lean * rng.normal(0.35, 0.5, count)[number] / (tufts * strands) for _ in range(2))
    s1, s2, strand = cells(rng, u + lean_u * body * 2, v + lean_v * body * 2, tufts * strands)
    tip = np.clip(1.0 - (s1 / 0.75) ** 2, 0.0, 1.0)
    tall = rng.normal(0.0, 0.13, (tufts * strands) ** 2)[strand]
    height = body * (0.6 + 0.06 * rng.normal(size=count)[number] + 1.2 * tall) + (0.15 + 0.3 * body) * tip
    height *= relief * size / tufts
    deep = smoothstep(0.05, 0.85, height / (relief * size / tufts))
    mix = (rng.random(count) < 0.28).astype(np.float64)[number]
    shade = (1.0 + 0.16 * rng.normal(size=count))[number] * (1.0 + 0.14 * rng.normal(size=(tufts * strands) ** 2))[
        strand
    ]
    brightness = (0.35 + 0.65 * deep) * np.clip(shade, 0.4, 1.3) * (0.75 + 0.25 * tip)
    albedo = _shade(color, brightness * (1 - mix)) + _shade(accent, brightness * mix)
    angle = rng.uniform(0.0, np.pi, count)[number]
    return _surface("carpet", height, albedo, 0.62 + 0.2 * (1 - tip), 0.04, 0.5 * tip, angle)


def wood(
    size=128, seed=0, rings=7, figure=0.5, pores=0.6, relief=0.5, gloss=0.6,
    light=(0.50, 0.29, 0.13), dark=(0.19, 0.085, 0.035),
) -> MicroGeometry:  # fmt: skip
    """Return planed wood: growth rings, open pores, and fibres whose gloss swings with their direction.

    Args:
        size: Texels along both sides.
        seed: Of the random fields.
        rings: Growth rings along u; the grain runs along v.
        figure: How far rings and fibres wave, 0 to 1.
        pores: Depth and number of the pores, 0 to 1.
        relief: Height between early and late wood, in hundredths of the side.
        gloss: How smooth the surface is, 0 to 1.
        light, dark: Albedo of early and of late wood, R,G,B.
    """
    rng = np.random.default_rng((seed, 4))
    u, v = np.broadcast_arrays(*grid(size))
    wave = band_noise(rng, size, 1.6, 0.7)
    drift = band_noise(rng, size, rings, 1.0)
    phase = rings * u + (0.8 * wave + 0.10 * drift) * figure
    turn = phase - np.floor(phase)
    late = smoothstep(0.25, 0.88, turn) * (1.0 - smoothstep(0.93, 1.0, turn))
    fibre = band_noise(rng, size, size / 4.0, size / 40.0)
    streak = band_noise(rng, size, size / 12.0, 1.5)
    # Pores are vessels cut lengthwise: short grooves along the grain, most of them in early wood.
    across, down = max(4, round(size / 3.2)), max(2, round(size / 26))
    p1, _, number = cells(rng, u + 0.02 * figure * sampled(wave, u, v) / rings, v, across, down, jitter=1.0)
    open_ = rng.random(across * down)[number] < (0.05 + 0.4 * (1.0 - late)) * pores
    groove = (1.0 - smoothstep(0.10, 0.36, p1)) * open_ * pores
    unit = relief * size / 100.0
    height = unit * (late + 0.25 * streak) + 0.07 * fibre * (1.0 - 0.5 * gloss) - 1.3 * groove
    shade = (1.0 + 0.10 * streak + 0.10 * fibre) * (1.0 - 0.62 * groove)
    albedo = _shade(light, shade * (1 - late)) + _shade(dark, shade * late)
    swing = band_noise(rng, size, 1.2, 2.5, octaves=2)
    slope = np.gradient(np.tile(wave, (3, 1)), axis=0)[size : 2 * size] * size / rings * 0.9 * figure
    angle = 0.5 * np.pi + 0.35 * figure * swing + np.arctan(np.clip(slope * 0.15, -0.6, 0.6))
    rough = 0.58 - 0.28 * gloss + 0.10 * late + 0.3 * groove + 0.02 * fibre
    return _surface("wood", height, albedo, np.clip(rough, 0.16, 0.9), 0.05, 0.75 * (1.0 - groove), angle)


def stone(
    size=128, seed=0, grains=16, relief=0.35, cracks=0.6, mica=0.3, color=(0.45, 0.42, 0.38), vein=(0.16, 0.15, 0.16)
) -> MicroGeometry:
    """Return rough-hewn stone: tilted grains of several minerals, cracks, and flakes that glint.

    Args:
        size: Texels along both sides.
        seed: Of the random fields.
        grains: Grains along both sides.
        relief: Height between grains, in grains.
        cracks: Depth of the cracks, 0 to 1.
        mica: Share of glinting grains, 0 to 1.
        color, vein: Albedo of light and dark grains, R,G,B.
    """
    rng = np.random.default_rng((seed, 5))
    u, v = np.broadcast_arrays(*grid(size))
    bend = [band_noise(rng, size, grains, octaves=2) * 0.2 / grains for _ in range(2)]
    d1, d2, number = cells(rng, u + bend[0], v + bend[1], grains)
    count = grains * grains
    rough_field = band_noise(rng, size, 3.0, octaves=5)
    ridge = band_noise(rng, size, 2.0, octaves=3)
    crack = np.exp(-((ridge / 0.07) ** 2)) * cracks
    flat = rng.random(count)[number]
    height = 0.45 * rough_field + 0.8 * flat * smoothstep(0.0, 0.3, d2 - d1) - 1.4 * crack
    height += 0.06 * band_noise(rng, size, size / 6.0)
    height *= relief * size / grains
    glint = (rng.random(count) < mica)[number] * smoothstep(0.05, 0.2, d2 - d1)
    mix = (rng.random(count) < 0.4)[number] * 0.9
    shade = (1.0 + 0.18 * rng.normal(size=count))[number] * (1.0 - 0.6 * crack) * (1.0 + 0.08 * rough_field)
    albedo = _shade(color, shade * (1 - mix)) + _shade(vein, shade * mix)
    return _surface("stone", height, albedo, np.clip(0.75 - 0.45 * glint, 0.2, 0.95), 0.04 + 0.06 * glint)


PATTERNS = {f.__name__: f for f in (weave, leather, carpet, wood, stone)}
"""Patterns by name."""

_RANGES = {
    "size": (16, 1024), "seed": (0, 2**31 - 1), "threads": (2, 256), "pebbles": (2, 128), "tufts": (2, 128),
    "rings": (1, 64), "grains": (2, 128), "fibres": (1, 32), "strands": (1, 16), "twill": (0, 1), "relief": (0.0, 2.0),
}  # fmt: skip
_DEFAULT_RANGE = (0.0, 1.0)


def make_pattern(name: str, **parameters) -> MicroGeometry:
    """Return the micro-geometry of a pattern.

    Raises:
        ValueError: If pattern or parameter is unknown, or a value lies outside its range; one line, with the nearest
            name or the range.
    """
    if name not in PATTERNS:
        raise ValueError(f"no micro-geometry {name!r}; {suggest(name, PATTERNS)}")
    known = inspect.signature(PATTERNS[name]).parameters
    for key, value in parameters.items():
        if key not in known:
            raise ValueError(f"{name} has no parameter {key!r}; {suggest(key, known)}")
        default = known[key].default
        low, high = _RANGES.get(key, _DEFAULT_RANGE)
        form = {int: "a whole number", float: "a number", tuple: "R,G,B"}[type(default)]
        numbers = value if isinstance(value, tuple) else (value,)
        fits = all(isinstance(x, (int, float)) and low <= x <= high for x in numbers)
        if len(numbers) != (3 if isinstance(default, tuple) else 1) or not fits:
            raise ValueError(f"{name}: {key} must be {form} in [{low}, {high}], got {value!r}")
        if isinstance(default, int) and value != int(value):
            raise ValueError(f"{name}: {key} must be a whole number in [{low}, {high}], got {value!r}")
    cast = {k: int(v) if isinstance(known[k].default, int) else v for k, v in parameters.items()}
    return PATTERNS[name](**cast)


def parse_query(spec: str, query: str) -> dict:
    """Return ``KEY=VALUE&…`` as numbers and triples of numbers.

    Raises:
        ValueError: If a key comes twice, or a value is no number.
    """
    found = {}
    for part in filter(None, query.split("&")):
        key, equals, text = part.partition("=")
        if not equals or key in found:
            raise ValueError(f"{spec}: parameter {key!r} must be given once, as {key}=VALUE")
        try:
            numbers = tuple(_number(t) for t in urllib.parse.unquote(text).split(","))
        except ValueError:
            raise ValueError(f"{spec}: {key} must be a number or R,G,B, got {text!r}") from None
        found[key] = numbers if len(numbers) > 1 else numbers[0]
    return found


def _number(text: str) -> float:
    """Return a number, whole ones as int, so that messages show them as they were written."""
    number = float(text)
    return int(number) if number.is_integer() else number
