"""The kernels of rendering, BCf training and simulation compile to PTX, without a GPU: one source serves both."""

import pytest
import warp as wp

from warp_neumat.kernels import (
    atlas,
    bc6h_encode_pack,
    bcf,
    bcf_shade,
    bcf_train,
    block_texture,
    btf,
    carry,
    frame,
    gather,
    ggx,
    healpix,
    height_field,
    height_field_light,
    lod,
    mlp,
    neubrdf,
    ntbc,
    proxy,
    schedule,
    shade,
    stereo,
    streaming,
    tile_plan,
    visibility,
    visibility_setup,
    worklist,
)


def _frame():
    return frame._make_kernels(1)[0].module


def _healpix():
    return healpix._kernels(1).corners.module


def _mlp():
    return mlp.make_rows_kernel(mlp.MLPShape(12, 16, 9), 1).module


def _neubrdf():
    return neubrdf.make_eval_kernel(neubrdf.Layout((64, 64), "isotropic"), 1).module


def _neubrdf_half():
    layout = neubrdf.Layout((64, 32, 64), "half-isotropic", "bilateral", "idw", channels=9)
    return neubrdf.make_eval_kernel(layout, 1).module


def _shade():
    return shade.make_shade_kernel(neubrdf.functions, neubrdf.Layout((64, 64), "isotropic"), 1).module


def _shade_neubrdf_textured():
    layout = neubrdf.Layout((32,), "half", "reciprocal", "uniform", channels=8)
    return shade.make_shade_kernel(neubrdf.functions, layout, 1, textured=True).module


def _shade_textured():
    layout = bcf_shade.Layout(bcf.Layout(channels=12))
    return shade.make_shade_kernel(bcf_shade.functions, layout, 1, textured=True).module


def _shade_btf():
    return shade.make_shade_kernel(btf.functions, btf.Layout(), 1, textured=True).module


def _ntbc():
    shape = ntbc.NetworkShape(((16, 16), (32, 32)), 16), ntbc.NetworkShape(((16, 16),), 8)
    return ntbc.make_blocks_kernel(ntbc.ModelShape(*shape, (("bc1", 3), ("bc4", 1), ("bc7", 4))), False).module


def _ntbc_naive():
    shape = ntbc.NetworkShape(((16, 16),), 8), ntbc.NetworkShape(((16, 16), (32, 32)), 2)
    return ntbc.make_blocks_kernel(ntbc.ModelShape(*shape, (("bc1", 3), ("bc4", 1)), naive=True), False).module


def _bcf_step():
    return bcf_train.step_kernel(bcf_train.StepShape(textures=4, hidden=16, channels=9), 1).module


MODULES = {
    "frame": _frame,
    "healpix": _healpix,
    "mlp": _mlp,
    "neubrdf": _neubrdf,
    "neubrdf_half": _neubrdf_half,
    "shade": _shade,
    "shade_textured": _shade_textured,
    "shade_neubrdf_textured": _shade_neubrdf_textured,
    "ggx": lambda: ggx._make_kernel(1).module,
    "lod": lambda: lod.uv_gradient_kernel.module,
    "btf_rows": lambda: btf.make_eval_kernel(btf.Layout(), 1).module,
    "btf_quads": lambda: btf.make_eval_kernel(btf.Layout(), 4).module,
    "shade_btf": _shade_btf,
    "height_field": lambda: height_field._make_trace(1).module,
    "height_field_direct": lambda: height_field_light._make_light(1)[0].module,
    "height_field_bounce": lambda: height_field_light._make_light(1)[1].module,
    "height_field_pack": lambda: height_field_light._make_light(1)[2].module,
    "height_field_slices": lambda: height_field_light._make_slice(1, 2).module,
    "bcf_step": _bcf_step,
    "ntbc": _ntbc,
    "ntbc_naive": _ntbc_naive,
    "block_decode": lambda: block_texture.make_block_kernels()[0].module,
    "block_adjoint": lambda: block_texture.make_block_kernels()[1].module,
    "bc6h_pack": lambda: bc6h_encode_pack.bc6h_pack_kernel.module,
    "worklist": lambda: worklist.list_kernel.module,
    "streaming": lambda: wp.get_module(streaming.__name__),
    "stereo": lambda: stereo.merge_kernel.module,
    "stereo_difference": lambda: stereo.make_difference_kernel(1).module,
    "tile_plan": lambda: tile_plan.rank_kernel.module,
    "gather": lambda: gather.gather_kernel.module,
    "carry": lambda: carry.make_gather_kernel(1).module,
    "schedule": lambda: schedule.make_predict_kernel(1).module,
    "schedule_learn": lambda: schedule.learn_kernel.module,
    "proxy": lambda: proxy._make_kernel(1).module,
    "atlas": lambda: wp.get_module(atlas.__name__),
    "visibility_setup": lambda: visibility_setup.make_project(1).module,
    "visibility": lambda: wp.get_module(visibility.__name__),
}


@pytest.mark.parametrize("name", MODULES)
def test_kernels_compile_for_cuda(name, tmp_path):
    wp.init()
    wp.compile_aot_module(MODULES[name](), arch=80, module_dir=tmp_path, use_ptx=True)
    code = "".join(f.read_text(errors="replace") for f in tmp_path.glob("*.ptx"))
    assert ".entry" in code
    assert "_kernel" in code
