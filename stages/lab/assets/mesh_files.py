"""Grouping of mesh files into objects."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from pathlib import Path

from stages.core.errors import InputError

log = logging.getLogger(__name__)
MESH_SUFFIXES = (".obj", ".glb", ".gltf", ".ply", ".stl", ".off")  # suffixes in order of preference
# number of a part at the end of the stem
PART_NUMBER = re.compile(r"([ _.-]+|(?<=part)|(?<=piece)|(?<=mesh)|(?<=geom))\d+$", re.IGNORECASE)
GENERIC_STEMS = ("mesh", "model", "object", "scene", "textured", "part", "piece", "geom")  # the folder names the object


def find_objects(paths: Sequence[Path]) -> list[tuple[Path, ...]]:
    """The files of each object; folders are searched recursively, and a file given directly is one object.

    Within a folder, files whose names differ only in a number at the end (leg_0.obj, leg_1.obj; part1.obj, part2.obj,
    but not towel2.obj, towel3.obj) are the parts of one object. Of files that differ only in their suffix, the first in
    the order of MESH_SUFFIXES is used. Raises InputError for a folder without meshes.
    """
    return [files for path in map(Path, paths) for files in (_in_folder(path) if path.is_dir() else [(path,)])]


def _in_folder(folder: Path) -> list[tuple[Path, ...]]:
    suffix = {p: MESH_SUFFIXES.index(p.suffix.lower()) for p in folder.rglob("*")
              if p.suffix.lower() in MESH_SUFFIXES and p.is_file() and not p.name.startswith(".")}  # fmt: skip
    if not suffix:
        raise InputError(f"{folder}: contains no meshes; give a folder with files of suffix {' '.join(MESH_SUFFIXES)}")
    objects: dict[Path, dict[str, Path]] = {}
    for path in sorted(suffix, key=lambda p: (p.parent, p.stem, suffix[p])):
        objects.setdefault(path.parent / _common_stem(path), {}).setdefault(path.stem, path)
    for name, parts in objects.items():
        if len(parts) > 1:
            names = ", ".join(p.name for p in parts.values())
            log.warning("%s: %s are read as parts of one object", name.parent, names)
    return [tuple(parts.values()) for parts in objects.values()]


def _common_stem(path: Path) -> str:
    return PART_NUMBER.sub("", path.stem) or path.stem


def object_name(files: Sequence[Path]) -> str:
    """Name of the object in these files: their common stem, or the name of the folder if the stem is generic."""
    path = Path(files[0])
    stem = path.stem if len(files) == 1 else _common_stem(path)
    return path.resolve().parent.name or stem if stem.lower() in GENERIC_STEMS else stem
