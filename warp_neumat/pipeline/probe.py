"""Measuring FLIP in a frame for a small part of what a reference costs: one window, shaded pixel by pixel.

A window lies where the picture shows something, elsewhere each time. Its pixels are shaded as per-pixel shading would,
and the picture's and its own display values are compared. What the tiles behind its pixels were predicted to be off is
handed on beside it, so that a prediction can be corrected by what is seen (``target.py``).
"""

import math

import numpy as np
import warp as wp

from warp_neumat import metrics
from warp_neumat.kernels.tiles import TILE
from warp_neumat.kernels.visibility import CameraRaster
from warp_neumat.pipeline.camera import Camera
from warp_neumat.pipeline.lights import LightState
from warp_neumat.pipeline.look import Look
from warp_neumat.pipeline.policy import flip_of
from warp_neumat.pipeline.schedule import Schedule
from warp_neumat.pipeline.surface_mesh import Facing
from warp_neumat.pipeline.target import TargetFlip
from warp_neumat.pipeline.texel_shader import TexelShader
from warp_neumat.pipeline.tonemap import tonemap

WINDOW = 48
"""Side of a window [px]: some times the reach of FLIP's filters, 10 px."""

EVERY = 2
"""Frames from one probe to the next."""


class Probe:
    """Shades windows of the pictures of one view.

    Args:
        look: What views have in common.
        raster: The view's camera raster.
        facing: Of the view.
        schedule: Predicts what the tiles are off.
        target: Learns from the probes.
        seed: Decides where the windows lie.
    """

    def __init__(
        self, look: Look, raster: CameraRaster, facing: Facing, schedule: Schedule, target: TargetFlip, seed: int = 0
    ):
        self.look, self.raster, self.schedule, self.target = look, raster, schedule, target
        self._face_material = look.mesh.face_material.numpy()
        pixels = raster.width * raster.height
        self._material = wp.zeros(pixels, dtype=wp.uint8, device=look.mesh.device)
        self._shader = TexelShader(
            look.mesh,
            facing,
            look.materials,
            raster.triangle,
            raster.barycentric,
            self._material,
            look.light_capacity,
            skip=look.skips.lights,
            gain=look.gain,
        )
        self._shader.share_seen(self._material)
        self._seed = seed
        self.reset()

    def reset(self) -> None:
        """Begin anew, as before the first frame."""
        self._random = np.random.default_rng(self._seed)
        self._frame = 0

    def run(self, image: np.ndarray, corner_uv: np.ndarray, camera: Camera, lights: LightState) -> int:
        """Tell the target what the frame is predicted to be off and, when it is time, what a window is.

        Args:
            image: The frame, (H, W, 3) linear.
            corner_uv: Corners of the faces on the sheet [texel], flat.
            camera, lights: The present ones.

        Returns: Evaluations of materials that the window took.
        """
        triangle = self.raster.triangle.numpy()
        picture = triangle.size
        pixels = self.schedule.pixels.numpy().reshape(-1, self.schedule.shader.tiles).sum(axis=0)
        predicted = float(flip_of(self.schedule.change, pixels).sum()) / picture
        self.target.note(predicted, float(pixels.sum()) / picture)
        self._frame += 1
        if self._frame % EVERY:
            return 0
        window = self._window(triangle)
        if window is None:
            return 0
        rows, columns = window
        inside = triangle[rows, columns]
        material = np.zeros(triangle.shape, np.uint8)
        material[rows, columns] = np.where(inside >= 0, self._face_material[np.maximum(inside, 0)] + 1, 0)
        self._material.assign(material.ravel())
        self._shader.begin(camera, lights)
        self._shader.forget()
        self._shader.list()
        evaluations = self._shader.shade().evaluations
        shaded = self._shader.radiance.numpy().reshape(*triangle.shape, 4)[rows, columns, :3].astype(np.float32)
        shown = np.ascontiguousarray(image[rows, columns])
        expected = np.where(inside[..., None] >= 0, shaded, shown)
        stops = math.log2(self.look.gain)
        flip = metrics.flip(*(tonemap(p, stops, self.look.tonemap) for p in (expected, shown)))[0]
        drawn = inside >= 0
        tile = self._tiles(inside[drawn], self.raster.barycentric.numpy()[rows, columns][drawn], corner_uv)
        off = float(flip_of(self.schedule.change[tile], 1.0).sum()) / inside.size
        self.target.probe(flip, off, float(drawn.mean()))
        return evaluations

    def _window(self, triangle):
        """Return rows and columns of a window around a random pixel that is drawn, or None without any."""
        height, width = triangle.shape
        for _ in range(64):  # cheaper than listing all that are drawn
            y, x = self._random.integers(height), self._random.integers(width)
            if triangle[y, x] >= 0:
                break
        else:
            drawn = np.flatnonzero(triangle >= 0)
            if not len(drawn):
                return None
            y, x = divmod(int(self._random.choice(drawn)), width)
        top = min(max(y - WINDOW // 2, 0), max(height - WINDOW, 0))
        left = min(max(x - WINDOW // 2, 0), max(width - WINDOW, 0))
        return slice(top, top + WINDOW), slice(left, left + WINDOW)

    def _tiles(self, triangle, barycentric, corner_uv) -> np.ndarray:
        b1, b2 = barycentric.T
        corner = corner_uv.reshape(-1, 3, 2)[triangle]
        at = (1 - b1 - b2)[:, None] * corner[:, 0] + b1[:, None] * corner[:, 1] + b2[:, None] * corner[:, 2] - 0.5
        x, y = (np.clip(at, 0, self.schedule.shader.width - 1).astype(np.int32) // TILE).T
        return y * self.schedule.shader.columns + x
