"""The texel-space shading stage with BTFs: its time over lights, texels and materials (MobileVR, Figure 10, Table 3).

Square sheets, gently domed, lie side by side under point lights that reach every texel. All texels are seen, a texel of
the sheet is one of the 400² texture, which repeats, and a pixel of the camera is about as large. A stage is what an
epoch costs once: lights and viewer are set, the quads listed and shaded.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import warp as wp

from warp_neumat.materials.btf import BTF
from warp_neumat.pipeline.camera import Camera
from warp_neumat.pipeline.lights import PointLights
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.pipeline.surface_mesh import Facing, SurfaceMesh, bind_materials, map_sizes
from warp_neumat.pipeline.texel_shader import TexelShader

from ._btf_networks import SIDE, asset, least, line, surplus

CELLS, DOME = 16, 0.15
"""Cells of a sheet along a side, and how deep its corners lie below a plane, twice, in sides."""

MIPS = 3
HEIGHT, DISTANCE = 2.5, 4.0
"""Of the lights and the camera above the sheets [sides]."""

BEHIND = 8
"""Lights behind the surface that are timed together, for one costs less than a clock can tell."""


def sheets(count: int, scale: float) -> MeshSequence:
    """Return ``count`` domed squares of side 1 along x, facing +z, uv from 0 to ``scale`` on each."""
    grid = np.arange(CELLS + 1) / CELLS
    x, y = (a.ravel() - 0.5 for a in np.meshgrid(grid, grid))  # row by row from the top: y here points down
    points = np.stack([x, -y, -DOME * (x * x + y * y)], 1)
    corner = (np.arange(CELLS)[:, None] * (CELLS + 1) + np.arange(CELLS)).ravel()
    right, down = corner + 1, corner + CELLS + 1
    faces = np.stack([np.stack([corner, down, right], 1), np.stack([down + 1, right, down], 1)], 1).reshape(-1, 3)
    offset = np.arange(count) - 0.5 * (count - 1)
    return MeshSequence.from_arrays(
        np.concatenate([points + (dx, 0, 0) for dx in offset]).astype(np.float32),
        np.concatenate([faces + k * len(points) for k in range(count)]).astype(np.int32),
        np.tile(scale * np.stack([x + 0.5, y + 0.5], 1), (count, 1)).astype(np.float32),
        face_mesh=np.repeat(np.arange(count), len(faces)),
        mesh_names=[f"sheet{k}" for k in range(count)],
    )


def owners(count: int, side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return triangle (side, count · side) int32 and barycentrics (…, 2) of the texels of ``count`` sheets."""
    at = (np.arange(side) + 0.5) * CELLS / side
    cell, rest = at.astype(int), at - at.astype(int)
    fx, fy = np.meshgrid(rest, rest)
    lower = fx + fy > 1
    face = 2 * (cell[:, None] * CELLS + cell) + lower
    weights = np.where(lower[..., None], np.stack([1 - fy, 1 - fx], 2), np.stack([fy, fx], 2))
    triangle = np.concatenate([face + 2 * CELLS * CELLS * k for k in range(count)], 1)
    return triangle.astype(np.int32), np.tile(weights, (1, count, 1)).astype(np.float32)


class Stage:
    """Sheets of ``side``² texels, one for each material, and their shading.

    Args:
        materials: One for each sheet.
        side: Texels of a sheet along a side, even.
        capacity: Most lights.
    """

    def __init__(self, materials: list[BTF], side: int, capacity: int, device):
        count = len(materials)
        sequence = sheets(count, side / SIDE)
        listed, face_material = bind_materials(sequence, {f"sheet{k}": m for k, m in enumerate(materials)})
        mesh = SurfaceMesh(sequence, face_material, map_sizes(sequence, face_material, listed), device=device)
        triangle, barycentric = owners(count, side)
        owner = wp.array((face_material[triangle] + 1).astype(np.uint8).ravel(), dtype=wp.uint8, device=device)
        facing = Facing(mesh)
        self.shader = TexelShader(
            mesh, facing, listed, wp.array(triangle, dtype=wp.int32, device=device),
            wp.array(barycentric, dtype=wp.float32, device=device), owner, capacity,
        )  # fmt: skip
        view = {"fov_y": 2 * math.atan(0.5 / DISTANCE), "width": count * side, "height": side}
        self.camera = Camera.look_at((0.0, 0.0, DISTANCE), (0.0, 0.0, 0.0), **view)
        mesh.show(0)
        mesh.freeze()
        facing.update(self.camera)
        self.shader.seen.fill_(1)
        self.texels = triangle.size
        self._mesh = mesh

    def shade(self, above: int, below: int = 0) -> int:
        """Shade all texels under lights above the sheets and behind them; return the material's evaluations."""
        turn = 2 * np.pi * np.arange(above) / max(above, 1)
        position = np.zeros((above + below, 3))
        position[:above] = np.stack([np.cos(turn), np.sin(turn), np.full(above, HEIGHT)], 1)
        position[above:, 2] = -HEIGHT
        self.shader.begin(self.camera, PointLights(position, np.full((above + below, 3), 10.0)).at(0))
        self.shader.forget()
        self.shader.list()
        return self.shader.shade().evaluations


def _materials(shape: str, count: int, device) -> list[BTF]:
    rng = np.random.default_rng(8)
    return [BTF(*asset(rng, shape, mips=MIPS), device=device) for _ in range(count)]


def _fitted(table: str, method: str, over: str, x, rows: list[dict]) -> dict:
    found = line(x, [row["ms"] for row in rows])
    row = {"table": table, "method": f"line {method}", "per": over, "r2": found["r2"]}
    return {**row, "intercept_ms": found["intercept"], "slope_ms": found["slope"]}


def figure10(lab):
    """Yield the stage over 1 … 8 lights, the line through them, what a light behind costs, and the same over texels."""
    choice, rounds = lab.choice, lab.choice.rounds
    sheet = _materials("coarse-to-fine", 1, lab.device)
    stage = Stage(sheet, choice.atlas, 3 + BEHIND, lab.device)
    other = Stage(_materials("single-level", 1, lab.device), choice.atlas, 8, lab.device)
    counts = range(1, 9)
    calls = {("ours", n): functools.partial(stage.shade, n) for n in counts}
    calls |= {("peer", n): functools.partial(other.shade, n) for n in counts}
    seconds = least(calls, rounds)
    rows = []
    for n in counts:
        ours, peer = seconds["ours", n], seconds["peer", n]
        row = {"table": "figure10", "method": "over lights", "lights": n, "materials": 1, "texels": stage.texels}
        row |= {"ms": 1e3 * ours, "evaluations": stage.shade(n), "ms_per_light": 1e3 * ours / n}
        rows.append({**row, "peer": "single-level", "peer_ms": 1e3 * peer, "ratio": peer / ours})
        yield rows[-1]
    fitted = _fitted("figure10", "over lights", "light", counts, rows)
    yield fitted
    with_them, without = functools.partial(stage.shade, 3, BEHIND), functools.partial(stage.shade, 3)
    extra = 1e3 * surplus(with_them, without, 2 * rounds) / BEHIND
    yield {
        "table": "figure10",
        "method": "a light behind",
        "lights": f"3 + {BEHIND}",
        "materials": 1,
        "texels": stage.texels,
        "ms": extra,
        "evaluations": (with_them() - without()) / BEHIND,
        "of_a_light": extra / fitted["slope_ms"],
    }
    sides = [2 * round(choice.atlas * share / 2) for share in (1 / 3, 2 / 3, 1, 4 / 3)]
    stages = {side: Stage(sheet, side, 3, lab.device) for side in sides}
    seconds = least({side: functools.partial(s.shade, 3) for side, s in stages.items()}, rounds)
    rows = []
    for side, found in stages.items():
        row = {"table": "figure10", "method": "over texels", "lights": 3, "materials": 1, "texels": found.texels}
        rows.append({**row, "ms": 1e3 * seconds[side], "evaluations": found.shade(3)})
        yield rows[-1]
    yield _fitted("figure10", "over texels", "million texels", [side * side / 1e6 for side in sides], rows)


def table3(lab):
    """Yield the stage over 1 … 4 materials of a sheet each under three lights, and the line through them."""
    choice, counts = lab.choice, range(1, 5)
    materials = _materials("coarse-to-fine", counts[-1], lab.device)
    stages = {n: Stage(materials[:n], choice.tile, 3, lab.device) for n in counts}
    seconds = least({n: functools.partial(stage.shade, 3) for n, stage in stages.items()}, choice.rounds)
    rows = []
    for n, stage in stages.items():
        row = {"table": "table3", "method": "over materials", "lights": 3, "materials": n, "texels": stage.texels}
        rows.append({**row, "ms": 1e3 * seconds[n], "evaluations": stage.shade(3)})
        yield rows[-1]
    yield _fitted("table3", "over materials", "material", counts, rows)
