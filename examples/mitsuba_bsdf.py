"""Path-trace a fitted material with Mitsuba 3: a sphere under an area light and a uniform sky.

A BSDF plugin in Python, `neumat`, hands Mitsuba's arrays to `eval`, `sample` and `pdf` of the material and takes the
results back. Directions go the other way round there: what Mitsuba calls `si.wi` points to the viewer, our ω_o, and its
`wo` to the light, our ω_i. Its texture coordinates start at the bottom, ours at the top.

The plugin needs values, not symbols, so Mitsuba's loops and calls have to run in evaluated mode: see `evaluated`. It
works in the scalar variants too, one direction at a time, some thousand times slower.

Needs: pip install mitsuba, and for speed LLVM 17 or newer (DRJIT_LIBLLVM_PATH names its library)
Run: python examples/mitsuba_bsdf.py [FILE.neumat] --out out/sphere.png --size 256 --spp 64
"""

import argparse
import threading
from pathlib import Path

import numpy as np
import warp as wp

import warp_neumat as nm
from warp_neumat.pipeline import demo

FAST, SLOW = "llvm_ad_rgb", "scalar_rgb"
SKY = 0.35  # radiance of the uniform sky
LIGHT = {"centre": (2.2, 2.6, 2.4), "half": 0.7, "radiance": 9.0}  # a square that faces the sphere's centre
CAMERA = {"distance": 4.0, "fov": 34.0}  # on +z, looking at the sphere of radius 1 around the origin


def best_variant() -> str:
    """Return the fast variant where Dr.Jit finds an LLVM that compiles Mitsuba's kernels, else say so and go slow."""
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(FAST)
    try:
        version = dr.detail.llvm_version()
    except RuntimeError:
        version = None
    if version is not None and version >= (17, 0, 0):
        return FAST
    found = "no LLVM" if version is None else f"LLVM {version[0]}"
    print(f"{found} for {FAST}, which needs 17 or newer: rendering by {SLOW}; DRJIT_LIBLLVM_PATH names another library")
    return SLOW


def rows(value) -> np.ndarray:
    """Return a Dr.Jit vector as (n, components) float32: one kernel interleaves it, numpy looks at the result."""
    import drjit as dr

    if not dr.is_jit_v(value):
        return np.array([list(value)], np.float32)
    return dr.ravel(value).numpy().reshape(-1, len(value))


def register():
    """Define the plugin for the current Mitsuba variant and register it as `neumat`; return the class."""
    import drjit as dr
    import mitsuba as mi

    class NeumatBSDF(mi.BSDF):
        """`{"type": "neumat", "filename": "bronze.neumat"}`: one-sided, as the material is."""

        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.filename = props["filename"]
            self.material = nm.load(self.filename)
            self.one_at_a_time = threading.Lock()  # scalar variants call from every thread
            flags = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [flags]
            self.m_flags = flags

        def _lanes(self, si, active, *arrays):
            """Return the indices of active samples with both frames' z above 0, their uv, and their rows of arrays."""
            found = [rows(a) for a in arrays]
            count = max(len(f) for f in found)
            mask = np.broadcast_to(active.numpy() if dr.is_jit_v(active) else active, count)
            found = [np.broadcast_to(f, (count, f.shape[1])) for f in found]
            lanes = np.flatnonzero(mask & (found[0][:, 2] > 0))  # the first is always the viewer
            uv = np.broadcast_to(rows(si.uv), (count, 2))[lanes] * np.float32([1, -1]) + np.float32([0, 1])
            return count, lanes, uv, [f[lanes] for f in found]

        def _back(self, kind, count, lanes, values):
            """Return `values` of the lanes, and 0 elsewhere, as a Dr.Jit array of type `kind`."""
            whole = np.zeros((count, *values.shape[1:]), np.float32)
            whole[lanes] = values
            if not dr.is_jit_v(kind):
                return kind(whole[0].tolist())
            flat = mi.Float(whole.ravel())
            return flat if values.ndim == 1 else dr.unravel(kind, flat)

        def sample(self, ctx, si, sample1, sample2, active=True):
            numbers = mi.Vector3f(sample1, sample2.x, sample2.y)
            count, lanes, uv, (viewer, u) = self._lanes(si, active, si.wi, numbers)
            with self.one_at_a_time:
                light, weight, density = self.material.sample(uv, viewer, u)
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = self._back(mi.Vector3f, count, lanes, light)
            bs.pdf = self._back(mi.Float, count, lanes, density)
            bs.eta = 1.0
            bs.sampled_type = +mi.BSDFFlags.GlossyReflection
            bs.sampled_component = 0
            return bs, self._back(mi.Color3f, count, lanes, weight)

        def eval(self, ctx, si, wo, active=True):
            count, lanes, uv, (viewer, light) = self._lanes(si, active, si.wi, wo)
            with self.one_at_a_time:
                value = self.material.eval(uv, light, viewer)
            return self._back(mi.Color3f, count, lanes, value)

        def pdf(self, ctx, si, wo, active=True):
            count, lanes, _, (viewer, light) = self._lanes(si, active, si.wi, wo)
            with self.one_at_a_time:
                density = self.material.pdf(None, light, viewer)
            return self._back(mi.Float, count, lanes, density)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def to_string(self):
            return f"NeumatBSDF[filename={self.filename}]"

    mi.register_bsdf("neumat", NeumatBSDF)
    return NeumatBSDF


def evaluated():
    """Return a context in which Mitsuba computes arrays step by step, so that a plugin may look at their values."""
    import contextlib

    import drjit as dr

    stack = contextlib.ExitStack()
    for flag in (dr.JitFlag.SymbolicLoops, dr.JitFlag.SymbolicCalls, dr.JitFlag.SymbolicConditionals):
        stack.enter_context(dr.scoped_set_flag(flag, False))
    return stack


def scene(asset, size: int) -> dict:
    """Return the Mitsuba scene: a sphere with the material, a square light, a sky, a camera, a box filter."""
    import mitsuba as mi

    to_world = mi.ScalarTransform4f
    centre = list(LIGHT["centre"])
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},  # nothing here reflects twice
        "sensor": {
            "type": "perspective",
            "fov": CAMERA["fov"],
            "to_world": to_world().look_at(origin=[0, 0, CAMERA["distance"]], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
        },
        "sphere": {"type": "sphere", "bsdf": {"type": "neumat", "filename": str(asset)}},
        "sky": {"type": "constant", "radiance": SKY},
        "light": {
            "type": "rectangle",
            "to_world": to_world().look_at(origin=centre, target=[0, 0, 0], up=[0, 1, 0]).scale(LIGHT["half"]),
            "emitter": {"type": "area", "radiance": LIGHT["radiance"]},
        },
    }


def render(asset, *, size: int, spp: int, seed: int = 0, variant: str = FAST) -> np.ndarray:
    """Return the linear picture (size, size, 3) float32."""
    import mitsuba as mi

    mi.set_variant(variant)
    register()
    with evaluated():
        image = mi.render(mi.load_dict(scene(asset, size)), spp=spp, seed=seed)
    return np.array(image)[:, :, :3]


def main(arguments=None) -> np.ndarray:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("asset", type=Path, nargs="?", help="a .neumat file; default: the bundled bronze")
    parser.add_argument("--out", type=Path, default=Path("out/sphere.png"), help=".png (sRGB) or .exr (linear)")
    parser.add_argument("--size", type=int, default=256, help="width and height in pixels")
    parser.add_argument("--spp", type=int, default=64, help="samples per pixel")
    parser.add_argument("--variant", choices=(FAST, SLOW), help="of Mitsuba; default: the fast one where it can run")
    options = parser.parse_args(arguments)
    wp.config.log_level = wp.LOG_WARNING
    try:
        import mitsuba as mi
    except ImportError:
        raise SystemExit("this example needs Mitsuba 3: pip install mitsuba") from None

    asset = options.asset or demo.material_paths()["knot"]
    variant = options.variant or best_variant()
    image = render(asset, size=options.size, spp=options.spp, variant=variant)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    mi.util.write_bitmap(str(options.out), image, write_async=False)
    print(f"{options.out}: mean radiance {image.mean():.4f}, {options.spp} samples per pixel")
    return image


if __name__ == "__main__":
    main()
