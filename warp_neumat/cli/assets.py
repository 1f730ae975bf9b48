"""``neumat fit``, ``eval``, ``info``, ``decode``, ``export``: what is done to and with an asset."""

import os
import time
from pathlib import Path
from typing import Annotated

import typer

from warp_neumat.cli.common import Device, Out, Usage, app, progress_bar, start_warp, write_json
from warp_neumat.cli.describe import describe
from warp_neumat.cli.measure import figures, measure_brdf, measure_btf, measure_maps
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

_OWN = (
    "model",
    "mode",
    "preset",
    "features",
    "bytes",
    "steps",
    "seed",
    "resume",
    "size",
    "crop",
    "overrides",
    "device",
)

_MAPS = ("bcf", "ntbc")
"""Kinds that are sets of maps."""


@app.command()
def fit(
    source: Annotated[
        str,
        typer.Argument(
            help="A folder of PBR maps or its .json manifest (models bcf, ntbc); a MERL .binary, an RGL .bsdf, a .csv "
            "of samples, FILE.npz:NAME, analytic:ggx?roughness=0.2&f0=0.9,0.6,0.3, analytic:layered?… or "
            "svbrdf:FOLDER, PBR maps as a reflectance (model neubrdf); a UBO2014 .btf, a UBO2003 .zip or its folder, "
            "or simulated microgeometry:PATTERN?size=128&seed=0 with pattern weave, leather, carpet, wood or stone "
            "(model btf). "
            "With --shared also FILE.npz, FILE.npz:'gold*', or a folder of measured files."
        ),
    ],
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Asset to write, ending in .neumat.")] = None,
    model: Annotated[
        str | None,
        typer.Option(
            help="Kind of material: bcf, ntbc, neubrdf or btf; default: the one that SOURCE is for, bcf for maps."
        ),
    ] = None,
    mode: Annotated[
        str | None,
        typer.Option(
            help="ntbc: conservative, a model for colours and one for single channels, or aggressive, one for all."
        ),
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
            "width of a primitive, as 16; btf: how features are stored, half or bc6h."
        ),
    ] = None,
    budget: Annotated[
        int | None,
        typer.Option("--bytes", min=1, help="Sizes of the feature textures, or of an ntbc's grids, by bytes to spend."),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(help="Training steps (ntbc: of each network pair); default: the model's and the preset's."),
    ] = None,
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
            "batch=65536, nside=64, bits=9, hidden=64,64, frame=absolute, interpolation=uniform; btf: variant=neumip, "
            "teacher=none, teacher=FILE.neumat, mips=1, schedule=plateau; ntbc: rate=0.45, variant=naive, normals=bc1, "
            "colours=bc7, metric=luma, endpoints=fitted."
        ),
    ] = None,
    device: Device = "cpu",
):
    """Fit a material to PBR maps, a reflectance function or a bidirectional texture function.

    \b
    neumat fit bricks/ -o bricks.neumat --preset 1k
    neumat fit bricks/ -o bricks.neumat --crop 0,0,512,512 --override normal.orientation=dx
    neumat fit bricks/ -o bricks.neumat --model ntbc --mode aggressive
    neumat fit FILE.npz:alum-bronze -o bronze.neumat
    neumat fit FILE.npz --shared metals/
    neumat fit 'microgeometry:weave?size=128' -o weave.neumat
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
        "bytes": budget,
    }
    config |= {name: value for name, value in opening.items() if value is not None}
    # Threads of torch that spin while they wait cost a busy machine many times what they gain.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    start_warp(device)
    from warp_neumat.models import REGISTRY
    from warp_neumat.simulation.open_btf import is_btf_spec
    from warp_neumat.training import fit as training

    if shared is not None:
        model = "neubrdf" if model is None else one_of("--model", model, ["neubrdf"])
    model = training.default_model(source) if model is None else one_of("--model", model, REGISTRY)
    if reciprocal and model != "neubrdf":
        raise Usage(f"--reciprocal is for model neubrdf, not {model}")
    if mode is not None:
        if model != "ntbc":
            raise Usage(f"--mode is for model ntbc, not {model}")
        config["mode"] = one_of("--mode", mode, ("conservative", "aggressive"))
    if preset is not None:
        one_of("--preset", preset, training.presets(model))
    if is_btf_spec(source) and model != "btf":
        raise Usage(f"{source} is a bidirectional texture function, which is for model btf, not {model}")
    if features is not None:
        config["features"] = _features(features, model)
    if model == "btf" and (named := {"width", "height"} & set(config)):
        raise Usage(f"--option {min(named)}: a btf has the size of its source, as microgeometry:weave?size=64")
    textured = model == "neubrdf" and source.startswith("svbrdf:")
    for name in opening if model not in _MAPS else ():
        if textured and name in ("size", "crop", "overrides"):
            continue
        if opening[name] is not None:
            written = name.removesuffix("s") if name == "overrides" else name
            raise Usage(f"--{written} is for model {' or '.join(_MAPS)}, not {model}")

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
    print(f"{out}: {figures(header.get('metrics', {}))} ({time.perf_counter() - start:.0f} s)")


def _features(text: str, model: str):
    """Return what ``--features`` stands for: sides, the width of a primitive, or a way to store them."""
    if model == "ntbc":
        raise Usage("--features is for models bcf, neubrdf and btf; sizes of an ntbc follow from --bytes")
    if model == "btf":
        return one_of("--features", text, ("half", "bc6h"))
    numbers = parse_features(text)
    if model == "neubrdf" and len(numbers) > 1:
        raise Usage(f"--features must be one width of a primitive for model neubrdf, as 16, got {text!r}")
    return numbers[0] if model == "neubrdf" else numbers


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
        print(f"{folder / name}.neumat: {header['group']['file']}, {figures(header['metrics'])}")


@app.command("eval")
def evaluate(
    asset: Asset,
    against: Annotated[str, typer.Option(help="The source, as for fit; maps remember their size, crop and overrides.")],
    json_file: Annotated[str | None, typer.Option("--json", help="JSON to this file; - for standard output.")] = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            help="Write source, asset and ten times their difference side by side to this PNG, then for maps with "
            "baselines BC at half resolution and its difference, a row a map; of a btf, a column for each of six "
            "slices, and below them the apparent BRDF of the central texel."
        ),
    ] = None,
    baselines: Annotated[
        str | None,
        typer.Option(
            help="bcf, ntbc: what to compare with, of bc_same (ntbc: the formats that it writes), bc_full, bc_half, "
            "bc7_full, bc7_half, astc12, astc12_half, with commas between them; default: all but the last."
        ),
    ] = None,
    no_baselines: Annotated[
        bool, typer.Option("--no-baselines", help="bcf, ntbc: this file alone, which is quick.")
    ] = False,
    device: Device = "cpu",
):
    """Measure an asset against its source.

    \b
    neumat eval bricks.neumat --against bricks/ --json bricks.json
    neumat eval bronze.neumat --against FILE.npz:alum-bronze --picture sphere.png
    neumat eval weave.neumat --against 'microgeometry:weave?size=128' --picture weave.png
    """
    if no_baselines and baselines:
        raise Usage("--baselines and --no-baselines: give one of them")
    if picture is not None and picture.suffix.lower() != ".png":
        raise Usage(f"--picture must end in .png, got {str(picture)!r}")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    start_warp(device)
    from warp_neumat.materials import load
    from warp_neumat.simulation.open_btf import is_btf_spec

    material = load(asset, device=device)
    if is_btf_spec(against) and material.kind != "btf":
        raise Usage(f"{against} is a bidirectional texture function, and {asset} is of kind {material.kind}")
    if material.kind in _MAPS:
        names = False if no_baselines else True if baselines is None else [b.strip() for b in baselines.split(",")]
        record, text = measure_maps(material, against, names, picture)
    elif baselines or no_baselines:
        raise Usage(f"--baselines are for a bcf or ntbc; {asset} is of kind {material.kind}")
    else:
        measure = measure_btf if material.kind == "btf" else measure_brdf
        record, text = measure(material, against, picture)
    write_json(record, json_file)
    if json_file != "-":
        print(f"{asset}: {figures(record)}")
        if text:
            print(text)


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
    """Turn a bcf or ntbc back into PNG and EXR maps.

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
            help="bcf: language of the decoder source, glsl, hlsl or wgsl, repeatable; none: no source. Default: all."
        ),
    ] = None,
):
    """Write a bcf or ntbc as an engine reads it.

    Of a bcf: BC6H textures with mips, the network in float16, a manifest with a golden vector, and decoder source. Of
    an ntbc: the BC1 to BC7 textures with mips that it stands for, which need no decoder, and a manifest.

    \b
    neumat export bricks.neumat -o engine/ --format ktx2 --shader wgsl
    """
    start_warp()
    from warp_neumat.export.bcf import export_bcf
    from warp_neumat.export.files import CONTAINERS
    from warp_neumat.export.languages import LANGUAGES
    from warp_neumat.io.asset import read_asset

    one_of("--format", format, CONTAINERS)
    wanted = list(LANGUAGES) if not shader else [one_of("--shader", s, [*LANGUAGES, "none"]) for s in shader]
    if "none" in wanted and len(wanted) > 1:
        raise Usage("--shader none stands alone")
    if read_asset(asset)[1]["kind"] == "ntbc":
        if shader and wanted != ["none"]:
            raise Usage(f"--shader is for a bcf; {asset} is an ntbc, whose textures need no decoder")
        from warp_neumat.export.ntbc import export_ntbc

        paths = export_ntbc(asset, out, format=format)
    else:
        paths = export_bcf(asset, out, format=format, shaders=[s for s in wanted if s != "none"])
    for path in paths:
        print(path)
