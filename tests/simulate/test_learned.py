import math
from dataclasses import replace

import pytest
import torch

from stages.errors import InputError
from stages.models.weights import build, save
from stages.scene.scene_ply import write_scene
from stages.scene.trajectory import read_trajectory
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run


@pytest.fixture(scope="module")
def untrained(tmp_path_factory):
    """Weights of a tiny force field: whatever it has learned, free fall and pins are built in."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "small.safetensors"
    save(path, "ngff", build("ngff", hidden=8), {"warning": "knows nothing"})
    return path


def roll(scene, tmp_path, untrained, **options):
    write_scene(tmp_path / "scene.ply", scene)
    chosen = {"steps": 6, "engine": "ngff", "weights": untrained, "keypoints": 40, "quality": "draft", "device": "cpu"}
    run(tmp_path / "scene.ply", tmp_path / "t.h5", SimulateOptions(**{**chosen, **options}))
    return read_trajectory(tmp_path / "t.h5")


def shift(t, row, frame=-1):
    return t.com[frame, row] - t.com[0, row]


@pytest.mark.parametrize("unit", [1.0, 0.1])
def test_free_fall_is_right_at_any_scale(two_balls, tmp_path, untrained, unit):
    scene = replace(two_balls, scale={"metres_per_unit": unit, "source": "test"})
    t = roll(scene, tmp_path, untrained, lift=("2=2",))
    assert torch.equal(t.positions[0, t.keypoints.object_id == 1], t.keypoints.rest[t.keypoints.object_id == 1])
    assert shift(t, 1).tolist() == pytest.approx([0, 0, -9.81 / unit * 0.1**2 / 2], rel=1e-3, abs=1e-4)
    assert t.motion.engine == "ngff"


def test_a_throw_and_a_push_in_flight(two_balls, tmp_path, untrained, caplog):
    t = roll(two_balls, tmp_path, untrained, lift=("3",), velocity=("object=1 1,0,0",), gravity=0.0,
             force=("object=2 force=0,0,6",))  # fmt: skip
    assert shift(t, 0).tolist() == pytest.approx([0.1, 0, 0], abs=1e-3)
    fall = roll(two_balls, tmp_path, untrained, lift=("3",), gravity=0.0, force=("object=2 force=0,0,12",))
    assert float(shift(t, 1)[2]) > 1e-4
    assert float(shift(fall, 1)[2]) == pytest.approx(2 * float(shift(t, 1)[2]), rel=0.02)
    assert "knows nothing" in caplog.text


def test_pinned_objects_stay_and_fewer_frames_a_second_are_the_same_motion(two_balls, tmp_path, untrained):
    t = roll(two_balls, tmp_path, untrained, lift=("2=2",), pin=("1",))
    assert shift(t, 0).norm() < 1e-5
    coarse = roll(two_balls, tmp_path, untrained, lift=("2=2",), pin=("1",), dt=0.05, steps=3)
    assert float(shift(coarse, 1)[2]) == pytest.approx(float(shift(t, 1)[2]), rel=0.01)
    assert math.isclose(coarse.motion.dt, 0.05)


def test_missing_weights_are_said(two_balls, tmp_path):
    with pytest.raises(InputError, match="nowhere.safetensors"):
        roll(two_balls, tmp_path, tmp_path / "nowhere.safetensors")
