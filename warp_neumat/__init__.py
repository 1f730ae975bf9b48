"""warp_neumat: neural materials on NVIDIA Warp. Fit them, store them, render mesh sequences with them, measure.

The names below are the public Python interface. Each is imported when it is first used, so that ``import warp_neumat``
costs little and a program pays only for the parts it touches.
"""

import importlib

__version__ = "0.1.0"

_HOMES = {
    "Atlas": "pipeline.atlas",
    "Camera": "pipeline.camera",
    "Material": "materials.base",
    "MeshSequence": "pipeline.sequence",
    "PointLights": "pipeline.lights",
    "RenderedFrame": "pipeline.renderer",
    "Renderer": "pipeline.renderer",
    "bc1_decode": "kernels.bc1",
    "bc3_decode": "kernels.bc1",
    "bc4_decode": "kernels.bc4",
    "bc5_decode": "kernels.bc4",
    "bc6h_decode": "kernels.bc6h",
    "bc6h_encode": "kernels.bc6h_encode",
    "bc7_decode": "kernels.bc7",
    "corners": "kernels.healpix",
    "export_bcf": "export.bcf",
    "export_ntbc": "export.ntbc",
    "fit": "training.fit",
    "fit_shared": "training.sharing",
    "half_vectors": "kernels.frame",
    "load": "materials.base",
    "mlp_eval": "kernels.mlp",
    "open_brdf": "io.brdf",
    "open_brdfs": "io.brdf_set",
    "open_texture_set": "io.texture_set",
    "read_dds": "io.dds",
    "read_ktx2": "io.ktx2",
    "render_shot": "pipeline.shot",
    "tangent_frames": "kernels.frame",
    "tonemap": "pipeline.tonemap",
    "vec2pix": "kernels.healpix",
    "write_dds": "io.dds",
    "write_ktx2": "io.ktx2",
    "write_merl": "io.merl",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__():
    return sorted({*globals(), *_HOMES})
