"""The MPM solver compared with theory, at one setting of each diagram in stages/lab/results/mpm.md."""

import math

import cv2
import pytest
import torch

from stages.core.errors import InputError
from stages.core.kernels.mpm.constitutive import VON_MISES
from stages.core.physics.mpm import solver as mpm
from stages.lab import plot
from stages.lab.bench import validate_mpm as validate
from stages.lab.bench.validate_mpm import OPEN_BOX, advance, particle_block, subset


@pytest.mark.slow
def test_a_pressure_pulse_travels_at_the_speed_of_sound():
    # with quadratic splines and 8 cells in its half width, dispersion is less than 1 %
    start, *_, end = validate.pressure_pulse()
    assert end[1] - start[1] == pytest.approx(end[2] - start[2], rel=0.01)


def test_the_frequency_of_a_bar_converges_with_the_square_of_the_spacing():
    errors = [abs(f / exact - 1) for f, exact in map(validate.bar_frequency, (8, 16))]
    assert errors[0] < 0.02
    assert math.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.3)


@pytest.mark.slow
def test_cantilever_sag_matches_timoshenko():
    # four cells in its height; the clamp is soft by a part of a cell, and 1 % of the length changes the sag by 4 %
    measured, exact = validate.cantilever_deflection(0.3)
    assert measured == pytest.approx(exact, rel=0.05)


@pytest.mark.slow
def test_sand_column_spread_matches_experiments():
    # measured by Lube et al. for many grains; here the radius has 6 cells, and the front is thinner than a cell
    measured, published = validate.sand_column_spread(0.6)
    assert measured == pytest.approx(published, rel=0.15)


@pytest.mark.slow
def test_sand_spread_grows_with_resolution_and_shrinks_with_substeps():
    # transfers smooth thin flows, so tall columns spread less than published, especially on coarse grids
    (coarse, published), (fine, _) = (
        validate.sand_column_spread(1.5, cells=3),
        validate.sand_column_spread(1.5, cells=4),
    )
    busy, _ = validate.sand_column_spread(1.5, cells=3, substeps=100)
    assert busy < 0.85 * coarse and 1.02 * coarse < fine < published


def test_motion_is_insensitive_to_the_substep():
    a, start = validate.bar_displacement(20)
    b, _ = validate.bar_displacement(80)
    motion = float((b - start).square().sum(1).mean().sqrt())
    assert float((a - b).square().sum(1).mean().sqrt()) < 0.01 * motion


@pytest.mark.slow
def test_momentum_drift_over_ten_thousand_steps():
    steps, linear, angular = validate.momentum_drift()[-1]
    # rounding errors of 6e-8 per step add up to 6e-4 if all have the same sign, and 6e-6 if random
    assert steps == 10_000 and linear < 5e-5 and angular < 1e-4


def test_stress_in_metal_is_limited_by_its_yield_strength():
    """The largest von Mises stress in a block that is compressed by 10 %."""
    dx, strength = 0.05, 1e3
    plastic = (strength, 0.0, 0.0)
    p = particle_block((0.2, 0.2, 0.2), dx / 2, nu=0.3, viscosity=50.0, model=VON_MISES, plastic=plastic)
    p.held[p.x[:, 2] < dx] = 1
    p.held[p.x[:, 2] > 0.2 - dx] = 1
    p.v[p.x[:, 2] > 0.2 - dx, 2] = -0.1
    solver = mpm.Solver(p, OPEN_BOX, dx)
    for _ in range(10):
        advance(solver, 0.02)
    now = subset(solver.particles, p.held == 0)
    S = torch.linalg.svdvals(now.F).log()
    stress = 2 * now.stiffness[:, :1] * (S - S.mean(1, keepdim=True))
    assert float(math.sqrt(1.5) * stress.norm(dim=1).max()) == pytest.approx(strength, rel=1e-3)


def test_diagram_has_marks_and_a_line(tmp_path):
    panels = [plot.Panel("a", [(0.0, 0.0), (1.0, 2.0)], [(0.0, 0.1), (1.0, 1.9)]),
              plot.Panel("b", [(1e-3, 1.0), (1e-1, 100.0)], log=True)]  # fmt: skip
    plot.draw_panels(tmp_path / "a.png", panels, columns=2)
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image.shape == (plot.PANEL_HEIGHT, 2 * plot.PANEL_WIDTH, 3)
    blue, red = (image == plot.BLUE).all(2), image[..., 2].astype(int) - image[..., 0] > 60
    assert (
        blue[:, : plot.PANEL_WIDTH].sum() > 40
        and red[:, : plot.PANEL_WIDTH].any()
        and not red[:, plot.PANEL_WIDTH :].any()
    )
    with pytest.raises(InputError, match="no folder"):
        plot.draw_panels(tmp_path / "no" / "a.png", panels)
