"""The ``neumat`` command: arguments in, calls out, errors as one line. What it does lives in the packages it calls."""

import contextlib
import os
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    name="neumat",
    help="Neural materials on NVIDIA Warp: fit them, look at them, render mesh sequences with them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain help starts in half the time
    context_settings={"help_option_names": ["-h", "--help"]},
)

Device = Annotated[str, typer.Option(help="Warp device: cpu or cuda:0.")]
Out = Annotated[Path, typer.Option("-o", "--out", help="Folder to write into; made where it is missing.")]


class Usage(ValueError):
    """An argument that is not written as it must be: exit code 2."""


@app.callback()
def _globals(debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False):
    pass  # the option is listed here, and taken by main() wherever it stands


@contextlib.contextmanager
def _progress(title: str):
    """Yield ``progress(fraction, text)`` that draws a bar on stderr, or nothing where that is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = [
        "{task.description}",
        BarColumn(),
        "{task.percentage:>3.0f}%",
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    ]
    columns.append(TextColumn("{task.fields[text]}"))
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(title, total=1.0, text="")
        yield lambda fraction, text="": bar.update(task, completed=fraction, text=text)


def _warp(device: str = "cpu"):
    """Import Warp without its banner, and for the CPU without its warning that there is no GPU driver."""
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING  # no banner, no line for each kernel module
    if device == "cpu":
        sys.stderr.flush()
        saved, silent = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(silent, 2)  # the warning is written by native code
            wp.init()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            os.close(silent)
    wp.get_device(device)  # an unknown device is an error before any work


def _frames(text: str | None, count: int) -> range:
    """Read ``A:B`` as Python slices are read; one number N is ``0:N``."""
    if text is None:
        return range(count)
    try:
        numbers = [int(part) if part else None for part in text.split(":")]
    except ValueError:
        raise Usage(f"--frames must be A:B, as 0:48, got {text!r}") from None
    if len(numbers) > 2 or (len(numbers) == 1 and numbers[0] is None):
        raise Usage(f"--frames must be A:B, as 0:48, got {text!r}")
    first, last = (0, numbers[0]) if len(numbers) == 1 else (numbers[0] or 0, numbers[1])
    last = count if last is None else last
    if not 0 <= first < last:
        raise Usage(f"--frames must be A:B with 0 <= A < B, got {text!r}")
    return range(first, last)


def _size(text: str) -> tuple[int, int]:
    """Read ``WxH``."""
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and 0 < int(width) <= 16384 and 0 < int(height) <= 16384):
        raise Usage(f"--size must be WxH, as 1280x720, up to 16384, got {text!r}")
    return int(width), int(height)


def _assignments(pairs: list[str]) -> dict[str, Path]:
    """Read ``NAME=FILE`` pairs."""
    found = {}
    for pair in pairs:
        name, sign, file = pair.partition("=")
        if not (sign and name and file):
            raise Usage(f"--material must be NAME=FILE, as fox=bronze.neumat or '*=bronze.neumat', got {pair!r}")
        found[name] = Path(file)
    return found


@app.command()
def fit(
    source: Annotated[str, typer.Argument(help="FILE.npz:NAME, or analytic:ggx?roughness=0.2&f0=0.9,0.6,0.3")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Asset to write, ending in .neumat.")],
    model: Annotated[str, typer.Option(help="Kind of material: neubrdf.")] = "neubrdf",
    preset: Annotated[str | None, typer.Option(help="Length of the fit: quick, standard or fine.")] = None,
    steps: Annotated[int | None, typer.Option(help="Training steps; default: the preset's.")] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same file.")] = 0,
    resume: Annotated[bool, typer.Option(help="Go on where an interrupted fit of the same output stopped.")] = False,
    device: Device = "cpu",
):
    """Fit a material to a reflectance function."""
    # Threads of torch that spin while they wait cost a busy machine many times what they gain.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    _warp(device)
    from warp_neumat.training.fit import fit as run

    start = time.perf_counter()
    with _progress(f"fit {out.stem}") as progress:
        header = run(
            source,
            out,
            model=model,
            preset=preset,
            steps=steps,
            seed=seed,
            resume=resume,
            device=device,
            progress=progress,
        )
    shown = {k: v for k, v in header.get("metrics", {}).items() if isinstance(v, (int, float))}
    print(f"{out}: {', '.join(f'{k} {v:.4g}' for k, v in shown.items())} ({time.perf_counter() - start:.0f} s)")


@app.command("eval")
def evaluate(
    asset: Annotated[Path, typer.Argument(help="A .neumat file.")],
    against: Annotated[str, typer.Option(help="The source, as for fit.")],
    json_file: Annotated[str | None, typer.Option("--json", help="JSON to this file; - for standard output.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Write source, asset and ten times their difference on a sphere to this PNG.")
    ] = None,
    device: Device = "cpu",
):
    """Measure an asset against its source."""
    _warp(device)
    from warp_neumat.io.brdf import open_brdf
    from warp_neumat.materials import load
    from warp_neumat.training.evaluate import brdf_metrics, sphere_strip

    material, source = load(asset, device=device), open_brdf(against)
    record = {"kind": material.kind, "bytes": material.bytes, **brdf_metrics(source, material.brdf)}
    if picture is not None:
        from warp_neumat.io.image import write_png

        write_png(picture, sphere_strip(source.eval, material.brdf))
    _write_json(record, json_file)
    if json_file != "-":
        print(f"{asset}: " + ", ".join(f"{k} {v:.4g}" for k, v in record.items() if isinstance(v, (int, float))))


def _write_json(record: dict, target: str | None) -> None:
    """Write ``record`` to a file, whole or not at all, or with ``-`` to standard output."""
    import json

    from warp_neumat.io.atomic import replacing

    if target is None:
        return
    text = json.dumps(record, indent=1) + "\n"
    if target == "-":
        sys.stdout.write(text)
        return
    with replacing(Path(target)) as temporary:
        temporary.write_text(text, encoding="utf-8")


@app.command()
def info(
    asset: Annotated[Path, typer.Argument(help="A .neumat file.")],
    json_file: Annotated[
        str | None, typer.Option("--json", help="Write the header as JSON to this file; - for standard output.")
    ] = None,
):
    """Show what an asset holds."""
    from warp_neumat.io.asset import read_asset

    tensors, header = read_asset(asset)
    size = sum(t.nbytes for t in tensors.values())
    listed = {n: {"dtype": str(t.dtype), "shape": list(t.shape), "bytes": t.nbytes} for n, t in tensors.items()}
    _write_json({**header, "bytes": size, "tensors": listed}, json_file)
    if json_file is not None:
        return
    print(f"{asset}: {header['kind']} version {header['version']}, {size} bytes")
    for part in ("config", "source", "training", "metrics"):
        for key, value in header.get(part, {}).items():
            print(f"  {part}.{key}: {value:.6g}" if isinstance(value, float) else f"  {part}.{key}: {value}")
    for name, tensor in listed.items():
        print(f"  {name}: {tensor['dtype']} {tensor['shape']}, {tensor['bytes']} bytes")


def _shot(sequence, materials, out, *, frames, interval, atlas, lights, camera, size, reference, video, device, **more):
    """Set up a renderer, run the shot with progress bars, and say where everything is."""
    from warp_neumat.pipeline.renderer import Renderer
    from warp_neumat.pipeline.shot import prepare_folder, render_shot

    start = time.perf_counter()
    prepare_folder(out)
    sequence.frame(frames[-1])  # a frame that does not exist shows before the work
    with _progress("atlas") as progress:
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
    with _progress("render") as progress:
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
    picture, assigned = _size(size), _assignments(material)
    try:
        skip, behind = parse_skips(no_skip or []), parse_background(background)
        check_operator(tonemap, exposure)
    except ValueError as error:
        raise Usage(error) from None
    _warp(device)
    from warp_neumat.pipeline.sequence import MeshSequence

    with _progress("load") as progress:
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
        frames=_frames(frames, loaded.frame_count),
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
    picture = _size(size)
    _warp(device)
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


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a user's mistake ends in one line on stderr and exit code 1, a wrong option in 2."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments  # before or after the command
    try:
        code = app([a for a in arguments if a != "--debug"] if debug else arguments, standalone_mode=False)
        if code:
            sys.exit(code)
    except Exception as error:
        if debug:
            raise
        if hasattr(error, "format_message"):  # the parser's own: unknown command or option, missing argument
            if not arguments:
                return  # the help has been printed
            print(f"neumat: {' '.join(error.format_message().split())}; see neumat --help", file=sys.stderr)
            sys.exit(error.exit_code)
        text = " ".join(str(error).split()) or type(error).__name__
        print(f"neumat: {text}", file=sys.stderr)
        sys.exit(2 if isinstance(error, Usage) else 1)
    except KeyboardInterrupt:
        print("neumat: interrupted", file=sys.stderr)
        sys.exit(130)
