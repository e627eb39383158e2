"""Validation of the MPM solver against theory, and the figure of stages/lab/results/mpm.md.

    python -m stages.lab.bench.validate_mpm stages/lab/results/mpm.png

Every function simulates a small scene with a known outcome and returns the measured and the expected value. Tests check
one setting of each.
"""

from __future__ import annotations

import math
import sys
from dataclasses import fields
from pathlib import Path

import torch

from stages.core.kernels.mpm.constitutive import SAND, sand_slope
from stages.core.physics.mpm import solver as mpm

OPEN_BOX = mpm.Box((-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))
E, DENSITY = 1e5, 500.0  # [Pa] [kg/m^3]


def particle_block(size: tuple, h: float, E: float = E, nu: float = 0.0, viscosity: float = 0.0, jitter: float = 0.0,
            **material) -> mpm.Particles:  # fmt: skip
    """A box of particles at the centres of voxels with edge h [m], its lower corner at the origin."""
    counts = [max(1, round(s / h)) for s in size]
    x = (torch.cartesian_prod(*[torch.arange(n) + 0.5 for n in counts]) * h).reshape(-1, 3)
    x = x + jitter * h * (torch.rand(x.shape, generator=torch.Generator().manual_seed(0)) - 0.5)
    return mpm.at_rest(x, h**3, mpm.ParticleMaterial(E, nu, DENSITY, viscosity, 0.6), **material)


def subset(p: mpm.Particles, mask: torch.Tensor) -> mpm.Particles:
    """The particles selected by a mask."""
    return mpm.Particles(*(getattr(p, f.name)[mask] for f in fields(p)))


def advance(solver: mpm.Solver, duration: float, push: tuple = (0.0, 0.0, 0.0), substeps: int | None = None) -> None:
    """Advance a solver by `duration` [s] with the same acceleration [m/s^2] for all particles."""
    solver.advance(duration, torch.tensor(push).repeat(len(solver.rows), 1), substeps)


def pressure_pulse(cells: int = 8, travel: float = 0.8) -> list[tuple[float, float, float]]:
    """(time [s], position, theoretical position [m]) of a pressure pulse in a bar with Poisson ratio 0.

    `cells` is the number of cells in the half width of the pulse. A pulse v = a g(x) with strain -a g(x) / c travels to
    the right only, at c = sqrt(E / density).
    """
    width, c = 0.1, math.sqrt(E / DENSITY)
    dx = width / cells
    p = particle_block((1.6, 2 * dx, 2 * dx), dx / 2)
    g = torch.exp(-(((p.x[:, 0] - 0.4) / width) ** 2) / 2)
    a = 1e-3 * c
    p.v[:, 0] = a * g
    p.F[:, 0, 0] = 1 - a / c * g
    start, rows = p.x[:, 0].clone(), []
    solver, frame = mpm.Solver(p, OPEN_BOX, dx), travel / c / 8
    for n in range(9):
        v = (
            solver.particles.v[:, 0].double().clamp_min(0) ** 2
        )  # squared, so that the peak outweighs ripples far from it
        rows.append((n * frame, float((v * start).sum() / v.sum()), 0.4 + c * n * frame))
        if n < 8:
            advance(solver, frame)
    return rows


def bar_frequency(cells: int) -> tuple[float, float]:
    """Lowest frequency of a free bar with this many cells along it, and sqrt(E / density) / (2 L) [Hz]."""
    length = 0.8
    dx = length / cells
    p = particle_block((length, 4 * dx, 4 * dx), dx / 2)
    shape = torch.cos(math.pi * p.x[:, 0] / length)
    p.v[:, 0] = 0.05 * shape
    solver, signal = mpm.Solver(p, OPEN_BOX, dx), []
    exact = math.sqrt(E / DENSITY) / (2 * length)
    frame = 1 / exact / 80
    for _ in range(140):
        advance(solver, frame)
        signal.append(float((solver.particles.v[:, 0] * shape).sum()))
    s = torch.tensor(signal)
    turns = (s[1:] * s[:-1] < 0).nonzero()[:, 0]
    at = frame * (turns + s[turns] / (s[turns] - s[turns + 1]))
    return (len(at) - 1) / 2 / float(at[-1] - at[0]), exact


def cantilever_deflection(load: float, cells: int = 4) -> tuple[float, float]:
    """Tip deflection of a cantilever under gravity `load` [m/s^2], and Timoshenko's [m]; `cells` are in its height.

    w = density g L^2 (L^2 / (2 h^2) 3 / E + 1 / (2 k G)), k = 5/6, G = E / 2: bending and shear.
    """
    length, height = 0.4, 0.1
    dx = height / cells
    p = particle_block((length + 3 * dx, height, height), dx / 2)
    p.held[p.x[:, 0] < 3 * dx] = 1
    tip = p.x[:, 0] > length + 3 * dx - dx
    solver, before, peak_energy = mpm.Solver(p, OPEN_BOX, dx), p.x[tip, 2].mean(), 0.0
    for _ in range(120):  # kinetic damping: stop the motion at each maximum of the kinetic energy, near equilibrium
        advance(solver, 0.02, (0.0, 0.0, -load))
        energy = float(solver.particles.v.square().sum())
        if energy < peak_energy:
            solver.set(v=torch.zeros_like(p.v), C=torch.zeros_like(p.C))
            energy = 0.0
        peak_energy = energy
    x = (float(p.x[tip, 0].mean()) - 3 * dx) / length  # the tip's particles lie half a cell before the end
    bending = DENSITY * load * 12 / (E * height**2) * length**4 / 24 * x**2 * (x**2 - 4 * x + 6)
    shear = DENSITY * load * length**2 / (2 * 5 / 6 * E / 2) * (2 * x - x**2)
    return float(before - solver.particles.x[tip, 2].mean()), bending + shear


def sand_column_spread(
    aspect: float, cells: int = 6, substeps: int | None = None, E: float = 3.5e5
) -> tuple[float, float]:
    """Spread (r - r0) / r0 of a collapsing sand column of height aspect x r0, and Lube et al. 2004: 1.24 aspect.

    `cells` is the number of cells in its radius, `substeps` that of substeps in 0.02 s (default: from the CFL
    condition). The angle of repose is 31 degrees, on an equally rough floor. Every transfer smooths a flow that is only
    a few cells thick, so sand spreads less with larger cells and more substeps.
    """
    r0 = 0.1
    dx = r0 / cells
    p = particle_block((2 * r0, 2 * r0, aspect * r0), dx / 2, E=E, nu=0.3, jitter=0.5, model=SAND,
                plastic=(sand_slope(31.0), 0.0, 0.0))  # fmt: skip
    p = subset(p, (p.x[:, :2] - r0).norm(dim=1) < r0)
    p.x[:, 2] += dx / 4
    p.mass *= 1600 / DENSITY
    solver = mpm.Solver(p, mpm.Box((-0.4, -0.4, 0.0), (0.6, 0.6, 0.6)), dx)
    for _ in range(25):
        advance(solver, 0.02, (0.0, 0.0, -9.81), substeps)
    r = (solver.particles.x[:, :2] - r0).norm(dim=1)
    return (float(r.quantile(0.999)) - r0) / r0, 1.24 * aspect


def bar_displacement(substeps: int, cells: int = 16) -> tuple[torch.Tensor, torch.Tensor]:
    """Particle positions of a vibrating bar after half a period in `substeps` substeps, and at the start [m]."""
    length = 0.8
    dx = length / cells
    p = particle_block((length, 4 * dx, 4 * dx), dx / 2)
    p.v[:, 0] = 0.2 * torch.cos(math.pi * p.x[:, 0] / length)
    solver = mpm.Solver(p, OPEN_BOX, dx)
    advance(solver, 0.03, substeps=substeps)
    return solver.particles.x, p.x


def time_step_error() -> list[tuple[float, float]]:
    """(substep [s], RMS distance to the run with the smallest substep / RMS motion).

    The error of symplectic Euler grows with the substep, that of the transfers with their number, so the sum does not
    tend to zero.
    """
    exact, start = bar_displacement(1280)
    motion = (exact - start).square().sum(1).mean().sqrt()
    return [
        (0.03 / n, float((bar_displacement(n)[0] - exact).square().sum(1).mean().sqrt() / motion))
        for n in (20, 40, 80, 160, 320)
    ]


def momentum_drift(frames: int = 40, substeps: int = 250) -> list[tuple[int, float, float]]:
    """(substeps, relative change of momentum, of angular momentum) of a body that translates, rotates and vibrates."""
    dx = 0.05
    p = particle_block((0.2, 0.15, 0.1), dx / 2, nu=0.3)
    r = p.x - p.x.mean(0)
    p.v = torch.tensor([0.2, -0.1, 0.1]) + torch.linalg.cross(torch.tensor([1.0, 2.0, -1.0]).expand_as(r), r) + r
    solver, rows = mpm.Solver(p, OPEN_BOX, dx), []
    advance(solver, 0.01, substeps=substeps)  # initialises the affine velocity matrices C
    first = total_momenta(solver.particles, dx)
    for n in range(frames):
        advance(solver, 0.01, substeps=substeps)
        now = total_momenta(solver.particles, dx)
        rows.append(((n + 1) * substeps, *(float((a - b).norm() / b.norm()) for a, b in zip(now, first, strict=True))))
    return rows


def total_momenta(p: mpm.Particles, dx: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Linear and angular momentum; APIC particles have spin with inertia m dx^2 / 4 (Jiang et al. 2015, eq. 8)."""
    x, v, C, m = (t.double() for t in (p.x, p.v, p.C, p.mass))
    spin = dx**2 / 4 * torch.stack([C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], 1)
    return (m[:, None] * v).sum(0), (m[:, None] * (torch.linalg.cross(x, v) + spin)).sum(0)


def figure(out: Path) -> None:
    """Plot measured and expected values."""
    from stages.lab.plot import Panel, draw_panels

    travel = pressure_pulse()
    coarse_to_fine = (8, 16, 32)
    bars = [(0.8 / n, abs(f / exact - 1)) for n in coarse_to_fine for f, exact in [bar_frequency(n)]]
    loads = (0.1, 0.3, 0.5, 0.8)
    sags = [(g, *cantilever_deflection(g)) for g in loads]
    heights = (0.4, 0.8, 1.2, 1.6)
    heaps = [(a, *sand_column_spread(a)) for a in heights]
    in_time = time_step_error()
    kept = momentum_drift()
    draw_panels(out, [
        Panel("pressure pulse: place [m] after time [ms]", [(1e3 * t, x) for t, x, _ in travel],
              [(1e3 * t, x) for t, _, x in travel]),
        Panel("bar: error of frequency over dx [m]", bars, [(d, bars[0][1] * (d / bars[0][0]) ** 2) for d, _ in bars],
              log=True, theory="second order"),
        Panel("cantilever: sag [mm] over gravity [m/s2]", [(g, 1e3 * w) for g, w, _ in sags],
              [(g, 1e3 * w) for g, _, w in sags], theory="Timoshenko"),
        Panel("sand column: spread over height, in radii", [(a, s) for a, s, _ in heaps],
              [(a, s) for a, _, s in heaps], theory="Lube et al. 2004"),
        Panel("change by the substep [s], fraction of the motion", in_time, log=True),
        Panel("relative drift of momentum (o), spin (line) over substeps", [(n, a) for n, a, _ in kept],
              [(n, b) for n, _, b in kept], theory="spin"),
    ])  # fmt: skip


if __name__ == "__main__":
    figure(Path(sys.argv[1]))
