"""Benchmark of the MPM solver, compared with an unfused three-kernel form in the same run and with memory bandwidth.

A scene has three elastic bodies with eight particles per cell, which fall onto each other and onto the floor; a frame
has 200 substeps of 1e-4 s. A scene of the published data set has 100 such frames.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from pathlib import Path

import torch

from stages.core.kernels.cuda_graphs import captured
from stages.core.models.initial_conditions import GRAVITY
from stages.core.physics.mpm import solver as mpm
from stages.lab.bench import common as bench
from stages.lab.bench import mpm_three_kernel
from stages.lab.bench.speed_options import MpmBenchOptions

log = logging.getLogger(__name__)
SUBSTEP, SUBSTEPS, FRAMES = 1e-4, 200, 100  # substep [s], substeps per frame, frames per scene, as published
BODIES_PER_SCENE = 3
PARTICLE_BYTES = 145  # read and written per particle and substep, without the grid
STENCIL_NODES = 27  # grid nodes in the stencil of a particle: 16 bytes read and 16 bytes added for each
MATERIALS = ((8e5, 600.0), (1e5, 700.0), (3e5, 300.0))  # E [Pa], density [kg/m^3]: ball, panda, duck


def falling_boxes(particles: int) -> tuple[mpm.Particles, mpm.Box, float]:
    """Three boxes above each other near the floor of the published domain; also the domain, and grid spacing [m]."""
    side = round((particles / BODIES_PER_SCENE) ** (1 / 3))
    layers = max(1, round(particles / BODIES_PER_SCENE / side**2))
    h = 0.45 / side
    body = torch.cartesian_prod(torch.arange(side), torch.arange(side), torch.arange(layers)) + 0.5
    parts = []
    for n, (E, density) in enumerate(MATERIALS):
        x = body * h + torch.tensor([0.05 * n - 0.3, 0.03 * n - 0.3, -0.93 + n * (layers * h + 0.06)])
        parts.append(mpm.at_rest(x, h**3, mpm.ParticleMaterial(E, 0.3, density, 0.0, 0.5)))
    return mpm.join_particles(parts), mpm.Box((-1.94, -1.94, -0.94), (1.94, 1.94, 2.94)), 2 * h


def measure(particles: int, scenes: int, device: str, frames: int, schedule: str = "auto") -> dict:
    """Time per substep of a batch and figures derived from it, with a `schedule` of the solver.

    With `contact`, each body of a single scene has its own velocity field; the bytes exclude the pass over the grid.
    """
    one, box, dx = falling_boxes(particles)
    if schedule == "contact" and scenes > 1:
        raise ValueError("contact is between the bodies of one scene")
    parts = BODIES_PER_SCENE if schedule == "contact" else scenes
    sizes = [len(one) * scenes // parts] * parts
    options = mpm.SolverOptions(schedule=schedule)
    solver = mpm.Solver(mpm.join_particles([one] * scenes), box, dx, device, options, sizes)
    push = torch.tensor(GRAVITY, device=device).repeat(len(solver.rows), 1)
    step = lambda: solver.enqueue_frame(SUBSTEP * SUBSTEPS, push, SUBSTEPS)  # noqa: E731
    for _ in range(3):
        step()
    each = bench.median_seconds(lambda: [step() for _ in range(frames)], device, repeat=1) / frames / SUBSTEPS
    count, nodes = len(solver.rows), solver.active_nodes
    node = 32 if schedule == "exact" else 16
    moved = count * (PARTICLE_BYTES + 2 * node * STENCIL_NODES) + node * nodes
    if bool((solver.lost >= 0).any()):
        log.warning("%d scenes lost particles", int((solver.lost >= 0).sum()))
    return {
        "particles": len(one), "scenes": scenes, "nodes": tuple(solver.grid.nodes), "substep_us": 1e6 * each,
        "ns_per_particle": 1e9 * each / count, "scenes_per_minute": 60 * scenes / (each * SUBSTEPS * FRAMES),
        "bytes": moved, "bytes_per_second": moved / each,
    }  # fmt: skip


def measure_three_kernel(particles: int, device: str) -> float:
    """Time per substep of one scene in the three-kernel form [s]."""
    one, box, dx = falling_boxes(particles)
    solver = mpm.Solver(one, box, dx, device, mpm.SolverOptions(schedule="fused"))
    push = torch.tensor(GRAVITY, device=device).repeat(len(one), 1)
    solver.enqueue_frame(SUBSTEP * SUBSTEPS, push, SUBSTEPS)
    nodes = torch.zeros(solver.grid.count, 4, device=device)
    steps = 20 if device != "cpu" else 2
    many = lambda: [mpm_three_kernel.substep(solver, nodes, SUBSTEP) for _ in range(steps)]  # noqa: E731
    many()
    if device != "cpu":
        return bench.median_seconds(captured(many).replay, device) / steps
    return bench.median_seconds(many, device, repeat=1) / steps


def batch_size(particles: int, device: str) -> int:
    """Number of scenes that fill a GPU within its memory and the index range of exact sums; 1 on a CPU."""
    if device == "cpu":
        return 1
    _, box, dx = falling_boxes(particles)
    count = mpm.make_grid(box, dx).count
    free = torch.cuda.mem_get_info(device)[0]
    room = min(2**30 // count, int(0.8 * free / (count * 100.5 + particles * 700)))
    return max(1, min(room, math.ceil(3_000_000 / particles)))


def run(out: Path | None, options: MpmBenchOptions) -> Iterator[str]:
    """Yield the lines of the report; all results go to `out` as JSON."""
    from stages.core.backends import pick_device

    device = pick_device(options.device)
    yield bench.machine(device)
    copy = bench.copy_bandwidth(device)
    yield f"copy bandwidth {copy / 1e9:,.0f} GB/s"
    rows = []
    for particles in options.particles:
        plain = measure_three_kernel(particles, device)
        many = options.scenes or batch_size(particles, device)
        cases = [(1, "auto"), (1, "contact"), (many, "auto"), (many, "exact")]
        for scenes, schedule in dict.fromkeys(cases):
            r = measure(particles, scenes, device, options.frames, schedule)
            speedup = plain * scenes / r["substep_us"] * 1e6  # relative to the three-kernel form
            rows.append({"schedule": schedule, **r, "speedup": speedup})
            kind, shape = "mpm" if schedule == "auto" else f"mpm {schedule}", " x ".join(map(str, r["nodes"]))
            yield (
                f"{kind} {r['particles']:>7,} particles x {scenes:>4} scenes, {shape} nodes: "
                f"{r['substep_us']:9.1f} us a substep, {r['ns_per_particle']:.3f} ns a particle, "
                f"{r['scenes_per_minute']:8.1f} scenes a minute; {r['bytes'] / 1e6:,.0f} MB moved, "
                f"{r['bytes_per_second'] / copy:.2f} x the copy bandwidth; "
                f"{speedup:.1f}x the speed of the three-kernel form"
            )
    bench.write_results(out, "mpm", device, {"copy_bytes_per_second": copy, "rows": rows})
