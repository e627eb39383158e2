"""Manifest of a data set: its settings and the sha256 of every file, to reproduce and verify it.

OUT/manifest.json         settings shared by all files, package versions, and a digest of the solver's sources
OUT/sums/<group>.sha256   in the format of `sha256sum`; `sha256sum -c sums/*.sha256` in OUT verifies them too
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.scene.files import ngff_version, replacing, sha256
from stages.core.scene.schema import read_json

FORMAT, VERSION = "ngff-dataset", 1
SOLVER_SOURCES = ("core/physics/mpm/*.py", "core/kernels/mpm/*.py")  # under stages/
UNLISTED_FILES = ("manifest.json", "particles.npz")  # files without checksums, besides the folder sums/
MAX_REPORTED = 5  # largest number of wrong files named in an error


def open_manifest(root: Path, settings: dict) -> None:
    """Write the manifest, or raise InputError if the existing one has other settings or another solver."""
    path, current = root / "manifest.json", {"settings": settings, "solver": solver_digest()}
    if path.exists():
        try:
            content = read_json(path)
            existing = {"settings": content["settings"], "solver": content["solver"]}
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: cannot be read ({error!r}); check that {root} is a data set") from error
        _require_equal(root, existing, current)
        return
    versions = {"ngff": ngff_version(), "python": platform.python_version(),
                **{name: version(name) for name in ("torch", "warp-lang", "h5py") if _installed(name)}}  # fmt: skip
    content = {"format": FORMAT, "version": VERSION, **current, "made with": versions}
    with replacing(path) as part:
        part.write_text(json.dumps(content, indent=1) + "\n")


def _installed(name: str) -> bool:
    """Whether a package has metadata; packages put on the import path by hand have none."""
    try:
        return bool(version(name))
    except PackageNotFoundError:
        return False


def _require_equal(root: Path, existing: dict, current: dict) -> None:
    old, new = existing["settings"], current["settings"]
    different = [name for name in {**old, **new} if old.get(name) != new.get(name)]
    if different:
        values = ", ".join(f"{n} {old.get(n)}, not {new.get(n)}" for n in different)
        raise InputError(f"{root}: was started with {values}; use the same options, or another folder")
    if existing["solver"] != current["solver"]:
        raise InputError(f"{root}: was started with another version of the solver; use that version, or another folder")


def solver_digest() -> str:
    """sha256 of the source files of the solver."""
    stages = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for path in sorted(p for pattern in SOLVER_SOURCES for p in stages.glob(pattern)):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def write_checksums(root: Path, name: str, files: Iterable[Path]) -> None:
    """List exactly these files in sums/<name>.sha256; files that are already listed are not hashed again."""
    path = root / "sums" / f"{name}.sha256"
    listed = read_checksums(path) if path.exists() else {}
    names = sorted(file.relative_to(root).as_posix() for file in files)
    if names == sorted(listed):
        return
    digests = {n: listed.get(n) or sha256(root / n) for n in tqdm(names, desc=f"sha256 {name}", leave=False)}
    path.parent.mkdir(exist_ok=True)
    with replacing(path) as part:
        part.write_text("".join(f"{digest}  {n}\n" for n, digest in digests.items()))


def read_checksums(path: Path) -> dict[str, str]:
    """Digests by file name, from a file in the format of `sha256sum`. Raises InputError for other content."""
    rows = [line.split("  ", 1) for line in path.read_text(errors="replace").splitlines() if line]
    if not all(len(row) == 2 and len(row[0]) == 64 for row in rows):
        raise InputError(f"{path}: is not a list of sha256 digests; remove it and run `ngff-lab dataset` again")
    return {name: digest for digest, name in rows}


def verify_files(root: Path) -> int:
    """Verify all files and return the number of listed files.

    Raises InputError if a listed file is missing or changed, or a file is not listed.
    """
    lists = sorted((root / "sums").glob("*.sha256"))
    if not lists:
        raise InputError(
            f"{root}: has no sums/*.sha256; it is not a data set of `ngff-lab dataset`, or is "
            "incomplete; generate it first"
        )
    listed = {name: digest for path in lists for name, digest in read_checksums(path).items()}
    problems = []
    for name, digest in tqdm(listed.items(), desc="check", unit="file"):
        if not (root / name).is_file():
            problems.append(f"{name} is missing")
        elif sha256(root / name) != digest:
            problems.append(f"{name} has changed")
    unlisted = {str(p.relative_to(root).as_posix()) for p in root.rglob("*") if p.is_file()} - set(listed)
    unlisted -= {n for n in unlisted if n in UNLISTED_FILES or n.startswith("sums/")}
    being_written = {n for n in unlisted if n.startswith(".part-") and n.endswith(tuple(UNLISTED_FILES))}
    problems += [f"{n} is not listed" for n in sorted(unlisted - being_written)]
    if problems:
        more = f", and {len(problems) - MAX_REPORTED} more" if len(problems) > MAX_REPORTED else ""
        raise InputError(f"{root}: {', '.join(problems[:MAX_REPORTED])}{more}; remove the wrong files and run the same "
                         "command again")  # fmt: skip
    return len(listed)
