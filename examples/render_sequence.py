"""Render the bundled animation from Python: sequence, atlas, renderer, and what each frame cost.

Run: python examples/render_sequence.py --frames 8 --out out/example
"""

import argparse
from pathlib import Path

import warp as wp

import warp_neumat as nm
from warp_neumat.io.image import write_png
from warp_neumat.pipeline import demo


def main(arguments=None) -> list[dict]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--atlas", type=int, default=600)
    parser.add_argument("--out", type=Path, default=Path("out/example"))
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    options.out.mkdir(parents=True, exist_ok=True)

    sequence = demo.sequence(options.frames)
    renderer = nm.Renderer(sequence, demo.material_paths(), atlas=options.atlas, size=(640, 360), interval=4)
    stats = []
    for frame in renderer.render():
        write_png(options.out / f"{frame.index:04d}.png", nm.tonemap(frame.image))
        stats.append(frame.stats)
        print(f"frame {frame.index}: {frame.stats['evaluations']} evaluations, {frame.stats['ms']['shade']:.1f} ms")
    return stats


if __name__ == "__main__":
    main()
