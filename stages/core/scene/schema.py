"""Checks of what a file holds, made before memory is taken for it; each reader adds the table of its own format.

They raise ValueError, which the reader turns into an InputError with the name of the file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

MAX_JSON_BYTES, MAX_JSON_DEPTH = 256 << 20, 100
MAX_COMPRESSION = 1100  # deflate reaches 1032
MAX_OBJECT_ID = 65535  # label images have 16 bits
LARGEST = 1e9  # of coordinates and sizes [scene units]; squares stay far from the limit of float32
MAX_QUOTED = 80
Bound = int | float
PLY_WIDTHS = {"char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2,
              "double": 8, "float64": 8}  # bytes; the others have 4  # fmt: skip


def quote(text: object, limit: int = MAX_QUOTED) -> str:
    """Text of a user's file for a message: printable, on one line, at most `limit` characters."""
    line = "".join(c if c.isprintable() else "?" for c in str(text)[: limit + 1])
    return line if len(line) <= limit else f"{line[: limit - 3]}..."


def reason(error: Exception) -> str:
    """What an exception says, for a message: its type where that is needed to understand it, and its text."""
    return quote(repr(error) if isinstance(error, KeyError) else error, 120)


def number(value: object, what: str, low: Bound = -LARGEST, high: Bound = LARGEST) -> float:
    """A finite number between two bounds; ValueError, with `what` it is, for anything else."""
    kinds = (int, float, np.integer, np.floating)
    if isinstance(value, bool) or not isinstance(value, kinds) or not low <= value <= high:
        raise ValueError(f"{what} is {quote(repr(value), 40)}, not a number from {low:g} to {high:g}")
    return float(value)


def numbers(values: object, count: int, what: str, low: Bound = -LARGEST, high: Bound = LARGEST) -> tuple[float, ...]:
    """A list of `count` such numbers."""
    if isinstance(values, (str, bytes, dict)) or not hasattr(values, "__len__") or len(values) != count:
        raise ValueError(f"{what} is {quote(repr(values), 40)}, not {count} numbers")
    return tuple(number(value, what, low, high) for value in values)


def parse_json(text: str, finite: bool = True) -> object:
    """The value of a JSON text of bounded depth; `finite` refuses NaN, infinities and integers beyond 64 bits."""
    try:
        value = json.loads(text, **(FINITE if finite else {}))
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
    """The value of a JSON file (UTF-8) of bounded size and depth."""
    size = Path(path).stat().st_size
    if size > MAX_JSON_BYTES:
        raise ValueError(f"it has {size >> 20} MB; at most {MAX_JSON_BYTES >> 20} are read")
    return parse_json(Path(path).read_text(encoding="utf-8"))


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{quote(text, 20)} is not finite")
    return value


def _int64(text: str) -> int:
    if len(text) > 19:
        raise ValueError(f"{quote(text, 20)} is too large a number")
    return int(text)


FINITE = {"parse_constant": _finite, "parse_float": _finite, "parse_int": _int64}


@dataclass(frozen=True)
class Dataset:
    """What an HDF5 dataset must be; its lengths are numbers, or letters that stand for the same number in all."""

    shape: str
    kind: str = "float"  # float (of any width, or integers), int or text
    low: Bound = -LARGEST
    high: Bound = LARGEST

    def open(self, file: h5py.File, name: str, lengths: dict[str, int]) -> h5py.Dataset:
        """The dataset, checked but for its values; adds new letters to `lengths`. KeyError where there is none."""
        parts = name.split("/")
        for i in range(len(parts)):  # a soft link may be a loop, and an external one names any file of the machine
            link = file.get("/".join(parts[: i + 1]), getlink=True)
            if link is None:
                raise KeyError(name)
            if not isinstance(link, h5py.HardLink):
                raise ValueError(f"{name} is a link")
        data = file[name]
        if not isinstance(data, h5py.Dataset) or data.is_virtual or data.external or data.shape is None:
            raise ValueError(f"{name} is not a dataset with values of its own")
        expected = tuple(lengths.get(s, -1) if s.isalpha() else int(s) for s in self.shape.split())
        fits = len(expected) == len(data.shape) and all(e in (-1, s) for e, s in zip(expected, data.shape, strict=True))
        if not fits:
            wanted = ", ".join(str(lengths.get(s, s)) for s in self.shape.split())
            raise ValueError(f"{name} has shape {data.shape}; the other datasets need ({wanted})")
        text = h5py.check_string_dtype(data.dtype) is not None
        kind = "text" if text else data.dtype.kind
        if kind not in {"float": ("f", "i", "u"), "int": ("i", "u"), "text": ("text",)}[self.kind]:
            raise ValueError(f"{name} has values of type {quote(data.dtype, 40)}, not {self.kind}")
        stored = data.id.get_storage_size()
        if data.size * data.dtype.itemsize > MAX_COMPRESSION * stored + 4096:
            raise ValueError(f"{name} declares {data.size} values, but the file stores only {stored} bytes of them")
        lengths.update({s: n for s, n in zip(self.shape.split(), data.shape, strict=True) if s.isalpha()})
        return data

    def read(self, file: h5py.File, name: str, lengths: dict[str, int]) -> np.ndarray | list[str]:
        """The values as float32, int64 or text; ValueError where one is not finite or out of range."""
        data = self.open(file, name, lengths)
        if self.kind == "text":
            return [str(s) for s in data.asstr(errors="replace")[()]]
        return self.checked(data[()], name)

    def checked(self, values: np.ndarray, name: str) -> np.ndarray:
        """Values in native byte order, float32 or int64; ValueError where one is not finite or out of range."""
        if values.dtype.kind == "f" and values.dtype.itemsize < 4:
            values = values.astype(np.float32)
        if not ((values >= self.low) & (values <= self.high)).all():  # false for NaN
            why = "some are not finite" if not np.isfinite(values).all() else "out of range"
            raise ValueError(f"{name} must be from {self.low:g} to {self.high:g}; {why}")
        return np.ascontiguousarray(values, np.float32 if self.kind == "float" else np.int64)


def check_ply_counts(header: Sequence[str], size: int) -> None:
    """Compare the counts that the lines of a PLY header declare with the bytes that follow it; no lists."""
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
