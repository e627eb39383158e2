"""Physics of the MPM solver: conservation, waves, contact, friction."""

import math

import pytest
import torch
import warp as wp

from stages.core.kernels.mpm import grid as mpm_grid
from stages.core.kernels.mpm.constitutive import maxwell_branches
from stages.core.physics.mpm import solver as mpm
from tests.conftest import DEVICES

FREE = mpm.Box((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))


def block(
    size: tuple = (0.2, 0.2, 0.2), h: float = 0.0125, E: float = 1e5, nu: float = 0.3, density: float = 500.0,
    friction: float = 0.5, viscosity: float = 0.0, low: tuple = (0.0, 0.0, 0.0),
) -> mpm.Particles:  # fmt: skip
    """A box of particles of the given density, jittered in voxels of edge h."""
    counts = [max(1, round(s / h)) for s in size]
    x = torch.cartesian_prod(*[torch.arange(n) + 0.5 for n in counts]) * h
    x = x + (torch.rand(x.shape, generator=torch.Generator().manual_seed(0)) - 0.5) * 0.5 * h + torch.tensor(low)
    return mpm.at_rest(x, h**3, mpm.ParticleMaterial(E, nu, density, viscosity, friction))


def roll(solver: mpm.Solver, seconds: float, push: tuple = (0.0, 0.0, 0.0), frame: float = 0.02, **options) -> None:
    accelerations = torch.tensor(push).repeat(len(solver.particles), 1)
    for _ in range(round(seconds / frame)):
        solver.advance(frame, accelerations, **options)


def momenta(p: mpm.Particles, dx: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Linear and angular momentum; an APIC particle has moment of inertia m dx^2 / 4 (Jiang et al. 2015, eq. 8)."""
    x, v, C, m = (t.double() for t in (p.x, p.v, p.C, p.mass))
    spin = dx**2 / 4 * torch.stack([C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], 1)
    return (m[:, None] * v).sum(0), (m[:, None] * (torch.linalg.cross(x, v) + spin)).sum(0)


def energy(p: mpm.Particles, dx: float) -> float:
    """Kinetic energy with the affine part, plus elastic energy [J].

    The density of the elastic energy is mu/2 (tr F^T F - 3 - 2 log J) + lambda/2 log(J)^2.
    """
    F, v, C = p.F.double(), p.v.double(), p.C.double()
    log_J = torch.linalg.det(F).log()
    mu, lam = p.stiffness[:, 0].double(), p.stiffness[:, 1].double()
    stored = mu / 2 * (F.square().sum((1, 2)) - 3 - 2 * log_J) + lam / 2 * log_J**2
    kinetic = p.mass.double() / 2 * (v.square().sum(1) + dx**2 / 4 * C.square().sum((1, 2)))
    return float((kinetic + p.volume.double() * stored).sum())


@pytest.mark.parametrize("device", DEVICES)
def test_free_flight_is_a_parabola(device):
    p = block()
    p.v[:] = torch.tensor([1.0, 0.5, 2.0])
    solver, g, t = mpm.Solver(p, FREE, 0.025, device), torch.tensor([0.0, 0.0, -9.81]), 0.2
    roll(solver, t, tuple(g.tolist()))
    # the error of symplectic Euler is g t dt / 2; the rest is float32 rounding
    dt = 0.02 / solver.substeps(0.02, g[None])
    expected = p.x.mean(0) + p.v[0] * t + g * t**2 / 2
    torch.testing.assert_close(solver.particles.x.cpu().mean(0), expected, rtol=0, atol=9.81 * t * dt / 2 + 1e-4)
    assert (solver.particles.F.cpu() - torch.eye(3)).abs().max() < 1e-3  # there is no deformation


def test_momentum_and_angular_momentum_are_conserved():
    p, dx = block((0.2, 0.1, 0.3)), 0.025
    r = p.x - p.x.mean(0)
    p.v = torch.tensor([0.5, -0.3, 0.2]) + torch.linalg.cross(torch.tensor([3.0, 5.0, -4.0]).expand_as(r), r) + 4 * r
    solver = mpm.Solver(p, FREE, dx)
    roll(solver, 0.02)  # the affine part builds up
    before = momenta(solver.particles, dx)
    roll(solver, 0.3)
    for a, b in zip(before, momenta(solver.particles, dx), strict=True):
        # rounding of a few hundred float32 steps
        torch.testing.assert_close(a, b, rtol=0, atol=2e-4 * float(a.norm()))


def vibration(dx: float, time: float = 0.1) -> float:
    """Fraction of its energy that a ball in radial vibration keeps over `time` [s]."""
    p = block(h=dx / 2, E=2e5)
    r = p.x - p.x.mean(0)
    p = mpm.Particles(*(getattr(p, f)[r.norm(dim=1) < 0.1] for f in p.__dataclass_fields__))
    p.v = 3 * (p.x - p.x.mean(0))
    solver = mpm.Solver(p, FREE, dx)
    start, highest = energy(solver.particles, dx), 0.0
    for _ in range(round(time / 0.005)):
        roll(solver, 0.005, frame=0.005)
        highest = max(highest, energy(solver.particles, dx))
    assert highest < 1.02 * start, "energy grows"
    return energy(solver.particles, dx) / start


def test_energy_does_not_grow_and_its_loss_shrinks_with_refinement():
    coarse, fine = vibration(0.04), vibration(0.02)
    assert 1 - fine < 0.75 * (1 - coarse)


def test_a_bar_vibrates_at_its_frequency():
    # with free ends and Poisson's ratio 0: f = sqrt(E / density) / (2 L). The tolerance of 3 % is for quadratic splines
    # with 32 cells per wavelength, and for free ends resolved to a fraction of a cell.
    length, E, density, dx = 0.8, 1e5, 500.0, 0.05
    p = block((length, 0.1, 0.1), dx / 2, E, 0.0, density)
    shape = torch.cos(math.pi * p.x[:, 0] / length)
    p.v[:, 0] = 0.2 * shape
    solver, frame, signal = mpm.Solver(p, FREE, dx), 0.002, []
    for _ in range(85):
        roll(solver, frame, frame=frame)
        signal.append(float((solver.particles.v[:, 0] * shape).sum()))
    s = torch.tensor(signal)
    changes = (s[1:] * s[:-1] < 0).nonzero()[:, 0]
    crossings = frame * (changes + s[changes] / (s[changes] - s[changes + 1]))
    measured = (len(crossings) - 1) / 2 / float(crossings[-1] - crossings[0])
    assert len(crossings) >= 3
    assert measured == pytest.approx(math.sqrt(E / density) / (2 * length), rel=0.03)


def test_viscosity_damps_vibration():
    elastic, viscous = block(E=1e5), block(E=1e5, viscosity=30.0)
    kept = []
    for p in (elastic, viscous):
        p.v = 3 * (p.x - p.x.mean(0))
        solver = mpm.Solver(p, FREE, 0.025)
        start = energy(p, 0.025)
        roll(solver, 0.1)
        kept.append(energy(solver.particles, 0.025) / start)
    assert kept[1] < 0.5 * kept[0]


@pytest.mark.parametrize("slower", [1.0, 3.0, 10.0])
def test_a_bar_with_maxwell_branches_loses_the_same_share_of_each_vibration(slower):
    """After one period, exp(-2 pi loss) of the energy is left, at the upper frequency and at 1/3 and 1/10 of it."""
    loss, E, density, length, dx = 0.15, 1e5, 500.0, 0.4, 0.02
    p = block((length, 0.04, 0.04), dx / 2, E=E, nu=0.0, density=density)
    omega = math.pi * math.sqrt(E / density) / length
    modulus, rate = maxwell_branches(loss, slower * omega)
    p = mpm.with_branches(p, torch.tensor([modulus]).repeat(len(p), 1), torch.tensor([rate]).repeat(len(p), 1))
    shape = torch.cos(math.pi * p.x[:, 0] / length)
    p.v[:, 0] = 0.05 * shape
    solver, frame, signal = mpm.Solver(p, FREE, dx), 1e-3, []
    for _ in range(180):
        roll(solver, frame, frame=frame)
        signal.append(float((solver.particles.v[:, 0] * shape).sum()))
    s = torch.tensor(signal)
    turns = ((s[1:-1] - s[:-2]) * (s[2:] - s[1:-1]) < 0).nonzero()[:, 0] + 1  # extremes, which are half a period apart
    assert len(turns) >= 4
    kept = float((s[turns[3]] / s[turns[1]]).abs())
    assert kept == pytest.approx(math.exp(-math.pi * loss), rel=0.08)


def test_maxwell_branches_take_no_momentum_and_carry_no_load():
    p, dx = block((0.2, 0.1, 0.3)), 0.025
    modulus, rate = maxwell_branches(0.3, 100.0)
    p = mpm.with_branches(p, torch.tensor([modulus]).repeat(len(p), 1), torch.tensor([rate]).repeat(len(p), 1))
    r = p.x - p.x.mean(0)
    p.v = torch.tensor([0.5, -0.3, 0.2]) + torch.linalg.cross(torch.tensor([3.0, 5.0, -4.0]).expand_as(r), r) + 4 * r
    solver = mpm.Solver(p, FREE, dx)
    roll(solver, 0.02)
    before = momenta(solver.particles, dx)
    roll(solver, 0.3)
    for a, b in zip(before, momenta(solver.particles, dx), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=2e-4 * float(a.norm()))
    spun = energy(solver.particles, dx)
    roll(solver, 1.0)  # it spins on with a constant stretch, and the branches relax
    assert energy(solver.particles, dx) == pytest.approx(spun, rel=0.03)
    assert float(solver.particles.branch_strain.abs().max()) < 0.03


def test_a_block_rests_on_the_floor():
    # it settles by a fraction of a cell, stops, and neither creeps nor jitters
    dx, box = 0.025, mpm.Box((-1, -1, 0), (1, 1, 1))
    p = block((0.15, 0.15, 0.15), E=5e5, viscosity=100.0)
    solver = mpm.Solver(p, box, dx)
    roll(solver, 1.0, (0.0, 0.0, -9.81))
    settled = solver.particles.x.clone()
    roll(solver, 0.2, (0.0, 0.0, -9.81))
    end = solver.particles
    assert end.v.norm(dim=1).mean() < 3e-3
    assert float((end.x - settled).norm(dim=1).max()) < 5e-4
    assert float((end.x - p.x).norm(dim=1).max()) < dx / 8


def test_a_fall_ends_at_floor_height():
    # contact on the grid begins at about one cell; FLOOR_GAP corrects for it to a fraction of a cell
    dx = 0.025
    solver = mpm.Solver(
        block((0.15, 0.15, 0.15), E=5e5, viscosity=100.0, low=(0, 0, 0.03)), mpm.Box((-1, -1, 0), (1, 1, 1)), dx
    )
    roll(solver, 0.8, (0.0, 0.0, -9.81))
    assert abs(float(solver.particles.x[:, 2].quantile(0.01)) - dx / 4) < dx / 4


def slide(slope: float, friction: float, finer: int = 1) -> tuple[float, float]:
    """Mean acceleration along a slope [m/s^2] and distance after 0.3 s [m] of a flat block, after a start-up phase."""
    dx, angle = 1 / 30, math.atan(slope)
    p = block((0.4, 0.1, 0.1), dx / 2, E=5e5, viscosity=200.0, friction=friction)
    solver = mpm.Solver(p, mpm.Box((-1, -1, 0), (2, 1.4, 1)), dx)
    push = (9.81 * math.sin(angle), 0.0, -9.81 * math.cos(angle))
    substeps = finer * solver.substeps(0.02, torch.tensor([push]))
    roll(solver, 0.1, (0.0, 0.0, push[2]), substeps=substeps)
    roll(solver, 0.2, push, substeps=substeps)
    before = solver.particles
    roll(solver, 0.3, push, substeps=substeps)
    after = solver.particles
    gained, moved = (float((getattr(after, f) - getattr(before, f))[:, 0].mean()) for f in ("v", "x"))
    return gained / 0.3, moved


def rigid(slope: float, friction: float) -> float:
    """Acceleration of a sliding rigid block."""
    return 9.81 * (math.sin(math.atan(slope)) - friction * math.cos(math.atan(slope)))


def test_a_block_sticks_below_the_friction_angle():
    assert abs(slide(0.35, 0.5)[1]) < 1e-3


@pytest.mark.parametrize("slope, friction", [(0.75, 0.5), (0.3, 0.0)])
def test_a_block_slides_above_the_friction_angle(slope, friction):
    # sliding soft blocks vibrate, so their whole underside is not always in contact
    assert slide(slope, friction)[0] == pytest.approx(rigid(slope, friction), rel=0.07)


def test_friction_does_not_depend_on_the_substep():
    # a factor per substep, as in the solver of NGFF, would have three times the effect
    assert slide(0.75, 0.5, finer=3)[0] == pytest.approx(rigid(0.75, 0.5), rel=0.07)


@pytest.mark.gpu
def test_gpu_agrees_with_cpu():
    if len(DEVICES) < 2:
        pytest.skip("needs an NVIDIA GPU")
    if not wp.is_cpu_available():
        pytest.skip("this build of Warp has no CPU compiler")
    # a fall, contact with the floor and friction amplify rounding about a hundred times
    ends = []
    for device in DEVICES:
        p = block(low=(0, 0, 0.05))
        p.v[:, 0] = 1.0
        solver = mpm.Solver(p, mpm.Box((-0.2, -0.2, 0), (0.8, 0.5, 0.5)), 0.025, device)
        roll(solver, 0.3, (0.0, 0.0, -9.81), substeps=80)
        ends.append(solver.particles.x.cpu())
    torch.testing.assert_close(*ends, rtol=0, atol=2e-5)


def test_both_schedules_agree():
    ends = []
    for schedule in ("split", "fused"):
        p = block(low=(0, 0, 0.05))
        p.v[:, 0] = 1.0
        box, options = mpm.Box((-0.2, -0.2, 0), (0.8, 0.5, 0.5)), mpm.SolverOptions(schedule=schedule)
        solver = mpm.Solver(p, box, 0.025, options=options)
        roll(solver, 0.2, (0.0, 0.0, -9.81), substeps=80)
        ends.append(solver.particles.x)
        grids = solver._substepper._grids() if schedule == "fused" else [solver._substepper._momentum]
        assert not any(bool(g.any()) for g in grids), "a grid is not clean after a frame"
    torch.testing.assert_close(*ends, rtol=0, atol=2e-5)


def test_walls_hold():
    p = block(E=3e4)
    p.v[:, 0] = 3.0
    solver = mpm.Solver(p, mpm.Box((-0.1, -0.1, -0.1), (0.4, 0.3, 0.3)), 0.025)
    roll(solver, 0.16)
    assert float(solver.particles.x[:, 0].max()) < 0.4 + 0.025
    assert float(solver.particles.v[:, 0].mean()) < 0  # it has bounced


def test_a_held_body_stays_and_supports_others():
    low, high = block((0.1, 0.1, 0.1)), block((0.1, 0.1, 0.1), low=(0, 0, 0.15))
    p = mpm.join_particles([low, high])
    p.held[: len(low)] = 1
    solver = mpm.Solver(p, FREE, 0.025)
    roll(solver, 0.6, (0.0, 0.0, -9.81))
    end = solver.particles
    assert torch.equal(end.x[: len(low)], low.x)
    assert 0.1 < float(end.x[len(low) :, 2].mean()) < 0.2


def test_substeps_follow_the_cfl_condition():
    p, dx = block(E=1e6), 0.025
    solver = mpm.Solver(p, FREE, dx)
    wave = mpm.wave_speed(1e6, 0.3, 500.0)
    assert wave == pytest.approx(math.sqrt(1e6 * 0.7 / (1.3 * 0.4) / 500))
    assert mpm.modulus_at_wave_speed(wave, 0.3, 500.0) == pytest.approx(1e6)
    assert solver.substeps(0.02, torch.zeros(1, 3)) == math.ceil(0.02 * wave / (mpm.SAFETY * dx))
    solver.set(v=torch.full((len(p), 3), 10.0))
    speed = 10 * math.sqrt(3)
    assert solver.substeps(0.02, torch.zeros(1, 3)) == math.ceil(0.02 * (wave + speed) / (mpm.SAFETY * dx))


def test_substeps_of_a_viscous_solid_are_those_of_diffusion():
    assert mpm.substep_rate(0.02, 0.0, 3.0) == pytest.approx(mpm.substep_rate(0.01, 0.0, 3.0) / 4)
    assert mpm.substep_rate(0.01, 0.0, 3.0) == pytest.approx(3.0 / (mpm.VISCOUS * 1e-4))
    assert mpm.substep_rate(0.01, 50.0, 1e-9) == pytest.approx(50.0 / (mpm.SAFETY * 0.01))


def test_a_grid_has_whole_blocks_around_the_box():
    grid = mpm.make_grid(mpm.Box((0, 0, 0), (1, 2, 0.5)), 0.1)
    margin = 1 + 2 * mpm_grid.GRID_PADDING
    for nodes, cells in zip((grid.nodes[a] for a in range(3)), (10, 20, 5), strict=True):
        inside = math.ceil(cells + 2 * mpm.FLOOR_GAP - 1e-6)
        assert nodes % mpm_grid.BLOCK == 0 and 0 <= nodes - inside - margin < mpm_grid.BLOCK
    assert [grid.origin[a] for a in range(3)] == pytest.approx([-(mpm_grid.GRID_PADDING + mpm.FLOOR_GAP) * 0.1] * 3)


def test_divergence_names_the_particle():
    p = block()
    solver = mpm.Solver(p, FREE, 0.025)
    bad = p.v.clone()
    bad[17] = torch.nan
    solver.set(v=bad)
    with pytest.raises(mpm.Diverged) as error:
        solver.advance(0.02, torch.zeros(len(p), 3))
    assert error.value.particle == 17
    unstable = mpm.Solver(block(E=1e7), FREE, 0.025)
    unstable.set(v=torch.randn(len(p), 3, generator=torch.Generator().manual_seed(0)))
    with pytest.raises(mpm.Diverged):
        for _ in range(20):
            unstable.advance(0.02, torch.zeros(len(p), 3), substeps=5)


def test_an_exception_in_a_launch_reaches_the_caller_and_the_next_frame_runs(monkeypatch):
    class Failing(wp.Launch):
        def __init__(self):
            pass

        def launch(self, stream=None):
            raise RuntimeError("out of memory")

    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    p = block()
    solver = mpm.Solver(p, FREE, 0.025)
    solver.advance(0.02, torch.zeros(len(p), 3), substeps=1)
    working = solver._substepper._grid_commands[0]
    for _ in range(2):
        with pytest.raises(RuntimeError, match="out of memory"):
            solver._substepper._run([working, Failing(), working, Failing()])
    assert solver.advance(0.02, torch.zeros(len(p), 3), substeps=1) == 1
