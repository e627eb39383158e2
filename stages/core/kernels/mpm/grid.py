"""Background grid: node layout, interpolation weights, and boundary conditions at walls and obstacles.

A batch has one grid per scene, all of one shape, consecutive in memory. Walls and obstacles are conditions on the
velocity of nodes: the normal component into the surface is removed, and Coulomb friction reduces the tangential one in
proportion. Bodies then rebound only by their own elasticity. A surface with restitution instead acts on particles as a
penalty spring, whose force is multiplied by restitution^2 during rebound. The result does not depend on the substep.
"""

from __future__ import annotations

import warp as wp

BLOCK = 4  # nodes along an edge of a block
GRID_PADDING = 4  # nodes beyond the walls on each side, for the stencils of particles pressed into a wall
FLOOR_GAP = 1.0  # [cells] distance of a resting body from the outermost constrained nodes (measured; see tests)
OBSTACLE_OFFSET = FLOOR_GAP - 0.5  # [cells] depth of the outermost constrained nodes; see apply_obstacles
RESTITUTION_MARGIN = 2.0  # [cells] added to OBSTACLE_OFFSET at surfaces with restitution
REST_DISTANCE = 0.25  # [cells] distance of resting particles from a surface (measured; see tests)
PLANE, SPHERE, BOX = 0, 1, 2  # shapes of obstacles (Obstacle.kind)
SEPARATE, SLIP, STICKY = 0, 1, 2  # contact conditions (Obstacle.surface): Coulomb, free slip, no slip


@wp.struct
class Obstacle:
    """Moving obstacle: the half-space below local z = 0, a sphere of radius size[0] [m], or a box (half edges)."""

    kind: int
    surface: int
    centre: wp.vec3
    turn: wp.quat  # rotation, local to world
    size: wp.vec3
    velocity: wp.vec3  # [m/s]
    spin: wp.vec3  # angular velocity [rad/s]
    friction: float
    restitution: float


@wp.struct
class MpmGrid:
    """Grid of a scene: node (i, j, k) lies at origin + dx (i, j, k) [m] and has index (i ny + j) nz + k of `count`."""

    origin: wp.vec3
    dx: float
    nodes: wp.vec3i  # multiples of BLOCK
    low: wp.vec3i  # nodes with an index <= low or >= high are subject to the walls
    high: wp.vec3i
    count: int  # nodes per scene
    restitution: float  # coefficient of restitution of floor and walls
    face_low: wp.vec3  # positions of the walls [m]; nodes `low` and `high` lie outside them
    face_high: wp.vec3
    spring: float  # circular frequency of the springs of surfaces with restitution [rad/s]
    tangential_retention: float  # fraction of the tangential velocity kept at a wall in each substep; < 0: Coulomb
    damping: float  # fraction of the symmetric part of C removed in each transfer (RPIC), 0 to 1
    obstacles: wp.array[Obstacle]  # of all scenes


@wp.struct
class NodeArrays:
    """Nodes of the grids of all scenes."""

    velocity: wp.array[wp.vec4]  # [m/s], and mass [kg]
    momentum: wp.array[wp.vec4]  # [kg m/s], and mass [kg]; one or more copies, or two rows per node in fixed point
    scale: wp.vec2  # fixed-point units of momentum and mass, see exact.py; 0 in floating point
    friction: wp.array[float]  # Coulomb coefficient at floor and walls
    nearest: wp.array[wp.int64]  # key of the nearest particle of each body in contact, see contact.py


@wp.struct
class Stencil:
    """The 3 x 3 x 3 nodes that a particle transfers to and from."""

    first: int  # index of the first node over all scenes; < 0: none
    base: wp.vec3i  # index of the first node along x, y and z in the grid of its scene
    fx: wp.vec3  # offset of the particle from the first node [cells], in [0.5, 1.5)^3


@wp.func
def bspline_weights(fx: wp.vec3) -> wp.mat33:
    """Quadratic B-spline weights of the three nodes (columns) along each axis (rows).

    fx in [0.5, 1.5)^3 is the distance from the first node of the stencil [cells].
    """
    w = wp.mat33()
    for axis in range(3):
        f = fx[axis]
        w[axis, 0] = 0.5 * (1.5 - f) * (1.5 - f)
        w[axis, 1] = 0.75 - (f - 1.0) * (f - 1.0)
        w[axis, 2] = 0.5 * (f - 0.5) * (f - 0.5)
    return w


@wp.func
def stencil_inside(grid: MpmGrid, g: wp.vec3) -> bool:
    """Whether the stencil of a particle at g [cells] lies on the grid; False for NaN."""
    top = wp.vec3(float(grid.nodes[0] - 4), float(grid.nodes[1] - 4), float(grid.nodes[2] - 4))
    return g[0] >= 1.0 and g[0] < top[0] and g[1] >= 1.0 and g[1] < top[1] and g[2] >= 1.0 and g[2] < top[2]


@wp.func
def first_node(g: wp.vec3) -> wp.vec3i:
    """First node of the stencil of a particle at g [cells], which must be positive."""
    return wp.vec3i(int(g[0] - 0.5), int(g[1] - 0.5), int(g[2] - 0.5))


@wp.func
def stencil_at(grid: MpmGrid, x: wp.vec3, window: int) -> Stencil:
    """Stencil of a particle at x [m], in the grid whose first node is `window`."""
    g = (x - grid.origin) / grid.dx
    base = first_node(g)
    out = Stencil()
    out.base = base
    out.fx = wp.vec3(g[0] - float(base[0]), g[1] - float(base[1]), g[2] - float(base[2]))
    out.first = window + (base[0] * grid.nodes[1] + base[1]) * grid.nodes[2] + base[2]
    return out


@wp.func
def empty_stencil() -> Stencil:
    """Stencil without nodes, for a thread without a particle."""
    out = Stencil()
    out.first = -1
    out.fx = wp.vec3(1.0, 1.0, 1.0)
    return out


@wp.func
def coulomb_contact(v: wp.vec3, normal: wp.vec3, friction: float) -> wp.vec3:
    """Velocity after contact with a surface of unit outward `normal`: no inward component, Coulomb friction.

    The tangential change is at most friction x the normal change, for any time step.
    """
    across = wp.dot(v, normal)
    if across >= 0.0:
        return v
    along = v - across * normal
    speed = wp.length(along)
    if speed <= -friction * across:
        return wp.vec3()
    return along * (1.0 + friction * across / speed)


@wp.func
def _spring(v: wp.vec3, normal: wp.vec3, depth: float, friction: float, restitution: float, rate: float) -> wp.vec3:
    """Velocity of a particle after a substep under a surface's penalty spring and friction.

    `depth` is measured from REST_DISTANCE [m]; `rate` is the velocity gained per unit of depth [1/s].
    """
    if depth <= 0.0:
        return v
    across = wp.dot(v, normal)
    gain = rate * depth * wp.where(across > 0.0, restitution * restitution, 1.0)
    along = v - across * normal
    speed = wp.length(along)
    left = wp.where(speed > friction * gain, 1.0 - friction * gain / wp.max(speed, 1e-12), 0.0)
    return (across + gain) * normal + left * along


@wp.func
def _wall(grid: MpmGrid, v: wp.vec3, normal: wp.vec3, friction: float) -> wp.vec3:
    """Boundary condition of one wall with inward `normal`."""
    if grid.tangential_retention < 0.0:
        return coulomb_contact(v, normal, friction)
    across = wp.dot(v, normal)
    if across >= 0.0:
        return v
    return grid.tangential_retention * (v - across * normal)


@wp.func
def near_walls(grid: MpmGrid, base: wp.vec3i) -> bool:
    """Whether the stencil with first node `base` includes nodes subject to floor or walls."""
    return base[0] <= grid.low[0] or base[1] <= grid.low[1] or base[2] <= grid.low[2] or \
        base[0] + 2 >= grid.high[0] or base[1] + 2 >= grid.high[1] or base[2] + 2 >= grid.high[2]  # fmt: skip


@wp.func
def apply_walls(grid: MpmGrid, at: wp.vec3i, velocity: wp.vec3, friction: float) -> wp.vec3:
    """Velocity of node `at` after the conditions of floor, ceiling and walls, applied in this order."""
    v = velocity
    if at[2] <= grid.low[2]:
        v = _wall(grid, v, wp.vec3(0.0, 0.0, 1.0), friction)
    if at[2] >= grid.high[2]:
        v = _wall(grid, v, wp.vec3(0.0, 0.0, -1.0), friction)
    if at[1] <= grid.low[1]:
        v = _wall(grid, v, wp.vec3(0.0, 1.0, 0.0), friction)
    if at[1] >= grid.high[1]:
        v = _wall(grid, v, wp.vec3(0.0, -1.0, 0.0), friction)
    if at[0] <= grid.low[0]:
        v = _wall(grid, v, wp.vec3(1.0, 0.0, 0.0), friction)
    if at[0] >= grid.high[0]:
        v = _wall(grid, v, wp.vec3(-1.0, 0.0, 0.0), friction)
    return v


@wp.func
def _outwards(obstacle: Obstacle, arm: wp.vec3, turn: wp.quat) -> wp.vec4:
    """Outward normal (xyz) and signed distance (w) [m] at the point `arm` relative to the obstacle's centre."""
    local = wp.quat_rotate_inv(turn, arm)
    normal = wp.vec3(0.0, 0.0, 1.0)
    distance = local[2]
    if obstacle.kind == SPHERE:
        length = wp.length(local)
        distance = length - obstacle.size[0]
        if length > 1e-9:
            normal = local / length
    if obstacle.kind == BOX:
        distance = float(-1e30)
        for axis in range(3):
            gap = wp.abs(local[axis]) - obstacle.size[axis]
            if gap > distance:
                distance = gap
                normal = wp.vec3()
                normal[axis] = wp.where(local[axis] < 0.0, -1.0, 1.0)
    normal = wp.quat_rotate(turn, normal)
    return wp.vec4(normal[0], normal[1], normal[2], distance)


@wp.func
def _surface_at(obstacle: Obstacle, place: wp.vec3, time: float) -> wp.vec4:
    """Outward normal and signed distance of a position, `time` [s] after the start of the frame."""
    turn = obstacle.turn
    rate = wp.length(obstacle.spin)
    if rate > 0.0:
        turn = wp.mul(wp.quat_from_axis_angle(obstacle.spin / rate, rate * time), obstacle.turn)
    return _outwards(obstacle, place - obstacle.centre - time * obstacle.velocity, turn)


@wp.func
def near_obstacles(place: wp.vec3, obstacles: wp.array[Obstacle], time: float, radius: float) -> bool:
    """Whether a point within `radius` [m] of a position along each axis may lie in an obstacle."""
    near = float(1e30)
    for n in range(obstacles.shape[0]):
        near = wp.min(near, _surface_at(obstacles[n], place, time)[3])
    return near < 1.75 * radius


@wp.func
def apply_obstacles(
    place: wp.vec3, velocity: wp.vec3, obstacles: wp.array[Obstacle], time: float, dx: float
) -> wp.vec3:
    """Velocity of a node at `place` after the conditions of all obstacles, `time` [s] after the start of the frame.

    Approaching nodes are constrained from a depth of OBSTACLE_OFFSET cells, so that bodies come to rest on the surface
    (the first constrained node is on average FLOOR_GAP deep). At SLIP and STICKY surfaces, separating nodes are
    constrained from OBSTACLE_OFFSET cells above the surface, where resting bodies have their mass.
    """
    v = velocity
    for n in range(obstacles.shape[0]):
        o = obstacles[n]
        out = _surface_at(o, place, time)
        normal = wp.vec3(out[0], out[1], out[2])
        moving = o.velocity + wp.cross(o.spin, place - o.centre - time * o.velocity)
        u = v - moving
        leaves = o.surface != SEPARATE and wp.dot(u, normal) > 0.0
        offset = wp.where(leaves, OBSTACLE_OFFSET, -OBSTACLE_OFFSET)
        edge = wp.where(o.restitution > 0.0, -OBSTACLE_OFFSET - RESTITUTION_MARGIN, offset)
        if out[3] < edge * dx:
            if o.surface == STICKY:
                u = wp.vec3()
            elif o.surface == SLIP:
                u = u - wp.dot(u, normal) * normal
            else:
                u = coulomb_contact(u, normal, o.friction)
            v = moving + u
    return v


@wp.func
def apply_restitution(
    grid: MpmGrid, time: float, x: wp.vec3, velocity: wp.vec3, friction: float, dt: float
) -> wp.vec3:  # fmt: skip
    """Velocity of a particle after `dt` [s] under the springs of all walls and obstacles with restitution."""
    v = velocity
    rate = dt * grid.spring * grid.spring
    touch = REST_DISTANCE * grid.dx
    if grid.restitution > 0.0:
        for axis in range(3):
            normal = wp.vec3()
            normal[axis] = 1.0
            v = _spring(v, normal, grid.face_low[axis] + touch - x[axis], friction, grid.restitution, rate)
            v = _spring(v, -normal, x[axis] - grid.face_high[axis] + touch, friction, grid.restitution, rate)
    for n in range(grid.obstacles.shape[0]):
        o = grid.obstacles[n]
        if o.restitution > 0.0:
            out = _surface_at(o, x, time)
            moving = o.velocity + wp.cross(o.spin, x - o.centre - time * o.velocity)
            normal = wp.vec3(out[0], out[1], out[2])
            v = moving + _spring(v - moving, normal, touch - out[3], o.friction, o.restitution, rate)
    return v


@wp.func
def apply_boundaries(grid: MpmGrid, nodes: NodeArrays, time: float, first: int, at: wp.vec3i):
    """Apply walls and obstacles to the velocities of a row of four nodes, the first of which is `at`."""
    inside = at[0] > grid.low[0] and at[0] < grid.high[0] and at[1] > grid.low[1] and at[1] < grid.high[1]
    inside = inside and at[2] > grid.low[2] and at[2] + BLOCK <= grid.high[2]
    blocked = bool(False)
    if grid.obstacles.shape[0] > 0:
        middle = grid.origin + grid.dx * wp.vec3(float(at[0]), float(at[1]), float(at[2]) + 1.5)
        blocked = near_obstacles(middle, grid.obstacles, time, 2.0 * grid.dx)
    if inside and not blocked:
        return
    for n in range(BLOCK):
        u = nodes.velocity[first + n]
        v = apply_walls(grid, at + wp.vec3i(0, 0, n), wp.vec3(u[0], u[1], u[2]), nodes.friction[first + n])
        if blocked:
            place = grid.origin + grid.dx * wp.vec3(float(at[0]), float(at[1]), float(at[2] + n))
            v = apply_obstacles(place, v, grid.obstacles, time, grid.dx)
        nodes.velocity[first + n] = wp.vec4(v[0], v[1], v[2], u[3])
