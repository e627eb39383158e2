"""The contact solver, compared with mechanics (a box on a floor, two colliding balls) and with the reference solver."""

from __future__ import annotations

import math

import pytest
import torch
import warp as wp

from stages.core.kernels.field.contact_impulses import ContactSolver, contact_solver
from stages.core.kernels.field.contact_solve import solve as solve_in_group
from stages.core.kernels.field.groups import GroupThread
from stages.core.kernels.interop import launch, with_arrays
from tests.core.kernels import contact_reference as reference
from tests.core.kernels.contact_reference import BodyInertia, Contacts

GROUP = {"cpu": 1, "cuda": 64}  # threads per scene


@wp.kernel(enable_backward=False)
def _solve(solver: ContactSolver, lanes: int):
    thread = GroupThread()
    thread.lane = wp.tid()
    thread.lanes = lanes
    solve_in_group(solver, thread)


def solve(
    bodies: BodyInertia, contacts: Contacts, start: torch.Tensor, device: str
) -> tuple[torch.Tensor, torch.Tensor]:
    """`solve` of the reference, computed by the kernels."""
    o, group = len(bodies.mass), GROUP[device]
    pair = contacts.a * o + contacts.b
    order = pair.argsort(stable=True)
    solver = contact_solver(device, 1, o, len(pair), group)
    first = torch.searchsorted(pair[order].contiguous(), torch.arange(o * o + 1)).int()
    active = (first.diff() > 0).nonzero()[:, 0]

    def response(body, arm):
        K = torch.linalg.cross(torch.eye(3).to(arm).expand(len(arm), 3, 3), arm[:, None].expand(-1, 3, 3))
        free = (~bodies.pinned)[body].double()
        turned = K.mT @ bodies.inverse[body] @ K
        return free * (1 / bodies.mass[body] + turned.diagonal(dim1=1, dim2=2).sum(-1) / 3)

    both = response(contacts.a, contacts.arm_a) + ~contacts.fixed * response(contacts.b, contacts.arm_b)
    own = {
        "a": contacts.a, "b": torch.where(contacts.fixed, contacts.a, contacts.b), "normal": contacts.normal,
        "arm_a": contacts.arm_a, "arm_b": contacts.arm_b, "target": contacts.target,
        "friction": contacts.friction, "R_n": 1e-3 * both, "R_t": 1e-3 * both,
        "impulse": torch.zeros_like(contacts.normal),
    }  # fmt: skip
    own = {k: x[order][None].to(device) for k, x in own.items()}
    counts = {"first": first[None], "active": torch.nn.functional.pad(active, (0, o * o - len(active)))[None],
              "active_count": torch.tensor([len(active)])}  # fmt: skip
    with_arrays(solver.contacts, own | {k: x.to(device) for k, x in counts.items()})
    with_arrays(solver.inertia, {
        "mass": bodies.mass.float()[None].to(device), "tensor": bodies.inertia[None].to(device),
        "inverse": bodies.inverse[None].to(device), "pinned": bodies.pinned[None].to(device),
    })  # fmt: skip

    def velocities(x):
        x = torch.where(bodies.pinned[:, None], 0.0, x)[None].to(device)
        return {"linear": x[..., :3].contiguous(), "angular": x[..., 3:].contiguous()}

    moved = velocities(start)
    with_arrays(solver.velocities, moved)
    with_arrays(solver.free, velocities(bodies.velocity))
    launch(_solve, group, [solver, group], device=device, block_dim=group)
    impulse = torch.empty_like(own["impulse"][0].cpu())
    impulse[order] = own["impulse"][0].cpu()
    return torch.cat([moved["linear"], moved["angular"]], -1)[0].cpu(), impulse


DT, G, MASS = 0.005, 5.0, 2.0


def box_on_floor(device, speed, friction, tilt=0.0):
    """One step of a box of 0.3 x 0.3 x 0.2 m with 49 contacts below it; gravity is tilted about y by `tilt`."""
    line = torch.linspace(-0.15, 0.15, 7).double()
    arm = torch.cat([torch.cartesian_prod(line, line), torch.full((49, 1), -0.1).double()], 1)
    zero, inertia = torch.zeros(49, dtype=torch.int64), MASS * torch.tensor([0.0108, 0.0108, 0.015]).double().diag()
    gravity = G * torch.tensor([math.sin(tilt), 0.0, -math.cos(tilt)]).double()
    start = torch.zeros(1, 6).double()
    start[0, 0] = speed
    free = start.clone()
    free[0, :3] += DT * gravity
    bodies = BodyInertia(
        torch.tensor([MASS]).double(), inertia[None], inertia.inverse()[None], free, torch.tensor([False])
    )
    up = torch.tensor([0.0, 0.0, 1.0]).double().expand(49, 3)
    contacts = Contacts(zero, zero, torch.ones(49, dtype=torch.bool), up, arm, arm, torch.zeros(49).double(),
                        torch.full((49,), friction).double())  # fmt: skip
    return contacts, *solve(bodies, contacts, start, device)


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.5, 1.0])
def test_a_sliding_box_slows_down_by_friction_times_gravity(device, friction):
    _, velocity, impulse = box_on_floor(device, 2.0, friction)
    assert float(velocity[0, 0]) == pytest.approx(2 - friction * G * DT, abs=1e-4)
    assert float(impulse[:, 2].sum()) == pytest.approx(MASS * G * DT, rel=1e-3)
    assert float(velocity[0, [1, 2, 5]].abs().max()) < 1e-4


@pytest.mark.parametrize(("degrees", "holds"), [(10, True), (16, True), (17.5, False), (30, False)])
def test_a_slope_holds_up_to_the_friction_angle(device, degrees, holds):
    tilt, friction = math.radians(degrees), 0.3  # friction angle 16.7 degrees
    _, velocity, _ = box_on_floor(device, 0.0, friction, tilt)
    pull = 0.0 if holds else G * (math.sin(tilt) - friction * math.cos(tilt)) * DT
    assert float(velocity[0, 0]) == pytest.approx(pull, abs=1e-5)


@pytest.mark.parametrize("speed", [0.0, 0.003, 2.0])
def test_the_impulse_is_in_the_friction_cone(device, speed):
    """Checks the sum, since the distribution of friction over 49 contacts of a rigid face is nearly indeterminate."""
    contacts, _, impulse = box_on_floor(device, speed, 0.5, 0.2)
    along = (impulse * contacts.normal).sum(-1)
    across = (impulse - along[:, None] * contacts.normal).sum(0).norm()
    assert bool((along >= 0).all()) and float(across) <= 0.5 * float(along.sum()) * (1 + 1e-3)


def two_balls(device, pinned):
    """Balls of 1 and 3 kg in an off-centre collision with a target speed of separation of 0.6 m/s."""
    mass, radius = torch.tensor([1.0, 3.0]).double(), 0.1
    inertia = 0.4 * mass[:, None, None] * radius**2 * torch.eye(3).double()
    velocity = torch.zeros(2, 6).double()
    velocity[0, :2] = torch.tensor([1.0, 0.4])
    n = torch.tensor([[-1.0, 0.0, 0.0]]).double()
    one = torch.ones(1).double()
    contacts = Contacts(torch.tensor([0]), torch.tensor([1]), torch.tensor([False]), n, -radius * n, radius * n,
                        0.6 * one, 0.05 * one)  # fmt: skip
    bodies = BodyInertia(mass, inertia, inertia.inverse(), velocity, torch.tensor([False, pinned]))
    return bodies, contacts, *solve(bodies, contacts, velocity, device)


def test_a_collision_keeps_momentum_and_separates_at_the_target(device):
    bodies, contacts, after, impulse = two_balls(device, pinned=False)
    mass, before = bodies.mass[:, None], bodies.velocity
    torch.testing.assert_close((mass * after[:, :3]).sum(0), (mass * before[:, :3]).sum(0))
    assert float(after[1, 0] - after[0, 0]) == pytest.approx(0.6, rel=0.02)  # contacts are stiff, not rigid
    assert float(impulse[0, 1]) == pytest.approx(0.05 * float(impulse[0, 0]), rel=1e-4)  # the contact slips
    spin = torch.linalg.cross(contacts.arm_a[0], impulse[0]) / bodies.inertia[0, 0, 0]
    torch.testing.assert_close(after[0, 3:], spin)


def test_a_pinned_body_stays(device):
    _, _, after, _ = two_balls(device, pinned=True)
    assert float(after[1].abs().max()) < 1e-4
    assert float(after[0, 0]) == pytest.approx(-0.6, rel=0.02)


def test_equals_another_solver(device):
    """Seven bodies, two of them pinned, with random contacts: two islands, and one body without contacts."""
    rng, o, r = torch.Generator().manual_seed(3), 7, 40

    def normal(*shape):
        return torch.randn(*shape, generator=rng).double()

    root = normal(o, 3, 3)
    inertia = 0.05 * (root @ root.mT + 3 * torch.eye(3))
    mass = torch.rand(o, generator=rng).float().double() + 0.5
    pinned = torch.tensor([False, True, False, False, True, False, False])
    bodies = BodyInertia(mass, inertia, inertia.inverse(), normal(o, 6), pinned)
    pairs = torch.tensor([(0, 0), (0, 1), (2, 0), (0, 2), (3, 5), (5, 3), (5, 5), (4, 3)])
    a, b = pairs[torch.randint(len(pairs), (r,), generator=rng)].T
    n = normal(r, 3)
    contacts = Contacts(a, b, a == b, n / n.norm(dim=-1, keepdim=True), 0.3 * normal(r, 3), 0.3 * normal(r, 3),
                        -normal(r).abs(), torch.rand(r, generator=rng).double())  # fmt: skip
    ours, impulse = solve(bodies, contacts, bodies.velocity, device)
    theirs, wanted = reference.solve(bodies, contacts, bodies.velocity)
    torch.testing.assert_close(ours, torch.where(pinned[:, None], 0.0, theirs), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(impulse, wanted, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(ours[6], bodies.velocity[6])
