"""What a measurement was made on and with, for reports and benchmarks: no host name, no user name, no path."""

import importlib.metadata
import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np

_SIMD = (
    *("SSE42", "AVX", "F16C", "FMA3", "AVX2", "AVX512F", "AVX512_SKX", "AVX512_ICL", "AVX512_SPR"),
    *("NEON_FP16", "ASIMD", "ASIMDHP", "ASIMDDP", "SVE", "VSX3", "VX"),
)

_PACKAGES = {
    "warp": "warp-lang",
    "numpy": "numpy",
    "torch": "torch",
    "drjit": "drjit",
    "healpy": "healpy",
}


def machine() -> dict:
    """Return ``{cpu, cores, memory_gib, simd, python, platform}``, and ``gpus`` where Warp is loaded and sees any.

    ``cores`` counts the cores this process may use; ``simd`` lists the vector extensions NumPy detected on this CPU.
    A fact the system does not tell is ``None``.
    """
    facts = {
        "cpu": _cpu_name(),
        "cores": _cores(),
        "memory_gib": _memory_gib(),
        "simd": _simd(),
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
    }
    if (warp := sys.modules.get("warp")) and (gpus := [device.name for device in warp.get_cuda_devices()]):
        facts["gpus"] = gpus
    return facts


def versions() -> dict:
    """Return the versions of warp_neumat, Warp, NumPy, of torch, drjit, healpy if installed, and the ``git`` commit.

    Versions are read from package metadata: nothing is imported. ``git`` is there in a checkout only, and ends in
    ``-dirty`` where tracked files were edited since the commit.
    """
    import warp_neumat

    found = {"warp_neumat": warp_neumat.__version__}
    for name, package in _PACKAGES.items():
        try:
            found[name] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    if commit := _git_commit(Path(__file__).resolve().parents[1]):
        found["git"] = commit
    return found


def _cores() -> int:
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS and Windows
        return os.cpu_count() or 1


def _cpu_name() -> str | None:
    try:
        if sys.platform == "linux":
            for line in Path("/proc/cpuinfo").read_text().splitlines():
                key, _, value = line.partition(":")
                if key.strip() == "model name":
                    return value.strip()
        if sys.platform == "darwin":
            return _output(["sysctl", "-n", "machdep.cpu.brand_string"]) or None
    except OSError:
        pass
    return platform.processor() or None


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (AttributeError, ValueError, OSError):  # not on Windows
        return None


def _simd() -> list[str]:
    features = getattr(getattr(np, "_core", None), "_multiarray_umath", None)
    features = getattr(features, "__cpu_features__", {})
    return [name for name in _SIMD if features.get(name)]


def _git_commit(root: Path) -> str | None:
    if not (root / ".git").exists():  # an installed package may lie inside somebody else's repository
        return None
    try:
        commit = _output(["git", "rev-parse", "--short=12", "HEAD"], root)
        dirty = _output(["git", "status", "--porcelain", "--untracked-files=no"], root)
    except OSError:
        return None
    return f"{commit}-dirty" if commit and dirty else commit or None


def _output(command: list[str], folder: Path | None = None) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=10, check=False)
    return done.stdout.strip() if done.returncode == 0 else ""
