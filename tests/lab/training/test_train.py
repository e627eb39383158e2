"""Training: steps, checkpoints, cards and the command."""

import math
import os
import shutil
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
import torch
from torch.testing import assert_close

from ngff_cli.lab import app
from stages.core.errors import InputError, MissingPackage
from stages.core.models.checkpoints import build, load
from stages.core.scene.files import sha256
from stages.lab.dataset.keypoint_motions import read_groups, write_motions
from stages.lab.training.data import ClipSampler, train_validation_split
from stages.lab.training.options import OPTIMIZERS, TrainOptions
from stages.lab.training.rollout_loss import RolloutLoss
from stages.lab.training.state import GRADIENT_CLIP, WARMUP_STEPS, TrainingState, _optimizer
from stages.lab.training.train import run, validate
from stages.lab.training.widen import widen
from tests.conftest import CliRunner
from tests.lab.training.motions import DT, falling, without_last


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A folder with two groups of motions."""
    (tmp_path / "data" / "motions").mkdir(parents=True)
    for seed, name in enumerate(("3_0", "3_1")):
        made = {"command": f"made {name}"}
        write_motions(tmp_path / "data" / "motions" / f"{name}.h5", falling(frames=6, seed=seed), made)
    return tmp_path / "data"


QUICK = TrainOptions(steps=12, batch=2, keypoints=8, horizons="2,3", width=8, groups="3_0..3_1", checks=4)


def test_widened_network_is_the_same_function_and_trains_new_channels(device):
    torch.manual_seed(0)
    narrow = build("ngff", hidden=8).to(device).eval()
    wide = widen(narrow, 16)
    sampler = ClipSampler(without_last(falling()), device, narrow)
    clip = sampler.take(torch.tensor([0, 3]), torch.tensor([0, 5]), 4)
    (was, _), (loss, grads) = RolloutLoss(narrow, DT)(clip), RolloutLoss(wide, DT)(clip)
    assert_close(loss, was)
    new = dict(zip((name for name, _ in wide.named_parameters()), grads, strict=True))["planes.decoder.2.weight"]
    assert new.shape[1] == 16 and (new[:, 8:].abs().sum(0) > 0).all()
    with pytest.raises(InputError, match="can only be widened"):
        widen(wide, 8)


@pytest.mark.parametrize("optimizer", OPTIMIZERS)
def test_nonfinite_gradients_are_skipped(optimizer):
    state = TrainingState(build("gcn", hidden=8), 1e-2, 0, optimizer)
    good = [torch.ones_like(p) for p in state.params]
    for _ in range(2):
        state.update(good, 1e-2)
    before = [p.detach().clone() for p in state.params]
    usual = state.gradient_norm.clone()
    state.update([torch.full_like(good[0], math.nan), *good[1:]], 1e-2)
    assert all(torch.equal(a, b) for a, b in zip(before, state.params, strict=True))
    assert torch.equal(usual, state.gradient_norm)
    state.record({"RMSE": 1.0})
    assert state.curve[-1]["skipped"] == 1
    state.update(good, 1e-2)
    assert not any(torch.equal(a, b) for a, b in zip(before, state.params, strict=True))


def test_missing_soap_package_is_reported(monkeypatch):
    monkeypatch.setitem(sys.modules, "pytorch_optimizer", None)
    with pytest.raises(MissingPackage, match=r"ngff\[train\]"):
        TrainingState(build("gcn", hidden=8), 1e-2, 0, "soap")


def test_soap_minimises_an_ill_conditioned_quadratic():
    """With condition number 1e6 and rotated axes, SOAP finds the eigenvectors, where Adam would stagnate."""
    rng = torch.Generator().manual_seed(0)
    turn = torch.linalg.qr(torch.randn(8, 8, generator=rng))[0]
    H = (turn * 10.0 ** torch.linspace(-3, 3, 8)) @ turn.T
    wanted = torch.randn(8, 8, generator=rng)
    left = {}
    for kind in OPTIMIZERS:
        weight = torch.nn.Parameter(torch.zeros(8, 8))
        steps = _optimizer(kind, [weight], 0.03)
        for step in range(1500):
            weight.grad = (weight.detach() - wanted) @ H
            steps.param_groups[0]["lr"] = 0.03 * (1 - step / 1500)
            steps.step()
        left[kind] = float((weight.detach() - wanted).norm() / wanted.norm())
    assert left["soap"] < 0.05 < 0.2 < left["adamw"]


def test_gradients_are_clipped_to_twice_the_average_norm():
    state = TrainingState(build("gcn", hidden=8), 1e-3, 0)
    good = [torch.ones_like(p) for p in state.params]
    state.update(good, 1e-3)
    usual = float(state.gradient_norm)
    state.update([1e4 * g for g in good], 1e-3)
    assert float(torch.stack([p.grad.square().sum() for p in state.params]).sum().sqrt()) == pytest.approx(
        GRADIENT_CLIP * usual, rel=1e-4
    )
    assert float(state.gradient_norm) == pytest.approx(usual * (0.99 + 0.01 * GRADIENT_CLIP), rel=1e-4)


def test_divergence_restarts_from_the_best_at_half_rate():
    state = TrainingState(build("gcn", hidden=8), 1e-2, 0)
    good = [torch.ones_like(p) for p in state.params]
    state.update(good, 1e-2)
    state.record({"RMSE": 0.1})
    best = {k: v.clone() for k, v in state.best.items()}
    state.update(good, 1e-2)
    state.record({"RMSE": 0.12})  # slightly worse results do not cause a restart
    assert state.rate_factor == 1.0
    assert not all(torch.equal(v, best[k]) for k, v in state.model.state_dict().items())
    state.update(good, 1e-2)
    state.record({"RMSE": math.inf})
    assert state.rate_factor == 0.5
    for network in (state.model, state.ema):
        assert all(torch.equal(v, best[k]) for k, v in network.state_dict().items())
    state.update(good, 1e-2)
    assert state.optimizer.param_groups[0]["lr"] == pytest.approx(0.5e-2 / WARMUP_STEPS)
    moved = max(float((p.detach() - best[n]).abs().max()) for n, p in state.model.named_parameters())
    assert moved == pytest.approx(0.5e-2 / WARMUP_STEPS, rel=0.01)  # the moments were reset, as in a first step of Adam


@pytest.mark.parametrize(("after", "factor"), [((1.01, 1.02, 1.03, 1.04), 0.5), ((1.01, 1.02, 1.03, 1.02, 1.03), 1.0)])
def test_repeated_worsening_is_divergence(after, factor):
    state = TrainingState(build("gcn"), 1e-3, 0)
    for rmse in (1.2, 1.0, *after):
        state.record({"RMSE": rmse})
    assert state.rate_factor == factor


def test_a_new_horizon_resets_moments_and_warm_up():
    state = TrainingState(build("gcn", hidden=8), 1e-2, 0)
    state.start_horizon(8)
    for _ in range(WARMUP_STEPS):
        state.update([torch.ones_like(p) for p in state.params], 1e-2)
    assert state.optimizer.param_groups[0]["lr"] == 1e-2
    before = [p.detach().clone() for p in state.params]
    state.start_horizon(20)
    state.update([100 * torch.ones_like(p) for p in state.params], 1e-2)
    step = max(float((p.detach() - q).abs().max()) for p, q in zip(state.params, before, strict=True))
    assert step == pytest.approx(1e-2 / WARMUP_STEPS, rel=0.01)  # independent of the size of the gradients


@pytest.mark.usefixtures("device")
def test_training_learns_free_fall(tmp_path):
    """A graph network learns gravity from scratch."""
    write_motions(tmp_path / "3_0.h5", falling(scenes=30, n=6, frames=6), {})
    options = replace(QUICK, steps=80, batch=8, keypoints=6, horizons="1", lr=2e-2, width=16, groups="3_0")
    torch.manual_seed(options.seed)
    unseen = train_validation_split(read_groups(tmp_path, ["3_0"], 6), 100)[1]
    before = validate(build("gcn", hidden=16), unseen)["RMSE"]
    run("gcn", tmp_path, tmp_path / "gcn.safetensors", options)
    card = load(tmp_path / "gcn.safetensors")[1]
    assert card["runs"][0]["validation"]["RMSE"] < 0.2 * before
    assert card["curve"]["loss"][-1] < 0.1 * card["curve"]["loss"][0]


def test_card_records_the_training(data, tmp_path, device):
    lines = run("gcn", data, tmp_path / "a.safetensors", QUICK)
    model, card = load(tmp_path / "a.safetensors")
    assert str(tmp_path / "a.safetensors") in lines[0]
    (record,) = card["runs"]
    assert record["data"] == {name: sha256(data / "motions" / f"{name}.h5")[:16] for name in ("3_0", "3_1")}
    assert (record["scenes"], record["validation scenes"], record["steps"], record["finished"]) == (8, 4, 12, True)
    assert record["seed"] == card["options"]["seed"] == 0 and card["config"]["hidden"] == 8
    assert card["curve"]["horizon"] == [2, 2, 3, 3]
    unseen = train_validation_split(read_groups(data, ["3_0", "3_1"], 8), 100)[1]
    assert record["validation"]["RMSE"] == pytest.approx(min(card["curve"]["RMSE"]), rel=1e-4)
    rounding = 1e-6 if device == "cpu" else 1e-2  # on a GPU, training multiplies matrices in TF32
    assert validate(model, unseen)["RMSE"] == pytest.approx(record["validation"]["RMSE"], rel=rounding)


@pytest.mark.parametrize(("after", "optimizer"), [(1, "adamw"), (5, "adamw"), (5, "soap")])
def test_resumed_training_repeats_the_curve(data, tmp_path, monkeypatch, after, optimizer):
    options = replace(QUICK, optimizer=optimizer, device="cpu")  # results on the CPU are exactly repeatable
    run("pointformer", data, tmp_path / "whole.safetensors", options)  # includes dropout
    with monkeypatch.context() as patch:
        update = TrainingState.update

        def stopped(self, grads, lr):
            update(self, grads, lr)
            if self.step == after:
                os.kill(os.getpid(), signal.SIGTERM)

        patch.setattr(TrainingState, "update", stopped)
        lines = run("pointformer", data, tmp_path / "parts.safetensors", options)
    assert "--resume" in lines[0] and not load(tmp_path / "parts.safetensors")[1]["runs"][0]["finished"]
    run("pointformer", data, tmp_path / "parts.safetensors", options, resume=True)
    (a, whole), (b, parts) = (load(tmp_path / f"{name}.safetensors") for name in ("whole", "parts"))
    assert parts["runs"][0]["finished"] and parts["runs"][0]["steps"] == 12

    def rows(card):
        columns = [card["curve"][key] for key in ("step", "horizon", "RMSE", "R")]
        return dict(zip(card["curve"]["step"], zip(*columns, strict=True), strict=True))

    extra = rows(parts).keys() - rows(whole).keys()
    assert len(extra) == (after == 1)  # a stop before the first validation adds one, which is needed to save weights
    assert rows(whole) == {step: row for step, row in rows(parts).items() if step not in extra}
    for p, q in zip(a.parameters(), b.parameters(), strict=True):
        assert torch.equal(p, q)


@pytest.mark.usefixtures("device")
def test_training_from_weights_extends_their_runs(data, tmp_path):
    first, second = tmp_path / "first.safetensors", tmp_path / "second.safetensors"
    run("gcn", data, first, QUICK)
    still = replace(QUICK, steps=1, lr=1e-9, width=0)
    run("gcn", data, second, still, start=first)
    (a, before), (b, card) = load(first), load(second)
    assert card["runs"][0] == {**before["runs"][0], "sha256": before["sha256"]}
    assert len(card["runs"]) == 2 and card["runs"][1]["steps"] == 1 and "sha256" not in card["runs"][1]
    for p, q in zip(a.parameters(), b.parameters(), strict=True):
        assert_close(p, q, rtol=0, atol=1e-8)
    run("gcn", data, second, still, resume=True, start=first)
    with pytest.raises(InputError, match="different values of from"):
        run("gcn", data, second, still, resume=True)
    for wrong in ({"model": "ngff"}, {"model": "gcn", "options": replace(still, width=16)}):
        with pytest.raises(InputError, match="first.safetensors: holds gcn"):
            run(**{"data": data, "out": second, "options": still, "start": first, **wrong})


def test_other_checkpoints_are_rejected(data, tmp_path):
    out = tmp_path / "a.safetensors"
    with pytest.raises(InputError, match="no such file"):
        run("gcn", data, out, QUICK, resume=True)
    run("gcn", data, out, replace(QUICK, steps=2))
    with pytest.raises(InputError, match="different values of steps, lr"):
        run("gcn", data, out, replace(QUICK, lr=0.1), resume=True)
    other = shutil.copytree(data, tmp_path / "other")
    with h5py.File(next(other.rglob("3_0.h5")), "a") as file:
        file.attrs["note"] = "made again"
    with pytest.raises(InputError, match="different values of data"):
        run("gcn", other, out, replace(QUICK, steps=2), resume=True)
    state = torch.load(out.with_suffix(".ckpt"), weights_only=True)
    torch.save({k: v for k, v in state.items() if k != "optimizer"}, out.with_suffix(".ckpt"))
    with pytest.raises(InputError, match="a.ckpt: cannot be read as a checkpoint of a training"):
        run("gcn", data, out, replace(QUICK, steps=2), resume=True)
    out.with_suffix(".ckpt").write_bytes(b"broken")
    with pytest.raises(InputError, match="checkpoint"):
        run("gcn", data, out, QUICK, resume=True)


def test_nonfinite_rmse_is_infinite():
    class Lost:
        def eval(self):
            pass

        def rollout(self, world, frames, dt):
            points = world.points[:, None].repeat(1, frames, 1, 1, 1)
            points[0] = math.nan
            return points

    assert validate(Lost(), falling())["RMSE"] == math.inf


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"groups": "3_0..3_2"}, "3_2.h5"),
        ({"keypoints": 9}, "8 keypoints"),
        ({"horizons": "3,8"}, "6 frames"),
        ({"horizons": "8,x"}, "--horizons"),
        ({"lr": 0.0}, "--lr"),
        ({"sparse_keypoints": 9}, "--sparse-keypoints"),
        ({"optimizer": "newton"}, "--optimizer newton"),
        ({"velocity_weight": -0.1}, "--velocity-weight"),
    ],
)
def test_unusable_data_and_options_are_reported(data, tmp_path, change, message):
    with pytest.raises(InputError, match=message):
        run("ngff", data, tmp_path / "a.safetensors", replace(QUICK, **change))
    assert not (tmp_path / "a.safetensors").exists()


@pytest.mark.usefixtures("device")
def test_every_fourth_step_uses_fewer_keypoints(data, tmp_path, monkeypatch):
    seen, draw = [], ClipSampler.draw

    def watched(self, *args):
        clip = draw(self, *args)
        seen.append(clip.points.shape[2])
        return clip

    monkeypatch.setattr(ClipSampler, "draw", watched)
    run("ngff", data, tmp_path / "a.safetensors", replace(QUICK, steps=6, sparse_keypoints=4, velocity_weight=0.1))
    assert seen == [4, 8, 8, 8, 4, 8]


@pytest.mark.usefixtures("device")
def test_the_command_trains(data, tmp_path):
    out = tmp_path / "gcn.safetensors"
    words = "--steps 2 --batch 2 --keypoints 8 --sparse-keypoints 4 --velocity-weight 0.1 --horizons 3"
    words += f" --loss relative --width 8 --groups 3_0,3_1 -o {out}"
    result = CliRunner().invoke(app, ["train", "gcn", "--data", str(data), *words.split()])
    assert result.exit_code == 0, result.output
    assert "RMSE" in result.stdout
    assert load(out)[1]["runs"][0]["steps"] == 2


@pytest.mark.slow
def test_two_processes_equal_one_with_the_whole_batch(data, tmp_path):
    """Each process computes half of every batch and gradients are averaged, so only the order of sums differs.

    It runs on the CPU, because two processes cannot use one GPU.
    """
    words = ["train", "gcn", "--data", str(data), "--device", "cpu"]
    words += ["--steps", "6", "--batch", "4", "--keypoints", "8", "--horizons", "3", "--width", "8"]
    words += ["--groups", "3_0,3_1"]
    assert CliRunner().invoke(app, [*words, "-o", str(tmp_path / "one.safetensors")]).exit_code == 0
    command = f"from ngff_cli.lab import app; app({[*words, '-o', str(tmp_path / 'two.safetensors')]!r})"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        place = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(probe.getsockname()[1]), "OMP_NUM_THREADS": "1"}
    crew = [
        subprocess.Popen([sys.executable, "-c", command], stderr=subprocess.PIPE, text=True,
                         env={**os.environ, **place, "WORLD_SIZE": "2", "RANK": str(i), "LOCAL_RANK": str(i)})
        for i in range(2)
    ]  # fmt: skip
    for process in crew:
        error = process.communicate(timeout=600)[1]
        assert process.returncode == 0, error
    (one, _), (two, card) = (load(tmp_path / f"{name}.safetensors") for name in ("one", "two"))
    assert card["runs"][0]["processes"] == 2 and card["runs"][0]["steps"] == 6
    for p, q in zip(one.parameters(), two.parameters(), strict=True):
        assert_close(p, q, rtol=1e-3, atol=1e-5)


def test_indivisible_batch_is_rejected(data, tmp_path, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(InputError, match="multiple of 2"):
        run("gcn", data, tmp_path / "a.safetensors", replace(QUICK, batch=3))
