import os
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
    """While it is written, after `store_prompts`; and after a restart only the new frames."""
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
     ("frames", "other datasets need"), ("ids", "object 1 is there twice"), ("weights", "does not sum to 1"),
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
