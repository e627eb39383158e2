"""What holds for every dynamics model: order, padding and batching do not matter; prompts do what they say."""

import pytest
import torch

from stages.core.models.external_forces import Pushes
from stages.core.models.initial_conditions import World, centre
from tests.core.models.worlds import SMALL, crowd, padded, push, small

STEPS = 6
EXACT = {"rtol": 0, "atol": 1e-10}  # double precision, sums in another order


@pytest.fixture(params=SMALL)
def name(request) -> str:
    return request.param


def reordered(world: World, rows=None, columns=None) -> World:
    b, o, n, _ = world.points.shape
    rows = torch.arange(o) if rows is None else rows
    columns = torch.arange(n) if columns is None else columns
    given = {k: getattr(world, k)[:, rows] for k in ("mass", "E", "nu", "friction", "velocity", "spin")}
    return World.of(world.points[:, rows][:, :, columns], world.valid[:, rows][:, :, columns], **given)


@torch.no_grad()
def test_the_start_is_the_first_frame_and_things_move(name):
    world = crowd()
    out = small(name).rollout(world, STEPS)
    assert out.shape == (2, STEPS, 3, 12, 3) and out.isfinite().all()
    torch.testing.assert_close(out[:, 0], world.points, **EXACT)
    assert (out[:, -1] - out[:, 0]).norm(dim=-1).amax() > 1e-3
    torch.testing.assert_close(small(name).rollout(world, 1), out[:, :1], **EXACT)


@torch.no_grad()
def test_speeds_are_those_with_which_points_move(name):
    """Along the rate of the state, by central differences, amid a motion in which things turn and deform."""
    world, model, h = crowd(), small(name), 1e-6
    scene, nobody = model.prepare(world), Pushes.none(world)
    state = model.start(scene)
    for _ in range(3):
        state = model.step(scene, state, 0.0, 0.02, nobody)
    rate = model.derivative(scene, 0.0, state, nobody)
    ahead, behind = (
        model.points(scene, type(state)(*(y + s * dy for y, dy in zip(state, rate, strict=True)))) for s in (h, -h)
    )
    speed = model.speed(scene, state, nobody)
    assert speed.norm(dim=-1).amax() > 0.1
    torch.testing.assert_close(speed, (ahead - behind) / (2 * h), rtol=0, atol=1e-7)


@torch.no_grad()
def test_order_of_objects_and_keypoints_does_not_matter(name):
    world, rows, columns = crowd(), torch.tensor([2, 0, 1]), torch.randperm(12)
    out = small(name).rollout(world, STEPS)
    again = small(name).rollout(reordered(world, rows, columns), STEPS)
    torch.testing.assert_close(again, out[:, :, rows][:, :, :, columns], **EXACT)


@torch.no_grad()
def test_padding_does_not_matter(name):
    world = crowd()
    out = small(name).rollout(world, STEPS)
    again = small(name).rollout(padded(world, 2, 5), STEPS)
    torch.testing.assert_close(again[:, :, :3, :12], out, **EXACT)
    assert (again[:, :, 3:] == 0).all() and (again[:, :, :, 12:] == 0).all()


def test_padding_does_not_matter_for_gradients(name):
    grads = []
    for world in (crowd(), padded(crowd(), 1, 2)):
        model = small(name)
        model.rollout(world, 3)[:, :, :3, :12].square().sum().backward()
        grads.append({k: p.grad for k, p in model.named_parameters() if p.grad is not None})
    assert grads[0].keys() == grads[1].keys() and len(grads[0]) > 4
    for key, g in grads[0].items():
        torch.testing.assert_close(grads[1][key], g, rtol=1e-9, atol=1e-9)


@torch.no_grad()
def test_a_batch_is_its_scenes(name):
    world = crowd(3)
    out = small(name).rollout(world, STEPS)
    for i in range(3):
        torch.testing.assert_close(small(name).rollout(world[i : i + 1], STEPS), out[i : i + 1], **EXACT)


@torch.no_grad()
def test_steps_add_up_to_a_rollout(name):
    world, model = crowd(), small(name)
    pushes = push(world, 1, (1.0, 0.0, 2.0), (0.0, 0.1, 0.0), 0.03, 0.07)
    scene = model.prepare(world)
    state = model.start(scene)
    for i in range(STEPS - 1):
        state = model.step(scene, state, 0.02 * i, 0.02, pushes)
    torch.testing.assert_close(model.points(scene, state), model.rollout(world, STEPS, pushes=pushes)[:, -1], **EXACT)


@pytest.mark.parametrize("name", [n for n in SMALL if n != "ngff"])
@torch.no_grad()
def test_a_published_step_is_one_of_euler(name):
    world, model = crowd(), small(name)
    pushes = push(world, 1, (1.0, 0.0, 2.0), (0.0, 0.1, 0.0), 0.03, 0.07)
    for substeps in (1, 3):
        rolled = [model.rollout(world, STEPS, method=m, pushes=pushes, substeps=substeps) for m in ("step", "euler")]
        torch.testing.assert_close(*rolled, **EXACT)


def test_the_adjoint_needs_an_equation():
    with pytest.raises(ValueError, match="needs an ODE method"):
        small("gcn").rollout(crowd(), 3, adjoint=True)


@torch.no_grad()
@pytest.mark.parametrize("method", ["rk4", "dopri5"])
def test_other_methods_run(name, method):
    out = small(name).rollout(crowd(1), 3, method=method)
    torch.testing.assert_close(out, small(name).rollout(crowd(1), 3, substeps=20), rtol=0, atol=0.05)


def test_gradients_equal_finite_differences(name):
    world, model = crowd(1, 2, 16), small(name)
    target = world.points[:, None] + 0.1

    def loss() -> torch.Tensor:
        return (model.rollout(world, 4) - target).square().mean()

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
def test_a_push_changes_only_the_acceleration(name):
    world, model = crowd(), small(name)
    scene = model.prepare(world)
    state, force = model.start(scene), torch.tensor([0.5, -1.0, 2.0], dtype=torch.float64)
    without = model.derivative(scene, 0.1, state, Pushes.none(world))
    with_ = model.derivative(scene, 0.1, state, push(world, 1, force.tolist()))
    mass = world.mass[:, 1] if "mass" in model.told or hasattr(state, "position") else torch.tensor([0.1, 0.1])
    for field, a, b in zip(state._fields, without, with_, strict=True):
        change = b - a
        if field == "velocity":
            expected = torch.zeros_like(change)
            expected[:, 1] = (force / mass[:, None].double()).reshape(2, *[1] * (change.dim() - 3), 3)
            torch.testing.assert_close(change, expected, rtol=1e-6, atol=1e-10)
        else:
            assert (change == 0).all(), field


@torch.no_grad()
def test_a_push_outside_of_its_time_changes_nothing(name):
    world, model = crowd(), small(name)
    late = push(world, 0, (5.0, 0, 0), (1.0, 0, 0), start=3.0)
    assert torch.equal(model.rollout(world, STEPS, pushes=late), model.rollout(world, STEPS))


@torch.no_grad()
def test_a_pinned_object_stays(name):
    world, model = crowd(), small(name)
    pushes = push(world, 1, (50.0, 0, 0), (1.0, 0, 0))
    pushes.pinned[:, 1] = True
    out = model.rollout(world, STEPS, pushes=pushes)
    torch.testing.assert_close(out[:, :, 1], world.points[:, None, 1].expand_as(out[:, :, 1]), **EXACT)
    assert (out[:, -1, 0] - out[:, 0, 0]).norm(dim=-1).amin() > 0


@torch.no_grad()
def test_what_a_model_is_told_it_uses_and_no_more(name):
    world, model = crowd(), small(name)
    out = model.rollout(world, STEPS)
    other = {
        "mass": 3 * world.mass, "E": 30 * world.E, "nu": world.nu / 2, "friction": world.friction / 2,
        "solidity": 3 * world.solidity,
        "gravity": 2 * world.gravity, "velocity": world.velocity + 1, "spin": world.spin + 1,
        "box": world.box + torch.tensor([0.0, 0.0, 0.15], dtype=torch.float64),
    }  # fmt: skip
    fields = {k: getattr(world, k) for k in other}
    for field, value in other.items():
        changed = model.rollout(World.of(world.points, **{**fields, field: value}), STEPS)
        assert torch.equal(changed, out) == (field not in model.told), field


@torch.no_grad()
def test_a_motion_can_be_taken_up_where_it_is(name):
    world, model = crowd(), small(name)
    scene = model.prepare(world)
    state = model.start(scene)
    for i in range(STEPS):
        state = model.step(scene, state, 0.02 * i, 0.02, Pushes.none(world))
    h = 1e-6
    rate = model.derivative(scene, 0.0, state, Pushes.none(world))
    before, after = (type(state)(*(y + s * h * dy for y, dy in zip(state, rate, strict=True))) for s in (-1, 1))
    speed = (model.points(scene, after) - model.points(scene, before)) / (2 * h)
    if hasattr(state, "position"):  # what a network adds to the positions need not be in the velocity
        speed = state.velocity
    again = model.observe(scene, model.points(scene, state), speed)
    torch.testing.assert_close(model.points(scene, again), model.points(scene, state), rtol=0, atol=1e-6)
    one, other = (model.points(scene, model.step(scene, s, 0.0, 0.02, Pushes.none(world))) for s in (state, again))
    torch.testing.assert_close(one, other, rtol=0, atol=2e-4)  # the inertia is enlarged by a thousandth


@torch.no_grad()
def test_a_rollout_from_the_middle(name):
    world, model = crowd(), small(name)
    speed = torch.zeros_like(world.points)
    start = World.of(world.points, mass=world.mass, E=world.E, nu=world.nu, friction=world.friction)
    out = model.rollout(start, STEPS, start=(world.points, speed))
    torch.testing.assert_close(out, model.rollout(start, STEPS), rtol=0, atol=1e-6)


@torch.no_grad()
def test_initial_velocities_and_spins():
    world = crowd()
    state = small("transformer").start(world)
    torch.testing.assert_close(centre(world, state.velocity), world.velocity, **EXACT)
    arm = world.points - centre(world, world.points)[:, :, None]
    momentum = torch.linalg.cross(arm, state.velocity).mean(2)  # angular, per mass; positive along the spin
    assert ((momentum * world.spin).sum(-1) > 0).all()
