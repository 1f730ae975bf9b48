"""The benchmark harness: fair turns, medians, discovery without imports, exit codes and whole JSON files."""

import json
import math
import os
import platform
import re
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from bench import __main__ as command
from bench.harness import interleave, machine, versions

ROOT = Path(__file__).resolve().parents[1]


def test_interleave_takes_turns_and_starts_one_further_each_round():
    calls = []
    interleave({name: lambda name=name: calls.append(name) for name in "abc"}, rounds=3, warmup=1)
    assert "".join(calls) == "abc" + "abc" + "bca" + "cab"


def test_interleave_returns_medians():
    naps = iter([0.0, 0.002, 0.2, 0.004])  # the warm-up, then an outlier in the middle
    seconds = interleave({"nap": lambda: time.sleep(next(naps))}, rounds=3)
    assert 0.004 <= seconds["nap"] < 0.1


def test_interleave_rejects_no_rounds():
    with pytest.raises(ValueError, match="rounds must be at least 1"):
        interleave({"a": int}, rounds=0)


def test_machine_and_versions_say_what_and_not_where():
    facts, found = machine(), versions()
    assert {"cpu", "cores", "memory_gib", "simd", "python", "platform"} <= facts.keys()
    assert facts["cores"] >= 1
    assert facts["python"] == platform.python_version()
    assert found["numpy"] == np.__version__
    assert {"warp_neumat", "warp", "numpy"} <= found.keys()
    assert re.fullmatch(r"[0-9a-f]{12}(-dirty)?", found.get("git", "0" * 12))
    words = re.findall(r"[\w.-]+", json.dumps([facts, found]))
    assert socket.gethostname() not in words
    assert "/" not in json.dumps([{k: v for k, v in facts.items() if k not in ("cpu", "gpus")}, found])


def bench(*arguments, folder=ROOT):
    environment = {**os.environ, "COLUMNS": "100", "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        [sys.executable, "-m", "bench", *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_list_names_every_benchmark_without_importing_one(tmp_path, capsys):
    (tmp_path / "heavy.py").write_text('"""Measures nothing.\n\nMore."""\nraise RuntimeError("imported")\n')
    (tmp_path / "_private.py").write_text('"""Not one."""\n')
    (tmp_path / "harness.py").write_text('"""Not one."""\n')
    assert command.available(tmp_path) == {"heavy": "Measures nothing."}
    assert command.main(["--list"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(command.available())


def test_unknown_name_is_one_line_with_the_nearest_and_exit_code_2(capsys, monkeypatch):
    monkeypatch.setattr(command, "available", lambda: {"shading": "", "mlp": "", "raster": ""})
    assert command.main(["shadng"]) == 2
    message = capsys.readouterr().err
    assert message == "bench: no benchmark is named 'shadng'; did you mean shading?\n"


def test_no_name_is_exit_code_2():
    done = bench()
    assert done.returncode == 2
    assert done.stderr.startswith("bench: say which benchmark")
    assert "Traceback" not in done.stderr


@pytest.fixture
def sample(monkeypatch):
    """A benchmark module of three rows, the way ``bench/NAME.py`` would be imported."""

    class Sample:
        COLUMNS = ("n", "peer", "ms", "error")

        @staticmethod
        def rows(*, device, quick):
            for n in (1, 1000, 1000000):
                yield {
                    "n": n,
                    "peer": f"peer {n} on {device}",
                    "ms": np.float32(n * 1.5),
                    "error": math.nan,
                    "quick": quick,
                }

    monkeypatch.setattr(command, "available", lambda: {"sample": "A sample."})
    monkeypatch.setattr(command.importlib, "import_module", lambda name: {"bench.sample": Sample}[name])
    return Sample


def test_json_holds_all_keys_of_all_rows_and_no_nan(sample, tmp_path, capsys):
    file = tmp_path / "out.json"
    assert command.main(["sample", "--json", str(file), "--quick"]) == 0
    document = json.loads(file.read_text(), parse_constant=pytest.fail)
    assert list(document) == ["bench", "machine", "versions", "rows"]
    assert document["bench"] == "sample"
    assert document["rows"][1] == {"n": 1000, "peer": "peer 1000 on cpu", "ms": 1500.0, "error": None, "quick": True}
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["n", "peer", "ms", "error"]
    assert lines[3].split() == ["1000", "peer", "1000", "on", "cpu", "1500", "nan"]
    assert list(tmp_path.iterdir()) == [file]


def test_a_table_wider_than_the_terminal_keeps_its_columns(sample, capsys):
    sample.COLUMNS = tuple(f"quite a long column {k}" for k in range(12))
    assert command.main(["sample"]) == 0
    assert capsys.readouterr().out.splitlines()[1].split("  ")[:12] == list(sample.COLUMNS)


def test_a_benchmark_that_fails_leaves_the_old_json_and_exit_code_1(sample, tmp_path, capsys):
    file = tmp_path / "out.json"
    file.write_text("old")

    def rows(*, device, quick):
        yield {"n": 1}
        raise ValueError("nside must be a power of 2,\n got 3")

    sample.rows = staticmethod(rows)
    assert command.main(["sample", "--json", str(file)]) == 1
    assert capsys.readouterr().err == "bench: nside must be a power of 2, got 3\n"
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_missing_folder_is_named_before_anything_is_measured(sample, tmp_path, capsys):
    sample.rows = staticmethod(lambda **_: pytest.fail("measured"))
    assert command.main(["sample", "--json", str(tmp_path / "no" / "out.json")]) == 1
    assert "out.json: cannot be written, there is no folder" in capsys.readouterr().err
