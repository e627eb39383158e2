"""Multithreaded compression and decompression of HDF5 datasets; HDF5 itself uses one thread.

The files are those that HDF5 writes with its filters shuffle (the first bytes of all values, then the second ones, and
so on) and gzip: chunks are encoded and decoded here, and written and read unfiltered (direct chunk I/O). ISA-L
compresses what is stored here some ten times as fast as zlib, to the same format.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import h5py
import numpy as np
import torch
from isal import isal_zlib

LEVEL = 2  # of ISA-L, 0 to 3; what HDF5 itself compresses has zlib's level of this number
COMPRESSED = {"compression": "gzip", "compression_opts": LEVEL, "shuffle": True}
CHUNK_BYTES = 1 << 18
FILTERS = (h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE)


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
    """Append rows to a dataset that is COMPRESSED in chunks of one row."""
    first = len(data)
    data.resize(first + len(rows), axis=0)
    _write_chunks(data, first, np.split(rows.astype(data.dtype, copy=False), len(rows)))


def read_compressed(data: h5py.Dataset) -> np.ndarray:
    """All values of a dataset; OSError if a chunk is damaged."""
    if data.chunks is None or data.dtype.kind not in "fiu" or filters_of(data) != FILTERS or not data.size:
        return data[()]
    infos = [data.id.get_chunk_info(i) for i in range(data.id.get_num_chunks())]
    if any(info.filter_mask for info in infos):
        return data[()]
    out, chunks, dtype = np.full(data.shape, data.fillvalue, data.dtype), data.chunks, data.dtype

    # h5py is called from this thread only: with several threads its lock can deadlock (h5py issue 2920).
    def place(chunk: tuple[tuple[int, ...], bytes]) -> None:
        offset, stored = chunk
        part = out[tuple(slice(a, a + b) for a, b in zip(offset, chunks, strict=True))]
        part[...] = _decoded(stored, chunks, dtype)[tuple(slice(0, s) for s in part.shape)]

    _in_threads(place, [(info.chunk_offset, data.id.read_direct_chunk(info.chunk_offset)[1]) for info in infos])
    return out


def _write_chunks(data: h5py.Dataset, first: int, chunks: list[np.ndarray]) -> None:
    zeros = (0,) * (data.ndim - 1)
    for i, chunk in enumerate(_in_threads(_encoded, chunks)):
        data.id.write_direct_chunk((first + i * data.chunks[0], *zeros), chunk)


def _encoded(values: np.ndarray) -> bytes:
    """A chunk as stored."""
    shuffled = np.ascontiguousarray(values).view(np.uint8).reshape(-1, values.itemsize).T.tobytes()
    return isal_zlib.compress(shuffled, LEVEL)


def _decoded(stored: bytes, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """The values of a stored chunk; OSError if it is damaged."""
    size = int(np.prod(shape)) * dtype.itemsize
    try:
        raw = isal_zlib.decompressobj().decompress(stored, size + 1)
    except isal_zlib.error as error:
        raise OSError(f"a damaged chunk: {error}") from error
    if len(raw) != size:
        raise OSError("a damaged chunk: its size is wrong")
    return np.frombuffer(raw, np.uint8).reshape(dtype.itemsize, -1).T.copy().view(dtype).reshape(shape)


def filters_of(data: h5py.Dataset) -> tuple[int, ...]:
    """Identifiers of the filters of a dataset, in the order in which they are applied."""
    properties = data.id.get_create_plist()
    return tuple(properties.get_filter(i)[0] for i in range(properties.get_nfilters()))


def _in_threads(function: Callable, items: Iterable) -> list[Any]:
    """Results of a function for items, in order, by as many threads as PyTorch uses."""
    count = min(torch.get_num_threads(), len(items))
    if count <= 1:
        return [function(item) for item in items]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(function, items))
