"""Arrays kept on disk between runs: one file each, whole or absent, checked on reading, the oldest dropped first.

A file is the magic ``NMTABLE1``, the number of bytes (uint64), their CRC-32 (uint32), all little endian, and the bytes.
Its name is a digest of everything the array depends on, so a file that can be read is right.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from pathlib import Path

import numpy as np

from warp_neumat.io.atomic import replacing

_HEAD = struct.Struct("<8sQI")
_MAGIC = b"NMTABLE1"


class TableCache:
    """Arrays of bytes in ``folder``, at most ``limit`` bytes together.

    A folder that cannot be written stops the writing, not the work: :attr:`trouble` then says why.
    """

    def __init__(self, folder, limit: int = 4 << 30):
        self.folder, self.limit, self.trouble = Path(folder), int(limit), ""

    def load(self, key: str, dtype, count: int) -> np.ndarray | None:
        """Return the array of ``count`` numbers under ``key``; ``None`` if there is none, or its file is damaged."""
        file = self.folder / f"{key}.table"
        try:
            with open(file, "rb") as stream:
                magic, size, check = _HEAD.unpack(stream.read(_HEAD.size))
                data = stream.read(size + 1)
        except (OSError, struct.error):
            return None
        if (
            magic != _MAGIC
            or len(data) != size
            or size != count * np.dtype(dtype).itemsize
            or zlib.crc32(data) != check
        ):
            return None
        with contextlib.suppress(OSError):
            os.utime(file)
        return np.frombuffer(data, dtype)

    def store(self, key: str, array: np.ndarray) -> None:
        """Write an array under ``key``."""
        if self.trouble:
            return
        data = np.ascontiguousarray(array).tobytes()
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with replacing(self.folder / f"{key}.table") as temporary, open(temporary, "wb") as stream:
                stream.write(_HEAD.pack(_MAGIC, len(data), zlib.crc32(data)))
                stream.write(data)
        except OSError as error:
            self.trouble = str(error)

    def trim(self) -> None:
        """Delete the files longest unused until all fit into the limit."""
        files = []
        with contextlib.suppress(OSError):
            for entry in os.scandir(self.folder):
                if entry.name.endswith(".table"):
                    with contextlib.suppress(OSError):
                        found = entry.stat()
                        files.append((found.st_mtime_ns, found.st_size, entry.path))
        total = sum(size for _, size, _ in files)
        for _, size, path in sorted(files):
            if total <= self.limit:
                break
            with contextlib.suppress(OSError):
                os.unlink(path)
            total -= size
