"""The arrows between the rooms: every import of every file is walked, and one that the design does not have fails."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import warp_neumat

ROOT = Path(warp_neumat.__file__).parent

# Room → rooms it may import from, beside itself. docs/conventions.md draws it.
ARROWS = {
    "kernels": set(),
    "reference": set(),
    "io": set(),
    "metrics": set(),
    "simulation": {"kernels", "io"},
    "machine": set(),
    "materials": {"kernels", "io"},
    "export": {"materials", "kernels", "io"},
    "pipeline": {"materials", "kernels", "io", "metrics", "machine"},
    "ops": {"kernels"},
    "models": {"ops", "kernels", "io"},
    "training": {
        "models",
        "ops",
        "materials",
        "kernels",
        "io",
        "metrics",
        "machine",
        "simulation",
    },  # materials: a fit measures its file
    "cli": {
        "kernels",
        "io",
        "metrics",
        "machine",
        "materials",
        "export",
        "pipeline",
        "models",
        "training",
        "ops",
        "simulation",
    },
    "__init__": set(),
    "__main__": {"cli"},
}

# Files of numbers out of a specification: numpy and no Warp, so that kernel and reference read the same ones.
DATA_TABLES = {"kernels/bc6h_tables.py", "kernels/bc7_tables.py"}

# Third-party packages that a room may import at module level; inside functions, any may be.
HEAVY = {"torch", "trimesh", "xatlas", "OpenImageIO", "matplotlib", "av", "skimage", "flip_evaluator", "rich", "pxr"}
TORCH_ROOMS = {"ops", "models", "training"}

FILES = sorted(ROOT.rglob("*.py"))


def room_of(file: Path) -> str:
    """Return the folder below the package, or the file's own name where it lies at the top."""
    part = file.relative_to(ROOT).parts[0]
    return part.removesuffix(".py")


def imports(file: Path):
    """Yield (module, line, whether it is at module level) for every import of ``file``."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    inner = {
        id(node)
        for function in ast.walk(tree)
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef))
        for node in ast.walk(function)
    }
    package = ["warp_neumat", *file.relative_to(ROOT).parent.parts]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            # `from package import room` names the room in the alias.
            names = [f"{module}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            yield name, node.lineno, id(node) not in inner


def breaches(file: Path) -> list[str]:
    """Return every import of ``file`` that the design does not have."""
    room, found = room_of(file), []
    for name, line, top in imports(file):
        parts = name.split(".")
        if parts[0] == "warp_neumat":
            target = parts[1] if len(parts) > 1 else "__init__"
            known = target in ARROWS
            if room == "reference" and "/".join(parts[1:3]) + ".py" in DATA_TABLES:
                continue
            if known and target not in ARROWS[room] | {room, "__init__"}:
                found.append(f"{file.relative_to(ROOT)}:{line}: {room} may not import {target}")
        elif parts[0] == "bench" or parts[0] == "tests":
            found.append(f"{file.relative_to(ROOT)}:{line}: the package may not import {parts[0]}")
        elif top and parts[0] in HEAVY and not (parts[0] == "torch" and room in TORCH_ROOMS):
            found.append(f"{file.relative_to(ROOT)}:{line}: {parts[0]} must be imported inside a function")
        elif room == "kernels" and parts[0] not in {"warp", "numpy"} | sys.stdlib_module_names:
            found.append(f"{file.relative_to(ROOT)}:{line}: kernels may import warp and numpy only, not {parts[0]}")
        elif str(file.relative_to(ROOT)) in DATA_TABLES and parts[0] == "warp":
            found.append(f"{file.relative_to(ROOT)}:{line}: a table of data may not import warp")
        elif room == "reference" and parts[0] not in {"numpy"} | sys.stdlib_module_names:
            found.append(f"{file.relative_to(ROOT)}:{line}: reference may import numpy only, not {parts[0]}")
    return found


@pytest.mark.parametrize("file", FILES, ids=lambda f: str(f.relative_to(ROOT)))
def test_imports_follow_the_arrows(file):
    assert room_of(file) in ARROWS, f"{file.name} lies in no room of the design"
    assert breaches(file) == []


def test_a_wrong_arrow_is_found(tmp_path, monkeypatch):
    file = ROOT / "kernels" / "wrong.py"  # never written: only its path says where it would lie
    source = "from ..pipeline import atlas\nimport torch\n\ndef f():\n    import trimesh\n"
    monkeypatch.setattr(Path, "read_text", lambda self, **_: source)
    found = "\n".join(breaches(file))
    assert "kernels may not import pipeline" in found
    assert "torch must be imported inside a function" in found
    assert "kernels may import warp and numpy only, not trimesh" in found


def test_the_reference_may_read_tables_and_no_kernel(monkeypatch):
    file = ROOT / "reference" / "wrong.py"
    source = "from ..kernels.bc6h_tables import MODES\nfrom ..kernels import bc7_tables\nfrom ..kernels.bc6h import x\n"
    monkeypatch.setattr(Path, "read_text", lambda self, **_: source)
    assert breaches(file) == ["reference/wrong.py:3: reference may not import kernels"]
    monkeypatch.setattr(Path, "read_text", lambda self, **_: "import warp as wp\n")
    assert breaches(ROOT / "kernels" / "bc7_tables.py") == [
        "kernels/bc7_tables.py:1: a table of data may not import warp"
    ]


def test_files_hold_one_idea():
    long = [f"{f.relative_to(ROOT)}" for f in FILES if len(f.read_text(encoding="utf-8").splitlines()) > 500]
    assert long == []


def _loaded_by(statement: str) -> set[str]:
    """Return the top-level modules that a fresh interpreter has loaded after ``statement``."""
    code = f"import sys, warnings; warnings.simplefilter('ignore'); {statement}; print(' '.join(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return {name.split(".")[0] for name in done.stdout.split()}


@pytest.mark.parametrize(
    "statement",
    [
        "import warp_neumat",
        "import warp_neumat.cli",
        "from warp_neumat import Renderer, load, MeshSequence, vec2pix, render_shot",
    ],
)
def test_rendering_loads_nothing_heavy(statement):
    assert not _loaded_by(statement) & HEAVY
