"""Chart making and packing: xatlas in a child process with a time limit, and a packer of our own that always works.

Both packers take charts in *surface units* (one unit of length on the sheet before scaling is one unit of length on the
mesh, so that one scale gives every part the same texel density) and return corners in texels of one square sheet.

The child gets its arrays through ``in.npz`` in a temporary folder and replaces ``out.npz`` there, atomically, whenever
it has found a denser packing: a kill at any moment leaves the best result so far, or none. It imports numpy and xatlas.
"""

import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

BORDER = 2  # texels around xatlas' sheet, which places charts flush with its edge

_INSET = 0.5 + 1 / 32  # where a chart starts in its rectangle: its footprint, 1/64 wider than bilinear, stays inside
_ROUNDS = 12
_PATCH = 2000  # xatlas' time grows faster than its input: 69k triangles in one piece take over 5 times longer


class UnwrapError(RuntimeError):
    """xatlas gave no usable result; ``timed_out`` says whether more time could help."""

    def __init__(self, reason: str, timed_out: bool = False):
        super().__init__(reason)
        self.timed_out = timed_out


def triangle_areas(corners: np.ndarray) -> np.ndarray:
    """Return areas of triangles [n, 3, 2 or 3]; signed (positive where corners turn from x to y) in two dimensions."""
    p, q = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    if corners.shape[2] == 2:
        return 0.5 * (p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])
    return 0.5 * np.linalg.norm(np.cross(p, q), axis=1)


def connected(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return component numbers 0 … k − 1 of ``count`` nodes joined by edges a–b, by lowest member."""
    label = np.arange(count)
    while True:
        low = np.minimum(label[a], label[b])
        before = label.copy()
        np.minimum.at(label, before[a], low)
        np.minimum.at(label, before[b], low)
        while (label != label[label]).any():
            label = label[label]
        if (label == before).all():
            return np.unique(label, return_inverse=True)[1].astype(np.int32)


def face_edges(keys: np.ndarray):
    """Return ``(first, second)``: pairs of faces with a common edge; ``keys`` [n, 3] numbers the corners."""
    edge = np.sort(np.stack([keys, np.roll(keys, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    order = np.lexsort((edge[:, 1], edge[:, 0]))
    same = (edge[order[1:]] == edge[order[:-1]]).all(axis=1)
    return order[:-1][same] // 3, order[1:][same] // 3


# --- our own packer ---------------------------------------------------------------------------------------------------


def right_triangle_cells(points: np.ndarray, faces: np.ndarray, part: np.ndarray):
    """Return ``(uv [n, 3, 2], chart [n])``: each triangle as half of a square of its own area, in surface units.

    Two triangles of a part that share an edge share a square, joined at its diagonal (longest edges are matched first,
    so the two halves of a quad meet); a triangle that finds no partner fills half of its square. Faces without area get
    chart −1.
    """
    corners = points[faces].astype(np.float64)
    area = triangle_areas(corners)
    first, second = face_edges(faces)
    fits = (first != second) & (part[first] == part[second]) & (area[first] > 0) & (area[second] > 0)
    first, second = first[fits], second[fits]
    common = (faces[first][:, :, None] == faces[second][:, None, :]).any(axis=2)
    apex = np.argmin(common, axis=1)  # the corner of `first` off the common edge
    length = np.linalg.norm(corners[first, (apex + 1) % 3] - corners[first, (apex + 2) % 3], axis=1)
    partner, matched = np.full(len(faces), -1), []
    for i in np.argsort(-length, kind="stable"):
        if partner[first[i]] < 0 and partner[second[i]] < 0:
            partner[first[i]], partner[second[i]] = second[i], first[i]
            matched.append(i)
    f, g, apex = first[matched], second[matched], apex[matched]

    origin, right, down, opposite = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    uv = np.broadcast_to(np.stack([origin, right, down]), (len(faces), 3, 2)).copy()
    for j, where in enumerate((origin, right, down)):
        uv[f, (apex + j) % 3] = where
    u, v = faces[f, (apex + 1) % 3, None], faces[f, (apex + 2) % 3, None]
    for k in range(3):
        vertex = faces[g, k, None]
        uv[g, k] = np.where(vertex == u, right, np.where(vertex == v, down, opposite))

    own = np.arange(len(faces))
    leader = np.where(partner < 0, own, np.minimum(own, partner))
    square = np.where(partner < 0, 2 * area, area + area[np.maximum(partner, 0)])
    chart = np.full(len(faces), -1, np.int32)
    chart[area > 0] = np.unique(leader[area > 0], return_inverse=True)[1]
    return uv * np.sqrt(square)[:, None, None], chart


def shelf_pack(uv: np.ndarray, chart: np.ndarray, size: int) -> np.ndarray | None:
    """Pack the boxes of charts in rows of falling height, at the largest scale that fits ``size`` × ``size`` texels.

    Args:
        uv: Corners in surface units, shape [n, 3, 2]. Every chart number from 0 up is in use.
        chart: Chart of each triangle, shape [n]; faces of chart −1 come back as NaN.
        size: Side of the sheet [texel].

    Returns:
        Corners [texel], shape [n, 3, 2], whose charts' bilinear footprints are disjoint and on the sheet, and no more:
        texels between them would cost small charts most of their room. ``None`` if there are too many charts even at
        2 × 2 texels each.
    """
    used = chart >= 0
    count = chart.max(initial=-1) + 1
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    for k in range(3):
        np.minimum.at(low, chart[used], uv[used, k])
        np.maximum.at(high, chart[used], uv[used, k])
    extent = high - low
    order = np.lexsort((np.arange(count), -extent[:, 0], -extent[:, 1]))

    def rows(scale):
        cell = np.ceil(extent[order] * scale + 2 * _INSET).astype(np.int64)
        if (cell > size).any():
            return None
        end = np.cumsum(cell[:, 0])
        corner = np.empty((count, 2), np.int64)
        i = top = 0
        while i < count:
            left = end[i - 1] if i else 0
            stop = np.searchsorted(end, left + size, side="right")
            height = cell[i:stop, 1].max()
            if top + height > size:
                return None
            corner[order[i:stop], 0] = end[i:stop] - cell[i:stop, 0] - left
            corner[order[i:stop], 1] = top
            top += height
            i = stop
        return corner

    best, scale = rows(0.0), 0.0
    if best is None:
        return None
    low_scale, high_scale = 0.0, size / max(extent.max(), np.sqrt(extent.prod(axis=1).sum()))
    for _ in range(30):
        middle = 0.5 * (low_scale + high_scale)
        found = rows(middle)
        if found is None:
            high_scale = middle
        else:
            low_scale, best, scale = middle, found, middle
    packed = np.full(uv.shape, np.nan)
    packed[used] = (uv[used] - low[chart[used], None]) * scale + best[chart[used], None] + _INSET
    return packed


# --- xatlas in a child process ----------------------------------------------------------------------------------------


def xatlas_unwrap(points, faces, part, uv, chart, *, resolution: int, padding: int, time_limit: float, progress=None):
    """Parametrise ``faces`` with xatlas, pack them with the charts of ``uv``; return ``(corners, chart, finished)``.

    Args:
        points: Welded positions, shape [v, 3].
        faces: Triangles without texture coordinates, shape [n, 3].
        part: Part of each of them; charts do not cross parts. Shape [n].
        uv: Corners of triangles that keep their charts, in surface units, shape [m, 3, 2].
        chart: Charts of those, shape [m].
        resolution: Side of the sheet [texel].
        padding: Texels between charts.
        time_limit: Seconds until the child is stopped.
        progress: Called as ``progress(fraction, text)``.

    Returns:
        Corners [texel] of the n + m triangles; their charts, −1 where xatlas left a triangle out; and whether the
        search for the densest packing came to its end within the time.

    Raises:
        UnwrapError: If there is no result.
    """
    with tempfile.TemporaryDirectory(prefix="neumat-unwrap-", ignore_cleanup_errors=True) as folder:
        job = {"points": points, "faces": faces, "part": part, "uv": uv, "chart": chart}
        np.savez(Path(folder, "in.npz"), resolution=resolution, padding=padding, **job)
        reason = _run_child(folder, time_limit, progress)
        if progress is not None:
            progress(1.0, "unwrapped" if reason is None else reason)
        try:
            with np.load(Path(folder, "out.npz")) as result:
                return result["corners"], result["chart"], reason is None
        except FileNotFoundError:
            timed_out = reason is not None and reason.startswith("time")
            raise UnwrapError(reason or "xatlas found no packing", timed_out) from None


def _run_child(folder: str, time_limit: float, progress) -> str | None:
    """Run this file as a program on ``folder``; return why it did not come to its end, or ``None``."""
    start = time.monotonic()
    # Not `-m`: importing the package would load Warp. Not by path alone: that puts this folder first on sys.path.
    program = "import runpy, sys; runpy.run_path(sys.argv.pop(1), run_name='__main__')"
    with open(Path(folder, "errors.txt"), "wb") as errors:
        child = subprocess.Popen(
            [sys.executable, "-c", program, str(Path(__file__).resolve()), folder],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        )
        lines = queue.SimpleQueue()

        def read():
            for line in child.stdout:
                lines.put(line)

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        fraction, text = 0.0, "starting xatlas"
        try:
            while child.poll() is None:
                spent = time.monotonic() - start
                if spent > time_limit:
                    return f"time limit of {time_limit:g} s reached"
                while not lines.empty():
                    head, _, text = lines.get().strip().partition(" ")
                    fraction = max(fraction, float(head))
                if progress is not None:  # xatlas does not tell how far it is: within a stage, time is all we know
                    progress(max(fraction, min(spent / time_limit, 0.99)), text)
                time.sleep(0.02)
        finally:
            if child.poll() is None:
                child.kill()
            child.wait()
            reader.join(timeout=1.0)
            child.stdout.close()
    if child.returncode == 0:
        return None
    tail = Path(folder, "errors.txt").read_text(errors="replace").strip().splitlines()
    return f"xatlas failed with exit code {child.returncode}" + (f": {tail[-1]}" if tail else "")


def _patches(centre: np.ndarray, rows: np.ndarray) -> list[np.ndarray]:
    """Halve a set of triangles along its longest axis until every patch has at most ``_PATCH`` of them."""
    if len(rows) <= _PATCH:
        return [rows]
    axis = np.ptp(centre[rows], axis=0).argmax()
    order = rows[np.argsort(centre[rows, axis], kind="stable")]
    half = len(rows) // 2
    return _patches(centre, order[:half]) + _patches(centre, order[half:])


def _parametrise(xatlas, points, faces, part):
    """Return ``(uv [n, 3, 2] in surface units, chart [n])`` of new charts; −1 where xatlas drops a triangle."""
    unit = np.sqrt(
        triangle_areas(points[faces]).mean()
    )  # xatlas' tolerances are absolute, made for triangles of size 1
    atlas, centre = xatlas.Atlas(), points[faces].mean(axis=1)
    rows = [patch for p in np.unique(part) for patch in _patches(centre, np.flatnonzero(part == p))]
    for row in rows:
        vertices, local = np.unique(faces[row], return_inverse=True)
        local = local.reshape(-1, 3).astype(np.uint32)
        atlas.add_mesh((points[vertices] / unit).astype(np.float32), local)
    pack = xatlas.PackOptions()
    pack.texels_per_unit, pack.padding = 8.0, 0
    atlas.generate(xatlas.ChartOptions(), pack)
    uv, chart, count = np.zeros((len(faces), 3, 2)), np.full(len(faces), -1, np.int64), 0
    sheet = [atlas.width, atlas.height]
    for mesh, row in enumerate(rows):
        _, index, where = atlas[mesh]
        uv[row] = (where.astype(np.float64) * sheet)[index]
        for i in range(atlas.get_mesh_chart_count(mesh)):
            chart[row[np.asarray(atlas.get_mesh_chart(mesh, i).faces)]] = count + i
        count += atlas.get_mesh_chart_count(mesh)
    chart[triangle_areas(uv) == 0] = -1
    rows = np.flatnonzero(chart >= 0)  # xatlas stretches a chart to whole texels: back to the area of its surface
    surface = np.bincount(chart[rows], triangle_areas(points[faces[rows]]))
    uv[rows] *= np.sqrt(surface / np.bincount(chart[rows], np.abs(triangle_areas(uv[rows]))))[chart[rows], None, None]
    return uv, chart


def _pack_once(xatlas, vertices, index, material, size: int, padding: int, scale: float, to_axis: bool):
    """Return ``(corners [texel], chart)`` of triangles with mean area 1, or ``None`` if one sheet cannot hold them.

    ``to_axis`` turns charts to the axis of their hull first, which helps some sets of charts and hurts others.
    """
    atlas, pack = xatlas.Atlas(), xatlas.PackOptions()
    atlas.add_uv_mesh(vertices, index, material)
    pack.resolution, pack.texels_per_unit, pack.bilinear, pack.rotate_charts_to_axis = size, scale, True, to_axis
    pack.padding = max(2, (padding + 1) // 2)  # xatlas leaves twice this between two charts
    atlas.generate(xatlas.ChartOptions(), pack)
    if atlas.atlas_count != 1 or max(atlas.width, atlas.height) > size:
        return None
    _, faces, where = atlas[0]
    corners = (where.astype(np.float64) * [atlas.width, atlas.height])[faces]
    if np.abs(triangle_areas(corners)).sum() < 0.995 * len(faces) * scale**2:
        return None  # a chart larger than the sheet was shrunk without a word: its texels would be larger than others
    chart = np.full(len(faces), -1, np.int64)
    for c in range(atlas.get_mesh_chart_count(0)):
        chart[np.asarray(atlas.get_mesh_chart(0, c).faces)] = c
    return corners, chart


def _search(xatlas, uv, chart, size: int, padding: int, save, say) -> None:
    """Pack charts at growing scale until one sheet is full; hand every result that fits to ``save``."""
    rows = np.flatnonzero(chart >= 0)
    unit = np.sqrt(np.abs(triangle_areas(uv[rows])).mean())  # xatlas drops triangles below an absolute area
    keys = np.column_stack([np.repeat(chart[rows], 3), uv[rows].reshape(-1, 2) / unit])
    vertices, index = np.unique(keys, axis=0, return_inverse=True)
    mesh = (
        vertices[:, 1:].astype(np.float32),
        index.reshape(-1, 3).astype(np.uint32),
        chart[rows, None].astype(np.uint32),
    )
    low, high, scale = 0.0, np.inf, 0.85 * size / np.sqrt(len(rows))
    for i in range(_ROUNDS):
        say(0.3 + 0.7 * i / _ROUNDS, f"packing {len(np.unique(chart[rows]))} charts, round {i + 1}")
        packed = None
        for to_axis in (True, False):
            packed = packed or _pack_once(xatlas, *mesh, size, padding, scale, to_axis)
        if packed is None:
            high = scale
        else:
            low = scale
            corners, charts = np.full(uv.shape, np.nan), np.full(len(uv), -1, np.int64)
            corners[rows], charts[rows] = packed
            save(corners, charts)
        if low and high / low < 1.01:
            return
        if low and np.isfinite(high):
            scale = np.sqrt(low * high)
        else:
            scale = scale * 1.06 if low else scale * 0.9 ** (i + 1)


def _child(folder: str) -> None:
    import xatlas

    def say(fraction, text):
        print(f"{fraction:.3f} {text}", flush=True)

    with np.load(Path(folder, "in.npz")) as job:
        points, faces, part = job["points"].astype(np.float64), job["faces"], job["part"]
        uv, chart = job["uv"].astype(np.float64), job["chart"].astype(np.int64)
        resolution, padding = int(job["resolution"]), int(job["padding"])
    if len(faces):
        say(0.0, f"unwrapping {len(faces)} triangles")
        new_uv, new_chart = _parametrise(xatlas, points, faces, part)
        uv = np.concatenate([new_uv, uv])
        chart = np.concatenate([new_chart, chart + (new_chart.max(initial=-1) + 1) * (chart >= 0)])

    def save(corners, numbers):
        partial = Path(folder, "partial.npz")
        np.savez(partial, corners=corners + BORDER, chart=numbers)
        os.replace(partial, Path(folder, "out.npz"))

    _search(xatlas, uv, chart, resolution - 2 * BORDER, padding, save, say)


if __name__ == "__main__":
    _child(sys.argv[1])
