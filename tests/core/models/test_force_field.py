"""Properties of the force field that hold for any weights."""

import math
from dataclasses import replace

import pytest
import torch

from stages.core.geometry.rotations import matrix
from stages.core.models.external_forces import ExternalForces
from stages.core.models.field.contact_forces import ContactPoints
from stages.core.models.field.deformation import DeformationInputs, projected
from stages.core.models.field.floor_response import MAX_PENETRATION, SEPARATION_SPEED, friction_factor, push_only
from stages.core.models.field.force_field import MAX_TRAINED_STIFFNESS, ForceField
from stages.core.models.field.rest_shape import rest_shape_of
from stages.core.models.initial_conditions import BOX, InitialConditions, centre_of_mass
from tests.core.models.worlds import crowd, push

ROOMY = torch.tensor([[-50.0] * 3, [50.0] * 3], dtype=torch.float64)
NOWHERE = torch.zeros(3, dtype=torch.float64)
EXACT = {"rtol": 0, "atol": 1e-10}


def loud(seed: int = 0, deform: bool = True) -> ForceField:
    """A model whose random forces are as strong as real ones."""
    torch.manual_seed(seed)
    model = ForceField(hidden=16, deform=deform).double().eval()
    with torch.no_grad():
        for net in (model.pairs, model.planes, *([model.stress] if deform else [])):
            net.say[-1].weight *= 10
    return model


def flying(n: int = 20, gravity=NOWHERE, **given) -> InitialConditions:
    """Two bodies far from everything that fly at each other, off centre and spinning; one is the heavier."""
    rng = torch.Generator().manual_seed(3)
    box = (torch.rand(2, n, 3, generator=rng, dtype=torch.float64) - 0.5) * torch.tensor([0.3, 0.2, 0.1]).double()
    points = box + torch.tensor([[-0.25, 0.02, 0.0], [0.25, -0.03, 0.02]]).double()[:, None]
    velocity = torch.tensor([[1.0, 0, 0.1], [-0.5, 0, 0]]).double()
    spin = torch.tensor([[1.0, 3.0, -2.0], [-2.0, 0.5, 1.0]]).double()
    given = {"mass": torch.tensor([0.4, 1.2]), "velocity": velocity, "spin": spin, **given}
    return InitialConditions.of(points[None], gravity=gravity, box=ROOMY, **given)


def history(
    model: ForceField, initial: InitialConditions, steps: int, dt: float = 0.02, external: ExternalForces | None = None
):
    scene = model.prepare(initial)
    states = [model.initial_state(scene)]
    for i in range(steps):
        states.append(
            model.step(scene, states[-1], dt * i, dt, ExternalForces.none(initial) if external is None else external)
        )
    return scene, states


def momenta(initial: InitialConditions, state) -> tuple[torch.Tensor, torch.Tensor]:
    """Linear momentum, and angular momentum about the origin, of each scene."""
    p = initial.mass[..., None] * state.velocity
    return p.sum(1), (torch.linalg.cross(state.com, p) + initial.mass[..., None] * state.momentum).sum(1)


@torch.no_grad()
def test_collision_conserves_linear_and_angular_momentum():
    initial = flying()
    _, states = history(loud(), initial, 40)
    change = (states[-1].velocity - states[0].velocity).norm(dim=-1)
    assert change.min() > 0.1  # they did collide
    for before, after in zip(momenta(initial, states[0]), momenta(initial, states[-1]), strict=True):
        torch.testing.assert_close(after, before, rtol=0, atol=1e-12)


@torch.no_grad()
def test_derivative_conserves_momentum():
    initial, model = flying(), loud(deform=False)
    scene = model.prepare(initial)
    rate = model.derivative(
        scene, 0.0, model.initial_state(scene)._replace(com=initial.points.mean(2) * 0.5), ExternalForces.none(initial)
    )
    assert rate.velocity.norm(dim=-1).min() > 0.1
    assert (initial.mass[..., None] * rate.velocity).sum(1).abs().max() < 1e-12


@torch.no_grad()
def test_free_flight_is_a_parabola():
    initial = flying(gravity=torch.tensor([0.3, 0.0, -5.0]), velocity=torch.tensor([[-1.0, 0, 2], [1, 1, 1]]))
    scene, states = history(loud(), initial, 50)
    t = 1.0
    wanted = states[0].com + t * initial.velocity + t * t / 2 * initial.gravity[:, None]
    torch.testing.assert_close(states[-1].com, wanted, **EXACT)


def test_a_free_spin_converges_with_order_two_and_keeps_its_energy():
    # a body of three different moments turns about no fixed axis
    initial = flying(
        velocity=torch.tensor([[-3.0, 0, 0], [3.0, 0, 0]]), spin=torch.tensor([[0.2, 8.0, 0.3], [5, 1, -4]])
    )
    model = loud(deform=False)

    def end(steps: int):
        with torch.no_grad():
            scene, states = history(model, initial, steps, 0.4 / steps)
            return scene, states[0], states[-1]

    scene, first, last = end(80)
    R20, R40, R80 = matrix(end(20)[2].quat), matrix(end(40)[2].quat), matrix(last.quat)
    assert math.log2((R20 - R40).norm() / (R40 - R80).norm()) == pytest.approx(2, abs=0.3)

    def energy(state):
        R = matrix(state.quat)
        body = (R.mT @ state.momentum[..., None])[..., 0]
        return (body * (scene.shape.inverse @ body[..., None])[..., 0]).sum(-1) / 2

    torch.testing.assert_close(energy(last), energy(first), rtol=1e-3, atol=0)
    torch.testing.assert_close(last.momentum, first.momentum, **EXACT)


def turn(angle: float, axis=(0.0, 0.0, 1.0)) -> torch.Tensor:
    a = torch.tensor(axis).double()
    return matrix(torch.cat([torch.tensor([math.cos(angle / 2)]), math.sin(angle / 2) * a / a.norm()]))


def rotated(initial: InitialConditions, R: torch.Tensor) -> InitialConditions:
    given = {k: getattr(initial, k) for k in ("mass", "E", "nu", "friction", "box")}
    vectors = {k: getattr(initial, k) @ R.mT for k in ("velocity", "spin", "gravity")}
    return InitialConditions.of(initial.points @ R.mT, initial.valid, **given, **vectors)


@torch.no_grad()
def test_a_scene_turned_about_the_vertical_moves_turned():
    initial, R, model = crowd(), turn(1.1), loud()
    out = model.rollout(initial, 15)
    assert (out[:, -1] - out[:, 0]).norm(dim=-1).max() > 0.05
    torch.testing.assert_close(model.rollout(rotated(initial, R), 15), out @ R.mT, rtol=0, atol=1e-7)


@torch.no_grad()
def test_rollouts_are_rotation_equivariant_far_from_floor_and_walls():
    initial, R, model = flying(gravity=torch.tensor([1.0, 2.0, -3.0])), turn(2.0, (1, -2, 0.5)), loud()
    torch.testing.assert_close(
        model.rollout(rotated(initial, R), 30), model.rollout(initial, 30) @ R.mT, rtol=0, atol=1e-7
    )


@torch.no_grad()
def test_body_without_contact_does_not_deform():
    initial = flying(velocity=NOWHERE, spin=NOWHERE)
    out = loud().rollout(
        InitialConditions.of(initial.points * torch.tensor([4.0, 1, 1]), gravity=NOWHERE, box=ROOMY), 100
    )
    assert (out == out[:, :1]).all() or (out - out[:, :1]).abs().max() < 1e-12


@torch.no_grad()
def test_deformation_scales_with_compliance_beyond_the_trained_stiffness():
    """Linear elasticity; softer things are told apart by the network alone."""
    model, initial = ForceField(hidden=8).double().eval(), crowd(1, 1, 12)
    stiffest = float(MAX_TRAINED_STIFFNESS * initial.mass[0, 0] / rest_shape_of(initial).size[0, 0])
    touch = torch.randn(1, 1, 12, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rest, gravity = torch.zeros_like(touch), torch.zeros(1, 1, 3, dtype=torch.float64)
    inputs = DeformationInputs(rest, rest, touch, gravity)
    bends = []
    for E in (stiffest / 10, stiffest, 5 * stiffest, 1e4 * stiffest):
        scene = model.prepare(replace(initial, E=torch.full_like(initial.E, E)))
        bends.append(model.stress(scene.shape, scene.embedding, scene.compliance_scale, inputs))
    soft, usual, stiff, rigid = bends
    assert not torch.allclose(soft, usual, rtol=1e-3)
    torch.testing.assert_close(stiff, usual / 5)
    torch.testing.assert_close(rigid, usual / 1e4)
    assert usual.norm() > 1e-3


@torch.no_grad()
def test_the_floor_holds_what_creeps_and_lets_slide_what_is_fast():
    model = loud(deform=False)
    model.planes.say[-1].weight.zero_()  # no force of the floor but its grip
    model.planes.say[-1].bias.zero_()
    model.hold.bias.fill_(3.0)
    points = crowd(1, 1).points
    points = points - points.amin((1, 2), keepdim=True) + torch.tensor([0, 0, BOX[0][2] + 0.01]).double()

    def speed_left(speed: float) -> float:
        initial = InitialConditions.of(points, gravity=NOWHERE, velocity=torch.tensor([speed, 0, 0]))
        return float(history(model, initial, 20)[1][-1].velocity[0, 0, 0]) / speed

    assert speed_left(0.005) < 1e-6
    assert 0.95 < speed_left(1.0) < 1


@torch.no_grad()
def test_what_lies_on_what_the_floor_holds_is_held_too_and_what_flies_is_not():
    model = loud(deform=False)
    for net in (model.planes, model.pairs):  # no forces
        net.say[-1].weight.zero_()
        net.say[-1].bias.zero_()
    model.hold.bias.fill_(3.0)
    box = crowd(1, 1, 100).points[0, 0]
    box = box - box.amin(0)
    floor = torch.tensor([0, 0, BOX[0][2] + 0.01]).double()
    top = torch.tensor([0, 0, float(box[:, 2].max()) + 0.01]).double()
    points = torch.stack([floor + box, floor + top + box, floor + 5 * top + box])[None]
    initial = InitialConditions.of(points, gravity=NOWHERE, velocity=torch.tensor([0.005, 0, 0]))
    left = history(model, initial, 20)[1][-1].velocity[0, :, 0] / 0.005
    assert left[0] < 1e-6 and left[1] < 1e-3
    torch.testing.assert_close(left[2], torch.ones_like(left[2]))


@torch.no_grad()
def test_friction_ignores_velocities_that_alternate_between_steps():
    """Velocities that change their sign at each step move nothing; those of a bounce are far faster, and stay."""
    model = loud(deform=False)
    initial = crowd(1, 1)
    scene = model.prepare(initial)
    none = torch.zeros(1, 1, 3, dtype=torch.float64)
    threshold = torch.full((1, 1, 1), 0.03, dtype=torch.float64)

    def kept(before: float, after: float) -> float:
        x = torch.tensor([1.0, 0, 0]).double().expand_as(none)
        return float(friction_factor(scene.shape, threshold, (before * x, none), (after * x, none), 0.02))

    assert kept(-0.05, 0.05) < 0.1 < 0.7 < kept(0.05, 0.05)
    assert kept(-1.0, 1.0) > 0.999


@torch.no_grad()
@pytest.mark.parametrize("depth", [0.0, 2.0])
def test_penetration_of_floor_and_walls_is_resolved(depth):
    initial = crowd(1, 2)
    low = initial.points.amin((1, 2, 3))[:, None, None, None]
    for axis in (0, 2):
        shift = torch.zeros(3, dtype=torch.float64)
        shift[axis] = BOX[0][axis] - depth
        points = initial.points - low * (torch.arange(3) == axis) + shift
        start = InitialConditions.of(points, velocity=torch.tensor([-2.0, 0, -6.0]))
        out = loud().rollout(start, 200)
        assert out.isfinite().all()
        assert out[:, -1, ..., axis].min() > BOX[0][axis] - MAX_PENETRATION - 0.02  # the rest is of second order


def test_the_floor_gives_back_less_than_it_takes():
    """Of what it pushes what comes, nothing to what could be pulled, and half to what leaves at LEAVING."""
    up, a = torch.tensor([0.0, 0, 1]), torch.tensor([[3.0, 1, 5], [3.0, 1, -50], [0, 0, 0.5]])[None, None, None]
    weight = torch.full((1, 1, 1, 3), 0.1)

    def felt(speed):
        vectors = torch.stack([up, torch.zeros(3), torch.tensor(speed)]).expand(1, 1, 1, 3, 3, 3)
        return push_only(
            a, ContactPoints(vectors, weight[..., None], weight, torch.arange(3)[None, None, None]), weight
        )

    comes, rests, leaves = felt([0.5, 0, -2.0]), felt([0.0, 0, 0]), felt([0.5, 0, SEPARATION_SPEED])
    assert torch.equal(comes, rests) and (rests[..., 2] >= 0).all()
    torch.testing.assert_close(leaves[..., 2], rests[..., 2] / 2)
    assert torch.equal(leaves[..., :2], a[..., :2])  # along the floor it is left to the network


@pytest.mark.parametrize("steps", [200, pytest.param(1000, marks=pytest.mark.slow)])
@torch.no_grad()
def test_long_rollouts_stay_finite_and_undamaged(steps):
    initial = crowd(1, 2, 10)
    out = loud(4).rollout(initial, steps)
    assert out.isfinite().all()
    size = (initial.points - centre_of_mass(initial, initial.points)[:, :, None]).norm(dim=-1).amax()
    arm = out - out.mean(3, keepdim=True)
    assert arm.norm(dim=-1).max() < 2.5 * size


@torch.no_grad()
def test_torque_changes_spin_by_the_inverse_inertia():
    initial = flying(velocity=NOWHERE, spin=NOWHERE, mass=torch.tensor([2.0, 1.0]))
    initial = InitialConditions.of(initial.points * 3, mass=initial.mass, gravity=NOWHERE, box=ROOMY)
    external = push(initial, 0, torque=(0.0, 0.0, 0.2))
    scene, states = history(loud(), initial, 1, 0.01, external)
    arm = scene.shape.arm[0, 0]
    about_z = arm[:, :2].square().sum(-1).mean()
    torch.testing.assert_close(states[1].momentum[0, 0, 2], torch.tensor(0.01 * 0.2 / 2.0).double())
    points = loud().points(scene, states[1]) - loud().points(scene, states[0])
    measured = (arm[:, 0] * points[0, 0, :, 1] - arm[:, 1] * points[0, 0, :, 0]).mean() / about_z
    # half a step of drift follows the kick; inertia is enlarged by a thousandth, and axes are not principal
    assert float(measured) == pytest.approx(0.005 * 0.01 * 0.1 / float(about_z), rel=0.1)


@torch.no_grad()
def test_a_pinned_body_is_a_wall_for_others():
    initial, model = flying(spin=NOWHERE), loud()
    external = ExternalForces.none(initial)
    external.pinned[0, 1] = True
    heavy = InitialConditions.of(initial.points, gravity=NOWHERE, box=ROOMY, velocity=torch.tensor([[1.0, 0, 0.1], [0,
    0, 0]]),
                     mass=torch.tensor([0.4, 1.2]))  # fmt: skip
    _, states = history(model, heavy, 40, external=external)
    assert torch.equal(states[-1].com[:, 1], states[0].com[:, 1])
    assert (states[-1].velocity[:, 1] == 0).all() and (states[-1].momentum[:, 1] == 0).all()
    assert (states[-1].velocity[:, 0] - states[0].velocity[:, 0]).norm() > 0.1


def test_a_projected_field_neither_moves_nor_turns():
    initial = crowd()
    shape = rest_shape_of(initial)
    field = projected(shape, torch.randn(initial.points.shape, dtype=torch.float64))
    mass_fraction = initial.mass_fraction[..., None]
    assert (mass_fraction * field).sum(2).abs().max() < 1e-12
    # to the thousandth by which the inertia is enlarged
    assert (mass_fraction * torch.linalg.cross(shape.arm, field)).sum(2).abs().max() < 2e-3


@torch.no_grad()
def test_normals_of_a_sphere_point_outwards():
    rng = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(1, 1, 400, 3, generator=rng, dtype=torch.float64), dim=-1)
    shape = rest_shape_of(InitialConditions.of(0.2 * points))
    assert (shape.normal * points).sum(-1).min() > 0.9
    assert shape.size[0, 0] == pytest.approx(0.2, rel=1e-2)
    assert shape.spacing.mean() == pytest.approx(0.025, rel=0.3)  # sqrt(4 pi r^2 / n) = 0.035; the nearest are nearer


def test_each_object_finds_the_others_and_itself_in_them():
    shape = rest_shape_of(crowd(1, 4))
    for i in range(4):
        assert sorted(shape.others[i].tolist()) == [j for j in range(4) if j != i]
        for k, j in enumerate(shape.others[i].tolist()):
            assert shape.others[j, shape.back[i, k]] == i


@torch.no_grad()
def test_the_same_again_is_the_same():
    initial = crowd().to(torch.float32)
    model = loud().float()
    assert torch.equal(model.rollout(initial, 30), model.rollout(initial, 30))


@torch.no_grad()
def test_neighbourhoods_hold_no_subnormal_numbers_and_whole_weight():
    """On a CPU products with them take several times as long."""
    blur = rest_shape_of(crowd(2, 3, 200).to(torch.float32)).blur
    assert (blur == 0).any() and float(blur[blur > 0].min()) > 100 * torch.finfo(torch.float32).tiny
    torch.testing.assert_close(blur.sum(-1), torch.ones_like(blur.sum(-1)))
