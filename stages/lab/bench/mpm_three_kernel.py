"""Baseline of the MPM benchmark: the unfused form of most GPU solvers.

Each substep clears the whole grid and runs three kernels: particles to grid with scalar atomics, update of every grid
node, grid to particles. Particles are sorted by cell at the start. The substep is captured in a CUDA graph, like our
solver.
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.interop import launch, view
from stages.core.kernels.mpm.constitutive import neo_hookean
from stages.core.kernels.mpm.grid import MpmGrid, apply_walls, bspline_weights, first_node
from stages.core.kernels.mpm.nodes import mat43
from stages.core.kernels.mpm.transfers import FREE, ParticleArrays, ParticleUpdate, advance_free, affine_momentum
from stages.core.physics.mpm.solver import Solver


@wp.kernel(enable_backward=False)
def _to_grid(grid: MpmGrid, rows: ParticleArrays, dt: float, nodes: wp.array2d[float]):
    i = wp.tid()
    now = ParticleUpdate()
    now.x = rows.x[i]
    now.v = rows.v[i]
    now.C = rows.C[i]
    now.tau = neo_hookean(rows.F[i], rows.stiffness[i])
    load = affine_momentum(grid, rows, i, now, FREE, dt)
    g = (now.x - grid.origin) / grid.dx
    base = first_node(g)
    fx = wp.vec3(g[0] - float(base[0]), g[1] - float(base[1]), g[2] - float(base[2]))
    w = bspline_weights(fx)
    corner = rows.scene[i] * grid.count + (base[0] * grid.nodes[1] + base[1]) * grid.nodes[2] + base[2]
    for a in range(3):
        for b in range(3):
            for c in range(3):
                d = wp.vec4(1.0, float(a) - fx[0], float(b) - fx[1], float(c) - fx[2])
                value = (w[0, a] * w[1, b] * w[2, c]) * (wp.transpose(load) * d)
                node = corner + (a * grid.nodes[1] + b) * grid.nodes[2] + c
                for n in range(4):
                    wp.atomic_add(nodes, node, n, value[n])


@wp.kernel(enable_backward=False)
def _on_grid(grid: MpmGrid, nodes: wp.array[wp.vec4]):
    t = wp.tid()
    u = nodes[t]
    if u[3] > 0.0:
        n = t % grid.count
        at = wp.vec3i(n // (grid.nodes[1] * grid.nodes[2]), (n // grid.nodes[2]) % grid.nodes[1], n % grid.nodes[2])
        v = apply_walls(grid, at, wp.vec3(u[0], u[1], u[2]) / u[3], 0.5)
        nodes[t] = wp.vec4(v[0], v[1], v[2], u[3])


@wp.kernel(enable_backward=False)
def _to_particles(grid: MpmGrid, rows: ParticleArrays, dt: float, nodes: wp.array[wp.vec4]):
    i = wp.tid()
    g = (rows.x[i] - grid.origin) / grid.dx
    base = first_node(g)
    fx = wp.vec3(g[0] - float(base[0]), g[1] - float(base[1]), g[2] - float(base[2]))
    w = bspline_weights(fx)
    corner = rows.scene[i] * grid.count + (base[0] * grid.nodes[1] + base[1]) * grid.nodes[2] + base[2]
    s = mat43()
    for a in range(3):
        for b in range(3):
            for c in range(3):
                u = nodes[corner + (a * grid.nodes[1] + b) * grid.nodes[2] + c]
                d = wp.vec4(1.0, float(a) - fx[0], float(b) - fx[1], float(c) - fx[2])
                v = (w[0, a] * w[1, b] * w[2, c]) * wp.vec3(u[0], u[1], u[2])
                for r in range(4):
                    for n in range(3):
                        s[r, n] += d[r] * v[n]
    now = advance_free(grid, rows.x[i], rows.F[i], s, dt)
    rows.x[i] = now.x
    rows.v[i] = now.v
    rows.C[i] = now.C
    rows.F[i] = now.F


def substep(solver: Solver, nodes, dt: float) -> None:
    """Advance the elastic particles of a solver by one substep; `nodes` is a tensor of four floats per grid node."""
    rows, grid, device = solver.rows, solver.grid, solver.device
    nodes.zero_()
    launch(_to_grid, len(rows), [grid, rows.struct, dt, view(nodes)], device=device)
    launch(_on_grid, len(nodes), [grid, view(nodes, wp.vec4)], device=device)
    launch(_to_particles, len(rows), [grid, rows.struct, dt, view(nodes, wp.vec4)], device=device)
