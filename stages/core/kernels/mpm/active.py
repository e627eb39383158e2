"""List of the grid blocks near particles, kept on the device and never read by the host.

A particle that enters a new cell adds the blocks of its stencil. Kernels over the listed blocks are launched with a
fixed number of threads, each of which processes several rows or nodes.
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.mpm.contact import BLOCK_NODES, ContactBodies, may_touch, resolve_node
from stages.core.kernels.mpm.exact import velocity_from_exact
from stages.core.kernels.mpm.grid import BLOCK, MpmGrid, NodeArrays, apply_boundaries, near_walls
from stages.core.kernels.mpm.transfers import ParticleArrays, Substep


@wp.struct
class ActiveBlocks:
    """Blocks that any particle's stencil has touched since the start of the frame."""

    marks: wp.array[int]  # 1 for each active block, over all scenes
    blocks: wp.array[int]  # active blocks; the first total[0] entries are used
    total: wp.array[int]  # number of active blocks
    sharers: wp.array[int]  # number of scenes (windows of bodies) for which each block of a grid is active
    sweepers: int  # number of threads of a launch over the blocks
    stale: wp.array[int]  # set when a particle leaves the blocks that the host has listed (split.py)


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
    """Add the blocks of a particle's stencil to the active ones, and update the friction of its nodes at walls."""
    nb = wp.vec3i(grid.nodes[0] // BLOCK, grid.nodes[1] // BLOCK, grid.nodes[2] // BLOCK)
    a0 = rows.scene[i] * nb[0]
    for a in range(base[0] // BLOCK, (base[0] + 2) // BLOCK + 1):
        for b in range(base[1] // BLOCK, (base[1] + 2) // BLOCK + 1):
            for c in range(base[2] // BLOCK, (base[2] + 2) // BLOCK + 1):
                block = ((a0 + a) * nb[1] + b) * nb[2] + c
                if active.marks[block] == 0:  # noqa: SIM102 -- read before the atomic; Warp's `and` does not short-circuit
                    if wp.atomic_max(active.marks, block, 1) == 0:
                        active.blocks[wp.atomic_add(active.total, 0, 1)] = block
                        wp.atomic_add(active.sharers, block % (grid.count // BLOCK_NODES), 1)
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
def grid_sweep(grid: MpmGrid, nodes: NodeArrays, active: ActiveBlocks, step: Substep):
    """Convert fixed-point momentum to velocities, clear it, and apply walls and obstacles; four nodes at a time."""
    t = wp.tid()
    while t < active.total[0] * BLOCK * BLOCK:
        first = node_of_block(grid, active.blocks[t // (BLOCK * BLOCK)], (t % (BLOCK * BLOCK)) * BLOCK)
        velocity_from_exact(nodes.momentum, nodes.velocity, first, nodes.scale)
        apply_boundaries(grid, nodes, step.clock[0], first, _position(grid, first))
        t += active.sweepers


@wp.kernel(enable_backward=False)
def contact_sweep(
    grid: MpmGrid, rows: ParticleArrays, bodies: ContactBodies, nodes: NodeArrays, active: ActiveBlocks, step: Substep
):
    """Resolve contact at the nodes of blocks that may have it; the thread of the first body in a block does it."""
    t = wp.tid()
    blocks = grid.count // BLOCK_NODES  # blocks in the grid of one body
    while t < active.total[0] * BLOCK_NODES:
        block = active.blocks[t // BLOCK_NODES]
        here = block % blocks
        node = node_of_block(grid, here, t % BLOCK_NODES)
        at = _position(grid, node)
        if may_touch(grid, active.sharers, at[0], at[1], at[2]):
            first = int(0)
            while active.marks[first * blocks + here] == 0:
                first += 1
            if first == block // blocks:
                resolve_node(grid, rows, bodies, nodes, bodies.all[first:], at, step)
        t += active.sweepers


@wp.kernel(enable_backward=False)
def clear_active_blocks(
    grid: MpmGrid, a: wp.array[wp.vec4], b: wp.array[wp.vec4], c: wp.array[wp.vec4], friction: wp.array[float],
    active: ActiveBlocks,
):  # fmt: skip
    """Clear all grids and marks of active blocks at the end of a frame; the caller then resets `total`."""
    t = wp.tid()
    width = a.shape[0] // friction.shape[0]  # vec4 per node
    nodes = active.total[0] * BLOCK * BLOCK * BLOCK
    while t < nodes:
        block = active.blocks[t // 64]
        node = node_of_block(grid, block, t % 64)
        for n in range(width):
            a[node * width + n] = wp.vec4()
            b[node * width + n] = wp.vec4()
            c[node * width + n] = wp.vec4()
        friction[node] = 0.0
        active.marks[block] = 0
        active.sharers[block % (grid.count // BLOCK_NODES)] = 0
        t += active.sweepers
