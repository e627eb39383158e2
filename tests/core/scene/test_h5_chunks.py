"""Datasets compressed by our code can be read by HDF5, and vice versa."""

import zlib

import h5py
import numpy as np
import pytest

from stages.core.scene import h5_chunks
from stages.core.scene.h5_chunks import (
    CHUNK_BYTES,
    COMPRESSED,
    append_rows,
    check_chunks,
    decoded_here,
    read_compressed,
    write_compressed,
)

COUNT = CHUNK_BYTES // 12 + 1000  # rows of three floats in two chunks, the second one incomplete
ARRAYS = {
    "floats": np.random.default_rng(0).normal(size=(COUNT, 3)).astype("f4"),
    "harmonics": np.random.default_rng(1).normal(size=(COUNT // 3, 4, 3)).astype("f4"),
    "numbers": np.arange(4 * COUNT).astype("i8"),
    "none": np.zeros((0, 3), "f4"),
    "one": np.ones((1, 8), "i4"),
}


@pytest.mark.parametrize("name", ARRAYS)
def test_both_ways_agree_with_hdf5(tmp_path, name):
    values = ARRAYS[name]
    with h5py.File(tmp_path / "a.h5", "w") as file:
        write_compressed(file, "ours", values)
        file.create_dataset("theirs", data=values, **COMPRESSED)
        file.create_dataset("other", data=values)
        if len(values):
            file.create_dataset("gzip", data=values, compression="gzip")
            file.create_dataset("checked", data=values, compression="gzip", shuffle=True, fletcher32=True)
            file.create_dataset("lzf", data=values, compression="lzf", shuffle=True)
    with h5py.File(tmp_path / "a.h5") as file:
        assert np.array_equal(file["ours"][()], values) and file["ours"].dtype == values.dtype
        for data in file.values():
            check_chunks(data)
            assert np.array_equal(read_compressed(data), values)
            for row in {0, len(values) // 2, len(values) - 1} if len(values) and values.ndim > 1 else ():
                assert np.array_equal(read_compressed(data, row), values[row])
        if values.nbytes > CHUNK_BYTES:  # several chunks are encoded by several threads
            rows = file["ours"].chunks[0]
            assert file["ours"].chunks[1:] == values.shape[1:] and rows == CHUNK_BYTES // values[0].nbytes
        assert file["ours"].id.get_storage_size() < 1.1 * file["theirs"].id.get_storage_size() + 100


def test_rows_are_appended(tmp_path):
    rows = np.random.default_rng(0).normal(size=(5, 7, 3)).astype("f4")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("rows", (0, 7, 3), maxshape=(None, 7, 3), chunks=(1, 7, 3), dtype="f4", **COMPRESSED)
        append_rows(data, rows[:2])
        append_rows(data, rows[2:])
    with h5py.File(tmp_path / "a.h5") as file:
        assert np.array_equal(file["rows"][()], rows) and np.array_equal(read_compressed(file["rows"]), rows)


def test_missing_chunks_hold_the_fill_value_and_damaged_ones_are_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("rows", (4, 3), "f4", chunks=(1, 3), fillvalue=2.0, **COMPRESSED)
        data[1] = 1.0
        assert np.array_equal(read_compressed(data), data[()])
        data.id.write_direct_chunk((2, 0), zlib.compress(bytes(11)))
        with pytest.raises(OSError, match="a damaged chunk: its size is wrong"):
            read_compressed(data)
        data.id.write_direct_chunk((2, 0), b"not deflated")
        with pytest.raises(OSError, match="damaged"):
            read_compressed(data)


def test_chunks_without_some_of_the_filters(tmp_path):
    values = np.arange(12, dtype=">f4").reshape(4, 3)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("rows", (4, 3), ">f4", chunks=(1, 3), compression="gzip", shuffle=True)
        data[0] = values[0]
        data.id.write_direct_chunk((1, 0), values[1].tobytes(), filter_mask=3)
        data.id.write_direct_chunk((2, 0), zlib.compress(values[2].tobytes()), filter_mask=1)
        data[3] = values[3]
        assert np.array_equal(read_compressed(data), values) and np.array_equal(data[()], values)


@pytest.mark.parametrize("filters", [
    {"compression": "gzip"}, {"compression": "gzip", "shuffle": True}, {"compression": "gzip", "fletcher32": True},
])  # fmt: skip
@pytest.mark.parametrize("dtype", ["f4", "S4"])
def test_a_chunk_that_unpacks_to_more_than_its_values_is_refused(tmp_path, filters, dtype):
    """HDF5 would unpack all of it: 1 MB in a file can become 1 GB."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset("rows", (4, 3), dtype, chunks=(4, 3), **filters)
        data.id.write_direct_chunk((0, 0), zlib.compress(bytes(1 << 24)))
        with pytest.raises(OSError, match="a damaged chunk: its size is wrong"):
            check_chunks(data)
        if decoded_here(data):
            for row in (None, 2):
                with pytest.raises(OSError, match="a damaged chunk: its size is wrong"):
                    read_compressed(data, row)


def test_filters_after_gzip_are_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        filters = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        filters.set_chunk((4, 3))
        for _ in range(2):
            filters.set_deflate(9)
        space, kind = h5py.h5s.create_simple((4, 3)), h5py.h5t.NATIVE_FLOAT
        data = h5py.Dataset(h5py.h5d.create(file.id, b"twice", kind, space, filters))
        data[...] = 1.0
        with pytest.raises(OSError, match="by other filters after gzip"):
            check_chunks(data)


def test_threads_that_decompress_do_not_call_h5py(tmp_path, monkeypatch):
    values = np.random.default_rng(0).normal(size=(5000, 40)).astype("f4")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        write_compressed(file, "x", values)
    file = h5py.File(tmp_path / "a.h5")

    def after_closing(function, items):
        file.close()
        assert len(items) > 1
        return [function(item) for item in items]

    monkeypatch.setattr(h5_chunks, "_in_threads", after_closing)
    assert np.array_equal(read_compressed(file["x"]), values)
