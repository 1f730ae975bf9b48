"""BCf against block compression of the maps: PSNR, SSIM, FLIP and bytes, over sizes, scales and trainer options.

Paper [bcf], Sec. 6, on the centres of real sets, with feature textures in the proportions of Table 1. The tables, of
which ``python -m bench.bcf`` takes a choice (``--help``), as of sets, crop and steps:

- ``table2``: every set and method, then their mean, whose PSNR is that of the mean squared error, as in the paper;
  ``gain`` is over BC at half resolution.
- ``figure8``: these means, and a plot of PSNR against bytes.
- ``figure10``: PSNR over a continuous scale, at texel centres of a picture 2^scale times smaller. The reference is that
  of the training (bicubic in the two nearest mips, linear between); ``psnr_area`` is against the finest mip filtered
  over the area of a pixel, what a picture of that size should show. A plot of the first set.
- ``options``: the trainer's options one by one; ``gain`` is against its defaults.
- ``figure13``: features that are quantised instead of compressed, n channels of q bits; runs only if chosen.

PSNR counts every mip the same; ``psnr_texels`` every texel, ``psnr_mip0`` the finest mip alone. Fitted files stay in
the output folder and are used again while their options are the same; ``seconds`` is the fit's time, where it was now.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

from ._bcf_lab import BASELINES, PRESETS, SETS, TABLES, Choice, Lab, synthetic_set

COLUMNS = [
    "table", "set", "method", "scale", "bytes", "psnr", "psnr_texels", "psnr_mip0", "ssim", "flip", "gain", "seconds",
]  # fmt: skip

_PAPER = {
    "quantisation": "once",
    "modes": "single",
    "sensitivity": False,
    "mip_decay": 0.0,
    "aligned": 0.0,
    "smallest_mip": 4,
}

OPTIONS = {
    "defaults": {},
    "random partitions, no warm-up": {"warmup": False},
    "quantised at the end": {"quantisation": "once"},
    "quantised all at once": {"quantisation": "straight-through"},
    "partitions chosen anew": {"repartition": 2},
    "all texels encoded alike": {"sensitivity": False},
    "mode 10 only": {"modes": "single"},
    "all mips sampled alike": {"mip_decay": 0.0},
    "no samples on texel centres": {"aligned": 0.0},
    "last mip 4x4": {"smallest_mip": 4},
    "channels weighted by variance": {"channel_weights": "variance"},
    "as the paper": _PAPER,
}
"""Method → what differs from the defaults of the fit, with the preset of BCf-1k."""

QUANTISED = {
    "3 channels x 2 bit": {"quantise": (3, 2, 1.0)},
    "3 channels x 3 bit": {"quantise": (3, 3, 1.0)},
    "6 channels x 4 bit, half the side": {"quantise": (6, 4, 0.5)},
    "6 channels x 4 bit": {"quantise": (6, 4, 1.0)},
}
"""Method → (channels, bits, scale of the sides) of features that are quantised and not block-compressed (8 bit)."""

_SCALE_STEP = 0.25


def _gain(row: dict, base: dict) -> float | None:
    return None if row["psnr"] is None or base["psnr"] is None else row["psnr"] - base["psnr"]


def table2(lab: Lab):
    """Yield every set × method, then the means."""
    for name in lab.choice.sets:
        base = lab.measure(name, "bc_half")
        for method in (*lab.choice.presets, *lab.choice.baselines):
            row = lab.measure(name, method)
            yield {"table": "table2", "set": name, "method": method, **row, "gain": _gain(row, base)}
    base = lab.mean("bc_half")
    for method in (*lab.choice.presets, *lab.choice.baselines):
        row = lab.mean(method)
        yield {"table": "table2", "set": "mean", "method": method, **row, "gain": _gain(row, base)}


def figure8(lab: Lab):
    """Yield the means again, as points of PSNR over bytes, and plot them."""
    points = {method: lab.mean(method) for method in (*lab.choice.presets, *lab.choice.baselines)}
    families = [("BCf", lab.choice.presets)]
    for family in ("bc", "bc7", "astc12"):
        members = (family, f"{family}_full", f"{family}_half")
        families.append((family, [method for method in lab.choice.baselines if method in members]))
    with _plot(lab.out / "figure8.png", "size [kB]", "PSNR [dB], mean over mips and sets") as axes:
        axes.set_xscale("log")
        axes.margins(0.15)
        for family, methods in families:
            shown = sorted(
                (points[m]["bytes"] / 1000, points[m]["psnr"], m) for m in methods if points[m]["psnr"] is not None
            )
            if not shown:
                continue
            axes.plot([x for x, _, _ in shown], [y for _, y, _ in shown], "o-", label=family)
            for x, y, method in shown:
                axes.annotate(method, (x, y), textcoords="offset points", xytext=(6, -10), fontsize=8)
    for method, row in points.items():
        yield {"table": "figure8", "set": "mean", "method": method, **row}


def figure10(lab: Lab):
    """Yield PSNR over scale for BCf-1k and BC, and plot the first set."""
    from warp_neumat.io.mipmaps import resample
    from warp_neumat.training.baselines import METHODS
    from warp_neumat.training.evaluate_maps import sample_grid

    preset = "BCf-1k" if "BCf-1k" in lab.choice.presets else lab.choice.presets[0]
    for name in lab.choice.sets:
        _, opened, mips = lab.source(name)
        material, _ = lab.material(name, preset, {})
        levels = {}
        for method in ("bc_half", "bc_full"):
            baseline = lab.baseline(name, method)
            levels[method] = [baseline.level(m) for m in range(len(mips))]
        curves: dict[str, list] = {preset: [], "bc_full": [], "bc_half": []}
        scales = np.arange(0, max(len(mips) - 3, 0.5), _SCALE_STEP).tolist()  # down to 4 texels a side
        for scale in scales:
            height, width = (max(1, round(n / 2**scale)) for n in mips[0].shape[:2])
            reference = filtered(mips, height, width, scale, cubic_taps)
            area = resample(mips[0], opened.channels, width, height)
            for method in curves:
                if method == preset:
                    got = sample_grid(material.encoded, height, width, reference.shape[2], scale)
                else:
                    got = filtered(levels[method], height, width, max(scale, METHODS[method][1]), linear_taps)
                row = {"table": "figure10", "set": name, "method": method, "scale": scale}
                row |= {"psnr": _psnr(got, reference), "psnr_area": _psnr(got, area)}
                curves[method].append(row["psnr"])
                yield row
        if name == lab.choice.sets[0]:
            with _plot(lab.out / "figure10.png", "scale [mip of the reference]", f"PSNR [dB], {name}") as axes:
                for method, values in curves.items():
                    style = ".--" if method == "bc_half" else ".-"  # it lies on bc_full but for the first mip
                    axes.plot(scales, [math.nan if v is None else v for v in values], style, label=method)


def _psnr(got: np.ndarray, reference: np.ndarray) -> float | None:
    from warp_neumat import metrics

    return metrics.psnr_of_mse(metrics.channel_mse(reference, got))


def linear_taps(t: np.ndarray) -> list[np.ndarray]:
    """Return the weights of texels 0 and 1 for a place ``t`` in [0, 1) between them."""
    return [1 - t, t]


def cubic_taps(t: np.ndarray) -> list[np.ndarray]:
    """Return the weights of texels −1 to 2 for a place ``t`` in [0, 1): the cubic kernel of the training."""
    from warp_neumat.kernels.bcf_train import CUBIC as a

    def near(x):
        return ((a + 2) * x - (a + 3)) * x * x + 1

    def far(x):
        return ((a * x - 5 * a) * x + 8 * a) * x - 4 * a

    return [far(1 + t), near(t), near(1 - t), far(2 - t)]


def filtered(mips, height: int, width: int, lod: float, taps) -> np.ndarray:
    """Return the texel centres of a (height, width) grid, each of the two mips around ``lod`` filtered by ``taps``.

    Textures repeat; linear between the mips; shape (height, width, C), float32.
    """
    first = min(int(lod), len(mips) - 1)
    rest = min(lod - first, 1.0)
    result = _sampled(mips[first], height, width, taps)
    if rest > 0 and first + 1 < len(mips):
        result = result + np.float32(rest) * (_sampled(mips[first + 1], height, width, taps) - result)
    return result


def _sampled(mip: np.ndarray, height: int, width: int, taps) -> np.ndarray:
    for axis, size in enumerate((height, width)):
        source = mip.shape[axis]
        at = (np.arange(size) + 0.5) * (source / size) - 0.5
        low = np.floor(at).astype(int)
        weights = taps(at - low)
        start = 1 - len(weights) // 2
        shape = (-1, 1, 1) if axis == 0 else (1, -1, 1)
        mip = sum(
            np.take(mip, (low + start + k) % source, axis) * weight.astype(np.float32).reshape(shape)
            for k, weight in enumerate(weights)
        )
    return mip


def _variants(lab: Lab, table: str, configs: dict[str, dict]):
    """Yield every config on every set with BCf-1k's features, then the means; the first one is what others are to."""
    first = next(iter(configs))
    for name in lab.choice.sets:
        base = lab.measure(name, first, configs[first])
        for method, config in configs.items():
            row = lab.measure(name, method, config)
            yield {"table": table, "set": name, "method": method, **row, "gain": _gain(row, base)}
    base = lab.mean(first, configs[first])
    for method, config in configs.items():
        row = lab.mean(method, config)
        yield {"table": table, "set": "mean", "method": method, **row, "gain": _gain(row, base)}


def options(lab: Lab):
    """Yield the trainer's options, each against all of them."""
    return _variants(lab, "options", OPTIONS)


def figure13(lab: Lab):
    """Yield quantised features of several widths, against compressed ones."""
    return _variants(lab, "figure13", {"compressed (BC6H)": {}, **QUANTISED})


class _plot:
    """Gives axes, and writes them to a PNG when done."""

    def __init__(self, path: Path, x: str, y: str):
        self.path, self.labels = path, (x, y)

    def __enter__(self):
        from matplotlib.figure import Figure

        self.figure = Figure(figsize=(8, 5), dpi=120, layout="constrained")
        return self.figure.add_subplot()

    def __exit__(self, kind, error, trace):
        if kind is None:
            axes = self.figure.axes[0]
            axes.set(xlabel=self.labels[0], ylabel=self.labels[1])
            axes.grid(alpha=0.3)
            axes.legend()
            self.figure.savefig(self.path)


def rows(*, device: str, quick: bool, **choices):
    """Yield the rows of the chosen tables; ``choices`` are fields of :class:`Choice`."""
    if not quick:
        yield from _rows(Choice(**choices), device)
        return
    with tempfile.TemporaryDirectory() as folder:
        source = str(synthetic_set(Path(folder) / "quick"))
        small = {"sets": (source,), "presets": ("BCf-2k",), "baselines": ("bc_half", "astc12"), "crop": None}
        small |= {"only": ("table2", "figure8", "figure10"), "steps": 30, "astc_quality": 60}
        yield from _rows(Choice(**{**small, "out": Path(folder) / "out", **choices}), device)


def _rows(choice: Choice, device: str):
    lab = Lab(choice, device)
    for table in TABLES:
        if table in choice.only:
            for row in globals()[table](lab):
                yield {**row, "set": Path(row["set"]).name}


def main(arguments: list[str] | None = None) -> int:
    """Run chosen tables: the command line of ``python -m bench.bcf``."""
    from rich.console import Console

    from bench.__main__ import run

    def names(text):
        return tuple(text.split(","))

    parser = argparse.ArgumentParser(prog="python -m bench.bcf", description=__doc__.splitlines()[0])
    parser.add_argument("--only", type=names, default=Choice.only, help=f"tables, of {','.join(TABLES)}")
    parser.add_argument("--sets", type=names, default=SETS, help="names in NEUMAT_DATA/textures, or folders")
    parser.add_argument("--presets", type=names, default=PRESETS, help=f"of {','.join(PRESETS)}")
    parser.add_argument("--baselines", type=names, default=BASELINES, help=f"of {','.join(BASELINES)}")
    parser.add_argument("--crop", type=int, default=512, help="side of the centre; 0 for the whole set")
    parser.add_argument("--steps", type=int, help="of each fit; default: the fit's own")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--astc-quality", type=int, default=100)
    parser.add_argument("--out", type=Path, default=Choice.out, help="fitted files and plots (default: %(default)s)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--device", default="cpu")
    # Threads of FLIP and torch that spin while they wait cost a busy machine many times what they gain.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    chosen = vars(parser.parse_args(arguments))
    file, device = chosen.pop("json"), chosen.pop("device")
    try:
        found = rows(device=device, quick=False, **{**chosen, "crop": chosen["crop"] or None})
        document = run("bcf", found, COLUMNS, Console(highlight=False))
    except (ValueError, TypeError, OSError, ImportError) as error:
        print(f"bench: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    if file:
        file.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
