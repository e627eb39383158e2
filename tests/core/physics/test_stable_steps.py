"""Speeds of pressure waves, and the substeps and batches that result from them."""

import pytest
import torch

from stages.core.physics.mpm import batch
from stages.core.physics.mpm.domain import Box
from stages.core.physics.mpm.solver import (
    SAFETY,
    VISCOUS,
    ParticleMaterial,
    Solver,
    at_rest,
    modulus_at_wave_speed,
    substep_rate,
    wave_speed,
)


@pytest.mark.parametrize(("nu", "stiffening"), [(0.0, 1.0), (0.25, 1.2), (0.4, 0.6 / 0.28), (-0.5, 1.5)])
def test_speed_of_pressure_waves(nu, stiffening):
    """Laterally confined bars are stiffer than free ones by (1 - nu) / ((1 + nu) (1 - 2 nu))."""
    assert wave_speed(9e6, nu, 1000.0) == pytest.approx((9e3 * stiffening) ** 0.5)
    assert modulus_at_wave_speed(wave_speed(9e6, nu, 1000.0), nu, 1000.0) == pytest.approx(9e6)
    assert wave_speed(9e6, nu, 4000.0) == pytest.approx(wave_speed(9e6, nu, 1000.0) / 2)


def test_substeps_follow_from_the_faster_of_waves_and_viscosity():
    assert substep_rate(0.02, 10.0) == pytest.approx(500 / SAFETY)
    assert substep_rate(0.02, 10.0, viscosity=1.0) == pytest.approx(max(500 / SAFETY, 2500 / VISCOUS))
    assert substep_rate(0.02, 0.001, viscosity=1.0) == pytest.approx(2500 / VISCOUS)
    assert substep_rate(0.01, 0.0, viscosity=1.0) == pytest.approx(4 * substep_rate(0.02, 0.0, viscosity=1.0))


@pytest.mark.parametrize(("nodes", "exact", "count"), [(10.0, False, 10), (10.0, True, 5), (0.5, False, 1)])
def test_batches_on_the_cpu_are_limited_by_their_nodes(monkeypatch, nodes, exact, count):
    box = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    of_one = batch.make_grid(box, 0.1).count
    monkeypatch.setattr(batch, "max_batch_nodes", lambda device: int(nodes * of_one))
    assert batch.Batch.fits(box, 0.1, 10**12, "cpu", exact) == count


@pytest.mark.parametrize(("exact", "particles"), [(False, 0), (True, 0), (False, 5000), (True, 5000)])
def test_batches_on_a_gpu_are_limited_by_four_fifths_of_its_free_memory(monkeypatch, exact, particles):
    box = Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    of_one = batch.make_grid(box, 0.1).count
    grids = 2 if exact else 1
    each = of_one * (grids * batch.GRID_BYTES + batch.NODE_BYTES) + particles * batch.PARTICLE_BYTES
    monkeypatch.setattr(batch, "max_batch_nodes", lambda device: 10**9)
    monkeypatch.setattr(batch.torch.cuda, "mem_get_info", lambda device: (int(7.5 * each / 0.8), 10**12))
    assert batch.Batch.fits(box, 0.1, particles, "cuda", exact) == 7


def some_particles(count: int):
    x = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
    return at_rest(x, 1e-3, ParticleMaterial(1e5, 0.3, 1000.0, 2.0, 0.0))


@pytest.mark.parametrize("sizes", [(3, 4), (4, 5), (8, 0), (9, -1)])
def test_scenes_of_a_batch_make_up_its_particles(sizes):
    with pytest.raises(ValueError, match="8 particles cannot be split into scenes of"):
        Solver(some_particles(8), Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), 0.1, sizes=sizes)


def test_grids_that_are_too_large_are_refused():
    with pytest.raises(ValueError, match="a grid of [0-9]+ x [0-9]+ x [0-9]+ nodes is too large"):
        batch.make_grid(Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), 1e-4)


def test_particles_that_are_held_need_no_substeps():
    particles = some_particles(8)
    box, still = Box((-0.5, -0.5, -0.5), (1.5, 1.5, 1.5)), torch.zeros(8, 3)
    free = Solver(particles, box, 0.1).substeps(0.02, still)
    particles.held[:] = 1
    assert Solver(particles, box, 0.1).substeps(0.02, still) == 1 < free


def test_lame_parameters_of_youngs_modulus_and_poissons_ratio():
    """mu = E / 2 (1 + nu); the bulk modulus lambda + 2 mu / 3 is E / 3 (1 - 2 nu)."""
    E, nu, viscosity = torch.tensor([1e5, 2e6, 3e7]), torch.tensor([0.0, 0.3, 0.45]), torch.tensor([0.0, 1.0, 2.0])
    ones = torch.ones(3)
    mu, lam, eta = at_rest(torch.zeros(3, 3), ones, ParticleMaterial(E, nu, ones, viscosity, ones)).stiffness.T
    torch.testing.assert_close(mu, E / (2 * (1 + nu)))
    torch.testing.assert_close(lam + 2 * mu / 3, E / (3 * (1 - 2 * nu)))
    assert torch.equal(eta, viscosity)
