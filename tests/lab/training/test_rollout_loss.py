"""Clips of motions, and the loss and gradient of a rollout."""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from stages.core.models.checkpoints import MODELS, build
from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import GRAVITY
from stages.lab.dataset.keypoint_motions import KeypointMotions
from stages.lab.training.data import (
    MAX_SPEED_CHANGE,
    ClipSampler,
    ends_at_rest,
    motion_spread,
    smooth_frames,
)
from stages.lab.training.rollout_loss import LossOptions, RolloutLoss, keypoint_loss, velocity_loss
from tests.lab.training.motions import DT, falling, without_last


def untrained_sampler(motions: KeypointMotions, device: str) -> ClipSampler:
    return ClipSampler(motions, device, build("gcn", hidden=8).to(device))


def test_clips_start_with_the_velocity_of_free_fall(device):
    motions = falling(frames=6)
    clip = untrained_sampler(motions, device).take(torch.tensor([1, 4]), torch.tensor([0, 2]), 3)
    points, truth, speed = clip.points.cpu(), clip.truth.cpu(), clip.speed.cpu()
    assert_close(points, torch.stack([motions.points[1, 0], motions.points[4, 2]]))
    assert_close(truth, torch.stack([motions.points[1, 1:4], motions.points[4, 3:6]]))
    assert_close(speed[0], torch.zeros(2, 8, 3))
    # central differences are exact for a parabola, up to rounding of positions near 1, divided by 2 dt
    assert_close(speed[1], torch.tensor([0.0, 0.0, GRAVITY[2] * 2 * DT]).expand(2, 8, 3), rtol=0, atol=1e-5)


def test_clips_end_within_the_motion(device):
    sampler, rng = untrained_sampler(falling(frames=5), device), torch.Generator().manual_seed(0)
    starts = {float(sampler.draw(1, 3, rng).speed[0, 0, 0, 2]) for _ in range(40)}
    assert len(starts) == 2  # only frames 0 and 1 have 3 later frames


def test_scenes_at_rest_are_continued_at_rest(device):
    """One scene falls until its last frame, the other is at rest at its end."""
    motions = falling(frames=12)[:2]
    motions.points[1, 5:] = motions.points[1, 5:6]
    assert ends_at_rest(motions).tolist() == [False, True]
    sampler, rng = untrained_sampler(motions, device), torch.Generator().manual_seed(0)
    heights = sampler.draw(300, 9, rng).points[:, 0, 0, 2].cpu()
    assert len(heights.unique()) == 3 + 6  # one scene starts in frames 0 to 2, the other also in its frames at rest
    assert float((heights == motions.points[1, 11, 0, 0, 2]).float().mean()) > 0.2
    late = sampler.take(torch.tensor([1]), torch.tensor([11]), 9)
    assert_close(late.truth.cpu(), motions.points[1:, 11:].expand(1, 9, 2, 8, 3))
    assert not late.speed.any()


def test_clips_do_not_begin_amid_an_impact(device):
    """A ball is hit between two frames, at which central differences are far from its velocity."""
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
    predicted[:, :, 1] = 7.0  # padding must not count
    spread = torch.tensor([[[0.0, 0.0, 0.04], [0.0, 0.0, 0.0]]])
    assert_close(keypoint_loss(predicted, truth, valid, "square", spread), torch.tensor(1 / 3))
    assert_close(keypoint_loss(predicted, truth, valid, "scene", spread), torch.tensor((1 / 3 + 0.01) ** 0.5))
    assert_close(keypoint_loss(predicted, truth, valid, "axes", spread), torch.tensor((0.1 + 0.1 + 1.01**0.5) / 3))
    relative = keypoint_loss(
        predicted, truth, valid, "relative", spread
    )  # relative to the spread plus 1 cm; the reference is 5 cm
    assert_close(relative, torch.tensor((0.1 * 5 + 0.1 * 5 + 1.01**0.5) / 3))


def test_velocity_loss_sees_oscillations():
    """Velocities of 1 m/s with alternating signs cause no displacement. A frame during an impact does not count."""
    weighed = LossOptions("square", velocity_time=0.1)
    points = torch.zeros(1, 7, 1, 4, 3)
    valid, spread = torch.ones(1, 1, 4, dtype=torch.bool), torch.zeros(1, 1, 3)
    ringing = torch.zeros(1, 6, 1, 4, 3)
    ringing[..., 0] = (-1.0) ** torch.arange(6)[None, :, None, None]
    assert velocity_loss(0 * ringing, points, valid, spread, DT, weighed) == 0
    assert_close(velocity_loss(ringing, points, valid, spread, DT, weighed), torch.tensor(10.0**2 / 3))
    points[:, 4:, ..., 2] = (
        2 * MAX_SPEED_CHANGE * DT * torch.arange(3)[None, :, None, None] + MAX_SPEED_CHANGE * DT * 2
    )  # it is hit after frame 3
    free = torch.zeros(1, 6, 1, 4, 3)
    free[:, 3:, ..., 2] = 2 * MAX_SPEED_CHANGE
    assert_close(velocity_loss(free, points, valid, spread, DT, weighed), torch.tensor(0.0), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_gradients_match_autograd_of_the_rollout(name, device):
    """The gradient through the prepared scene is computed by hand; the reference is autograd of the whole rollout."""
    torch.manual_seed(0)
    model = build(name, hidden=8).to(device).eval()  # without dropout
    sampler = ClipSampler(without_last(falling()), device, model)
    clip = sampler.take(torch.tensor([0, 3]), torch.tensor([0, 5]), 3)
    loss, grads = RolloutLoss(model, DT)(clip)
    predicted = model.rollout(clip.world, 4, DT, start=(clip.points, clip.speed))[:, 1:]
    whole = keypoint_loss(predicted, clip.truth, clip.world.valid, "square", clip.spread)
    whole.backward()
    assert_close(loss, whole.detach())
    assert sum(float(g.abs().sum()) for g in grads) > 0
    # the order of sums varies
    rounding = {"rtol": 1e-4, "atol": 1e-6} if device == "cpu" else {"rtol": 1e-3, "atol": 1e-5}
    for p, g in zip(model.parameters(), grads, strict=True):
        assert_close(g, torch.zeros_like(p) if p.grad is None else p.grad, **rounding)


@pytest.mark.parametrize(("broken", "why"), [(True, "fails"), (False, "not finite")])
def test_failed_compilation_falls_back(monkeypatch, caplog, broken, why, device):
    """Neither a failing compiler nor one with wrong gradients may stop or spoil training."""

    def compile(function, **_):
        def wrong(*given):
            if broken:
                raise IndexError("tuple index out of range")
            *state, points = function(*given)
            return (*state, points * torch.nan)

        return wrong

    torch.manual_seed(0)
    model = build("gcn", hidden=8).to(device).eval()
    clip = ClipSampler(without_last(falling()), device, model).take(torch.tensor([0]), torch.tensor([0]), 2)
    with monkeypatch.context() as patch:
        patch.setattr(torch, "compile", compile)
        loss, grads = RolloutLoss(model, DT, compiled=True)(clip)
    assert why in caplog.text
    plain, true = RolloutLoss(model, DT)(clip)
    assert_close(loss, plain)
    for a, b in zip(grads, true, strict=True):
        assert_close(a, b)


def test_gradient_discount_shrinks_gradients_of_early_frames(device):
    """With a discount of 0.9, a gradient that goes back two frames is multiplied by 0.9^2."""
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
    assert 2 <= far[1] / far[0] <= 4  # gradients over one frame are halved, over two frames quartered


def test_absent_and_zero_forces_are_equal():
    world = without_last(falling()).initial_conditions()
    none, idle = ExternalForces.none_for(world.valid, world.points), ExternalForces.none(world)
    # a push of zero strength passes through the same code as a real one
    weak = replace(idle, object=idle.object.new_zeros(6, 1), point=idle.point.new_zeros(6, 1) - 1,
                   force=torch.zeros(6, 1, 3), torque=torch.zeros(6, 1, 3), start=torch.zeros(6, 1),
                   end=torch.ones(6, 1))  # fmt: skip
    com = torch.zeros(6, 2, 3)
    for pushes in (none, idle):
        assert_close(pushes.acceleration(world, world.points, 0.0), weak.acceleration(world, world.points, 0.0))
        assert_close(pushes.wrench(world.points, com, 0.0, DT), weak.wrench(world.points, com, 0.0, DT))


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
