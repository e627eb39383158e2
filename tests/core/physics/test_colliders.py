"""Colliders: friction, restitution, contact and prescribed motion."""

import math

import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.rotations import multiply
from stages.core.physics.colliders import Collider, as_obstacles
from stages.core.physics.mpm import solver as mpm
from tests.conftest import DEVICES
from tests.core.physics.test_mpm import FREE, block, roll

PLANE = (0.0, 0.0, 0.0)


def tilted(slope: float) -> tuple[float, float, float, float]:
    """Rotation (x, y, z, w) of the z axis to the normal of a plane that falls along x with this slope."""
    half = math.atan(slope) / 2
    return math.cos(half), 0.0, math.sin(half), 0.0


def along_slope(slope: float, friction: float = 0.5, surface: str = "separate", finer: int = 1) -> float:
    """Acceleration of a flat block on a tilted plane [m/s^2]; the block lies aligned with it, gravity is rotated."""
    p = block((0.4, 0.2, 0.1), 1 / 60, E=5e5, viscosity=200.0)
    ground = Collider("plane", PLANE, surface=surface, friction=friction)
    box, angle = mpm.Box((-1, -1, -0.5), (2, 1.4, 1)), math.atan(slope)
    solver = mpm.Solver(p, box, 1 / 30, options=mpm.SolverOptions((ground,)))
    push = (9.81 * math.sin(angle), 0.0, -9.81 * math.cos(angle))
    steps = finer * solver.substeps(0.02, torch.tensor([push]))
    roll(solver, 0.2, (0.0, 0.0, push[2]), substeps=steps)
    roll(solver, 0.1, push, substeps=steps)
    before = solver.particles.v[:, 0].mean()
    roll(solver, 0.2, push, substeps=steps)
    return float(solver.particles.v[:, 0].mean() - before) / 0.2


@pytest.mark.parametrize("finer", [1, 3])
def test_coulomb_friction_does_not_depend_on_the_substep(finer):
    expected = 9.81 * (math.sin(math.atan(0.75)) - 0.3 * math.cos(math.atan(0.75)))
    assert along_slope(0.75, 0.3, finer=finer) == pytest.approx(expected, rel=0.07)


def test_sticky_and_slip_surfaces():
    slope = 0.75
    assert abs(along_slope(slope, surface="sticky")) < 0.05
    assert along_slope(slope, surface="slip") == pytest.approx(9.81 * math.sin(math.atan(slope)), rel=0.02)


@pytest.mark.parametrize("surface, leaves", [("separate", True), ("slip", False), ("sticky", False)])
def test_only_separate_surfaces_release_bodies(surface, leaves):
    p = block((0.2, 0.2, 0.1), 0.025, E=2e5)
    ground = Collider("plane", PLANE, surface=surface)
    solver = mpm.Solver(p, FREE, 0.05, options=mpm.SolverOptions((ground,)))
    roll(solver, 0.1, (0.0, 0.0, -9.81))
    bottom = float(solver.particles.x[:, 2].min())
    roll(solver, 0.2, (0.0, 0.0, 20.0))
    risen = float(solver.particles.x[:, 2].min()) - bottom
    assert risen == pytest.approx(20 * 0.2**2 / 2, rel=0.15) if leaves else risen < 0.05


def dropped(restitution: float, finer: int, collider: bool) -> float:
    """Speed at which a sheet of particles leaves the ground after hitting it at 1 m/s."""
    p = block((0.3, 0.3, 0.025), 0.025, E=2e5, nu=0.0, low=(0, 0, 0.1))
    p.x[:, 2] = 0.1
    p.v[:, 2] = -1.0
    if collider:
        ground = Collider("plane", PLANE, restitution=restitution, friction=0.0)
        solver = mpm.Solver(p, FREE, 0.05, options=mpm.SolverOptions((ground,)))
    else:
        solver = mpm.Solver(p, mpm.Box((-1, -1, 0), (2, 2, 1), restitution=restitution), 0.05)
    roll(solver, 0.3, substeps=finer * solver.substeps(0.02, torch.zeros(1, 3)))
    return float(solver.particles.v[:, 2].mean())


@pytest.mark.parametrize("collider", [True, False])
@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_restitution_does_not_depend_on_the_substep(restitution, collider):
    # a sheet has no internal waves, so its speed is that of its surface
    for finer in (1, 4):
        assert dropped(restitution, finer, collider) == pytest.approx(restitution, abs=0.05)


def test_a_block_rests_on_a_box_and_falls_past_its_edge():
    table = Collider("box", (0.1, 0.1, 0.2), (0.3, 0.3, 0.1))
    on, beside = block((0.2, 0.2, 0.1), 0.025, low=(0, 0, 0.31)), block((0.1, 0.1, 0.1), 0.025, low=(0.5, 0, 0.31))
    solver = mpm.Solver(mpm.join_particles([on, beside]), FREE, 0.05, options=mpm.SolverOptions((table,)))
    roll(solver, 0.3, (0.0, 0.0, -9.81))
    z = solver.particles.x[:, 2]
    assert abs(float(z[: len(on)].min()) - 0.3) < 0.05  # the tolerance is one cell
    assert float((beside.x[:, 2] - z[len(on) :]).mean()) == pytest.approx(9.81 * 0.3**2 / 2, rel=0.02)


def test_bodies_do_not_penetrate_a_sphere_and_slide_off_it():
    ball = Collider("sphere", (0.1, 0.1, 0.0), (0.2, 0.0, 0.0), friction=0.1)
    p = block((0.1, 0.1, 0.1), 0.0125, E=2e5, low=(0.09, 0.05, 0.22))
    solver = mpm.Solver(p, FREE, 0.025, options=mpm.SolverOptions((ball,)))
    roll(solver, 0.6, (0.0, 0.0, -9.81))
    x = solver.particles.x - torch.tensor([0.1, 0.1, 0.0])
    assert float(x.norm(dim=1).min()) > 0.2 - 0.025
    assert float(x[:, 0].mean()) > 0.1  # it was placed off centre


@pytest.mark.parametrize("device, schedule", [(d, s) for d in DEVICES for s in ("split", "fused")])
def test_a_moving_wall_pushes_and_a_rotating_table_carries(device, schedule):
    wall = Collider("box", (-0.2, 0.1, 0.1), (0.15, 0.4, 0.4), velocity=(0.5, 0.0, 0.0), friction=0.0)
    p = block((0.1, 0.1, 0.1), 0.025, E=2e5, viscosity=100.0)
    solver = mpm.Solver(p, FREE, 0.05, device, mpm.SolverOptions((wall,), schedule=schedule))
    roll(solver, 0.6)
    assert solver.colliders[0].centre == pytest.approx((0.1, 0.1, 0.1))
    now = solver.particles
    # the body moves with the wall or bounces ahead of it
    assert 0.45 < float(now.v[:, 0].mean()) < 1.0 and float(now.x[:, 0].min()) > 0.25 - 0.05
    table = Collider("box", PLANE, (0.5, 0.5, 0.15), angular_velocity=(0.0, 0.0, 1.0), surface="sticky")
    solver = mpm.Solver(block((0.1, 0.1, 0.1), 0.025, E=2e5, viscosity=50.0, low=(0.2, -0.05, 0.13)), FREE, 0.05,
                        device, mpm.SolverOptions((table,), schedule=schedule))  # fmt: skip
    roll(solver, 0.6, (0.0, 0.0, -9.81))
    x, y = solver.particles.x[:, :2].mean(0).tolist()
    assert math.atan2(y, x) == pytest.approx(0.6, abs=0.1)  # radians, after 0.6 s at 1 rad/s


@pytest.mark.parametrize("device, schedule", [(d, s) for d in DEVICES for s in ("split", "fused")])
def test_a_kinematic_body_moves_as_prescribed_and_drags_others(device, schedule):
    low, high = block((0.3, 0.2, 0.1), 0.025), block((0.1, 0.1, 0.1), 0.025, low=(0.1, 0.05, 0.11), viscosity=50.0)
    p = mpm.join_particles([low, high])
    p.held[: len(low)] = 1
    p.v[: len(low), 0] = 0.3
    solver = mpm.Solver(p, FREE, 0.05, device, mpm.SolverOptions(schedule=schedule))
    roll(solver, 0.5, (0.0, 0.0, -9.81))
    end = mpm.Particles(*(getattr(solver.particles, f).cpu() for f in p.__dataclass_fields__))
    torch.testing.assert_close(end.x[: len(low)] - low.x, torch.tensor([[0.15, 0.0, 0.0]]).expand(len(low), 3),
                               rtol=0, atol=1e-5)  # fmt: skip
    assert float((end.x[len(low) :] - high.x)[:, 0].mean()) == pytest.approx(0.15, abs=0.02)


def test_prescribed_motion_of_colliders():
    c = Collider("box", (1.0, 0, 0), (1, 1, 1), velocity=(0, 2.0, 0), angular_velocity=(0, 0, math.pi)).advanced(0.5)
    assert c.centre == pytest.approx((1.0, 1.0, 0.0))
    assert c.rotation == pytest.approx((math.sqrt(0.5), 0, 0, math.sqrt(0.5)))


def test_colliders_turn_about_an_axis_of_the_world():
    """Rotation by 1.2 rad about (1, 2, 2) / 3, from any initial rotation, in one step or in many."""
    start, rate = (0.8, -0.36, 0.48, 0.0), (0.4, 0.8, 0.8)
    once = Collider("box", PLANE, (1, 1, 1), rotation=start, angular_velocity=rate).advanced(1.0)
    turn = torch.tensor([math.cos(0.6), *(math.sin(0.6) * v / 1.2 for v in rate)])
    torch.testing.assert_close(torch.tensor(once.rotation), multiply(turn, torch.tensor(start)))
    often = Collider("box", PLANE, (1, 1, 1), rotation=start, angular_velocity=rate)
    for _ in range(10):
        often = often.advanced(0.1)
    assert often.rotation == pytest.approx(once.rotation)


@pytest.mark.parametrize("wrong, message", [
    ({"kind": "cone"}, "plane, sphere, box, not 'cone'"), ({"surface": "wet"}, "separate, slip, sticky"),
    ({"friction": -1.0}, "0 or more"), ({"restitution": 2.0}, "0 to 1"),
    *(({"kind": kind, **size}, f"a {kind} needs a positive size") for kind, size in (
        ("sphere", {}), ("box", {}), ("sphere", {"size": (-1.0, 1.0, 1.0)}), ("box", {"size": (1.0, 1.0, 0.0)}))),
])  # fmt: skip
def test_invalid_colliders(wrong, message):
    with pytest.raises(InputError, match=message):
        Collider(**{"kind": "plane", "centre": PLANE, **wrong})


def test_rotations_of_colliders_need_not_have_length_1():
    longer, unit = (as_obstacles([Collider("box", PLANE, (1, 1, 1), rotation=r)], "cpu").numpy()
                    for r in ((0.0, 3.0, 0.0, 4.0), (0.0, 0.6, 0.0, 0.8)))  # fmt: skip
    np.testing.assert_allclose(longer["turn"], unit["turn"])
    np.testing.assert_allclose(unit["turn"][0], [0.6, 0.0, 0.8, 0.0])  # order x, y, z, w
