"""Training: sampler, loss, gradients, steps, checkpoints, and the command."""

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
from stages.core.errors import InputError
from stages.core.models.checkpoints import MODELS, build, load
from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import BOX, GRAVITY
from stages.core.scene.files import sha256
from stages.lab.dataset.keypoint_motions import KeypointMotions, write_motions
from stages.lab.training.data import (
    MAX_SPEED_CHANGE,
    ClipSampler,
    ends_at_rest,
    motion_spread,
    read_groups,
    smooth_frames,
    train_validation_split,
)
from stages.lab.training.rollout_loss import LossOptions, RolloutLoss, keypoint_loss, velocity_loss
from stages.lab.training.state import GRADIENT_CLIP, OPTIMIZERS, WARMUP_STEPS, TrainingState, _optimizer
from stages.lab.training.train import TrainOptions, run, validate
from stages.lab.training.widen import widen
from tests.conftest import CliRunner

DT = 0.02
FLOOR = BOX[0][2]


def falling(scenes: int = 6, frames: int = 12, objects: int = 2, n: int = 8, seed: int = 0) -> KeypointMotions:
    """Balls of points that fall from different heights and stay where their lowest point meets the floor."""
    rng = torch.Generator().manual_seed(seed)
    shape = 0.1 * torch.nn.functional.normalize(torch.randn(scenes, objects, n, 3, generator=rng), dim=-1)
    centre = torch.rand(scenes, objects, 3, generator=rng) - 0.5
    centre[..., 2] = FLOOR + 0.1 + 0.1 * torch.rand(scenes, objects, generator=rng)
    start = centre[:, :, None] + shape
    fallen = -GRAVITY[2] * (DT * torch.arange(frames)).square() / 2
    room = start[..., 2].amin(-1) - FLOOR
    points = start[:, None].repeat(1, frames, 1, 1, 1)
    points[..., 2] -= torch.minimum(fallen[None, :, None], room[:, None])[..., None]
    one = torch.ones(scenes, objects)
    ids = torch.arange(objects).expand(scenes, objects).clone()
    return KeypointMotions(tuple(map(str, range(scenes))), ids, points, 0.1 * one, 1e5 * one, 0.3 * one, 0.5 * one, DT,
                   GRAVITY, BOX, one)  # fmt: skip


def without_last(motions: KeypointMotions) -> KeypointMotions:
    """The last object of scene 0 is padding."""
    ids, points = motions.objects.clone(), motions.points.clone()
    ids[0, -1], points[0, :, -1] = -1, 0
    return replace(motions, objects=ids, points=points)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A folder with two groups."""
    (tmp_path / "data" / "motions").mkdir(parents=True)
    for seed, name in enumerate(("3_0", "3_1")):
        made = {"command": f"made {name}"}
        write_motions(tmp_path / "data" / "motions" / f"{name}.h5", falling(frames=6, seed=seed), made)
    return tmp_path / "data"


QUICK = TrainOptions(steps=12, batch=2, keypoints=8, horizons="2,3", width=8, groups="3_0..3_1", checks=4)


def untrained_sampler(motions: KeypointMotions, device: str) -> ClipSampler:
    return ClipSampler(motions, device, build("gcn", hidden=8).to(device))


def test_clips_start_with_the_velocity_of_free_fall(device):
    motions = falling(frames=6)
    clip = untrained_sampler(motions, device).take(torch.tensor([1, 4]), torch.tensor([0, 2]), 3)
    points, truth, speed = clip.points.cpu(), clip.truth.cpu(), clip.speed.cpu()
    assert_close(points, torch.stack([motions.points[1, 0], motions.points[4, 2]]))
    assert_close(truth, torch.stack([motions.points[1, 1:4], motions.points[4, 3:6]]))
    assert_close(speed[0], torch.zeros(2, 8, 3))
    # central differences are exact for a parabola: only rounding of positions near 1, over 2 dt, is left
    assert_close(speed[1], torch.tensor([0.0, 0.0, GRAVITY[2] * 2 * DT]).expand(2, 8, 3), rtol=0, atol=1e-5)


def test_clips_end_within_the_motion(device):
    sampler, rng = untrained_sampler(falling(frames=5), device), torch.Generator().manual_seed(0)
    starts = {float(sampler.draw(1, 3, rng).speed[0, 0, 0, 2]) for _ in range(40)}
    assert len(starts) == 2  # frames 0 and 1 are all that leave 3 more


def test_scenes_at_rest_are_continued_at_rest(device):
    """One scene falls to its last frame, the other is at rest at its end."""
    motions = falling(frames=12)[:2]
    motions.points[1, 5:] = motions.points[1, 5:6]
    assert ends_at_rest(motions).tolist() == [False, True]
    sampler, rng = untrained_sampler(motions, device), torch.Generator().manual_seed(0)
    heights = sampler.draw(300, 9, rng).points[:, 0, 0, 2].cpu()
    assert len(heights.unique()) == 3 + 6  # one starts in frames 0 to 2, the other also in those in which it rests
    assert float((heights == motions.points[1, 11, 0, 0, 2]).float().mean()) > 0.2
    late = sampler.take(torch.tensor([1]), torch.tensor([11]), 9)
    assert_close(late.truth.cpu(), motions.points[1:, 11:].expand(1, 9, 2, 8, 3))
    assert not late.speed.any()


def test_clips_do_not_begin_amid_an_impact(device):
    """A ball hit between two frames, in which central differences are far from its velocity."""
    motions = falling(frames=12)[:1]
    hit = torch.arange(12)[:, None, None, None] * torch.tensor([0.0, 0.0, 0.02])
    motions.points[:] = motions.points[:, :1] + torch.where(torch.arange(12)[:, None, None, None] < 5, 0.0, hit - 0.09)
    assert smooth_frames(motions)[0].tolist() == [t not in (4, 5) for t in range(12)]
    sampler, rng = untrained_sampler(motions, device), torch.Generator().manual_seed(0)
    speeds = sampler.draw(200, 3, rng).speed[:, 0, 0, 2]
    for speed in speeds.unique():
        assert min(abs(float(speed)), abs(float(speed) - 1.0)) < 1e-5
    assert (speeds > 0.5).any() and (speeds < 0.5).any()


def test_spread_is_the_rms_motion_of_an_objects_points():
    motions = falling(frames=9)[:2]
    x = motions.points[1, :, 1]
    assert_close(motion_spread(motions)[1, 1], (x - x.mean(0)).square().mean((0, 1)).sqrt())


def test_losses_of_known_errors():
    truth = torch.zeros(1, 2, 2, 4, 3)
    valid = torch.tensor([[[True] * 4, [False] * 4]])
    predicted = truth.clone()
    predicted[:, :, 0, :, 2] = 0.01
    predicted[:, :, 1] = 7.0  # padding does not count
    spread = torch.tensor([[[0.0, 0.0, 0.04], [0.0, 0.0, 0.0]]])
    assert_close(keypoint_loss(predicted, truth, valid, "square", spread), torch.tensor(1 / 3))
    assert_close(keypoint_loss(predicted, truth, valid, "scene", spread), torch.tensor((1 / 3 + 0.01) ** 0.5))
    assert_close(keypoint_loss(predicted, truth, valid, "axes", spread), torch.tensor((0.1 + 0.1 + 1.01**0.5) / 3))
    relative = keypoint_loss(
        predicted, truth, valid, "relative", spread
    )  # to 1 cm more than the spread, 5 cm being usual
    assert_close(relative, torch.tensor((0.1 * 5 + 0.1 * 5 + 1.01**0.5) / 3))


def test_velocity_loss_sees_oscillations():
    """Velocities of 1 m/s that change their sign each frame move nothing. A frame amid an impact does not count."""
    weighed = LossOptions("square", velocity_time=0.1)
    points = torch.zeros(1, 7, 1, 4, 3)
    valid, spread = torch.ones(1, 1, 4, dtype=torch.bool), torch.zeros(1, 1, 3)
    ringing = torch.zeros(1, 6, 1, 4, 3)
    ringing[..., 0] = (-1.0) ** torch.arange(6)[None, :, None, None]
    assert velocity_loss(0 * ringing, points, valid, spread, DT, weighed) == 0
    assert_close(velocity_loss(ringing, points, valid, spread, DT, weighed), torch.tensor(10.0**2 / 3))
    points[:, 4:, ..., 2] = (
        2 * MAX_SPEED_CHANGE * DT * torch.arange(3)[None, :, None, None] + MAX_SPEED_CHANGE * DT * 2
    )  # hit after frame 3
    free = torch.zeros(1, 6, 1, 4, 3)
    free[:, 3:, ..., 2] = 2 * MAX_SPEED_CHANGE
    assert_close(velocity_loss(free, points, valid, spread, DT, weighed), torch.tensor(0.0), rtol=0, atol=1e-5)


def test_widened_network_is_the_same_function_and_trains_new_channels(device):
    torch.manual_seed(0)
    narrow = build("ngff", hidden=8).to(device).eval()
    wide = widen(narrow, 16)
    sampler = ClipSampler(without_last(falling()), device, narrow)
    clip = sampler.take(torch.tensor([0, 3]), torch.tensor([0, 5]), 4)
    (was, _), (loss, grads) = RolloutLoss(narrow, DT)(clip), RolloutLoss(wide, DT)(clip)
    assert_close(loss, was)
    new = dict(zip((name for name, _ in wide.named_parameters()), grads, strict=True))["planes.say.2.weight"]
    assert new.shape[1] == 16 and (new[:, 8:].abs().sum(0) > 0).all()
    with pytest.raises(InputError, match="can only be widened"):
        widen(wide, 8)


@pytest.mark.parametrize("name", MODELS)
def test_gradients_match_autograd_of_the_rollout(name, device):
    """The gradient through the prepared scene is chained by hand; autograd of the whole rollout is the reference."""
    torch.manual_seed(0)
    model = build(name, hidden=8).to(device).eval()  # no dropout
    sampler = ClipSampler(without_last(falling()), device, model)
    clip = sampler.take(torch.tensor([0, 3]), torch.tensor([0, 5]), 3)
    loss, grads = RolloutLoss(model, DT)(clip)
    predicted = model.rollout(clip.world, 4, DT, start=(clip.points, clip.speed))[:, 1:]
    whole = keypoint_loss(predicted, clip.truth, clip.world.valid, "square", clip.spread)
    whole.backward()
    assert_close(loss, whole.detach())
    assert sum(float(g.abs().sum()) for g in grads) > 0
    rounding = {"rtol": 1e-4, "atol": 1e-6} if device == "cpu" else {"rtol": 1e-3, "atol": 1e-5}  # sums in any order
    for p, g in zip(model.parameters(), grads, strict=True):
        assert_close(g, torch.zeros_like(p) if p.grad is None else p.grad, **rounding)


@pytest.mark.parametrize(("broken", "why"), [(True, "fails"), (False, "not finite")])
def test_failed_compilation_falls_back(monkeypatch, caplog, broken, why):
    """Neither a failing compiler nor one with wrong gradients stops or spoils training."""

    def compile(function, **_):
        def wrong(*given):
            if broken:
                raise IndexError("tuple index out of range")
            *state, points = function(*given)
            return (*state, points * torch.nan)

        return wrong

    torch.manual_seed(0)
    model = build("gcn", hidden=8).eval()
    clip = ClipSampler(without_last(falling()), "cpu", model).take(torch.tensor([0]), torch.tensor([0]), 2)
    with monkeypatch.context() as patch:
        patch.setattr(torch, "compile", compile)
        loss, grads = RolloutLoss(model, DT, compiled=True)(clip)
    assert why in caplog.text
    plain, true = RolloutLoss(model, DT)(clip)
    assert_close(loss, plain)
    for a, b in zip(grads, true, strict=True):
        assert_close(a, b)


def test_gradient_discount_shrinks_gradients_of_early_frames(device):
    """A gradient that goes back two frames is multiplied by 0.9^2."""
    torch.manual_seed(0)
    model = build("gcn", hidden=8).to(device).eval()
    clip = ClipSampler(without_last(falling()), device, model).take(torch.tensor([0]), torch.tensor([0]), 3)

    def gradient(discount):
        return torch.cat(
            [g.flatten() for g in RolloutLoss(model, DT, LossOptions(gradient_discount=discount))(clip)[1]]
        )

    none, full = gradient(0.0), gradient(1.0)
    far = [(gradient(m) - none).norm() for m in (0.25, 0.5)]
    assert none.norm() > 0 and (full - none).norm() > 0
    assert 2 <= far[1] / far[0] <= 4  # of one frame back half as much, of two a quarter


def test_absent_and_zero_forces_are_equal():
    world = without_last(falling()).initial_conditions()
    none, idle = ExternalForces.none_for(world.valid, world.points), ExternalForces.none(world)
    # a push of no strength goes all the way that a real one goes
    weak = replace(idle, object=idle.object.new_zeros(6, 1), point=idle.point.new_zeros(6, 1) - 1,
                   force=torch.zeros(6, 1, 3), torque=torch.zeros(6, 1, 3), start=torch.zeros(6, 1),
                   end=torch.ones(6, 1))  # fmt: skip
    com = torch.zeros(6, 2, 3)
    for pushes in (none, idle):
        assert_close(pushes.acceleration(world, world.points, 0.0), weak.acceleration(world, world.points, 0.0))
        assert_close(pushes.wrench(world.points, com, 0.0, DT), weak.wrench(world.points, com, 0.0, DT))


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
    with pytest.raises(InputError, match=r"ngff\[train\]"):
        TrainingState(build("gcn", hidden=8), 1e-2, 0, "soap")


def test_soap_minimises_an_ill_conditioned_quadratic():
    """Condition number 1e6, rotated axes: SOAP finds the eigenvectors, where Adam would stall."""
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
    state.record({"RMSE": 0.12})  # a little worse: so it goes
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
    assert moved == pytest.approx(0.5e-2 / WARMUP_STEPS, rel=0.01)  # a first step of Adam: the moments were reset


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
    assert step == pytest.approx(1e-2 / WARMUP_STEPS, rel=0.01)  # however much larger gradients have become


@pytest.mark.usefixtures("device")
def test_training_learns_free_fall(tmp_path):
    """A graph network from scratch learns gravity."""
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
    rounding = 1e-6 if device == "cpu" else 1e-2  # training on a GPU multiplies matrices in TF32
    assert validate(model, unseen)["RMSE"] == pytest.approx(record["validation"]["RMSE"], rel=rounding)


@pytest.mark.parametrize(("after", "optimizer"), [(1, "adamw"), (5, "adamw"), (5, "soap")])
def test_resumed_training_repeats_the_curve(data, tmp_path, monkeypatch, after, optimizer):
    options = replace(QUICK, optimizer=optimizer, device="cpu")  # where results repeat to the bit
    run("pointformer", data, tmp_path / "whole.safetensors", options)  # with dropout
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
    assert len(extra) == (after == 1)  # stopped before the first validation: one is needed to save weights at all
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
    with pytest.raises(InputError, match="another from"):
        run("gcn", data, second, still, resume=True)
    for wrong in ({"model": "ngff"}, {"model": "gcn", "options": replace(still, width=16)}):
        with pytest.raises(InputError, match="first.safetensors: holds gcn"):
            run(**{"data": data, "out": second, "options": still, "start": first, **wrong})


def test_other_checkpoints_are_rejected(data, tmp_path):
    out = tmp_path / "a.safetensors"
    with pytest.raises(InputError, match="no such file"):
        run("gcn", data, out, QUICK, resume=True)
    run("gcn", data, out, replace(QUICK, steps=2))
    with pytest.raises(InputError, match="another steps, lr"):
        run("gcn", data, out, replace(QUICK, lr=0.1), resume=True)
    other = shutil.copytree(data, tmp_path / "other")
    with h5py.File(next(other.rglob("3_0.h5")), "a") as file:
        file.attrs["note"] = "made again"
    with pytest.raises(InputError, match="another data"):
        run("gcn", other, out, replace(QUICK, steps=2), resume=True)
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
    """Each computes half of every batch and gradients are averaged: only the order of sums differs."""
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
        error = process.communicate(timeout=120)[1]
        assert process.returncode == 0, error
    (one, _), (two, card) = (load(tmp_path / f"{name}.safetensors") for name in ("one", "two"))
    assert card["runs"][0]["processes"] == 2 and card["runs"][0]["steps"] == 6
    for p, q in zip(one.parameters(), two.parameters(), strict=True):
        assert_close(p, q, rtol=1e-3, atol=1e-5)


def test_indivisible_batch_is_rejected(data, tmp_path, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(InputError, match="multiple of 2"):
        run("gcn", data, tmp_path / "a.safetensors", replace(QUICK, batch=3))


@pytest.mark.gpu
@pytest.mark.parametrize("name", MODELS)
def test_cuda_graph_equals_eager(name):
    torch.manual_seed(0)
    model = build(name, hidden=16).cuda().eval()
    sampler, rng = ClipSampler(without_last(falling()), "cuda", model), torch.Generator().manual_seed(0)
    recorded, plain = RolloutLoss(model, DT), RolloutLoss(model, DT, graph=False)
    for _ in range(3):
        clip = sampler.draw(4, 3, rng)
        (loss, grads), (loss_, grads_) = recorded(clip), plain(clip)
        assert recorded.graph is not None
        assert_close(loss, loss_)
        for a, b in zip(grads, grads_, strict=True):
            assert_close(a, b, rtol=1e-3, atol=1e-5)
