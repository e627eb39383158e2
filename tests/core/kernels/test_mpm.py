"""The MPM substep, compared with its PyTorch specification; reproducibility and clearing of the launch schedules."""

import pytest
import torch

from stages.core.kernels.mpm.grid import GRID_PADDING
from stages.core.kernels.mpm.transfers import substep_reference
from stages.core.physics.mpm import solver as mpm
from tests.conftest import DEVICES

DX, DT, FRICTION = 0.1, 1e-3, 0.4


def cloud(p: int = 300, seed: int = 0) -> mpm.Particles:
    """Deformed, moving particles, some of them in the floor and in a wall of the box from 0 to 1."""
    rng = torch.Generator().manual_seed(seed)
    x = torch.rand(p, 3, generator=rng) * torch.tensor([0.3, 0.5, 0.5]) + torch.tensor([0.0, 0.25, 0.0])
    particles = mpm.at_rest(x, 1e-3, mpm.ParticleMaterial(2e5, 0.3, 900.0, 4.0, FRICTION))
    particles.v = torch.randn(p, 3, generator=rng) - torch.tensor([1.0, 0, 1])
    particles.C = torch.randn(p, 3, 3, generator=rng)
    particles.F = particles.F + 0.1 * torch.randn(p, 3, 3, generator=rng)
    return particles


def viscoelastic_cloud() -> mpm.Particles:
    """The same particles with strained Maxwell branches."""
    rng = torch.Generator().manual_seed(1)
    p = cloud()
    p = mpm.with_branches(p, torch.rand(len(p), 2, generator=rng), 500 * torch.rand(len(p), 2, generator=rng))
    strain = 0.1 * torch.randn(len(p), 2, 3, 3, generator=rng)
    p.branch_strain = strain + strain.mT
    return p


@pytest.mark.parametrize("make", [cloud, viscoelastic_cloud])
@pytest.mark.parametrize("device", DEVICES)
def test_substep_equals_its_reference(device, make):
    # float32 against float64: sums of a few dozen terms, so 1e-5 of the largest value
    ours = make()
    solver = mpm.Solver(ours, mpm.Box((0, 0, 0), (1, 1, 1)), DX, device)
    push = torch.tensor([0.5, 0.0, -9.81]).repeat(len(ours), 1)
    solver.advance(DT, push, substeps=1)
    columns = ("x", "v", "C", "F", "mass", "volume", "stiffness", "branch_modulus", "branch_strain")
    theirs = {k: getattr(ours, k).double() for k in columns}
    expected = substep_reference({**theirs, "acceleration": push.double()}, solver.grid, FRICTION, DT)
    got = solver.particles
    for name, value in zip(("x", "v", "C", "F"), expected, strict=True):
        scale = float(value.abs().max())
        torch.testing.assert_close(getattr(got, name).cpu().double(), value, rtol=0, atol=2e-5 * scale, msg=name)
    kept = 1 / (1 + DT * ours.branch_rate.double())[..., None, None]
    change = expected[2][:, None] @ (torch.eye(3) + theirs["branch_strain"])
    strain = kept * (theirs["branch_strain"] + DT * (change + change.mT))
    torch.testing.assert_close(got.branch_strain.cpu().double(), strain, rtol=0, atol=2e-5)
    assert list(solver.grid.low) == [GRID_PADDING] * 3


def test_result_is_bit_identical_for_any_number_of_threads(monkeypatch):
    push = torch.tensor([0.0, 0.0, -9.81]).repeat(300, 1)
    results = []
    for threads in (1, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        solver = mpm.Solver(cloud(), mpm.Box((0, 0, 0), (1, 1, 1)), DX)
        for _ in range(3):
            solver.advance(0.01, push)
        results.append(solver.particles.x)
    assert torch.equal(*results)


def test_grid_is_zero_after_a_frame():
    # momentum scattered in one substep must be cleared before the next, even where particles have left
    solver = mpm.Solver(cloud(), mpm.Box((0, 0, 0), (1, 1, 1)), DX)
    solver.advance(0.05, torch.zeros(300, 3))
    assert not solver._substepper._momentum.any()
