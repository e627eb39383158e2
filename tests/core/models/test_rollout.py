"""TimeStepper equals the model's own steps; on CUDA it replays a captured graph and is equal up to rounding."""

import pytest
import torch

from stages.core.models.checkpoints import build
from stages.core.models.dynamics import Dynamics
from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import InitialConditions
from stages.core.models.rollout import TimeStepper, record_frames
from tests.conftest import DEVICES
from tests.core.models.dynamics_fixtures import (
    SMALL_CONFIGS,
    add_padding,
    external_force,
    overlapping_objects,
    small_model,
)

CUDA = pytest.param("cuda", marks=pytest.mark.gpu)


def rollout(model: Dynamics, initial: InitialConditions, steps: int, external: ExternalForces | None = None):
    """`model.rollout` by a TimeStepper."""
    out = record_frames(TimeStepper(model, initial, external=external), steps)
    return out.masked_fill(~initial.valid[:, None, ..., None], 0.0)


@pytest.mark.parametrize("device", ["cpu", *([CUDA] if "cuda" in DEVICES else [])])
@pytest.mark.parametrize("name", SMALL_CONFIGS)
def test_rollout_equals_model_rollout(name, device):
    model, initial = small_model(name).to(device), add_padding(overlapping_objects(), 1, 3).to(device)
    external = external_force(initial, 0, force=(0.0, 0.0, 30.0), start=0.05, end=0.11)
    external = ExternalForces(**{k: v.to(device) for k, v in vars(external).items()})
    expected = model.rollout(initial, 10, external=external).detach()
    assert (expected - model.rollout(initial, 10)).abs().max() > 1e-3  # the external force has an effect
    # time is computed from the step count, not accumulated
    torch.testing.assert_close(rollout(model, initial, 10, external=external), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("device", ["cpu", *([CUDA] if "cuda" in DEVICES else [])])
@pytest.mark.parametrize("name", SMALL_CONFIGS)
def test_restart_with_other_initial_conditions(name, device):
    model, initial = small_model(name).to(device), overlapping_objects(seed=2).to(device)
    stepper = TimeStepper(model, overlapping_objects(seed=1).to(device))
    state = [x.data_ptr() for x in (*stepper.state, stepper.points)]
    record_frames(stepper, 5)
    # the order of summation differs on a GPU
    atol = 1e-12 if device == "cpu" else 1e-9
    for start in (initial, overlapping_objects(seed=3).to(device)):
        stepper.restart(start)
        torch.testing.assert_close(record_frames(stepper, 6), model.rollout(start, 6), rtol=0, atol=atol)
    assert [x.data_ptr() for x in (*stepper.state, stepper.points)] == state
    with pytest.raises(ValueError, match="made for"):
        stepper.restart(overlapping_objects(n=13).to(device))


def test_external_forces_may_change_between_steps():
    model, initial = small_model("ngff-paper"), overlapping_objects()
    stepper = TimeStepper(model, initial, external=external_force(initial, 1))
    stepper.step()
    stepper.external.force[:, 0] = torch.tensor([0.0, 0.0, 5.0])
    before = stepper.state.velocity[:, 1, 2].clone()
    unforced = TimeStepper(model, initial, external=external_force(initial, 1))
    unforced.step()
    stepper.step()
    unforced.step()
    gained = stepper.state.velocity[:, 1, 2] - unforced.state.velocity[:, 1, 2]
    # the impulse of 5 N for 0.02 s; this model assumes 0.1 kg for every object
    torch.testing.assert_close(gained, torch.full_like(before, 1.0))


def test_inputs_are_not_modified():
    initial, model = overlapping_objects(), small_model("ngff-paper")
    before = initial.points.clone()
    stepper = TimeStepper(model, initial)
    record_frames(stepper, 4)
    assert torch.equal(initial.points, before)
    assert not torch.equal(stepper.points, before)


@pytest.mark.gpu
@pytest.mark.skipif("cuda" not in DEVICES, reason="no NVIDIA GPU")
def test_captured_steps_equal_model_steps_to_rounding():
    torch.manual_seed(0)
    model, initial = build("ngff").cuda().eval(), overlapping_objects(2, 3, 200).to(torch.float32).to("cuda")
    expected = model.rollout(initial, 8).detach()  # it records gradients and thus does not use the fused kernels
    actual = rollout(model, initial, 8)
    assert (expected[:, -1] - expected[:, 0]).norm(dim=-1).max() > 0.05
    # the tolerance is for single precision and eight steps with contacts
    torch.testing.assert_close(actual, expected, rtol=0, atol=1e-5)
