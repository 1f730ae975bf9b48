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

import difflib
import hashlib
import json
import re
from pathlib import Path

import numpy as np

from warp_neumat import __version__
from warp_neumat.export.golden import golden_vector
from warp_neumat.export.languages import LANGUAGES
from warp_neumat.export.shader_source import lod_bias, maps_of, prefix_of, shader_source
from warp_neumat.export.weight_layout import ROW_HALVES, layout, pack_weights
from warp_neumat.io.asset import FormatError, read_asset
from warp_neumat.io.atomic import replacing
from warp_neumat.io.block_formats import FORMATS
from warp_neumat.io.dds import write_dds
from warp_neumat.io.ktx2 import write_ktx2
from warp_neumat.materials.base import Material
from warp_neumat.materials.bcf import BCf

MANIFEST_VERSION = 1
"""Version of the manifest's layout."""

_WRITERS = {"dds": write_dds, "ktx2": write_ktx2}

CONTAINERS = tuple(_WRITERS)
"""Names of the containers that textures are written in."""


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
    _known("format", format, _WRITERS)
    for shader in shaders:
        _known("shaders", shader, LANGUAGES)
    material, weights = _opened(source)
    folder, name, config = _made(folder), material.name, material.header["config"]

    textures, written = [], []
    for n, (texture, entry) in enumerate(zip(material.textures, config["textures"], strict=True)):
        path = folder / f"{name}_features{n}.{format}"
        _WRITERS[format](path, texture)
        numbers = FORMATS[texture.format]
        about = {"format": texture.format, "dxgi_format": numbers.dxgi, "vk_format": numbers.vk, **entry}
        textures.append({**_file(path), **about, "lod_bias": lod_bias(config, entry)})
        written.append(path)

    rows = pack_weights(weights)
    written.append(_write(folder / f"{name}_weights.bin", rows.tobytes()))
    about = {"dtype": "float16", "byte_order": "little", "row_bytes": 2 * ROW_HALVES, "rows": len(rows)}
    (hidden, inputs), outputs = weights["weight0"].shape, len(weights["bias1"])
    tensors = [_place(block) for block in layout(inputs, hidden, outputs).values()]
    packed = {**_file(written[-1]), **about, "tensors": tensors}

    sources = []
    for language in shaders:
        for baked in (False, True):
            text = shader_source(language, name, config, weights, baked=baked)
            path = folder / f"{name}{'_baked' if baked else ''}.{language}"
            written.append(_write(path, text.encode("ascii")))
            sources.append({**_file(path), "language": language, "weights": "constants" if baked else "buffer"})

    manifest = {
        "kind": "neumat-export",
        "version": MANIFEST_VERSION,
        "generator": f"warp_neumat {__version__}",
        "name": name,
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
    text = json.dumps(manifest, indent=2, ensure_ascii=False, allow_nan=False)
    text = re.sub(r"\[\s+([^\[\]{}]*?)\s+\]", lambda match: f"[{' '.join(match[1].split())}]", text) + "\n"
    written.append(_write(folder / f"{name}.json", text.encode("utf-8")))
    return written


def _known(argument: str, value, names) -> None:
    """Raise a ValueError unless ``value`` is one of ``names``."""
    if value not in names:
        near = difflib.get_close_matches(str(value).lower(), names, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"{argument} must be one of {', '.join(names)}, got {value!r}{hint}")


def _opened(source) -> tuple[Material, dict[str, np.ndarray]]:
    """Return a BCf and its network's tensors.

    Raises: FormatError: If it is of another kind, or not what it should be.
    """
    if isinstance(source, Material):
        kind, where = source.kind, source.name
    else:
        tensors, header = read_asset(source)
        kind, where = header["kind"], source
    if kind != BCf.kind:
        raise FormatError(where, "kind", f"{kind!r} has no textures to export", f"give one of kind {BCf.kind!r}")
    if isinstance(source, Material):
        return source, source.weights
    return BCf(tensors, header, path=Path(source), device="cpu"), tensors


def _made(folder) -> Path:
    """Return ``folder``, made where it is missing."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        rule = "is a file" if folder.exists() else f"cannot be made ({error.strerror})"
        raise type(error)(f"{folder}: {rule}; give another folder") from None
    return folder


def _write(path: Path, content: bytes) -> Path:
    with replacing(path) as temporary:
        temporary.write_bytes(content)
    return path


def _file(path: Path) -> dict:
    """Return name, size and checksum of a file that was just written."""
    content = path.read_bytes()
    return {"file": path.name, "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def _place(block) -> dict:
    """Return where a tensor lies in the weights file, in bytes."""
    size = 2 * ROW_HALVES
    place = {"name": block.name, "shape": list(block.shape), "offset": size * block.row}
    return place | {"stride": size * block.stride} if len(block.shape) == 2 else place
