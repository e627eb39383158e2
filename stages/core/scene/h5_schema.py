"""Checks of HDF5 datasets and attributes; separate from schema.py, so that only readers of trajectories import h5py."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from stages.core.scene.h5_chunks import READABLE, check_chunks, decoded_here, filters_of, read_compressed
from stages.core.scene.h5_text import check_attributes, check_texts
from stages.core.scene.schema import LARGEST, MAX_DEFLATE_RATIO, Bound, quote

MAX_CHUNK = 64 << 20  # size up to which a chunk is accepted, however little the file stores [bytes]


@contextmanager
def open_h5(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file and check the strings in its attributes. Raises ValueError and the errors of h5py."""
    with h5py.File(path, "r") as file:
        check_attributes(file)
        yield file


def find_link(file: h5py.File, name: str) -> h5py.HardLink | h5py.SoftLink | h5py.ExternalLink | None:
    """The link of this name, or the first link on its path that is not a hard link; None if the file has none.

    Unlike `name in file`, this follows no links: soft links may be cyclic, and external links may refer to any file of
    the machine, or to a pipe, on which HDF5 blocks.
    """
    parts = name.split("/")
    for i in range(len(parts)):
        link = file.get("/".join(parts[: i + 1]), getlink=True)
        if not isinstance(link, h5py.HardLink):
            break
    return link


def attribute(item: h5py.Group | h5py.Dataset, name: str, *default: object) -> object:
    """The value of an attribute, or `default`. Raises KeyError if it is absent and there is no default.

    Fixed-length strings become str and one-element arrays their element, because programs in C and MATLAB write these.
    """
    if name not in item.attrs:
        if not default:
            raise KeyError(f"attribute {name}")
        return default[0]
    value = item.attrs[name]
    value = value.item() if isinstance(value, (np.ndarray, np.generic)) and value.size == 1 else value
    return value.decode(errors="replace") if isinstance(value, bytes) else value


@dataclass(frozen=True)
class Dataset:
    """Expected shape, type and range of a dataset. A letter in the shape stands for the same length in all datasets."""

    shape: str  # letters and numbers separated by spaces, such as "n 3"
    kind: str = "float"  # float (of any width, or integers), int or text
    low: Bound = -LARGEST
    high: Bound = LARGEST

    def open(self, file: h5py.File, name: str, lengths: dict[str, int]) -> h5py.Dataset:
        """Open the dataset, check its shape and type, and add new letters to `lengths`.

        Raises KeyError if it is absent, and ValueError if it is not as expected.
        """
        link = find_link(file, name)
        if link is None:
            raise KeyError(name)
        if not isinstance(link, h5py.HardLink):
            raise ValueError(f"{name} is a link")
        data = file[name]
        if not isinstance(data, h5py.Dataset) or data.is_virtual or data.external or data.shape is None:
            raise ValueError(f"{name} is not a dataset with values of its own")
        data.id.get_create_plist().fill_value_defined()  # ValueError for a damaged fill value, which would crash HDF5
        expected = tuple(lengths.get(s, -1) if s.isalpha() else int(s) for s in self.shape.split())
        fits = len(expected) == len(data.shape) and all(e in (-1, s) for e, s in zip(expected, data.shape, strict=True))
        if not fits:
            wanted = ", ".join(str(lengths.get(s, s)) for s in self.shape.split())
            raise ValueError(f"{name} has shape {data.shape}; the other datasets need ({wanted})")
        text = h5py.check_string_dtype(data.dtype) is not None
        kind = "text" if text else data.dtype.kind
        if kind not in {"float": ("f", "i", "u"), "int": ("i", "u"), "text": ("text",)}[self.kind]:
            raise ValueError(f"{name} has values of type {quote(data.dtype, 40)}, not {self.kind}")
        stored = min(data.id.get_storage_size(), file.id.get_filesize())  # a damaged index may overstate the former
        if data.size * data.dtype.itemsize > MAX_DEFLATE_RATIO * stored + 4096:
            raise ValueError(f"{name} declares {data.size} values, but the file stores only {stored} bytes of them")
        if data.chunks and math.prod(data.chunks) * data.dtype.itemsize > max(MAX_DEFLATE_RATIO * stored, MAX_CHUNK):
            raise ValueError(f"{name} has chunks of {data.chunks} values, but the file stores only {stored} bytes")
        for code in filters_of(data):
            if code not in READABLE:
                raise ValueError(f"{name} is stored with filter {code} of HDF5, which is not read; write it with gzip")
        if not decoded_here(data):
            check_chunks(data)
        lengths.update({s: n for s, n in zip(self.shape.split(), data.shape, strict=True) if s.isalpha()})
        return data

    def read(self, file: h5py.File, name: str, lengths: dict[str, int]) -> np.ndarray | list[str]:
        """Read the values as float32, int64 or strings. Raises ValueError if one is not finite or out of range."""
        data = self.open(file, name, lengths)
        if self.kind == "text":
            if h5py.check_string_dtype(data.dtype).length is None:
                check_texts(data)
            return [str(s) for s in data.asstr(errors="replace")[()]]
        return self.checked(read_compressed(data), name)

    def checked(self, values: np.ndarray, name: str) -> np.ndarray:
        """Values as float32 or int64 in native byte order. Raises ValueError if one is not finite or out of range."""
        if values.dtype.kind == "f" and values.dtype.itemsize < 4:
            values = values.astype(np.float32)
        if not ((values >= self.low) & (values <= self.high)).all():  # false for NaN
            why = "some are not finite" if not np.isfinite(values).all() else "out of range"
            raise ValueError(f"{name} must be from {self.low:g} to {self.high:g}; {why}")
        return np.ascontiguousarray(values, np.float32 if self.kind == "float" else np.int64)
