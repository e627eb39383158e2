"""The shape of the code: who may import whom, and what stays light."""

import ast
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
ORDER = ["errors", "backends", "geometry", "scene", "kernels", "raster", "physics", "models",
         "reconstruct", "segment", "refine", "simulate", "render", "evaluate", "lab"]  # fmt: skip
STAGES = {"reconstruct", "segment", "refine", "simulate", "render", "evaluate"}


def imported(path: Path) -> set[str]:
    """First folder below `stages` of every import in a file, wherever in the file it stands."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return {name.split(".")[1] for name in names if name.startswith("stages.")}


FILES = sorted(p for p in (ROOT / "stages").rglob("*.py") if p.parent != ROOT / "stages")


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(ROOT)))
def test_folders_import_only_from_folders_above_them(path):
    home = path.relative_to(ROOT / "stages").parts[0]
    allowed = set(ORDER[: ORDER.index(home) + 1])
    if home in STAGES:
        allowed -= STAGES - {home}
    assert imported(path) <= allowed


def test_no_file_outside_the_list_of_folders():
    assert {p.relative_to(ROOT / "stages").parts[0] for p in FILES} <= set(ORDER)


def test_help_is_quick_and_imports_nothing_heavy():
    code = "import sys; sys.argv = ['ngff', '--help']\nimport ngff_cli.app as a\n"
    code += "try:\n a.main()\nexcept SystemExit: pass\n"
    code += "print(sorted({'torch', 'warp', 'cv2', 'pycolmap', 'h5py', 'numpy'} & set(sys.modules)))"
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip().endswith("[]")
    assert time.perf_counter() - start < 20  # a hang, not a speed: the modules above are what costs time
