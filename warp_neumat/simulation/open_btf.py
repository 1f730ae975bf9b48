"""Bidirectional texture functions by name: measured files, archives of photographs, and simulated micro-geometry."""

from __future__ import annotations

import os
import re
from pathlib import Path

from warp_neumat.io.brdf_source import suggest
from warp_neumat.io.btf_source import BTFSource
from warp_neumat.io.ubo2003 import open_ubo2003
from warp_neumat.io.ubo2014 import open_ubo2014
from warp_neumat.simulation.gonioreflectometer import open_microgeometry

MICROGEOMETRY = "microgeometry:"
FORMS = "FILE.btf (UBO2014), FILE.zip or FOLDER of tl… pl… tv… pv… pictures (UBO2003), microgeometry:PATTERN?…"

_OPTIONS = {"ubo2014": {"scale": float, "azimuth": str}, "ubo2003": {"transfer": str, "scale": float, "azimuth": str}}
_PICTURE = re.compile(r"tl\d+[ _]pl\d+[ _]tv\d+[ _]pv\d+", re.IGNORECASE)


def is_btf_spec(spec) -> bool:
    """Return whether ``spec`` is of a form that only a BTF has; says nothing of whether it can be opened."""
    if not isinstance(spec, (str, os.PathLike)):
        return False
    text = os.fspath(spec)
    file = text.partition("?")[0]
    return text.startswith(MICROGEOMETRY) or file.lower().endswith((".btf", ".zip")) or _has_pictures(Path(file))


def _has_pictures(folder: Path) -> bool:
    if not folder.is_dir():
        return False
    # The archives keep their pictures up to two folders deep, tens of thousands of them: the first few tell.
    for depth in ("*", "*/*", "*/*/*"):
        for number, path in enumerate(folder.glob(depth)):
            if _PICTURE.search(path.name):
                return True
            if number > 200:
                break
    return False


def open_btf(spec) -> BTFSource:
    """Return the BTF that ``spec`` names: :data:`FORMS`.

    Files take options as ``FILE.btf?scale=0.5&azimuth=clockwise``, those of
    :func:`warp_neumat.io.ubo2014.open_ubo2014` and :func:`warp_neumat.io.ubo2003.open_ubo2003`.

    Raises:
        FileNotFoundError: If there is no such file.
        FormatError: If a file cannot be read.
        ValueError: If the form, a pattern or an option is unknown or out of range; names the nearest.
    """
    text = os.fspath(spec)
    if text.startswith(MICROGEOMETRY):
        return open_microgeometry(text)
    file, _, query = text.partition("?")
    if not Path(file).exists():
        raise FileNotFoundError(f"{file}: no such file or folder; a BTF is {FORMS}")
    if file.lower().endswith(".btf"):
        return open_ubo2014(file, **_options(text, query, _OPTIONS["ubo2014"]))
    if file.lower().endswith(".zip") or _has_pictures(Path(file)):
        return open_ubo2003(file, **_options(text, query, _OPTIONS["ubo2003"]))
    raise ValueError(f"{file}: not a BTF; known: {FORMS}")


def _options(text: str, query: str, known: dict) -> dict:
    found: dict = {}
    for part in filter(None, query.split("&")):
        key, _, value = part.partition("=")
        if key not in known or key in found:
            raise ValueError(f"{text}: no option {key!r} here, or it is given twice; {suggest(key, known)}")
        try:
            found[key] = known[key](value)
        except ValueError:
            raise ValueError(f"{text}: {key} must be a number, got {value!r}") from None
    return found
