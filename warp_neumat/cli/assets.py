"""``neumat fit``, ``eval``, ``info``, ``decode``, ``export``: what is done to and with an asset."""

import os
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from warp_neumat.cli.common import Device, Out, Usage, app, progress_bar, start_warp, write_json
from warp_neumat.cli.describe import describe
from warp_neumat.cli.values import (
    one_of,
    parse_crop,
    parse_features,
    parse_options,
    parse_overrides,
    parse_set_size,
    parse_size,
)

Asset = Annotated[Path, typer.Argument(help="A .neumat file.")]

_OWN = ("model", "preset", "features", "bytes", "steps", "seed", "resume", "size", "crop", "overrides", "device")


@app.command()
def fit(
    source: Annotated[
        str,
        typer.Argument(
            help="A folder of PBR maps or its .json manifest (model bcf); a MERL .binary, an RGL .bsdf, a .csv of "
            "samples, FILE.npz:NAME, analytic:ggx?roughness=0.2&f0=0.9,0.6,0.3, analytic:layered?… or "
            "svbrdf:FOLDER, PBR maps as a reflectance (model neubrdf). "
            "With --shared also FILE.npz, FILE.npz:'gold*', or a folder of measured files."
        ),
    ],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Asset to write, ending in .neumat.")] = None,
    model: Annotated[
        str | None, typer.Option(help="Kind of material: bcf or neubrdf; default: the one that SOURCE is for.")
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            help="Sizes of the feature textures of a bcf: 0.5k, 1k (default), 2k or 2k++, from small to close; or the "
            "length of the fit: quick, standard or fine."
        ),
    ] = None,
    features: Annotated[
        str | None,
        typer.Option(
            help="bcf: longer sides of the feature textures instead of a preset, as 256,128,64,32 [texel]; neubrdf: "
            "width of a primitive, as 16."
        ),
    ] = None,
    budget: Annotated[
        int | None, typer.Option("--bytes", min=1, help="Sizes of the feature textures by what they may take [byte].")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Training steps; default: the model's and the preset's.")] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same file.")] = 0,
    resume: Annotated[bool, typer.Option(help="Go on where an interrupted fit of the same output stopped.")] = False,
    size: Annotated[
        str | None, typer.Option(help="Fit to the maps at this size: WxH, or the longer side; default: the largest's.")
    ] = None,
    crop: Annotated[str | None, typer.Option(help="Fit to a part of the maps: X,Y,W,H, as 0,0,512,512 [px].")] = None,
    override: Annotated[
        list[str] | None,
        typer.Option(
            help="What file names do not say, repeatable: normal.orientation=dx, roughness.file=x.png, "
            "roughness.channel=g, height.replace_nan=0, metallic=0 (a constant), mask=none (left out)."
        ),
    ] = None,
    shared: Annotated[
        Path | None,
        typer.Option(
            help="neubrdf: fit all materials of SOURCE into this folder, in groups that share primitives and decoder; "
            "where it holds groups, the materials join them and nothing else is touched."
        ),
    ] = None,
    groups: Annotated[
        int | None, typer.Option(min=1, help="With --shared: groups; default: one for about eight materials.")
    ] = None,
    reciprocal: Annotated[
        bool, typer.Option("--reciprocal", help="neubrdf: light and viewer can be swapped, exactly.")
    ] = False,
    option: Annotated[
        list[str] | None,
        typer.Option(
            help="Any other setting of the model or of its training, repeatable: wrap=clamp, modes=single, "
            "batch=65536, nside=64, bits=9, hidden=64,64, frame=absolute, interpolation=uniform."
        ),
    ] = None,
    device: Device = "cpu",
):
    """Fit a material to PBR maps or a reflectance function.

    \b
    neumat fit bricks/ -o bricks.neumat --preset 1k
    neumat fit bricks/ -o bricks.neumat --crop 0,0,512,512 --override normal.orientation=dx
    neumat fit FILE.npz:alum-bronze -o bronze.neumat
    neumat fit FILE.npz --shared metals/
    """
    if (out is None) == (shared is None):
        raise Usage("give either -o FILE.neumat, or --shared DIR for many materials")
    if out is not None and out.suffix.lower() != ".neumat":
        raise Usage(f"-o must end in .neumat, got {str(out)!r}")
    if groups is not None and shared is None:
        raise Usage("--groups is for --shared")
    config = parse_options(option or [], _OWN)
    for name, stored in (("storage", "codebook"), ("pixelation", "healpix")):
        if config.get(name, stored) != stored:
            raise Usage(f"--option {name}={config[name]} is for comparison and has no file; see python -m bench.brdf")
    if reciprocal:
        config["reciprocal"] = True
    opening = {
        "size": None if size is None else parse_set_size(size),
        "crop": None if crop is None else parse_crop(crop),
        "overrides": parse_overrides(override or []) or None,
        "features": None if features is None else parse_features(features),
        "bytes": budget,
    }
    config |= {name: value for name, value in opening.items() if value is not None}
    # Threads of torch that spin while they wait cost a busy machine many times what they gain.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    start_warp(device)
    from warp_neumat.models import REGISTRY
    from warp_neumat.training import fit as training

    if shared is not None:
        model = "neubrdf" if model is None else one_of("--model", model, ["neubrdf"])
    model = training.default_model(source) if model is None else one_of("--model", model, REGISTRY)
    if reciprocal and model != "neubrdf":
        raise Usage(f"--reciprocal is for model neubrdf, not {model}")
    if preset is not None:
        one_of("--preset", preset, training.presets(model))
    if model == "neubrdf" and features is not None and len(config["features"]) == 1:
        config["features"], opening["features"] = config["features"][0], None  # the width of a primitive
    textured = model == "neubrdf" and source.startswith("svbrdf:")
    for name in opening if model != "bcf" else ():
        if textured and name in ("size", "crop", "overrides"):
            continue
        if opening[name] is not None:
            raise Usage(f"--{name.removesuffix('s') if name == 'overrides' else name} is for model bcf, not {model}")

    start = time.perf_counter()
    if shared is not None:
        _fit_shared(source, shared, groups, preset, steps, seed, resume, device, config)
        print(f"{shared}: {time.perf_counter() - start:.0f} s")
        return
    with progress_bar(f"fit {out.stem}") as progress:
        header = training.fit(
            source,
            out,
            model=model,
            preset=preset,
            steps=steps,
            seed=seed,
            resume=resume,
            device=device,
            progress=progress,
            announce=lambda text: print(text, flush=True),
            **config,
        )
    print(f"{out}: {_figures(header.get('metrics', {}))} ({time.perf_counter() - start:.0f} s)")


def _fit_shared(source, folder: Path, groups, preset, steps, seed, resume, device, config) -> None:
    from warp_neumat.io.brdf_set import open_brdfs
    from warp_neumat.training.fit import PRESETS
    from warp_neumat.training.sharing import fit_shared

    with progress_bar(f"fit {folder.name}") as progress:
        headers = fit_shared(
            open_brdfs(source),
            folder,
            count=groups,
            steps=steps,
            length=PRESETS[preset or "standard"],
            seed=seed,
            device=device,
            resume=resume,
            progress=progress,
            announce=lambda text: print(text, flush=True),
            **config,
        )
    for name, header in headers.items():
        print(f"{folder / name}.neumat: {header['group']['file']}, {_figures(header['metrics'])}")


def _figures(record: dict) -> str:
    numbers = {k: v for k, v in record.items() if isinstance(v, (int, float))}
    return ", ".join(f"{k} {v}" if isinstance(v, int) else f"{k} {v:.4g}" for k, v in numbers.items())


@app.command("eval")
def evaluate(
    asset: Asset,
    against: Annotated[str, typer.Option(help="The source, as for fit; a bcf remembers its size, crop and overrides.")],
    json_file: Annotated[str | None, typer.Option("--json", help="JSON to this file; - for standard output.")] = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            help="Write source, asset and ten times their difference side by side to this PNG, then for a bcf with "
            "baselines BC at half resolution and its difference; a row a map."
        ),
    ] = None,
    baselines: Annotated[
        str | None,
        typer.Option(
            help="bcf: what to compare with, of bc_full, bc_half, bc7_full, bc7_half, astc12, astc12_half, with commas "
            "between them; default: all but the last."
        ),
    ] = None,
    no_baselines: Annotated[bool, typer.Option("--no-baselines", help="bcf: this file alone, which is quick.")] = False,
    device: Device = "cpu",
):
    """Measure an asset against its source.

    \b
    neumat eval bricks.neumat --against bricks/ --json bricks.json
    neumat eval bronze.neumat --against FILE.npz:alum-bronze --picture sphere.png
    """
    if no_baselines and baselines:
        raise Usage("--baselines and --no-baselines: give one of them")
    if picture is not None and picture.suffix.lower() != ".png":
        raise Usage(f"--picture must end in .png, got {str(picture)!r}")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    start_warp(device)
    from warp_neumat.materials import load

    material = load(asset, device=device)
    if material.kind == "bcf":
        names = False if no_baselines else True if baselines is None else [b.strip() for b in baselines.split(",")]
        record, text = _evaluate_maps(material, against, names, picture)
    elif baselines or no_baselines:
        raise Usage(f"--baselines are for a bcf; {asset} is of kind {material.kind}")
    else:
        record, text = _evaluate_brdf(material, against, picture)
    write_json(record, json_file)
    if json_file != "-":
        print(f"{asset}: {_figures(record)}")
        if text:
            print(text)


def _evaluate_brdf(material, against: str, picture: Path | None) -> tuple[dict, str]:
    from warp_neumat.io.svbrdf import PREFIX, is_spatial
    from warp_neumat.training import spatial
    from warp_neumat.training.evaluate import brdf_metrics, sphere_strip
    from warp_neumat.training.fit import BRDFData
    from warp_neumat.training.plane import plane_strip

    opening = material.header.get("source", {}).get("opening", {}) if against.startswith(PREFIX) else {}
    source = BRDFData.open(against, **{k: opening[k] for k in BRDFData.OPTIONS if k in opening})
    varies = is_spatial(source)
    if material.textured and not varies:
        raise Usage(f"{material.name} varies over a surface; --against must be {PREFIX}FOLDER, got {against!r}")
    evaluate = spatial.material_on_source_levels(source, material) if varies else material.brdf
    record = {"kind": material.kind, "bytes": material.bytes, **brdf_metrics(source, evaluate)}
    if (own := material.header.get("own_bytes")) is not None:
        sharers = material.header.get("metrics", {}).get("sharers")
        record |= {"bytes_own": own, "bytes_shared": material.bytes - own, "sharers": sharers}
    if varies:
        record["bits_per_texel"] = spatial.bits_per_texel(source, material.bytes)
    if picture is not None:
        from warp_neumat.io.image import write_png

        write_png(picture, plane_strip(source, evaluate) if varies else sphere_strip(source.eval, evaluate))
    return record, "\n".join(
        f"level {mip['lod']}: {_figures({k: v for k, v in mip.items() if k != 'lod'})}"
        for mip in record.get("mips", ())
    )


def _evaluate_maps(material, against: str, baselines, picture: Path | None) -> tuple[dict, str]:
    from warp_neumat.io.texture_set import open_texture_set
    from warp_neumat.training.baselines import METHODS
    from warp_neumat.training.evaluate_maps import contact_sheet, eval_record, format_table

    for name in baselines if isinstance(baselines, list) else ():
        one_of("--baselines", name, METHODS)
    opening = material.header.get("source", {}).get("opening", {})
    source = open_texture_set(against, **{k: opening[k] for k in ("size", "crop", "overrides") if k in opening})
    with progress_bar(f"eval {material.name}") as progress:
        try:
            record = eval_record(source, material, baselines, progress=progress)
        except ImportError as error:
            if baselines is not True:
                raise
            print(f"note: no baselines: {error}", file=sys.stderr)
            record = eval_record(source, material, False, progress=progress)
    if picture is not None:
        from warp_neumat.io.image import write_png

        beside = "bc_half" if "bc_half" in record["baselines"] else None
        write_png(picture, contact_sheet(source, material, baseline=beside))
    return record, format_table(record)


@app.command()
def info(
    asset: Asset,
    json_file: Annotated[
        str | None, typer.Option("--json", help="Write the header as JSON to this file; - for standard output.")
    ] = None,
):
    """Show what an asset holds."""
    from warp_neumat.io.asset import read_asset

    tensors, header = read_asset(asset)
    size = sum(t.nbytes for t in tensors.values())
    listed = {n: {"dtype": str(t.dtype), "shape": list(t.shape), "bytes": t.nbytes} for n, t in tensors.items()}
    write_json({**header, "bytes": size, "tensors": listed}, json_file)
    if json_file is None:
        print(f"{asset}: {header['kind']} version {header['version']}, {size} bytes")
        print("\n".join(describe(header, listed)))


@app.command()
def decode(
    asset: Asset,
    out: Out,
    size: Annotated[
        str | None, typer.Option(help="Size of the pictures, WxH [px]; default: that of the level.")
    ] = None,
    lod: Annotated[
        float | None,
        typer.Option(min=0, max=32, help="Mip level, 0 = finest, continuous; default: that which fits the size."),
    ] = None,
    bits: Annotated[int, typer.Option(help="Bits of a channel in PNG: 8 or 16.")] = 8,
    device: Device = "cpu",
):
    """Turn a bcf back into PNG and EXR maps.

    \b
    neumat decode bricks.neumat -o maps/ --size 1024x1024
    """
    picture = None if size is None else parse_size(size)
    if bits not in (8, 16):
        raise Usage(f"--bits must be 8 or 16, got {bits}")
    start_warp(device)
    from warp_neumat.materials import load
    from warp_neumat.pipeline.decode_maps import write_maps

    for path in write_maps(out, load(asset, device=device), picture, lod, bits=bits):
        print(path)


@app.command()
def export(
    asset: Asset,
    out: Out,
    format: Annotated[str, typer.Option(help="Container of the textures: dds or ktx2.")] = "dds",
    shader: Annotated[
        list[str] | None,
        typer.Option(
            help="Language of the decoder source: glsl, hlsl or wgsl, repeatable; none: no source. Default: all."
        ),
    ] = None,
):
    """Write a bcf as an engine reads it.

    BC6H textures with mips, the network in float16, a manifest with a golden vector, and decoder source.

    \b
    neumat export bricks.neumat -o engine/ --format ktx2 --shader wgsl
    """
    start_warp()
    from warp_neumat.export.bcf import CONTAINERS, export_bcf
    from warp_neumat.export.languages import LANGUAGES

    one_of("--format", format, CONTAINERS)
    wanted = list(LANGUAGES) if not shader else [one_of("--shader", s, [*LANGUAGES, "none"]) for s in shader]
    if "none" in wanted and len(wanted) > 1:
        raise Usage("--shader none stands alone")
    for path in export_bcf(asset, out, format=format, shaders=[s for s in wanted if s != "none"]):
        print(path)
