"""Writes glTF files of a few vertices, for tests that need one feature each."""

import base64
import json
import struct

import numpy as np

TYPES = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)


class TinyGltf:
    """A glTF tree under construction; `add` appends an accessor, `write` stores the file."""

    def __init__(self):
        self.tree = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "meshes": [], "nodes": []}
        self.tree |= {"scene": 0, "scenes": [{"nodes": []}]}
        self.blob = bytearray()

    def view(self, data: bytes, **extra) -> int:
        self.blob += bytes(-len(self.blob) % 4)
        entry = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)} | extra
        self.blob += data
        self.tree["bufferViews"].append(entry)
        return len(self.tree["bufferViews"]) - 1

    def add(self, values, kind: str, dtype=np.float32, **extra) -> int:
        values = np.ascontiguousarray(values, dtype)
        count = values.size // {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}[kind]
        entry = {"bufferView": self.view(values.tobytes()), "componentType": TYPES[values.dtype.name]}
        self.tree["accessors"].append(entry | {"type": kind, "count": count} | extra)
        return len(self.tree["accessors"]) - 1

    def add_sparse(self, count: int, rows, values, kind: str = "VEC3") -> int:
        """Append an accessor of zeros with a few rows replaced."""
        indices = {"bufferView": self.view(np.asarray(rows, np.uint16).tobytes()), "componentType": 5123}
        overlay = {"bufferView": self.view(np.asarray(values, np.float32).tobytes())}
        sparse = {"count": len(rows), "indices": indices, "values": overlay}
        self.tree["accessors"].append({"componentType": 5126, "type": kind, "count": count, "sparse": sparse})
        return len(self.tree["accessors"]) - 1

    def mesh(self, points=TRIANGLE, faces=None, *, name=None, primitive=None, mesh=None, **attributes) -> int:
        """Append a mesh of one primitive; attributes are accessor indices."""
        entry = {"attributes": {"POSITION": self.add(points, "VEC3")} | attributes} | (primitive or {})
        if faces is not None:
            entry["indices"] = self.add(faces, "SCALAR", np.uint16)
        self.tree["meshes"].append({"primitives": [entry]} | ({"name": name} if name else {}) | (mesh or {}))
        return len(self.tree["meshes"]) - 1

    def node(self, *, root: bool = True, **entry) -> int:
        self.tree["nodes"].append(entry)
        index = len(self.tree["nodes"]) - 1
        if root:
            self.tree["scenes"][0]["nodes"].append(index)
        return index

    def animate(self, node: int, path: str, times, values, interpolation=None, name: str = "move") -> None:
        """Append an animation of one channel, or a channel to the animation of that name."""
        animations = self.tree.setdefault("animations", [])
        found = [a for a in animations if a["name"] == name]
        animation = found[0] if found else {"name": name, "channels": [], "samplers": []}
        if not found:
            animations.append(animation)
        kind = {"rotation": "VEC4", "weights": "SCALAR"}.get(path, "VEC3")
        sampler = {"input": self.add(times, "SCALAR"), "output": self.add(values, kind)}
        animation["samplers"].append(sampler | ({"interpolation": interpolation} if interpolation else {}))
        target = {"node": node, "path": path}
        animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})

    def write(self, path):
        """Store as ``.glb``, or as ``.gltf`` with a buffer beside it; returns the path."""
        tree = dict(self.tree)
        if path.suffix == ".glb":
            self.blob += bytes(-len(self.blob) % 4)
            tree["buffers"] = [{"byteLength": len(self.blob)}]
            path.write_bytes(pack_glb(tree, bytes(self.blob)))
        else:
            beside = path.with_name(f"{path.stem} buffer.bin")
            beside.write_bytes(self.blob)
            tree["buffers"] = [{"byteLength": len(self.blob), "uri": beside.name.replace(" ", "%20")}]
            path.write_text(json.dumps(tree))
        return path

    def write_embedded(self, path):
        """Store as ``.gltf`` with its buffer in a data URI; returns the path."""
        uri = "data:application/octet-stream;base64," + base64.b64encode(bytes(self.blob)).decode()
        path.write_text(json.dumps(self.tree | {"buffers": [{"byteLength": len(self.blob), "uri": uri}]}))
        return path


def pack_glb(tree: dict, blob: bytes) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
