"""What `neumat export` writes of a BCf: files that an engine loads without this package (paper [bcf], §5.2).

====================  ==================================================================================================
`NAME_features0.dds`  (or `.ktx2`) one BC6H texture per feature layer with its mips: the asset's own blocks, bit for bit
`NAME_weights.bin`    the network in fp16, 16-byte rows; ``export/weight_layout.py`` says what lies where
`NAME.json`           the manifest: sizes, mips, biases of Eq. 11, channels, constants, layout of the weights, SHA-256
                      of each file, and a golden test vector
`NAME.glsl`           decoder source, weights from a buffer; `.hlsl` and `.wgsl` alike
`NAME_baked.glsl`     the same with the weights as constants, for a shader of one material; `.hlsl`, `.wgsl` alike
====================  ==================================================================================================

Into an engine, in ten lines:

1. Load `NAME_features0.dds` … as BC6H textures with all their mips; never decompress, never let an importer re-encode.
   (Direct3D and WebGPU want sides of mip 0 that are multiples of 4, as those of all presets are; Vulkan takes any.)
2. Make one sampler: linear, linear between mips, the manifest's ``wrap``, no bias, no anisotropy.
3. Load `NAME_weights.bin` into a read-only storage buffer of ``uvec4``; those of further materials go behind it, and a
   material's ``base`` is the number of 16-byte rows before its own.
4. Declare that buffer as ``bcf_weights`` in the shader, then include the decoder source; its head shows the line.
   Materials with equal channels and sizes can share one source: pick textures and ``base`` by material id.
5. Call ``bcf_NAME_sample_grad(textures…, sampler, uv, dFdx(uv), dFdy(uv), base)`` in the fragment shader;
   ``bcf_NAME_sample_lod`` with an explicit mip level elsewhere (ray tracing, compute, vertex displacement).
6. Shade with the struct that comes back: linear Rec. 709 colours, unit tangent-space normal (+Y up), scalars.
7. Evaluate the manifest's ``golden`` uv and lod once: where ``exact`` is true, features agree to fp32 rounding on any
   conforming sampler; elsewhere to the precision of its filter weights (8 bits on most GPUs).
"""

from __future__ import annotations

from pathlib import Path

from warp_neumat.export.files import (
    CONTAINERS,
    check_known,
    described,
    made,
    opened,
    write,
    write_manifest,
    write_texture,
)
from warp_neumat.export.golden import golden_vector
from warp_neumat.export.languages import LANGUAGES
from warp_neumat.export.shader_source import lod_bias, maps_of, prefix_of, shader_source
from warp_neumat.export.weight_layout import ROW_HALVES, layout, pack_weights
from warp_neumat.materials.bcf import BCf


def export_bcf(source, folder, *, format="dds", shaders=tuple(LANGUAGES)) -> list[Path]:
    """Write the textures, weights, manifest and decoder source of a BCf into ``folder``; return their paths.

    The folder is made where it is missing, files of the same names are replaced, each whole or not at all, and the
    manifest comes last. The same asset gives the same bytes.

    Args:
        source: A BCf from :func:`warp_neumat.load`, or the path of its asset.
        folder: Where the files go.
        format: Container of the textures, ``"dds"`` or ``"ktx2"``.
        shaders: Languages of the decoder source, any of ``"glsl"``, ``"hlsl"``, ``"wgsl"``, or one name; may be empty.

    Raises:
        ValueError: If ``format`` or a name in ``shaders`` is unknown, or the material is of another kind.
        FormatError: If the asset is not what it should be.
        OSError: If the asset is missing or the folder cannot be written.
    """
    shaders = (shaders,) if isinstance(shaders, str) else tuple(dict.fromkeys(shaders))
    check_known("format", format, CONTAINERS)
    for shader in shaders:
        check_known("shaders", shader, LANGUAGES)
    material, _ = opened(source, BCf)
    folder, name, config, weights = made(folder), material.name, material.header["config"], material.weights

    textures, written = [], []
    for n, (texture, entry) in enumerate(zip(material.textures, config["textures"], strict=True)):
        path, about = write_texture(folder, f"{name}_features{n}", texture, format)
        textures.append({**about, **entry, "lod_bias": lod_bias(config, entry)})
        written.append(path)

    rows = pack_weights(weights)
    written.append(write(folder / f"{name}_weights.bin", rows.tobytes()))
    about = {"dtype": "float16", "byte_order": "little", "row_bytes": 2 * ROW_HALVES, "rows": len(rows)}
    (hidden, inputs), outputs = weights["weight0"].shape, len(weights["bias1"])
    tensors = [_place(block) for block in layout(inputs, hidden, outputs).values()]
    packed = {**described(written[-1]), **about, "tensors": tensors}

    sources = []
    for language in shaders:
        for baked in (False, True):
            text = shader_source(language, name, config, weights, baked=baked)
            path = folder / f"{name}{'_baked' if baked else ''}.{language}"
            written.append(write(path, text.encode("ascii")))
            sources.append({**described(path), "language": language, "weights": "constants" if baked else "buffer"})

    manifest = {
        "prefix": prefix_of(name),
        "reference": {"width": config["width"], "height": config["height"]},
        "wrap": config["wrap"],
        "textures": textures,
        "weights": packed,
        "network": {"inputs": inputs, "hidden": hidden, "outputs": outputs, "activation": "relu", "clamp": [0, 1]},
        "channels": config["channels"],
        "constants": config.get("constants", {}),
        "maps": [{"name": m.name, "field": m.field, "components": m.width} for m in maps_of(config)],
        "shaders": sources,
        "golden": golden_vector(material),
    }
    written.append(write_manifest(folder, name, manifest))
    return written


def _place(block) -> dict:
    """Return where a tensor lies in the weights file, in bytes."""
    size = 2 * ROW_HALVES
    place = {"name": block.name, "shape": list(block.shape), "offset": size * block.row}
    return place | {"stride": size * block.stride} if len(block.shape) == 2 else place
