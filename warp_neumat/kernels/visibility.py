"""Camera raster: which triangle each pixel sees, where on it, and how far away.

``visibility_setup.py`` says how triangles become edge functions. On the CPU they are drawn tile by tile
(``visibility_tiles.py``); on CUDA, one thread per triangle takes the minimum of 64-bit keys (depth, triangle), and
one per pixel resolves them. Pixels: row 0 on top, (x, y) is centred at (x + 0.5, y + 0.5). Clip space:
docs/conventions.md.
"""

import functools
import math

import numpy as np
import warp as wp

from .arrays import Kind, take
from .dispatch import Job, blocks, lanes, module_options, worker_count
from .visibility_setup import BITS, TILE, bounds_of, make_project, planes
from .visibility_tiles import GROUP, LEVELS, SCRATCH, count_kernel, fill_kernel, scan_kernel, tile_kernel

__all__ = ["MAX_SIZE", "CameraRaster", "depth_range", "pixel_matrix"]

wp.set_module_options(module_options())

MAX_SIZE = 32767
"""Largest width and height [px]: bounds are stored in 16 bits."""

_EMPTY = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))


@wp.kernel
def clear_kernel(first: int, keys: wp.array(dtype=wp.int64)):
    keys[first + wp.tid()] = _EMPTY


@wp.kernel
def splat_kernel(
    first: int,
    projected: wp.array(dtype=wp.vec4d),
    faces: wp.array(dtype=wp.int32),
    sided: wp.array(dtype=wp.uint8),
    near: wp.float64,
    q_near: float,
    q_far: float,
    width: int,
    height: int,
    keys: wp.array(dtype=wp.int64),
):
    """One triangle into the keys: the nearest wins, then the lower id."""
    t = first + wp.tid()
    i0 = faces[3 * t]
    i1 = faces[3 * t + 1]
    i2 = faces[3 * t + 2]
    box = bounds_of(projected[i0], projected[i1], projected[i2], sided[t], near, width, height)
    if box[0] > box[2]:
        return
    for ty in range(int(box[1]) >> BITS, (int(box[3]) >> BITS) + 1):
        for tx in range(int(box[0]) >> BITS, (int(box[2]) >> BITS) + 1):
            ox = tx * TILE + TILE // 2
            oy = ty * TILE + TILE // 2
            m = planes(
                projected[i0], projected[i1], projected[i2], i0, i1, i2, wp.float64(ox), wp.float64(oy), sided[t]
            )
            for y in range(wp.max(int(box[1]), ty * TILE), wp.min(int(box[3]), ty * TILE + TILE - 1) + 1):
                row = m[2] + m[1] * (float(y - oy) + 0.5)
                for x in range(wp.max(int(box[0]), tx * TILE), wp.min(int(box[2]), tx * TILE + TILE - 1) + 1):
                    e = row + m[0] * (float(x - ox) + 0.5)
                    if wp.min(wp.min(e[0], e[1]), e[2]) >= 0.0 and e[3] <= q_near and e[3] >= q_far:
                        rank = wp.int64(0x7FFFFFFF) - wp.int64(wp.cast(e[3], wp.int32))
                        wp.atomic_min(keys, y * width + x, (rank << wp.int64(32)) | wp.int64(t))


@wp.kernel
def resolve_kernel(
    first: int,
    keys: wp.array(dtype=wp.int64),
    projected: wp.array(dtype=wp.vec4d),
    faces: wp.array(dtype=wp.int32),
    sided: wp.array(dtype=wp.uint8),
    width: int,
    triangle: wp.array(dtype=wp.int32),
    barycentric: wp.array(dtype=wp.float32),
    depth: wp.array(dtype=wp.float32),
):
    """One pixel from its key."""
    i = first + wp.tid()
    key = keys[i]
    if key == _EMPTY:
        triangle[i] = -1
        barycentric[2 * i] = 0.0
        barycentric[2 * i + 1] = 0.0
        depth[i] = wp.inf
        return
    t = int(key & wp.int64(0x7FFFFFFF))
    x = i % width
    y = i // width
    ox = (x >> BITS) * TILE + TILE // 2
    oy = (y >> BITS) * TILE + TILE // 2
    i0 = faces[3 * t]
    i1 = faces[3 * t + 1]
    i2 = faces[3 * t + 2]
    m = planes(projected[i0], projected[i1], projected[i2], i0, i1, i2, wp.float64(ox), wp.float64(oy), sided[t])
    e = (m[2] + m[1] * (float(y - oy) + 0.5)) + m[0] * (float(x - ox) + 0.5)
    r = 1.0 / (e[0] + e[1] + e[2])
    triangle[i] = t
    barycentric[2 * i] = e[1] * r
    barycentric[2 * i + 1] = e[2] * r
    depth[i] = 1.0 / e[3]


def depth_range(clip) -> tuple[float, float]:
    """Return the view depths (near, far) between which ``clip`` gives z/w in [0, 1]; far may be infinite.

    Args:
        clip: World → clip matrix, shape (4, 4), whose w is the view depth. Reversed z (1 at near) is allowed.

    Raises:
        ValueError: If the matrix is not finite, or is no perspective with 0 < near < far.
    """
    m = np.asarray(clip, dtype=np.float64)
    if m.shape != (4, 4):
        raise ValueError(f"clip must have shape (4, 4), got {m.shape}")
    if not np.isfinite(m).all():
        raise ValueError("clip must be finite")
    z, w = m[2], m[3]
    square = w[:3] @ w[:3]
    if square == 0.0:
        raise ValueError("clip must be a perspective whose w is the view depth; its last row is constant")
    # z = slope · w + shift for every point, up to the rounding of float32.
    slope = (z[:3] @ w[:3]) / square
    shift = z[3] - slope * w[3]
    if np.abs(z[:3] - slope * w[:3]).max() > 1e-4 * max(1.0, abs(slope)) * math.sqrt(square):
        raise ValueError("clip must map equal view depths to equal z; its third row is no multiple of its fourth")
    at = [-shift / slope if slope else math.inf, shift / (1.0 - slope) if slope != 1.0 else math.inf]
    near, far = sorted(d if d > 0.0 else math.inf for d in at)
    if not near < far:
        raise ValueError(f"clip must hold 0 < near < far, got z/w = 0 at depth {at[0]:g} and 1 at {at[1]:g}")
    return near, far


def pixel_matrix(clip, width: int, height: int) -> np.ndarray:
    """Return the matrix from world points to (X, Y, ·, w) with pixel coordinates (X/w, Y/w), shape (4, 4), float64."""
    m = np.asarray(clip, dtype=np.float64)
    return np.stack([0.5 * width * (m[3] + m[0]), 0.5 * height * (m[3] - m[1]), np.zeros(4), m[3]])


class CameraRaster:
    """Draws one mesh topology into triangle ids, barycentrics and depth, frame after frame, without allocating.

    A pixel shows the nearest triangle whose closed area holds its centre and whose depth there is within the clip
    matrix's near and far; of equal depths, the lower triangle id. So a centre on a shared edge belongs to either
    triangle, never to none. Front faces run counter-clockwise as seen; others are drawn only where ``double_sided``.
    Triangles of no area, or with a NaN or Inf in a vertex, draw nothing. The result does not depend on the number of
    workers.

    Args:
        faces: Vertex indices, shape (F, 3).
        vertex_count: Number of vertices V.
        width: Picture width [px], 1 … :data:`MAX_SIZE`.
        height: Picture height [px], likewise.
        double_sided: Whether each triangle is seen from behind too, shape (F,); ``None``: none is.
        device: Warp device; default: the current one.
        tiled: Draw tile by tile (the default on the CPU) or with one thread per triangle (the default on CUDA).

    Attributes:
        triangle: Triangle ids, shape (H, W), int32, −1 where nothing is drawn. Row 0 is the top one.
        barycentric: Perspective-correct weights of the triangle's second and third vertex, shape (H, W, 2), float32;
            each ≥ 0 and their sum ≤ 1 but for one rounding; 0 where nothing is drawn.
        depth: View depth w [scene unit], shape (H, W), float32, +inf where nothing is drawn.

    The three arrays are for reading: tiles that stay empty are not written again.

    Raises:
        ValueError: If shapes or sizes are off, or a face names a vertex that does not exist.

    Error: weights are those of a point within 4e-6 px of the pixel centre, plus 1.2e-7; depth is within 5.1e-7 (5e-6
    where a triangle reaches 1e8 px), both against float64 on CPU. Held by test_raster_matches_reference.
    """

    def __init__(self, faces, vertex_count, width, height, *, double_sided=None, device=None, tiled=None):
        self.device = wp.get_device(device)
        self.width, self.height, self.vertex_count = int(width), int(height), int(vertex_count)
        for name, size in (("width", self.width), ("height", self.height)):
            if not 1 <= size <= MAX_SIZE:
                raise ValueError(f"{name} must be in 1..{MAX_SIZE}, got {size}")
        kind = Kind("warp", self.device)
        faces = np.ascontiguousarray(faces.numpy() if isinstance(faces, wp.array) else faces)
        if faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(f"faces must have shape [F, 3], got {faces.shape}")
        if faces.size and not (faces.min() >= 0 and faces.max() < self.vertex_count):
            raise ValueError(
                f"faces must index {self.vertex_count} vertices, got indices from {faces.min()} to {faces.max()}"
            )
        self.triangle_count = n = len(faces)
        if double_sided is None:
            double_sided = np.zeros(n, np.uint8)
        self._sided = wp.clone(take(double_sided, "double_sided", (n,), wp.uint8, kind))
        self._faces = wp.array(faces.astype(np.int32).reshape(-1), dtype=wp.int32, device=self.device)

        def array(shape, dtype=wp.int32):
            return wp.zeros(shape, dtype=dtype, device=self.device)

        pixels = self.width * self.height
        self.triangle = wp.full((self.height, self.width), -1, dtype=wp.int32, device=self.device)
        self.barycentric = array((self.height, self.width, 2), wp.float32)
        self.depth = wp.full((self.height, self.width), math.inf, dtype=wp.float32, device=self.device)
        flat = [self.triangle.flatten(), self.barycentric.flatten(), self.depth.flatten()]
        projected, bounds = array(self.vertex_count, wp.vec4d), array(n, wp.vec4s)
        mesh = [projected, self._faces, self._sided]
        size = [self.width, self.height]
        self._clip = None

        L = lanes(self.device)
        points = array((self.vertex_count, 3), wp.float32)
        self._kind = kind
        self._project = Job(
            make_project(L),
            blocks(self.vertex_count, L),
            [points.flatten(), wp.mat44d(), self.vertex_count, projected],
            device=self.device,
            grain=8,
        )
        self._tiled = self.device.is_cpu if tiled is None else bool(tiled)
        if self._tiled and not self.device.is_cpu:
            raise ValueError("tiled drawing needs the CPU; leave tiled at None")
        ranges = [0.0, 0.0]
        if self._tiled:
            grid, cells = [], 0
            for level in range(LEVELS):
                across, down = (blocks(s, TILE << 2 * level) for s in size)
                grid += [cells, across]
                cells += across * down
            grid = wp.array(grid, dtype=wp.int32, device=self.device)
            group = max(GROUP, blocks(n, 64))
            groups = blocks(n, group)
            counters, starts, lists = array(groups * cells), array(cells + 1), array(4 * n)
            tiles = blocks(self.width, TILE) * blocks(self.height, TILE)
            self._starts, self._dirty, self._bounds = starts, array(tiles), bounds
            self._slots = worker_count()
            scratch = array(self._slots * SCRATCH, wp.float32)
            binning = [grid, cells, group, n]
            make = functools.partial(Job, device=self.device, grain=1)
            self._count = make(count_kernel, groups, [*mesh, 0.0, *size, *binning, bounds, counters])
            self._scan = make(scan_kernel, 1, [cells, groups, counters, starts])
            self._fill = make(fill_kernel, groups, [bounds, *binning, counters, lists])
            self._tiles = make(
                tile_kernel,
                tiles,
                [
                    tiles,
                    _coprime(tiles),
                    grid,
                    starts,
                    lists,
                    bounds,
                    *mesh,
                    *ranges,
                    *size,
                    scratch,
                    self._dirty,
                    *flat,
                ],
            )
            self.stages = [("count", self._count), ("scan", self._scan), ("fill", self._fill), ("tiles", self._tiles)]
        else:
            keys = array(pixels, wp.int64)
            # Atomics on the CPU hold within one worker only, so there a single chunk takes all triangles.
            self._clear = Job(clear_kernel, pixels, [keys], device=self.device, grain=1 << 16)
            self._splat = Job(splat_kernel, n, [*mesh, 0.0, *ranges, *size, keys], device=self.device, grain=max(1, n))
            resolve = Job(resolve_kernel, pixels, [keys, *mesh, self.width, *flat], device=self.device, grain=1 << 14)
            self.stages = [("clear", self._clear), ("splat", self._splat), ("resolve", resolve)]
        self.stages.insert(0, ("project", self._project))

    def run(self, points, clip, eye=None) -> None:
        """Draw the mesh at ``points`` into :attr:`triangle`, :attr:`barycentric` and :attr:`depth`.

        Args:
            points: World positions, shape (V, 3), float32; numpy, torch or Warp.
            clip: World → clip matrix, shape (4, 4), as :func:`depth_range` takes it.
            eye: Not needed (facing follows from ``clip``); accepted for callers that carry the camera as a pair.

        Raises:
            ValueError: If a shape is wrong or the matrix is no perspective.
        """
        self._prepare(points, clip)
        for _, job in self.stages:
            job.run()

    def _prepare(self, points, clip) -> None:
        points = take(points, "points", (self.vertex_count, 3), wp.float32, self._kind)
        _set(self._project, points=points.flatten())
        clip = np.asarray(clip, dtype=np.float64)
        if self._clip is None or not np.array_equal(clip, self._clip):
            near, far = depth_range(clip)
            self._clip = clip.copy()
            _set(self._project, m=wp.mat44d(pixel_matrix(clip, self.width, self.height)))
            ranges = {"q_near": float(np.float32(1.0 / near)), "q_far": float(np.float32(1.0 / far))}
            if self._tiled:
                _set(self._count, near=near)
                _set(self._tiles, **ranges)
            else:
                _set(self._splat, near=near, **ranges)
        if self._tiled and worker_count() > self._slots:
            self._slots = worker_count()
            _set(self._tiles, scratch=wp.empty(self._slots * SCRATCH, dtype=wp.float32, device=self.device))

    def stats(self) -> dict[str, int]:
        """Return counts of the last frame, so that what was skipped can be seen.

        ``triangles`` of the mesh and ``tiles`` of the picture; where drawn tile by tile also ``kept``, the triangles
        left without back faces, degenerate ones, and those outside or between pixel centres, ``entries`` of all
        cells' lists, and ``tiles_drawn``, the tiles with a pixel that is not background.
        """
        counts = {"triangles": self.triangle_count, "tiles": blocks(self.width, TILE) * blocks(self.height, TILE)}
        if self._tiled:
            box = self._bounds.numpy()
            counts["kept"] = int((box[:, 0] <= box[:, 2]).sum())
            counts["entries"] = int(self._starts.numpy()[-1])
            counts["tiles_drawn"] = int(np.count_nonzero(self._dirty.numpy()))
        return counts


def _coprime(n: int) -> int:
    """Return a step near the golden section of ``n`` that visits all of 0 … n − 1."""
    step = max(1, round(0.618034 * n))
    while math.gcd(step, n) != 1:
        step += 1
    return step


def _set(job: Job, **values) -> None:
    """Set arguments of a recorded launch by name."""
    names = [argument.label for argument in job.kernel.adj.args if argument.label not in ("first", "slot")]
    for name, value in values.items():
        job.set(names.index(name), value)
