"""How close a fitted material is to its maps, per map and mip, beside block compression of the maps themselves.

Paper [bcf], Sec. 6.1 and 6.2: every mip of the reference is compared at its own texel centres. PSNR is that of the
squared error averaged over mips, each counting the same, and over the trained channels, in the encoded domain that the
loss sees (sRGB values, x and y of normals as 0.5 + 0.5 n, constants not counted); beside it ``psnr_texels`` counts each
texel of all mips the same, and ``psnr_mip0`` the finest mip alone. (Table 2 of the paper looks like texels rather than
mips: BC at full and half resolution differ in one mip of twelve, and 36.16 against 28.49 dB would put that one at
18.5 dB.) SSIM and FLIP are means over mips and maps; FLIP sees one-channel maps as grey and normals as the usual bluish
picture, SSIM skips mips below 11 px. The error of normals is also given as an angle, z made from x and y. A figure that
does not exist (the PSNR of no error, the SSIM of a tiny mip) is ``None``.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from warp_neumat import metrics
from warp_neumat.io.mipmaps import unit_normals
from warp_neumat.training.baselines import METHODS, THOROUGH, Baseline

_CHUNK = 1 << 18  # samples that are evaluated at a time: 2K maps are never in memory as coordinates

BASELINES = ("bc_full", "bc_half", "bc7_full", "bc7_half", "astc12")
"""What :func:`eval_record` compares with."""

BASELINES_OF_BLOCKS = ("bc_same", "bc_full", "bc_half", "bc7_half", "astc12")
"""The same for a material that writes BC textures itself."""

_COLUMN = 17  # characters of a method in the table: six fit into 120

_TITLES = {
    "this": "this file",
    "bc_same": "BC, same",
    "bc_full": "BC full",
    "bc_half": "BC half",
    "bc7_full": "BC7 full",
    "bc7_half": "BC7 half",
    "astc12": "ASTC 12x12",
    "astc12_half": "ASTC half",
}


@dataclasses.dataclass(frozen=True)
class MapChannels:
    """One map of a set: its name, the numbers of its channels, their encoding and range."""

    name: str
    indices: tuple[int, ...]
    encoding: str
    ranges: tuple[tuple[float, float], ...]

    def normals(self, encoded: np.ndarray) -> np.ndarray:
        """Return unit normals (..., 3) of encoded x and y (..., 2)."""
        low, high = np.asarray(self.ranges, np.float32).T
        return unit_normals(low + (high - low) * encoded)

    def picture(self, encoded: np.ndarray) -> np.ndarray:
        """Return the map as an eye looks at it, (h, w, 3) in [0, 1]."""
        return metrics.colour_picture(0.5 + 0.5 * self.normals(encoded) if self.encoding == "normal" else encoded)


def map_channels(channels) -> list[MapChannels]:
    """Return the maps of ``channels`` (each with map, component, encoding and range), in order."""
    indices: dict[str, list[int]] = {}
    for index, channel in enumerate(channels):
        indices.setdefault(channel.map, []).append(index)
    return [
        MapChannels(name, tuple(own), channels[own[0]].encoding, tuple((*map(float, channels[k].range),) for k in own))
        for name, own in indices.items()
    ]


def sample_grid(encoded_fn, height: int, width: int, channels: int, lod: float) -> np.ndarray:
    """Return ``encoded_fn(uv, lod)`` at the texel centres of a grid, (height, width, channels) float32."""
    result = np.empty((height, width, channels), np.float32)
    u = ((np.arange(width) + 0.5) / width).astype(np.float32)
    rows = max(1, _CHUNK // width)
    for top in range(0, height, rows):
        v = ((np.arange(top, min(top + rows, height)) + 0.5) / height).astype(np.float32)
        uv = np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1).reshape(-1, 2)
        values = np.asarray(encoded_fn(np.ascontiguousarray(uv), lod), np.float32)
        if values.shape != (len(uv), channels):
            raise ValueError(f"encoded_fn must return shape ({len(uv)}, {channels}), got {values.shape}")
        result[top : top + rows] = values.reshape(-1, width, channels)
    return result


def compare(channels, mips, levels, *, progress=None) -> dict:
    """Return how far ``levels`` are from ``mips``: ``psnr, psnr_texels, psnr_mip0, ssim, flip, mips`` and ``maps``.

    Args:
        channels: The set's channels.
        mips: Reference from the finest mip on, each (h, w, C) float32 in [0, 1], encoded.
        levels: What to judge, one picture of the same shape for each mip; read once, so it may be a generator.
        progress: ``progress(fraction, text)``, where the fraction counts texels.
    """
    maps = map_channels(channels)
    errors, rows = [], {each.name: [] for each in maps}
    texels = sum(mip.shape[0] * mip.shape[1] for mip in mips)
    done = 0
    for reference, level in zip(mips, levels, strict=True):
        error = metrics.channel_mse(reference, level)
        errors.append(error)
        for each in maps:
            ours, theirs = (np.ascontiguousarray(x[..., each.indices]) for x in (reference, level))
            row = {
                "width": reference.shape[1],
                "height": reference.shape[0],
                "psnr": metrics.psnr_of_mse(error[list(each.indices)]),
                "ssim": metrics.map_ssim(ours, theirs),
                "flip": metrics.map_flip(each.picture(ours), each.picture(theirs)),
            }
            if each.encoding == "normal":
                mean, high = metrics.angular_error(each.normals(ours), each.normals(theirs))
                row["angle"] = {"mean": mean, "p95": high}
            rows[each.name].append(row)
        done += reference.shape[0] * reference.shape[1]
        if progress:
            progress(done / texels, f"{reference.shape[1]}x{reference.shape[0]}")
    counts = np.array([mip.shape[0] * mip.shape[1] for mip in mips])
    record = {
        "psnr": metrics.psnr_of_mse(errors),
        "psnr_texels": metrics.psnr_of_mse(counts @ np.array(errors) / counts.sum()),
        "psnr_mip0": metrics.psnr_of_mse(errors[0]),
    }
    entries = {each.name: _map_entry(each, errors, rows[each.name]) for each in maps}
    record |= {key: _mean(entry[key] for entry in entries.values()) for key in ("ssim", "flip")}
    sizes = [{"width": mip.shape[1], "height": mip.shape[0]} for mip in mips]
    record["mips"] = [{**size, "psnr": metrics.psnr_of_mse(error)} for size, error in zip(sizes, errors, strict=True)]
    return {**record, "maps": entries}


def _map_entry(each: MapChannels, errors, rows: list[dict]) -> dict:
    entry = {"psnr": metrics.psnr_of_mse([error[list(each.indices)] for error in errors])}
    entry |= {key: _mean(row[key] for row in rows) for key in ("ssim", "flip")}
    if each.encoding == "normal":
        entry["angle"] = {key: _mean(row["angle"][key] for row in rows) for key in ("mean", "p95")}
    return {**entry, "mips": rows}


def _mean(values) -> float | None:
    """Return the mean of those that exist."""
    found = [value for value in values if value is not None]
    return sum(found) / len(found) if found else None


def map_metrics(texture_set, encoded_fn, *, mips: int | None = None, progress=None) -> dict:
    """Return :func:`compare`'s record of what ``encoded_fn`` gives at the texel centres of every mip.

    Args:
        texture_set: The source, as :func:`warp_neumat.io.texture_set.open_texture_set` opens it.
        encoded_fn: ``(uv (n, 2), lod) -> (n, C)`` as ``BCf.encoded`` of ``materials/bcf.py``, lod = mip of the source.
        mips: How many mips to compare, from the finest on; default: all, to 1×1.
        progress: ``progress(fraction, text)``.
    """
    channels, pyramid = list(texture_set.channels), list(texture_set.mips())[:mips]
    levels = (sample_grid(encoded_fn, *mip.shape, float(lod)) for lod, mip in enumerate(pyramid))
    return compare(channels, pyramid, levels, progress=progress)


def eval_record(
    texture_set, material, baselines=True, *, astc_quality: int = THOROUGH, mips: int | None = None, progress=None
) -> dict:
    """Return what ``neumat eval`` writes: ``kind, bytes, bits_per_texel_per_channel``, metrics and ``baselines``.

    The bits count all mips of the file, and per texel of the finest mip and trained channel.

    Args:
        texture_set: The source, opened at the size and crop that the material was fitted to.
        material: With ``encoded``, ``channels``, ``kind``, ``bytes`` and the config's width and height.
        baselines: True for :data:`BASELINES`, False for none, or names in :data:`baselines.METHODS`.
        astc_quality: As for :class:`baselines.Baseline`.
        mips: As for :func:`map_metrics`.
        progress: ``progress(fraction, text)``.

    Raises:
        ValueError: If size or channels of source and material differ; says which.
        ImportError: If an encoder of a baseline is missing; names the extra.
    """
    check_match(texture_set, material)
    channels, pyramid = list(texture_set.channels), list(texture_set.mips())[:mips]
    config = material.header["config"]
    written = config["textures"] if material.kind == "ntbc" else None
    every = BASELINES if written is None else BASELINES_OF_BLOCKS
    names = every if baselines is True else tuple(baselines or ())
    more = {"wrap": config.get("wrap", "repeat"), "astc_quality": astc_quality, "written": written}
    others = [Baseline(name, channels, pyramid, **more) for name in names]
    steps = 1 + len(others)

    def part(number: int, title: str):
        return progress and (lambda fraction, text: progress((number + fraction) / steps, f"{title} {text}"))

    texels = texture_set.width * texture_set.height
    bits = 8 * material.bytes / (texels * len(channels))
    levels = (sample_grid(material.encoded, *mip.shape, float(lod)) for lod, mip in enumerate(pyramid))
    record = {"kind": material.kind, "bytes": int(material.bytes), "bits_per_texel_per_channel": bits}
    record |= compare(channels, pyramid, levels, progress=part(0, "this file"))
    record["baselines"] = {}
    for number, other in enumerate(others, 1):
        levels = (other.level(lod) for lod in range(len(pyramid)))
        found = compare(channels, pyramid, levels, progress=part(number, _TITLES[other.method]))
        for entry in found["maps"].values():
            del entry["mips"]
        entry = {"bytes": other.bytes, "bits_per_texel_per_channel": 8 * other.bytes / (texels * len(channels))}
        entry |= {"textures": other.formats, **found}
        if METHODS[other.method][0] == "astc12":
            entry["quality"] = astc_quality
        record["baselines"][other.method] = entry
    return record


def check_match(texture_set, material) -> None:
    """Raise a ValueError unless the material has the set's size and its channels in the same order."""
    config = material.header["config"]
    have, want = (texture_set.width, texture_set.height), (config["width"], config["height"])
    if have != want:
        raise ValueError(
            f"{texture_set.name}: is {have[0]}x{have[1]}, and the asset was fitted to {want[0]}x{want[1]}; "
            "open the source with the same size and crop"
        )
    ours, theirs = ([_facts(channel) for channel in channels] for channels in (texture_set.channels, material.channels))
    if ours != theirs:
        names = [", ".join(".".join(fact[:2]) for fact in facts) for facts in (ours, theirs)]
        if names[0] == names[1]:
            first = next(k for k in range(len(ours)) if ours[k] != theirs[k])
            names = [f"{facts[first][0]} {facts[first][2]} {list(facts[first][3])}" for facts in (ours, theirs)]
        raise ValueError(f"{texture_set.name}: its channels are {names[0]}, and the asset's are {names[1]}")


def _facts(channel) -> tuple:
    get = channel.get if isinstance(channel, dict) else lambda name: getattr(channel, name)
    return get("map"), get("component"), get("encoding"), tuple(float(x) for x in get("range"))


def format_table(record: dict) -> str:
    """Return maps × methods (PSNR [dB], SSIM, FLIP), their sizes, and this file's PSNR of every mip, as text."""
    methods = {"this": record, **record["baselines"]}
    shown = [("all maps", methods)]
    for name in record["maps"]:
        shown.append((name, {method: entry["maps"][name] for method, entry in methods.items()}))
    head = max(14, *(len(name) for name, _ in shown)) if len(methods) < 5 else 14
    lines = [" " * head + "".join(f"{_TITLES[method]:>{_COLUMN}}" for method in methods)]
    lines.append(" " * head + f"{'dB SSIM FLIP':>{_COLUMN}}" * len(methods))
    for name, row in shown:
        lines.append(f"{name[:head]:<{head}}" + "".join(f"{_cell(entry):>{_COLUMN}}" for entry in row.values()))
        if all("angle" in entry for entry in row.values()):
            angles = (f"{entry['angle']['mean']:.2f} ({entry['angle']['p95']:.2f})" for entry in row.values())
            lines.append(f"{'  angle (95 %)':<{head}}" + "".join(f"{text + '°':>{_COLUMN}}" for text in angles))
    sizes = (_size(entry["bytes"]) for entry in methods.values())
    lines.append(f"{'size':<{head}}" + "".join(f"{text:>{_COLUMN}}" for text in sizes))
    bits = (f"{entry['bits_per_texel_per_channel']:.3f}" for entry in methods.values())
    lines.append(f"{'bit/texel/ch.':<{head}}" + "".join(f"{text:>{_COLUMN}}" for text in bits))
    lines += ["", "PSNR [dB] of this file by mip (1 = half size)"]
    lines.append(" " * head + "".join(f"{lod:>7}" for lod in range(len(record["mips"]))))
    per_mip = [("all maps", record["mips"]), *((name, entry["mips"]) for name, entry in record["maps"].items())]
    for name, rows in per_mip:
        lines.append(f"{name[:head]:<{head}}" + "".join(f"{_decibel(row['psnr']):>7}" for row in rows))
    return "\n".join(line.rstrip() for line in lines)


def _cell(entry: dict) -> str:
    ssim = "–" if entry["ssim"] is None else "1.00" if entry["ssim"] > 0.9995 else f"{entry['ssim']:.3f}"
    flip = "–" if entry["flip"] is None else f"{entry['flip']:.3f}"
    return f"{_decibel(entry['psnr'])} {ssim.removeprefix('0'):>4} {flip.removeprefix('0'):>4}"


def _decibel(value: float | None) -> str:
    return "exact" if value is None else f"{value:.2f}" if value < 99.995 else f"{value:.0f}"


def _size(count: int) -> str:
    power = min(int(math.log(max(count, 1), 1000)), 2)
    return f"{count / 1000**power:.4g} {('B', 'kB', 'MB')[power]}"


def contact_sheet(texture_set, material, *, baseline: str | None = "bc_half", tile: int = 512) -> np.ndarray:
    """Return a picture of the finest mip, display values (H, W, 3) float32: one row for each map.

    From left to right: reference, decoded, ten times their difference, then the baseline and ten times its difference.
    Of maps larger than ``tile`` the middle is shown, texel by texel, as shrinking would hide what is to be seen.
    """
    check_match(texture_set, material)
    channels, pyramid = list(texture_set.channels), list(texture_set.mips())
    reference = pyramid[0]
    height, width = reference.shape[:2]
    pictures = [sample_grid(material.encoded, *reference.shape, 0.0)]
    if baseline is not None:
        wrap = material.header["config"].get("wrap", "repeat")
        pictures.append(Baseline(baseline, channels, pyramid, wrap=wrap).level(0))
    top, left = max(0, height - tile) // 2, max(0, width - tile) // 2
    window = slice(top, top + tile), slice(left, left + tile)
    rows = []
    for each in map_channels(channels):
        original = each.picture(reference[window][..., each.indices])
        row = [original]
        for picture in pictures:
            shown = each.picture(picture[window][..., each.indices])
            row += [shown, np.minimum(10.0 * np.abs(shown - original), 1.0)]
        rows.append(np.concatenate([_framed(part) for part in row], axis=1))
    return np.concatenate(rows, axis=0)


def _framed(picture: np.ndarray, width: int = 2) -> np.ndarray:
    return np.pad(picture, ((width, width), (width, width), (0, 0)), constant_values=1.0).astype(np.float32)
