"""Rays on a periodic height field: what a viewer sees of it, what a light reaches, and which points see each other.

Frame: x along columns, y up in the picture (against the rows), z up, all lengths in texels. Heights are given at texel
centres and interpolated bilinearly; the field repeats. *Surface points* lie s × s to a texel, at the centres of its
sub-squares; point ``texel · s² + k`` has sub-row k // s. A ray's hit is the point in whose sub-square it lies, so that
everything light and view share hangs on points: :mod:`warp_neumat.kernels.height_field_light` sums it up.

A ray walks from cell to cell (Amanatides and Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing", 1987) and solves
the quadratic of ray and bilinear patch in those whose highest corner it passes below.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import warp as wp

from warp_neumat.kernels import dispatch

wp.set_module_options(dispatch.module_options())

OFFSET = 1.0e-3
"""Distance along the normal at which a ray leaves the surface [texel]."""

_STEPS = wp.constant(16384)
_OFFSET = wp.constant(1.0e-3)
_FAR = wp.constant(1.0e30)


@wp.func
def wrapped(i: int, n: int) -> int:
    """Return ``i`` modulo ``n``, in [0, n)."""
    k = i % n
    return wp.where(k < 0, k + n, k)


@wp.func
def trace_ray(
    column: int,
    row: int,
    start: wp.vec3,
    d: wp.vec3,
    height: wp.array(dtype=wp.float32),
    top: wp.array(dtype=wp.float32),
    width: int,
    rows: int,
    ceiling: float,
) -> wp.vec4:
    """Follow a ray from cell to cell; return x and y in the cell it hits, and that cell's column, −1 for none, and row.

    Args:
        column, row: Cell in which the ray starts, between the texel centres (row, column) and (row + 1, column + 1).
        start: Position in it, x and y in [0, 1] along columns and rows, and height.
        d: Direction along columns, rows, and up.
        height, top: Heights [rows · width], and the highest corner of every cell.
        ceiling: Height above which a rising ray hits nothing.

    Positions stay local to the cell, so the result is the same bits wherever the field's period begins.
    """
    i = int(column)
    j = int(row)
    a = float(start[0])
    b = float(start[1])
    z = float(start[2])
    hit_a = float(0.0)
    hit_b = float(0.0)
    found = int(0)
    inv_x = wp.where(wp.abs(d[0]) > 1.0e-12, 1.0 / d[0], _FAR)
    inv_y = wp.where(wp.abs(d[1]) > 1.0e-12, 1.0 / d[1], _FAR)
    step = int(0)
    while step < _STEPS:
        sx = wp.where(wp.abs(d[0]) > 1.0e-12, wp.where(d[0] > 0.0, 1.0 - a, -a) * inv_x, _FAR)
        sy = wp.where(wp.abs(d[1]) > 1.0e-12, wp.where(d[1] > 0.0, 1.0 - b, -b) * inv_y, _FAR)
        s = wp.max(wp.min(sx, sy), 0.0)
        cell = j * width + i
        next_z = z + d[2] * s
        if wp.min(z, next_z) <= top[cell]:
            i1 = wp.where(i + 1 == width, 0, i + 1)
            j1 = wp.where(j + 1 == rows, 0, j + 1)
            h00 = height[cell]
            hx = height[j * width + i1] - h00
            hy = height[j1 * width + i] - h00
            hxy = height[j1 * width + i1] - h00 - hx - hy
            # The gap between ray and surface along the ray is the quadratic q2 s² + q1 s + q0.
            q0 = z - (h00 + hx * a + hy * b + hxy * a * b)
            q1 = d[2] - (hx * d[0] + hy * d[1] + hxy * (a * d[1] + b * d[0]))
            q2 = -hxy * d[0] * d[1]
            at = float(-1.0)
            if q0 <= 0.0:
                at = 0.0
            else:
                disc = q1 * q1 - 4.0 * q2 * q0
                if disc >= 0.0:
                    divisor = wp.sqrt(disc) - q1
                    if divisor > 0.0 and 2.0 * q0 <= divisor * s:
                        at = 2.0 * q0 / divisor
                if at < 0.0 and (q2 * s + q1) * s + q0 <= 0.0:
                    at = s
            if at >= 0.0:
                hit_a = wp.clamp(a + d[0] * at, 0.0, 1.0)
                hit_b = wp.clamp(b + d[1] * at, 0.0, 1.0)
                found = 1
                break
        if d[2] > 0.0 and next_z > ceiling:
            break
        if s > 1.0e29:  # straight up or down within a cell that it cannot leave
            break
        z = next_z
        if sx <= sy:
            b = wp.clamp(b + d[1] * s, 0.0, 1.0)
            if d[0] > 0.0:
                a = 0.0
                i = wp.where(i + 1 == width, 0, i + 1)
            else:
                a = 1.0
                i = wp.where(i == 0, width - 1, i - 1)
        else:
            a = wp.clamp(a + d[0] * s, 0.0, 1.0)
            if d[1] > 0.0:
                b = 0.0
                j = wp.where(j + 1 == rows, 0, j + 1)
            else:
                b = 1.0
                j = wp.where(j == 0, rows - 1, j - 1)
        step += 1
    return wp.vec4(hit_a, hit_b, wp.where(found == 1, float(i), -1.0), float(j))


@wp.func
def nearest_point(hit: wp.vec4, sub: int, width: int, rows: int) -> int:
    """Return the surface point in whose sub-square a hit of :func:`trace_ray` lies; −1 for none."""
    # Sub-squares from the texel centre at which the cell starts: a texel begins half a texel before its centre.
    x = int(wp.floor(hit[0] * float(sub) + 0.5 * float(sub)))
    y = int(wp.floor(hit[1] * float(sub) + 0.5 * float(sub)))
    column = int(hit[2]) + x / sub
    row = int(hit[3]) + y / sub
    column = wp.where(column >= width, column - width, column)
    row = wp.where(row >= rows, row - rows, row)
    texel = row * width + column
    point = (texel * sub + y % sub) * sub + x % sub
    return wp.where(hit[2] < 0.0, -1, point)


@functools.cache
def _make_trace(lanes: int):
    L = lanes

    @wp.kernel(module="unique", module_options=dispatch.module_options())
    def height_field_trace_kernel(
        first: int,
        mode: int,
        level: wp.array(dtype=wp.float32),
        normal: wp.array(dtype=wp.vec3),
        tangent: wp.array(dtype=wp.vec3),
        directions: wp.array(dtype=wp.vec3),
        direction_count: int,
        height: wp.array(dtype=wp.float32),
        top: wp.array(dtype=wp.float32),
        width: int,
        rows: int,
        sub: int,
        plane: float,
        ceiling: float,
        count: int,
        # outputs
        found: wp.array(dtype=wp.int32),
    ):
        """Mode 0: rays of views through the plane. 1: to lights, 1 where nothing is in the way. 2: bounces."""
        b = first + wp.tid()
        for l in range(L):
            r = b * L + l
            if r < count:
                p = r / direction_count
                w = directions[r - p * direction_count]
                texel = p / (sub * sub)
                k = p - texel * sub * sub
                row = texel / width
                column = texel - row * width
                x = (float(k % sub) + 0.5) / float(sub) - 0.5
                y = (float(k / sub) + 0.5) / float(sub) - 0.5
                z = plane
                d = wp.vec3(w[0], -w[1], w[2])
                go = int(1)
                if mode == 0:
                    reach = (ceiling - plane) / w[2]
                    x = x + d[0] * reach
                    y = y + d[1] * reach
                    z = ceiling
                    d = -d
                else:
                    n = normal[p]
                    if mode == 2:
                        t = tangent[p]
                        u = wp.cross(n, t)
                        v = t * w[0] + u * w[1] + n * w[2]
                        d = wp.vec3(v[0], -v[1], v[2])
                        w = v
                    if wp.dot(n, w) <= 0.0:
                        go = 0
                    x = x + n[0] * _OFFSET
                    y = y - n[1] * _OFFSET
                    z = level[p] + n[2] * _OFFSET
                answer = wp.where(mode == 1, int(0), int(-1))
                if go == 1:
                    left = int(wp.floor(x))
                    up = int(wp.floor(y))
                    start = wp.vec3(x - float(left), y - float(up), z)
                    hit = trace_ray(
                        wrapped(column + left, width), wrapped(row + up, rows), start, d,
                        height, top, width, rows, ceiling,
                    )  # fmt: skip
                    if mode == 1:
                        answer = wp.where(hit[2] < 0.0, 1, 0)
                    else:
                        answer = nearest_point(hit, sub, width, rows)
                found[r] = answer

    return height_field_trace_kernel


def vectors(values, device) -> wp.array:
    """Return rows of three numbers as a Warp array of vectors."""
    return wp.array(np.ascontiguousarray(values, np.float32), dtype=wp.vec3, device=device)


def floats(values, device) -> wp.array:
    """Return numbers as a flat Warp array of float32."""
    return wp.array(np.ascontiguousarray(values, np.float32).ravel(), dtype=wp.float32, device=device)


@dataclasses.dataclass(frozen=True)
class Surface:
    """A height field and its surface points as arrays on a device; made by :func:`surface`."""

    width: int
    rows: int
    sub: int
    plane: float
    """Height that slices are seen at: a texel is the part of this plane that its rays pass [texel]."""
    ceiling: float
    height: wp.array
    top: wp.array
    level: wp.array
    normal: wp.array
    tangent: wp.array
    angle: np.ndarray
    """Direction of the first tangent before it is laid onto the surface [rad], shape [points]."""
    device: str

    @property
    def points(self) -> int:
        """Number of surface points."""
        return self.width * self.rows * self.sub * self.sub


def sub_positions(sub: int) -> np.ndarray:
    """Return where the s sub-squares of a texel lie, in texels from its centre, ascending, shape [s]."""
    return (np.arange(sub) + 0.5) / sub - 0.5


def interpolated(values: np.ndarray, sub: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a periodic field, and its slopes along columns and rows, at the surface points.

    Args:
        values: Values at texel centres, shape [rows, width] or [rows, width, c].
        sub: Points along the side of a texel, even: an odd number would put one on a crease between patches.

    Returns:
        Three arrays of shape [points] or [points, c], float64, of the bilinear interpolant.
    """
    values = np.asarray(values, np.float64)
    rows, width = values.shape[:2]
    out = np.empty((3, rows, width, sub, sub, *values.shape[2:]))
    for i, y in enumerate(sub_positions(sub)):
        for j, x in enumerate(sub_positions(sub)):
            a, b = x % 1.0, y % 1.0
            shift = (1 if y < 0 else 0, 1 if x < 0 else 0)
            h00 = np.roll(values, shift, (0, 1))
            h10, h01 = np.roll(h00, -1, 1), np.roll(h00, -1, 0)
            h11 = np.roll(h10, -1, 0)
            twist = h11 - h10 - h01 + h00
            out[0, :, :, i, j] = h00 + (h10 - h00) * a + (h01 - h00) * b + twist * a * b
            out[1, :, :, i, j] = h10 - h00 + twist * b
            out[2, :, :, i, j] = h01 - h00 + twist * a
    return tuple(out.reshape(3, rows * width * sub * sub, *values.shape[2:]))


def point_frames(height: np.ndarray, angle: np.ndarray, sub: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return height [points], unit normal [points, 3] and first tangent [points, 3] of surface points, float64.

    The tangent is the direction ``angle`` [rad] about z from +x, one per texel, laid onto the surface.
    """
    level, along, down = interpolated(height, sub)
    normal = np.stack([-along, down, np.ones_like(level)], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    turn = np.repeat(np.asarray(angle, np.float64).ravel(), sub * sub)
    tangent = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], 1)
    tangent -= normal * (normal * tangent).sum(1, keepdims=True)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return level, normal, tangent


def surface(height: np.ndarray, angle: np.ndarray, sub: int = 2, *, plane: float | None = None, device=None) -> Surface:
    """Return the :class:`Surface` of a height field.

    Args:
        height: Heights at texel centres [texel], shape [rows, width].
        angle: Direction of the first tangent [rad], shape [rows, width].
        sub: Surface points, and rays, along the side of a texel: even.
        plane: Height of the plane that is seen [texel]; the mean height where not given.
        device: Warp device.

    Raises:
        ValueError: If the shape is not that of a picture, a height is not finite, or ``sub`` is odd.
    """
    height = np.asarray(height, np.float32)
    if height.ndim != 2 or not height.size or not np.isfinite(height).all():
        raise ValueError(f"height must be finite numbers of shape (rows, width), got {height.shape}")
    if sub < 2 or sub % 2:
        raise ValueError(f"sub must be even and at least 2, got {sub}")
    level, normal, tangent = point_frames(height, angle, sub)
    right = np.maximum(height, np.roll(height, -1, 1))
    top = np.maximum(right, np.roll(right, -1, 0))
    device = wp.get_device(device)
    return Surface(
        height.shape[1], height.shape[0], sub, float(height.mean(dtype=np.float64) if plane is None else plane),
        float(height.max()) + 1e-3, floats(height, device), floats(top, device), floats(level, device),
        vectors(normal, device), vectors(tangent, device),
        np.repeat(np.asarray(angle, np.float64).ravel(), sub * sub), device.alias,
    )  # fmt: skip


def _trace(field: Surface, mode: int, directions) -> np.ndarray:
    directions = np.ascontiguousarray(directions, np.float32).reshape(-1, 3)
    count, lanes = field.points * len(directions), dispatch.lanes(field.device)
    if count >= 1 << 31:
        raise ValueError(f"{field.points} points × {len(directions)} directions are too many for one launch")
    found = wp.empty(count, dtype=wp.int32, device=field.device)
    inputs = [
        mode, field.level, field.normal, field.tangent, vectors(directions, field.device), len(directions),
        field.height, field.top, field.width, field.rows, field.sub, field.plane, field.ceiling, count,
    ]  # fmt: skip
    dispatch.launch(_make_trace(lanes), dispatch.blocks(count, lanes), inputs, [found], device=field.device)
    return found.numpy().reshape(field.points, len(directions))


def trace_views(field: Surface, directions) -> np.ndarray:
    """Return the point that every ray of a view sees, shape [directions, points], int32.

    Ray ``texel · s² + k`` runs along −ω_o through the centre of sub-square k of the texel, on the plane. ``directions``
    ω_o are unit with z ≥ 0.01, shape [n, 3].

    Error: against float64, at most 2 in 10⁴ rays see the point beside the true one, where they meet on the line between
        two sub-squares; held by test_rays_see_the_points_of_the_reference.
    """
    seen = _trace(field, 0, directions).T
    own = np.arange(field.points, dtype=np.int32)
    return np.where(seen < 0, own, seen)


def trace_lights(field: Surface, directions) -> np.ndarray:
    """Return 1 where the light along ω_i, z ≥ 0.01, reaches a point, else 0: shape [points, directions], int32.

    Error: against float64, at most 2 in 10⁴ points, those on the edge of a shadow; held by
        test_lights_reach_the_points_of_the_reference.
    """
    return _trace(field, 1, directions)


def trace_bounces(field: Surface, directions) -> np.ndarray:
    """Return the point that rays from every point meet, shape [points, directions], int32, −1 for none.

    ``directions`` are in the frames of the points: first tangent, second, normal.

    Error: as :func:`trace_views`; held by test_bounces_meet_the_points_of_the_reference.
    """
    return _trace(field, 2, directions)
