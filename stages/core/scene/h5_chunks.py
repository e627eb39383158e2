"""Multithreaded compression and decompression of HDF5 datasets; HDF5 itself uses one thread.

The files are the same as HDF5 writes with its filters shuffle (the first bytes of all values, then the second bytes,
and so on) and gzip. Chunks are encoded and decoded here, and written and read with direct chunk I/O, which bypasses the
filters. ISA-L compresses our data about ten times as fast as zlib, to the same format. HDF5 does not limit the size to
which a chunk decompresses, which may be a decompression bomb, so chunks that HDF5 decodes must be checked first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import h5py
import numpy as np
import torch
from isal import isal_zlib

LEVEL = 2  # compression level of ISA-L, 0 to 3, and of zlib where HDF5 itself compresses
COMPRESSED = {"compression": "gzip", "compression_opts": LEVEL, "shuffle": True}
CHUNK_BYTES = 1 << 18
SHUFFLE, GZIP, CHECKSUM = h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_FLETCHER32
READABLE = {SHUFFLE, GZIP, CHECKSUM, h5py.h5z.FILTER_LZF}


def write_compressed(file: h5py.File, name: str, values: np.ndarray) -> None:
    """Create a dataset with these values, in chunks of rows."""
    rows = max(1, CHUNK_BYTES * len(values) // max(values.nbytes, 1))
    if len(values) <= rows:  # one chunk
        file.create_dataset(name, data=values, **COMPRESSED)
        return
    data = file.create_dataset(name, values.shape, values.dtype, chunks=(rows, *values.shape[1:]), **COMPRESSED)
    padded = np.concatenate([values, np.zeros((-len(values) % rows, *values.shape[1:]), values.dtype)])
    _write_chunks(data, 0, np.split(padded, len(padded) // rows))


def append_rows(data: h5py.Dataset, rows: np.ndarray) -> None:
    """Append rows to a dataset that was created with COMPRESSED and chunks of one row."""
    first = len(data)
    data.resize(first + len(rows), axis=0)
    _write_chunks(data, first, np.split(rows.astype(data.dtype, copy=False), len(rows)))


def read_compressed(data: h5py.Dataset, row: int | None = None) -> np.ndarray:
    """All values of a dataset, or one row of a dataset with several axes. Raises OSError if a chunk is damaged."""
    if not decoded_here(data) or not data.size:
        return data[() if row is None else row]
    filters, chunks, dtype = filters_of(data), data.chunks, data.dtype
    first, rows = (0, len(data)) if row is None else (row, 1)
    out = np.full((rows, *data.shape[1:]), data.fillvalue, dtype)

    # h5py is called only from this thread, because its lock can deadlock with several threads (h5py issue 2920)
    def place(chunk: tuple[tuple[int, ...], list[int], bytes]) -> None:
        (above, *others), used, stored = chunk
        values = _decoded(stored, used, chunks, dtype)
        part = out[(slice(max(above - first, 0), max(above + chunks[0] - first, 0)),
                    *(slice(a, a + b) for a, b in zip(others, chunks[1:], strict=True)))]  # fmt: skip
        values = values[max(first - above, 0) :]
        part[...] = values[tuple(slice(0, s) for s in part.shape)]

    infos = [i for i in chunks_of(data) if first - chunks[0] < i.chunk_offset[0] < first + rows]
    _in_threads(place, [(info.chunk_offset, used_filters(filters, info),
                         data.id.read_direct_chunk(info.chunk_offset)[1]) for info in infos])  # fmt: skip
    return out if row is None else out[0]


def decoded_here(data: h5py.Dataset) -> bool:
    """Whether `read_compressed` decodes the chunks of a dataset itself."""
    return data.chunks is not None and data.dtype.kind in "fiu" and filters_of(data) in ((GZIP,), (SHUFFLE, GZIP))


def check_chunks(data: h5py.Dataset) -> None:
    """Raise OSError if a gzip chunk that HDF5 will decode is damaged, or decompresses to more than its values.

    Variable-length strings are not checked here, but by `h5_text.check_texts`.
    """
    filters = filters_of(data)
    if GZIP not in filters or data.dtype.kind == "O":
        return
    size = int(np.prod(data.chunks)) * data.dtype.itemsize
    for info in chunks_of(data):
        used = used_filters(filters, info)
        while used and used[-1] == CHECKSUM:  # it only appends four bytes
            used.pop()
        if GZIP in used[:-1]:
            raise OSError("a chunk is compressed by other filters after gzip")
        if used and used[-1] == GZIP:
            _inflated(data.id.read_direct_chunk(info.chunk_offset)[1], size)


def chunks_of(data: h5py.Dataset) -> list[h5py.h5d.StoreInfo]:
    """Index, file offset and size of the stored chunks of a dataset, in time linear in their number."""
    found: list[h5py.h5d.StoreInfo] = []
    data.id.chunk_iter(found.append)
    return found


def _write_chunks(data: h5py.Dataset, first: int, chunks: list[np.ndarray]) -> None:
    zeros = (0,) * (data.ndim - 1)
    for i, chunk in enumerate(_in_threads(_encoded, chunks)):
        data.id.write_direct_chunk((first + i * data.chunks[0], *zeros), chunk)


def _encoded(values: np.ndarray) -> bytes:
    """A chunk as stored in the file: shuffled and compressed."""
    shuffled = np.ascontiguousarray(values).view(np.uint8).reshape(-1, values.itemsize).T.tobytes()
    return isal_zlib.compress(shuffled, LEVEL)


def _decoded(stored: bytes, used: list[int], shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Decode a chunk to which the filters `used` (shuffle, gzip) were applied. Raises OSError if it is damaged."""
    size = int(np.prod(shape)) * dtype.itemsize
    raw = _inflated(stored, size) if GZIP in used else stored
    if len(raw) != size:
        raise OSError("a damaged chunk: its size is wrong")
    values = np.frombuffer(raw, np.uint8)
    if SHUFFLE in used:
        values = values.reshape(dtype.itemsize, -1).T.copy()
    return values.view(dtype).reshape(shape)


def _inflated(stored: bytes, size: int) -> bytes:
    """Decompress a chunk. Raises OSError if it is damaged, or decompresses to more than `size` bytes."""
    try:
        raw = isal_zlib.decompressobj().decompress(stored, size + 1)
    except isal_zlib.error as error:
        raise OSError(f"a damaged chunk: {error}") from error
    if len(raw) > size:
        raise OSError("a damaged chunk: its size is wrong")
    return raw


def filters_of(data: h5py.Dataset) -> tuple[int, ...]:
    """Identifiers of the filters of a dataset, in the order in which they are applied."""
    properties = data.id.get_create_plist()
    return tuple(properties.get_filter(i)[0] for i in range(properties.get_nfilters()))


def used_filters(filters: tuple[int, ...], info: h5py.h5d.StoreInfo) -> list[int]:
    """The filters of a dataset that are applied to this chunk."""
    return [code for i, code in enumerate(filters) if not info.filter_mask >> i & 1]


def _in_threads(function: Callable, items: Iterable) -> list[Any]:
    """Map a function over items with as many threads as PyTorch uses; results are in order."""
    count = min(torch.get_num_threads(), len(items))
    if count <= 1:
        return [function(item) for item in items]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(function, items))
