"""Replay of a recorded run of the published solver."""

import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.lab.bench import replay
from tests.conftest import SHARED

RECORDING = SHARED / "facts" / "public_mpm" / "three_boxes.npz"
ALL_HAVE_TOUCHED = 27  # [frames]; the last of the three boxes has its first contact in frame 25


def small(frames: int = 3) -> dict[str, np.ndarray]:
    """A box of eight particles in free fall, as recorded by the published solver: gravity is applied before motion."""
    start = np.array([[2 + 0.01 * i, 2 + 0.01 * j, 1 + 0.01 * k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    steps = 200 * np.arange(frames)
    fallen = -5.0 * 1e-4**2 * steps * (steps + 1) / 2
    return {
        "positions": (start + fallen[:, None, None] * [0, 0, 1]).astype(np.float32), "n": np.array([8]),
        "volume": np.full(8, 1e-6, np.float32), "E": np.array([1e5]), "rho": np.array([500.0]), "nu": np.array(0.3),
        "dt": np.array(1e-4), "substeps_per_frame": np.array(200), "n_grid": np.array(200),
        "grid_lim": np.array(4.0), "gravity": np.array([0.0, 0.0, -5.0]), "rpic_damping": np.array(0.9),
    }  # fmt: skip


@pytest.mark.slow
def test_agrees_with_the_public_solver_through_first_contacts(device):
    if not RECORDING.exists():
        pytest.skip("the recording is not on this machine")
    data = replay.read_recording(RECORDING)
    ours = torch.stack(list(replay.simulate(data, ALL_HAVE_TOUCHED, device)))
    c = replay.compare(data, ours)
    assert c.contact == 16
    assert float(c.particles[: c.contact].max()) < 1e-4  # only rounding errors in free flight
    assert float(c.com.max()) < 0.01  # relative to the drop height
    moved = (ours[-1] - ours[15]).norm(dim=1).max() / c.drop
    assert float(moved) > 0.3  # the bodies have moved


def test_grid_nodes_match_the_public_solver(device):
    grid = replay.make_solver(small(), device).grid
    at = [(torch.tensor(list(grid.origin)) + 0.02 * torch.tensor(list(edge))) / 0.02 for edge in (grid.low, grid.high)]
    torch.testing.assert_close(at[0], torch.full((3,), 2.0), rtol=0, atol=1e-4)  # the third node is the last fixed one
    torch.testing.assert_close(at[1], torch.full((3,), 197.0), rtol=0, atol=1e-4)


@pytest.mark.usefixtures("device")
def test_output_is_a_recording(tmp_path):
    np.savez(tmp_path / "a.npz", **small())
    lines = list(replay.run(tmp_path / "a.npz", tmp_path / "ours.npz", replay.ReplayOptions()))
    again = replay.read_recording(tmp_path / "ours.npz")
    np.testing.assert_allclose(again["positions"], small()["positions"], rtol=0, atol=2e-6)
    assert "frame   2" in lines[3] and "agree to 1 % of the drop height through frame 2 of 2" in lines[-1]


def spoiled(**changes) -> dict[str, np.ndarray]:
    return {k: v for k, v in {**small(), **changes}.items() if v is not None}


@pytest.mark.parametrize("data, message", [
    (spoiled(E=None), "no E; a recording has"), (spoiled(n=np.array([7])), r"positions must be \(frames, 7, 3\)"),
    (spoiled(volume=np.ones(3)), r"volume must have the shape \(8,\)"),
    (spoiled(positions=np.full((3, 8, 3), np.nan)), "positions has values that are not finite"),
    (spoiled(n_grid=np.array(10**6)), "n_grid must be from 7 to 1024"),
    (spoiled(n=np.array([9, -1])), "n must be a list"),
])  # fmt: skip
def test_invalid_recordings_are_rejected(tmp_path, data, message):
    np.savez(tmp_path / "a.npz", **data)
    with pytest.raises(InputError, match=message):
        replay.read_recording(tmp_path / "a.npz")


def test_invalid_files_and_options_are_rejected(tmp_path):
    (tmp_path / "a.npz").write_text("no")
    with pytest.raises(InputError, match="not an NPZ"):
        replay.read_recording(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", **small())
    with pytest.raises(InputError, match="--frames 9"):
        list(replay.run(tmp_path / "b.npz", tmp_path / "c.npz", replay.ReplayOptions(9)))
    assert not (tmp_path / "c.npz").exists()
    with pytest.raises(InputError, match="--frames"):
        replay.ReplayOptions(-1)
