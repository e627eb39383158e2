"""Pinned parts of bodies: they are clamped at their face, wherever it lies relative to the grid."""

import math
from dataclasses import fields

import numpy as np
import pytest
import torch
import warp as wp

from stages.core.kernels.interop import launch, view
from stages.core.kernels.mpm.pins import PinnedNodes, pin_nodes
from stages.core.kernels.mpm.transfers import KINEMATIC_MASS_FACTOR, Features
from stages.core.physics.mpm import solver as mpm
from stages.core.physics.mpm.contact import ContactSubsteps
from stages.core.physics.mpm.pins import OUTSIDE, face_nodes
from stages.core.physics.mpm.split import SplitSubsteps

# width and length [m], Young's modulus [Pa] and density [kg/m^3] of the beam
SIDE, LENGTH, E, DENSITY = 0.1, 0.5, 2e5, 500.0


def rotation(degrees: float, axis: tuple) -> torch.Tensor:
    w = math.radians(degrees) * torch.nn.functional.normalize(torch.tensor(axis), dim=0)
    return torch.linalg.matrix_exp(torch.tensor([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]))


def beam(n: int, nu: float, turn: torch.Tensor, shift: tuple) -> tuple[mpm.Particles, float]:
    """A rotated beam, initially along x, with n^2 particles per section, held where x < 0; and the grid spacing [m].

    `shift`: position of the beam relative to the nodes [cells].
    """
    h = SIDE / n
    x = torch.cartesian_prod(torch.arange(-6, round(LENGTH / h)), torch.arange(n), torch.arange(n)) + 0.5
    material = mpm.ParticleMaterial(E, nu, DENSITY, 0.0, 0.5)
    p = mpm.at_rest((x * h + 2 * h * torch.tensor(shift)) @ turn.mT, h**3, material)
    p.held[:] = (x[:, 0] < 0).to(p.held.dtype)
    return p, 2 * h


def solver_of(p: mpm.Particles, dx: float, device: str) -> mpm.Solver:
    """A solver whose nodes are at multiples of dx."""
    low, high = p.x.amin(0) - 0.2, p.x.amax(0) + 0.2
    low = dx * ((low / dx).floor() - torch.tensor([0.0, 0.0, 1 - mpm.CONTACT_FLOOR_GAP]))
    box = mpm.Box(tuple(low.tolist()), tuple(high.tolist()))
    return mpm.Solver(p, box, dx, device, mpm.SolverOptions(schedule="contact"))


def settle(solver: mpm.Solver, pull: torch.Tensor, omega: float) -> torch.Tensor:
    """Displacement at rest under an acceleration `pull` of the free part; `omega` is the lowest frequency [rad/s]."""
    start = solver.particles.x.cpu()
    acceleration = (solver.particles.held.cpu() == 0)[:, None] * pull
    # at least eight stable substeps; a GPU takes eight, and the effect of shorter ones is lost in rounding
    frame = 0.4 / omega
    for _ in range(30):
        solver.advance(frame, acceleration)
        now = solver.particles
        kept = math.exp(-1.6 * omega * frame)  # nearly critical damping
        solver.set(v=now.v * kept, C=now.C * kept)
    return solver.particles.x.cpu() - start


def tip_displacement(n: int, nu: float, turn: torch.Tensor, shift: tuple, pull: tuple, omega: float, device: str):
    """Displacement of the end along `pull` [m], and the grid spacing [m]."""
    p, dx = beam(n, nu, turn, shift)
    g = turn @ torch.tensor(pull)
    moved = (settle(solver_of(p, dx, device), g, omega) @ (g / g.norm())).reshape(-1, n**2).mean(1)
    return float(1.5 * moved[-1] - 0.5 * moved[-2]), dx


WAYS = [
    pytest.param(6, 0, (0.0, 0.1, 0.2)), pytest.param(6, 0, (0.5, 0.1, 0.2)), pytest.param(6, 30, (0.3, 0.1, 0.2)),
    *(pytest.param(12, *way, marks=pytest.mark.slow)
      for way in ((0, (0.0, 0.1, 0.2)), (0, (0.25, 0.1, 0.2)), (0, (0.5, 0.1, 0.2)), (0, (0.75, 0.1, 0.2)),
                  (10, (0.3, 0.1, 0.2)), (30, (0.3, 0.1, 0.2)), (45, (0.8, 0.5, 0.9)))),
]  # fmt: skip


@pytest.mark.parametrize(("n", "degrees", "shift"), WAYS)
def test_a_beam_bends_as_if_it_were_clamped_at_the_face_of_the_pinned_part(n, degrees, shift, device):
    """By Timoshenko's theory the sag is a L^4 + b L^2. L is right to a fraction of a cell at any resolution."""
    nu = 0.2
    turn, omega = rotation(degrees, (1.0, 1.0, 1.0)), 3.516 * math.sqrt(E / DENSITY / 12) * SIDE / LENGTH**2
    sag, dx = tip_displacement(n, nu, turn, shift, (0.0, 0.0, -0.5), omega, device)
    load = 0.5 * DENSITY * SIDE**2  # weight per length [N/m]
    a, b = load / (8 * E * SIDE**4 / 12), load / (2 * 5 / 6 * E / (2 * (1 + nu)) * SIDE**2)
    length = math.sqrt((math.sqrt(b**2 + 4 * a * sag) - b) / (2 * a))
    assert length == pytest.approx(LENGTH, abs=(0.3 if degrees else 0.2) * dx)


@pytest.mark.parametrize(("n", "degrees", "shift"), WAYS)
def test_a_bar_stretches_as_if_it_were_clamped_at_the_face_of_the_pinned_part(n, degrees, shift, device):
    """The stretch under gravity g is density g L^2 / 2 E. If nodes lie along the face, the velocity is linear there."""
    turn, omega = rotation(degrees, (1.0, 1.0, 1.0)), math.pi / 2 / LENGTH * math.sqrt(E / DENSITY)
    stretch, dx = tip_displacement(n, 0.0, turn, shift, (2.0, 0.0, 0.0), omega, device)
    assert math.sqrt(2 * E * stretch / DENSITY / 2.0) == pytest.approx(LENGTH, abs=(0.3 if degrees else 0.05) * dx)


@pytest.mark.slow
def test_a_beam_at_rest_does_not_creep(device):
    p, dx = beam(4, 0.3, torch.eye(3), (0.3, 0.1, 0.2))
    solver, pull, tip = solver_of(p, dx, device), torch.tensor([0.0, 0.0, -0.5]), p.rest[:, 0] > LENGTH - 0.03
    settle(solver, pull, 8.0)
    sag = []
    for _ in range(200):
        solver.advance(0.02, (p.held == 0)[:, None] * pull)
        sag.append(float((solver.particles.x.cpu() - p.x)[tip, 2].mean()))
    # averages over 1 s, which is longer than the period of 0.8 s
    first, *_, last = torch.tensor(sag).reshape(4, 50).mean(1).tolist()
    assert first < -0.01 and last == pytest.approx(first, rel=5e-3)


@pytest.mark.parametrize("width", [2, pytest.param(4, marks=pytest.mark.slow), 6])
def test_a_pinned_part_of_any_size_holds_what_is_around_it(width, device):
    """A cube of one to three cells in a beam that would otherwise fall by half of its thickness."""
    p, dx = beam(6, 0.3, torch.eye(3), (0.5, 0.6, 0.7))
    middle = p.rest - dx * torch.tensor([0.5, 0.6, 0.7]) - torch.tensor([LENGTH / 2, SIDE / 2, SIDE / 2])
    p.held[:] = (middle.abs() < width * dx / 4).all(1).to(p.held.dtype)
    p.stiffness[:, 2] = 0.005 * E
    solver, free = solver_of(p, dx, device), p.held == 0
    for _ in range(16):
        solver.advance(0.02, free[:, None] * torch.tensor([0.0, 0.0, -1.0]))
    moved = (solver.particles.x.cpu() - p.x).norm(dim=1)
    near = torch.cdist(p.rest, p.rest[~free]).amin(1) < 0.7 * dx
    assert float(moved[near].max()) < 0.02 * dx and float(moved.max()) < 0.3 * dx


@pytest.mark.parametrize("degrees", [0, 25])
def test_nodes_at_a_face_follow_a_linear_profile(degrees):
    """Slaves are at most OUTSIDE from the face, masters farther; velocities are proportional to the distances."""
    turn = rotation(degrees, (0.2, 1.0, 0.5))
    p, dx = beam(12, 0.3, turn, (0.2, 0.1, 0.4))
    nodes = face_nodes((p.x / dx + 20).double().numpy(), p.volume.double().numpy(), p.held.numpy() == 1)
    led = nodes.masters[:, 0] >= 0
    # position relative to the beam, x along it [cells]
    back = lambda at: ((at - 20.0) @ turn.double().numpy() - (0.2, 0.1, 0.4)).T  # noqa: E731
    d, y, z = back(nodes.slaves[led])
    far, *_ = back(nodes.masters[led])
    inside = (np.abs(y - 3) < 2) & (np.abs(z - 3) < 2)  # the inner 4 x 4 cells of the section of 6 x 6
    assert inside.sum() > 40 and d[inside].min() < -1
    assert d[inside].max() < OUTSIDE + 0.1 and far[inside].min() > OUTSIDE - 0.1
    # zero of the profile [cells]; the fraction in an oblique half-space differs from the formula by a few percent
    zero = ((d - nodes.ratio[led] * far) / (1 - nodes.ratio[led]))[inside]
    np.testing.assert_allclose(zero, 0, atol=0.15 if degrees else 0.02)
    assert abs(zero.mean()) < 0.02
    at_face = (p.x @ turn / dx - torch.tensor([0.2, 0.1, 0.4]))[torch.from_numpy(nodes.at_face), 0]
    assert float(at_face.min()) > -3 and float(at_face.max()) < 0


def test_nodes_are_projected_to_the_profiles_in_the_norm_of_their_mass(device):
    """Compared with the projection P (P^T M P)^-1 P^T M v on the velocities that the ratios P allow."""
    rng = np.random.default_rng(0)
    v, mass = rng.normal(size=(12, 3)), rng.uniform(0.5, 2, 12)
    masters, starts, slaves, ratio = [-1, 3, 7], [0, 1, 3, 6], [0, 1, 4, 2, 5, 9], [0.0, 0.4, -0.7, 0.3, -0.2, -1.1]
    P = np.eye(12)
    P[slaves, slaves] = 0
    for n, master in enumerate(masters[1:], 1):
        P[slaves[starts[n] : starts[n + 1]], master] = ratio[starts[n] : starts[n + 1]]
    P = P[:, P.any(0)]
    expected = P @ np.linalg.solve(P.T @ (mass[:, None] * P), P.T @ (mass[:, None] * v))

    velocity = torch.from_numpy(np.concatenate([v, mass[:, None]], 1)).float().to(device)
    pins, ints = PinnedNodes(), [torch.tensor(a, dtype=torch.int32, device=device) for a in (masters, starts, slaves)]
    ratios = torch.tensor(ratio, device=device)
    pins.masters, pins.starts, pins.slaves, pins.ratio = *(view(a) for a in ints), view(ratios)
    launch(pin_nodes, 3, [pins, view(velocity, wp.vec4)], device=device)
    np.testing.assert_allclose(velocity[:, :3].cpu(), expected, atol=1e-5)
    np.testing.assert_allclose(velocity[slaves, 3].cpu(), KINEMATIC_MASS_FACTOR * mass[slaves], rtol=1e-5)


def test_the_schedule_for_gpus_gives_the_same_motion_of_what_is_pinned_and_repeats_to_the_bit(device):
    """The second case pins another part after graphs were captured."""
    p, dx = beam(6, 0.3, torch.eye(3), (0.3, 0.1, 0.2))

    def run(kind):
        solver = solver_of(p, dx, device)
        shared = solver.rows, Features(False, False, False), solver._body_contact(p, [len(p)], None)
        solver._substepper = kind(*shared, solver._quanta()) if kind is ContactSubsteps else kind(*shared)
        ends = []
        for held in (p.rest[:, 0] < 0, p.rest[:, 0] < 0.1):
            solver.set(held=held.to(torch.int8), v=solver.particles.v.cpu() * ~held[:, None])
            for _ in range(4):
                solver.advance(0.02, torch.tensor([0.0, 0.0, -2.0]) * ~held[:, None], substeps=64)
            ends.append(solver.particles.x.cpu())
        return torch.stack(ends)

    fast = run(ContactSubsteps)
    assert float((fast[1] - p.x).norm(dim=1).max()) > 1e-3
    torch.testing.assert_close(fast, run(SplitSubsteps), rtol=0, atol=2e-5)
    assert torch.equal(fast, run(ContactSubsteps))


def test_what_is_released_falls_and_what_has_no_free_neighbours_stays(device):
    p, dx = beam(6, 0.3, torch.eye(3), (0.3, 0.1, 0.2))
    solver, free = solver_of(p, dx, device), torch.zeros_like(p.held)
    assert torch.equal(solver.particles.held.cpu(), p.held)  # includes particles that add nothing to the grid
    solver.set(held=free)
    solver.advance(0.02, torch.tensor([0.0, 0.0, -9.81]).repeat(len(p), 1))
    assert torch.equal(solver.particles.held.cpu(), free)
    torch.testing.assert_close(
        solver.particles.v.cpu(), torch.tensor([0, 0, -0.1962]).repeat(len(p), 1), atol=1e-3, rtol=0
    )
    p.held[:] = (p.x[:, 0] < LENGTH - dx).to(p.held.dtype)  # the remaining layer of one cell is too thin for a profile
    solver = solver_of(p, dx, device)
    solver.advance(0.1, torch.tensor([0.0, 0.0, -9.81]) * (p.held == 0)[:, None])
    torch.testing.assert_close(solver.particles.x.cpu(), p.x, atol=0.02 * dx, rtol=0)
    far = (p.x[:, 0] < 0) | (p.x[:, 0] > 0.3)  # pinned and free particles without common nodes
    apart = mpm.Particles(*(getattr(p, f.name)[far] for f in fields(p)))
    apart.held[:] = (apart.x[:, 0] < 0).to(p.held.dtype)
    solver = solver_of(apart, dx, device)
    solver.advance(0.02, torch.tensor([0.0, 0.0, -9.81]) * (apart.held == 0)[:, None])
    assert torch.equal(solver.particles.x.cpu()[apart.held == 1], apart.x[apart.held == 1])
    assert float(solver.particles.v.cpu()[apart.held == 0, 2].max()) < -0.19
