"""A whole shot on disk: frames, video, reference and report."""

import math
import re
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from warp_neumat import machine, metrics
from warp_neumat.io.atomic import check_writable
from warp_neumat.io.image import write_exr, write_png
from warp_neumat.io.video import VideoWriter
from warp_neumat.pipeline.renderer import Renderer
from warp_neumat.pipeline.report import write_report
from warp_neumat.pipeline.tonemap import tonemap


def prepare_folder(out) -> Path:
    """Make the folder ``out`` with its ``frames``, and return it; what is there stays.

    Raises: OSError: If that cannot be done or the folder cannot be written; one line.
    """
    out = Path(out)
    try:
        (out / "frames").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise type(error)(f"{out}: cannot be made ({error.strerror}); choose a folder that you may write to") from None
    check_writable(out / "report.json")
    return out


def _clear(out: Path) -> None:
    """Remove what an earlier shot wrote to ``out``, so that its frames do not pass for this one's."""
    for part in ("frames", "reference"):
        for old in (out / part).glob("*"):
            if re.fullmatch(r"\d{4,}\.(png|exr)", old.name):
                old.unlink()
    for name in ("video.mp4", "report.html", "report.json"):
        (out / name).unlink(missing_ok=True)


def render_shot(
    renderer: Renderer,
    out,
    frames: range,
    *,
    reference: Renderer | None = None,
    exr: bool = False,
    video: bool = False,
    options: dict | None = None,
    setup: dict | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> dict:
    """Render ``frames`` into the folder ``out`` and return the report.

    Written are ``frames/NNNN.png``, with ``exr`` also ``frames/NNNN.exr`` (linear, float16), with ``video``
    ``video.mp4``, ``report.json`` and ``report.html``; with ``reference`` also ``reference/NNNN.png``. A renderer of
    two eyes gives pictures of twice the width, the left eye's on the left; errors are then means over both.

    Args:
        renderer: What renders; its gain and tone mapping are those of the pictures.
        out: Folder, made where it is missing.
        frames: Frame numbers.
        reference: Renders the same frames in screen space; the error of each frame is measured against it on the
            tone-mapped pictures: PSNR, SSIM, FLIP.
        options: What the report says was asked for.
        setup: Milliseconds of what came before the first frame, by name, for the report.
        progress: Called as ``progress(fraction, text)``.

    Raises:
        OSError: If the folder cannot be made or written.
        ImportError: If ``video`` or ``reference`` needs an extra that is not installed; nothing is rendered then.
        ValueError: If there is no frame, or the reference has another number of eyes.
    """
    if not len(frames):
        raise ValueError("there is no frame to render; give a range A:B with B above A")
    exposure, operator = math.log2(renderer.gain), renderer.tonemap
    if reference is not None and reference.stereo != renderer.stereo:
        raise ValueError("reference must have as many eyes as the renderer; use Renderer.per_pixel")
    if reference is not None:  # a missing extra or too small a picture shows before the work
        blank = np.zeros((renderer.height, renderer.width, 3), np.float32)
        metrics.ssim(blank, blank)
        metrics.flip(blank[:16, :16], blank[:16, :16] + 0.5)
    out = prepare_folder(out)
    _clear(out)
    if reference is not None:
        (out / "reference").mkdir(exist_ok=True)
    eyes = 2 if renderer.stereo else 1
    width = eyes * renderer.width
    writer = VideoWriter(out / "video.mp4", width, renderer.height, renderer.sequence.fps) if video else None
    entries, pictures = [], []

    def shoot(add: Callable[[np.ndarray], None]) -> None:
        for done, index in enumerate(frames):
            if progress:
                progress(done / len(frames), f"frame {index}")
            frame = renderer.frame(index)
            stats = frame.stats
            clock = time.perf_counter()

            def stage(name):
                nonlocal clock
                now = time.perf_counter()
                stats["ms"][name] = 1e3 * (now - clock)  # noqa: B023  (called within the iteration)
                clock = now

            linear = np.hstack(frame.eyes)
            display = tonemap(linear, exposure, operator)
            stage("tonemap")
            path = out / "frames" / f"{index:04d}.png"
            write_png(path, display)
            if exr:
                write_exr(path.with_suffix(".exr"), linear)
            stage("write")
            add(display)
            stage("video")
            if reference is not None:
                shaded = reference.frame(index)
                stats["ms"]["reference"] = sum(shaded.stats["ms"].values())
                stats["reference"] = {"shade_ms": shaded.stats["ms"]["shade"]}
                stats["reference"]["evaluations"] = shaded.stats["evaluations"]
                clock = time.perf_counter()
                expected = tonemap(np.hstack(shaded.eyes), exposure, operator)
                write_png(out / "reference" / f"{index:04d}.png", expected)
                stats["error"] = _error(expected, display, eyes)
                stage("metrics")
            if writer is None:
                del stats["ms"]["video"]
            entries.append({"index": index, **stats})
            pictures.append(path)

    if writer is None:
        shoot(lambda display: None)
    else:
        with writer:
            shoot(writer.add)
    if progress:
        progress(1.0, "report")
    report = {
        "options": {"exposure": exposure, "tonemap": operator, **(options or {})},
        "machine": machine.machine(),
        "versions": machine.versions(),
        "setup_ms": setup or {},
        "frames": entries,
        "summary": _summary(renderer, entries),
    }
    return write_report(out, report, frames=pictures)


def _error(expected: np.ndarray, display: np.ndarray, eyes: int) -> dict:
    """Return PSNR, SSIM and FLIP of a picture of so many eyes side by side: the means over them."""
    pairs = [
        tuple(np.ascontiguousarray(half) for half in pair)
        for pair in zip(np.hsplit(expected, eyes), np.hsplit(display, eyes), strict=True)
    ]
    errors = {
        "psnr": [metrics.psnr(*pair) for pair in pairs],
        "ssim": [metrics.ssim(*pair) for pair in pairs],
        "flip": [metrics.flip(*pair)[0] for pair in pairs],
    }
    return {name: float(np.mean(values)) for name, values in errors.items()}


def _summary(renderer: Renderer, entries: list[dict]) -> dict:
    """Return what the report's own summary does not know: the atlas, and the gain over the reference."""
    summary: dict = {}
    if renderer.atlas is not None:
        atlas = renderer.atlas
        summary["atlas"] = {
            "resolution": atlas.resolution,
            "utilisation": getattr(atlas, "utilisation", None),  # a layout has no texels
            "charts": int(atlas.chart.max()) + 1,
            "sources": atlas.sources,
            "notes": atlas.notes,
        }
    if renderer.stereo:
        summary["stereo"] = {
            "eye_distance": renderer.eye_distance,
            "pictures": "left and right eye side by side",
            "numbers": "texels and evaluations are sums over both eyes, errors are means",
        }
        if "shared" in entries[0]:
            names = entries[0]["shared"]
            summary["shared"] = {n: sum(e["shared"][n] for e in entries) / len(entries) for n in names}
    if "reference" in entries[0]:
        ours = sum(e["ms"]["shade"] for e in entries)
        summary["reference_shade_ms"] = sum(e["reference"]["shade_ms"] for e in entries) / len(entries)
        summary["shade_speedup"] = summary["reference_shade_ms"] * len(entries) / ours if ours else None
        summary["reference_evaluations"] = sum(e["reference"]["evaluations"] for e in entries) / len(entries)
    if renderer.sequence.degenerate_faces:
        summary["degenerate_faces"] = renderer.sequence.degenerate_faces
    return summary
