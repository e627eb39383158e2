"""Contact of bodies that have a velocity field each: no approach, Coulomb friction, free separation.

Each body is scattered to a window of its own, as scenes of a batch are. Where windows overlap, bodies may have mass at
the same node although they are a cell apart. With quadratic B-splines the volume fractions of two bodies add up to 1 at
every node across a common surface, and to less across a gap, by the slope of the fractions times its width in cells; so
bodies touch where 1 - f_a - f_b is at most CONTACT_GAP times that slope.
Sources: Bardenhagen et al. 2001, "An improved contact algorithm for the material point method"; Huang et al. 2011,
"Contact algorithms for the material point method in impact and penetration simulation" (common normal); Nairn 2013,
"Modeling imperfect interfaces in the material point method using multimaterial methods" (normal of one body).
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.mpm.grid import BLOCK, MpmGrid, apply_walls, coulomb_contact

CONTACT_GAP = 0.1  # gap at which bodies are in contact [cells]; particles are placed with a jitter of this size
MIN_FRACTION = 0.02  # volume fraction a cell outside a flat surface; normals at fewer are unreliable
SWEEPS = 2  # over the pairs of a node with more than two bodies
BLOCK_NODES = wp.constant(BLOCK**3)
ACROSS = wp.constant(wp.vec2(10.0 / 16.0, 3.0 / 16.0))  # weights of differences in a row and in those beside it


@wp.func
def _slope(velocity: wp.array[wp.vec4], node: int, stride_x: int, stride_y: int, full: float) -> wp.vec3:
    """Change of the volume fraction of a body per cell; `full` is the mass of a filled cell.

    Central differences, averaged across: normals of inclined planes are 1.5 degrees off at most, without it 2 to 8.
    Source: Scharr 2000, "Optimale Operatoren in der digitalen Bildverarbeitung".
    """
    slope = wp.vec3()
    for i in range(-1, 2):
        for j in range(-1, 2):
            for k in range(-1, 2):
                x = wp.where(i == 0, ACROSS[0], ACROSS[1])
                y = wp.where(j == 0, ACROSS[0], ACROSS[1])
                z = wp.where(k == 0, ACROSS[0], ACROSS[1])
                mass = velocity[node + i * stride_x + j * stride_y + k][3]
                slope += mass * wp.vec3(float(i) * y * z, float(j) * x * z, float(k) * x * y)
    return slope * (0.5 / full)


@wp.func
def _flat_slope(fraction: float) -> float:
    """Slope per cell of the volume fraction across a flat surface, where it is `fraction`; less at a convex edge."""
    f = wp.clamp(wp.min(fraction, 1.0 - fraction), MIN_FRACTION, 0.5)
    if f < 1.0 / 6.0:  # farther than half a cell from the surface
        return 0.5 * wp.pow(6.0 * f, 2.0 / 3.0)
    d = (0.5 - f) / 0.75
    d += d * d * d / 2.25  # inverts f = 1/2 - 3 d / 4 + d^3 / 3 to 3 %
    return 0.75 - d * d


@wp.func
def resolve_pair(
    velocity: wp.array[wp.vec4], first: int, second: int, stride_x: int, stride_y: int, full_a: float, full_b: float,
    friction: float,
) -> bool:  # fmt: skip
    """Stop the approach of two bodies at a node where they touch, with friction; momentum is kept."""
    u = velocity[first]
    v = velocity[second]
    fa = u[3] / full_a
    fb = v[3] / full_b
    if fa < MIN_FRACTION or fb < MIN_FRACTION:
        return False
    slope_a = _slope(velocity, first, stride_x, stride_y, full_a)
    slope_b = _slope(velocity, second, stride_x, stride_y, full_b)
    steep_a = wp.length(slope_a)
    steep_b = wp.length(slope_b)
    if 1.0 - wp.min(fa, 1.0) - wp.min(fb, 1.0) > 0.5 * CONTACT_GAP * (steep_a + steep_b):
        return False
    # from the first body to the second, by the flatter surface: at the edge of a block that slides on another the mean
    # of both would be tilted against the motion
    flatter = steep_a * _flat_slope(fb) > steep_b * _flat_slope(fa)
    normal = wp.normalize(wp.where(flatter, -slope_a, slope_b))
    relative = wp.vec3(u[0] - v[0], u[1] - v[1], u[2] - v[2])
    change = relative - coulomb_contact(relative, -normal, friction)
    if wp.dot(change, normal) <= 0.0:
        return False
    a = v[3] / (u[3] + v[3])
    b = 1.0 - a
    velocity[first] = wp.vec4(u[0] - a * change[0], u[1] - a * change[1], u[2] - a * change[2], u[3])
    velocity[second] = wp.vec4(v[0] + b * change[0], v[1] + b * change[1], v[2] + b * change[2], v[3])
    return True


@wp.kernel(enable_backward=False)
def contact_step(
    grid: MpmGrid, velocity: wp.array[wp.vec4], corners: wp.array[int], starts: wp.array[int], bodies: wp.array[int],
    full: wp.array[float], friction: wp.array[float], wall_friction: wp.array[float],
):  # fmt: skip
    """One node of a block that several bodies share: `bodies[starts[b] : starts[b + 1]]` of the block at `corners[b]`.

    `velocity` holds velocity and mass of the nodes of each body; `full` the mass of a filled cell and `friction` the
    Coulomb coefficient of each body; the larger of two coefficients acts.
    """
    t = wp.tid()
    b = t // BLOCK_NODES
    n = t % BLOCK_NODES
    stride_y = grid.nodes[2]
    stride_x = grid.nodes[1] * stride_y
    i = corners[b] // stride_x + n // (BLOCK * BLOCK)
    j = (corners[b] // stride_y) % grid.nodes[1] + (n // BLOCK) % BLOCK
    k = corners[b] % stride_y + n % BLOCK
    node = i * stride_x + j * stride_y + k
    start = starts[b]
    stop = starts[b + 1]
    if i == 0 or j == 0 or k == 0 or i + 1 >= grid.nodes[0] or j + 1 >= grid.nodes[1] or k + 1 >= grid.nodes[2]:
        return
    sweeps = wp.where(stop - start > 2, SWEEPS, 1)
    touched = bool(False)  # noqa: UP018 -- a literal would be constant in Warp
    for _ in range(sweeps):
        for p in range(start, stop):
            for q in range(p + 1, stop):
                one = bodies[p]
                other = bodies[q]
                mu = wp.max(friction[one], friction[other])
                if resolve_pair(velocity, one * grid.count + node, other * grid.count + node, stride_x, stride_y,
                                 full[one], full[other], mu):  # fmt: skip
                    touched = True
    if touched:
        for p in range(start, stop):
            at = bodies[p] * grid.count + node
            w = velocity[at]
            inside = apply_walls(grid, wp.vec3i(i, j, k), wp.vec3(w[0], w[1], w[2]), wall_friction[at])
            velocity[at] = wp.vec4(inside[0], inside[1], inside[2], w[3])
