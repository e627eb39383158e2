"""TimeStepper against the model's own steps; on CUDA captured as a graph, equal to rounding."""

import pytest
import torch

from stages.core.models.checkpoints import build
from stages.core.models.external_forces import ExternalForces
from stages.core.models.rollout import TimeStepper, record_frames, rollout
from tests.conftest import DEVICES
from tests.core.models.worlds import SMALL, crowd, padded, push, small

CUDA = pytest.param("cuda", marks=pytest.mark.gpu)


@pytest.mark.parametrize("device", ["cpu", *([CUDA] if "cuda" in DEVICES else [])])
@pytest.mark.parametrize("name", SMALL)
def test_rollout_equals_that_of_the_model(name, device):
    model, initial = small(name).to(device), padded(crowd(), 1, 3).to(device)
    external = push(initial, 0, force=(0.0, 0.0, 30.0), start=0.05, end=0.11)
    external = ExternalForces(**{k: v.to(device) for k, v in vars(external).items()})
    wanted = model.rollout(initial, 10, external=external).detach()
    assert (wanted - model.rollout(initial, 10)).abs().max() > 1e-3  # the push, of a few frames amid, is felt
    # the time is counted in steps, not summed up
    torch.testing.assert_close(rollout(model, initial, 10, external=external), wanted, rtol=0, atol=1e-9)


@pytest.mark.parametrize("device", ["cpu", *([CUDA] if "cuda" in DEVICES else [])])
@pytest.mark.parametrize("name", SMALL)
def test_restart_with_other_initial_conditions(name, device):
    model, other = small(name).to(device), crowd(seed=2).to(device)
    stepper = TimeStepper(model, crowd(seed=1).to(device))
    state = [x.data_ptr() for x in (*stepper.state, stepper.points)]
    record_frames(stepper, 5)
    stepper.restart(other)
    # on a GPU another order of sums
    near = 1e-12 if device == "cpu" else 1e-9
    torch.testing.assert_close(record_frames(stepper, 6), model.rollout(other, 6), rtol=0, atol=near)
    assert [x.data_ptr() for x in (*stepper.state, stepper.points)] == state
    with pytest.raises(ValueError, match="made for"):
        stepper.restart(crowd(n=13).to(device))


def test_external_forces_may_change_between_steps():
    model, initial = small("ngff-paper"), crowd()
    stepper = TimeStepper(model, initial, external=push(initial, 1))
    stepper.step()
    stepper.external.force[:, 0] = torch.tensor([0.0, 0.0, 5.0])
    before = stepper.state.velocity[:, 1, 2].clone()
    other = TimeStepper(model, initial, external=push(initial, 1))
    other.step()
    stepper.step()
    other.step()
    gained = stepper.state.velocity[:, 1, 2] - other.state.velocity[:, 1, 2]
    # 5 N for 0.02 s on the 0.1 kg that this model takes every object for
    torch.testing.assert_close(gained, torch.full_like(before, 1.0))


def test_inputs_are_not_modified():
    initial, model = crowd(), small("ngff-paper")
    before = initial.points.clone()
    stepper = TimeStepper(model, initial)
    record_frames(stepper, 4)
    assert torch.equal(initial.points, before)
    assert not torch.equal(stepper.points, before)


@pytest.mark.gpu
@pytest.mark.skipif("cuda" not in DEVICES, reason="no NVIDIA GPU")
def test_captured_steps_equal_model_steps_to_rounding():
    torch.manual_seed(0)
    model, initial = build("ngff").cuda().eval(), crowd(2, 3, 200).to(torch.float32).to("cuda")
    wanted = model.rollout(initial, 8).detach()  # with gradients, so without fused kernels
    found = rollout(model, initial, 8)
    assert (wanted[:, -1] - wanted[:, 0]).norm(dim=-1).max() > 0.05
    # single precision, eight steps with contacts
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-5)
