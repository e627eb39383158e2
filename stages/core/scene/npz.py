"""Read NPZ files, checking the sizes of arrays before memory is allocated."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from stages.core.errors import InputError
from stages.core.scene.files import must_exist
from stages.core.scene.schema import MAX_DEFLATE_RATIO, quote, reason

MAX_BYTES = 16 << 30  # maximum size of all arrays together [bytes]


def read_npz(path: Path, what: str) -> dict[str, np.ndarray]:
    """The arrays of an NPZ file by name; errors say that `what` is expected.

    Raises InputError for other and damaged files, Python objects, and numbers that are not finite.
    """
    must_exist(path, what)
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(info.file_size for info in archive.infolist()) > min(MAX_BYTES, MAX_DEFLATE_RATIO * _size(path)):
                raise ValueError("it declares more bytes than it can hold")
            for info in archive.infolist():
                with archive.open(info) as file:
                    _check_header(file, info)
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except Exception as error:  # zipfile, its decompressors and NumPy's parser raise errors of almost any type
        raise InputError(f"{path}: is not an NPZ file ({reason(error)}); {what} is expected") from error
    for name, array in arrays.items():
        if array.dtype.kind not in "biufU" or array.dtype.kind == "f" and not np.isfinite(array).all():
            raise InputError(f"{path}: {quote(name)} has values that are not finite numbers; {what} is expected")
    return arrays


def _size(path: Path) -> int:
    return Path(path).stat().st_size


def _check_header(file: zipfile.ZipExtFile, info: zipfile.ZipInfo) -> None:
    """Raise ValueError if an array of the declared shape is larger than its stored data."""
    version = np.lib.format.read_magic(file)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(file)
    count = 1
    for side in shape:
        count *= side
    if dtype.hasobject or count * dtype.itemsize + 10 > info.file_size or min(shape, default=0) < 0:
        raise ValueError(f"{info.filename} declares {count} values, but has {info.file_size} bytes")
