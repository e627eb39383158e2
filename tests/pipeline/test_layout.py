"""Structure of the code: order of imports between folders, unique class names, and imports by the command line."""

import ast
import subprocess
import sys
from collections import Counter
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CORE = [
    "errors",
    "backends",
    "options",
    "torch_state",
    "geometry",
    "scene",
    "kernels",
    "raster",
    "perception",
    "physics",
    "models",
    "player",
]
STAGES = {"reconstruct", "segment", "refine", "simulate", "render", "evaluate"}
HEAVY = {"torch", "warp", "cv2", "pycolmap", "h5py", "numpy"}  # packages whose import takes long


def folder(module: str) -> str:
    """Folder of a module below stages: core.geometry, simulate, lab, ..."""
    parts = module.split(".")
    return ".".join(parts[1:3]) if parts[1] == "core" else parts[1]


def imported_modules(tree: ast.Module) -> set[str]:
    """All imports of a file, at any level: modules, and names imported from them."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    return names


def imported_folders(tree: ast.Module) -> set[str]:
    """Folders of all modules in stages that a file imports."""
    return {folder(name) for name in imported_modules(tree) if name.startswith("stages.")}


@pytest.fixture(scope="module")
def trees() -> dict[str, ast.Module]:
    """Syntax trees by module name."""
    files = (p for p in (ROOT / "stages").rglob("*.py") if p.parent not in (ROOT / "stages", ROOT / "stages/core"))
    return {".".join(p.relative_to(ROOT).with_suffix("").parts): ast.parse(p.read_text()) for p in sorted(files)}


def allowed_imports(home: str) -> set[str]:
    """Folders from which the files of a folder may import."""
    core = [f"core.{name}" for name in CORE]
    above = core[: core.index(home)] if home in core else core
    return {*above, home, *(STAGES if home == "lab" else ())}


def test_folders_import_only_from_folders_above_them(trees):
    violations = {module: extra for module, tree in trees.items()
                  if (extra := imported_folders(tree) - allowed_imports(folder(module)))}  # fmt: skip
    assert not violations


@pytest.mark.parametrize("home", ["stages.lab", "stages.core.models"])
def test_no_two_subfolders_import_from_each_other(trees, home):
    """Longer cycles are not allowed either. The files directly in `home` count as one subfolder."""

    def part(module: str) -> str:
        name = module.removeprefix(f"{home}.").split(".")[0]
        return name if (ROOT / home.replace(".", "/") / name).is_dir() else home

    graph: dict[str, set[str]] = {}
    for module, tree in trees.items():
        if module.startswith(f"{home}."):
            others = {part(name) for name in imported_modules(tree) if name.startswith(f"{home}.")}
            graph.setdefault(part(module), set()).update(others - {part(module)})
    tuple(TopologicalSorter(graph).static_order())  # raises CycleError if there is a cycle


def test_no_file_outside_the_list_of_folders(trees):
    assert {folder(module) for module in trees} <= {"lab", *STAGES, *(f"core.{name}" for name in CORE)}


def test_class_names_are_unique(trees):
    names = Counter(node.name for tree in trees.values() for node in tree.body if isinstance(node, ast.ClassDef))
    assert not [name for name, count in names.items() if count > 1]


@pytest.mark.parametrize("command_line", ["app", "lab"])
def test_help_imports_nothing_heavy(command_line):
    code = f"import sys; sys.argv = ['ngff', '--help']\nimport ngff_cli.{command_line} as a\n"
    code += "try:\n a.main()\nexcept SystemExit: pass\n"
    code += f"print(sorted({HEAVY!r} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip().endswith("[]")
