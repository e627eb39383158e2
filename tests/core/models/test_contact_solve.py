"""The contact solve against mechanics: a box on a floor, and two balls that collide."""

from __future__ import annotations

import math

import pytest
import torch

from stages.core.models.field.contact_solve import BodyInertia, Contacts, solve

DT, G, MASS = 0.005, 5.0, 2.0


def box_on_floor(speed, friction, tilt=0.0):
    """One step of a box of .3 x .3 x .2 m whose lower face has 49 contacts; gravity is tilted by `tilt` about y."""
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
    return contacts, *solve(bodies, contacts, start)


@pytest.mark.parametrize("friction", [0.0, 0.1, 0.5, 1.0])
def test_a_sliding_box_slows_down_by_friction_times_gravity(friction):
    _, velocity, impulse = box_on_floor(2.0, friction)
    assert float(velocity[0, 0]) == pytest.approx(2 - friction * G * DT, abs=1e-4)
    assert float(impulse[:, 2].sum()) == pytest.approx(MASS * G * DT, rel=1e-3)
    assert float(velocity[0, [1, 2, 5]].abs().max()) < 1e-4


@pytest.mark.parametrize(("degrees", "holds"), [(10, True), (16, True), (17.5, False), (30, False)])
def test_a_slope_holds_up_to_the_friction_angle(degrees, holds):
    tilt, friction = math.radians(degrees), 0.3  # 16.7 degrees
    _, velocity, _ = box_on_floor(0.0, friction, tilt)
    pull = 0.0 if holds else G * (math.sin(tilt) - friction * math.cos(tilt)) * DT
    assert float(velocity[0, 0]) == pytest.approx(pull, abs=1e-5)


@pytest.mark.parametrize("speed", [0.0, 0.003, 2.0])
def test_the_impulse_is_in_the_friction_cone(speed):
    """Their sum: how 49 contacts of a rigid face share friction is hardly determined."""
    contacts, _, impulse = box_on_floor(speed, 0.5, 0.2)
    along = (impulse * contacts.normal).sum(-1)
    across = (impulse - along[:, None] * contacts.normal).sum(0).norm()
    assert bool((along >= 0).all()) and float(across) <= 0.5 * float(along.sum()) * (1 + 1e-3)


def two_balls(pinned):
    """Balls of 1 and 3 kg that meet off their centres, and should separate at .6 m/s."""
    mass, radius = torch.tensor([1.0, 3.0]).double(), 0.1
    inertia = 0.4 * mass[:, None, None] * radius**2 * torch.eye(3).double()
    velocity = torch.zeros(2, 6).double()
    velocity[0, :2] = torch.tensor([1.0, 0.4])
    n = torch.tensor([[-1.0, 0.0, 0.0]]).double()
    one = torch.ones(1).double()
    contacts = Contacts(torch.tensor([0]), torch.tensor([1]), torch.tensor([False]), n, -radius * n, radius * n,
                        0.6 * one, 0.05 * one)  # fmt: skip
    bodies = BodyInertia(mass, inertia, inertia.inverse(), velocity, torch.tensor([False, pinned]))
    return bodies, contacts, *solve(bodies, contacts, velocity)


def test_a_collision_keeps_momentum_and_separates_at_the_target():
    bodies, contacts, after, impulse = two_balls(pinned=False)
    mass, before = bodies.mass[:, None], bodies.velocity
    torch.testing.assert_close((mass * after[:, :3]).sum(0), (mass * before[:, :3]).sum(0))
    assert float(after[1, 0] - after[0, 0]) == pytest.approx(0.6, rel=0.02)  # contacts are stiff, not rigid
    assert float(impulse[0, 1]) == pytest.approx(0.05 * float(impulse[0, 0]), rel=1e-4)  # it slips
    spin = torch.linalg.cross(contacts.arm_a[0], impulse[0]) / bodies.inertia[0, 0, 0]
    torch.testing.assert_close(after[0, 3:], spin)


def test_a_pinned_body_stays():
    _, _, after, _ = two_balls(pinned=True)
    assert float(after[1].abs().max()) < 1e-4
    assert float(after[0, 0]) == pytest.approx(-0.6, rel=0.02)
