"""The benchmark measures what it says, and writes down all of it."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.testing import assert_close

from stages.errors import InputError
from stages.evaluate.dynamics import rmse
from stages.lab import bench_dynamics
from stages.lab.bench_dynamics import FALL, SPLITS, BenchOptions, free_fall, measured, run, scenes_of
from stages.lab.motions import write_motions
from stages.models.weights import build, save
from tests.lab.test_train import DT, falling, without_last

GROUPS = [*(f"3_{i}" for i in range(10)), "4", "6"]


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """All groups, of two scenes each."""
    (tmp_path / "data").mkdir()
    for seed, name in enumerate(GROUPS):
        write_motions(tmp_path / "data" / f"{name}.h5", falling(2, 8, int(name[0]), seed=seed), {})
    return tmp_path / "data"


def test_free_fall_is_exact_for_bodies_that_only_fall():
    motions = without_last(falling(frames=20))
    predicted = free_fall(motions.world(), 20, motions.dt)
    assert_close(predicted, motions.points, rtol=0, atol=1e-5)
    resting = predicted[1:, -1, :, :, 2].amin(-1)
    assert_close(resting, torch.full_like(resting, float(motions.world().floor[0])), rtol=0, atol=1e-5)


def test_the_truth_has_no_error_and_correlates_wholly():
    motions = without_last(falling())
    result = measured(lambda world, frames, dt: free_fall(world, frames, dt), motions, "spatial", batch=4)
    assert result["RMSE"] < 1e-5 and result["FPE"] < 1e-5 and result["R"] > 0.9999
    assert len(result["error by frame"]) == 12 and result["scenes not finite"] == 0
    assert set(result["error by object id"]) == {0, 1}


def test_errors_are_averaged_over_scenes_whatever_the_batch():
    motions = without_last(falling(seed=3))

    def still(world, frames, dt):
        return world.points[:, None].repeat(1, frames, 1, 1, 1)

    one, all_ = (measured(still, motions, "spatial", batch=b) for b in (1, 6))
    assert one == all_
    world = motions.world()
    assert one["RMSE"] == pytest.approx(float(rmse(still(world, 12, DT), motions.points, world.valid).mean()), abs=1e-6)
    assert one["R"] == 0  # everything falls, nothing was said to


def test_a_scene_that_is_lost_is_not_left_out():
    motions = falling()

    def lost(world, frames, dt):
        points = free_fall(world, frames, dt)
        points[0, -1] = math.nan
        return points

    result = measured(lost, motions, "spatial", batch=6)
    assert result["RMSE"] is None and result["FPE"] is None and result["scenes not finite"] == 1
    assert result["R"] == pytest.approx(5 / 6, abs=1e-3)
    assert "not finite" in bench_dynamics.table({"a": {"splits": dict.fromkeys(SPLITS, result)}})[1]


def test_the_sample_of_the_temporal_split_is_always_the_same(data, monkeypatch):
    monkeypatch.setattr(bench_dynamics, "SAMPLE", 5)
    options = BenchOptions(keypoints=8)
    a, b = (scenes_of(data, "temporal", options) for _ in range(2))
    assert len(a) == 5 and torch.equal(a.points, b.points)
    assert not torch.equal(a.points, scenes_of(data, "temporal", replace(options, seed=1)).points)
    assert scenes_of(data, "6 objects", options).points.shape == (2, 8, 6, 8, 3)


def test_every_model_is_measured_on_every_split(data, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_dynamics, "TIMED", 2)
    folder, out = tmp_path / "weights", tmp_path / "results.json"
    folder.mkdir()
    for name in ("gcn", "transformer"):
        save(folder / f"{name}.safetensors", name, build(name, hidden=8), {"minutes": 2.0})
    lines = run(data, folder, out, BenchOptions(keypoints=8, limit=2, device="cpu"))
    facts = json.loads(out.read_text(), parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert list(facts["rows"]) == [FALL, "gcn", "transformer"]
    for row in facts["rows"].values():
        assert list(row["splits"]) == list(SPLITS)
    assert facts["rows"][FALL]["splits"]["spatial"]["RMSE"] < 1e-3  # these bodies only fall
    row = facts["rows"]["transformer"]
    assert row["s for 2 steps"] > 0 and row["card"]["minutes"] == 2.0 and row["parameters"] > 0
    assert facts["scenes"] == dict.fromkeys(SPLITS, 2) and facts["machine"] and facts["date"]
    published = facts["published, on other data"]["NGFF"]
    assert published["spatial"] == [0.082, 0.326, 0.661]
    text = "\n".join(lines)
    assert text.index("transformer") < text.index("measured on other data") < text.index("Pointformer")


def test_a_folder_without_weights_is_said(data, tmp_path):
    with pytest.raises(InputError, match="no weights"):
        run(data, tmp_path, tmp_path / "r.json", BenchOptions(keypoints=8, device="cpu"))
