"""What code and documents say about tests is true: every test they name exists."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_every_test_that_is_cited_exists():
    known = set()
    for file in (ROOT / "tests").rglob("test_*.py"):
        known |= set(re.findall(r"def (test_\w+)", file.read_text(encoding="utf-8"))) | {file.stem}
    texts = [*(ROOT / "warp_neumat").rglob("*.py"), *(ROOT / "docs").glob("*.md"), ROOT / "README.md"]
    # A quoted name is data: the field of a header that holds errors on test samples.
    cited = {(f.name, name) for f in texts for name in re.findall(r'(?<!")\btest_\w+', f.read_text(encoding="utf-8"))}
    assert len(cited) > 30
    assert sorted((f, n) for f, n in cited if n not in known) == []


def test_every_file_that_is_cited_exists():
    for text in [*(ROOT / "docs").glob("*.md"), ROOT / "README.md"]:
        for path in re.findall(
            r"`((?:tests|kernels|models|reference|pipeline|bench|docs|export|training|ops|io|materials)/[\w/.]+)`",
            text.read_text(),
        ):
            assert (ROOT / path).exists() or (ROOT / "warp_neumat" / path).exists(), f"{text.name}: {path}"


def test_no_placeholder_is_left():
    for file in (ROOT / "warp_neumat").rglob("*.py"):
        assert "<FILL>" not in file.read_text(encoding="utf-8"), file
