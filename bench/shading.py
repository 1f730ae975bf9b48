"""Texture-space shading by atlas resolution and update interval, beside per-pixel shading (MobileVR, Table 2).

Fox "Run" under one point light at 2064×2208, an orbiting camera, one measured-like metal. Every frame is rendered by
all settings in turn, so that noise hits them alike. In texture space the policy is the paper's: all that is seen is
shaded anew every (interval + 1)th frame, at the atlas's own resolution. ``shade_ms`` is the shading stage, ``ms`` the
whole frame without writing it; both are means per frame over whole epochs, after a frame of warm-up. ``ratio`` is the
shading time of screen space over ours. FLIP and PSNR compare the tone-mapped pictures with screen space over
consecutive frames, so that every age of the reused radiance is among them.
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

COLUMNS = ["atlas", "interval", "shade_ms", "ms", "evaluations", "seen", "flip", "psnr", "peer", "peer_ms", "ratio"]

RESOLUTIONS, INTERVALS = (800, 1200, 1600, 2000), (0, 1, 2, 4, 6)
PAPER = {"policy": "fixed", "skip": [name for name in SKIPS if name != "rate"]}
COMPARED = range(12, 19)  # seven frames: every age of the longest interval


def rows(*, device: str, quick: bool, lights: int = 1, material=None, size=(2064, 2208), frames: int = 30):
    """Yield one row for screen space and one per atlas resolution and interval."""
    data = Path(os.environ.get("NEUMAT_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    sequence = MeshSequence.load(data / "animation" / "Fox.glb", animation="Run")
    resolutions, intervals, compared = RESOLUTIONS, INTERVALS, COMPARED
    if quick:
        resolutions, intervals, compared, size, frames = (400,), (0, 4), range(1, 3), (258, 276), 5
    common = {"size": size, "lights": lights, "frame_count": max(frames, 48), "device": device}
    materials = {"*": material or material_paths()["knot"]}
    settings: dict = {"screen": Renderer(sequence, materials, space="screen", **common)}
    for side in resolutions:
        atlas = Atlas.build(sequence, side, device=device)
        for interval in intervals:
            paper = {"atlas": atlas, "interval": interval, **PAPER}
            settings[side, interval] = Renderer(sequence, materials, **paper, **common)
    stats: dict = {key: [] for key in settings}
    errors: dict = {key: [] for key in settings}
    for renderer in settings.values():  # warm up
        renderer.frame(0)
        renderer.restart()
    for frame in track(range(frames), "all settings, frame by frame"):
        expected = None
        for key, renderer in settings.items():
            rendered = renderer.frame(frame)
            interval = 0 if key == "screen" else key[1]
            if frame < frames - frames % (interval + 1):  # whole epochs only
                stats[key].append(rendered.stats)
            if frame not in compared:
                continue
            display = tonemap(rendered.image)
            if expected is None:
                expected = display
            else:
                errors[key].append((metrics.flip(expected, display)[0], metrics.psnr(expected, display)))

    def mean(key, pick):
        return float(np.mean([pick(s) for s in stats[key]]))

    screen = mean("screen", lambda s: s["ms"]["shade"])
    for key in settings:
        error = dict(zip(("flip", "psnr"), np.mean(errors[key], axis=0).tolist(), strict=True)) if errors[key] else {}
        shade = mean(key, lambda s: s["ms"]["shade"])
        yield {
            "atlas": "screen" if key == "screen" else key[0],
            "interval": 0 if key == "screen" else key[1],
            "lights": lights,
            "width": size[0],
            "height": size[1],
            "shade_ms": shade,
            "ms": mean(key, lambda s: sum(s["ms"].values())),
            "stages": {name: mean(key, lambda s, n=name: s["ms"][n]) for name in stats[key][0]["ms"]},
            "evaluations": mean(key, lambda s: s["evaluations"]),
            "seen": mean(key, lambda s: s["texels"]["seen"]),
            **error,
            **({} if key == "screen" else {"peer": "screen", "peer_ms": screen, "ratio": screen / shade}),
        }
