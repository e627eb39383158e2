"""The steps of a reconstruction: how long each took, and what a later run need not do again."""

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
from stages.core.scene.files import replacing

log = logging.getLogger(__name__)
T = TypeVar("T")


class StepCache:
    """A folder with the result of every finished step, each there whole or not at all.

    `key` names everything that the results follow from; results found under another key are discarded.
    Without a folder a temporary one serves, gone with this object.
    """

    def __init__(self, folder: Path | None = None, key: str = "", resume: bool = False):
        self._temporary = tempfile.TemporaryDirectory() if folder is None else None
        self.folder = Path(self._temporary.name if folder is None else folder)
        self.seconds: dict[str, float] = {}
        note = self.folder / "key"
        if not (resume and note.exists() and note.read_text() == key):
            if resume:
                log.info("nothing to resume: no earlier run with these photos and options was cut off here")
            self.remove()
        self.folder.mkdir(exist_ok=True)
        note.write_text(key)

    @classmethod
    def for_output(cls, out: Path, key: str, resume: bool) -> StepCache:
        """In a hidden folder next to the file that is being made."""
        out = Path(out)
        if not out.parent.is_dir():
            raise InputError(f"{out}: there is no folder {out.parent}; make it first")
        return cls(out.with_name(f".steps-{out.name}"), key, resume)

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Adds the wall time of what is inside to the step's [s]."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def cached(self, name: str, make: Callable[[], T], types: tuple[type, ...] = ()) -> T:
        """What `make` returns, or returned in the run that is resumed: tensors, plain values and `types`."""
        path = self.folder / f"{name}.pt"
        if path.exists():
            log.info("%s: from the earlier run", name)
            torch.serialization.add_safe_globals(list(types))
            return torch.load(path, weights_only=True)
        with self.timed(name):
            made = make()
        with replacing(path) as part:
            torch.save(made, part)
        return made

    def cached_file(self, name: str, write: Callable[[Path], None]) -> Path:
        """A file that `write` makes, or made in the run that is resumed."""
        path = self.folder / name
        if path.exists():
            log.info("%s: from the earlier run", path.stem)
            return path
        with replacing(path) as part:
            write(part)
        return path

    def remove(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


def fingerprint(*parts: object) -> str:
    """Hex digest of tensors' bytes and of everything else as it prints."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.numpy().data if isinstance(part, torch.Tensor) else repr(part).encode())
    return digest.hexdigest()


def peak_memory() -> float:
    """The most memory that this process has held at a time [GB]; 0 where the system does not say."""
    try:
        import resource
    except ImportError:  # no such count outside Unix
        return 0.0
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9
