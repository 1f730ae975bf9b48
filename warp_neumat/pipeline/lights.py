"""Point lights: where they stand, how bright they are, and the circles they may travel on.

Intensity is radiant intensity per channel [W/sr], linear Rec. 709, so a surface at distance d whose normal makes the
angle θ with the direction to the light receives the irradiance intensity · cos θ / d².
"""

import dataclasses
import math
import operator

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


@dataclasses.dataclass(frozen=True, eq=False)
class PointLights:
    """L point lights, at rest or on circles.

    Args:
        position: At frame 0, shape (L, 3) [scene unit].
        intensity: Linear Rec. 709, shape (L, 3) [W/sr].
        turns: Turns that each makes within ``frames`` frames, shape (L,); 0 rests. None: all rest.
        axis: What each turns around, right-handed, shape (L, 3), any length. None: +y.
        centre: A point on all axes, shape (3,).
        frames: Number of frames in ``turns``.
    """

    position: np.ndarray
    intensity: np.ndarray
    turns: np.ndarray | None = None
    axis: np.ndarray | None = None
    centre: np.ndarray | tuple = (0.0, 0.0, 0.0)
    frames: int = 1

    def __post_init__(self):
        count = len(self.position)
        shapes = {
            "position": (count, 3),
            "intensity": (count, 3),
            "turns": (count,),
            "axis": (count, 3),
            "centre": (3,),
        }
        rest = {"turns": np.zeros(count), "axis": np.tile([0.0, 1.0, 0.0], (count, 1))}
        for name, shape in shapes.items():
            value = getattr(self, name)
            value = np.array(rest[name] if value is None else value, dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {value.shape}")
            if not np.isfinite(value).all():
                raise ValueError(f"{name} must be finite")
            object.__setattr__(self, name, value)
        if (self.intensity < 0).any():
            raise ValueError("intensity must not be negative")
        length = np.linalg.norm(self.axis, axis=1, keepdims=True)
        if (length == 0).any():
            raise ValueError("axis must not be zero")
        object.__setattr__(self, "axis", self.axis / length)

    def __len__(self) -> int:
        return len(self.position)

    @property
    def animated(self) -> bool:
        """Whether any light moves."""
        return bool(self.turns.any())

    def at(self, frame: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and intensity at ``frame``, both (L, 3), float32, C-contiguous."""
        angle = (2.0 * math.pi * self.turns * frame / self.frames)[:, None]
        arm = self.position - self.centre
        along = self.axis * np.sum(arm * self.axis, axis=1, keepdims=True)
        turned = along + np.cos(angle) * (arm - along) + np.sin(angle) * np.cross(self.axis, arm)
        position = np.where(self.turns[:, None] == 0.0, self.position, self.centre + turned)
        return position.astype(np.float32), self.intensity.astype(np.float32)


def lights_from(spec, lo, hi, frames: int = 1) -> PointLights:
    """Return the lights that ``spec`` asks for.

    A whole number 1 … 16 gives that many default ones around the bounds: a warm key, a fill, a cool rim, and a ring
    of dim ones, four bounding radii from the centre. Intensities grow with the scene's size squared, so that a white
    Lambert surface that faces the key, one radius from the centre, has radiance 0.7 [W/m²/sr, luminance] from it.

    Anything else is a JSON file, its positions in scene units and its intensities in W/sr::

        {"lights": [{"position": [2, 3, 1], "intensity": 40, "color": [1, 0.9, 0.8],
                     "orbit": {"turns": 1, "axis": [0, 1, 0]}}, …]}

    ``color`` (linear Rec. 709, white by default) multiplies ``intensity``; ``orbit`` turns the light around an axis
    through the centre of the bounds, ``turns`` times within ``frames`` frames.

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
    position, intensity, turns, axis = [], [], [], []
    for k, entry in enumerate(entries):
        fields = Fields(entry, f"{path}: lights[{k}]", ("position", "intensity", "color", "orbit"))
        colour = fields.vector("color", [1.0, 1.0, 1.0])
        if (colour < 0).any():
            raise ValueError(f"{fields.name('color')} must not be negative, got {colour.tolist()}")
        position.append(fields.vector("position"))
        intensity.append(fields.number("intensity", low=0.0) * colour)
        orbit = Fields(entry.get("orbit", {}), f"{path}: lights[{k}].orbit", ("turns", "axis"))
        turns.append(orbit.number("turns", 1.0 if "orbit" in fields else 0.0))
        axis.append(orbit.vector("axis", [0.0, 1.0, 0.0]))
        if not axis[-1].any():
            raise ValueError(f"{orbit.name('axis')} must not be zero")
    return PointLights(position, intensity, np.array(turns), np.array(axis), centre, frames)
