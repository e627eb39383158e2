import os
import zlib
from contextlib import nullcontext
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.core.scene.trajectory import (
    BUFFERED,
    Binding,
    Keypoints,
    SimulationInfo,
    TrajectoryWriter,
    read_trajectory,
)
from tests.conftest import two_balls_scene
from tests.core.scene.test_h5_schema import UNITS, start_of


def parts(scene, p: int = 10):
    n = len(scene.gaussians)
    rest = torch.randn(p, 3, generator=torch.Generator().manual_seed(0))
    keypoints = Keypoints(rest, torch.ones(p, dtype=torch.int64))
    index = torch.randint(0, p, (n, 8), generator=torch.Generator().manual_seed(1))
    info = SimulationInfo(0.02, (0.0, 0.0, -9.81), "test", ({"kind": "pin", "object_id": 1},))
    return info, keypoints, Binding(index, torch.full((n, 8), 1 / 8))


def write(path, scene, frames: int = 3):
    info, keypoints, binding = parts(scene)
    with TrajectoryWriter(path, scene, info, keypoints, binding) as writer:
        for t in range(frames):
            writer.append(keypoints.rest + 0.1 * t, torch.full((2, 3), float(t)), torch.eye(4)[:2])


def test_round_trip(tmp_path, two_balls):
    write(tmp_path / "t.h5", replace(two_balls, background=(0.2, 0.4, 0.6)))
    t = read_trajectory(tmp_path / "t.h5")
    info, keypoints, binding = parts(two_balls)
    assert len(t) == 3 and t.info == info
    assert t.scene.objects == two_balls.objects and t.scene.floor == 0.0
    assert t.scene.background == (0.2, 0.4, 0.6)
    assert t.scene.cameras.names == two_balls.cameras.names
    assert torch.equal(t.scene.gaussians.means, two_balls.gaussians.means)
    assert torch.equal(t.positions[2], keypoints.rest + 0.2)
    assert torch.equal(t.binding.index, binding.index)
    assert torch.equal(t.com[:, 0, 0], torch.tensor([0.0, 1, 2]))


def test_confidence_of_a_tracked_motion(tmp_path, two_balls):
    info, keypoints, binding = parts(two_balls)
    write(tmp_path / "simulated.h5", two_balls)
    assert read_trajectory(tmp_path / "simulated.h5").confidence is None
    confidence = torch.tensor([[1.0, 0.5], [0.0, 0.25]])
    with TrajectoryWriter(tmp_path / "t.h5", two_balls, info, keypoints, binding) as writer:
        for _ in range(2):
            writer.append(keypoints.rest, torch.zeros(2, 3), torch.eye(4)[[0, 0]])
        writer.store_confidence(confidence)
    assert torch.equal(read_trajectory(tmp_path / "t.h5").confidence, confidence)
    with h5py.File(tmp_path / "t.h5", "r+") as file:
        file["objects/confidence"][0, 0] = 1.5
    with pytest.raises(InputError, match="objects/confidence must be from 0 to 1"):
        read_trajectory(tmp_path / "t.h5")


def test_input_error_keeps_the_written_frames(tmp_path, two_balls):
    info, keypoints, binding = parts(two_balls)
    with (
        pytest.raises(InputError, match="escaped"),
        TrajectoryWriter(tmp_path / "t.h5", two_balls, info, keypoints, binding) as writer,
    ):
        writer.append(keypoints.rest, torch.zeros(2, 3), torch.eye(4)[[0, 0]])
        raise InputError("green ball escaped")
    assert os.listdir(tmp_path) == ["t.partial.h5"]
    assert len(read_trajectory(tmp_path / "t.partial.h5")) == 1


def test_a_written_file_is_not_kept_open(tmp_path, two_balls):
    with TrajectoryWriter(tmp_path / "t.h5", two_balls, *parts(two_balls)) as writer:
        pass
    assert writer.frames == 0
    open_files = [os.path.realpath(f"/proc/self/fd/{name}") for name in os.listdir("/proc/self/fd")]
    assert not [name for name in open_files if name.startswith(str(tmp_path))]


def test_a_trajectory_has_frames_and_gaussians(tmp_path, two_balls):
    write(tmp_path / "t.h5", two_balls, frames=0)
    with pytest.raises(InputError, match="t.h5: has no frames"):
        read_trajectory(tmp_path / "t.h5")
    write(tmp_path / "t.h5", replace(two_balls, gaussians=two_balls.gaussians[:0]))
    with pytest.raises(InputError, match="t.h5: has no Gaussians"):
        read_trajectory(tmp_path / "t.h5")


STORED = {"prompts": [], "provenance": {}, "field": start_of(UNITS), "confidence": torch.ones(1, 2), "plausibility": {}}


@pytest.mark.parametrize("what", STORED)
def test_a_disk_that_is_full_ends_the_run_at_the_next_write(tmp_path, two_balls, what):
    """HDF5 itself would not report the error."""
    with (
        pytest.raises(InputError, match="t.h5: cannot be written .No space left on device."),
        TrajectoryWriter(tmp_path / "t.h5", two_balls, *parts(two_balls)) as writer,
    ):
        raw = writer._raw
        raw.error = OSError(28, "No space left on device")
        getattr(writer, f"store_{what}")(STORED[what])
        pytest.fail("nothing was raised")
    assert os.listdir(tmp_path) == [] and raw.closed


def test_interrupted_write_leaves_no_file(tmp_path, two_balls):
    info, keypoints, binding = parts(two_balls)
    with (
        pytest.raises(KeyboardInterrupt),
        TrajectoryWriter(tmp_path / "t.h5", two_balls, info, keypoints, binding) as writer,
    ):
        writer.append(keypoints.rest, torch.zeros(2, 3), torch.eye(4)[[0, 0]])
        raise KeyboardInterrupt
    assert os.listdir(tmp_path) == []


def test_frames_in_the_buffer_are_in_the_file_when_it_is_read(tmp_path, two_balls):
    """They are in the file during writing, after `store_prompts`; after a restart it has only the new frames."""
    info, keypoints, binding = parts(two_balls)
    with TrajectoryWriter(tmp_path / "t.h5", two_balls, info, keypoints, binding) as writer:
        for t in range(BUFFERED + 3):
            writer.append(keypoints.rest + t, torch.zeros(2, 3), torch.zeros(2, 4))
        writer.store_prompts(info.forces)
        with h5py.File(writer.part) as file:
            assert len(file["keypoints/positions"]) == BUFFERED + 3
        writer.restart()
        writer.append(keypoints.rest + 7, torch.zeros(2, 3), torch.zeros(2, 4))
    with h5py.File(tmp_path / "t.h5") as file:
        assert np.array_equal(file["keypoints/positions"][()], (keypoints.rest + 7).numpy()[None])


def damage(path, scene, how: str):
    if how == "text":
        path.write_text("not HDF5")
        return
    write(path, scene)
    with h5py.File(path, "a") as file:
        if how == "format":
            file.attrs["format"] = "other"
        elif how == "part":
            del file["binding"]
        elif how == "nan":
            file["keypoints/positions"][0, 0, 0] = float("nan")
        elif how == "frames":
            file["keypoints/positions"].resize(2, axis=0)
        elif how == "ids":
            file["objects/id"][:] = 1
        elif how == "weights":
            file["binding/weight"][3] = 0.2
        elif how == "index":
            file["binding/index"][3, 0] = 10
        elif how == "quats":
            file["gaussians/quats"][5] = 2.0
        elif how == "rotation":
            file["objects/rotation"][1, 0] = 0.0


@pytest.mark.parametrize(
    ("how", "message"),
    [("text", "not a readable HDF5"), ("format", "format attribute"), ("part", "missing"), ("nan", "not finite"),
     ("frames", "other datasets need"), ("ids", "object 1 occurs twice"), ("weights", "does not sum to 1"),
     ("index", "binding does not fit the 1700 Gaussians and 10 keypoints"),
     ("quats", "gaussians/quats has a quaternion that is not of length 1"), ("rotation", "objects/rotation has a")],
)  # fmt: skip
def test_damaged_files_are_refused_in_one_line(tmp_path, two_balls, how, message):
    damage(tmp_path / "t.h5", two_balls, how)
    with pytest.raises(InputError, match=message) as caught:
        read_trajectory(tmp_path / "t.h5")
    assert "\n" not in str(caught.value)


def test_frame_rate_for_other_readers_is_the_inverse_of_the_time_step(tmp_path, two_balls):
    write(tmp_path / "t.h5", two_balls)
    with h5py.File(tmp_path / "t.h5") as file:
        assert file.attrs["dt"] == 0.02 and file.attrs["fps"] == pytest.approx(50)


@pytest.fixture(scope="module")
def intact(tmp_path_factory):
    """The bytes of a valid trajectory."""
    path = tmp_path_factory.mktemp("intact") / "t.h5"
    write(path, two_balls_scene())
    return path.read_bytes()


def change(path, intact: bytes, name: str, value) -> None:
    """Write a trajectory with a changed attribute, or dataset if the name has a slash; None deletes it."""
    path.write_bytes(intact)
    with h5py.File(path, "a") as file:
        where = file if "/" in name else file.attrs
        if name in where:
            del where[name]
        if value is not None:
            where[name] = value


def test_attributes_are_read_as_other_languages_write_them(tmp_path, intact):
    """Texts have a fixed length, as written by C and MATLAB, and numbers may be arrays with one element."""
    path = tmp_path / "t.h5"
    path.write_bytes(intact)
    expected = read_trajectory(path)
    with h5py.File(path, "a") as file:
        for name in ("format", "engine", "scale", "provenance"):
            file.attrs[name] = np.bytes_(file.attrs[name])
        for name in ("version", "dt"):
            file.attrs[name] = np.array([file.attrs[name]])
        file.attrs["engine"] = np.array([file.attrs["engine"]])
    found = read_trajectory(path)
    assert found.info == expected.info and found.scene.scale == expected.scene.scale
    assert found.scene.provenance == expected.scene.provenance


@pytest.mark.parametrize(("name", "value", "message"), [
    ("version", 2, "version 2 is newer than 1; upgrade"), ("version", -1, "version is"), ("dt", 0.0, "dt is"),
    ("dt", None, "missing"), ("gravity", [0.0, 1.0], "gravity is"), ("floor", np.inf, "floor is"),
    ("scale", "[1]", "scale or provenance"), ("scale", '{"metres_per_unit": 0}', "metres_per_unit"),
    ("background", [0.1, 0.2], "background is"), ("provenance", "[]", "scale or provenance"),
    ("plausibility", "[]", "plausibility is not"), ("plausibility", '{"objects": []}', "plausibility is not"),
    ("plausibility", '{"objects": {"1": 3}}', "whose measures are not"),
    ("plausibility", '{"energy_gain": -1}', "plausibility is"),
    ("plausibility", '{"objects": {"1": {"creep": "x"}}}', "plausibility is"),
    ("keypoints/positions", np.zeros((0, 10, 3), "f4"), "has no frames|other datasets"),
    ("gaussians/sh", np.zeros((1700, 2, 3), "f4"), "has 2 coefficients, not 1, 4, 9 or 16"),
    ("gaussians/scales", -np.ones((1700, 3), "f4"), "scales must be from 0"),
    ("forces/json", ["[]"], "none of the kinds"),
    ("forces/json", ['{"kind": "pin", "object_id": 3}'], "not among the objects"),
    ("binding/index", np.full((1700, 8), -1, "i4"), "has a weight without a keypoint"),
    ("binding/index", np.zeros((1699, 8), "i4"), "other datasets need|does not fit"),
    ("objects/name", None, "a part of the trajectory is missing .objects/name"),
    ("cameras/viewmats", np.zeros((6, 4, 4), "f4"), "viewmat that is not a rotation"),
])  # fmt: skip
def test_values_that_a_trajectory_cannot_have(tmp_path, intact, name, value, message):
    change(tmp_path / "t.h5", intact, name, value)
    with pytest.raises(InputError, match=message) as caught:
        read_trajectory(tmp_path / "t.h5")
    assert "t.h5" in str(caught.value)


@pytest.mark.parametrize(("name", "low", "high", "step"), [
    ("gaussians/scales", 0, None, 1e-6), ("gaussians/opacities", -0.001, 1.001, 1e-5),
    ("gaussians/object_id", 0, 65535, 1), ("objects/id", 1, 65535, 1), ("keypoints/object_id", 0, 65535, 1),
    ("objects/confidence", 0, 1, 1e-5), ("binding/index", -1, None, 1), ("binding/weight", -0.001, 1.001, 1e-5),
    ("cameras/sizes", 1, 65536, 1),
])  # fmt: skip
def test_values_up_to_the_limits_of_a_dataset_are_read(tmp_path, intact, name, low, high, step):
    """Limits of the file format; errors of other checks for values within them are ignored here."""
    path = tmp_path / "t.h5"
    path.write_bytes(intact)
    with h5py.File(path, "a") as file:
        if name not in file:
            file[name] = np.ones((3, 2), "f4")
    for limit, sign in ((low, -1), (high, 1)):
        for value, right in () if limit is None else ((limit, True), (limit + sign * step, False)):
            with h5py.File(path, "a") as file:
                data = file[name]
                data[(0,) * data.ndim] = value
            try:
                read_trajectory(path)
                refused = False
            except InputError as error:
                refused = f"{name} must be" in str(error)
            assert refused is not right, (value, right)


def test_filters_that_are_not_read_are_named(tmp_path, intact):
    path, name = tmp_path / "t.h5", b"keypoints/positions"
    path.write_bytes(intact)
    with h5py.File(path, "a") as file:
        values = file[name][()]
        del file[name]
        filters = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        filters.set_chunk(values.shape)
        filters.set_filter(32001, h5py.h5z.FLAG_OPTIONAL)  # filter number of Blosc
        data = h5py.h5d.create(file.id, name, h5py.h5t.IEEE_F32LE, h5py.h5s.create_simple(values.shape), filters)
        data.write_direct_chunk((0, 0, 0), values.tobytes())
    with pytest.raises(InputError, match="t.h5.*keypoints/positions is stored with filter 32001 of HDF5.*gzip"):
        read_trajectory(path)


def test_chunks_that_unpack_to_more_than_their_values_are_refused(tmp_path, two_balls, intact):
    path, bomb = tmp_path / "t.h5", zlib.compress(bytes(1 << 24))
    path.write_bytes(intact)
    with h5py.File(path, "a") as file:
        values = file["objects/name"].asstr()[()].astype("S9")
        del file["objects/name"]
        file.create_dataset("objects/name", data=values, compression="gzip").id.write_direct_chunk((0,), bomb)
    with pytest.raises(InputError, match="t.h5: .*a damaged chunk: its size is wrong"):
        read_trajectory(path)
    path.write_bytes(intact)
    with h5py.File(path, "a") as file:
        for name in ("means", "quats", "scales"):
            rows = getattr(two_balls.gaussians, name).numpy()[None].repeat(3, 0)
            data = file.create_dataset(f"frames/{name}", data=rows, chunks=(1, *rows.shape[1:]), compression="gzip")
        data.id.write_direct_chunk((1, 0, 0), bomb)
    t = read_trajectory(path)
    assert torch.equal(t.frame(2).means, two_balls.gaussians.means)
    with pytest.raises(InputError, match="t.h5: frame 1 is damaged .a damaged chunk: its size is wrong"):
        t.frame(1)


@pytest.mark.parametrize(("dt", "right"), [(1e-6, True), (9.9e-7, False), (1e4, True), (10_001.0, False)])
def test_times_between_frames_are_a_microsecond_to_hours(tmp_path, intact, dt, right):
    change(tmp_path / "t.h5", intact, "dt", dt)
    with nullcontext() if right else pytest.raises(InputError, match="dt is"):
        assert read_trajectory(tmp_path / "t.h5").info.dt == dt


@pytest.mark.parametrize("name", ["gaussians", "frames", "frames/means", "cameras", "forces", "objects/confidence"])
def test_links_are_not_followed(tmp_path, intact, name):
    """Optional parts are not even looked up through links, because HDF5 would wait for a pipe."""
    path, dataset = tmp_path / "t.h5", {"cameras": "cameras/viewmats", "forces": "forces/json"}.get(name)
    path.write_bytes(intact)
    with h5py.File(tmp_path / "other.h5", "w"):
        pass  # it is empty, so that a reader that follows the link would consider the part absent
    with h5py.File(path, "a") as file:
        if name in file:
            del file[name]
        file[name] = h5py.ExternalLink("other.h5", "/")
    with pytest.raises(InputError, match=f"{dataset or name}.* is a link"):
        read_trajectory(path)


def test_what_a_trajectory_may_lack(tmp_path, intact):
    for name in ("objects/material", "forces/json", "cameras/viewmats", "scale", "provenance", "floor"):
        change(tmp_path / "t.h5", intact, name, None)
        t = read_trajectory(tmp_path / "t.h5")
        assert (t.info.forces == ()) == (name == "forces/json")
        assert (t.scene.cameras is None) == (name == "cameras/viewmats")
        assert (t.scene.floor is None) == (name == "floor")
        assert [o.material for o in t.scene.objects] == (["", ""] if name == "objects/material" else ["rubber"] * 2)
        assert t.scene.metres_per_unit == 1 and not t.scene.has_known_scale and t.plausibility is None


def test_weights_and_quaternions_may_be_rounded_to_16_bits(tmp_path, intact):
    (tmp_path / "t.h5").write_bytes(intact)
    for factor, right in ((0.991, True), (1.02, False), (0.98, False)):
        for name in ("binding/weight", "gaussians/quats", "objects/rotation"):
            with h5py.File(tmp_path / "t.h5", "a") as file:
                before = file[name][()]
                file[name][...] = factor * before
            with nullcontext() if right else pytest.raises(InputError, match=name):
                read_trajectory(tmp_path / "t.h5")
            with h5py.File(tmp_path / "t.h5", "a") as file:
                file[name][...] = before


def test_gaussians_that_follow_no_keypoint(tmp_path, two_balls):
    info, keypoints, binding = parts(two_balls)
    binding.index[:5], binding.weight[:5] = -1, 0
    with TrajectoryWriter(tmp_path / "t.h5", two_balls, info, keypoints, binding) as writer:
        writer.append(keypoints.rest, torch.zeros(2, 3), torch.eye(4)[[0, 0]])
    assert torch.equal(read_trajectory(tmp_path / "t.h5").binding.index, binding.index)


def test_dense_frames_are_read_one_by_one(tmp_path, two_balls, intact):
    path, n = tmp_path / "t.h5", len(two_balls.gaussians)
    write(path, two_balls)
    assert not read_trajectory(path).dense
    with h5py.File(path, "a") as file:
        for name, width in (("means", 3), ("quats", 4), ("scales", 3)):
            rows = getattr(two_balls.gaussians, name).numpy()
            file[f"frames/{name}"] = np.stack([rows, rows + (name == "means"), rows * (2 if name == "quats" else 1)])
            assert file[f"frames/{name}"].shape == (3, n, width)
        del file["binding/index"], file["binding/weight"]
        file["binding/index"], file["binding/weight"] = np.zeros((0, 8), "i4"), np.zeros((0, 8), "f4")
    t = read_trajectory(path)
    assert t.dense and len(t) == 3
    moved, g = t.frame(1), two_balls.gaussians
    assert torch.equal(moved.means, g.means + 1) and torch.equal(moved.quats, g.quats)
    assert torch.equal(moved.scales, g.scales) and torch.equal(moved.sh, g.sh)
    with pytest.raises(InputError, match="t.h5: frame 2 is damaged .frames/quats has a quaternion"):
        t.frame(2)
    with h5py.File(path, "a") as file:
        file["frames/scales"][0, 0, 0] = -1
    with pytest.raises(InputError, match="frame 0 is damaged .frames/scales must be from 0"):
        t.frame(0)
    change(path, intact, "frames/means", np.zeros((2, n, 3), "f4"))
    with pytest.raises(InputError, match="frames/means has shape"):
        read_trajectory(path)


def test_measures_and_facts_of_the_end_of_a_run_are_read_back(tmp_path, two_balls):
    info, keypoints, binding = parts(two_balls)
    measures = {"objects": {"1": {"creep": 0.5}, "2": {}}, "energy_gain": 0.25}
    with TrajectoryWriter(tmp_path / "t.h5", two_balls, info, keypoints, binding) as writer:
        writer.append(keypoints.rest, torch.zeros(2, 3), torch.eye(4)[[0, 0]])
        writer.store_plausibility(measures)
        writer.store_provenance({"command": "ngff simulate"})
        writer.store_prompts([*info.forces, {"kind": "pin", "object_id": 2}])
    t = read_trajectory(tmp_path / "t.h5")
    assert t.plausibility == measures and t.scene.provenance == {"command": "ngff simulate"} and t.field is None
    assert [f["object_id"] for f in t.info.forces] == [1, 2]
