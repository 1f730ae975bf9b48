"""Files that appear whole or not at all: written beside their place under a temporary name, then renamed."""

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def replacing(path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` with the same suffix; rename it to ``path`` when the block ends well.

    If the block raises, the temporary file is removed and what was at ``path`` stays.

    Raises:
        OSError: If the folder is missing or cannot be written; one line that names the file.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(4)}{path.suffix}")
    check_writable(path)
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def check_writable(path) -> None:
    """Raise an OSError that names ``path`` unless a file can be created there or replaced."""
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: cannot be written, there is no folder {path.parent}; create it first")
    if path.is_dir():
        raise IsADirectoryError(f"{path}: cannot be written, it is a folder; give a file name")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise PermissionError(f"{path}: cannot be written, the folder {path.parent} is read-only; choose another one")
