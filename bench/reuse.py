"""Fox "Run", 48 frames, orbiting camera, three lights: what reuse saves at 2064×2208, and what it costs at 720p.

The policy is the paper's: all that is seen is shaded anew every (interval + 1)th frame, at the atlas's own resolution.
The atlas has 1200² texels. The first row compares shading times at 2064×2208: interval 4 beside per-pixel shading,
frame by frame in turns, after a frame of warm-up. The others give the error of each interval at 1280×720 against
per-pixel shading of every frame.
"""

import os
from pathlib import Path

import numpy as np

from bench.harness import track
from warp_neumat import metrics
from warp_neumat.pipeline.atlas import Atlas
from warp_neumat.pipeline.demo import material_paths
from warp_neumat.pipeline.renderer import SKIPS, Renderer
from warp_neumat.pipeline.sequence import MeshSequence
from warp_neumat.pipeline.tonemap import tonemap

COLUMNS = [
    "size",
    "interval",
    "shade_ms",
    "evaluations",
    "flip",
    "flip_worst",
    "psnr",
    "ssim",
    "peer",
    "peer_ms",
    "ratio",
]

FRAMES = 48

PAPER = {"policy": "fixed", "skip": [name for name in SKIPS if name != "rate"]}


def rows(*, device: str, quick: bool):
    """Yield the speed row and one error row per interval."""
    data = Path(os.environ.get("NEUMAT_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    sequence = MeshSequence.load(data / "animation" / "Fox.glb", animation="Run")
    materials = {"fox": material_paths()["knot"]}
    big, small, frames, intervals = (2064, 2208), (1280, 720), FRAMES, (0, 1, 2, 4, 6)
    atlas = Atlas.build(sequence, 400 if quick else 1200, device=device)
    if quick:
        big, small, frames, intervals = (258, 276), (160, 90), 6, (0, 4)
    common = {"lights": 3, "frame_count": FRAMES, "device": device}

    ours = Renderer(sequence, materials, atlas=atlas, interval=4, size=big, **PAPER, **common)
    screen = ours.per_pixel()
    for renderer in (ours, screen):
        renderer.frame(0)
    ours.restart()
    stats = [(ours.frame(k).stats, screen.frame(k).stats) for k in track(range(frames), "times")]

    def mean(which, pick):
        return float(np.mean([pick(pair[which]) for pair in stats]))

    shade, peer = (mean(which, lambda s: s["ms"]["shade"]) for which in (0, 1))
    yield {
        "size": f"{big[0]}x{big[1]}",
        "interval": 4,
        "shade_ms": shade,
        "ms": mean(0, lambda s: sum(s["ms"].values())),
        "evaluations": mean(0, lambda s: s["evaluations"]),
        "peer": "per pixel",
        "peer_ms": peer,
        "peer_frame_ms": mean(1, lambda s: sum(s["ms"].values())),
        "peer_evaluations": mean(1, lambda s: s["evaluations"]),
        "ratio": peer / shade,
    }
    del ours, screen

    paper = {"atlas": atlas, "size": small, **PAPER, **common}
    renderers = {k: Renderer(sequence, materials, interval=k, **paper) for k in intervals}
    reference = renderers[0].per_pixel()
    found: dict = {k: [] for k in intervals}
    for frame in track(range(frames), "errors"):
        expected = tonemap(reference.frame(frame).image)
        for interval, renderer in renderers.items():
            rendered = renderer.frame(frame)
            display = tonemap(rendered.image)
            error = (
                metrics.flip(expected, display)[0],
                metrics.psnr(expected, display),
                metrics.ssim(expected, display),
            )
            found[interval].append((*error, rendered.stats["ms"]["shade"], rendered.stats["evaluations"]))
    for interval, values in found.items():
        flip, psnr, ssim, ms, evaluations = np.array(values).T
        yield {
            "size": f"{small[0]}x{small[1]}",
            "interval": interval,
            "shade_ms": float(ms.mean()),
            "evaluations": float(evaluations.mean()),
            "flip": float(flip.mean()),
            "flip_worst": float(flip.max()),
            "psnr": float(psnr.mean()),
            "ssim": float(ssim.mean()),
        }
