"""A whole substep of all particles in one launch: the order that is fastest on a GPU.

A thread gathers from one grid, dividing momentum by mass and applying walls as it reads, moves its particle, and
scatters into a second grid; additional threads clear a third. The grids change roles every substep, so that there is no
synchronisation within one. A particle that enters a new cell adds the blocks of its stencil to the list of active
blocks, which is exact and never read by the host. Transfers, materials and walls are those of `transfers`.

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
    Obstacle,
    apply_obstacles,
    apply_restitution,
    apply_walls,
    bspline_weights,
    first_node,
    near_obstacles,
    near_walls,
)
from stages.core.kernels.mpm.nodes import gather_momentum, mat43
from stages.core.kernels.mpm.transfers import (
    FREE,
    LOST,
    ParticleArrays,
    ParticleUpdate,
    advance_free,
    advance_kinematic,
    affine_momentum,
    mark_lost,
)

THREADS_PER_BLOCK = 128


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
def _node_velocity(
    grid: MpmGrid, read: wp.array[wp.vec4], friction: wp.array[float], node: int, at: wp.vec3i, scale: wp.vec2
) -> wp.vec3:
    """Velocity of a node after the walls; the grid is in fixed point if `scale` is set (see `exact`)."""
    v = wp.vec3()
    if scale[0] > 0.0:
        v = velocity_exact(read, node, scale)
    else:
        u = read[node]
        v = wp.vec3(u[0], u[1], u[2]) / wp.max(u[3], 1e-30)
    return apply_walls(grid, at, v, friction[node])


@wp.func
def _gather_walls(
    grid: MpmGrid, read: wp.array[wp.vec4], friction: wp.array[float], corner: int, base: wp.vec3i, fx: wp.vec3,
    scale: wp.vec2,
) -> mat43:  # fmt: skip
    """As gather_momentum, for stencils with nodes subject to walls."""
    s = mat43()
    for n in range(27):
        at = base + wp.vec3i(n // 9, (n // 3) % 3, n % 3)
        node = corner + ((n // 9) * grid.nodes[1] + (n // 3) % 3) * grid.nodes[2] + n % 3
        s = _add(s, fx, n, _node_velocity(grid, read, friction, node, at, scale))
    return s


@wp.func
def _gather_obstacles(
    grid: MpmGrid, read: wp.array[wp.vec4], friction: wp.array[float], obstacles: wp.array[Obstacle], time: float,
    corner: int, base: wp.vec3i, fx: wp.vec3, scale: wp.vec2,
) -> mat43:  # fmt: skip
    """As gather_momentum, for stencils with nodes subject to walls or obstacles."""
    s = mat43()
    for n in range(27):
        at = base + wp.vec3i(n // 9, (n // 3) % 3, n % 3)
        node = corner + ((n // 9) * grid.nodes[1] + (n // 3) % 3) * grid.nodes[2] + n % 3
        v = _node_velocity(grid, read, friction, node, at, scale)
        place = grid.origin + grid.dx * wp.vec3(float(at[0]), float(at[1]), float(at[2]))
        s = _add(s, fx, n, apply_obstacles(place, v, obstacles, time, grid.dx))
    return s


@wp.func
def _gather_free(
    grid: MpmGrid, read: wp.array[wp.vec4], friction: wp.array[float], corner: int, base: wp.vec3i, fx: wp.vec3,
    scale: wp.vec2,
) -> mat43:  # fmt: skip
    """As gather_momentum, for stencils without nodes at walls, or at the floor only."""
    under = grid.low[2] + 1 - base[2]
    return gather_momentum(read, friction, corner, grid.nodes[1] * grid.nodes[2], grid.nodes[2], bspline_weights(fx),
                           fx, under, grid.tangential_retention)  # fmt: skip


@wp.func
def _gather_free_exact(
    grid: MpmGrid, read: wp.array[wp.vec4], friction: wp.array[float], corner: int, base: wp.vec3i, fx: wp.vec3,
    scale: wp.vec2,
) -> mat43:  # fmt: skip
    """As _gather_free, from fixed point, for stencils without nodes at floor or walls."""
    return gather_exact(read, corner, grid.nodes[1] * grid.nodes[2], grid.nodes[2], bspline_weights(fx), fx, scale)


@wp.func
def _at_sides(grid: MpmGrid, base: wp.vec3i) -> bool:
    """Whether a stencil has nodes subject to a wall other than the floor."""
    return base[0] <= grid.low[0] or base[1] <= grid.low[1] or base[0] + 2 >= grid.high[0] or \
        base[1] + 2 >= grid.high[1] or base[2] + 2 >= grid.high[2]  # fmt: skip


@cache
def fused_step(plastic: bool, has_obstacles: bool, restitution: bool, exact: bool) -> wp.Kernel:
    """Build the kernel with the features needed, since each one costs registers.

    `plastic`: material models other than neo-Hookean; `exact`: grids in fixed point (see `exact`).
    """

    # 80 registers per thread instead of 94 and a quarter more threads at once; fixed point needs more registers
    bounds = {} if exact else {"launch_bounds": (THREADS_PER_BLOCK, 6)}
    collect, add = (_gather_free_exact, scatter_exact) if exact else (_gather_free, scatter_float)
    walled = near_walls if exact else _at_sides

    @wp.kernel(module="unique", enable_backward=False, **bounds)
    def fused_step(
        grid: MpmGrid, rows: ParticleArrays, sweep_from: int, sweepers: int, gather: int, scatter: int, substep: int,
        clock: wp.array[float], damping: float, read: wp.array[wp.vec4], write: wp.array[wp.vec4],
        stale: wp.array[wp.vec4], friction: wp.array[float], active: ActiveBlocks, obstacles: wp.array[Obstacle],
        scale: wp.vec2,
    ):  # fmt: skip
        """Threads below `sweep_from` (a multiple of 32) each move a particle; `sweepers` more clear the grid `stale`.

        `gather` and `scatter` switch G2P and P2G. clock: the substep [s], on the device, so that a captured graph can
        be replayed with another value.
        """
        i = wp.tid()
        if i >= sweep_from:
            if scatter > 0 and gather > 0:
                nodes = active.total[0] * BLOCK * BLOCK * BLOCK
                t = i - sweep_from
                while t < nodes:
                    node = node_of_block(grid, active.blocks[t // 64], t % 64)
                    if wp.static(exact):
                        stale[2 * node] = wp.vec4()
                        stale[2 * node + 1] = wp.vec4()
                    else:
                        stale[node] = wp.vec4()
                    t += sweepers
            return
        dt = clock[0]
        stride_y = grid.nodes[2]
        stride_x = grid.nodes[1] * grid.nodes[2]
        first = int(-1)
        fx = wp.vec3(1.0, 1.0, 1.0)
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
            if gather > 0 and held == FREE:
                g = (x - grid.origin) / grid.dx
                base = first_node(g)
                fx = wp.vec3(g[0] - float(base[0]), g[1] - float(base[1]), g[2] - float(base[2]))
                at = window + base[0] * stride_x + base[1] * stride_y + base[2]
                s = mat43()
                if wp.static(has_obstacles):
                    time = dt * float(substep)
                    if walled(grid, base) or near_obstacles(x, obstacles, time, 2.0 * grid.dx):
                        s = _gather_obstacles(grid, read, friction, obstacles, time, at, base, fx, scale)
                    else:
                        s = collect(grid, read, friction, at, base, fx, scale)
                else:
                    if walled(grid, base):
                        s = _gather_walls(grid, read, friction, at, base, fx, scale)
                    else:
                        s = collect(grid, read, friction, at, base, fx, scale)
                now = advance_free(grid, x, F, s, dt)
            else:
                now = advance_kinematic(grid, x, rows.v[i], rows.C[i], F, wp.where(gather > 0, dt, 0.0))
            if not now.alive:
                mark_lost(rows.held, rows.lost, i, rows.scene[i], rows.order[i])
            tau = wp.mat33()
            if wp.static(plastic):
                new = material_update(int(rows.model[i]), now.F, stiffness, rows.plastic[i], rows.state[i],
                                      wp.where(gather > 0, dt, 0.0))  # fmt: skip
                now.F = new.F
                tau = new.tau
                rows.state[i] = new.state
            else:
                tau = neo_hookean(now.F, stiffness)
            if gather > 0:
                rows.x[i] = now.x
                rows.F[i] = now.F
                if scatter == 0:  # during a frame the velocity is only on the grid
                    rows.v[i] = now.v
                    rows.C[i] = now.C
            if scatter > 0 and now.alive:
                g = (now.x - grid.origin) / grid.dx
                base = first_node(g)
                fx = wp.vec3(g[0] - float(base[0]), g[1] - float(base[1]), g[2] - float(base[2]))
                previous = rows.base_node[i]
                if base[0] != previous[0] or base[1] != previous[1] or base[2] != previous[2]:
                    rows.base_node[i] = base
                    activate_blocks(grid, rows, i, base, friction, active)
                if wp.static(restitution):  # noqa: SIM102 -- resolved when the kernel is built
                    if held == FREE:
                        now.v = apply_restitution(
                            grid, obstacles, dt * float(substep + 1), now.x, now.v, rows.friction[i], dt
                        )
                load = affine_momentum(grid.dx, now, tau, rows.mass[i], rows.volume[i], stiffness[2],
                                       rows.acceleration[i], held, dt, damping)  # fmt: skip
                first = window + base[0] * stride_x + base[1] * stride_y + base[2]
        if scatter > 0:
            add(write, first, stride_x, stride_y, bspline_weights(fx), fx, load, scale)

    return fused_step
