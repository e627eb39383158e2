"""Atomic writing, checks before reading, and provenance."""

import hashlib
import itertools
import os
import platform
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from stages.core.errors import InputError
from stages.core.scene.formats import format_of
from stages.core.scene.schema import read_json, reason

KEPT_OF_NAME = 50  # characters of a file's name kept in the name of its temporary file; names have up to 255 bytes
_HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:6]
_count = itertools.count()
_swept: set[Path] = set()  # folders from which this process has removed the files of killed processes


def check_output(path: Path, *kinds: str) -> None:
    """Check before long work that a file can be written. Raises InputError if it cannot.

    That is if `path` is a folder or a device, if its folder is missing or cannot be written to, or if `kinds` of data
    (formats.py) are given and the suffix is not of a format that holds one of them: the next stage could not read the
    file, and an existing file of that name might be of another kind.
    """
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of the file to write")
    if path.exists() and not path.is_file():
        raise InputError(
            f"{path}: is not a regular file but a device or a pipe, which cannot be replaced; name another file"
        )
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}; create it first")
    if not os.access(path.parent, os.W_OK):
        raise InputError(
            f"{path}: its folder is not writable; change the folder's permissions, or name a file in another folder"
        )
    if kinds:
        format_of(path, *kinds, writable=True)


def make_folder(path: Path) -> Path:
    """Create a folder to write to, with its parents. Raises InputError, before long work, if that is not possible."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{path}: is not a folder and cannot be created ({error.strerror}); name another folder"
        ) from error
    if not os.access(path, os.W_OK):
        raise InputError(f"{path}: is not writable; change its permissions, or name another folder")
    return path


def check_json_output(path: Path) -> None:
    """As `check_output`, for JSON. Raises InputError for another suffix too: it might be a file of another kind."""
    check_output(path)
    if path.suffix.lower() != ".json":
        raise InputError(f"{path}: the output is a JSON file; use the suffix .json")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path next to `path`, with the same suffix, that replaces `path` on success and is deleted on failure.

    Its name .part-HOST-PID-COUNT-NAME is unique: if several processes write the same file, the last one wins. Only the
    end of a long NAME is used, so that names may be as long as the file system allows. The first call for a folder
    deletes the temporary files that killed processes of this machine left there. Raises InputError if `path` is a
    folder, its folder is missing, or the file cannot be written.
    """
    path = Path(path)
    check_output(path)
    _sweep(path.parent)
    part = path.with_name(f".part-{_HOST}-{os.getpid()}-{next(_count)}-{path.name[-KEPT_OF_NAME:]}")
    try:
        yield part
        os.replace(part, path)
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        part.unlink(missing_ok=True)


def save_tensors(path: Path, values: object) -> None:
    """Write tensors, and containers of them, with torch.save. Raises InputError as `replacing` does."""
    import torch

    with replacing(path) as part, part.open("wb") as file:  # a full disk raises OSError only with a file object
        try:
            torch.save(values, file)
        except RuntimeError as error:  # after a failed write, torch.save also fails to close its archive
            raise error.__context__ if isinstance(error.__context__, OSError) else error from None


def _sweep(folder: Path) -> None:
    """Delete the temporary files of processes of this machine that have ended."""
    if folder in _swept or os.name != "posix":
        return
    _swept.add(folder)
    for stale in folder.glob(f".part-{_HOST}-*"):
        pid = stale.name.split("-")[2]
        if pid.isdecimal() and not _is_running(int(pid)):
            shutil.rmtree(stale, ignore_errors=True) if stale.is_dir() else stale.unlink(missing_ok=True)


def _is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # the process of another user
        return True
    return True


def must_exist(path: Path, what: str) -> Path:
    """The path, if it is a readable, non-empty file. Otherwise raises InputError, saying that `what` is expected."""
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; {what} is expected")
    if not path.exists():
        raise InputError(f"{path}: no such file; {what} is expected")
    if not path.is_file():
        raise InputError(f"{path}: is not a regular file but a device or a pipe; {what} is expected")
    if not os.access(path, os.R_OK):
        raise InputError(f"{path}: cannot be read; check its permissions")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: is empty; {what} is expected")
    return path


def read_json_file(path: Path, what: str, kind: type | tuple[type, ...] = dict) -> Any:
    """The value of a JSON file, of type `kind`. Otherwise raises InputError, which says that `what` is expected."""
    must_exist(path, what)
    try:
        data = read_json(path)
    except ValueError as error:
        raise InputError(f"{path}: is not JSON ({reason(error)}); {what} is expected") from error
    if not isinstance(data, kind):
        raise InputError(f"{path}: is not {what}")
    return data


def sha256(path: Path) -> str:
    """Hexadecimal SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() if hasattr(hashlib, "file_digest") else _digest(file)


def _digest(file) -> str:
    """SHA-256 in blocks, for Python before 3.11, which has no hashlib.file_digest."""
    digest = hashlib.sha256()
    while block := file.read(1 << 20):
        digest.update(block)
    return digest.hexdigest()


def ngff_version() -> str:
    """Version of the installed package."""
    try:
        return version("ngff")
    except PackageNotFoundError:
        return "0 (not installed)"


def seconds_since(began: float) -> dict[str, float]:
    """{"seconds": wall time since `began` (time.monotonic())}; empty unless $NGFF_TIMES is set."""
    return {"seconds": round(time.monotonic() - began, 1)} if os.environ.get("NGFF_TIMES") else {}


def provenance(command: str, inputs: Sequence[Path], options: object = None) -> dict:
    """Provenance of an output file: command, version, options, and the inputs, including paths given as options.

    Input files are recorded with their sha256, folders only by name.
    """
    chosen = asdict(options) if is_dataclass(options) else dict(options or {})
    paths = dict.fromkeys([*map(Path, inputs), *(v for v in chosen.values() if isinstance(v, Path))])
    return {
        "command": command,
        "ngff": ngff_version(),
        "inputs": [{"name": p.name, **({"sha256": sha256(p)} if p.is_file() else {})} for p in paths],
        "options": {k: str(v) if isinstance(v, Path) else v for k, v in chosen.items()},
    }
