"""A cube that falls flat on the floor keeps part of its energy as vibrations, as in linear elastodynamics."""

import math

import numpy as np
import pytest
import scipy.sparse as sp
import torch

from stages.core.physics.mpm.solver import Box, ParticleMaterial, Solver, SolverOptions, at_rest

E, NU, DENSITY, SIDE = 1e6, 0.3, 540.0, 0.3
# simulated time [s]; the contact lasts 2.3 times as long as a wave takes through the cube
LONG = 6 * SIDE / math.sqrt(E / DENSITY)


def viscosity(loss: float) -> float:
    """Viscosity of a Kelvin-Voigt solid whose slowest longitudinal vibration has this loss factor [Pa s]."""
    return loss * E * SIDE / (math.pi * math.sqrt(E / DENSITY))


def element_stiffness(h: float, mu: float, lam: float) -> np.ndarray:
    """Stiffness (24, 24) of a trilinear cube of edge h with these Lame constants, by 2 x 2 x 2 Gauss points."""
    elasticity = np.diag([2 * mu] * 3 + [mu] * 3)
    elasticity[:3, :3] += lam
    signs = np.argwhere(np.ones((2, 2, 2))) * 2 - 1
    out = np.zeros((24, 24))
    for gauss in signs / math.sqrt(3):
        linear = 1 + signs * gauss
        slopes = signs * np.roll(linear, 1, 1) * np.roll(linear, 2, 1) / (4 * h)
        strain = np.zeros((6, 8, 3))
        for axis in range(3):
            strain[axis, :, axis] = slopes[:, axis]
        for row, (a, b) in enumerate(((0, 1), (1, 2), (2, 0)), 3):
            strain[row, :, a], strain[row, :, b] = slopes[:, b], slopes[:, a]
        strain = strain.reshape(6, 24)
        out += strain.T @ elasticity @ strain * (h / 2) ** 3
    return out


def finite_elements(n: int, loss: float) -> float:
    """Restitution of a cube of n^3 elements with lumped masses, on a floor without friction."""
    mu, lam = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
    h, nodes = SIDE / n, n + 1
    corners = np.argwhere(np.ones((n, n, n)))[:, None] + np.argwhere(np.ones((2, 2, 2)))
    node = (corners[..., 0] * nodes + corners[..., 1]) * nodes + corners[..., 2]
    of = (3 * node[..., None] + np.arange(3)).reshape(len(node), 24)
    stiffness, damping = (
        sp.csr_matrix((np.tile(one.ravel(), len(node)), (np.repeat(of, 24, 1).ravel(), np.tile(of, (1, 24)).ravel())))
        for one in (element_stiffness(h, mu, lam), element_stiffness(h, viscosity(loss), 0.0))
    )
    mass = np.bincount(node.ravel(), minlength=nodes**3) * DENSITY * h**3 / 8
    floor = np.arange(nodes**2) * nodes
    u, v = np.zeros((nodes**3, 3)), np.tile([0.0, 0.0, -1.0], (nodes**3, 1))
    dt = min(0.2 * h / math.sqrt(E / DENSITY), 0.1 * DENSITY * h**2 / max(viscosity(loss), 1e-30))
    for _ in range(round(LONG / dt)):
        v -= dt * (stiffness @ u.ravel() + damping @ v.ravel()).reshape(-1, 3) / mass[:, None]
        v[floor, 2] = np.maximum(v[floor, 2], -u[floor, 2] / dt)
        u += dt * v
    return float(mass @ v[:, 2] / mass.sum())


def particles(n: int, loss: float) -> tuple[float, float]:
    """Restitution of a cube of n^3 particles, and the share of the energy that remains."""
    h = SIDE / n
    along = (torch.arange(n) + 0.5) * h
    x = torch.cartesian_prod(along - SIDE / 2, along - SIDE / 2, along + 0.05 * h)
    p = at_rest(x, h**3, ParticleMaterial(E, NU, DENSITY, viscosity(loss), 0.0))
    p.v[:, 2] = -1.0
    box = Box((-0.5, -0.5, 0.0), (0.5, 0.5, 0.6))
    solver = Solver(p, box, 2 * h, options=SolverOptions(schedule="contact"))
    for _ in range(40):
        solver.advance(LONG / 40, torch.zeros(len(x), 3))
    now = solver.particles
    J, (mu, lam, _) = torch.linalg.det(now.F.double()), now.stiffness[0].tolist()
    elastic = mu / 2 * (now.F.double().square().sum((1, 2)) - 3) - mu * J.log() + lam / 2 * J.log() ** 2
    kinetic = DENSITY / 2 * (now.v.square().sum(1) + h**2 * now.C.square().sum((1, 2)))
    return float(now.v[:, 2].mean()), float((elastic + kinetic).mean()) / (DENSITY / 2)


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.0, 0.05])
def test_the_rebound_of_a_cube_converges_to_that_of_finite_elements(loss):
    reference = finite_elements(12, loss)
    assert finite_elements(6, loss) == pytest.approx(reference, abs=0.02)
    (coarse, kept), (fine, more) = particles(24, loss), particles(48, loss)
    assert reference < fine < coarse and fine - reference < 0.75 * (coarse - reference)
    assert loss > 0 or (kept < more < 1 and 1 - more < 0.6 * (1 - kept))
