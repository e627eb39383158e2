"""A substep as two launches, particles and then grid: the fastest launch order on a CPU.

`particle_step` gathers velocities from the grid (G2P), moves the particles and scatters their momentum and stress for
the next substep (P2G); `grid_step` divides momentum by mass and applies floor, walls and obstacles. Several CPU threads
may scatter at once, each into its own copy of the momentum; for each block, bits tell in which copies it may be
non-zero. On a GPU the particle kernel sums in fixed point (see `exact`) and lists the active blocks itself (see
`active`).
"""

from __future__ import annotations

from functools import cache

import warp as wp

from stages.core.kernels.mpm.active import ActiveBlocks, activate_blocks
from stages.core.kernels.mpm.constitutive import material_update, neo_hookean
from stages.core.kernels.mpm.exact import scatter_exact, scatter_float
from stages.core.kernels.mpm.grid import (
    BLOCK,
    MpmGrid,
    NodeArrays,
    apply_boundaries,
    apply_restitution,
    bspline_weights,
    empty_stencil,
    first_node,
    near_walls,
    stencil_at,
)
from stages.core.kernels.mpm.nodes import gather_nodes, velocity_from_momentum
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


@wp.struct
class ParticlePart:
    """A range of particles, and the copy of the momentum that they scatter into."""

    start: int
    stop: int  # one past the last particle
    copy: int  # first node of the copy


@cache
def particle_step(features: Features, exact: bool = False) -> wp.Kernel:
    """Build the particle kernel with these features.

    With `exact` it scatters in fixed point, and lists active blocks instead of setting `stale`.
    """
    plastic, viscoelastic, restitution = features
    add = scatter_exact if exact else scatter_float

    @wp.kernel(module="unique", enable_backward=False)
    def particle_step(
        grid: MpmGrid, rows: ParticleArrays, part: ParticlePart, nodes: NodeArrays, active: ActiveBlocks, step: Substep
    ):  # fmt: skip
        """Advance one particle of a part."""
        i = part.start + wp.tid()
        dt = step.dt
        target = empty_stencil()
        load = wp.mat44()
        held = int(LOST)
        if i < part.stop:
            held = int(rows.held[i])
        if held != LOST:
            now = ParticleUpdate()
            x = rows.x[i]
            F = rows.F[i]
            stiffness = rows.stiffness[i]
            window = rows.scene[i] * grid.count
            if step.gather > 0 and held == FREE:
                source = stencil_at(grid, x, window)
                sums = gather_nodes(grid, nodes.velocity, source, bspline_weights(source.fx))
                now = advance_free(grid, x, F, sums, dt)
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
                rows.v[i] = now.v
                rows.C[i] = now.C
                rows.F[i] = now.F
            if step.scatter > 0 and now.alive:
                target = stencil_at(grid, now.x, part.copy + window)
                base = target.base
                previous = rows.base_node[i]
                shift = wp.max(wp.abs(base[0] - previous[0]), wp.abs(base[1] - previous[1]))
                shift = wp.max(shift, wp.abs(base[2] - previous[2]))
                if wp.static(exact):
                    if shift > 0:
                        rows.base_node[i] = base
                        activate_blocks(grid, rows, i, base, nodes.friction, active)
                elif shift > 1:
                    active.stale[0] = 1
                if wp.static(restitution):  # noqa: SIM102 -- resolved when the kernel is built
                    if held == FREE:
                        now.v = apply_restitution(grid, step.clock[0] + dt, now.x, now.v, rows.friction[i], dt)
                load = affine_momentum(grid, rows, i, now, held, dt)
        if step.scatter > 0:
            add(grid, nodes.momentum, target, bspline_weights(target.fx), load, nodes.scale)

    return particle_step


@wp.kernel(enable_backward=False)
def grid_step(grid: MpmGrid, start: int, nodes: NodeArrays, blocks: wp.array[wp.vec2i], clock: wp.array[float]):
    """Update one row of four nodes of an active block.

    `blocks` holds the first node of each block and the bits of its copies; `clock` is as in Substep.
    """
    t = start + wp.tid()
    block = blocks[t // (BLOCK * BLOCK)]
    row = t % (BLOCK * BLOCK)
    stride_y = grid.nodes[2]
    stride_x = grid.nodes[1] * stride_y
    window = (block[0] // grid.count) * grid.count
    corner = block[0] - window
    i = corner // stride_x + row // BLOCK
    j = (corner // stride_y) % grid.nodes[1] + row % BLOCK
    k = corner % stride_y
    first = window + i * stride_x + j * stride_y + k
    velocity_from_momentum(nodes.momentum, nodes.velocity, first, nodes.velocity.shape[0], block[1])
    apply_boundaries(grid, nodes, clock[0], first, wp.vec3i(i, j, k))


@wp.kernel(enable_backward=False)
def mark_blocks(grid: MpmGrid, rows: ParticleArrays, start: int, bit: int, marks: wp.array4d[int]):
    """Mark with `bit` the blocks (scene, i, j, k) that a particle's stencil reaches if it moves by up to one cell."""
    i = start + wp.tid()
    if rows.held[i] == wp.int8(LOST):
        return
    base = first_node((rows.x[i] - grid.origin) / grid.dx)
    rows.base_node[i] = base
    s = rows.scene[i]
    lo = wp.vec3i(wp.max(base[0] - 1, 0), wp.max(base[1] - 1, 0), wp.max(base[2] - 1, 0))
    hi = wp.vec3i(wp.min(base[0] + 3, grid.nodes[0] - 1), wp.min(base[1] + 3, grid.nodes[1] - 1),
                  wp.min(base[2] + 3, grid.nodes[2] - 1))  # fmt: skip
    for a in range(lo[0] // BLOCK, hi[0] // BLOCK + 1):
        for b in range(lo[1] // BLOCK, hi[1] // BLOCK + 1):
            for c in range(lo[2] // BLOCK, hi[2] // BLOCK + 1):
                if marks[s, a, b, c] & bit == 0:
                    wp.atomic_or(marks, s, a, b, c, bit)


@wp.kernel(enable_backward=False)
def mark_friction(grid: MpmGrid, rows: ParticleArrays, friction: wp.array[float]):
    """Set the friction coefficient of nodes at floor and walls to the maximum over the particles near them.

    "Near" includes motions of up to one cell. The fused order uses only the actual stencils, so the two orders can
    differ where bodies with different friction coefficients are closer than a cell.
    """
    i = wp.tid()
    if rows.held[i] == wp.int8(LOST):
        return
    base = first_node((rows.x[i] - grid.origin) / grid.dx)
    if not (near_walls(grid, base - wp.vec3i(1, 1, 1)) or near_walls(grid, base + wp.vec3i(1, 1, 1))):
        return
    window = rows.scene[i] * grid.count
    for a in range(wp.max(base[0] - 1, 0), wp.min(base[0] + 4, grid.nodes[0])):
        for b in range(wp.max(base[1] - 1, 0), wp.min(base[1] + 4, grid.nodes[1])):
            for c in range(wp.max(base[2] - 1, 0), wp.min(base[2] + 4, grid.nodes[2])):
                node = window + (a * grid.nodes[1] + b) * grid.nodes[2] + c
                wp.atomic_max(friction, node, rows.friction[i])


@wp.kernel(enable_backward=False)
def clear_friction(grid: MpmGrid, blocks: wp.array[wp.vec2i], friction: wp.array[float]):
    """Set the friction coefficient of one row of four nodes of a block to 0; threads as in grid_step."""
    t = wp.tid()
    row = t % (BLOCK * BLOCK)
    first = blocks[t // (BLOCK * BLOCK)][0] + ((row // BLOCK) * grid.nodes[1] + row % BLOCK) * grid.nodes[2]
    for n in range(BLOCK):
        friction[first + n] = 0.0
