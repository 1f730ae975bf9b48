"""Materials that share primitives and decoder: files of kind ``neubrdf`` that name a file of kind ``neubrdf-group``.

The group's file holds ``codebook``, ``weight{n}`` and ``bias{n}``; a member's file holds its ``indices`` (and ``live``)
alone, and in its header ``group``: the name of the group's file, which lies beside it, and a digest of what it holds.
So a material joins a group without any other file being touched.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from warp_neumat.io.asset import FormatError, read_asset

GROUP = "neubrdf-group"
"""Kind of a group's file."""


def digest(tensors: dict[str, np.ndarray]) -> str:
    """Return the SHA-256 of ``tensors``, names and bytes, as hexadecimal text."""
    found = hashlib.sha256()
    for name in sorted(tensors):
        found.update(name.encode())
        found.update(np.ascontiguousarray(tensors[name]).tobytes())
    return found.hexdigest()


def read_whole_asset(path) -> tuple[dict[str, np.ndarray], dict]:
    """Return (tensors, header) of an asset as :func:`read_asset`, with the tensors of its group where it has one.

    ``header["own_bytes"]`` then is the size of what the material does not share.

    Raises:
        FileNotFoundError: If there is no such file, or its group's is missing.
        FormatError: If one of the two is no asset, or the group is not the one that the material was fitted to.
    """
    path = Path(path)
    tensors, header = read_asset(path)
    if header["kind"] == GROUP:
        raise FormatError(path, "kind", "is a group of primitives, no material", "give one of its members' files")
    group = header.get("group")
    if group is None:
        return tensors, header
    if (
        not isinstance(group, dict)
        or not isinstance(group.get("file"), str)
        or Path(group["file"]).name != group["file"]
    ):
        raise FormatError(path, "group.file", f"must name a file beside this one, got {group!r}", "fit it again")
    shared_path = path.parent / group["file"]
    if not shared_path.is_file():
        raise FileNotFoundError(f"{path}: its group {group['file']} is not beside it; put {shared_path} back")
    shared, shared_header = read_asset(shared_path)
    if shared_header["kind"] != GROUP:
        raise FormatError(
            shared_path, "kind", f"must be {GROUP}, got {shared_header['kind']}", "put the group's file back"
        )
    if digest(shared) != group.get("digest"):
        rule = f"is another than {path.name} was fitted to"
        raise FormatError(shared_path, "digest", rule, "put the group's file back, or fit the material again")
    own = sum(tensor.nbytes for tensor in tensors.values())
    return {**tensors, **shared}, {**header, "own_bytes": own}
