"""The logarithm behind mip levels, and those of atlas texels; tests/pipeline/test_footprint.py has those of pixels."""

import numpy as np
import pytest
import warp as wp

from warp_neumat.kernels import dispatch
from warp_neumat.kernels.lod import NO_LOD, atlas_lod, lod_of, log2, uv_gradient_kernel

wp.set_module_options(dispatch.module_options())


@wp.kernel
def logs_kernel(
    first: int, x: wp.array(dtype=wp.float32), y: wp.array(dtype=wp.float32), z: wp.array(dtype=wp.float32)
):
    i = first + wp.tid()
    y[i] = log2(x[i])
    z[i] = lod_of(x[i])


def _logs(x, device):
    x = wp.array(x, dtype=wp.float32, device=device)
    y, z = wp.empty_like(x), wp.empty_like(x)
    dispatch.launch(logs_kernel, len(x), inputs=[x], outputs=[y, z], device=device)
    return y.numpy(), z.numpy()


def test_log2_matches_float64(rng, device):
    x = np.concatenate([np.exp2(rng.uniform(-126, 127, 100_000)), 1 + rng.uniform(-0.1, 0.1, 100_000)])
    x = x.astype(np.float32)
    got, _ = _logs(x, device)
    error = np.abs(got - np.log2(x.astype(np.float64))) - 6e-8 * np.abs(got)  # the sum with the exponent is float32
    assert error.max() < 4e-6  # worst: 2.6e-6
    powers = np.exp2(np.arange(-100, 100)).astype(np.float32)
    assert np.array_equal(_logs(powers, device)[0], np.arange(-100, 100, dtype=np.float32))


def test_no_footprint_gives_a_level_out_of_range(device):
    _, level = _logs(np.array([0.0, 1e-40, 3e38, np.inf, 4.0, 0.25], np.float32), device)
    assert level == pytest.approx([-32, -32, 32, 32, 1, -1], abs=1e-5)


def test_atlas_levels_are_those_of_the_longer_derivative():
    faces = np.array([[0, 1, 2], [0, 1, 2], [0, 1, 1]])
    uv = np.array([[0.1, 0.2], [0.1 + 0.25, 0.2], [0.1, 0.2 + 0.5]], np.float32)
    flat = np.array([[10, 10], [42, 10], [10, 42]], np.float32)
    turned = flat[:, ::-1]
    texels = np.full((3, 2), (1024, 256), np.float32)
    # 32 atlas texels hold 256 texels across and 128 down; turning or mirroring the chart changes nothing.
    level = atlas_lod(np.stack([flat, turned, flat]), uv, faces, texels)
    assert level[:2] == pytest.approx([3, 3], abs=1e-5)
    collapsed = atlas_lod(np.stack([flat, np.tile(flat[:1], (3, 1)), flat]), uv, faces, texels)
    assert collapsed[1] == NO_LOD
    assert np.isfinite(collapsed).all()
    assert atlas_lod(np.stack([flat] * 3), np.full_like(uv, np.nan), faces, texels) == pytest.approx(NO_LOD)
    sheared = np.array([[0, 0], [32, 0], [32, 32]], np.float32)  # u along x; v along y - and u backwards
    assert atlas_lod(sheared[None], uv, faces[:1], texels[:1]) == pytest.approx(0.5 * np.log2(8**2 + 4**2), abs=1e-5)


def test_gradients_recover_uv_and_are_zero_where_nothing_is_defined(rng, device):
    n = 500
    points = rng.normal(size=(3 * n, 3)).astype(np.float32)
    uv = rng.normal(size=(3 * n, 2)).astype(np.float32)
    points[3:6] = points[3]  # a point
    uv[6:9] = uv[6]
    faces, texels = np.arange(3 * n).reshape(n, 3), np.full((n, 2), (512, 64), np.float32)

    def array(values, dtype=wp.float32):
        return wp.array(np.ravel(values), dtype=dtype, device=device)

    out, side = wp.zeros(6 * n, dtype=wp.float32, device=device), np.ones(n)
    inputs = [array(faces, wp.int32), n, array(texels), array(uv), array(points), array(side, wp.int8), 64]
    dispatch.launch(uv_gradient_kernel, dispatch.blocks(n, 64), inputs=inputs, outputs=[out], device=device)
    gradient = out.numpy().reshape(n, 2, 3).astype(np.float64)
    assert (gradient[1:3] == 0).all()
    p, q = points.reshape(n, 3, 3).astype(np.float64), uv.reshape(n, 3, 2) * texels[:, None].astype(np.float64)
    edges = p[:, 1:] - p[:, :1]
    error = np.abs(np.einsum("nec,nkc->nek", edges, gradient) - (q[:, 1:] - q[:, :1])).max((1, 2))
    area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    solid = area > 0.2
    solid[1] = False
    assert solid.sum() > 400
    assert error[solid].max() < 0.01  # of up to 2000 texels; worst 2e-3
    normal = np.cross(edges[:, 0], edges[:, 1])
    assert np.abs(np.einsum("nkc,nc->nk", gradient, normal))[solid].max() < 0.01  # within the plane
