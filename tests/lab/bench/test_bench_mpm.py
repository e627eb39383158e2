"""The MPM benchmark: the baseline has the same physics, and figures are consistent. Speed is not tested."""

import math

import pytest
import torch

from stages.core.errors import InputError
from stages.core.kernels.mpm import grid as mpm_grid
from stages.core.physics.mpm import solver as mpm
from stages.lab.bench import mpm as bench_mpm
from stages.lab.bench import mpm_three_kernel
from stages.lab.bench.speed_options import MpmBenchOptions


def test_three_kernel_form_equals_the_solver():
    one, box, dx = bench_mpm.falling_boxes(400)
    one.v[:] = torch.tensor([0.3, 0.1, -1.0])
    ours = mpm.Solver(one, box, dx)
    push = torch.tensor(bench_mpm.GRAVITY).repeat(len(one), 1)
    ours.advance(0.01, push, 100)
    baseline = mpm.Solver(one, box, dx)
    baseline.set(acceleration=push)
    nodes = torch.zeros(baseline.grid.count, 4)
    for _ in range(100):
        mpm_three_kernel.substep(baseline, nodes, 1e-4)
    assert baseline.grid.low[0] == mpm_grid.GRID_PADDING
    torch.testing.assert_close(baseline.particles.x, ours.particles.x, rtol=0, atol=2e-5)


@pytest.mark.parametrize("particles", [6_144, 20_000, 250_000])
def test_scenes_have_the_requested_particles_eight_per_cell(particles):
    one, box, dx = bench_mpm.falling_boxes(particles)
    assert len(one) == pytest.approx(particles, rel=0.1)
    assert dx**3 / float(one.volume[0]) == pytest.approx(8, rel=1e-5)
    low, high = torch.tensor(box.low), torch.tensor(box.high)
    assert bool((one.x > low).all() and (one.x < high).all())


def test_report_has_ratios_and_the_machine(monkeypatch, device):
    monkeypatch.setattr(bench_mpm.bench, "copy_bandwidth", lambda device: 1e10)
    lines = list(bench_mpm.run(None, MpmBenchOptions(device, (400,), scenes=2, frames=1)))
    assert "torch" in lines[0] and "10 GB/s" in lines[1] and len(lines) == 6
    assert all(sum(f"mpm {schedule}" in line for line in lines) == 1 for schedule in ("exact", "contact"))
    for line in lines[2:]:
        assert "us a substep" in line and "scenes a minute" in line and "the speed of the three-kernel form" in line


def test_the_figures_follow_from_each_other(device):
    r = bench_mpm.measure(400, 2, device, 1)
    count = 2 * r["particles"]
    assert r["ns_per_particle"] == pytest.approx(1e3 * r["substep_us"] / count)
    assert r["scenes_per_minute"] == pytest.approx(2 * 60 / (r["substep_us"] * 1e-6 * 200 * 100))
    assert r["bytes"] > count * 2 * 27 * 16 and math.isfinite(r["bytes_per_second"])


def test_invalid_options_are_rejected():
    for options in ({"frames": 0}, {"particles": (3,)}, {"scenes": -1}):
        with pytest.raises(InputError, match="--frames must be at least 1"):
            MpmBenchOptions(**options)
