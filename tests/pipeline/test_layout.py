"""The shape of the code: who may import whom, and what stays light."""

import ast
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CORE = ["errors", "backends", "geometry", "scene", "kernels", "raster", "perception", "physics", "models"]
STAGES = {"reconstruct", "segment", "refine", "simulate", "render", "evaluate"}


def folder(module: str) -> str:
    """Which room a module belongs to: core.geometry, simulate, lab, ..."""
    parts = module.split(".")
    return ".".join(parts[1:3]) if parts[1] == "core" else parts[1]


def imported(path: Path) -> set[str]:
    """Rooms of every import in a file, wherever in the file it stands."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return {folder(name) for name in names if name.startswith("stages.")}


FILES = sorted(p for p in (ROOT / "stages").rglob("*.py") if p.parent not in (ROOT / "stages", ROOT / "stages/core"))


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_folders_import_only_from_folders_above_them(path):
    home = folder(".".join(path.relative_to(ROOT).with_suffix("").parts))
    core = [f"core.{name}" for name in CORE]
    above = core[: core.index(home)] if home in core else core
    assert imported(path) <= {*above, home, *(STAGES if home == "lab" else ())}


def test_no_file_outside_the_list_of_folders():
    homes = {folder(".".join(p.relative_to(ROOT).with_suffix("").parts)) for p in FILES}
    assert homes <= {"lab", *STAGES, *(f"core.{name}" for name in CORE)}


def test_help_is_quick_and_imports_nothing_heavy():
    code = "import sys; sys.argv = ['ngff', '--help']\nimport ngff_cli.app as a\n"
    code += "try:\n a.main()\nexcept SystemExit: pass\n"
    code += "print(sorted({'torch', 'warp', 'cv2', 'pycolmap', 'h5py', 'numpy'} & set(sys.modules)))"
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip().endswith("[]")
    assert time.perf_counter() - start < 20  # a hang, not a speed: the modules above are what costs time
