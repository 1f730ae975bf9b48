"""Every bench runs in its quick form, on the CPU, and its rows hold what its table promises."""

import importlib
import math
from pathlib import Path

import pytest

NAMES = sorted(f.stem for f in (Path(__file__).resolve().parents[1] / "bench").glob("[a-z]*.py") if f.stem != "harness")


@pytest.mark.parametrize("name", NAMES)
def test_quick_bench_yields_whole_rows(name, data, monkeypatch, tmp_path):
    monkeypatch.setenv("NEUMAT_DATA", str(data))
    monkeypatch.setenv("NEUMAT_CACHE", str(tmp_path))
    if name in ("mlp", "neubrdf"):
        pytest.importorskip("drjit")
    module = importlib.import_module(f"bench.{name}")
    rows = list(module.rows(device="cpu", quick=True))
    assert rows
    columns = set(module.COLUMNS)
    assert columns <= set().union(*rows)
    for row in rows:
        if "ratio" in row:
            assert row["peer_ms"] > 0
            assert math.isfinite(row["ratio"])
            assert row["ratio"] > 0
        for value in row.values():
            assert not isinstance(value, float) or not math.isnan(value)
