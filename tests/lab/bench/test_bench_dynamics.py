"""The dynamics benchmark: baselines, metrics, tables and results."""

import json
import math
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
import torch
from torch.testing import assert_close

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.geometry.rotations import matrix
from stages.core.models.checkpoints import build, save
from stages.evaluate.dynamics import rmse
from stages.lab.bench import dynamics as bench_dynamics
from stages.lab.bench import dynamics_baselines
from stages.lab.bench.dynamics import (
    FREE_FALL,
    MPM_ESTIMATED,
    NUDGED,
    RIGID_FIT,
    SPLITS,
    evaluate_predictor,
    run,
    split_scenes,
)
from stages.lab.bench.dynamics_baselines import (
    VLM_MATERIALS,
    Resimulation,
    free_fall,
    predict_free_fall,
    predict_from,
    predict_rigid_fit,
    shared_scenes,
    with_estimated_materials,
)
from stages.lab.bench.dynamics_report import markdown, table
from stages.lab.bench.motion_options import DynamicsBenchOptions
from stages.lab.dataset.keypoint_motions import KeypointMotions, concatenate_motions, write_motions
from stages.lab.dataset.object_particles import Asset, particle_volumes
from stages.lab.dataset.scene_configs import SceneConfig, write_scene_configs
from stages.lab.dataset.simulation import SimulationSettings, simulate
from stages.lab.plot import LEGEND_HEIGHT, PANEL_HEIGHT, PANEL_WIDTH
from tests.conftest import CliRunner
from tests.lab.small_world import COARSE, box_shell
from tests.lab.training.motions import falling, without_last

GROUPS = [*(f"3_{i}" for i in range(10)), "4", "6", "heldout"]
NONE = DynamicsBenchOptions(keypoints=8, mpm=0)


def group(name: str, by: float = 0.0) -> KeypointMotions:
    """Two scenes of falling bodies, displaced by `by` [m]."""
    made = falling(2, 8, 3 if name == "heldout" else int(name[0]), seed=GROUPS.index(name))
    return replace(made, names=(f"{name} a", f"{name} b"), points=made.points + by)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A data set of all groups with two scenes each."""
    (tmp_path / "data").mkdir()
    for name in GROUPS:
        write_motions(tmp_path / "data" / f"{name}.h5", group(name), {})
    return tmp_path / "data"


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    (tmp_path / "weights").mkdir()
    for name in ("gcn", "transformer"):
        save(tmp_path / "weights" / f"{name}.safetensors", name, build(name, hidden=8), {"runs": [{"minutes": 2.0}]})
    return tmp_path / "weights"


def test_free_fall_is_exact_for_bodies_that_only_fall():
    motions = without_last(falling(frames=20))
    predicted = free_fall(motions.initial_conditions(), 20, motions.dt)
    assert_close(predicted, motions.points, rtol=0, atol=1e-5)
    resting = predicted[1:, -1, :, :, 2].amin(-1)
    assert_close(resting, torch.full_like(resting, float(motions.initial_conditions().floor[0, 0])), rtol=0, atol=1e-5)


def tumbling(seed: int = 0):
    """Rigid bodies that rotate and translate; scene 0 lacks its last object."""
    motions = without_last(falling(frames=6, n=20, seed=seed))
    rest = motions.points[:, 0]
    centre = rest.mean(2, keepdim=True)
    points = []
    for t in range(6):
        half = torch.tensor(0.4 * t)
        R = matrix(torch.cat([half.cos()[None], half.sin() * torch.tensor([1.0, 2, 2]) / 3]))
        points.append((rest - centre) @ R.mT + centre + 0.1 * t)
    points = torch.stack(points, 1) * motions.present[:, None, :, None, None]
    return replace(motions, points=points)


def test_rigid_fit_of_rigid_bodies_is_exact():
    motions = tumbling()
    assert_close(predict_rigid_fit(motions), motions.points, rtol=0, atol=1e-5)


def test_rigid_fit_of_soft_bodies_is_optimal():
    motions = tumbling()
    noise = 0.02 * torch.randn(motions.points.shape, generator=torch.Generator().manual_seed(1))
    noise[:, 0] = 0  # no noise in the rest shape
    soft = replace(motions, points=motions.points + noise * motions.present[:, None, :, None, None])
    fit = predict_rigid_fit(soft)
    rest, last = soft.points[1, 0, 0], fit[1, -1, 0]
    assert_close(torch.cdist(last, last), torch.cdist(rest, rest), rtol=0, atol=1e-4)
    error = (fit - soft.points).square().sum()
    assert error < (motions.points - soft.points).square().sum()  # the fit includes the motion without noise
    assert predict_rigid_fit(soft)[0, :, -1].abs().max() == 0  # the missing object


def test_the_truth_has_no_error_and_full_correlation():
    motions = without_last(falling())
    result = evaluate_predictor(predict_free_fall, motions, batch=4)
    assert result["RMSE"] < 1e-5 and result["FPE"] < 1e-5 and result["R"] > 0.9999
    assert len(result["error by frame"]) == 12 and result["scenes not finite"] == 0
    assert {name: len(curve) for name, curve in result["error by object"].items()} == {"ball": 2, "bear": 2}


def test_metrics_do_not_depend_on_the_batch_size():
    motions = without_last(falling(seed=3))

    def still(some):
        return some.points[:, :1].repeat(1, 12, 1, 1, 1)

    one, all_ = (evaluate_predictor(still, motions, batch=b) for b in (1, 6))
    assert one == all_
    world = motions.initial_conditions()
    expected = float(rmse(still(motions), motions.points, world.valid).mean())
    assert one["RMSE"] == pytest.approx(expected, rel=1e-3)
    assert one["R"] == 0  # everything falls, but nothing is predicted to move
    gap = (motions.points - motions.points[:, :1]).norm(dim=-1).mean(-1)
    assert one["error by frame"][-1] == pytest.approx(float(gap[:, -1][motions.present].mean()), rel=1e-2)
    bears = motions.objects == 1
    assert one["error by object"]["bear"][1] == pytest.approx(float(gap[:, 8][bears].mean()), rel=1e-2)


def test_nonfinite_scenes_count():
    motions = falling()

    def lost(some):
        points = predict_free_fall(some)
        points[0, -1] = math.nan
        return points

    result = evaluate_predictor(lost, motions, batch=6)
    assert result["RMSE"] is None and result["FPE"] is None and result["scenes not finite"] == 1
    assert result["R"] == pytest.approx(5 / 6, abs=1e-3) and result["error by frame"][-1] is None
    facts = {"scenes": {"spatial": 6}, "rows": {"a": {"splits": {"spatial": result}}}}
    assert "not finite" in table(facts)[1]


def test_scenes_are_matched_by_name():
    motions = falling(seed=4)
    other = replace(motions, points=motions.points + 0.01)[torch.tensor([5, 3, 0])]
    both = shared_scenes(motions, other)
    assert both.names == ("0", "3", "5")
    result = evaluate_predictor(predict_from(other, 12), both, batch=2)
    assert result["RMSE"] == pytest.approx(0.01, rel=1e-3) and result["PCE"] == pytest.approx(0, abs=1e-6)
    with pytest.raises(InputError, match="fewer frames"):
        predict_from(replace(other, points=other.points[:, :5]), 12)(both)


def test_temporal_sample_is_reproducible(data, monkeypatch):
    monkeypatch.setattr(bench_dynamics.sensitivity, "TEMPORAL_SCENES", 5)
    options = DynamicsBenchOptions(keypoints=8)
    a, b = (split_scenes(data, "temporal", options) for _ in range(2))
    assert len(a) == 5 and torch.equal(a.points, b.points)
    assert not torch.equal(a.points, split_scenes(data, "temporal", replace(options, seed=1)).points)
    assert split_scenes(data, "6 objects", options).points.shape == (2, 8, 6, 8, 3)


def test_every_model_is_measured_on_every_split(data, weights, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_dynamics, "TIMED_STEPS", 2)
    out = tmp_path / "results.json"
    nudged = tmp_path / "nudged"
    nudged.mkdir()
    for name in GROUPS:
        write_motions(nudged / f"{name}.h5", group(name, by=0.001), {})
    lines = run(data, weights, out, replace(NONE, limit=2), nudged)
    facts = json.loads(out.read_text(), parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert list(facts["rows"]) == [FREE_FALL, NUDGED, RIGID_FIT, "gcn", "transformer"]
    for row in facts["rows"].values():
        assert list(row["splits"]) == list(SPLITS)
    assert facts["rows"][FREE_FALL]["splits"]["spatial"]["RMSE"] < 1e-3  # these bodies only fall
    assert facts["rows"][NUDGED]["splits"]["temporal"]["RMSE"] == pytest.approx(1e-3, rel=0.06)  # stored to 0.1 mm
    assert facts["rows"][RIGID_FIT]["splits"]["6 objects"]["RMSE"] < 2e-4
    row = facts["rows"]["transformer"]
    assert row["seconds"] > 0 and row["card"]["minutes"] == 2.0 and row["parameters"] > 0
    assert facts["scenes"] == dict.fromkeys(SPLITS, 2) and facts["machine"] and facts["date"]
    assert facts["published, on other data"]["NGFF"]["spatial"] == [0.082, 0.326, 0.661]
    text = "\n".join(lines)
    assert text.index("transformer") < text.index("measured on other data") < text.index("Pointformer")
    assert len({len(line) for line in lines if "other data" not in line}) == 1  # columns are aligned
    assert "[\n" not in out.read_text()  # lists of numbers are single lines


def test_table_and_plots_from_results_alone(data, weights, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_dynamics, "TIMED_STEPS", 2)
    out = tmp_path / "results.json"
    lines = run(data, weights, out, NONE)
    first = {kind: out.with_suffix(kind).read_bytes() for kind in (".md", ".png")}
    for kind in first:
        out.with_suffix(kind).unlink()
    done = CliRunner().invoke(app, ["bench", "dynamics", "--from", str(out)])
    assert done.exit_code == 0 and done.stdout.splitlines() == lines, done.stderr
    assert first == {kind: out.with_suffix(kind).read_bytes() for kind in first}
    assert cv2.imread(str(out.with_suffix(".png"))).shape[:2] == (2 * PANEL_HEIGHT + LEGEND_HEIGHT, 5 * PANEL_WIDTH)
    for text in ("[]", "no", '{"rows": 3}'):
        (tmp_path / "bad.json").write_text(text)
        done = CliRunner().invoke(app, ["bench", "dynamics", "--from", str(tmp_path / "bad.json")])
        assert done.exit_code == 2 and "bad.json: contains no results" in done.stderr
    done = CliRunner().invoke(app, ["bench", "dynamics"])
    assert done.exit_code == 2 and "--data" in done.stderr


def test_other_rows_of_the_same_scenes_are_kept(data, weights, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_dynamics, "TIMED_STEPS", 2)
    out = tmp_path / "results.json"
    run(data, weights, out, NONE)
    before = json.loads(out.read_text())["rows"]
    (weights / "transformer.safetensors").unlink()
    save(weights / "gcn.safetensors", "gcn", build("gcn", hidden=8), {"runs": [{"minutes": 3.0}]})
    run(data, weights, out, NONE)
    rows = json.loads(out.read_text())["rows"]
    assert list(rows) == list(before) and rows["transformer"] == before["transformer"]
    assert rows["gcn"]["card"]["minutes"] == 3.0
    run(data, weights, out, replace(NONE, limit=1))  # previous numbers are for other scenes
    assert list(json.loads(out.read_text())["rows"]) == [FREE_FALL, RIGID_FIT, "gcn"]
    out.write_text("[]")
    with pytest.raises(InputError, match="results.json: contains no results"):
        run(data, weights, out, NONE)


def test_the_best_value_of_each_split_and_metric_is_bold():
    def row(rmse, r=0.5, **more):
        score = {"RMSE": rmse, "FPE": 0.1, "R": r}
        return {"splits": {"spatial": {**score, **more.pop("left", {})}}, **more}

    facts = {
        "machine": "m", "date": "d", "keypoints": 8, "scenes": {"spatial": 6}, "frames": {"spatial": 80},
        "rows": {FREE_FALL: row(0.02), MPM_ESTIMATED: row(0.3, left={"scenes left out": 2}),
                 "gcn": row(0.2, 0.6, card={"minutes": 3.0}),
                 "ngff": row(0.1, card={}, parameters=270_000, seconds=0.0123), "odd": row(None, card={})},
    }  # fmt: skip
    text = "\n".join(markdown("results", facts))
    assert "| `ngff` | **0.1000** / **0.100** / 0.500 | 0.0123 s | 0.27 M |  |" in text
    assert "| `gcn` | 0.2000 / **0.100** / **0.600** | - |  | 3.0 min |" in text and text.count("**") == 8
    assert "| no learning | 0.0200" in text and "not finite" in text and "3.0 min" in text
    assert "mpm-estimated: without scenes in which the solver failed: 2 of spatial." in text
    assert "| NGFF | 0.0820 / 0.326 / 0.661 | 0.363 s |" in text and "measured on other data" in text


@pytest.fixture
def simulated(tmp_path, monkeypatch):
    """One group of two scenes with a ball and a duck, and their assets; one scene has objects far outside the domain.

    It is simulated on the CPU, where runs are exactly repeatable; so are the resimulations.
    """
    shapes = {0: (0.2, 0.2, 0.2), 7: (0.1, 0.1, 0.3)}
    points = {i: box_shell(half, seed=i) for i, half in shapes.items()}
    things = {i: Asset(i, 1.0, p, particle_volumes(p, COARSE.dx), 1e5, 500.0) for i, p in points.items()}
    heights = {"a": -0.73, "b": 0.0}
    configs = {n: SceneConfig(n, (0, 7), ((0.0, 0.0, z), (0.7, 0.0, z + 0.1)), (1.0, 1.0)) for n, z in heights.items()}
    for folder in ("motions", "scene_configs"):
        (tmp_path / "set" / folder).mkdir(parents=True)
    write_scene_configs(tmp_path / "set" / "scene_configs" / "3_9.json", configs)
    options = {"dx": COARSE.dx, "spacing": COARSE.spacing, "substep": COARSE.substep, "keypoints": 60}
    settings = SimulationSettings(COARSE, 12, 60, "cpu")
    made = concatenate_motions(list(simulate(configs, things, settings)))
    write_motions(tmp_path / "set" / "motions" / "3_9.h5", made, {"options": options})
    monkeypatch.setattr(dynamics_baselines, "load_assets", lambda fineness, least, kept: things)
    return tmp_path / "set", things


def test_estimated_materials_replace_the_true_ones(simulated):
    _, things = simulated
    guess = with_estimated_materials(things)
    assert (guess[0].E, guess[0].density) == VLM_MATERIALS["ball"] and (guess[7].E, guess[7].density) == VLM_MATERIALS[
        "duck"
    ]
    assert torch.equal(guess[0].points, things[0].points) and guess[7].mass == pytest.approx(
        things[7].mass * 1100 / 500, rel=1e-6
    )


def test_resimulation_repeats_the_scenes(simulated, monkeypatch):
    data, things = simulated
    # uses the true materials
    monkeypatch.setattr(dynamics_baselines, "with_estimated_materials", lambda things: things)
    truth = split_scenes(data, "spatial", DynamicsBenchOptions(keypoints=20))
    again = Resimulation(data, ["3_9"], "cpu")(("b", "a"), 12, 20)
    result = evaluate_predictor(predict_from(again, 12), truth, batch=2)
    assert result["RMSE"] < 1e-4  # positions are stored to 0.1 mm


def test_mpm_with_estimated_materials_is_a_row_of_its_own(simulated, weights, tmp_path, monkeypatch):
    monkeypatch.setattr(bench_dynamics, "TIMED_STEPS", 2)
    data, _ = simulated
    run(data, weights, tmp_path / "r.json", DynamicsBenchOptions(keypoints=20, mpm=1))
    facts = json.loads((tmp_path / "r.json").read_text())
    row = facts["rows"][MPM_ESTIMATED]["splits"]["spatial"]
    assert list(facts["rows"])[2] == MPM_ESTIMATED and row["scenes left out"] == 0
    # stored to 0.1 mm; the estimate is 20 times as soft, so the duck lands differently
    start, later = row["error by object"]["duck"]
    assert start < 1e-4 and later > 5e-4
    assert facts["scenes"] == {"spatial": 2}


def test_data_without_provenance_are_reported(simulated):
    data, _ = simulated
    write_motions(data / "motions" / "3_9.h5", group("3_9"), {"options": {"dx": 0.02}})
    with pytest.raises(InputError, match="3_9.h5: does not record how it was simulated .no spacing.*--mpm 0"):
        Resimulation(data, ["3_9"], "cpu")


def test_folder_without_weights_is_reported(data, tmp_path):
    with pytest.raises(InputError, match="no weights"):
        run(data, tmp_path, tmp_path / "r.json", NONE)
