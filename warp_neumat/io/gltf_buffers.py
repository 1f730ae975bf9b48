"""Container, buffers and accessors of glTF 2.0: bytes become numpy arrays.

An accessor is a typed, strided window into a buffer, optionally with a sparse overlay and optionally normalised from
integers to [0, 1] or [-1, 1]. Every window is checked against the bytes that are there before it is read. Source:
Khronos, glTF 2.0 specification, sections 3.6 (buffers and accessors) and 4 (GLB).
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from pathlib import Path
from urllib.parse import unquote

import numpy as np

COMPONENT_TYPES = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
COMPONENT_COUNTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
LARGEST_EMPTY = 1 << 26  # an accessor without bytes behind it could otherwise ask for any amount of memory
# Extensions that a file may require although geometry reads the same without them.
HARMLESS_EXTENSIONS = ("KHR_mesh_quantization", "KHR_lights_punctual", "KHR_materials_", "KHR_texture_", "EXT_texture_")


class Malformed(Exception):
    """A broken rule, worded for the user; `gltf.load_gltf` adds the file's name."""


def open_gltf(path: Path) -> Buffers:
    """Read a ``.glb`` or ``.gltf`` file and check its version and the extensions that it requires.

    Raises: Malformed: If the container or its JSON is broken, of another version, or needs an extension that changes
        geometry.
    """
    raw = path.read_bytes()
    tree, binary = _split_glb(raw) if raw[:4] == b"glTF" else (_parse_json(raw), None)
    version = str(tree.get("asset", {}).get("version", "missing"))
    if version.split(".")[0] != "2":
        raise Malformed(f"glTF version is {version}, only 2.x is supported")
    refused = [name for name in tree.get("extensionsRequired", ()) if not name.startswith(HARMLESS_EXTENSIONS)]
    if refused:
        raise Malformed(f"requires the unsupported extension {', '.join(refused)}; export the file without it")
    return Buffers(path, tree, binary)


def _parse_json(raw: bytes) -> dict:
    try:
        tree = json.loads(raw.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise Malformed("neither a GLB file nor JSON text") from None
    except json.JSONDecodeError as error:
        raise Malformed(f"broken JSON at line {error.lineno}, column {error.colno}: {error.msg}") from None
    except RecursionError:
        raise Malformed("broken JSON: nested too deeply") from None
    if not isinstance(tree, dict):
        raise Malformed("the JSON is no glTF object")
    return tree


def _split_glb(raw: bytes) -> tuple[dict, bytes | None]:
    """Return the JSON tree and the binary chunk of a GLB container."""
    if len(raw) < 20:
        raise Malformed(f"truncated GLB, {len(raw)} bytes hold no header")
    _, version, length = struct.unpack_from("<4sII", raw)
    if version != 2:
        raise Malformed(f"GLB version {version} is not supported, only 2")
    if length > len(raw):
        raise Malformed(f"truncated GLB, the header says {length} bytes but the file has {len(raw)}")
    chunks, offset = {}, 12
    while offset + 8 <= length:
        size, kind = struct.unpack_from("<I4s", raw, offset)
        if offset + 8 + size > length:
            raise Malformed(f"truncated GLB, a chunk of {size} bytes at byte {offset} ends beyond the file")
        chunks.setdefault(kind, raw[offset + 8 : offset + 8 + size])
        offset += 8 + size
    if b"JSON" not in chunks:
        raise Malformed("the GLB has no JSON chunk")
    return _parse_json(chunks[b"JSON"]), chunks.get(b"BIN\0")


class Buffers:
    """The JSON tree of one file with its binary data; each buffer is opened once."""

    def __init__(self, path: Path, tree: dict, binary: bytes | None):
        self.path, self.tree, self.binary = path, tree, binary
        self._open: dict[int, bytes] = {}

    def item(self, kind: str, index: int) -> dict:
        """Return one entry of a top-level list, such as ``item("nodes", 3)``."""
        items = self.tree.get(kind, [])
        if not isinstance(index, int) or not 0 <= index < len(items):
            raise Malformed(f"index {index} into {kind} is out of range, there are {len(items)}")
        return items[index]

    def _buffer(self, index: int) -> bytes:
        if index not in self._open:
            entry = self.item("buffers", index)
            data = self.binary if "uri" not in entry and index == 0 else self._fetch(index, entry.get("uri"))
            if data is None or len(data) < entry["byteLength"]:
                have = 0 if data is None else len(data)
                raise Malformed(f"buffer {index} is truncated, it needs {entry['byteLength']} bytes but has {have}")
            self._open[index] = data
        return self._open[index]

    def _fetch(self, index: int, uri: str | None) -> bytes | None:
        if uri is None:
            return None
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            try:
                return base64.b64decode(unquote(body), validate=True) if head.endswith(";base64") else None
            except binascii.Error as error:
                raise Malformed(f"buffer {index} has broken base64 data ({error})") from None
        if "://" in uri:
            raise Malformed(f"buffer {index} lies at {uri}; download it beside the file first")
        target = self.path.parent / unquote(uri)
        if not target.is_file():
            raise FileNotFoundError(f"{self.path}: its buffer {target} is missing")
        return target.read_bytes()

    def _strided(self, what: str, view: int, offset: int, count: int, width: int, dtype) -> np.ndarray:
        """View ``count`` rows of ``width`` components inside a buffer view, shape (count, width)."""
        entry = self.item("bufferViews", view)
        data, start, size = self._buffer(entry["buffer"]), entry.get("byteOffset", 0), entry["byteLength"]
        dtype = np.dtype(dtype).newbyteorder("<")
        stride = entry.get("byteStride") or width * dtype.itemsize
        last = offset + (count - 1) * stride + width * dtype.itemsize if count else 0
        if min(start, size, offset, count, stride) < 0 or last > size or start + size > len(data):
            raise Malformed(
                f"{what} reaches out of its buffer: it ends at byte {start + last}, "
                f"bufferView {view} ends at {start + size}, the buffer at {len(data)}"
            )
        return np.ndarray((count, width), dtype, buffer=data, offset=start + offset, strides=(stride, dtype.itemsize))

    def accessor(self, index: int) -> np.ndarray:
        """Decode one accessor to shape (count, components): float32 where it is float or normalised, else integers."""
        entry = self.item("accessors", index)
        what, count = f"accessor {index}", entry["count"]
        if entry["componentType"] not in COMPONENT_TYPES:
            raise Malformed(f"{what} has the unknown componentType {entry['componentType']}")
        if entry["type"] not in COMPONENT_COUNTS:
            raise Malformed(f"{what} has type {entry['type']}, which no supported attribute uses")
        dtype, width = COMPONENT_TYPES[entry["componentType"]], COMPONENT_COUNTS[entry["type"]]
        if "bufferView" in entry:
            values = self._strided(what, entry["bufferView"], entry.get("byteOffset", 0), count, width, dtype)
        elif 0 <= count <= LARGEST_EMPTY:
            values = np.zeros((count, width), dtype)
        else:
            raise Malformed(f"{what} has no bufferView and {count} elements, at most {LARGEST_EMPTY} are sensible")
        if "sparse" in entry:
            values = self._apply_sparse(what, entry["sparse"], np.array(values), width, dtype)
        if entry.get("normalized") and dtype is not np.float32:
            values = np.maximum(values.astype(np.float32) / np.float32(np.iinfo(dtype).max), np.float32(-1))
        return np.ascontiguousarray(values)

    def _apply_sparse(self, what: str, sparse: dict, values: np.ndarray, width: int, dtype) -> np.ndarray:
        count, where, news = sparse["count"], sparse["indices"], sparse["values"]
        index_type = COMPONENT_TYPES.get(where["componentType"], np.float32)
        if index_type is np.float32:
            raise Malformed(f"{what}: its sparse indices have componentType {where['componentType']}")
        args = (where["bufferView"], where.get("byteOffset", 0), count, 1, index_type)
        rows = self._strided(f"the sparse indices of {what}", *args)[:, 0].astype(np.int64)
        if count and rows.max() >= len(values):
            raise Malformed(f"{what}: sparse index {rows.max()} is out of range, it has {len(values)} elements")
        args = (news["bufferView"], news.get("byteOffset", 0), count, width, dtype)
        values[rows] = self._strided(f"the sparse values of {what}", *args)
        return values
