"""Cases: a random change of a small valid file, given to its reader.

The result is `right` (read, and the values satisfy their types), `clear error` (an InputError of one short line),
`nonsense` (read, but the values do not, or an error that is not short) or `traceback` (any other exception). Those that
only another process can see are in campaign.py.
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

MAX_MESSAGE = 600  # characters of an error, without the path
GOOD = ("right", "clear error")
TURNS = [kind for kind in KINDS for _ in range(kind.share)]  # the kinds of the cases, repeated in this order


class Examples:
    """The valid files of every kind, made once, in a folder; a case changes a copy."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.files: dict[str, dict[str, bytes]] = {}
        for kind in KINDS:
            made = folder / "valid" / kind.name
            made.mkdir(parents=True)
            kind.write(made)
            self.files[kind.name] = {path.name: path.read_bytes() for path in sorted(made.iterdir())}

    def place(self, kind: Kind) -> Path:
        """A folder with the valid files of a kind."""
        case = self.folder / "case" / kind.name
        case.mkdir(parents=True, exist_ok=True)
        for name, data in self.files[kind.name].items():
            (case / name).write_bytes(data)
        for path in case.iterdir():
            if path.name not in self.files[kind.name]:
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        return case

    def run(self, seed: int, number: int) -> tuple[Kind, str, str]:
        """The kind and the result of a case, and what explains it; its files stay in `place_in`."""
        kind, rng = TURNS[number % len(TURNS)], random.Random(f"{seed} {number}")
        case = self.place(kind)
        name = rng.choice(list(kind.changes))
        kind.changes[name](case / name, rng)
        if kind.repair and rng.random() < 0.7:
            kind.repair(case)
        return kind, *result_of(kind, case)

    @staticmethod
    def place_in(folder: Path, number: int) -> Path:
        """Where the examples of a folder have the files of a case, until the next case of its kind."""
        return folder / "case" / TURNS[number % len(TURNS)].name


def result_of(kind: Kind, folder: Path) -> tuple[str, str]:
    """The result of reading the files in a folder, and what explains it."""
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
    """Without log messages."""
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)
