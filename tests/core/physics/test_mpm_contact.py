"""Bodies with separate velocity fields neither stick together nor penetrate, and obey Coulomb's law of friction."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.core.kernels.mpm.constitutive import SAND, maxwell_branches
from stages.core.kernels.mpm.transfers import Features
from stages.core.physics.mpm import solver as mpm
from stages.core.physics.mpm.body_shapes import BodyShape
from stages.core.physics.mpm.contact import ContactSubsteps
from stages.core.physics.mpm.split import SplitSubsteps

DX, G = 0.05, 9.81
BOX = mpm.Box((-1.0, -1.0, 0.0), (3.0, 1.0, 1.5))


def block(low: tuple, high: tuple, friction: float = 0.3, speed: float = 0.0, held: bool = False) -> mpm.Particles:
    """A block with eight particles per cell, a modulus of 1e6 Pa and a density of 500 kg/m^3."""
    axes = [torch.arange(a + DX / 4, b, DX / 2) for a, b in zip(low, high, strict=True)]
    x = torch.cartesian_prod(*axes)
    p = mpm.at_rest(x, (DX / 2) ** 3, mpm.ParticleMaterial(1e6, 0.3, 500.0, 30.0, friction))
    p.v[:, 0], p.held[:] = speed, int(held)
    return p


@pytest.fixture
def solve(device):
    """Function that returns positions and velocities of each body after a number of frames of 0.02 s."""

    def solve(bodies: list[mpm.Particles], frames: int, gravity: float, touch: bool = True) -> tuple[list, list]:
        sizes = [len(b) for b in bodies]
        options = mpm.SolverOptions(schedule="contact" if touch else "auto")
        solver = mpm.Solver(mpm.join_particles(bodies), BOX, DX, device, options, sizes if touch else None)
        return moved(solver, sizes, frames, gravity)

    return solve


def moved(solver: mpm.Solver, sizes: list[int], frames: int, gravity: float) -> tuple[list, list]:
    pull = torch.tensor([0.0, 0.0, -gravity]) * (solver.particles.held.cpu() == 0)[:, None]
    for _ in range(frames):
        solver.advance(0.02, pull)
    return [list(getattr(solver.particles, name).cpu().split(sizes)) for name in "xv"]


def test_blocks_that_meet_keep_their_momentum_and_part_again(solve):
    blocks = [block((0, 0, 0.5), (0.2, 0.2, 0.7), speed=1.0), block((0.3, 0, 0.5), (0.5, 0.2, 0.7))]
    x, v = solve(blocks, 25, 0.0)
    one, other = (float(w[:, 0].mean()) for w in v)
    assert one + other == pytest.approx(1.0, abs=1e-3)
    assert other - one > 0.5 and float(x[1][:, 0].min() - x[0][:, 0].max()) > 0.1
    _, stuck = solve(blocks, 25, 0.0, touch=False)
    assert float(stuck[1][:, 0].mean() - stuck[0][:, 0].mean()) < other - one


@pytest.mark.parametrize("friction", [pytest.param(0.1, marks=pytest.mark.slow), 0.5])
def test_a_block_slides_on_another_by_v2_over_2_mu_g(solve, friction):
    slab = block((-0.2, -0.15, 0.15), (2.0 if friction < 0.3 else 0.8, 0.45, 0.3), friction, held=True)
    slider = block((0, 0, 0.3), (0.3, 0.3, 0.4), friction, speed=1.2)
    x, _ = solve([slab, slider], 60 if friction < 0.3 else 20, G)
    time = 1.2 if friction < 0.3 else 0.4
    stop = min(1.2 / (friction * G), time)
    assert float(x[1][:, 0].mean()) - 0.15 == pytest.approx(1.2 * stop - friction * G * stop**2 / 2, rel=0.02)


def planes(p: mpm.Particles) -> BodyShape:
    """The shape of a block; its distance is that from the planes of its faces, also outside their outlines."""
    h = DX / 2
    low, high = p.rest.amin(0).numpy() - h / 2, p.rest.amax(0).numpy() + h / 2
    size = np.rint((high - low) / h).astype(int) + 10
    x = low - 4.5 * h + h * np.moveaxis(np.indices(size), 0, -1)
    return BodyShape(np.maximum(low - x, x - high).max(-1), low - 4.5 * h, h)


def turned(p: mpm.Particles, degrees: float) -> torch.Tensor:
    """Rotate a block about the y axis, so that its x axis points downhill, and return the rotation matrix."""
    a = math.radians(degrees)
    R = torch.tensor([[math.cos(a), 0.0, math.sin(a)], [0.0, 1.0, 0.0], [-math.sin(a), 0.0, math.cos(a)]])
    p.x, p.F = p.x @ R.mT, R.repeat(len(p), 1, 1)
    return R


@pytest.mark.parametrize(("degrees", "friction"), [pytest.param(10, 0.0, marks=pytest.mark.slow), (25, 0.3), (40, 0.0)])
def test_a_block_slides_down_a_slope_as_a_point_mass_does(device, degrees, friction):
    """The leading edge is above the face of the slope; the plane of the slope's front face must not stop it."""
    slab = block((-0.2, -0.1, -0.1), (0.9, 0.3, 0.0), friction, held=True)
    slider = block((-0.1, 0, 0), (0.1, 0.2, 0.1), friction)
    shapes = [planes(slab), planes(slider)]
    R = [turned(p, degrees) for p in (slab, slider)][0]
    for p in (slab, slider):
        p.x[:, 2] += 0.6
    start, sizes = slider.x.clone(), [len(slab), len(slider)]
    options = mpm.SolverOptions(schedule="contact", shapes=shapes)
    solver = mpm.Solver(mpm.join_particles([slab, slider]), BOX, DX, device, options, sizes)
    x, _ = moved(solver, sizes, 20, G)
    a = math.radians(degrees)
    down = float(((x[1] - start).mean(0) @ R)[0])
    assert down == pytest.approx(G * (math.sin(a) - friction * math.cos(a)) * 0.4**2 / 2, rel=0.03)


def test_a_block_rests_on_another_with_a_gap_of_at_most_a_quarter_cell(solve):
    x, v = solve([block((0, 0, 0), (0.3, 0.3, 0.15)), block((0.05, 0.05, 0.18), (0.25, 0.25, 0.38))], 40, G)
    # particles are a quarter cell below the surface of their body
    gap = float(x[1][:, 2].min() - x[0][:, 2].max()) - DX / 2
    assert abs(gap) < 0.25 * DX and float(v[1].norm(dim=1).mean()) < 0.02


def rise(x: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
    """Mean vertical displacement of the particles at the lower and the upper end of a block along x."""
    ends = [start[:, 0] < start[:, 0].min() + DX, start[:, 0] > start[:, 0].max() - DX]
    return torch.stack([(x - start)[end, 2].mean() for end in ends])


def test_a_block_thrown_on_another_lands_flat(solve):
    """The leading edge has contact as early as the face has, and the block penetrates by at most 3 % of its height."""
    upper = block((0.05, 0.1, 0.34), (0.35, 0.4, 0.64), speed=0.5)
    start = upper.x.clone()
    x, _ = solve([block((0, 0, 0), (0.5, 0.5, 0.3)), upper], 15, G)
    low, high = rise(x[1], start).tolist()
    assert abs(math.degrees(math.atan2(high - low, 0.3))) < 2
    assert (low + high) / 2 == pytest.approx(-0.04, abs=0.03 * 0.3)


@pytest.mark.parametrize("friction", [0.1, 0.6])
def test_a_block_slides_on_the_floor_by_v2_over_2_mu_g(solve, friction):
    slider = block((0, 0, 0), (0.3, 0.3, 0.15), friction, speed=1.0)
    x, _ = solve([slider], 20, G)
    stop = min(1.0 / (friction * G), 0.4)
    assert float(x[0][:, 0].mean()) - 0.15 == pytest.approx(stop - friction * G * stop**2 / 2, rel=0.1)


def test_a_block_that_falls_on_the_floor_rests_on_it_and_stays_level(solve):
    fallen = block((0, 0, 0.02), (0.3, 0.3, 0.32))
    start = fallen.x.clone()
    x, _ = solve([fallen], 40, G)
    low, high = rise(x[0], start).tolist()
    assert (low + high) / 2 == pytest.approx(-0.02, abs=0.15 * DX) and abs(high - low) < 0.01


def test_sand_rests_on_a_held_block(solve):
    """Grains do not have the surface of the body that they were filled from; they have contact at their radius."""
    slab, heap = block((0, 0, 0.2), (0.5, 0.5, 0.3), held=True), block((0.15, 0.15, 0.3), (0.35, 0.35, 0.4))
    heap.model[:], heap.plastic[:, 0] = SAND, 0.4
    x, _ = solve([slab, heap], 10, G)
    assert float(x[1][:, 2].min()) > 0.3 - 0.25 * DX and float(x[1][:, 2].min()) < 0.3 + DX


def test_three_blocks_at_one_place_keep_their_momentum(solve):
    blocks = [block((0, 0, 0.5), (0.2, 0.2, 0.7), speed=1.0), block((0.22, 0, 0.5), (0.42, 0.2, 0.7)),
              block((0.22, 0.2, 0.5), (0.42, 0.4, 0.7))]  # fmt: skip
    _, v = solve(blocks, 10, 0.0)
    total = sum(w.mean(0) for w in v)
    torch.testing.assert_close(total, torch.tensor([1.0, 0.0, 0.0]), rtol=0, atol=2e-3)


@pytest.mark.parametrize("viscoelastic", [False, True])
def test_the_schedule_for_gpus_gives_the_same_motion_and_repeats_to_the_bit(device, viscoelastic):
    """Three bodies, two of which collide, in frames of two lengths, so that graphs are captured and replayed.

    Contact amplifies rounding: the motions may differ by a few times the effect of changing the last bits of the
    initial positions. With Maxwell branches, they are compared after four frames, while the bodies are in the air.
    """
    bodies = [block((0, 0, 0), (0.4, 0.3, 0.15)), block((0.1, 0.05, 0.25), (0.3, 0.25, 0.45), speed=1.0),
              block((0.5, 0.05, 0.25), (0.65, 0.2, 0.4), speed=-1.0)]  # fmt: skip
    joined, sizes = mpm.join_particles(bodies), [len(b) for b in bodies]
    features = Features(plastic=False, viscoelastic=viscoelastic, restitution=False)
    if viscoelastic:
        columns = (torch.tensor([pair]).repeat(len(joined), 1) for pair in maxwell_branches(0.2, 300.0))
        joined = mpm.with_branches(joined, *columns)

    def run(kind, seed=None, frames=4 if viscoelastic else 10):
        start = joined
        if seed is not None:
            toward = torch.randn(joined.x.shape, generator=torch.Generator().manual_seed(seed)).sign() * torch.inf
            start = replace(joined, x=torch.nextafter(joined.x, toward))
        solver = mpm.Solver(start, BOX, DX, device, mpm.SolverOptions(schedule="contact"), sizes)
        shared = solver.rows, features, solver._body_contact(start, sizes, None)
        solver._substepper = kind(*shared, solver._quanta()) if kind is ContactSubsteps else kind(*shared)
        return torch.cat(moved(solver, sizes, frames, G)[0])

    fast, split = run(ContactSubsteps), run(SplitSubsteps)
    rounding = float((run(SplitSubsteps, seed=0) - split).abs().max())
    assert rounding < 1e-4
    torch.testing.assert_close(fast, split, rtol=0, atol=3 * rounding)
    assert torch.equal(run(ContactSubsteps, frames=10), run(ContactSubsteps, frames=10))


def test_unknown_schedules_are_refused():
    with pytest.raises(ValueError, match="'both' is not a schedule"):
        mpm.SolverOptions(schedule="both")
