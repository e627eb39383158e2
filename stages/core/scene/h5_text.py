"""Check the variable-length strings in HDF5 files before HDF5 reads them.

HDF5 allocates the length that a string's reference declares before it looks the string up, and loops forever on a
damaged global heap (H5HG__cache_heap_deserialize). A reference has 16 bytes: the length, the address of a heap, and the
index of the string in that heap.
Source: The HDF Group, "HDF5 File Format Specification Version 3.0", III.E, IV.A.1 and IV.A.2.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator

import h5py
import numpy as np

from stages.core.scene.h5_chunks import chunks_of, filters_of, used_filters

ATTRIBUTE, CONTINUATION = 0x0C, 0x10  # message types of an object header
# Datatype classes: numbers, fixed-length strings, and enumerations such as booleans; variable-length strings are
# VARIABLE_LENGTH with the bits TEXT. HDF5 may crash on damaged attributes of other classes; ngff writes none of these.
NUMBER, FLOAT, FIXED_TEXT, ENUMERATION, VARIABLE_LENGTH, TEXT = 0, 1, 3, 8, 9, 1
HEAP = b"GCOL\x01\0\0\0"  # signature and version of a global heap
MAX_BLOCKS = 1000  # maximum number of blocks of an object header


def check_texts(data: h5py.Dataset) -> None:
    """Raise ValueError unless all strings of a variable-length dataset lie within the file, as long as declared."""
    with _FileBytes(data.file) as file:
        for part in _stored(data, file):
            file.check(part)


def check_attributes(item: h5py.Group | h5py.Dataset) -> None:
    """As `check_texts`, for the attributes of a file, group or dataset (object header messages).

    Also raises ValueError for attributes that are neither numbers nor strings.
    """
    with _FileBytes(item.file) as file:
        for attribute in _attributes(file, h5py.h5o.get_info(item.id).addr):
            name, kind, space = (int.from_bytes(attribute[i : i + 2], "little") for i in (2, 4, 6))
            start, to = (8, 8) if attribute[0] == 1 else (9, 1)
            after_name = start + -(-name // to) * to
            values = after_name + -(-kind // to) * to + -(-space // to) * to
            # reject attributes whose type or shape is stored elsewhere, and all of version 2
            if attribute[0] not in (1, 3) or after_name + 1 >= len(attribute) or attribute[1] & 3:
                raise ValueError("an attribute of it is damaged")
            datatype, bits = attribute[after_name] & 15, attribute[after_name + 1] & 15
            if datatype == VARIABLE_LENGTH and bits == TEXT:
                file.check(attribute[values : values + (len(attribute) - values) // 16 * 16])
            elif datatype not in (NUMBER, FLOAT, FIXED_TEXT, ENUMERATION):
                raise ValueError("an attribute of it is neither a number nor a text")


class _FileBytes:
    """Memory map of an open file. Raises ValueError for reads beyond its end."""

    def __init__(self, file: h5py.File):
        if file.userblock_size:
            raise ValueError("it begins with a user block, of another format")
        self._path = file.filename
        self._checked: dict[int, dict[int, int]] = {}  # heap address -> index of a string -> its length

    def __enter__(self) -> _FileBytes:
        with open(self._path, "rb") as file:
            self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        return self

    def __exit__(self, kind, error, trace) -> None:
        self._map.close()

    def read(self, at: int, size: int) -> bytes:
        if at + size > len(self._map):
            raise ValueError("a part of it is outside the file")
        return self._map[at : at + size]

    def number(self, at: int, size: int) -> int:
        return int.from_bytes(self.read(at, size), "little")

    def check(self, references: bytes) -> None:
        """Raise ValueError unless each reference is empty, or no longer than its string in an intact heap."""
        for at in range(0, len(references), 16):
            length, heap, index = struct.unpack_from("<IQI", references, at)
            if length and heap and length > self._lengths(heap).get(index, -1):
                raise ValueError(f"a text of {length} bytes is not in the file")

    def _lengths(self, heap: int) -> dict[int, int]:
        if heap not in self._checked:
            size = self.number(heap + 8, 8)
            if self.read(heap, 8) != HEAP or heap + size > len(self._map):
                raise ValueError("its texts are damaged")
            found, at = {}, heap + 16
            while at + 16 <= heap + size:
                index, length = self.number(at, 2), self.number(at + 8, 8)
                step = length if index == 0 else 16 + -(-length // 8) * 8  # 0: free space, with its header
                if step < 16 or at + step > heap + size:
                    raise ValueError("its texts are damaged")
                found[index] = length
                at += step
            self._checked[heap] = found
        return self._checked[heap]


def _stored(data: h5py.Dataset, file: _FileBytes) -> Iterator[bytes]:
    """Yield the references of a dataset, chunk by chunk; chunks that are not allocated are skipped."""
    if data.id.get_storage_size() == 0:
        return
    if data.chunks is None:
        if (at := data.id.get_offset()) is None:
            raise ValueError("its texts are stored in an object header")
        yield file.read(at, data.size * 16)
        return
    filters, size = filters_of(data), int(np.prod(data.chunks)) * 16
    for info in chunks_of(data):
        part = file.read(info.byte_offset, info.size)
        used = used_filters(filters, info)
        if used == [h5py.h5z.FILTER_DEFLATE]:
            part = zlib.decompressobj().decompress(part, size + 1)
        elif used:  # shuffle does not apply to strings
            raise ValueError("its texts are compressed by another filter than gzip")
        if len(part) != size:
            raise ValueError("its texts are damaged")
        yield part


def _attributes(file: _FileBytes, at: int) -> Iterator[bytes]:
    """Yield the attribute messages of the object header at an address."""
    new = file.read(at, 4) == b"OHDR"  # object header of version 2
    flags = file.number(at + 5, 1) if new else 0
    if new:
        first, width = at + 6 + 16 * bool(flags & 32) + 4 * bool(flags & 16), 1 << (flags & 3)
        blocks, before = [(first + width, file.number(first, width))], 4 + 2 * bool(flags & 4)
    else:
        blocks, before = [(at + 16, file.number(at + 8, 4))], 8
    for start, size in blocks:
        if len(blocks) > MAX_BLOCKS:
            raise ValueError("its object header has too many parts")
        position, end = start, start + size
        while position + before <= end:
            kind, length = file.number(position, 1 if new else 2), file.number(position + (1 if new else 2), 2)
            message = file.read(position + before, length)
            position += before + length
            if kind == ATTRIBUTE and length > 8:
                yield message
            elif kind == CONTINUATION and length >= 16:
                to, more = (int.from_bytes(message[i : i + 8], "little") for i in (0, 8))
                blocks.append((to + 4, more - 8) if new else (to, more))  # version 2: without signature and checksum
