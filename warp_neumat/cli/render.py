"""``neumat render`` and ``neumat demo``: mesh sequences to frames, video and report."""

import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from warp_neumat.cli.common import Device, Out, Usage, app, progress_bar, start_warp
from warp_neumat.cli.values import parse_assignments, parse_budget, parse_frames, parse_size


def _shot(sequence, materials, out, *, frames, renderer: dict, reference, video, **more):
    """Set up a renderer with its options, run the shot with progress bars, and say where everything is."""
    from warp_neumat.pipeline.renderer import Renderer
    from warp_neumat.pipeline.shot import prepare_folder, render_shot

    start = time.perf_counter()
    prepare_folder(out)
    sequence.frame(frames[-1])  # a frame that does not exist shows before the work
    with progress_bar("atlas") as progress:
        engine = Renderer(
            sequence,
            materials,
            frame_count=frames.stop,
            gain=2.0 ** more["exposure"],
            tonemap=more["tonemap"],
            progress=progress,
            **renderer,
        )
    twin = engine.per_pixel() if reference else None
    setup = {"renderer": 1e3 * (time.perf_counter() - start)}
    with progress_bar("render") as progress:
        report = render_shot(
            engine,
            out,
            frames,
            reference=twin,
            exr=more["exr"],
            video=video,
            options=more["options"],
            setup=setup,
            progress=progress,
        )
    for note in engine.atlas.notes:
        print(f"note: {note}", file=sys.stderr)
    summary = report["summary"]
    line = f"{len(frames)} frames, {summary['ms']:.1f} ms a frame, {summary['evaluations']:.0f} evaluations a frame"
    if reference:
        line += f"; FLIP {summary.get('flip', 0.0):.4f}, PSNR {summary.get('psnr') or float('inf'):.1f} dB"
    print(line)
    print(f"{out / 'report.html'}")


@app.command()
def render(
    sequence: Annotated[
        Path, typer.Argument(help=".glb, .gltf, .obj, .ply, .npz, or a folder of .obj or .ply frames.")
    ],
    material: Annotated[
        list[str],
        typer.Option(
            "--material", "-m", help="NAME=FILE for a mesh, node or material name; globs allowed: '*=x.neumat'."
        ),
    ],
    out: Out,
    frames: Annotated[str | None, typer.Option(help="A:B, as 0:48; default: the whole sequence.")] = None,
    animation: Annotated[str | None, typer.Option(help="glTF animation by name; default: the first.")] = None,
    fps: Annotated[float | None, typer.Option(help="Frames per second; default: the file's, else 30.")] = None,
    normals: Annotated[str, typer.Option(help="auto, smooth or flat; auto takes the file's.")] = "auto",
    double_sided: Annotated[bool | None, typer.Option(help="Override the materials' own flag.")] = None,
    atlas: Annotated[int, typer.Option(help="Side of the radiance texture [texel].")] = 1200,
    policy: Annotated[
        str,
        typer.Option(
            help="When texels are shaded anew: every frame; fixed: every interval + 1 frames; staggered: as many, but "
            "spread evenly; adaptive: those first whose light has changed most visibly."
        ),
    ] = "adaptive",
    interval: Annotated[
        int,
        typer.Option(
            help="Frames that reuse the shading before them. staggered spends as much as fixed with it would, adaptive "
            "a third, unless a budget or a target is given."
        ),
    ] = 4,
    budget: Annotated[
        str | None,
        typer.Option(help="For staggered and adaptive: evaluations a frame, as 250k, or shading time, as 4ms."),
    ] = None,
    target_flip: Annotated[
        float | None, typer.Option(help="For adaptive: mean FLIP against per-pixel shading to hold, as 0.02.")
    ] = None,
    carry: Annotated[
        bool | None,
        typer.Option(help="Carry stale light to the present by an analytic proxy; default: with adaptive."),
    ] = None,
    resident: Annotated[
        int | None,
        typer.Option(help="Hold only charts that are seen, on a sheet of this side [texel]; they stream."),
    ] = None,
    stereo: Annotated[bool, typer.Option(help="Two eyes; their pictures are written side by side.")] = False,
    eye_distance: Annotated[
        float | None, typer.Option(help="Between the eyes [scene unit]; default: 1/30 of the way to the centre.")
    ] = None,
    share: Annotated[
        float | None,
        typer.Option(help="Shade once for both eyes what differs by less between them [square root of luminance]."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Decides which of equals comes first.")] = 0,
    lights: Annotated[str, typer.Option(help="Number of default lights, or a lights file (JSON).")] = "3",
    camera: Annotated[str, typer.Option(help="orbit, or a camera file (JSON).")] = "orbit",
    size: Annotated[str, typer.Option(help="Size of the pictures, WxH [px].")] = "1280x720",
    reference: Annotated[
        bool, typer.Option(help="Also shade every pixel of every frame, and report PSNR, SSIM and FLIP against it.")
    ] = False,
    video: Annotated[bool, typer.Option(help="Also write video.mp4.")] = False,
    exr: Annotated[bool, typer.Option(help="Also write linear EXR frames.")] = False,
    exposure: Annotated[float, typer.Option(help="Gain before tone mapping [stops].")] = 0.0,
    tonemap: Annotated[str, typer.Option(help="srgb (clip and encode) or filmic.")] = "srgb",
    background: Annotated[str, typer.Option(help="Radiance where nothing is seen: one value or R,G,B.")] = "0.02",
    no_skip: Annotated[
        list[str] | None,
        typer.Option(
            help="Do not skip: unowned, backfacing, offscreen, occluded, rate, unchanged, range, spot or horizon; "
            "repeatable."
        ),
    ] = None,
    device: Device = "cpu",
):
    """Render a mesh sequence: frames, video, report."""
    from warp_neumat.pipeline.options import parse_background, parse_skips
    from warp_neumat.pipeline.policy import make_policy
    from warp_neumat.pipeline.tonemap import check_operator

    options = {k: str(v) if isinstance(v, Path) else v for k, v in locals().items() if not callable(v)}
    picture, assigned = parse_size(size), parse_assignments(material)
    try:
        skip, behind = parse_skips(no_skip or []), parse_background(background)
        limits = parse_budget(budget) if budget is not None else {}
        make_policy(policy, interval, target_flip=target_flip, **limits)  # a mistake shows before the work
        check_operator(tonemap, exposure)
    except ValueError as error:
        raise Usage(error) from None
    start_warp(device)
    from warp_neumat.pipeline.sequence import MeshSequence

    with progress_bar("load") as progress:
        loaded = MeshSequence.load(
            sequence,
            animation=animation,
            fps=fps,
            normals=normals,
            double_sided=double_sided,
            progress=lambda done, total: progress(done / total, f"{done} of {total} files"),
        )
    _shot(
        loaded,
        assigned,
        out,
        frames=parse_frames(frames, loaded.frame_count),
        renderer={
            "policy": policy,
            "interval": interval,
            "target_flip": target_flip,
            **limits,
            "carry": carry,
            "resident": resident,
            "stereo": stereo,
            "eye_distance": eye_distance,
            "share": share,
            "seed": seed,
            "atlas": atlas,
            "lights": lights,
            "camera": camera,
            "size": picture,
            "background": behind,
            "skip": skip,
            "device": device,
        },
        reference=reference,
        video=video,
        exposure=exposure,
        tonemap=tonemap,
        exr=exr,
        options=options,
    )


BUNDLED = {"policy": "adaptive", "interval": 4, "atlas": 1200, "lights": 3}
"""How the bundled animation is rendered."""


@app.command()
def demo(
    out: Out = Path("out/demo"),
    frames: Annotated[int, typer.Option(min=1, help="Number of frames.")] = 48,
    size: Annotated[str, typer.Option(help="Size of the pictures, WxH [px].")] = "1280x720",
    reference: Annotated[bool, typer.Option(help="Measure every frame against per-pixel shading.")] = True,
    device: Device = "cpu",
):
    """Render the bundled animation and its report."""
    picture = parse_size(size)
    start_warp(device)
    from warp_neumat.pipeline import demo as bundled

    _shot(
        bundled.sequence(frames),
        bundled.material_paths(),
        out,
        frames=range(frames),
        renderer={"size": picture, "background": (0.02, 0.02, 0.02), "device": device, **BUNDLED},
        reference=reference,
        video=True,
        exposure=0.0,
        tonemap="srgb",
        exr=False,
        options={"sequence": "demo", "frames": frames, "size": size, **BUNDLED, "device": device},
    )
