"""The `.neumat` container: one safetensors file whose metadata holds a JSON header under the key ``neumat``.

The header states kind, version, the resolved config, the source, training facts and metrics; the tensors are what the
kind defines. Files are written beside their target and renamed, so that a reader never meets half a file. Nothing is
pickled.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from warp_neumat.io.atomic import replacing

KINDS = {"bcf": 1, "btf": 1, "neubrdf": 2, "neubrdf-group": 1, "ntbc": 1}
"""Known kinds and the newest version of each that this release reads."""

_KEY = "neumat"


class FormatError(ValueError):
    """A file that is not what it should be: path, field, broken rule and way out, in one line."""

    def __init__(self, path, field: str, rule: str, way_out: str):
        self.path, self.field = Path(path), field
        super().__init__(f"{path}: {field}: {rule}; {way_out}")


# --- file -------------------------------------------------------------------------------------------------------------


def write_asset(path: str | os.PathLike, tensors: dict[str, np.ndarray], header: dict) -> None:
    """Write ``tensors`` and ``header`` to ``path``, whole or not at all.

    The same arguments give the same bytes.

    Args:
        path: Target; an existing file is replaced.
        tensors: Arrays by name, as the kind defines them.
        header: JSON-able dictionary with at least ``kind`` and ``version``.

    Raises:
        ValueError: If the header's kind or version is not one of :data:`KINDS`, or does not fit into JSON.
        OSError: If the folder does not exist or cannot be written.
    """
    path = Path(path)
    _check_header(path, header)
    text = json.dumps(header, ensure_ascii=False, allow_nan=False)
    content = save({k: np.ascontiguousarray(v) for k, v in tensors.items()}, metadata={_KEY: text})
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_asset(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], dict]:
    """Return (tensors, header) of the asset at ``path``.

    Raises:
        FileNotFoundError: If there is no such file.
        FormatError: If it is truncated, no safetensors file, no asset, of an unknown kind or a newer version, or holds
            floating-point values that are not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; give the path of a .neumat asset")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in sorted(file.keys())}  # noqa: SIM118 (no iterator)
    except SafetensorError as error:
        reason = str(error).splitlines()[0]
        raise FormatError(
            path, "file", f"truncated or no safetensors file ({reason})", "copy or fit it again"
        ) from None
    except (TypeError, AttributeError, KeyError) as error:  # element types that numpy does not have, as bf16
        raise FormatError(path, "file", f"holds a tensor type that numpy lacks ({error})", "fit it again") from None
    if _KEY not in metadata:
        raise FormatError(
            path, _KEY, "missing in the metadata, so this is no neumat asset", "make one with `neumat fit`"
        )
    try:
        header = json.loads(metadata[_KEY])
    except json.JSONDecodeError as error:
        raise FormatError(path, _KEY, f"header is not JSON ({error})", "fit it again") from None
    _check_header(path, header)
    for name, tensor in tensors.items():
        if tensor.dtype.kind == "f" and not np.isfinite(tensor).all():
            raise FormatError(path, name, "holds values that are not finite", "fit it again")
    return tensors, header


def _check_header(path: Path, header) -> None:
    if not isinstance(header, dict) or not isinstance(header.get("kind"), str):
        raise FormatError(path, "kind", "missing in the header", "fit it again")
    kind, version = header["kind"], header.get("version")
    if kind not in KINDS:
        raise FormatError(path, "kind", f"{kind!r} is unknown", f"this release reads {', '.join(sorted(KINDS))}")
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise FormatError(path, "version", f"must be a whole number of at least 1, got {version!r}", "fit it again")
    if version > KINDS[kind]:
        rule = f"{version} of {kind} is newer than {KINDS[kind]}, the newest this release reads"
        raise FormatError(path, "version", rule, "update warp-neumat")


def expect(tensors: dict[str, np.ndarray], name: str, dtype, shape: tuple, path) -> np.ndarray:
    """Return ``tensors[name]`` if it has ``dtype`` and ``shape``.

    Raises:
        FormatError: If it is missing, or of another type or shape.
    """
    if name not in tensors:
        raise FormatError(path, name, "missing", "fit it again")
    tensor, dtype = tensors[name], np.dtype(dtype)
    if tensor.dtype != dtype:
        raise FormatError(path, name, f"must be {dtype}, got {tensor.dtype}", "fit it again")
    if tensor.shape != tuple(shape):
        raise FormatError(path, name, f"must have shape {tuple(shape)}, got {tensor.shape}", "fit it again")
    return tensor


# --- bit streams ------------------------------------------------------------------------------------------------------


def pack_bits(values: np.ndarray, bits: int) -> np.ndarray:
    """Return ``values`` as a little-endian stream of ``bits`` bits each, uint8; the last byte is filled with zeros.

    Bit b of value i is bit (i·bits + b) mod 8 of byte (i·bits + b) div 8.

    Raises:
        ValueError: If a value does not fit.
    """
    values = np.asarray(values).ravel()
    if not 1 <= bits <= 16:
        raise ValueError(f"bits must be in [1, 16], got {bits}")
    if values.size and (values.min() < 0 or values.max() >> bits):
        raise ValueError(
            f"values must lie in [0, {(1 << bits) - 1}] for {bits} bits, got {values.min()} … {values.max()}"
        )
    if bits == 8:
        return values.astype(np.uint8)
    if bits < 8:
        planes = np.unpackbits(values.astype(np.uint8)[:, None], axis=1, count=bits, bitorder="little")
    else:
        planes = (values.astype(np.uint16)[:, None] >> np.arange(bits, dtype=np.uint16)) & np.uint16(1)
    return np.packbits(planes.astype(np.uint8, copy=False).ravel(), bitorder="little")


def packed_bytes(count: int, bits: int) -> int:
    """Return the bytes that ``count`` values of ``bits`` bits take."""
    return -(-count * bits // 8)


def unpack_bits(data: np.ndarray, bits: int, count: int) -> np.ndarray:
    """Return the ``count`` values of ``bits`` bits each that :func:`pack_bits` wrote, (count,) int32.

    Raises:
        ValueError: If ``data`` has not exactly the bytes that ``count`` values need.
    """
    data = np.asarray(data, np.uint8).ravel()
    if not 1 <= bits <= 16:
        raise ValueError(f"bits must be in [1, 16], got {bits}")
    needed = packed_bytes(count, bits)
    if data.size != needed:
        raise ValueError(f"{count} values of {bits} bits need {needed} bytes, got {data.size}")
    if bits == 8:
        return data.astype(np.int32)
    planes = np.unpackbits(data, bitorder="little", count=count * bits).reshape(count, bits)
    if bits < 8:
        return np.packbits(planes, axis=1, bitorder="little")[:, 0].astype(np.int32)
    return planes.astype(np.int32) @ (np.int32(1) << np.arange(bits, dtype=np.int32))
