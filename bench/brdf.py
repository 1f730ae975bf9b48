"""NeuBRDF against analytic lobes and a small network: sphere error, raw error, energy, bytes and seconds; its grids.

Paper [neubrdf], Tables 1, 3 and 4 and Figure 8, on the functions that Sztrajman et al. fitted to the measured MERL and
RGL materials, or on any source of ``neumat fit``. ``python -m bench.brdf`` takes a choice (``--help``):

- ``table1``: grids over the hemisphere: ms to index ω_i and ω_o of a 1920×1080 frame (``_brdf_pixelations.py``).
- ``frame``: time to evaluate a 1920×1080 frame of a fitted material, beside the bare network, without grids, in Dr.Jit.
- ``table3``: every material × method, then the means; ``misses`` counts the materials beyond MAE 0.0017 or SSIM 0.996,
  the paper's means over all 100 MERL materials, which then follow by name where the method is ours.
- ``table4``: features as 9-bit indices, plain fp16 or 4 bits each, on the paper's grid; ``mse_raw_factor``,
  ``mse_log_factor`` and ``bytes_factor`` are to plain features, bytes without the decoder.
- ``figure8``: width of the network, grid, bits, width of the features, pixelation, corner weights and frame, one at a
  time.

**Protocol.** MAE, RMSE and SSIM are of a sphere of 256×256 pixels seen from the front, orthographic, under two
directional lights (``training/sphere.py``): a key light 45° off the view at irradiance π, so that a white Lambertian
surface facing it shows 1, and a fill light 54° off on the other side at 0.6. Pictures are clipped to [0, 1] and
sRGB-encoded. The NBRDF authors light their sphere by an environment map that cannot be shipped; values are therefore
comparable between the rows here, and with the paper in kind. ``mse_raw`` is over directions spaced as a MERL table is,
in 1/sr², and owes nearly all to the few brightest. ``albedo_max`` is the largest directional albedo.

``nbrdf`` is the very form of the functions in the files: there it could reach an error of 0, which no measurement would
allow it. Baselines are trained from samples like ours.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from ._brdf_lab import BASELINES, MATERIALS, OURS, SETS, TABLES, Choice, Lab

COLUMNS = [
    "table", "material", "method", "mae", "rmse", "ssim", "mse_raw", "mse_log", "albedo_max", "bytes", "seconds",
    "points", "ms", "peer_ms", "ratio", "misses",
]  # fmt: skip

GOAL = {"mae": 0.0017, "ssim": 0.996}
"""The paper's Table 3."""

STORAGES = {
    "plain features": {"storage": "raw"},
    "4 bit": {"storage": "4bit"},
    "codebook": {"storage": "codebook"},
}
"""Table 4: method → options of the fit beside those of the paper's grid."""

PAPER_GRID = {"nside": 64, "features": 16, "bits": 9}

AXES = {
    "width": [{"hidden": (n, n)} for n in (16, 32, 64, 128)],
    "grid": [{"nside": n} for n in (8, 16, 32, 64)],
    "bits": [{"bits": n} for n in (5, 7, 9, 11)],
    "features": [{"features": n} for n in (4, 8, 16, 32)],
    "pixelation": [{"pixelation": name} for name in ("healpix", "lonlat", "sukharev", "fibonacci")],
    "weights": [{"interpolation": name} for name in ("bilinear", "idw", "uniform")],
    "frame": [{"frame": name} for name in ("half-isotropic", "half", "isotropic", "absolute")],
}
"""Figure 8: axis → options, the others as the fit has them, but for a grid of nside 32 where it is not the axis."""


def misses(record: dict) -> bool:
    """Return whether a record misses one of :data:`GOAL`."""
    return not (record["mae"] <= GOAL["mae"] and (record.get("ssim") or 0.0) >= GOAL["ssim"])


def table1(lab: Lab):
    """Yield the grids."""
    from . import _brdf_pixelations

    choice = lab.choice
    return _brdf_pixelations.rows(device=lab.device, pixels=choice.pixels, rounds=choice.rounds, nside=choice.nside)


def frame(lab: Lab):
    """Yield the time of a frame of evaluations."""
    from . import _brdf_frame

    return _brdf_frame.rows(lab)


def table3(lab: Lab):
    """Yield every material × method, the means, and the materials on which ours miss the paper's means."""
    found: dict[str, dict[str, dict]] = {method: {} for method in lab.choice.methods}
    for material in lab.materials:
        for method in lab.choice.methods:
            found[method][material] = record = lab.measure(material, method)
            yield {"table": "table3", "material": material, "method": method, **record}
    for method, records in found.items():
        missed = [name for name, record in records.items() if misses(record)]
        row = {"table": "table3", "material": f"mean of {len(records)}", "method": method}
        yield {**row, **lab.mean(list(records.values())), "misses": len(missed), "missed": missed}
    for method in (m for m in found if m in OURS):
        for material, record in found[method].items():
            if misses(record):
                figures = {key: record[key] for key in ("mae", "ssim")}
                yield {"table": "missed", "material": material, "method": method, **figures}


def _framed(lab: Lab) -> dict:
    return {} if lab.choice.frame is None else {"frame": lab.choice.frame}


def table4(lab: Lab):
    """Yield the means of each kind of storage."""
    from warp_neumat.kernels.pixelations import PIXELATIONS
    from warp_neumat.models.feature_storage import feature_bytes

    points = PIXELATIONS["healpix"].points(PAPER_GRID["nside"])
    base = None
    for method, options in STORAGES.items():
        given = {**PAPER_GRID, **_framed(lab), **options}
        found = lab.mean([lab.measure(material, method, given) for material in lab.materials])
        kind = "vq" if options["storage"] == "codebook" else options["storage"]
        found["bytes"] = feature_bytes(points, PAPER_GRID["features"], kind, PAPER_GRID["bits"])
        base = base or found
        factors = {f"{name}_factor": found[name] / base[name] for name in ("mse_raw", "mse_log", "bytes")}
        material = f"mean of {len(lab.materials)}"
        yield {"table": "table4", "material": material, "method": method, "points": points, **found, **factors}


def figure8(lab: Lab):
    """Yield the means along each axis."""
    for axis, values in AXES.items():
        for options in values:
            given = {"nside": 32, **_framed(lab), **options}
            shown = ",".join(str(v) for v in options.values()).strip("()").replace(", ", "x")
            found = lab.mean([lab.measure(material, f"{axis} {shown}", given) for material in lab.materials])
            material = f"mean of {len(lab.materials)}"
            yield {"table": "figure8", "material": material, "method": f"{axis} {shown}", "axis": axis, **found}


def picture(lab: Lab) -> None:
    """Draw the contact sheet of the last of our methods that was chosen."""
    from ._brdf_picture import draw

    ours = [method for method in lab.choice.methods if method in OURS]
    if not ours:
        raise ValueError("picture needs one of our methods: add absolute or half-isotropic to --methods")
    errors = {}
    for material in lab.materials:
        errors[material] = lab.measure(material, ours[-1])["mae"]
        if "ggx" in lab.choice.methods:
            lab.measure(material, "ggx")
    draw(lab.choice.picture, lab.spheres, ours[-1], errors)


QUICK = {
    "only": ("table1", "frame", "table3"),
    "materials": ("analytic:ggx?roughness=0.4&diffuse=0.2",),
    "methods": ("ggx", "half-isotropic"),
    "steps": 20,
    "baseline_steps": 30,
    "size": 64,
    "pixels": 1 << 15,
    "rounds": 3,
    "nside": 16,
}
"""What ``--quick`` chooses."""


def rows(*, device: str, quick: bool, **choices):
    """Yield the rows of the chosen tables; ``choices`` are fields of :class:`Choice`."""
    lab = Lab(Choice(**({**QUICK, **choices} if quick else choices)), device)
    for table in TABLES:
        if table in lab.choice.only:
            yield from globals()[table](lab)
    if lab.choice.picture is not None:
        picture(lab)


def main(arguments: list[str] | None = None) -> int:
    """Run chosen tables: the command line of ``python -m bench.brdf``."""
    from rich.console import Console

    from bench.__main__ import run
    from warp_neumat.io.atomic import check_writable

    def names(text):
        return tuple(text.split(","))

    parser = argparse.ArgumentParser(prog="python -m bench.brdf", description=__doc__.splitlines()[0])
    parser.add_argument("--only", type=names, default=TABLES, help=f"tables, of {','.join(TABLES)}")
    parser.add_argument("--set", default="merl80", help=f"of {', '.join(SETS)}")
    parser.add_argument(
        "--materials",
        type=names,
        default=(),
        help="names in the set, or all, or specifications as KIND:…, their commas as %%2C (default: "
        f"{','.join(MATERIALS['merl80'])})",
    )
    parser.add_argument("--methods", type=names, default=Choice.methods, help=f"of {','.join((*BASELINES, *OURS))}")
    parser.add_argument("--steps", type=int, help="of each of our fits; default: the fit's own")
    parser.add_argument("--baseline-steps", type=int, help="of each baseline; default: its own")
    parser.add_argument("--frame", help="of table4 and figure8; default: the fit's own")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache", type=Path, metavar="FILE", help="JSON lines of what was measured; used again")
    parser.add_argument(
        "--picture", type=Path, metavar="FILE.png", help="draw the spheres (fits what the cache only tells of)"
    )
    parser.add_argument("--quick", action="store_true", help="small sizes and few rounds, to see that it runs")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--device", default="cpu")
    # Threads of torch that spin while they wait cost a busy machine many times what they gain.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    defaults = vars(parser.parse_args([]))
    chosen = vars(parser.parse_args(arguments))
    quick, file, device = chosen.pop("quick"), chosen.pop("json"), chosen.pop("device")
    if quick:  # only what was asked for replaces the quick choice
        chosen = {name: value for name, value in chosen.items() if value != defaults[name]}
    import warp

    warp.config.log_level = warp.LOG_WARNING
    try:
        for path in (file, chosen.get("picture"), chosen.get("cache")):
            if path is not None:
                check_writable(path)
        document = run("brdf", rows(device=device, quick=quick, **chosen), COLUMNS, Console(highlight=False))
    except (ValueError, TypeError, OSError, ImportError) as error:
        print(f"bench: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        kept = f"; {chosen['cache']} holds what was measured" if chosen.get("cache") else ""
        print(f"bench: stopped{kept}", file=sys.stderr)
        return 130
    if file:
        file.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
