"""The rollout benchmark. Speed is not tested."""

import json

import pytest
import torch

from stages.core.errors import InputError
from stages.core.models.checkpoints import build, save
from stages.lab.bench import rollout as bench_rollout
from stages.lab.bench.rollout import PEER, ellipsoids, rollout_stepwise, run, table
from stages.lab.bench.speed_options import RolloutBenchOptions


def test_scene_has_contacts():
    start = ellipsoids(2, 60)
    assert torch.equal(start.points[0], start.points[1])
    torch.manual_seed(0)
    model = build("ngff", hidden=8).eval()
    end = rollout_stepwise(model, start, 40)[:, -1]
    fallen = start.points - end
    assert end.isfinite().all()
    assert fallen[:, 2, :, 2].mean() > 0.3  # the upper body has fallen
    assert end[..., 2].min() > float(start.floor[0, 0]) - 0.1


def test_more_objects_stand_in_piles_beside_each_other():
    three, seven = ellipsoids(1, 20), ellipsoids(1, 20, 7)
    assert torch.equal(three.mass[0], seven.mass[0, :3]) and torch.equal(seven.E[0, 3:6], three.E[0])
    middle = seven.points[0].mean(1)
    assert ((middle[3:6, 0] - middle[:3, 0] - 0.7).abs() < 0.1).all() and seven.points.shape[1] == 7


def test_run_has_all_rows_and_keeps_those_of_another_device(tmp_path, monkeypatch, device):
    torch.manual_seed(0)
    save(tmp_path / "small.safetensors", "ngff", build("ngff", hidden=8))
    small = build("ngff-paper", hidden=8, layers=1)
    monkeypatch.setattr(bench_rollout.checkpoints, "build", lambda name: small)
    ours = build("ngff", hidden=8).to(device).eval()
    monkeypatch.setattr(bench_rollout.checkpoints, "load", lambda path, device: (ours, {"sha256": "x"}))
    monkeypatch.setattr(bench_rollout.bench_mpm, "measure", lambda *a: {"particles": 30, "substep_us": 2.0})
    out = tmp_path / "rollout.json"
    out.write_text(json.dumps({"another": {"machine": "a large one"}}))
    options = RolloutBenchOptions(tmp_path / "small.safetensors", keypoints=10, steps=3, scenes=(1, 2), repeat=1)
    lines = list(run(out, options))
    facts = json.loads(out.read_text())
    assert facts["another"] == {"machine": "a large one"}
    rows = facts[device]["rows"]
    names = ["ngff, step by step", PEER, "MPM, 30 particles"]
    if device == "cuda":
        names = [names[0], "ngff, replayed", "ngff, in tf32, replayed", PEER, "ngff-paper, replayed", names[2]]
    assert [row["what"] for row in rows] == 2 * names and len(lines) == 2 + len(rows)
    assert [row["scenes"] for row in rows] == len(names) * [1] + len(names) * [2]
    assert all(row["processor_seconds"] > 0 for row in rows if device == "cpu" and "MPM" not in row["what"])
    assert all(0 < row["arithmetic"] < 1 for row in rows if row["what"].startswith("ngff, "))
    assert rows[len(names) - 1]["seconds"] == pytest.approx(2e-6 * 200 * 3)  # 200 substeps per step


def test_ratios_are_relative_to_the_published_model():
    rows = [{"what": "ours", "scenes": 1, "seconds": 0.5, "ready_seconds": 3.0, "strays_m": 1e-5},
            {"what": PEER, "scenes": 1, "seconds": 4.0}]  # fmt: skip
    ours, peer = table(rows)
    assert "8.00x" in ours and "set-up: 3.0 s" in ours and "1.00x" in peer


def test_invalid_options_are_rejected():
    for options in ({"steps": 0}, {"scenes": (0,)}, {"repeat": 0}):
        with pytest.raises(InputError, match="at least 1"):
            RolloutBenchOptions(**options)
