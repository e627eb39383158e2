"""The background grid: where nodes are, how much a particle weighs on them, and what walls and obstacles do to them.

A batch of scenes has one grid a scene, all of one shape, one after the other in memory. Walls and obstacles are
conditions on the velocity of nodes: what moves in loses that speed, and friction takes from the speed along the surface
in proportion. A body bounces by its own elasticity. A surface with restitution is a spring that pushes back particles
instead, with the share restitution^2 of its force on their way out. None of this depends on the substep.
"""

from __future__ import annotations

import warp as wp

BLOCK = 4  # nodes along the edge of a block
GRID_PADDING = 4  # nodes outside the walls on every side: room for the stencil of a particle pressed into a wall
FLOOR_GAP = 1.0  # cells: a body coming to rest stays this far above the outermost held nodes (measured; see tests)
OBSTACLE_OFFSET = FLOOR_GAP - 0.5  # cells: see at_obstacles
RESTITUTION_MARGIN = 2.0  # cells: nodes stop what comes this much deeper where a surface has restitution
REST_DISTANCE = 0.25  # cells: particles at rest lie this far above a surface (measured; see tests)
PLANE, SPHERE, BOX = 0, 1, 2  # kinds of obstacles
SEPARATE, SLIP, STICKY = 0, 1, 2  # surfaces of obstacles


@wp.struct
class MpmGrid:
    """Node (i, j, k) of a scene lies at origin + dx (i, j, k) and is number (i ny + j) nz + k of its `count`."""

    origin: wp.vec3
    dx: float
    nodes: wp.vec3i  # multiples of BLOCK
    low: wp.vec3i  # first node inside the walls; nodes up to and including `low` feel the wall
    high: wp.vec3i
    count: int  # nodes of a scene
    restitution: float  # of floor and walls
    face_low: wp.vec3  # where they are; nodes `low` and `high` lie outside
    face_high: wp.vec3
    spring: float  # circular frequency of surfaces that give back speed [rad/s]
    keep: float  # of the velocity along a wall, every substep, as in the public solver; below 0: Coulomb friction


@wp.struct
class Obstacle:
    """A solid in the way: a half-space below local z = 0, a sphere of radius size[0], a box of half edges size."""

    kind: int
    surface: int
    centre: wp.vec3
    turn: wp.quat  # local to world
    size: wp.vec3
    velocity: wp.vec3
    spin: wp.vec3
    friction: float
    restitution: float


@wp.func
def bspline_weights(fx: wp.vec3) -> wp.mat33:
    """Quadratic B-spline: rows are axes; fx in [0.5, 1.5) is the distance to the first node."""
    w = wp.mat33()
    for axis in range(3):
        f = fx[axis]
        w[axis, 0] = 0.5 * (1.5 - f) * (1.5 - f)
        w[axis, 1] = 0.75 - (f - 1.0) * (f - 1.0)
        w[axis, 2] = 0.5 * (f - 0.5) * (f - 0.5)
    return w


@wp.func
def stencil_inside(grid: MpmGrid, g: wp.vec3) -> bool:
    """Whether the stencil of a particle at g (in cells) lies on the grid; not so for a place that is no number."""
    top = wp.vec3(float(grid.nodes[0] - 4), float(grid.nodes[1] - 4), float(grid.nodes[2] - 4))
    return g[0] >= 1.0 and g[0] < top[0] and g[1] >= 1.0 and g[1] < top[1] and g[2] >= 1.0 and g[2] < top[2]


@wp.func
def first_node(g: wp.vec3) -> wp.vec3i:
    """Lowest node of the stencil of a particle at g (in cells, positive)."""
    return wp.vec3i(int(g[0] - 0.5), int(g[1] - 0.5), int(g[2] - 0.5))


@wp.func
def coulomb_contact(v: wp.vec3, normal: wp.vec3, friction: float) -> wp.vec3:
    """Velocity after a surface with unit `normal` (out of the solid) met what moves into it.

    Coulomb: the change along the surface is at most friction x the change across it, whatever the time step.
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
def _spring(
    v: wp.vec3, normal: wp.vec3, depth: float, friction: float, restitution: float, grid: MpmGrid, dt: float
) -> wp.vec3:
    """Velocity of a particle after `dt` at a surface that gives back speed; depth is counted from TOUCH."""
    if depth <= 0.0:
        return v
    across = wp.dot(v, normal)
    gain = dt * grid.spring * grid.spring * depth * wp.where(across > 0.0, restitution * restitution, 1.0)
    along = v - across * normal
    speed = wp.length(along)
    left = wp.where(speed > friction * gain, 1.0 - friction * gain / wp.max(speed, 1e-12), 0.0)
    return (across + gain) * normal + left * along


@wp.func
def _wall(grid: MpmGrid, v: wp.vec3, normal: wp.vec3, friction: float) -> wp.vec3:
    if grid.keep < 0.0:
        return coulomb_contact(v, normal, friction)
    across = wp.dot(v, normal)
    if across >= 0.0:
        return v
    return grid.keep * (v - across * normal)


@wp.func
def near_walls(grid: MpmGrid, base: wp.vec3i) -> bool:
    """Whether a stencil has nodes that feel a wall."""
    return base[0] <= grid.low[0] or base[1] <= grid.low[1] or base[2] <= grid.low[2] or \
        base[0] + 2 >= grid.high[0] or base[1] + 2 >= grid.high[1] or base[2] + 2 >= grid.high[2]  # fmt: skip


@wp.func
def apply_walls(grid: MpmGrid, at: wp.vec3i, velocity: wp.vec3, friction: float) -> wp.vec3:
    """Velocity of the node `at`, after floor and walls; the floor first."""
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
    """Normal and signed distance of the point `arm` away from the obstacle's centre."""
    local = wp.quat_rotate_inv(turn, arm)
    normal = wp.vec3(0.0, 0.0, 1.0)
    distance = local[2]
    if obstacle.kind == SPHERE:
        length = wp.length(local)
        distance = length - obstacle.size[0]
        if length > 1e-9:
            normal = local / length
    if obstacle.kind == BOX:
        distance = float(-1e30)  # noqa: UP018 -- Warp takes a literal for a constant
        for axis in range(3):
            gap = wp.abs(local[axis]) - obstacle.size[axis]
            if gap > distance:
                distance = gap
                normal = wp.vec3()
                normal[axis] = wp.where(local[axis] < 0.0, -1.0, 1.0)
    normal = wp.quat_rotate(turn, normal)
    return wp.vec4(normal[0], normal[1], normal[2], distance)


@wp.func
def _seen(obstacle: Obstacle, place: wp.vec3, time: float) -> wp.vec4:
    """Normal and signed distance of a place, `time` [s] after the start of the frame."""
    turn = obstacle.turn
    rate = wp.length(obstacle.spin)
    if rate > 0.0:
        turn = wp.mul(wp.quat_from_axis_angle(obstacle.spin / rate, rate * time), obstacle.turn)
    return _outwards(obstacle, place - obstacle.centre - time * obstacle.velocity, turn)


@wp.func
def near_obstacles(place: wp.vec3, obstacles: wp.array[Obstacle], time: float, reach: float) -> bool:
    """Whether anything within `reach` of a place may lie in an obstacle. (For a box, distance is along an axis.)"""
    near = float(1e30)  # noqa: UP018 -- Warp takes a literal for a constant
    for n in range(obstacles.shape[0]):
        near = wp.min(near, _seen(obstacles[n], place, time)[3])
    return near < 1.75 * reach


@wp.func
def apply_obstacles(
    place: wp.vec3, velocity: wp.vec3, obstacles: wp.array[Obstacle], time: float, dx: float
) -> wp.vec3:
    """Velocity of a node at `place`, after the obstacles, as they stand `time` [s] after the start of the frame.

    What approaches is stopped by nodes OUTER cells deep and more, so that bodies come to rest on the surface (on
    average the first of them is FLOOR_GAP deep). What would leave a surface that lets nothing go is held from OUTER
    cells above it: there those bodies have their weight.
    """
    v = velocity
    for n in range(obstacles.shape[0]):
        o = obstacles[n]
        out = _seen(o, place, time)
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
    grid: MpmGrid, obstacles: wp.array[Obstacle], time: float, x: wp.vec3, velocity: wp.vec3, friction: float, dt: float
) -> wp.vec3:
    """Velocity of a particle after `dt` at the surfaces with restitution."""
    v = velocity
    touch = REST_DISTANCE * grid.dx
    if grid.restitution > 0.0:
        for axis in range(3):
            normal = wp.vec3()
            normal[axis] = 1.0
            v = _spring(v, normal, grid.face_low[axis] + touch - x[axis], friction, grid.restitution, grid, dt)
            v = _spring(v, -normal, x[axis] - grid.face_high[axis] + touch, friction, grid.restitution, grid, dt)
    for n in range(obstacles.shape[0]):
        o = obstacles[n]
        if o.restitution > 0.0:
            out = _seen(o, x, time)
            moving = o.velocity + wp.cross(o.spin, x - o.centre - time * o.velocity)
            normal = wp.vec3(out[0], out[1], out[2])
            v = moving + _spring(v - moving, normal, touch - out[3], o.friction, o.restitution, grid, dt)
    return v
