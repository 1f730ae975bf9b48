"""Camera raster beside primary rays through wp.mesh_query_ray, at 1920×1080 on the same cores.

Both draw triangle id, barycentrics and depth of the same frame. The rays' BVH is built once, before the clock starts;
rays are launched over the same workers by the same dispatcher, in 8 × 8 pixel blocks (row by row takes as long).
Columns after ``mismatch_fraction`` break a frame into its stages [ms], measured one after the other in runs of their
own.
"""

import os
import time
from pathlib import Path

import numpy as np
import warp as wp

from bench.harness import interleave
from warp_neumat.kernels import dispatch
from warp_neumat.kernels.visibility import CameraRaster, pixel_matrix

COLUMNS = [
    "mesh", "triangles", "covered", "width", "height", "workers", "ms", "peer", "peer_ms", "ratio", "mismatch_fraction",
    "project_ms", "count_ms", "scan_ms", "fill_ms", "tiles_ms",
]  # fmt: skip
MESHES = {"bunny": "meshes/bunny.ply", "bunny_low": "meshes/bunny_low.ply", "fox": "animation/Fox.glb"}

wp.set_module_options(dispatch.module_options())


@wp.kernel
def primary_rays_kernel(
    first: int,
    mesh: wp.uint64,
    eye: wp.vec3,
    to_world: wp.mat33,
    axis: wp.vec3,
    width: int,
    height: int,
    triangle: wp.array2d(dtype=wp.int32),
    barycentric: wp.array2d(dtype=wp.vec2),
    depth: wp.array2d(dtype=wp.float32),
):
    i = first + wp.tid()
    across = (width + 7) // 8
    x = (i // 64) % across * 8 + i % 8
    y = (i // 64) // across * 8 + (i % 64) // 8
    if x >= width or y >= height:
        return
    ray = wp.normalize(to_world * wp.vec3(float(x) + 0.5, float(y) + 0.5, 1.0))
    query = wp.mesh_query_ray(mesh, eye, ray, 1.0e30)
    if query.result:
        triangle[y, x] = query.face
        barycentric[y, x] = wp.vec2(query.v, 1.0 - query.u - query.v)
        depth[y, x] = query.t * wp.dot(axis, ray)
    else:
        triangle[y, x] = -1
        barycentric[y, x] = wp.vec2(0.0, 0.0)
        depth[y, x] = wp.inf


class PrimaryRays:
    """One ray per pixel through a BVH built here."""

    def __init__(self, points, faces, clip, width, height, device):
        self.mesh = wp.Mesh(
            wp.array(points, dtype=wp.vec3, device=device), wp.array(faces.ravel(), dtype=wp.int32, device=device)
        )
        m = pixel_matrix(clip, width, height)[[0, 1, 3]]
        to_world = np.linalg.inv(m[:, :3])
        self.triangle = wp.empty((height, width), dtype=wp.int32, device=device)
        self.barycentric = wp.empty((height, width), dtype=wp.vec2, device=device)
        self.depth = wp.empty((height, width), dtype=wp.float32, device=device)
        self.job = dispatch.Job(
            primary_rays_kernel,
            64 * dispatch.blocks(width, 8) * dispatch.blocks(height, 8),
            [self.mesh.id, wp.vec3(-to_world @ m[:, 3]), wp.mat33(to_world), wp.vec3(m[2, :3]), width, height],
            [self.triangle, self.barycentric, self.depth],
            device=device,
            grain=1024,
        )
        self.run = self.job.run


def load(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return points (V, 3) float32 and faces (F, 3) int32 of a mesh of the data folder, in its rest pose."""
    import trimesh

    root = Path(os.environ.get("NEUMAT_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    mesh = trimesh.load(root / MESHES[name], process=False)
    if hasattr(mesh, "to_geometry"):
        mesh = mesh.to_geometry()
    return np.array(mesh.vertices, np.float32), np.array(mesh.faces, np.int32)


def look(points: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return the clip matrix of a camera before the mesh that sees it over 95 % of the picture's height or width."""
    low, high = points.min(0).astype(np.float64), points.max(0).astype(np.float64)
    centre, size = (low + high) / 2, high - low
    front = max(size[1], size[0] * height / width)
    distance = 1.6 * front + size[2] / 2
    near, far = 0.01 * distance, 100.0 * distance
    f = 2.0 * (distance - size[2] / 2) / front * 0.95
    project = np.array(
        [
            [f * height / width, 0, 0, 0],
            [0, f, 0, 0],
            [0, 0, far / (near - far), near * far / (near - far)],
            [0, 0, -1, 0],
        ]
    )
    view = np.eye(4)
    view[:3, 3] = -centre - [0.0, 0.0, distance]
    return (project @ view).astype(np.float32)


def rows(*, device: str, quick: bool):
    """Yield one row per mesh and number of workers."""
    width, height = (480, 270) if quick else (1920, 1080)
    rounds = 3 if quick else 9
    available = dispatch.worker_count()
    try:
        for name in ["bunny_low"] if quick else MESHES:
            points, faces = load(name)
            clip = look(points, width, height)
            # Faces that a file holds twice are one: which of them is hit, says the order of a sum.
            alike = np.append(np.unique(np.sort(faces, 1), axis=0, return_inverse=True)[1], -1)
            raster = CameraRaster(faces, len(points), width, height, device=device)
            rays = PrimaryRays(points, faces, clip, width, height, device)
            on_device = wp.array(points, dtype=wp.float32, device=device)
            for workers in sorted({1, available}) if wp.get_device(device).is_cpu else [1]:
                dispatch.set_worker_count(workers)

                def draw():
                    raster.run(on_device, clip)
                    wp.synchronize_device(device)

                def trace():
                    rays.run()
                    wp.synchronize_device(device)

                seconds = interleave({"ours": draw, "peer": trace}, rounds)
                ours, peer = alike[raster.triangle.numpy()], alike[rays.triangle.numpy()]
                row = {
                    "mesh": name, "triangles": len(faces), "covered": float((ours >= 0).mean()),
                    "width": width, "height": height, "workers": workers,
                    "ms": 1e3 * seconds["ours"], "peer": "wp.mesh_query_ray", "peer_ms": 1e3 * seconds["peer"],
                    "ratio": seconds["peer"] / seconds["ours"], "mismatch_fraction": float((ours != peer).mean()),
                }  # fmt: skip
                yield row | stages(raster, device, rounds)
    finally:
        dispatch.set_worker_count(None)


def stages(raster: CameraRaster, device: str, rounds: int) -> dict[str, float]:
    """Return the median milliseconds of each stage of the frame that was drawn last."""
    taken = {name: [] for name, _ in raster.stages}
    for _ in range(rounds):
        for name, job in raster.stages:
            start = time.perf_counter()
            job.run()
            wp.synchronize_device(device)
            taken[name].append(time.perf_counter() - start)
    return {f"{name}_ms": 1e3 * float(np.median(t)) for name, t in taken.items()}
