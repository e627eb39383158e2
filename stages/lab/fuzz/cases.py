"""Fuzzing cases: a random change to a small valid file, given to its reader.

The result is `right` (read, with values that satisfy their types), `clear error` (an InputError with one short line),
`nonsense` (read with invalid values, or an error that is too long or unprintable) or `traceback` (any other exception).
Results that only another process can observe are in campaign.py.
"""

from __future__ import annotations

import logging
import random
import shutil
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stages.core.errors import InputError
from stages.lab.fuzz.kinds import KINDS, Kind

MAX_MESSAGE = 600  # largest length of an error message without the path [characters]
GOOD = ("right", "clear error")  # acceptable results
TURNS = [kind for kind in KINDS for _ in range(kind.share)]  # kinds of the cases, used cyclically


class Examples:
    """The valid files of every kind, written once to a folder; each case changes a copy."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.files: dict[str, dict[str, bytes]] = {}
        for kind in KINDS:
            made = folder / "valid" / kind.name
            made.mkdir(parents=True)
            kind.write(made)
            self.files[kind.name] = {path.name: path.read_bytes() for path in sorted(made.iterdir())}

    def place(self, kind: Kind) -> Path:
        """Restore the valid files of a kind in the folder for its cases, and return it."""
        case = self.folder / "case" / kind.name
        case.mkdir(parents=True, exist_ok=True)
        for name, data in self.files[kind.name].items():
            (case / name).write_bytes(data)
        for path in case.iterdir():
            if path.name not in self.files[kind.name]:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        return case

    def run(self, seed: int, number: int) -> tuple[Kind, str, str]:
        """Run a case; return its kind, result and explanation. Its files stay in `place_in`."""
        kind, rng = TURNS[number % len(TURNS)], random.Random(f"{seed} {number}")
        case = self.place(kind)
        name = rng.choice(list(kind.changes))
        kind.changes[name](case / name, rng)
        if kind.repair and rng.random() < 0.7:
            kind.repair(case)
        return kind, *result_of(kind, case)

    @staticmethod
    def place_in(folder: Path, number: int) -> Path:
        """The folder with the files of a case, valid until the next case of the same kind."""
        return folder / "case" / TURNS[number % len(TURNS)].name


def result_of(kind: Kind, folder: Path) -> tuple[str, str]:
    """Result and explanation of reading the files in a folder."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            kind.read(folder)
    except InputError as error:
        text = str(error).replace(str(folder), "")
        wrong = not all(c.isprintable() for c in text) or len(text) > MAX_MESSAGE
        return ("nonsense", f"an error of {len(text)} characters: {text[:80]!r}") if wrong else ("clear error", text)
    except AssertionError:
        return "nonsense", traceback.format_exc(limit=-1)[-1000:]
    except MemoryError:
        return "more than 2 GB", traceback.format_exc(limit=-3)[-2000:]
    except Exception:
        return "traceback", traceback.format_exc(limit=-4)[-3000:]
    return "right", ""


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress log messages."""
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)
