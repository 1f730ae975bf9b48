"""What ``neumat eval`` measures, by kind of asset: each returns (record for JSON, more text for people)."""

import sys
from pathlib import Path

from warp_neumat.cli.common import Usage, progress_bar
from warp_neumat.cli.values import one_of


def figures(record: dict) -> str:
    """Return the numbers of ``record`` as one line."""
    numbers = {k: v for k, v in record.items() if isinstance(v, (int, float))}
    return ", ".join(f"{k} {v}" if isinstance(v, int) else f"{k} {v:.4g}" for k, v in numbers.items())


def measure_brdf(material, against: str, picture: Path | None) -> tuple[dict, str]:
    """Measure a reflectance, one that varies over a surface or not."""
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
        f"level {mip['lod']}: {figures({k: v for k, v in mip.items() if k != 'lod'})}" for mip in record.get("mips", ())
    )


def measure_maps(material, against: str, baselines, picture: Path | None) -> tuple[dict, str]:
    """Measure a set of maps, and ``baselines`` (names; True = all that can be had; False) beside it."""
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


def measure_btf(material, against: str, picture: Path | None) -> tuple[dict, str]:
    """Measure a BTF under the directions of its source."""
    from warp_neumat.simulation.open_btf import open_btf
    from warp_neumat.training.btf import btf_metrics

    source, config = open_btf(against), material.config
    sizes = f"{source.width}×{source.height}", f"{config['width']}×{config['height']}"
    if sizes[0] != sizes[1]:
        raise ValueError(f"{against}: has {sizes[0]} texels, and {material.name} was fitted to {sizes[1]}")
    with progress_bar(f"eval {material.name}"):
        record = {"kind": material.kind, "bytes": material.bytes, "weights": material.weights}
        record |= btf_metrics(source, material)
        if picture is not None:
            from warp_neumat.io.image import write_png
            from warp_neumat.training.btf_sheet import btf_sheet

            write_png(picture, btf_sheet(source, material))
    return record, "\n".join(f"level {m}: l1 {error:.4g}" for m, error in enumerate(record.get("levels", ())))
