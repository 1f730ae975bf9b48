"""Fixtures of the whole suite: the data folder, a seeded generator, and the devices at hand."""

import os
from pathlib import Path

import numpy as np
import pytest
import warp as wp

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


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240)


@pytest.fixture(params=["cpu", *wp.get_cuda_devices()], ids=str)
def device(request):
    """Every device of this machine: the CPU, and the GPUs where there are any."""
    return str(request.param)
