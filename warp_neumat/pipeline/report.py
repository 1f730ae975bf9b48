"""The record of a render: ``report.json`` for scripts and a self-contained ``report.html`` for people.

The report is a dict::

    {options, machine, versions,
     frames: [{index, ms: {stage: ms}, texels: {owned, facing, seen, shaded}, evaluations, error: {psnr, ssim, flip}}],
     summary: {…}}

``error`` is there where a reference was rendered. The stages ``reference`` and ``metrics`` are work that only
``--reference`` asks for: they are listed, but no part of the frame time.
"""

import base64
import json
import math
import statistics
import tempfile
from pathlib import Path

import numpy as np

from ..io.atomic import replacing
from ..io.image import read_image, to_uint8
from .report_html import page
from .tonemap import tonemap

ASIDE = ("reference", "metrics")
"""Stages that a render without ``--reference`` does not have."""

FRAMES_EMBEDDED = 60
WIDTH_EMBEDDED = 480

_STAGES = ("pose", "schedule", "visibility", "stream", "mark", "list", "shade", "gather", "probe")
_STAGES += ("tonemap", "write", "video")


def write_report(folder, report: dict, *, frames: list = ()) -> dict:
    """Write ``report.json`` and ``report.html`` into ``folder`` and return the report as it was written.

    Args:
        folder: Existing folder.
        report: As in the module's docstring. What :func:`summarise` finds is added to its ``summary``; values that are
            there stay. Floats are written with six digits, NaN and infinities as null.
        frames: The pictures of ``report["frames"]``, as many or none: paths of PNG or EXR files, or display values of
            shape (H, W, 3). At most 60, evenly spaced, are embedded, at most 480 px wide.

    Raises:
        OSError: If the folder cannot be written or a picture cannot be read; one line that names the file.
        ValueError: If there is no frame, or the number of pictures differs.
    """
    folder, frames = Path(folder), list(frames)
    entries = report.get("frames") or []
    if not entries:
        raise ValueError("a report needs at least one frame")
    if frames and len(frames) != len(entries):
        raise ValueError(f"frames must hold one picture per entry of the report, {len(entries)}, got {len(frames)}")
    report = plain({**report, "summary": {**summarise(entries), **report.get("summary", {})}})
    with replacing(folder / "report.json") as temporary:
        temporary.write_text(json.dumps(report, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    chosen = spread(len(frames), FRAMES_EMBEDDED)
    pictures = [(k, data_uri(frames[k])) for k in chosen]
    with replacing(folder / "report.html") as temporary:
        temporary.write_text(page(report, pictures, stages=stages(entries), aside=ASIDE), encoding="utf-8")
    return report


def stages(entries: list[dict]) -> list[str]:
    """Return the names of all stages in ``entries``, in the order a frame passes them; unknown ones come last."""
    found = dict.fromkeys(name for entry in entries for name in entry.get("ms", {}))
    return [name for name in _STAGES if name in found] + [name for name in found if name not in _STAGES]


def summarise(entries: list[dict]) -> dict:
    """Return what a report's frames amount to.

    ``ms`` and ``shade_ms`` are means per frame [ms], ``ms_median`` and ``ms_first`` the median and the first frame's,
    which holds what happens once; ``stages`` maps each stage to its median; ``texels`` and ``evaluations`` are means
    per frame. ``psnr``, ``ssim`` and ``flip`` are means over the frames that have a finite value; ``flip_worst`` is
    the largest.
    """
    totals = [sum(v for name, v in entry.get("ms", {}).items() if name not in ASIDE) for entry in entries]
    summary = {"frames": len(entries), "ms": statistics.fmean(totals), "ms_median": statistics.median(totals)}
    summary["ms_first"] = totals[0]
    names = stages(entries)
    summary["stages"] = {n: statistics.median(e.get("ms", {}).get(n, 0.0) for e in entries) for n in names}
    if "shade" in names:
        summary["shade_ms"] = statistics.fmean(e.get("ms", {}).get("shade", 0.0) for e in entries)
    texels = dict.fromkeys(name for entry in entries for name in entry.get("texels", {}))
    if texels:
        summary["texels"] = {n: statistics.fmean(e.get("texels", {}).get(n, 0) for e in entries) for n in texels}
    left_out = dict.fromkeys(name for entry in entries for name in entry.get("skipped", {}))
    if left_out:
        summary["skipped"] = {n: statistics.fmean(e.get("skipped", {}).get(n, 0) for e in entries) for n in left_out}
    if any("evaluations" in entry for entry in entries):
        summary["evaluations"] = statistics.fmean(entry.get("evaluations", 0) for entry in entries)
    errors = [entry["error"] for entry in entries if entry.get("error")]
    for name in ("psnr", "ssim", "flip"):
        values = [e[name] for e in errors if e.get(name) is not None and math.isfinite(e[name])]
        if values:
            summary[name] = statistics.fmean(values)
            if name == "flip":
                summary["flip_worst"] = max(values)
    return summary


def plain(value):
    """Return ``value`` as JSON can say it: NumPy's numbers become Python's, floats six digits, NaN and Inf None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    if value is None or isinstance(value, (bool, int, str)):
        return value
    return str(value)


def spread(count: int, most: int) -> list[int]:
    """Return at most ``most`` of 0 … ``count`` − 1, evenly spaced, the first and the last among them."""
    if count <= most:
        return list(range(count))
    return [round(k * (count - 1) / (most - 1)) for k in range(most)]


def data_uri(picture, width: int = WIDTH_EMBEDDED) -> str:
    """Return a picture as a JPEG data URI at most ``width`` pixels wide.

    Args:
        picture: Path of a PNG or EXR (linear: shown at exposure 0), or display values, shape (H, W, 3).
        width: Largest width [px].
    """
    import OpenImageIO as oiio

    if isinstance(picture, (str, Path)):
        values, _ = read_image(picture)
        picture = tonemap(values[..., :3]) if Path(picture).suffix.lower() == ".exr" else values[..., :3]
    picture = np.ascontiguousarray(to_uint8(picture)[..., :3])
    if picture.ndim != 3 or picture.shape[2] != 3:
        raise ValueError(f"a frame must have shape (H, W, 3), got {picture.shape}")
    buffer = oiio.ImageBuf(picture)
    if picture.shape[1] > width:
        height = max(1, round(picture.shape[0] * width / picture.shape[1]))
        # A box averages all pixels that it covers, in a tenth of the time of the default window.
        buffer = oiio.ImageBufAlgo.resize(buffer, "box", roi=oiio.ROI(0, width, 0, height, 0, 1, 0, 3))
    buffer.specmod()["compression"] = "jpeg:85"
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "frame.jpg")
        if not buffer.write(str(file), "uint8"):
            raise OSError(f"a frame of the report cannot be encoded: {' '.join(buffer.geterror().split())}")
        return "data:image/jpeg;base64," + base64.b64encode(file.read_bytes()).decode("ascii")
