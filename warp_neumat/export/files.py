"""What every export shares: the folder, files written whole with their checksums, textures in containers, manifests."""

from __future__ import annotations

import difflib
import hashlib
import json
import re
from pathlib import Path

from warp_neumat import __version__
from warp_neumat.io.asset import FormatError, read_asset
from warp_neumat.io.atomic import replacing
from warp_neumat.io.block_formats import FORMATS, BlockTexture
from warp_neumat.io.dds import write_dds
from warp_neumat.io.ktx2 import write_ktx2
from warp_neumat.materials.base import Material

MANIFEST_VERSION = 1
"""Version of the manifest's layout."""

_WRITERS = {"dds": write_dds, "ktx2": write_ktx2}

CONTAINERS = tuple(_WRITERS)
"""Names of the containers that textures are written in."""


def check_known(argument: str, value, names) -> None:
    """Raise a ValueError unless ``value`` is one of ``names``."""
    if value not in names:
        near = difflib.get_close_matches(str(value).lower(), names, 1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"{argument} must be one of {', '.join(names)}, got {value!r}{hint}")


def opened(source, material_class) -> tuple[Material, dict]:
    """Return a material of ``material_class`` and its asset's tensors, {} where ``source`` is a material already.

    Raises: FormatError: If it is of another kind, or not what it should be.
    """
    tensors: dict = {}
    if isinstance(source, Material):
        kind, where = source.kind, source.name
    else:
        tensors, header = read_asset(source)
        kind, where = header["kind"], source
    if kind != material_class.kind:
        rule = f"{kind!r} has no textures to export"
        raise FormatError(where, "kind", rule, f"give one of kind {material_class.kind!r}")
    if isinstance(source, Material):
        return source, tensors
    return material_class(tensors, header, path=Path(source), device="cpu"), tensors


def made(folder) -> Path:
    """Return ``folder``, made where it is missing."""
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        rule = "is a file" if folder.exists() else f"cannot be made ({error.strerror})"
        raise type(error)(f"{folder}: {rule}; give another folder") from None
    return folder


def write(path: Path, content: bytes) -> Path:
    """Write ``content``, whole or not at all, and return ``path``."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)
    return path


def described(path: Path) -> dict:
    """Return name, size and checksum of a file that was just written."""
    content = path.read_bytes()
    return {"file": path.name, "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def write_texture(folder: Path, stem: str, texture: BlockTexture, container: str) -> tuple[Path, dict]:
    """Write a texture and return its path and what a manifest says of file and format."""
    path = folder / f"{stem}.{container}"
    _WRITERS[container](path, texture)
    numbers = FORMATS[texture.format]
    about = {"format": texture.format, "dxgi_format": numbers.dxgi, "vk_format": numbers.vk}
    return path, {**described(path), **about}


def write_manifest(folder: Path, name: str, content: dict) -> Path:
    """Write ``content`` behind what all manifests begin with, lists of numbers in a line, and return the path."""
    head = {"kind": "neumat-export", "version": MANIFEST_VERSION, "generator": f"warp_neumat {__version__}"}
    text = json.dumps({**head, "name": name, **content}, indent=2, ensure_ascii=False, allow_nan=False)
    text = re.sub(r"\[\s+([^\[\]{}]*?)\s+\]", lambda match: f"[{' '.join(match[1].split())}]", text) + "\n"
    return write(folder / f"{name}.json", text.encode("utf-8"))
