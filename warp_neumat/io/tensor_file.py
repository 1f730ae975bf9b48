"""The tensor file of EPFL's Realistic Graphics Lab: named arrays in one binary file, as `.bsdf` measurements come in.

Layout, little endian: the 12 bytes "tensor_file\\0", two bytes version (1, 0), uint32 number of fields; then for each
field uint16 length of its name, the name (UTF-8), uint16 number of dimensions, uint8 type, uint64 offset of the data
from the start of the file, and one uint64 per dimension, slowest first; then the data, each field aligned to 8 bytes.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from .atomic import replacing

MAGIC = b"tensor_file\0"
TYPES = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<u8", 8: "<i8", 9: "<f2", 10: "<f4", 11: "<f8"}
"""Number of a type in the file → NumPy's name for it."""
_ALIGN = 8


def read_tensors(path) -> dict[str, np.ndarray]:
    """Return the arrays of the tensor file at ``path`` by name; they are mapped, not read, until they are used.

    Raises:
        ValueError: If the file is no tensor file, of another version, or shorter than its header says.
        OSError: If it cannot be read.
    """
    path = Path(path)
    size = path.stat().st_size
    with open(path, "rb") as file:

        def take(form: str) -> tuple:
            data = file.read(struct.calcsize(form))
            if len(data) < struct.calcsize(form):
                raise ValueError(f"{path}: the header of the tensor file ends early; fetch the file again")
            return struct.unpack(form, data)

        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError(f"{path}: not a tensor file, it does not begin with 'tensor_file'")
        version = take("<BB")
        if version != (1, 0):
            raise ValueError(f"{path}: tensor file of version {version[0]}.{version[1]}; only 1.0 is known")
        fields = {}
        for _ in range(take("<I")[0]):
            raw = file.read(take("<H")[0])
            dims, kind, offset = take("<HBQ")
            shape = take(f"<{dims}Q")
            try:
                name = raw.decode("utf-8")
            except UnicodeDecodeError:
                raise ValueError(f"{path}: a field's name is not text; fetch the file again") from None
            if kind not in TYPES:
                raise ValueError(f"{path}: field {name!r} has the unknown type {kind}; known are 1 to 11")
            fields[name] = (np.dtype(TYPES[kind]), offset, shape)
    arrays = {}
    for name, (dtype, offset, shape) in fields.items():
        count = 1
        for n in shape:
            count *= n
        if offset + count * dtype.itemsize > size:
            raise ValueError(f"{path}: field {name!r} ends beyond the file's {size} bytes; fetch the file again")
        if count:
            arrays[name] = np.memmap(path, dtype, "r", offset, shape=shape or (1,)).reshape(shape)
        else:
            arrays[name] = np.zeros(shape, dtype)
    return arrays


def write_tensors(path, arrays: dict[str, np.ndarray | str]) -> Path:
    """Write named arrays (a string becomes its UTF-8 bytes) as a tensor file, and return its path.

    Raises:
        ValueError: If an array's type has no number in the format, as bool.
        OSError: If the file cannot be written.
    """
    numbers = {np.dtype(kind): number for number, kind in TYPES.items()}
    fields = []
    for name, value in arrays.items():
        value = np.frombuffer(value.encode(), np.uint8) if isinstance(value, str) else np.asarray(value)
        dtype = value.dtype.newbyteorder("<")
        if dtype not in numbers:
            raise ValueError(f"{path}: field {name!r} is {value.dtype}; a tensor file holds integers and floats only")
        shape = value.shape
        fields.append((name.encode(), numbers[dtype], shape, np.ascontiguousarray(value, dtype)))
    offset = len(MAGIC) + 2 + 4 + sum(2 + len(name) + 2 + 1 + 8 + 8 * len(shape) for name, _, shape, _ in fields)
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(MAGIC + struct.pack("<BBI", 1, 0, len(fields)))
        places = []
        for name, number, shape, value in fields:
            offset = -(-offset // _ALIGN) * _ALIGN
            places.append(offset)
            file.write(struct.pack("<H", len(name)) + name)
            file.write(struct.pack(f"<HBQ{len(shape)}Q", len(shape), number, offset, *shape))
            offset += value.nbytes
        for place, (_, _, _, value) in zip(places, fields, strict=True):
            file.write(b"\0" * (place - file.tell()))
            value.tofile(file)
    return Path(path)
