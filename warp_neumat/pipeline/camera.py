"""Cameras and the paths they take.

Frames: a view matrix takes world points (column vectors) to camera space, x right, y up, looking down −z. Clip space
is x right, y up, z/w in [0, 1] from near to far, and w is the view depth [scene unit]. Picture coordinates are in
pixels, x to the right and y down from the top left corner; pixel i is centred at i + 0.5.
"""

import abc
import dataclasses
import math

import numpy as np

from .json_fields import Fields, load_json


@dataclasses.dataclass(frozen=True, eq=False)
class Camera:
    """A perspective camera.

    Args:
        view: World → camera, shape (4, 4), float64, rigid.
        fov_y: Vertical field of view [rad], in (0, π).
        width: Picture width [px].
        height: Picture height [px].
        near: View depth of the near plane [scene unit], above 0.
        far: View depth of the far plane [scene unit], above ``near``.
    """

    view: np.ndarray
    fov_y: float
    width: int
    height: int
    near: float
    far: float

    def __post_init__(self):
        object.__setattr__(self, "view", np.array(self.view, dtype=np.float64))
        if self.view.shape != (4, 4):
            raise ValueError(f"view must have shape (4, 4), got {self.view.shape}")
        if not np.isfinite(self.view).all():
            raise ValueError("view must be finite")
        if not 0 < self.fov_y < math.pi:
            raise ValueError(f"fov_y must be in (0, pi) radians, got {self.fov_y:g}")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"the picture must have at least one pixel, got {self.width}x{self.height}")
        if not 0 < self.near < self.far < math.inf:
            raise ValueError(f"near and far must hold 0 < near < far, got {self.near:g} and {self.far:g}")

    @classmethod
    def look_at(cls, eye, target, up=(0.0, 1.0, 0.0), *, fov_y: float, width: int, height: int, near=None, far=None):
        """Return the camera at ``eye`` that sees ``target`` in the middle of its picture and ``up`` pointing up.

        ``near`` and ``far`` default to a hundredth and a hundred times the distance between the two.

        Raises:
            ValueError: If eye and target coincide, ``up`` is zero or parallel to the view, or a number is not finite.
        """
        eye, target, up = (np.asarray(v, dtype=np.float64) for v in (eye, target, up))
        for name, v in (("eye", eye), ("target", target), ("up", up)):
            if v.shape != (3,) or not np.isfinite(v).all():
                raise ValueError(f"{name} must be three finite numbers, got {v.tolist()}")
        back = eye - target
        distance = np.linalg.norm(back)
        if distance <= 1e-12 * max(1.0, np.abs(eye).max()):
            raise ValueError(f"eye and target must differ, both are {eye.tolist()}")
        back = back / distance
        right = np.cross(up, back)
        if np.linalg.norm(right) <= 1e-6 * np.linalg.norm(up):
            raise ValueError(f"up must not be zero or parallel to the view direction, got {up.tolist()}")
        right = right / np.linalg.norm(right)
        view = np.eye(4)
        view[:3, :3] = right, np.cross(back, right), back
        view[:3, 3] = -view[:3, :3] @ eye
        near = 0.01 * distance if near is None else near
        far = 100.0 * distance if far is None else far
        return cls(view, float(fov_y), int(width), int(height), float(near), float(far))

    @property
    def eye(self) -> np.ndarray:
        """World position of the camera, shape (3,), float64."""
        return -self.view[:3, :3].T @ self.view[:3, 3]

    def moved(self, right: float) -> "Camera":
        """Return the camera that far to the right [scene unit], looking the same way; negative is to the left."""
        view = self.view.copy()
        view[0, 3] -= right
        return dataclasses.replace(self, view=view)

    def pixel_steps(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the unit view direction, and what one pixel to the right and one down add to a ray of view depth 1."""
        step = 2.0 * math.tan(0.5 * self.fov_y) / self.height
        right, up, back = self.view[:3, :3]
        return -back, step * right, -step * up

    def clip(self) -> np.ndarray:
        """Return world → clip, shape (4, 4), float32, for column vectors."""
        scale = 1.0 / math.tan(0.5 * self.fov_y)
        depth = self.far / (self.far - self.near)
        projection = np.array(
            [
                [scale * self.height / self.width, 0.0, 0.0, 0.0],
                [0.0, scale, 0.0, 0.0],
                [0.0, 0.0, -depth, -depth * self.near],
                [0.0, 0.0, -1.0, 0.0],
            ]
        )
        return (projection @ self.view).astype(np.float32)

    def ray(self, x, y) -> tuple[np.ndarray, np.ndarray]:
        """Return origin (3,) and unit directions (…, 3) in world space through the picture points (x, y) [px]."""
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        half = math.tan(0.5 * self.fov_y)
        direction = np.empty((*x.shape, 3))
        direction[..., 0] = (2.0 * x / self.width - 1.0) * half * self.width / self.height
        direction[..., 1] = (1.0 - 2.0 * y / self.height) * half
        direction[..., 2] = -1.0
        direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
        return self.eye, direction @ self.view[:3, :3]


class CameraPath(abc.ABC):
    """A camera for every frame; :class:`OrbitPath` and :class:`KeyPath` are the two kinds."""

    @abc.abstractmethod
    def at(self, frame: float) -> Camera:
        """Return the camera of ``frame``; fractions are allowed."""


def bounding_sphere(lo, hi) -> tuple[np.ndarray, float]:
    """Return centre (3,) and radius [scene unit] of the sphere around the box from corner ``lo`` to corner ``hi``."""
    lo, hi = np.asarray(lo, dtype=np.float64), np.asarray(hi, dtype=np.float64)
    if lo.shape != (3,) or hi.shape != (3,) or not np.isfinite([lo, hi]).all():
        raise ValueError(f"lo and hi must be three finite numbers each, got {lo.tolist()} and {hi.tolist()}")
    radius = 0.5 * float(np.linalg.norm(hi - lo))
    if radius == 0.0 or (hi < lo).any():
        raise ValueError(f"the bounds must have lo <= hi and some extent, got {lo.tolist()} and {hi.tolist()}")
    return 0.5 * (lo + hi), radius


def _planes(eye, centre, radius) -> tuple[float, float]:
    """Near and far planes that keep the sphere well inside, and depth precise."""
    distance = float(np.linalg.norm(eye - centre))
    far = distance + 2.0 * radius
    return max(0.5 * (distance - radius), 1e-3 * far), far


@dataclasses.dataclass(frozen=True, eq=False)
class OrbitPath(CameraPath):
    """A circle around a point; angles [rad]. Azimuth 0 is +z of a y-up scene, a quarter turn further is +x."""

    centre: np.ndarray
    radius: float
    distance: float
    frames: int
    turns: float
    elevation: float
    azimuth: float
    fov_y: float
    width: int
    height: int

    def at(self, frame: float) -> Camera:
        """Return the camera of ``frame``; frame ``frames`` is one whole path further than frame 0."""
        angle = self.azimuth + 2.0 * math.pi * self.turns * frame / self.frames
        level = math.cos(self.elevation)
        direction = np.array([level * math.sin(angle), math.sin(self.elevation), level * math.cos(angle)])
        eye = self.centre + self.distance * direction
        near, far = _planes(eye, self.centre, self.radius)
        lens = {"fov_y": self.fov_y, "width": self.width, "height": self.height}
        return Camera.look_at(eye, self.centre, near=near, far=far, **lens)


CALM = 1.0 / 240.0
"""Turns a frame of the default orbit: ten seconds a turn at 24 frames a second."""

_FILL = 0.95  # of the picture's width or height, by the default orbit


def _fitting_distance(points, centre, elevation: float, fill: float, aspect: float) -> float:
    """The nearest distance at which ``points`` lie within ``fill`` (× ``aspect``) of the axis, from all azimuths."""
    offset = np.asarray(points, np.float64) - centre
    angle = np.linspace(0.0, 2.0 * math.pi, 128, endpoint=False)
    level, height = math.cos(elevation) * np.ones_like(angle), math.sin(elevation)
    back = np.stack([level * np.sin(angle), height * np.ones_like(angle), level * np.cos(angle)], axis=1)
    right = np.stack([np.cos(angle), np.zeros_like(angle), -np.sin(angle)], axis=1)
    across, along = np.abs(right @ offset.T), back @ offset.T
    upward = np.abs(np.cross(back, right) @ offset.T)
    # A point is inside where across <= fill · aspect · (distance - along), and likewise upward.
    return float((along + np.maximum(across / (fill * aspect), upward / fill)).max())


def orbit(
    lo,
    hi,
    frames: int,
    *,
    width: int,
    height: int,
    turns: float | None = None,
    elevation: float = math.radians(15.0),
    azimuth: float = math.radians(35.0),
    distance: float | None = None,
    fov_y: float = math.radians(40.0),
    outline=None,
) -> OrbitPath:
    """Return a path around the box ``lo`` … ``hi`` (of all frames), ``turns`` times within ``frames`` frames.

    Args:
        lo: Lower corner of the scene's bounds, shape (3,).
        hi: Upper corner, shape (3,).
        frames: Length of the path, at least 1.
        width: Picture width [px].
        height: Picture height [px].
        turns: Whole or broken turns, counterclockwise seen from above; negative ones go the other way. By default one,
            but no faster than :data:`CALM` turns a frame.
        elevation: Angle above the horizon [rad], in (−π/2, π/2).
        azimuth: Where the path starts [rad].
        distance: From the centre [scene unit]; by default the nearest from which the outline, seen from any side,
            leaves a twentieth of the picture's width or height free.
        fov_y: Vertical field of view [rad].
        outline: Points that the picture should hold, shape (N, 3); by default the corners of the box.
    """
    centre, radius = bounding_sphere(lo, hi)
    if frames < 1:
        raise ValueError(f"frames must be at least 1, got {frames}")
    if turns is None:
        turns = min(1.0, CALM * frames)
    if not abs(elevation) < 0.5 * math.pi * 0.9999:
        raise ValueError(f"elevation must be between -90 and 90 degrees, got {math.degrees(elevation):g}")
    if distance is None:
        if outline is None:
            outline = np.array(np.meshgrid(*zip(lo, hi, strict=True))).reshape(3, 8).T  # the box's corners
        distance = _fitting_distance(outline, centre, elevation, _FILL * math.tan(0.5 * fov_y), width / height)
    if not 0 < distance < math.inf:
        raise ValueError(f"distance must be above 0, got {distance:g}")
    path = OrbitPath(centre, radius, distance, frames, turns, elevation, azimuth, fov_y, width, height)
    path.at(0)  # the camera checks the rest
    return path


@dataclasses.dataclass(frozen=True, eq=False)
class KeyPath(CameraPath):
    """Cameras at key frames and what lies between; before the first and after the last key the camera rests.

    ``values`` has shape (K, 10): eye, target, up, fov_y [rad]. Catmull-Rom means cubic Hermite pieces whose tangent
    at a key is the chord between its neighbours, in frames, so that keys need not be evenly spaced.
    """

    frames: np.ndarray
    values: np.ndarray
    smooth: bool
    centre: np.ndarray
    radius: float
    width: int
    height: int
    near: float | None = None
    far: float | None = None

    def at(self, frame: float) -> Camera:
        """Return the camera of ``frame``."""
        value = self._value(min(max(frame, self.frames[0]), self.frames[-1]))
        near, far = _planes(value[:3], self.centre, self.radius)
        near = near if self.near is None else self.near
        far = far if self.far is None else self.far
        lens = {"fov_y": float(value[9]), "width": self.width, "height": self.height}
        return Camera.look_at(value[:3], value[3:6], value[6:9], near=near, far=far, **lens)

    def _value(self, frame: float) -> np.ndarray:
        count = len(self.frames)
        if count == 1:
            return self.values[0]
        k = min(int(np.searchsorted(self.frames, frame, side="right")) - 1, count - 2)
        step = self.frames[k + 1] - self.frames[k]
        t = (frame - self.frames[k]) / step
        a, b = self.values[k], self.values[k + 1]
        if not self.smooth:
            return a + t * (b - a)
        ta, tb = (self._slope(i) * step for i in (k, k + 1))
        return a + t * (ta + t * (3.0 * (b - a) - 2.0 * ta - tb + t * (2.0 * (a - b) + ta + tb)))

    def _slope(self, k: int) -> np.ndarray:
        i, j = max(k - 1, 0), min(k + 1, len(self.frames) - 1)
        return (self.values[j] - self.values[i]) / (self.frames[j] - self.frames[i])


_POSE = ("eye", "target", "up", "fov_degrees")
_PLANES = ("near", "far")
_ORBIT = ("turns", "elevation_degrees", "azimuth_degrees", "distance", "fov_degrees")


def load_camera(spec, lo, hi, frames: int, *, width: int, height: int, outline=None) -> CameraPath:
    """Return the camera path that ``spec`` names: ``"orbit"``, or a JSON file.

    The file holds one of three things; everything but eye and target may be left out::

        {"eye": [0, 1, 3], "target": [0, 0.5, 0], "up": [0, 1, 0], "fov_degrees": 40}                   a camera at rest
        {"keys": [{"frame": 0, "eye": …, "target": …}, {"frame": 24, …}], "interpolation": "linear"}    or "catmull-rom"
        {"orbit": {"turns": 1, "elevation_degrees": 15, "azimuth_degrees": 35, "distance": 4, "fov_degrees": 40}}

    The first two also take ``near`` and ``far`` [scene unit], which by default follow from the bounds.

    Args:
        spec: ``"orbit"`` or a path.
        lo: Lower corner of the bounds of all frames, shape (3,).
        hi: Upper corner, shape (3,).
        frames: Number of frames that will be rendered; each is checked here, before the first one is rendered.
        width: Picture width [px].
        height: Picture height [px].
        outline: Points (N, 3) that an orbit should hold in the picture, closer than the bounds' corners.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If a field breaks a rule; names file, field and rule.
    """
    size = {"width": width, "height": height}
    if str(spec) == "orbit":
        return orbit(lo, hi, frames, **size, outline=outline)
    value = load_json(spec)
    centre, radius = bounding_sphere(lo, hi)
    if isinstance(value, dict) and "orbit" in value:
        Fields(value, str(spec), ("orbit",))
        shot = {**size, "outline": outline}
        path = _orbit_of(Fields(value["orbit"], f"{spec}: orbit", _ORBIT), lo, hi, frames, shot)
    elif isinstance(value, dict) and "keys" in value:
        fields = Fields(value, str(spec), ("keys", "interpolation", *_PLANES))
        keys = [Fields(key, f"{spec}: keys[{k}]", ("frame", *_POSE)) for k, key in enumerate(fields.items("keys"))]
        times = np.array([key.number("frame") for key in keys])
        for k in np.flatnonzero(np.diff(times) <= 0):
            raise ValueError(f"{keys[k + 1].name('frame')} must be above the key's before it, got {times[k + 1]:g}")
        smooth = fields.choice("interpolation", ("linear", "catmull-rom"), "linear") == "catmull-rom"
        poses = np.stack([_pose(key) for key in keys])
        path = KeyPath(times, poses, smooth, centre, radius, **size, **_planes_of(fields))
    else:
        fields = Fields(value, str(spec), (*_POSE, *_PLANES, "keys", "interpolation", "orbit"))
        path = KeyPath(np.zeros(1), _pose(fields)[None], False, centre, radius, **size, **_planes_of(fields))
    for frame in range(frames):
        try:
            path.at(frame)
        except ValueError as error:
            raise ValueError(f"{spec}: frame {frame}: {error}") from None
    return path


def _orbit_of(fields: Fields, lo, hi, frames: int, shot: dict) -> OrbitPath:
    given = {"turns": fields.number("turns", None), "distance": fields.number("distance", None, low=0, open_low=True)}
    given["elevation"] = math.radians(fields.number("elevation_degrees", 15.0, low=-89, high=89))
    given["azimuth"] = math.radians(fields.number("azimuth_degrees", 35.0))
    given["fov_y"] = math.radians(fields.number("fov_degrees", 40.0, low=0, high=170, open_low=True))
    return orbit(lo, hi, frames, **shot, **given)


def _pose(fields: Fields) -> np.ndarray:
    fov = math.radians(fields.number("fov_degrees", 40.0, low=0, high=170, open_low=True))
    return np.concatenate([fields.vector("eye"), fields.vector("target"), fields.vector("up", [0.0, 1.0, 0.0]), [fov]])


def _planes_of(fields: Fields) -> dict:
    return {name: fields.number(name, None, low=0, open_low=True) for name in _PLANES}
