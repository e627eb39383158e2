"""The shape, type and range of HDF5 datasets are checked before they are read."""

import h5py
import numpy as np
import pytest
import torch

from stages.core.scene import h5_schema
from stages.core.scene.field_start import DATASETS, FieldStart, FieldUnits, read_field_start, write_field_start
from stages.core.scene.h5_chunks import write_compressed
from stages.core.scene.h5_schema import Dataset, open_h5


@pytest.fixture
def file(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        yield file


def test_letters_stand_for_one_length_and_numbers_for_themselves(file):
    file["a/points"], file["weight"] = np.zeros((5, 3)), np.zeros(5)
    file["other"], file["wide"] = np.zeros(4), np.zeros((5, 4))
    lengths: dict[str, int] = {}
    assert Dataset("p 3").read(file, "a/points", lengths).dtype == np.float32
    assert lengths == {"p": 5}
    Dataset("p").read(file, "weight", lengths)
    for shape, name, wanted in (("p", "other", r"shape \(4,\); the other datasets need \(5\)"),
                                ("p 3", "wide", r"need \(5, 3\)"), ("p", "wide", r"need \(5\)")):  # fmt: skip
        with pytest.raises(ValueError, match=wanted):
            Dataset(shape).read(file, name, lengths)
    with pytest.raises(KeyError, match="a/absent"):
        Dataset("p").read(file, "a/absent", lengths)
    assert lengths == {"p": 5}


@pytest.mark.parametrize(("kind", "accepted"), [("float", "fiu"), ("int", "iu"), ("text", "")])
def test_types_are_those_of_the_kind(file, kind, accepted):
    for letter, dtype in (("f", "f8"), ("i", ">i2"), ("u", "u1")):
        file[letter] = np.array([0, 1], dtype)
        if letter in accepted:
            found = Dataset("n", kind).read(file, letter, {})
            assert found.tolist() == [0, 1] and found.dtype == (np.float32 if kind == "float" else np.int64)
        else:
            with pytest.raises(ValueError, match=f"values of type .*not {kind}"):
                Dataset("n", kind).read(file, letter, {})
    file["text"], file["bytes"] = ["duck", "ü"], np.array([b"ab", b"c"])
    file.flush()  # texts are read from the bytes on the disk
    for name, texts in (("text", ["duck", "ü"]), ("bytes", ["ab", "c"])):
        if kind == "text":
            assert Dataset("n", kind).read(file, name, {}) == texts
        else:
            with pytest.raises(ValueError, match="values of type"):
                Dataset("n", kind).read(file, name, {})


def test_values_are_in_their_range_with_its_bounds(file):
    file["x"], file["half"], file["nan"] = [0.0, 1.0], np.array([0, 6e4], "f2"), [0.0, np.nan]
    assert Dataset("n", low=0, high=1).read(file, "x", {}).tolist() == [0, 1]
    assert Dataset("n").read(file, "half", {})[1] == np.float32(np.float16(6e4))
    for name, low, high, why in (("x", 0, 0.5, "out of range"), ("x", 0.5, 1, "from 0.5 to 1; out of range"),
                                 ("nan", -1, 1, "some are not finite")):  # fmt: skip
        with pytest.raises(ValueError, match=why):
            Dataset("n", low=low, high=high).read(file, name, {})


def test_what_is_no_dataset_with_values_of_its_own_is_refused(file, tmp_path):
    file.create_group("group")
    file["empty"] = h5py.Empty("f4")
    layout = h5py.VirtualLayout((3,), "f4")
    layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "x", (3,))
    file.create_virtual_dataset("virtual", layout)
    file.create_dataset("external", (3,), "f4", external=[(str(tmp_path / "raw"), 0, 12)])
    for name in ("group", "empty", "virtual", "external"):
        with pytest.raises(ValueError, match=f"{name} is not a dataset with values of its own"):
            Dataset("n").open(file, name, {})
    file["inside"], file["real/x"] = h5py.SoftLink("/real"), [1.0]
    with pytest.raises(ValueError, match="inside/x is a link"):
        Dataset("n").open(file, "inside/x", {})


def test_more_values_than_the_file_can_store_are_refused(file, monkeypatch):
    """Deflate expands a byte to at most 1032 bytes; a dataset without stored bytes is limited to 4096 bytes."""
    file.create_dataset("small", (1024,), "f4")
    file.create_dataset("large", (1025,), "f4")
    file.create_dataset("zeros", data=np.zeros(10**6, "f4"), compression="gzip", chunks=(10**6,))
    Dataset("n").open(file, "small", {})
    Dataset("n").open(file, "zeros", {})
    with pytest.raises(ValueError, match="large declares 1025 values, but the file stores only 0 bytes"):
        Dataset("n").open(file, "large", {})
    monkeypatch.setattr(h5_schema, "MAX_CHUNK", 1000)
    file.create_dataset("chunk", (10,), "f4", chunks=(250,), maxshape=(None,))
    file.create_dataset("wide", (10,), "f4", chunks=(251,), maxshape=(None,))
    Dataset("n").open(file, "chunk", {})
    with pytest.raises(ValueError, match="wide has chunks"):
        Dataset("n").open(file, "wide", {})


UNITS = FieldUnits(2.0, 0.5, 3.0, 4.0, (0.1, 0.2, 0.3), 9.81, 7, "abc")


def start_of(units: FieldUnits, objects: int = 2, points: int = 5) -> FieldStart:
    o = torch.arange(objects) / 8
    return FieldStart(
        torch.rand(points, 3), torch.full((points,), 0.2), o + 1, o + 2, o + 3, o + 4, o / 4, o + 5,
        torch.rand(objects, 3), torch.rand(objects, 3, 3), torch.rand(objects, 2, 3), torch.arange(objects),
        torch.arange(objects).flip(0), tuple(f"m{i}" for i in range(objects)), units,
    )  # fmt: skip


@pytest.mark.parametrize("friction", [None, 0.25])
def test_the_start_of_a_field_is_read_back(file, friction):
    assert read_field_start(file, {}) is None
    units = FieldUnits(**{**UNITS.__dict__, "friction": friction})
    for objects in (3, 2):  # the second one replaces the first one
        start = start_of(units, objects)
        write_field_start(file, start)
    file.flush()
    lengths: dict[str, int] = {}
    found = read_field_start(file, lengths)
    assert lengths == {"p": 5, "o": 2}
    for name, value in start.__dict__.items():
        same = torch.equal if isinstance(value, torch.Tensor) else lambda a, b: a == b
        assert same(getattr(found, name), value), name


@pytest.mark.parametrize(("name", "value"), [
    ("length", 9.9e-13), ("time", 1.01e12), ("friction", -0.01), ("friction", 100.1), ("origin", [1.0, 2.0]),
    ("gravity", np.nan), ("steps", 0), ("steps", 10_001), ("steps", 1.5),
])  # fmt: skip
def test_units_of_a_field_out_of_range_are_refused(file, name, value):
    write_field_start(file, start_of(UNITS))
    file["field"].attrs[name] = value
    file.flush()
    with pytest.raises(ValueError, match=name):
        read_field_start(file, {})


@pytest.mark.parametrize("name", [name for name, dataset in DATASETS.items() if dataset.kind != "text"])
def test_values_of_a_field_out_of_range_are_refused(file, name):
    """Mass, stiffness and friction are not negative, and nu is between -1 and 0.5, as for elastic materials."""
    low = {"solidity": 1, "nu": -1, **dict.fromkeys(("points", "velocity", "inertia", "box"), -1e9)}.get(name, 0)
    high = {"mass_fraction": 1.001, "nu": 0.5, "awake": 1, "standing": 1,
            **dict.fromkeys(("mass", "volume", "E", "solidity"), 1e30)}.get(name, 1e9)  # fmt: skip
    write_field_start(file, start_of(UNITS))
    file.flush()
    data, step = file[f"field/{name}"], 1 if name in ("awake", "standing") else 1e-3
    before = data[()]
    below, above = low - step * max(1, abs(low)), high * 1.001 + step
    for value, right in ((low, True), (high, True), (below, False), (above, False)):
        data[()] = np.where(np.arange(before.size).reshape(before.shape) == 1, value, before)
        if right:
            read_field_start(file, {})
        else:
            with pytest.raises(ValueError, match=f"field/{name}"):
                read_field_start(file, {})


@pytest.mark.parametrize(("name", "low", "high"), [
    ("length", 1e-12, 1e12), ("mass", 1e-12, 1e12), ("friction", 0.0, 100.0), ("steps", 1, 10_000),
])  # fmt: skip
def test_units_of_a_field_up_to_their_limits_are_read(file, name, low, high):
    write_field_start(file, start_of(UNITS))
    for value in (low, high):
        file["field"].attrs[name] = value
        file.flush()
        assert getattr(read_field_start(file, {}).units, name) == value


def test_a_file_is_opened_for_reading(tmp_path):
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.attrs["name"] = "duck"
    with open_h5(tmp_path / "b.h5") as file:
        assert file.attrs["name"] == "duck" and file.mode == "r"


def test_a_damaged_fill_value_is_refused(tmp_path):
    """HDF5 crashes when it reads a fill value of negative size."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        write_compressed(file, "points", np.ones((7, 3), np.float32))
    # type 5 (fill value), 8 bytes: version, times, whether it is defined
    message = bytes([5, 0, 8, 0, 1, 0, 0, 0, 2, 3, 2, 1])
    data = bytearray(path.read_bytes())
    size = data.index(message) + len(message)
    data[size + 3] = 0x9D
    path.write_bytes(data)
    with h5py.File(path) as file, pytest.raises(ValueError, match="fill"):
        Dataset("p 3").read(file, "points", {})
