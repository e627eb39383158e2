"""Cache of the results of the steps of a reconstruction, to resume an interrupted run, and their wall times."""

from __future__ import annotations

import hashlib
import logging
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import torch

from stages.core.errors import InputError
from stages.core.scene.files import replacing, save_tensors

log = logging.getLogger(__name__)
T = TypeVar("T")


class StepCache:
    """A folder with the result of every finished step, written atomically.

    `key` identifies everything on which the results depend. Results with another key are deleted, and all results
    without `resume`. Without a folder a temporary one is used, which is deleted with this object.
    """

    def __init__(self, folder: Path | None = None, key: str = "", resume: bool = False):
        self._temporary = tempfile.TemporaryDirectory() if folder is None else None
        self.folder = Path(self._temporary.name if folder is None else folder)
        self.seconds: dict[str, float] = {}  # wall time of each step
        note = self.folder / "key"
        if not (resume and note.exists() and note.read_text() == key):
            if resume:
                log.info("--resume has no effect: there is no interrupted run with these photos, cameras and options")
            self.remove()
        self.folder.mkdir(exist_ok=True)
        note.write_text(key)

    @classmethod
    def for_output(cls, out: Path, key: str, resume: bool) -> StepCache:
        """A cache in a hidden folder next to the output file."""
        out = Path(out)
        return cls(out.with_name(f".steps-{out.name}"), key, resume)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Context manager that adds its wall time [s] to the step `name`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def cached(self, name: str, make: Callable[[], T], types: tuple[type, ...] = ()) -> T:
        """The result of `make`, or that of the resumed run. It may contain tensors, plain values and `types`.

        Raises InputError if the stored result is damaged.
        """
        path = self.folder / f"{name}.pt"
        if path.exists():
            log.info("%s: using the result of the interrupted run", name)
            torch.serialization.add_safe_globals(list(types))
            try:
                return torch.load(path, weights_only=True)
            except Exception as error:  # a damaged pickle may raise any exception
                raise InputError(f"{path}: is damaged; start again without --resume") from error
        with self.timed(name):
            made = make()
        save_tensors(path, made)
        return made

    def cached_file(self, name: str, write: Callable[[Path], None]) -> Path:
        """Path of the file that `write` writes, or that it wrote in the run that is resumed."""
        path = self.folder / name
        if path.exists():
            log.info("%s: using the result of the interrupted run", path.stem)
            return path
        with replacing(path) as part:
            write(part)
        return path

    def remove(self) -> None:
        """Delete the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)


def fingerprint(*parts: object) -> str:
    """SHA-256 of the bytes of tensors and the repr of everything else."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.numpy().data if isinstance(part, torch.Tensor) else repr(part).encode())
    return digest.hexdigest()


def peak_memory() -> float:
    """Peak resident memory of this process [GB]; 0 outside Unix."""
    try:
        import resource
    except ImportError:  # only on Unix
        return 0.0
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9
