"""Checks of values in files, made before memory is allocated for contents; each reader adds its format's schema.

The checks raise ValueError, which the reader turns into an InputError with the name of the file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

MAX_JSON_BYTES, MAX_JSON_DEPTH = 256 << 20, 100
MAX_OBJECT_ID = 65535  # label images have 16 bits
LARGEST = 1e9  # largest coordinate or size [scene units]; squares stay far below the limit of float32
MAX_DEFLATE_RATIO = 1100  # largest ratio of uncompressed to compressed bytes; deflate reaches 1032
MAX_QUOTED = 80  # maximum number of characters of a quoted value in messages
MAX_ROWS = 10**6  # maximum number of entries of a list that a user writes
Bound = int | float
PLY_WIDTHS = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2,
              "double": 8, "float64": 8}  # [bytes]; other types have 4  # fmt: skip


def quote(value: object, limit: int = MAX_QUOTED) -> str:
    """A value of a user's file for error messages: printable, on one line, at most `limit` characters."""
    line = "".join(c if c.isprintable() else "?" for c in str(value)[: limit + 1])
    return line if len(line) <= limit else f"{line[: limit - 3]}..."


def reason(error: Exception) -> str:
    """The text of an exception for error messages; a KeyError says what is absent."""
    return quote(f"{error} is absent" if isinstance(error, KeyError) else error, 120)


def number(value: object, what: str, low: Bound = -LARGEST, high: Bound = LARGEST) -> float:
    """A finite number between two bounds. Raises ValueError, naming it `what`, for anything else."""
    value = value.item() if isinstance(value, np.generic) else value  # its repr is used in the message
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise ValueError(f"{what} is {quote(repr(value), 40)}, not a number from {low:g} to {high:g}")
    return float(value)


def numbers(values: object, count: int, what: str, low: Bound = -LARGEST, high: Bound = LARGEST) -> tuple[float, ...]:
    """A list of `count` numbers, each checked by `number`. Raises ValueError for anything else."""
    if isinstance(values, (str, bytes, dict)) or not hasattr(values, "__len__") or len(values) != count:
        raise ValueError(f"{what} is {quote(repr(values), 40)}, not {count} numbers")
    return tuple(number(value, what, low, high) for value in values)


def whole(value: object, what: str, low: int = 0, high: int = MAX_OBJECT_ID) -> int:
    """A whole number between two bounds; 3.0 is accepted. Raises ValueError for anything else."""
    if number(value, what, low, high) != int(value):
        raise ValueError(f"{what} is {quote(repr(value), 40)}, not a whole number")
    return int(value)


def text(value: object, what: str) -> str:
    """A string, reduced to one line of at most 200 characters. Raises ValueError for anything else."""
    if not isinstance(value, str):
        raise ValueError(f"{what} is {quote(repr(value), 40)}, not text")
    return quote(value, 200)


def numbered(values: object, what: str) -> dict[int, object]:
    """The values of a JSON object by its keys as integers. Raises ValueError for other keys and duplicates."""
    wrong = [key for key in table(values, "it") if not (key.isascii() and key.isdecimal() and len(key) < 10)]
    if wrong:
        raise ValueError(f"{what} is {quote(repr(wrong[0]), 40)}, not a whole number")
    found = {whole(int(key), what): value for key, value in values.items()}
    if len(found) < len(values):
        raise ValueError(f"{what} is used twice")
    return found


def texts(values: object, what: str) -> tuple[str, ...]:
    """A list of strings, each reduced to one line of at most 200 characters. Raises ValueError for anything else."""
    if not isinstance(values, (list, tuple)) or not all(isinstance(value, str) for value in values):
        raise ValueError(f"{what} is {quote(repr(values), 40)}, not a list of texts")
    return tuple(text(value, what) for value in values)


def flag(value: object, what: str) -> bool:
    """A boolean. Raises ValueError for anything else."""
    if not isinstance(value, bool):
        raise ValueError(f"{what} is {quote(repr(value), 40)}, not true or false")
    return value


def rows(values: object, what: str) -> list:
    """A list of at most MAX_ROWS values. Raises ValueError for anything else."""
    if not isinstance(values, list) or len(values) > MAX_ROWS:
        raise ValueError(f"{what} is {quote(repr(values), 40)}, not a list of at most {MAX_ROWS} values")
    return values


def table(value: object, what: str) -> dict:
    """A JSON object. Raises ValueError for anything else."""
    if not isinstance(value, dict):
        raise ValueError(f"{what} is {quote(repr(value), 40)}, not a JSON object")
    return value


def parse_json(data: str, finite: bool = True) -> object:
    """Parse a JSON text of bounded depth. Raises ValueError for malformed text and for an object with duplicate keys.

    With `finite`, NaN, infinities and integers beyond 64 bits are rejected as well.
    """
    try:
        value = json.loads(data, object_pairs_hook=_object, **(FINITE if finite else {}))
    except RecursionError:
        raise ValueError(f"it is nested more than {MAX_JSON_DEPTH} deep") from None
    level = [value]
    for _ in range(MAX_JSON_DEPTH):
        level = [child for parent in level if isinstance(parent, (dict, list))
                 for child in (parent.values() if isinstance(parent, dict) else parent)]  # fmt: skip
        if not level:
            return value
    raise ValueError(f"it is nested more than {MAX_JSON_DEPTH} deep")


def read_json(path: Path) -> object:
    """Parse a JSON file (UTF-8 with or without a byte-order mark) of bounded size and depth. Raises ValueError."""
    if Path(path).exists() and not Path(path).is_file():  # reading a pipe would block
        raise ValueError("it is not a file")
    size = Path(path).stat().st_size
    if size > MAX_JSON_BYTES:
        raise ValueError(f"it has {size >> 20} MB; at most {MAX_JSON_BYTES >> 20} are read")
    return parse_json(Path(path).read_text(encoding="utf-8-sig"))


def _object(pairs: list[tuple[str, object]]) -> dict:
    found = dict(pairs)
    if len(found) < len(pairs):  # Python's json would silently keep the last value
        twice = next(key for i, (key, _) in enumerate(pairs) if key in dict(pairs[:i]))
        raise ValueError(f"{quote(repr(twice), 40)} occurs twice")
    return found


def _finite(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError(f"{quote(digits, 20)} is not finite")
    return value


def _int64(digits: str) -> int:
    if len(digits) > 19:
        raise ValueError(f"{quote(digits, 20)} is too large a number")
    return int(digits)


FINITE = {"parse_constant": _finite, "parse_float": _finite, "parse_int": _int64}


def check_ply_counts(header: Sequence[str], size: int) -> None:
    """Check the counts in a PLY header against the `size` [bytes] of the data after it.

    Raises ValueError if the data are too short, and for list properties.
    """
    ascii_file = any(line.split()[:2] == ["format", "ascii"] for line in header)
    needed, count = 0, 0
    for line in header:
        words = line.split()
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdecimal() or len(words[2]) > 15:
                raise ValueError(f"its header has the line {quote(line)}")
            count = int(words[2])
        elif words[:1] == ["property"] and len(words) > 1:
            if words[1] == "list":
                raise ValueError("it has lists, as meshes do")
            needed += count * (2 if ascii_file else PLY_WIDTHS.get(words[1], 4))
    if needed > size + 1:
        raise ValueError(f"its header declares {needed} bytes or more; it has {size}")
