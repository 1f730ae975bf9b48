"""``neumat render`` and ``neumat demo``: mesh sequences to frames, video and report."""

import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from warp_neumat.cli.common import Device, Out, Usage, app, progress_bar, start_warp
from warp_neumat.cli.values import parse_assignments, parse_frames, parse_size


def _shot(sequence, materials, out, *, frames, interval, atlas, lights, camera, size, reference, video, device, **more):
    """Set up a renderer, run the shot with progress bars, and say where everything is."""
    from warp_neumat.pipeline.renderer import Renderer
    from warp_neumat.pipeline.shot import prepare_folder, render_shot

    start = time.perf_counter()
    prepare_folder(out)
    sequence.frame(frames[-1])  # a frame that does not exist shows before the work
    with progress_bar("atlas") as progress:
        renderer = Renderer(
            sequence,
            materials,
            atlas=atlas,
            camera=camera,
            lights=lights,
            interval=interval,
            skip=more["skip"],
            size=size,
            frame_count=frames.stop,
            background=more["background"],
            device=device,
            progress=progress,
        )
    twin = renderer.per_pixel() if reference else None
    setup = {"renderer": 1e3 * (time.perf_counter() - start)}
    with progress_bar("render") as progress:
        report = render_shot(
            renderer,
            out,
            frames,
            reference=twin,
            exposure=more["exposure"],
            operator=more["tonemap"],
            exr=more["exr"],
            video=video,
            options=more["options"],
            setup=setup,
            progress=progress,
        )
    for note in renderer.atlas.notes:
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
    interval: Annotated[int, typer.Option(help="Frames that reuse the shading before them; 0 = none.")] = 4,
    policy: Annotated[str, typer.Option(help="fixed (shade every interval + 1 frames) or every.")] = "fixed",
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
        list[str] | None, typer.Option(help="Shade what would be skipped: unseen, backfacing, unowned; repeatable.")
    ] = None,
    device: Device = "cpu",
):
    """Render a mesh sequence: frames, video, report."""
    from warp_neumat.pipeline.options import parse_background, parse_skips
    from warp_neumat.pipeline.tonemap import check_operator

    options = {k: str(v) if isinstance(v, Path) else v for k, v in locals().items() if not callable(v)}
    if policy not in ("fixed", "every"):
        raise Usage(f"--policy must be fixed or every, got {policy!r}")
    picture, assigned = parse_size(size), parse_assignments(material)
    try:
        skip, behind = parse_skips(no_skip or []), parse_background(background)
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
        interval=0 if policy == "every" else interval,
        atlas=atlas,
        lights=lights,
        camera=camera,
        size=picture,
        reference=reference,
        video=video,
        device=device,
        background=behind,
        skip=skip,
        exposure=exposure,
        tonemap=tonemap,
        exr=exr,
        options=options,
    )


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
    from warp_neumat.pipeline.renderer import SKIPS

    _shot(
        bundled.sequence(frames),
        bundled.material_paths(),
        out,
        frames=range(frames),
        interval=4,
        atlas=1200,
        lights="3",
        camera="orbit",
        size=picture,
        reference=reference,
        video=True,
        device=device,
        background=(0.02, 0.02, 0.02),
        skip=SKIPS,
        exposure=0.0,
        tonemap="srgb",
        exr=False,
        options={"sequence": "demo", "frames": frames, "size": size, "interval": 4, "atlas": 1200, "device": device},
    )
