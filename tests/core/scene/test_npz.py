"""Arrays of NPZ files, and damaged archives, each of which causes one clear error."""

import io
import struct
import zipfile

import numpy as np
import pytest

from stages.core.errors import InputError
from stages.core.scene.npz import read_npz


def saved(save=np.savez, **arrays):
    file = io.BytesIO()
    save(file, **arrays)
    return file.getvalue()


ARRAYS = {"a": np.arange(60, dtype="f4").reshape(3, 20), "b": np.array(2), "c": np.array(["x", "yz"])}


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_are_those_saved(tmp_path, save):
    (tmp_path / "x.npz").write_bytes(saved(save, **ARRAYS))
    found = read_npz(tmp_path / "x.npz", "a recording")
    assert found.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(found[name], array)


def archive(content, name="a.npy", kind=zipfile.ZIP_STORED):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", kind) as made:
        made.writestr(name, content)
    return file.getvalue()


def replaced(data, offset, new, signatures=((b"PK\x03\x04", 0), (b"PK\x01\x02", 2))):
    """An archive with a changed field of its entry, also changed in the directory, where its offset is 2 larger."""
    for signature, later in signatures:
        at = data.index(signature) + offset + later
        data = data[:at] + new + data[at + len(new) :]
    return data


def array(header, data=b"", version=b"\x01\x00"):
    return b"\x93NUMPY" + version + struct.pack("<H", len(header)) + header + data


STORED, LARGE = saved(a=np.zeros(100)), saved(np.savez_compressed, a=np.zeros(10000))
HEADER = b"{'descr': '<f8', 'fortran_order': False, 'shape': %s, }\n"
BZIP2, LZMA = (archive(array(HEADER % b"(9,)", bytes(72)), kind=kind) for kind in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))
DAMAGED = {
    "no archive": b"nonsense" * 20,
    "unknown compression": replaced(STORED, 8, struct.pack("<H", 99)),
    "implode": replaced(STORED, 8, struct.pack("<H", 6)),
    "bzip2 of no data": replaced(STORED, 8, struct.pack("<H", zipfile.ZIP_BZIP2)),
    "lzma of no data": replaced(STORED, 8, struct.pack("<H", zipfile.ZIP_LZMA)),
    "deflate of no data": replaced(STORED, 8, struct.pack("<H", zipfile.ZIP_DEFLATED)),
    "damaged bzip2": BZIP2[:50] + b"\xff" * 20 + BZIP2[70:],
    "damaged lzma": LZMA[:50] + b"\xff" * 20 + LZMA[70:],
    "encrypted": replaced(STORED, 6, struct.pack("<H", 1)),
    "patched data": replaced(STORED, 6, struct.pack("<H", 32)),
    "strong encryption": replaced(STORED, 6, struct.pack("<H", 65)),
    "a newer version": replaced(STORED, 4, struct.pack("<H", 99)),
    "a wrong checksum": replaced(STORED, 14, b"abcd"),
    "a wrong name": replaced(STORED, 30, b"z", ((b"PK\x03\x04", 0),)),
    "cut in the middle": STORED[: len(STORED) // 2],
    "cut before its end": STORED[:-4],
    "a damaged stream": LARGE[:80] + b"\xff" * 30 + LARGE[110:],
    "a directory elsewhere": STORED[:-6] + struct.pack("<I", 1 << 31) + STORED[-2:],
    "a size of terabytes": replaced(LARGE, 22, b"\xff\xff\xff\x7f"),
    "an array of terabytes": archive(array(HEADER % b"(1000000000000,)", bytes(800))),
    "an array of 10^400 values": archive(array(HEADER % (b"(" + b"10000," * 100 + b")"), bytes(800))),
    "a negative shape": archive(array(HEADER % b"(-4,)", bytes(800))),
    "a shape of text": archive(array(HEADER % b"('a',)", bytes(800))),
    "no header": archive(array(b"import os\n", bytes(800))),
    "a header of another version": archive(array(HEADER % b"(1,)", bytes(8), b"\x07\x00")),
    "a header nested deeply": archive(array(b"(" * 9000 + b"\n", bytes(8))),
    "a header that breaks off": archive(b"\x93NUMPY\x01\x00\xff\xffabc"),
    "no array": archive(b"some text", "a.txt"),
    "objects": saved(a=np.array([{}, None], object)),
    "an infinite value": saved(a=np.array([1.0, np.inf])),
    "not a number": saved(np.savez_compressed, a=np.array([np.nan], "f2")),
    "complex numbers": saved(a=np.array([1j])),
    "bytes": saved(a=np.array([b"a"])),
}


@pytest.mark.parametrize("what", DAMAGED)
def test_damaged_archives_are_refused(tmp_path, what):
    (tmp_path / "x.npz").write_bytes(DAMAGED[what])
    with pytest.raises(InputError, match=r"x.npz: .*; a recording is expected") as caught:
        read_npz(tmp_path / "x.npz", "a recording")
    text = str(caught.value).replace(str(tmp_path), "")
    assert text.isprintable() and len(text) < 220


def test_every_byte_changed_or_cut_off_gives_the_arrays_or_one_error(tmp_path):
    data = saved(np.savez_compressed, a=np.arange(6.0), b=np.array(1))
    for i in range(len(data)):
        for changed in (
            data[:i] + bytes([data[i] ^ 0xFF]) + data[i + 1 :],
            data[:i] + b"\x63" + data[i + 1 :],
            data[:i],
        ):
            (tmp_path / "x.npz").write_bytes(changed)
            try:
                found = read_npz(tmp_path / "x.npz", "a recording")
            except InputError:
                continue
            assert all(np.isfinite(a).all() for a in found.values())
