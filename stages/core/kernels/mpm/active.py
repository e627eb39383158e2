"""The blocks of grid nodes that have particles, listed on the device and never read by the host.

A particle that enters a new cell adds the blocks of its stencil. Kernels over the listed blocks are launched with a
fixed number of threads, each of which takes several rows or nodes.
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.mpm.contact import SWEEPS, resolve_pair
from stages.core.kernels.mpm.exact import velocity_from_exact
from stages.core.kernels.mpm.grid import BLOCK, MpmGrid, Obstacle, apply_boundaries, apply_walls, near_walls
from stages.core.kernels.mpm.transfers import ParticleArrays


@wp.struct
class ActiveBlocks:
    """Blocks that had particles since the start of the frame: `blocks[: total[0]]`, and a mark for every block."""

    marks: wp.array[int]
    blocks: wp.array[int]
    total: wp.array[int]


@wp.func
def node_of_block(grid: MpmGrid, block: int, n: int) -> int:
    """Index of node n (0..63) of a block, over all scenes."""
    nb = wp.vec3i(grid.nodes[0] // BLOCK, grid.nodes[1] // BLOCK, grid.nodes[2] // BLOCK)
    a = block // (nb[1] * nb[2])  # scenes are consecutive along x
    b = (block // nb[2]) % nb[1]
    c = block % nb[2]
    i = a * BLOCK + n // (BLOCK * BLOCK)
    j = b * BLOCK + (n // BLOCK) % BLOCK
    return (i * grid.nodes[1] + j) * grid.nodes[2] + c * BLOCK + n % BLOCK


@wp.func
def activate_blocks(
    grid: MpmGrid, rows: ParticleArrays, i: int, base: wp.vec3i, friction: wp.array[float], active: ActiveBlocks
):
    """Add the blocks of a stencil to the active ones, and update the friction coefficients of its nodes at walls."""
    nb = wp.vec3i(grid.nodes[0] // BLOCK, grid.nodes[1] // BLOCK, grid.nodes[2] // BLOCK)
    a0 = rows.scene[i] * nb[0]
    for a in range(base[0] // BLOCK, (base[0] + 2) // BLOCK + 1):
        for b in range(base[1] // BLOCK, (base[1] + 2) // BLOCK + 1):
            for c in range(base[2] // BLOCK, (base[2] + 2) // BLOCK + 1):
                block = ((a0 + a) * nb[1] + b) * nb[2] + c
                if active.marks[block] == 0:  # noqa: SIM102 -- read before the atomic; Warp's `and` does not short-circuit
                    if wp.atomic_max(active.marks, block, 1) == 0:
                        active.blocks[wp.atomic_add(active.total, 0, 1)] = block
    if near_walls(grid, base):
        corner = rows.scene[i] * grid.count + (base[0] * grid.nodes[1] + base[1]) * grid.nodes[2] + base[2]
        mu = rows.friction[i]
        for n in range(27):
            node = corner + ((n // 9) * grid.nodes[1] + (n // 3) % 3) * grid.nodes[2] + n % 3
            if friction[node] < mu:
                wp.atomic_max(friction, node, mu)


@wp.func
def _position(grid: MpmGrid, node: int) -> wp.vec3i:
    """Indices of a node in the grid of its scene."""
    own = node % grid.count
    return wp.vec3i(own // (grid.nodes[1] * grid.nodes[2]), (own // grid.nodes[2]) % grid.nodes[1],
                    own % grid.nodes[2])  # fmt: skip


@wp.kernel(enable_backward=False)
def grid_sweep(
    grid: MpmGrid, sweepers: int, momentum: wp.array[wp.vec4], velocity: wp.array[wp.vec4],
    friction: wp.array[float], active: ActiveBlocks, obstacles: wp.array[Obstacle], clock: wp.array[float],
    scale: wp.vec2,
):  # fmt: skip
    """Momentum in fixed point, which is cleared, to velocities after walls and obstacles; a row of four nodes each.

    clock: time since the start of the frame [s], for moving obstacles.
    """
    t = wp.tid()
    while t < active.total[0] * BLOCK * BLOCK:
        first = node_of_block(grid, active.blocks[t // (BLOCK * BLOCK)], (t % (BLOCK * BLOCK)) * BLOCK)
        velocity_from_exact(momentum, velocity, first, scale)
        apply_boundaries(grid, velocity, friction, obstacles, clock[0], first, _position(grid, first))
        t += sweepers


@wp.func
def _resolve_node(
    grid: MpmGrid, velocity: wp.array[wp.vec4], full: wp.array[float], body_friction: wp.array[float],
    friction: wp.array[float], marks: wp.array[int], first: int, block: int, node: int,
):  # fmt: skip
    """Contact at a node of a block of the bodies that are active in it, of which `first` is the first."""
    blocks = grid.count // (BLOCK * BLOCK * BLOCK)
    bodies = full.shape[0]
    at = _position(grid, node)
    for axis in range(3):
        if at[axis] == 0 or at[axis] + 1 >= grid.nodes[axis]:
            return
    stride_y = grid.nodes[2]
    stride_x = grid.nodes[1] * stride_y
    here = int(0)  # noqa: UP018 -- a literal would be constant in Warp
    for p in range(first, bodies):
        here += wp.where(marks[p * blocks + block] > 0, 1, 0)
    touched = bool(False)  # noqa: UP018
    for _ in range(wp.where(here > 2, SWEEPS, wp.where(here > 1, 1, 0))):
        for p in range(first, bodies):
            if marks[p * blocks + block] > 0:
                for q in range(p + 1, bodies):
                    if marks[q * blocks + block] > 0:  # noqa: SIM102 -- Warp's `and` does not short-circuit
                        if resolve_pair(velocity, p * grid.count + node, q * grid.count + node, stride_x, stride_y,
                                        full[p], full[q], wp.max(body_friction[p], body_friction[q])):  # fmt: skip
                            touched = True
    if touched:
        for p in range(first, bodies):
            if marks[p * blocks + block] > 0:
                own = p * grid.count + node
                w = velocity[own]
                inside = apply_walls(grid, at, wp.vec3(w[0], w[1], w[2]), friction[own])
                velocity[own] = wp.vec4(inside[0], inside[1], inside[2], w[3])


@wp.kernel(enable_backward=False)
def contact_sweep(
    grid: MpmGrid, sweepers: int, velocity: wp.array[wp.vec4], full: wp.array[float], body_friction: wp.array[float],
    friction: wp.array[float], active: ActiveBlocks,
):  # fmt: skip
    """Contact at the nodes of blocks that several bodies have in common; the thread of the first body acts for all.

    Arguments as `contact.contact_step`.
    """
    t = wp.tid()
    blocks = grid.count // (BLOCK * BLOCK * BLOCK)  # of a body
    while t < active.total[0] * BLOCK * BLOCK * BLOCK:
        block = active.blocks[t // (BLOCK * BLOCK * BLOCK)]
        here = block % blocks
        first = int(0)  # noqa: UP018 -- a literal would be constant in Warp
        while active.marks[first * blocks + here] == 0:
            first += 1
        if first == block // blocks:
            node = node_of_block(grid, here, t % (BLOCK * BLOCK * BLOCK))
            _resolve_node(grid, velocity, full, body_friction, friction, active.marks, first, here, node)
        t += sweepers


@wp.kernel(enable_backward=False)
def clear_active_blocks(
    grid: MpmGrid, sweepers: int, a: wp.array[wp.vec4], b: wp.array[wp.vec4], c: wp.array[wp.vec4],
    friction: wp.array[float], active: ActiveBlocks, width: int,
):  # fmt: skip
    """Clear all grids and marks at the end of a frame; the caller then resets the number of active blocks."""
    t = wp.tid()
    nodes = active.total[0] * BLOCK * BLOCK * BLOCK
    while t < nodes:
        block = active.blocks[t // 64]
        node = node_of_block(grid, block, t % 64)
        for n in range(width):  # `width` vec4 per node
            a[node * width + n] = wp.vec4()
            b[node * width + n] = wp.vec4()
            c[node * width + n] = wp.vec4()
        friction[node] = 0.0
        active.marks[block] = 0
        t += sweepers
