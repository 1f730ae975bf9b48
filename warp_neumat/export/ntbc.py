"""What `neumat export` writes of an NTBC: ordinary block-compressed textures, and a manifest of what lies in them.

====================  ==================================================================================================
`NAME_TEXTURE.dds`    (or `.ktx2`) one texture as the asset's config lists them, BC1, BC3, BC4, BC5 or BC7, all mips
`NAME.json`           the manifest: sizes, formats, which channel is which component, constants, SHA-256 of each file
====================  ==================================================================================================

The textures are what the networks write at load, block for block, so an engine samples them as any others: there is no
decoder source. A channel's value is ``range[0] + (range[1] − range[0]) · v``, where v in [0, 1] is what a sampler reads
of a ``_unorm`` format, and the sRGB encoding of what it reads of a ``_srgb`` one; x and y of a normal are 2v − 1.
"""

from __future__ import annotations

from pathlib import Path

from warp_neumat.export.files import CONTAINERS, check_known, made, opened, write_manifest, write_texture
from warp_neumat.materials.ntbc import NTBC


def export_ntbc(source, folder, *, format="dds") -> list[Path]:
    """Write the textures of an NTBC and a manifest into ``folder``; return their paths, the manifest last.

    The folder is made where it is missing, files of the same names are replaced, each whole or not at all. The same
    asset gives the same bytes on one machine.

    Args:
        source: An NTBC from :func:`warp_neumat.load`, or the path of its asset.
        folder: Where the files go.
        format: Container of the textures, ``"dds"`` or ``"ktx2"``.

    Raises:
        ValueError: If ``format`` is unknown.
        FormatError: If the asset is not what it should be, or of another kind.
        OSError: If the asset is missing or the folder cannot be written.
    """
    check_known("format", format, CONTAINERS)
    material, _ = opened(source, NTBC)
    folder, name, config = made(folder), material.name, material.config
    textures, written = [], []
    for texture, entry in zip(material.textures, config["textures"], strict=True):
        path, about = write_texture(folder, f"{name}_{entry['name']}", texture, format)
        size = {"width": texture.width, "height": texture.height, "mips": texture.mips}
        textures.append({**about, "name": entry["name"], **size})
        written.append(path)
    channels = [
        {**channel, "texture": t, "texture_component": "rgba"[component]}
        for channel, (t, component) in zip(config["channels"], material.sources, strict=True)
    ]
    manifest = {
        "asset": {"kind": material.kind, "bytes": material.bytes, "block_bytes": material.block_bytes},
        "reference": {"width": config["width"], "height": config["height"]},
        "wrap": config["wrap"],
        "textures": textures,
        "channels": channels,
        "constants": config.get("constants", {}),
    }
    return [*written, write_manifest(folder, name, manifest)]
