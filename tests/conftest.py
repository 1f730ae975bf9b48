"""Fixtures of the whole suite: the data folder, a seeded generator, and the devices at hand."""

import os
from pathlib import Path

# Before torch and FLIP load their OpenMP: threads that spin while they wait cost a busy machine many times their gain.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

import numpy as np  # noqa: E402
import pytest  # noqa: E402
import warp as wp  # noqa: E402

wp.config.log_level = wp.LOG_WARNING


def data_root() -> Path:
    """Return the folder of real inputs: ``NEUMAT_DATA``, else ``../shared/data`` beside the checkout."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    return Path(os.environ.get("NEUMAT_DATA", default))


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of real inputs; tests that need it skip, counted, where it is missing."""
    root = data_root()
    if not root.is_dir():
        pytest.skip(f"no data folder at {root}; set NEUMAT_DATA")
    return root


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """What tests keep between runs of the package lies in a folder of their own, never in the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NEUMAT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240)


@pytest.fixture(params=["cpu", *wp.get_cuda_devices()], ids=str)
def device(request):
    """Every device of this machine: the CPU, and the GPUs where there are any."""
    return str(request.param)


@pytest.fixture
def run(capsys, monkeypatch, tmp_path):
    """``run("render", …)`` returns (exit code, stdout, stderr); the atlas cache is the test's own."""
    from warp_neumat.cli import main

    monkeypatch.setenv("NEUMAT_CACHE", str(tmp_path / "cache"))

    def call(*arguments):
        try:
            main([str(a) for a in arguments])
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        out, err = capsys.readouterr()
        return code, out, err

    return call
