"""Properties of every dynamics model: invariance to order, padding and batching; effects of external forces."""

import pytest
import torch

from stages.core.models.external_forces import ExternalForces
from stages.core.models.initial_conditions import InitialConditions, centre_of_mass
from stages.core.models.integrate import Integration
from tests.core.models.dynamics_fixtures import (
    SMALL_CONFIGS,
    add_padding,
    external_force,
    overlapping_objects,
    small_model,
)

STEPS = 6
EXACT = {"rtol": 0, "atol": 1e-10}  # double precision with a different order of summation


@pytest.fixture(params=SMALL_CONFIGS)
def name(request) -> str:
    return request.param


def reordered(initial: InitialConditions, rows=None, columns=None) -> InitialConditions:
    b, o, n, _ = initial.points.shape
    rows = torch.arange(o) if rows is None else rows
    columns = torch.arange(n) if columns is None else columns
    fields = {k: getattr(initial, k)[:, rows] for k in ("mass", "E", "nu", "friction", "velocity", "spin")}
    return InitialConditions.of(initial.points[:, rows][:, :, columns], initial.valid[:, rows][:, :, columns], **fields)


@torch.no_grad()
def test_first_frame_is_the_initial_state_and_objects_move(name):
    initial = overlapping_objects()
    out = small_model(name).rollout(initial, STEPS)
    assert out.shape == (2, STEPS, 3, 12, 3) and out.isfinite().all()
    torch.testing.assert_close(out[:, 0], initial.points, **EXACT)
    assert (out[:, -1] - out[:, 0]).norm(dim=-1).amax() > 1e-3
    torch.testing.assert_close(small_model(name).rollout(initial, 1), out[:, :1], **EXACT)


@torch.no_grad()
def test_point_velocities_equal_finite_differences(name):
    """Central differences along the rate of the state, during rotation and deformation."""
    initial, model, h = overlapping_objects(), small_model(name), 1e-6
    scene, no_force = model.prepare(initial), ExternalForces.none(initial)
    state = model.initial_state(scene)
    for _ in range(3):
        state = model.step(scene, state, 0.0, 0.02, no_force)
    rate = model.derivative(scene, 0.0, state, no_force)
    ahead, behind = (
        model.points(scene, type(state)(*(y + s * dy for y, dy in zip(state, rate, strict=True)))) for s in (h, -h)
    )
    speed = model.point_velocity(scene, state, no_force)
    assert speed.norm(dim=-1).amax() > 0.1
    torch.testing.assert_close(speed, (ahead - behind) / (2 * h), rtol=0, atol=1e-7)


@torch.no_grad()
def test_rollouts_are_equivariant_to_the_order_of_objects_and_keypoints(name):
    initial, rows, columns = overlapping_objects(), torch.tensor([2, 0, 1]), torch.randperm(12)
    out = small_model(name).rollout(initial, STEPS)
    second = small_model(name).rollout(reordered(initial, rows, columns), STEPS)
    torch.testing.assert_close(second, out[:, :, rows][:, :, :, columns], **EXACT)


@torch.no_grad()
def test_padding_does_not_change_rollouts(name):
    initial = overlapping_objects()
    out = small_model(name).rollout(initial, STEPS)
    second = small_model(name).rollout(add_padding(initial, 2, 5), STEPS)
    torch.testing.assert_close(second[:, :, :3, :12], out, **EXACT)
    assert (second[:, :, 3:] == 0).all() and (second[:, :, :, 12:] == 0).all()


def test_padding_does_not_change_gradients(name):
    grads = []
    for initial in (overlapping_objects(), add_padding(overlapping_objects(), 1, 2)):
        model = small_model(name)
        model.rollout(initial, 3)[:, :, :3, :12].square().sum().backward()
        grads.append({k: p.grad for k, p in model.named_parameters() if p.grad is not None})
    assert grads[0].keys() == grads[1].keys() and len(grads[0]) > 4
    for key, g in grads[0].items():
        torch.testing.assert_close(grads[1][key], g, rtol=1e-9, atol=1e-9)


@torch.no_grad()
def test_batched_rollout_equals_single_scenes(name):
    initial = overlapping_objects(3)
    out = small_model(name).rollout(initial, STEPS)
    for i in range(3):
        torch.testing.assert_close(small_model(name).rollout(initial[i : i + 1], STEPS), out[i : i + 1], **EXACT)


@torch.no_grad()
def test_rollout_equals_repeated_steps(name):
    initial, model = overlapping_objects(), small_model(name)
    external = external_force(initial, 1, (1.0, 0.0, 2.0), (0.0, 0.1, 0.0), 0.03, 0.07)
    scene = model.prepare(initial)
    state = model.initial_state(scene)
    for i in range(STEPS - 1):
        state = model.step(scene, state, 0.02 * i, 0.02, external)
    torch.testing.assert_close(
        model.points(scene, state), model.rollout(initial, STEPS, external=external)[:, -1], **EXACT
    )


@torch.no_grad()
def test_steps_of_a_rollout_are_prepared_once(name, monkeypatch):
    initial, model, lengths = overlapping_objects(), small_model(name), []
    expected, stepping = model.rollout(initial, STEPS, integration=Integration(substeps=2)), model.stepping

    def counted(scene, dt, external):
        lengths.append(dt)
        return stepping(scene, dt, external)

    monkeypatch.setattr(model, "stepping", counted)
    assert torch.equal(model.rollout(initial, STEPS, integration=Integration(substeps=2)), expected)
    assert lengths == [0.01]


@pytest.mark.parametrize("name", [n for n in SMALL_CONFIGS if n != "ngff"])
@torch.no_grad()
def test_step_of_baselines_is_explicit_euler(name):
    initial, model = overlapping_objects(), small_model(name)
    external = external_force(initial, 1, (1.0, 0.0, 2.0), (0.0, 0.1, 0.0), 0.03, 0.07)
    for substeps in (1, 3):
        rollouts = [
            model.rollout(initial, STEPS, external=external, integration=Integration(m, substeps))
            for m in ("step", "euler")
        ]
        torch.testing.assert_close(*rollouts, **EXACT)


def test_adjoint_needs_an_ode_method():
    with pytest.raises(ValueError, match="needs an ODE method"):
        Integration(adjoint=True)


@torch.no_grad()
@pytest.mark.parametrize("method", ["rk4", "dopri5"])
def test_ode_methods_agree_with_the_step(name, method):
    out = small_model(name).rollout(overlapping_objects(1), 3, integration=Integration(method))
    torch.testing.assert_close(
        out,
        small_model(name).rollout(overlapping_objects(1), 3, integration=Integration(substeps=20)),
        rtol=0,
        atol=0.05,
    )


def test_gradients_equal_finite_differences(name):
    initial, model = overlapping_objects(1, 2, 16), small_model(name)
    target = initial.points[:, None] + 0.1

    def loss() -> torch.Tensor:
        return (model.rollout(initial, 4) - target).square().mean()

    loss().backward()
    rng = torch.Generator().manual_seed(1)
    pairs = [(p, torch.randn(p.shape, generator=rng, dtype=p.dtype)) for p in model.parameters() if p.grad is not None]
    slope = sum((p.grad * d).sum() for p, d in pairs)
    h, values = 1e-6, []
    with torch.no_grad():
        for sign in (1, -1):
            for p, d in pairs:
                p += sign * h * d
            values.append(loss())
            for p, d in pairs:
                p -= sign * h * d
    measured = (values[0] - values[1]) / (2 * h)
    assert abs(slope) > 1e-6
    torch.testing.assert_close(slope, measured, rtol=1e-4, atol=1e-9)


@torch.no_grad()
def test_external_force_changes_only_the_acceleration(name):
    initial, model = overlapping_objects(), small_model(name)
    scene = model.prepare(initial)
    state, force = model.initial_state(scene), torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64)
    unforced = model.derivative(scene, 0.1, state, ExternalForces.none(initial))
    forced = model.derivative(scene, 0.1, state, external_force(initial, 1, force.tolist()))
    mass = initial.mass[:, 1] if "mass" in model.inputs or hasattr(state, "position") else torch.tensor([0.1, 0.1])
    for field, a, b in zip(state._fields, unforced, forced, strict=True):
        change = b - a
        if field == "velocity":
            expected = torch.zeros_like(change)
            expected[:, 1] = (force / mass[:, None].double()).reshape(2, *[1] * (change.dim() - 3), 3)
            torch.testing.assert_close(change, expected, rtol=1e-6, atol=1e-10)
        else:
            assert (change == 0).all(), field


@torch.no_grad()
def test_external_force_is_ignored_outside_its_time_interval(name):
    initial, model = overlapping_objects(), small_model(name)
    late = external_force(initial, 0, (5.0, 0, 0), (1.0, 0, 0), start=3.0)
    assert torch.equal(model.rollout(initial, STEPS, external=late), model.rollout(initial, STEPS))


@torch.no_grad()
def test_pinned_object_does_not_move(name):
    initial, model = overlapping_objects(), small_model(name)
    external = external_force(initial, 1, (50.0, 0, 0), (1.0, 0, 0))
    external.pinned[:, 1] = True
    out = model.rollout(initial, STEPS, external=external)
    torch.testing.assert_close(out[:, :, 1], initial.points[:, None, 1].expand_as(out[:, :, 1]), **EXACT)
    assert (out[:, -1, 0] - out[:, 0, 0]).norm(dim=-1).amin() > 0


@torch.no_grad()
def test_models_use_exactly_their_inputs(name):
    initial, model = overlapping_objects(), small_model(name)
    out = model.rollout(initial, STEPS)
    modified = {
        "mass": 3 * initial.mass, "E": 30 * initial.E, "nu": initial.nu / 2, "friction": initial.friction / 2,
        "solidity": 3 * initial.solidity,
        "gravity": 2 * initial.gravity, "velocity": initial.velocity + 1, "spin": initial.spin + 1,
        "box": initial.box + torch.tensor([0.0, 0.0, 0.15], dtype=torch.float64),
    }  # fmt: skip
    fields = {k: getattr(initial, k) for k in modified}
    for field, value in modified.items():
        changed = model.rollout(InitialConditions.of(initial.points, **{**fields, field: value}), STEPS)
        assert torch.equal(changed, out) == (field not in model.inputs), field


@torch.no_grad()
def test_state_from_motion_continues_a_motion(name):
    initial, model = overlapping_objects(), small_model(name)
    scene = model.prepare(initial)
    state = model.initial_state(scene)
    for i in range(STEPS):
        state = model.step(scene, state, 0.02 * i, 0.02, ExternalForces.none(initial))
    h = 1e-6
    rate = model.derivative(scene, 0.0, state, ExternalForces.none(initial))
    before, after = (type(state)(*(y + s * h * dy for y, dy in zip(state, rate, strict=True))) for s in (-1, 1))
    speed = (model.points(scene, after) - model.points(scene, before)) / (2 * h)
    if hasattr(state, "position"):  # position corrections of the network need not be part of the velocity
        speed = state.velocity
    second = model.state_from_motion(scene, model.points(scene, state), speed)
    torch.testing.assert_close(model.points(scene, second), model.points(scene, state), rtol=0, atol=1e-6)
    first, repeated = (
        model.points(scene, model.step(scene, s, 0.0, 0.02, ExternalForces.none(initial))) for s in (state, second)
    )
    torch.testing.assert_close(first, repeated, rtol=0, atol=2e-4)  # the inertia is regularised by 0.1 %


@torch.no_grad()
def test_rollout_from_given_positions_and_velocities(name):
    initial, model = overlapping_objects(), small_model(name)
    speed = torch.zeros_like(initial.points)
    start = InitialConditions.of(
        initial.points, mass=initial.mass, E=initial.E, nu=initial.nu, friction=initial.friction
    )
    out = model.rollout(start, STEPS, start=(initial.points, speed))
    torch.testing.assert_close(out, model.rollout(start, STEPS), rtol=0, atol=1e-6)


@torch.no_grad()
def test_initial_state_has_the_given_velocities_and_spins():
    initial = overlapping_objects()
    state = small_model("transformer").initial_state(initial)
    torch.testing.assert_close(centre_of_mass(initial, state.velocity), initial.velocity, **EXACT)
    arm = initial.points - centre_of_mass(initial, initial.points)[:, :, None]
    momentum = torch.linalg.cross(arm, state.velocity).mean(2)  # angular momentum per mass, positive along the spin
    assert ((momentum * initial.spin).sum(-1) > 0).all()
