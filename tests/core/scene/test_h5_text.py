"""Texts of variable length are read as by HDF5; damaged ones are refused before HDF5 allocates memory for them."""

import struct
import zlib

import h5py
import numpy as np
import pytest

from stages.core.scene.h5_schema import Dataset, open_h5
from stages.core.scene.h5_text import check_attributes, check_texts

NAMES = ["", "duck", "bowl ä", "x" * 300, "y"]
STORED = [{}, {"chunks": (2,)}, {"chunks": (2,), "maxshape": (None,)}, {"compression": "gzip"},
          {"compression": "gzip", "shuffle": True}]  # fmt: skip


def write(path, libver="earliest", **stored):
    """Write texts to a dataset and to many attributes, with headers of the old or the new version.

    "tracked" also stores the order in which the attributes were created.
    """
    tracked = libver == "tracked"
    with h5py.File(path, "w", libver="latest" if tracked else libver, track_order=tracked) as file:
        for i in range(6):  # more would not fit into a header of the new version
            file.attrs[f"{i}"] = "attribute " + i * "z"
        file.attrs["matrix"], file.attrs["list"] = np.eye(3), ["a", "bc", ""]
        file.create_dataset("names", data=NAMES, dtype=h5py.string_dtype(), **stored)
        file["names"].attrs["unit"] = "none"


@pytest.mark.parametrize("stored", STORED, ids=str)
@pytest.mark.parametrize("libver", ["earliest", "latest", "tracked"])
def test_sound_texts_are_read(tmp_path, stored, libver):
    write(tmp_path / "a.h5", libver, **stored)
    with open_h5(tmp_path / "a.h5") as file:
        assert Dataset("n", "text").read(file, "names", {}) == NAMES
        check_attributes(file["names"])
        assert file.attrs["5"] == "attribute zzzzz" and list(file.attrs["list"]) == ["a", "bc", ""]


def test_datasets_that_store_nothing_and_texts_of_fixed_length_are_read(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("names", (2,), h5py.string_dtype())
        file.create_dataset("fixed", data=np.array([b"ab", b"c"]))
    with open_h5(tmp_path / "a.h5") as file:
        assert Dataset("n", "text").read(file, "names", {}) == ["", ""]
        assert Dataset("n", "text").read(file, "fixed", {}) == ["ab", "c"]


def test_texts_of_other_filters_and_files_within_others_are_refused(tmp_path):
    write(tmp_path / "a.h5", compression="lzf")
    with pytest.raises(ValueError, match="its texts are compressed by another filter than gzip"):
        reread(tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w", userblock_size=512) as file:
        file.attrs["name"] = "duck"
    with pytest.raises(ValueError, match="it begins with a user block, of another format"), open_h5(tmp_path / "b.h5"):
        pass


def test_compressed_texts_of_another_length_are_refused(tmp_path):
    """A chunk of 5 references, 4 of which are stored."""
    write(tmp_path / "a.h5", compression="gzip")
    with h5py.File(tmp_path / "a.h5", "a") as file:
        names = file["names"]
        part = zlib.decompress(names.id.read_direct_chunk((0,))[1])
        names.id.write_direct_chunk((0,), zlib.compress(part[:-16]))
    with pytest.raises(ValueError, match="its texts are damaged"):
        reread(tmp_path / "a.h5")


def test_texts_within_an_object_header_are_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_layout(h5py.h5d.COMPACT)
        kind = h5py.h5t.py_create(h5py.string_dtype(), logical=True)
        h5py.h5d.create(file.id, b"names", kind, h5py.h5s.create_simple((2,)), layout)
        file["names"][:] = ["a", "bc"]
    with pytest.raises(ValueError, match="its texts are stored in an object header"):
        reread(tmp_path / "a.h5")


def reread(path):
    with open_h5(path) as file:
        check_attributes(file["names"])
        Dataset("n", "text").read(file, "names", {})


@pytest.mark.parametrize("libver", ["earliest", "latest", "tracked"])
@pytest.mark.parametrize("length", [len("duck"), len("attribute z"), len("none")], ids=["dataset", "file", "item"])
def test_a_text_longer_than_its_heap_has_is_refused(tmp_path, libver, length):
    path = tmp_path / "a.h5"
    write(path, libver)
    data = path.read_bytes()
    heaps = [at for at in range(len(data)) if data[at : at + 4] == b"GCOL"]
    places = [at for heap in heaps for at in all_of(data, struct.pack("<IQ", length, heap))]
    assert places
    for at in places:
        path.write_bytes(data)
        with h5py.File(path) as file:
            names = file["names"]  # the checksums of headers of the new version have been verified here
            path.write_bytes(data[:at] + struct.pack("<I", 3 << 30) + data[at + 4 :])
            with pytest.raises(ValueError, match="a text of 3221225472 bytes is not in the file"):
                check_attributes(file)
                check_attributes(names)
                check_texts(names)


@pytest.mark.parametrize("libver", ["earliest", "latest", "tracked"])
def test_attributes_that_are_neither_numbers_nor_texts_are_refused(tmp_path, libver):
    path = tmp_path / "a.h5"
    for value in (1, 2.5, "duck", b"duck", True, [1.0, 2.0], ["a", "b"]):
        write(path, libver)
        with h5py.File(path, "a") as file:
            file["names"].attrs["more"] = value
        reread(path)
    sequence, compound = np.empty(1, h5py.vlen_dtype(np.int64)), np.zeros(1, [("x", "f4"), ("y", "i4")])
    sequence[0] = np.arange(3)
    for value, committed in ((sequence, False), (compound, False), (np.zeros(1, "f4"), True)):
        write(path, libver)
        with h5py.File(path, "a") as file:
            file["type"] = value.dtype
            file["names"].attrs.create("more", value, dtype=file["type"] if committed else value.dtype)
        with pytest.raises(ValueError, match="damaged" if committed else "neither a number nor a text"):
            reread(path)


def all_of(data, part):
    return [at for at in range(len(data)) if data.startswith(part, at)]


@pytest.mark.parametrize(("offset", "value"), [(8, 1 << 40), (8, 1 << 63), (0, 0)])
def test_a_damaged_heap_is_refused(tmp_path, offset, value):
    path = tmp_path / "a.h5"
    write(path)
    data = path.read_bytes()
    at = data.index(b"GCOL") + offset
    path.write_bytes(data[:at] + struct.pack("<Q", value) + data[at + 8 :])
    with pytest.raises(ValueError, match="its texts are damaged"):
        reread(path)


def test_free_space_of_no_length_in_a_heap_is_refused(tmp_path):
    """HDF5 2.0 would read it in an infinite loop."""
    path = tmp_path / "a.h5"
    write(path)
    data = path.read_bytes()
    at = data.index(b"GCOL") + 16
    path.write_bytes(data[:at] + bytes(16) + data[at + 16 :])
    with pytest.raises(ValueError, match="its texts are damaged"):
        reread(path)


@pytest.mark.parametrize("where", ["itself", "outside"])
def test_a_header_that_continues_in_itself_or_outside_the_file_is_refused(tmp_path, where):
    path = tmp_path / "a.h5"
    write(path)
    data = path.read_bytes()
    with h5py.File(path) as file:
        at = h5py.h5o.get_info(file.id).addr
        to = at + 16 if where == "itself" else len(data) + 1000
        message = struct.pack("<HHI", 0x10, 16, 0) + struct.pack("<QQ", to, 24)
        path.write_bytes(data[: at + 16] + message + data[at + 40 :])
        why = "its object header has too many parts" if where == "itself" else "a part of it is outside the file"
        with pytest.raises(ValueError, match=why):  # HDF5 has read the header before
            check_attributes(file)
    with pytest.raises((ValueError, OSError)):
        reread(path)


@pytest.mark.parametrize("options", [{}, {"compression": "gzip"}, {"compression": "lzf"}])
def test_a_chunk_of_gigabytes_is_refused(tmp_path, options):
    side = (64 << 20) // 4 + 1  # 64 MiB of floats, and one more
    with h5py.File(tmp_path / "a.h5", "w") as file:
        properties = {"maxshape": (None,), "chunks": (side,), **options}
        file.create_dataset("x", (3,), "f4", **properties)
        file.create_dataset("y", (3,), "f4", **{**properties, "chunks": (side - 1,)})
    with open_h5(tmp_path / "a.h5") as file:
        with pytest.raises(ValueError, match="x has chunks of"):
            Dataset("n").read(file, "x", {})
        assert not Dataset("n").read(file, "y", {}).any()
