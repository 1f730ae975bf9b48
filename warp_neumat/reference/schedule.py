"""What a scheduler knows of a tile, in float64, with finite differences and loops: twin of ``kernels/schedule.py``."""

import numpy as np

from .proxy import proxy
from .shade import punctual, raised

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def root(params, points, normals, eye, position, intensity, gain, limits=None) -> np.ndarray:
    """Return √Y of what a display shows of proxies of luminance under point lights, (N,).

    Args:
        params: Diffuse, specular, grazing and α², (N, 4).
        points, normals: Of the samples, (N, 3) each, normals of any length.
        eye: Position of the viewer, (3,).
        position, intensity: Of the lights, (L, 3) each.
        gain: What radiance is multiplied by before it is shown.
        limits: For each light, what :func:`~.shade.punctual` takes after its first argument; None = without end.
    """
    params, points, normals = (np.asarray(a, np.float64) for a in (params, points, normals))
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    viewer = np.asarray(eye, np.float64) - points
    viewer = raised(viewer / np.linalg.norm(viewer, axis=1, keepdims=True), normals)
    diffuse, specular, grazing, alpha2 = params.T
    none, luminance = np.zeros(len(points)), 0.0
    limits = [()] * len(position) if limits is None else limits
    for at, power, limit in zip(position, np.asarray(intensity, np.float64) @ LUMINANCE, limits, strict=True):
        d = np.asarray(at, np.float64) - points
        distance = np.linalg.norm(d, axis=1, keepdims=True)
        value = proxy(np.stack([diffuse, specular, alpha2], 1), normals, d / distance, viewer)
        rise = proxy(np.stack([none, none - 1e-300, alpha2], 1), normals, d / distance, viewer)
        luminance = luminance + power * punctual(-d, *limit) / distance[:, 0] ** 2 * (value + grazing * rise)
    return np.sqrt(np.clip(gain * luminance, 0, 1))


def texel_size(points, corners, weights, pixel, step=1e-4) -> np.ndarray:
    """Return the longer axis on the picture [px] of what a texel's unit circle becomes, (N,).

    Args:
        points: Of the samples' triangles, (N, 3, 3).
        corners: The same on the sheet [texel], (N, 3, 2).
        weights: Barycentric weights of the samples, (N, 3).
        pixel: ``pixel(points) -> (N, 2)`` projects onto the picture [px].
        step: Of the central differences [texel].
    """
    points, corners, weights = (np.asarray(a, np.float64) for a in (points, corners, weights))
    system = np.concatenate([corners, np.ones((len(corners), 3, 1))], axis=2).transpose(0, 2, 1)
    at = np.einsum("nk,nkc->nc", weights, corners)

    def there(dx, dy):
        texel = np.concatenate([at + (dx, dy), np.ones((len(at), 1))], axis=1)
        return pixel(np.einsum("nk,nkc->nc", np.linalg.solve(system, texel[..., None])[..., 0], points))

    columns = [(there(step, 0) - there(-step, 0)) / (2 * step), (there(0, step) - there(0, -step)) / (2 * step)]
    return np.linalg.norm(np.stack(columns, axis=2), ord=2, axis=(1, 2))


def learn(tile, rate, done, texels, mul, sub, gain) -> tuple[float | None, float | None]:
    """Return what shading has left of a tile: its mean change and its roughness; None where nothing is to be seen.

    Args:
        tile: Column and row of the tile.
        rate: Its rate.
        done: Texels of the sheet that are shaded, (height, width).
        texels: RGB and change of each, (height, width, 4); the radiance is RGB · ``mul`` − ``sub``.
        gain: What radiance is multiplied by before it is shown.
    """
    step, (x0, y0) = 1 << rate, (8 * tile[0], 8 * tile[1])
    height, width = done.shape

    def root_at(x, y):
        """Return √Y of an anchor of the tile, or of the first beyond it where the rate is coarse; None = not known."""
        reach = 8 if rate == 0 else 9
        if x - x0 >= reach or y - y0 >= reach or x < x0 or y < y0 or x >= width or y >= height or not done[y, x]:
            return None
        return np.sqrt(np.clip(gain * (texels[y, x, :3].astype(np.float64) @ LUMINANCE * mul - sub), 0, 1))

    changes, bends = [], []
    for y in range(y0, y0 + 9, step):
        for x in range(x0, x0 + 9, step):
            centre = root_at(x, y)
            if centre is None:
                continue
            change = float(texels[y, x, 3])
            if x - x0 < 8 and y - y0 < 8 and 0 <= change <= 1:
                changes.append(change)
            for dx, dy in ((step, 0), (0, step)):
                if (x - x0 if dx else y - y0) // step % 2 == 0:
                    continue
                before, after = root_at(x - dx, y - dy), root_at(x + dx, y + dy)
                if before is not None and after is not None:
                    bends.append(centre - 0.5 * (before + after))
    change = float(np.mean(changes)) if changes else None
    return change, float(np.sqrt(np.mean(np.square(bends)))) if bends else None
