"""A whole substep of all particles in one launch: the fastest launch order on a GPU.

A thread gathers from one grid, dividing momentum by mass and applying walls as it reads, moves its particle, and
scatters into a second grid; additional threads clear a third. The grids rotate their roles every substep, so no
synchronisation is needed within a substep. A particle that enters a new cell adds the blocks of its stencil to the list
of active blocks, which is exact and never read by the host. Transfers, materials and walls are those of `transfers`.

Source: Wang et al. 2020, "A massively parallel and scalable multi-GPU material point method" (fused transfers).
"""

from __future__ import annotations

from functools import cache

import warp as wp

from stages.core.kernels.mpm.active import ActiveBlocks, activate_blocks, node_of_block
from stages.core.kernels.mpm.constitutive import material_update, neo_hookean
from stages.core.kernels.mpm.exact import gather_exact, scatter_exact, scatter_float, velocity_exact
from stages.core.kernels.mpm.grid import (
    BLOCK,
    MpmGrid,
    Stencil,
    apply_obstacles,
    apply_restitution,
    apply_walls,
    bspline_weights,
    empty_stencil,
    near_obstacles,
    near_walls,
    stencil_at,
)
from stages.core.kernels.mpm.nodes import gather_momentum, mat43
from stages.core.kernels.mpm.transfers import (
    FREE,
    LOST,
    Features,
    ParticleArrays,
    ParticleUpdate,
    Substep,
    advance_free,
    advance_kinematic,
    affine_momentum,
    mark_lost,
    relax,
)

THREADS_PER_BLOCK = 128


@wp.struct
class RotatingNodes:
    """Momentum and mass of the nodes of all scenes in the three grids of a substep; units as in NodeArrays."""

    read: wp.array[wp.vec4]
    write: wp.array[wp.vec4]
    stale: wp.array[wp.vec4]  # cleared during this substep
    scale: wp.vec2  # fixed-point units, see exact.py; 0 in floating point
    friction: wp.array[float]  # Coulomb coefficient at floor and walls


@wp.func
def _add(s: mat43, fx: wp.vec3, n: int, velocity: wp.vec3) -> mat43:
    """Add node n (0..26) to the G2P sums `s`; computes its weight, for loops that are not unrolled."""
    at = wp.vec3(float(n // 9), float((n // 3) % 3), float(n % 3))
    d = at - fx
    w = float(1.0)
    for axis in range(3):
        away = wp.abs(d[axis])
        w *= wp.where(away < 0.5, 0.75 - away * away, 0.5 * (1.5 - away) * (1.5 - away))
    v = w * velocity
    return s + mat43(v[0], v[1], v[2], v[0] * d[0], v[1] * d[0], v[2] * d[0], v[0] * d[1], v[1] * d[1], v[2] * d[1],
                     v[0] * d[2], v[1] * d[2], v[2] * d[2])  # fmt: skip


@wp.func
def _node_velocity(grid: MpmGrid, nodes: RotatingNodes, node: int, at: wp.vec3i) -> wp.vec3:
    """Velocity of a node after the wall conditions; the grid is in fixed point if `scale` is not 0 (see `exact`)."""
    v = wp.vec3()
    if nodes.scale[0] > 0.0:
        v = velocity_exact(nodes.read, node, nodes.scale)
    else:
        u = nodes.read[node]
        v = wp.vec3(u[0], u[1], u[2]) / wp.max(u[3], 1e-30)
    return apply_walls(grid, at, v, nodes.friction[node])


@wp.func
def _gather_walls(grid: MpmGrid, nodes: RotatingNodes, stencil: Stencil) -> mat43:
    """`gather_momentum` for stencils with nodes subject to walls."""
    s = mat43()
    for n in range(27):
        at = stencil.base + wp.vec3i(n // 9, (n // 3) % 3, n % 3)
        node = stencil.first + ((n // 9) * grid.nodes[1] + (n // 3) % 3) * grid.nodes[2] + n % 3
        s = _add(s, stencil.fx, n, _node_velocity(grid, nodes, node, at))
    return s


@wp.func
def _gather_obstacles(grid: MpmGrid, nodes: RotatingNodes, stencil: Stencil, time: float) -> mat43:
    """`gather_momentum` for stencils with nodes subject to walls or obstacles."""
    s = mat43()
    for n in range(27):
        at = stencil.base + wp.vec3i(n // 9, (n // 3) % 3, n % 3)
        node = stencil.first + ((n // 9) * grid.nodes[1] + (n // 3) % 3) * grid.nodes[2] + n % 3
        v = _node_velocity(grid, nodes, node, at)
        place = grid.origin + grid.dx * wp.vec3(float(at[0]), float(at[1]), float(at[2]))
        s = _add(s, stencil.fx, n, apply_obstacles(place, v, grid.obstacles, time, grid.dx))
    return s


@wp.func
def _gather_free(grid: MpmGrid, nodes: RotatingNodes, stencil: Stencil) -> mat43:
    """`gather_momentum` for stencils with nodes at no wall, or at the floor only."""
    under = grid.low[2] + 1 - stencil.base[2]
    return gather_momentum(grid, nodes.read, nodes.friction, stencil, bspline_weights(stencil.fx), under)


@wp.func
def _gather_free_exact(grid: MpmGrid, nodes: RotatingNodes, stencil: Stencil) -> mat43:
    """`_gather_free` from a fixed-point grid, for stencils without nodes at floor or walls."""
    return gather_exact(grid, nodes.read, stencil, bspline_weights(stencil.fx), nodes.scale)


@wp.func
def _at_sides(grid: MpmGrid, base: wp.vec3i) -> bool:
    """Whether a stencil has nodes subject to a wall other than the floor."""
    return base[0] <= grid.low[0] or base[1] <= grid.low[1] or base[0] + 2 >= grid.high[0] or \
        base[1] + 2 >= grid.high[1] or base[2] + 2 >= grid.high[2]  # fmt: skip


@cache
def fused_step(features: Features, has_obstacles: bool, exact: bool) -> wp.Kernel:
    """Build the kernel with only the features needed, since each one costs registers.

    `exact` selects fixed-point grids (see `exact`).
    """
    plastic, viscoelastic, restitution = features
    # 80 registers per thread instead of 94, so that a quarter more threads run at once; fixed point needs more
    bounds = {} if exact else {"launch_bounds": (THREADS_PER_BLOCK, 6)}
    collect, add = (_gather_free_exact, scatter_exact) if exact else (_gather_free, scatter_float)
    walled = near_walls if exact else _at_sides

    @wp.kernel(module="unique", enable_backward=False, **bounds)
    def fused_step(
        grid: MpmGrid, rows: ParticleArrays, nodes: RotatingNodes, active: ActiveBlocks, step: Substep, number: int
    ):  # fmt: skip
        """Substep `number` of the frame, counted from 0.

        The first `sweepers` threads (a multiple of 32) each move a particle; if the substep gathers and scatters, as
        many additional threads clear the grid `stale`.
        """
        i = wp.tid()
        if i >= active.sweepers:
            if step.scatter > 0 and step.gather > 0:
                total = active.total[0] * BLOCK * BLOCK * BLOCK
                t = i - active.sweepers
                while t < total:
                    node = node_of_block(grid, active.blocks[t // 64], t % 64)
                    if wp.static(exact):
                        nodes.stale[2 * node] = wp.vec4()
                        nodes.stale[2 * node + 1] = wp.vec4()
                    else:
                        nodes.stale[node] = wp.vec4()
                    t += active.sweepers
            return
        dt = step.dt
        target = empty_stencil()
        load = wp.mat44()
        held = int(LOST)
        if i < rows.count:
            held = int(rows.held[i])
        if held != LOST:
            now = ParticleUpdate()
            x = rows.x[i]
            F = rows.F[i]
            stiffness = rows.stiffness[i]
            window = rows.scene[i] * grid.count
            if step.gather > 0 and held == FREE:
                source = stencil_at(grid, x, window)
                s = mat43()
                if wp.static(has_obstacles):
                    time = dt * float(number)
                    if walled(grid, source.base) or near_obstacles(x, grid.obstacles, time, 2.0 * grid.dx):
                        s = _gather_obstacles(grid, nodes, source, time)
                    else:
                        s = collect(grid, nodes, source)
                else:
                    if walled(grid, source.base):
                        s = _gather_walls(grid, nodes, source)
                    else:
                        s = collect(grid, nodes, source)
                now = advance_free(grid, x, F, s, dt)
            else:
                now = advance_kinematic(grid, x, rows.v[i], rows.C[i], F, wp.where(step.gather > 0, dt, 0.0))
            if not now.alive:
                mark_lost(rows.held, rows.lost, i, rows.scene[i], rows.order[i])
            if wp.static(plastic):
                new = material_update(int(rows.model[i]), now.F, stiffness, rows.plastic[i], rows.state[i],
                                      wp.where(step.gather > 0, dt, 0.0))  # fmt: skip
                now.F = new.F
                now.tau = new.tau
                rows.state[i] = new.state
            else:
                now.tau = neo_hookean(now.F, stiffness)
            if wp.static(viscoelastic):
                now.tau += relax(rows, i, now, stiffness, wp.where(step.gather > 0, dt, 0.0))
            if step.gather > 0:
                rows.x[i] = now.x
                rows.F[i] = now.F
                if step.scatter == 0:  # between the substeps of a frame the velocity is only stored on the grid
                    rows.v[i] = now.v
                    rows.C[i] = now.C
            if step.scatter > 0 and now.alive:
                target = stencil_at(grid, now.x, window)
                base = target.base
                previous = rows.base_node[i]
                if base[0] != previous[0] or base[1] != previous[1] or base[2] != previous[2]:
                    rows.base_node[i] = base
                    activate_blocks(grid, rows, i, base, nodes.friction, active)
                if wp.static(restitution):  # noqa: SIM102 -- resolved when the kernel is built
                    if held == FREE:
                        now.v = apply_restitution(grid, dt * float(number + 1), now.x, now.v, rows.friction[i], dt)
                load = affine_momentum(grid, rows, i, now, held, dt)
        if step.scatter > 0:
            add(grid, nodes.write, target, bspline_weights(target.fx), load, nodes.scale)

    return fused_step
