"""Point lights and spots: where they stand, how bright they are, how far they reach, and the circles they travel on.

Intensity is radiant intensity per channel [W/sr], linear Rec. 709, so a surface at distance d whose normal makes the
angle θ with the direction to the light receives the irradiance intensity · cos θ / d². Range and cone of a spot
multiply it as glTF's KHR_lights_punctual says, by

    max(min(1 − (d / range)⁴, 1), 0)    and    clamp((cos γ − cos outer) / (cos inner − cos outer), 0, 1)²,

γ being the angle between the spot's axis and the direction from the light to the surface.
"""

import dataclasses
import math
import operator
from typing import NamedTuple

import numpy as np

from .camera import bounding_sphere
from .json_fields import Fields, load_json

LIGHTS_MAX = 16
"""Most lights of a default set."""

_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear Rec. 709

# Azimuth and elevation [degree] as in camera.orbit, share of the key's brightness, colour.
_DEFAULTS = (
    (65.0, 40.0, 1.0, (1.0, 0.93, 0.82)),  # key: warm, beside the camera's start
    (-15.0, 15.0, 0.35, (0.94, 0.97, 1.0)),  # fill: softens the key's shadow side
    (205.0, 45.0, 0.8, (0.75, 0.87, 1.0)),  # rim: cool, from behind
)
_DISTANCE = 4.0  # of a default light from the centre, in radii of the bounding sphere
_KEY_RADIANCE = 0.7
_EXTRAS = 0.6  # what all lights beyond the third add together, as a share of the key


_NARROWEST = 1e-6
"""Least cos inner − cos outer that a cone's falloff is computed with: float32 resolves no less."""


class LightState(NamedTuple):
    """L lights at one moment, float32, C-contiguous.

    Attributes:
        position: Shape (L, 3) [scene unit].
        intensity: Linear Rec. 709, shape (L, 3) [W/sr].
        range: Where light ends, shape (L,) [scene unit]; inf = nowhere.
        direction: Unit vector in which each shines, shape (L, 3).
        cones: Scale and offset of each cone, shape (L, 2): light in a direction that makes the angle γ with
            ``direction`` is multiplied by clamp(scale · cos γ + offset, 0, 1)²; (0, 1) = no spot.
    """

    position: np.ndarray
    intensity: np.ndarray
    range: np.ndarray
    direction: np.ndarray
    cones: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class PointLights:
    """L point lights and spots, at rest or on circles.

    Args:
        position: At frame 0, shape (L, 3) [scene unit].
        intensity: Linear Rec. 709, shape (L, 3) [W/sr].
        turns: Turns that each makes within ``frames`` frames, shape (L,); 0 rests. None: all rest.
        axis: What each turns around, right-handed, shape (L, 3), any length. None: +y.
        centre: A point on all axes, shape (3,).
        frames: Number of frames in ``turns``.
        range: Where each light ends, shape (L,) [scene unit], inf = nowhere. None: nowhere.
        direction: The way each spot shines at frame 0, shape (L, 3), any length; it turns with its light. None: −y.
        inner: Half the angle of the cone that has full light, shape (L,) [radian], 0 ≤ inner < outer. None: 0.
        outer: Half the angle of the cone outside which there is none, shape (L,) [radian], at most π/2; π = no spot.
            None: no spot.

    Raises:
        ValueError: If a shape or a value breaks one of these rules.
    """

    position: np.ndarray
    intensity: np.ndarray
    turns: np.ndarray | None = None
    axis: np.ndarray | None = None
    centre: np.ndarray | tuple = (0.0, 0.0, 0.0)
    frames: int = 1
    range: np.ndarray | None = None
    direction: np.ndarray | None = None
    inner: np.ndarray | None = None
    outer: np.ndarray | None = None

    def __post_init__(self):
        count = len(self.position)
        shapes = {
            "position": (count, 3),
            "intensity": (count, 3),
            "turns": (count,),
            "axis": (count, 3),
            "centre": (3,),
            "range": (count,),
            "direction": (count, 3),
            "inner": (count,),
            "outer": (count,),
        }
        rest = {
            "turns": np.zeros(count),
            "axis": np.tile([0.0, 1.0, 0.0], (count, 1)),
            "range": np.full(count, np.inf),
            "direction": np.tile([0.0, -1.0, 0.0], (count, 1)),
            "inner": np.zeros(count),
            "outer": np.full(count, math.pi),
        }
        for name, shape in shapes.items():
            value = getattr(self, name)
            value = np.array(rest[name] if value is None else value, dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {value.shape}")
            if name != "range" and not np.isfinite(value).all():
                raise ValueError(f"{name} must be finite")
            object.__setattr__(self, name, value)
        if (self.intensity < 0).any():
            raise ValueError("intensity must not be negative")
        if not (self.range > 0).all():
            raise ValueError("range must be more than 0, or inf for light without end")
        if not ((self.inner >= 0) & (self.inner < self.outer)).all():
            raise ValueError("inner must be at least 0 and less than outer")
        if not ((self.outer <= 0.5 * math.pi) | (self.outer == math.pi)).all():
            raise ValueError("outer must be at most π/2, or π for a light that is no spot")
        for name in ("axis", "direction"):
            length = np.linalg.norm(getattr(self, name), axis=1, keepdims=True)
            if (length == 0).any():
                raise ValueError(f"{name} must not be zero")
            object.__setattr__(self, name, getattr(self, name) / length)

    def __len__(self) -> int:
        return len(self.position)

    @property
    def animated(self) -> bool:
        """Whether any light moves."""
        return bool(self.turns.any())

    def at(self, frame: float) -> LightState:
        """Return the lights at ``frame``."""
        position = np.where(
            self.turns[:, None] == 0.0, self.position, self.centre + self._turned(self.position - self.centre, frame)
        )
        direction = np.where(self.turns[:, None] == 0.0, self.direction, self._turned(self.direction, frame))
        spot = self.outer < math.pi
        scale = spot / np.maximum(np.cos(self.inner) - np.cos(self.outer), _NARROWEST)
        offset = np.where(spot, -scale * np.cos(self.outer), 1.0)
        state = (position, self.intensity, self.range, direction, np.stack([scale, offset], axis=1))
        return LightState(*(np.ascontiguousarray(a, np.float32) for a in state))

    def _turned(self, vectors: np.ndarray, frame: float) -> np.ndarray:
        """Return each light's vector as turned about its axis at ``frame``."""
        angle = (2.0 * math.pi * self.turns * frame / self.frames)[:, None]
        along = self.axis * np.sum(vectors * self.axis, axis=1, keepdims=True)
        return along + np.cos(angle) * (vectors - along) + np.sin(angle) * np.cross(self.axis, vectors)


def lights_from(spec, lo, hi, frames: int = 1) -> PointLights:
    """Return the lights that ``spec`` asks for.

    A whole number 1 … 16 gives that many default ones around the bounds: a warm key, a fill, a cool rim, and a ring
    of dim ones, four bounding radii from the centre. Intensities grow with the scene's size squared, so that a white
    Lambert surface that faces the key, one radius from the centre, has radiance 0.7 [W/m²/sr, luminance] from it.

    Anything else is a JSON file, its positions in scene units and its intensities in W/sr::

        {"lights": [{"position": [2, 3, 1], "intensity": 40, "color": [1, 0.9, 0.8],
                     "orbit": {"turns": 1, "axis": [0, 1, 0]}, "range": 8,
                     "spot": {"target": [0, 1, 0], "inner": 20, "outer": 30}}, …]}

    ``color`` (linear Rec. 709, white by default) multiplies ``intensity``; ``orbit`` turns the light around an axis
    through the centre of the bounds, ``turns`` times within ``frames`` frames. Light ends at ``range`` (scene units;
    without it, nowhere). A ``spot`` shines in a ``direction`` or at a ``target`` where it stands in frame 0, and turns
    with its orbit; ``inner`` and ``outer`` are half the angles of its cone in degrees, 0 and 45 by default.

    Args:
        spec: Number of lights, as int or text, or a path.
        lo: Lower corner of the bounds of all frames, shape (3,).
        hi: Upper corner, shape (3,).
        frames: Number of frames that will be rendered.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If the number or a field breaks a rule; names file, field and rule.
    """
    centre, radius = bounding_sphere(lo, hi)
    if frames < 1:
        raise ValueError(f"frames must be at least 1, got {frames}")
    count = _count(spec)
    if count is None:
        return _from_file(spec, centre, frames)
    if not 1 <= count <= LIGHTS_MAX:
        raise ValueError(f"lights must be 1 to {LIGHTS_MAX} default lights or a JSON file, got {spec}")
    return _defaults(count, centre, radius)


def _count(spec) -> int | None:
    text = str(spec)
    if text.lstrip("+-").isdecimal():
        return int(text)
    try:
        return operator.index(spec)
    except TypeError:
        return None


def _defaults(count: int, centre: np.ndarray, radius: float) -> PointLights:
    extra = max(0, count - len(_DEFAULTS))
    golden = math.degrees(math.pi * (3.0 - math.sqrt(5.0)))  # spreads any number of azimuths evenly
    ring = [(110.0 + golden * k, 30.0 - 45.0 * (k % 2), _EXTRAS / extra, (1.0, 1.0, 1.0)) for k in range(extra)]
    position, intensity = [], []
    for azimuth, elevation, share, colour in (*_DEFAULTS, *ring)[:count]:
        a, e = math.radians(azimuth), math.radians(elevation)
        direction = np.array([math.cos(e) * math.sin(a), math.sin(e), math.cos(e) * math.cos(a)])
        position.append(centre + _DISTANCE * radius * direction)
        # Radiance of a white Lambert surface that faces the light from d away: intensity / (π d²).
        power = share * _KEY_RADIANCE * math.pi * ((_DISTANCE - 1.0) * radius) ** 2
        intensity.append(power * np.array(colour) / (_LUMINANCE @ colour))
    return PointLights(np.array(position), np.array(intensity), centre=centre)


def _from_file(path, centre: np.ndarray, frames: int) -> PointLights:
    entries = Fields(load_json(path), str(path), ("lights",)).items("lights")
    columns: dict[str, list] = {name: [] for name in ("position", "intensity", "turns", "axis", "range", *_NO_SPOT)}
    for k, entry in enumerate(entries):
        fields = Fields(entry, f"{path}: lights[{k}]", ("position", "intensity", "color", "orbit", "range", "spot"))
        colour = fields.vector("color", [1.0, 1.0, 1.0])
        if (colour < 0).any():
            raise ValueError(f"{fields.name('color')} must not be negative, got {colour.tolist()}")
        orbit = Fields(entry.get("orbit", {}), f"{path}: lights[{k}].orbit", ("turns", "axis"))
        light = {
            "position": fields.vector("position"),
            "intensity": fields.number("intensity", low=0.0) * colour,
            "turns": orbit.number("turns", 1.0 if "orbit" in fields else 0.0),
            "axis": orbit.vector("axis", [0.0, 1.0, 0.0]),
            "range": fields.number("range", math.inf, low=0.0, open_low=True),
        }
        if not np.any(light["axis"]):
            raise ValueError(f"{orbit.name('axis')} must not be zero")
        light |= _spot(entry["spot"], f"{path}: lights[{k}].spot", light["position"]) if "spot" in fields else _NO_SPOT
        for name, value in light.items():
            columns[name].append(value)
    return PointLights(centre=centre, frames=frames, **{name: np.array(values) for name, values in columns.items()})


_NO_SPOT = {"direction": (0.0, -1.0, 0.0), "inner": 0.0, "outer": math.pi}


def _spot(value, where: str, position: np.ndarray) -> dict:
    """Return direction and cone of a spot at ``position``."""
    fields = Fields(value, where, ("direction", "target", "inner", "outer"))
    if ("direction" in fields) == ("target" in fields):
        raise ValueError(f"{where} must have either direction or target")
    if "target" in fields:
        direction = fields.vector("target") - position
        if not direction.any():
            raise ValueError(f"{fields.name('target')} must not be the light's own position")
    else:
        direction = fields.vector("direction")
        if not direction.any():
            raise ValueError(f"{fields.name('direction')} must not be zero")
    outer = fields.number("outer", 45.0, low=0.0, high=90.0, open_low=True)
    inner = fields.number("inner", 0.0, low=0.0, high=90.0)
    if inner >= outer:
        raise ValueError(f"{fields.name('inner')} must be less than outer, {outer:g} degrees, got {inner:g}")
    return {"direction": direction, "inner": math.radians(inner), "outer": math.radians(outer)}
