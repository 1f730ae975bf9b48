"""What the benchmarks of the scheduler render: three scenes and two measured materials, and how frames take turns.

``fox`` runs while the camera orbits it, ``helmet`` rests under a light that travels around it, ``cloth`` is a curtain
whose folds wander while the camera moves slowly. So view, light and surface each move the shading of one of them.
"""

import dataclasses
import hashlib
import math
import os
import time
from collections.abc import Callable, Hashable, Iterable, Mapping
from pathlib import Path

import numpy as np

from bench.harness import track
from warp_neumat import metrics
from warp_neumat.io.cache import cache_folder
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.camera import CameraPath, orbit
from warp_neumat.pipeline.demo import material_paths
from warp_neumat.pipeline.lights import PointLights, lights_from
from warp_neumat.pipeline.renderer import Renderer
from warp_neumat.pipeline.sequence import MeshSequence

SCENES = ("fox", "helmet", "cloth")
FRAMES = 48
"""Frames that cameras and lights take for their way, however many are rendered."""

MEASURED = {"glossy": "alum-bronze", "matt": "green-fabric"}
"""Material → the measured function of the MERL set that it is fitted to."""
_BUNDLED = {"glossy": "knot", "matt": "cloth"}


def data_folder() -> Path:
    """Return ``$NEUMAT_DATA``, else ``../shared/data`` beside the checkout."""
    return Path(os.environ.get("NEUMAT_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def material_path(name: str, *, quick: bool, device: str = "cpu") -> Path:
    """Return the asset of a material of :data:`MEASURED`, fitted now unless it was before; a bundled one if ``quick``.

    Fits are kept in the cache folder, under names that change with what a fit's defaults resolve to.
    """
    if quick:
        return material_paths()[_BUNDLED[name]]
    from warp_neumat.io.brdf import open_brdf
    from warp_neumat.models import neubrdf
    from warp_neumat.training.fit import fit

    spec = f"{data_folder() / 'brdf' / 'merl80_nbrdf.npz'}:{MEASURED[name]}"
    plan = (neubrdf.configure(open_brdf(spec), {}), neubrdf.DEFAULT_STEPS, neubrdf.VERSION)
    key = hashlib.sha256(repr(plan).encode()).hexdigest()[:12]
    path = cache_folder() / "bench" / f"{MEASURED[name]}-{key}.neumat"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        fit(spec, path, model="neubrdf", device="cuda" if device.startswith("cuda") else "cpu")
    return path


@dataclasses.dataclass(frozen=True)
class Scene:
    """A shot without its material.

    Attributes:
        name: What tables call it.
        sequence: The meshes.
        camera: Their camera, for pictures of ``size``.
        lights: Their lights.
        size: (width, height) [px].
        frames: Frames there are to render.
    """

    name: str
    sequence: MeshSequence
    camera: CameraPath
    lights: PointLights
    size: tuple[int, int]
    frames: int

    def renderer(self, material, atlas: Atlas, device: str, **options) -> Renderer:
        """Return a renderer of the scene made of one material (a :class:`Material` or its path)."""
        shot = {"size": self.size, "camera": self.camera, "lights": self.lights, "frame_count": FRAMES}
        return Renderer(self.sequence, {"*": material}, atlas=atlas, device=device, **(shot | options))

    def posed(self, frame: int) -> int:
        """Animate ``frame``, so that whoever renders it first does not pay for all, and return it."""
        self.sequence.frame(frame)
        return frame

    def seen_from(self, **options) -> "Scene":
        """Return the scene as seen by :func:`orbit` with these options."""
        return dataclasses.replace(self, camera=_orbit(self.sequence, self.size, **options))


def open_scene(spec: str, size: tuple[int, int], frames: int = FRAMES) -> Scene:
    """Return one of :data:`SCENES`, or the mesh sequence at a path under three lights and an orbiting camera.

    Raises: ValueError, OSError: If ``spec`` is neither; as :meth:`MeshSequence.load`.
    """
    if spec == "fox":
        sequence = MeshSequence.load(data_folder() / "animation" / "Fox.glb", animation="Run")
    elif spec == "helmet":
        sequence = MeshSequence.load(data_folder() / "meshes" / "FlightHelmet" / "FlightHelmet.gltf")
    elif spec == "cloth":
        sequence = cloth(frames)
    elif Path(spec).exists():
        sequence = MeshSequence.load(spec)
        if sequence.animation is None and sequence.frame_count > 1:
            frames = min(frames, sequence.frame_count)  # an animation loops, a list of frames does not
    else:
        raise ValueError(f"SEQUENCE must be one of {', '.join(SCENES)}, or a path, got {spec!r}")
    lights = lights_from(3, *sequence.bounds(), FRAMES)
    camera = _orbit(sequence, size)
    if spec == "helmet":
        turns = np.array([0.5, 0.0, 0.0])  # the key: two seconds for half a turn, at 24 frames a second
        lights = dataclasses.replace(lights, turns=turns, frames=FRAMES)
        camera = _orbit(sequence, size, turns=0.0)
    elif spec == "cloth":
        camera = _orbit(sequence, size, turns=1.0 / 24.0, azimuth=math.radians(-8.0), elevation=math.radians(8.0))
        camera = dataclasses.replace(camera, distance=0.72 * camera.distance)  # it need not fit from the side
    return Scene(Path(spec).stem, sequence, camera, lights, size, frames)


def _orbit(sequence: MeshSequence, size, **options) -> CameraPath:
    picture = {"width": size[0], "height": size[1], "outline": sequence.outline()}
    return orbit(*sequence.bounds(), FRAMES, **picture, **options)


def cloth(frames: int = FRAMES, cells: int = 160) -> MeshSequence:
    """Return a curtain that hangs from a straight rail in a draught, 24 frames a second, with smooth normals.

    Its folds are narrow and shallow at the rail, merge by twos and deepen on the way down, and wander sideways; the
    cloth as a whole swings. What a fold takes in depth it gives up in width, so that the cloth is not stretched much.
    """
    v, u = np.meshgrid(np.linspace(0.0, 1.0, cells + 1), np.linspace(-1.0, 1.0, cells + 1), indexing="ij")
    points = np.empty((frames, cells + 1, cells + 1, 3), np.float32)
    for k in range(frames):
        t = k / 24.0
        loose = v * v * (3.0 - 2.0 * v)  # 0 at the rail, which holds the cloth, 1 at the hem
        sway = 0.25 * loose * np.sin(1.7 * t + 1.1 * u)
        fine = 0.05 * (1.0 - 0.8 * loose) * np.sin(22.0 * u + 0.4 * np.sin(3.0 * v))
        wide = (0.03 + 0.13 * loose) * np.sin(11.0 * u + 0.7 * np.sin(2.5 * v + 0.8 * t) - 1.6 * t * loose)
        ripple = 0.02 * loose * np.sin(9.0 * v - 4.0 * t + 2.0 * u)
        inward = 0.05 * loose * np.sin(22.0 * u - 3.2 * t * loose)  # the sides of a fold lean over
        points[k, ..., 0] = 1.5 * u + inward
        points[k, ..., 1] = 1.0 - 2.0 * v + 0.05 * loose * np.cos(11.0 * u)
        points[k, ..., 2] = fine + wide + ripple + sway
    i, j = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    a = (i * (cells + 1) + j).ravel()
    b, c, d = a + 1, a + cells + 1, a + cells + 2
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)]).astype(np.int32)
    uv = np.stack([0.5 * (u + 1.0), v], axis=-1).reshape(-1, 2).astype(np.float32)
    points = points.reshape(frames, -1, 3)
    return MeshSequence.from_arrays(points, faces, uv, fps=24.0, name="cloth", normals="smooth", double_sided=True)


@dataclasses.dataclass
class Taken:
    """What one renderer took for its frames.

    Attributes:
        ms: Milliseconds of each frame, by the clock on the wall.
        stats: ``RenderedFrame.stats`` of each.
    """

    ms: list[float] = dataclasses.field(default_factory=list)
    stats: list[dict] = dataclasses.field(default_factory=list)

    def stage(self, *names: str) -> np.ndarray:
        """Return the milliseconds that stages took together, of each frame."""
        return np.array([sum(s["ms"].get(name, 0.0) for name in names) for s in self.stats])

    @property
    def evaluations(self) -> np.ndarray:
        """Evaluations of each frame."""
        return np.array([s["evaluations"] for s in self.stats])


def take_turns(
    scene: Scene,
    renderers: Mapping[Hashable, Renderer],
    frames: Iterable[int],
    text: str,
    look: Callable[[int, Hashable, np.ndarray], None] | None = None,
) -> dict[Hashable, Taken]:
    """Render each frame by all renderers before the next frame, and return what each took.

    Every frame starts one renderer further, so that none always follows the same neighbour's cache.

    Args:
        scene: What is rendered; its animation is done beforehand, and is in nobody's time.
        renderers: Name → renderer.
        frames: Frame numbers, in order.
        text: What a progress bar says.
        look: ``look(place in frames, name, picture)`` is called with every picture, outside of the times.
    """
    names, taken = list(renderers), {name: Taken() for name in renderers}
    for place, frame in enumerate(track(list(frames), text)):
        scene.posed(frame)
        for turn in range(len(names)):
            name = names[(place + turn) % len(names)]
            start = time.perf_counter()
            rendered = renderers[name].frame(frame)
            taken[name].ms.append(1e3 * (time.perf_counter() - start))
            taken[name].stats.append(rendered.stats)
            if look is not None:
                look(place, name, rendered.image)
    return taken


def judged(frames: int) -> list[int]:
    """Return the frames that FLIP, which costs more than all else, is taken of: 3k + (k mod 3), k ≥ 1; every third.

    In those of :data:`FRAMES`, each age of shading that is reused for 1, 2, 4 or 6 frames occurs alike (by the rest of
    the division by 2, 3, 5 and 7). Of 16 frames or less, all but the first.
    """
    if frames <= 16:
        return list(range(1, frames)) or [0]
    return [f for k in range(1, frames) if (f := 3 * k + k % 3) < frames]


class Errors:
    """Errors of a sequence of display pictures against its reference, frame by frame.

    Attributes:
        flip: Mean FLIP of each frame it was asked of.
        flip_p95: The 95th percentile of FLIP over the pixels of each of them in which the mesh is seen.
        mse: Mean squared difference of each frame.
        flicker: :func:`metrics.flicker` of each frame but the first.
    """

    def __init__(self):
        self.flip: list[float] = []
        self.flip_p95: list[float] = []
        self.mse: list[float] = []
        self.flicker: list[float] = []
        self._before: tuple[np.ndarray, np.ndarray] | None = None

    def add(self, reference: np.ndarray, picture: np.ndarray, covered: np.ndarray | None) -> None:
        """Take the next frame; ``picture`` is kept.

        Args:
            reference, picture: Display-referred, shape (H, W, 3).
            covered: Where the mesh is, shape (H, W); None leaves FLIP out.
        """
        if covered is not None:
            mean, errors = metrics.flip(reference, picture)
            self.flip.append(mean)
            self.flip_p95.append(float(np.percentile(errors[covered], 95.0)) if covered.any() else 0.0)
        self.mse.append(metrics.rmse(reference, picture) ** 2)
        if self._before is not None:
            self.flicker.append(metrics.flicker(reference, picture, *self._before))
        self._before = reference, picture
