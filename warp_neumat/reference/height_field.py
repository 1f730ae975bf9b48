"""Path tracing on a periodic height field in float64, path by path: the twin of ``kernels/height_field*.py``.

Nothing is shared: every path traces its own ray to the light and its own bounces, each by intersecting the bilinear
patches of all cells between sorted crossings of the grid. Frame: positions (column, row, z) in texels from the centre
of texel (0, 0), directions (x, y, z) with y up, against the rows.
"""

import numpy as np

OFFSET = 1e-3
_PIECE = 12.0


def patch(height, x, y):
    """Return height and slopes along columns and rows of the bilinear interpolant at (x, y)."""
    h = np.asarray(height, np.float64)
    rows, width = h.shape
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    a, b = x - i, y - j
    h00, h10 = h[j % rows, i % width], h[j % rows, (i + 1) % width]
    h01, h11 = h[(j + 1) % rows, i % width], h[(j + 1) % rows, (i + 1) % width]
    value = h00 * (1 - a) * (1 - b) + h10 * a * (1 - b) + h01 * (1 - a) * b + h11 * a * b
    return value, (h10 - h00) * (1 - b) + (h11 - h01) * b, (h01 - h00) * (1 - a) + (h11 - h10) * a


def point_positions(shape, sub):
    """Return columns and rows of the surface points, ``texel · s² + k``: two arrays [points]."""
    rows, width = shape
    j, i, t, s = np.meshgrid(*(np.arange(n) for n in (rows, width, sub, sub)), indexing="ij")
    return (i + (s + 0.5) / sub - 0.5).ravel(), (j + (t + 0.5) / sub - 0.5).ravel()


def frames(height, fibre, sub):
    """Return positions [points, 3], normals and first tangents [points, 3] of the surface points."""
    x, y = point_positions(np.shape(height), sub)
    z, along, down = patch(height, x, y)
    n = np.stack([-along, down, np.ones_like(z)], 1)
    n /= np.linalg.norm(n, axis=1)[:, None]
    turn = np.repeat(np.ravel(fibre), sub * sub)
    t = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    t -= n * (n * t).sum(1)[:, None]
    return np.stack([x, y, z], 1), n, t / np.linalg.norm(t, axis=1)[:, None]


def trace(height, start, direction):
    """Return (column, row) of the first hit of rays, [n, 2], NaN for none; ``direction`` (x, y up, z), rows of each."""
    height = np.asarray(height, np.float64)
    start, d = np.asarray(start, np.float64), np.asarray(direction, np.float64) * [1, -1, 1]
    low, high = height.min() - 1e-3, height.max() + 1e-3
    with np.errstate(divide="ignore"):
        end = np.where(d[:, 2] > 0, (high - start[:, 2]) / d[:, 2], (low - start[:, 2]) / d[:, 2])
    out, left, begin = np.full((len(start), 2), np.nan), np.arange(len(start)), 0.0
    while len(left):  # piece by piece: near the horizon a ray is long, and most end soon
        for chunk in np.array_split(left, max(1, len(left) // 2048)):
            part = start[chunk] + begin * d[chunk]
            out[chunk] = _trace(height, part, d[chunk], np.clip(end[chunk] - begin, 0, _PIECE))
        begin += _PIECE
        left = left[np.isnan(out[left, 0]) & (end[left] > begin)]
    return out


def _trace(height, start, d, end):
    rows, width = height.shape
    crossings = [np.zeros((len(start), 1)), end[:, None]]
    for axis in (0, 1):
        reach = int(np.ceil(np.abs(d[:, axis] * end).max(initial=0))) + 2
        first = np.where(d[:, axis] > 0, np.ceil(start[:, axis]), np.floor(start[:, axis]))
        lines = first[:, None] + np.sign(d[:, axis])[:, None] * np.arange(reach)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (lines - start[:, axis, None]) / d[:, axis, None]
        crossings.append(np.where(np.isfinite(t), np.clip(t, 0, end[:, None]), end[:, None]))
    t = np.sort(np.concatenate(crossings, 1), 1)
    t0, t1 = t[:, :-1], t[:, 1:]
    middle = start[:, None] + 0.5 * (t0 + t1)[..., None] * d[:, None]
    i, j = np.floor(middle[..., 0]).astype(int), np.floor(middle[..., 1]).astype(int)
    h00, h10 = height[j % rows, i % width], height[j % rows, (i + 1) % width]
    h01, h11 = height[(j + 1) % rows, i % width], height[(j + 1) % rows, (i + 1) % width]
    hx, hy, hxy = h10 - h00, h01 - h00, h11 - h10 - h01 + h00
    at = start[:, None] + t0[..., None] * d[:, None]
    a, b, dx, dy, dz = at[..., 0] - i, at[..., 1] - j, *(d[:, k, None] for k in range(3))
    c0 = at[..., 2] - (h00 + hx * a + hy * b + hxy * a * b)
    c1 = dz - (hx * dx + hy * dy + hxy * (a * dy + b * dx))
    c2 = -hxy * dx * dy
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(c1 * c1 - 4 * c2 * c0)
        s = np.where(c0 <= 0, 0.0, 2 * c0 / (root - c1))
    hit = (s >= 0) & (s <= t1 - t0 + 1e-12) & (t1 > t0)
    first = hit.argmax(1)
    pick = np.arange(len(start))
    when = np.where(hit.any(1), t0[pick, first] + np.where(hit, s, 0)[pick, first], np.nan)
    return start[:, :2] + when[:, None] * d[:, :2]


def nearest(shape, hits, sub):
    """Return the surface points in whose sub-squares hits lie, −1 where NaN."""
    rows, width = shape
    lost = np.isnan(hits[:, 0])
    x, y = np.floor((np.where(lost[:, None], 0, hits) + 0.5) * sub).astype(int).T
    texel = (y // sub) % rows * width + (x // sub) % width
    return np.where(lost, -1, (texel * sub + y % sub) * sub + x % sub)


class PathTracer:
    """A surface whose paths are traced one by one.

    Args:
        height, fibre: [H, W]; ``albedo`` [H, W, 3]; ``alpha`` [H, W, 2]; ``f0`` [H, W], as ``MicroGeometry`` has them.
        sub: Points and rays along the side of a texel.
        bounces: Directions of bounces in the frames of points, [n, 3].
    """

    def __init__(self, height, albedo, alpha, f0, fibre, sub, bounces):
        self.height, self.sub, self.bounces = np.asarray(height, np.float64), sub, np.asarray(bounces, np.float64)
        self.position, self.normal, self.tangent = frames(height, fibre, sub)
        x, y = self.position[:, 0], self.position[:, 1]
        self.albedo = np.stack([patch(albedo[..., k], x, y)[0] for k in range(3)], 1)
        self.alpha = np.repeat(np.reshape(alpha, (-1, 2)).astype(np.float64), sub * sub, 0)
        self.f0 = np.repeat(np.ravel(f0).astype(np.float64), sub * sub)

    def seen(self, wo):
        """Return the points that the rays of a view see."""
        wo = np.asarray(wo, np.float64)
        x, y = self.position[:, 0], self.position[:, 1]
        plane, top = np.asarray(self.height).mean(), self.height.max() + 1e-3
        reach = (top - plane) / wo[2]
        start = np.stack([x + wo[0] * reach, y - wo[1] * reach, np.full_like(x, top)], 1)
        return nearest(self.height.shape, trace(self.height, start, np.broadcast_to(-wo, start.shape)), self.sub)

    def left(self, points):
        """Return where rays leave ``points``."""
        return self.position[points] + OFFSET * self.normal[points] * [1, -1, 1]

    def lit(self, points, wi):
        """Return whether the light along ω_i reaches ``points``."""
        wi = np.asarray(wi, np.float64)
        away = self.normal[points] @ wi <= 0
        return ~away & np.isnan(trace(self.height, self.left(points), np.broadcast_to(wi, (len(points), 3)))[:, 0])

    def met(self, points):
        """Return the points that bounces from ``points`` meet, [points, n], −1 for none."""
        n, t = self.normal[points], self.tangent[points]
        axes = np.stack([t, np.cross(n, t), n], 1)
        d = np.einsum("bk,pkc->pbc", self.bounces, axes)
        start = np.repeat(self.left(points), len(self.bounces), 0)
        return nearest(self.height.shape, trace(self.height, start, d.reshape(-1, 3)), self.sub).reshape(d.shape[:2])

    def sent(self, points, wi, passes):
        """Return G of ``points``: diffuse light by up to ``passes`` bounces, before the viewer's Fresnel term."""
        c = np.maximum(self.normal[points] @ np.asarray(wi, np.float64), 0)
        rho, f0 = self.albedo[points] / np.pi, self.f0[points]
        total = rho * (c * self.lit(points, wi) * (1 - f0) * (1 - (1 - c) ** 5))[:, None]
        if passes and len(points):
            met = self.met(points)
            light = np.zeros((*met.shape, 3))
            q = met[met >= 0]
            light[met >= 0] = self.sent(q, wi, passes - 1) * ((1 - self.f0[q]) * 20 / 21)[:, None]
            total += rho * ((1 - f0) * 20 / 21)[:, None] * np.pi * light.mean(1)
        return total

    def slice(self, wi, wo, passes):
        """Return value × cos θ_i of a pair of directions, [H, W, 3]."""
        wi, wo = np.asarray(wi, np.float64), np.asarray(wo, np.float64)
        p = self.seen(wo)
        n, t, f0 = self.normal[p], self.tangent[p], self.f0[p]
        b = np.cross(n, t)
        nl, nv = np.maximum(n @ wi, 0), np.maximum(n @ wo, 1e-3)
        h = (wi + wo) / np.linalg.norm(wi + wo)
        ax, ay = self.alpha[p].T
        d = 1 / (np.pi * ax * ay * ((t @ h / ax) ** 2 + (b @ h / ay) ** 2 + (n @ h) ** 2) ** 2)
        width_i = np.sqrt((ax * (t @ wi)) ** 2 + (ay * (b @ wi)) ** 2 + nl**2)
        width_o = np.sqrt((ax * (t @ wo)) ** 2 + (ay * (b @ wo)) ** 2 + nv**2)
        f = f0 + (1 - f0) * (1 - wo @ h) ** 5
        lobe = f * d * nl / (2 * (nv * width_i + nl * width_o)) * self.lit(p, wi)
        through = (1 - f0) * (1 - np.clip(1 - nv, 0, 1) ** 5)
        value = self.sent(p, wi, passes) * through[:, None] + lobe[:, None]
        return value.reshape(*self.height.shape, self.sub**2, 3).mean(2)
