"""What a data set was made with and the sha256 of every file: the same bytes can be made again, and checked.

OUT/manifest.json         settings that all of it shares, versions, and a digest of the solver's sources
OUT/sums/<group>.sha256   as `sha256sum` writes them; `sha256sum -c sums/*.sha256` in OUT checks them too
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path

from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.scene.files import ngff_version, replacing, sha256

FORMAT, VERSION = "ngff-dataset", 1
SOLVER_SOURCES = ("core/physics/mpm/*.py", "core/kernels/mpm/*.py")  # under stages/
UNLISTED_FILES = ("manifest.json", "particles.npz")  # beside the folder sums/


def open_manifest(root: Path, settings: dict) -> None:
    """Write the manifest, or see that what is there was made with the same settings and solver."""
    path, now = root / "manifest.json", {"settings": settings, "solver": solver_digest()}
    if path.exists():
        try:
            there = json.loads(path.read_text())
            before = {"settings": there["settings"], "solver": there["solver"]}
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: cannot be read ({error!r}); is {root} a data set?") from error
        _must_agree(root, before, now)
        return
    about = {"ngff": ngff_version(), "python": platform.python_version(),
             **{name: version(name) for name in ("torch", "warp-lang", "h5py") if _there(name)}}  # fmt: skip
    with replacing(path) as part:
        part.write_text(json.dumps({"format": FORMAT, "version": VERSION, **now, "made with": about}, indent=1) + "\n")


def _there(name: str) -> bool:
    try:
        return bool(version(name))
    except ImportError:  # PackageNotFoundError is one: a package that was put on the path by hand
        return False


def _must_agree(root: Path, before: dict, now: dict) -> None:
    names = {**before["settings"], **now["settings"]}
    odd = [name for name in names if before["settings"].get(name) != now["settings"].get(name)]
    if odd:
        told = ", ".join(f"{n} {before['settings'].get(n)}, not {now['settings'].get(n)}" for n in odd)
        raise InputError(f"{root}: was begun with {told}; go on with the same, or use another folder")
    if before["solver"] != now["solver"]:
        raise InputError(f"{root}: was begun with another version of the solver; go on with that one, or use another "
                         "folder")  # fmt: skip


def solver_digest() -> str:
    """sha256 of the sources that decide how things move."""
    stages = Path(__file__).resolve().parents[2]
    digest = hashlib.sha256()
    for path in sorted(p for pattern in SOLVER_SOURCES for p in stages.glob(pattern)):
        digest.update(path.name.encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def write_checksums(root: Path, name: str, files: Iterable[Path]) -> None:
    """List files, and no others, in sums/<name>.sha256; those that are listed already are not read again."""
    path = root / "sums" / f"{name}.sha256"
    before = read_checksums(path) if path.exists() else {}
    names = sorted(file.relative_to(root).as_posix() for file in files)
    if names == sorted(before):
        return
    digests = {n: before.get(n) or sha256(root / n) for n in tqdm(names, desc=f"sha256 {name}", leave=False)}
    path.parent.mkdir(exist_ok=True)
    with replacing(path) as part:
        part.write_text("".join(f"{digest}  {n}\n" for n, digest in digests.items()))


def read_checksums(path: Path) -> dict[str, str]:
    """Name -> digest of a file as `sha256sum` writes it."""
    rows = [line.split("  ", 1) for line in path.read_text().splitlines() if line]
    if not all(len(row) == 2 and len(row[0]) == 64 for row in rows):
        raise InputError(f"{path}: is no list of sha256 digests; remove it and run `ngff-lab dataset` again")
    return {name: digest for digest, name in rows}


def verify_files(root: Path) -> int:
    """How many files are listed, all of them as they were. Raises InputError when one is not, or is not listed."""
    lists = sorted((root / "sums").glob("*.sha256"))
    if not lists:
        raise InputError(f"{root}: has no sums/*.sha256; it is no data set of `ngff-lab dataset`, or was not finished")
    listed = {name: digest for path in lists for name, digest in read_checksums(path).items()}
    wrong = []
    for name, digest in tqdm(listed.items(), desc="check", unit="file"):
        if not (root / name).is_file():
            wrong.append(f"{name} is missing")
        elif sha256(root / name) != digest:
            wrong.append(f"{name} has changed")
    unlisted = {str(p.relative_to(root).as_posix()) for p in root.rglob("*") if p.is_file()} - set(listed)
    known = (*UNLISTED_FILES, *(f".part-{n}" for n in UNLISTED_FILES))  # another run may be writing them
    wrong += [f"{n} is not listed" for n in sorted(unlisted) if n not in known and not n.startswith("sums/")]
    if wrong:
        more = f", and {len(wrong) - 5} more" if len(wrong) > 5 else ""
        raise InputError(f"{root}: {', '.join(wrong[:5])}{more}; remove what is wrong and run the same command again")
    return len(listed)
