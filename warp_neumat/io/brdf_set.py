"""Many BRDF sources at once: all functions of an npz file, those whose names match a pattern, or a folder of files."""

from __future__ import annotations

import fnmatch
import re
from pathlib import Path
from typing import NamedTuple

from warp_neumat.io.brdf import function_names, open_brdf
from warp_neumat.io.brdf_source import BRDFSource

SUFFIXES = (".binary", ".bsdf", ".csv")
"""Files of a folder that are taken for sources."""


class Opened(NamedTuple):
    """A source, and what it was opened by."""

    spec: str
    """What :func:`warp_neumat.io.brdf.open_brdf` opens the same source by."""
    source: BRDFSource


def open_brdfs(spec: str) -> dict[str, Opened]:
    """Return the sources that ``spec`` names, by a name that can be a file's.

    Args:
        spec: ``FILE.npz`` (all of its materials), ``FILE.npz:PATTERN`` with ``*``, ``?`` and ``[…]``, a folder of
            ``.binary``, ``.bsdf`` and ``.csv`` files, or anything that :func:`warp_neumat.io.brdf.open_brdf` takes.

    Raises:
        ValueError: If nothing is found, or two sources would have one name.
        FileNotFoundError: If a file does not exist.
    """
    path = Path(spec)
    if path.is_dir():
        files = sorted(file for file in path.iterdir() if file.suffix.lower() in SUFFIXES)
        if not files:
            raise ValueError(f"{spec}: the folder holds no {', '.join(SUFFIXES)} file")
        return _named([(file.stem, str(file)) for file in files])
    match = re.fullmatch(r"(?P<file>.+\.npz)(:(?P<pattern>[^:/\\]*))?", spec, flags=re.IGNORECASE | re.DOTALL)
    if not match or (match["pattern"] and not re.search(r"[*?\[]", match["pattern"])):
        source = open_brdf(spec)
        return {_file_name(source.name): Opened(spec, source)}
    file, pattern = Path(match["file"]), match["pattern"] or "*"
    names = function_names(file)
    chosen = fnmatch.filter(names, pattern)
    if not chosen:
        raise ValueError(f"{spec}: no material matches {pattern!r}; there are {', '.join(names[:8])}, …")
    return _named([(name, f"{file}:{name}") for name in chosen])


def _named(pairs) -> dict[str, Opened]:
    found: dict[str, Opened] = {}
    for name, spec in pairs:
        if _file_name(name) in found:
            raise ValueError(f"{spec}: a second source named {_file_name(name)!r}; rename one of them")
        found[_file_name(name)] = Opened(spec, open_brdf(spec))
    return found


def _file_name(name: str) -> str:
    return re.sub(r"[^\w.-]+", "_", name) or "material"
