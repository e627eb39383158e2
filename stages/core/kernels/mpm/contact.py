"""Contact of bodies with separate velocity fields: no approach, Coulomb friction, free separation.

Each body is scattered to its own window of the grid, like the scenes of a batch. Where windows overlap, two bodies may
have mass at the same node although they are a cell apart. The gap between them there follows from the signed distance
to each undeformed body, evaluated at the material coordinates of the node, X + F^-1 (place - x), where X, F and x are
those of the nearest particle. The node is projected onto the surface of one body, and the distance of this point from
the other body is a gap; the smaller of the two gaps is used, so that edges make contact as early as faces. The normal
is taken at the same point, from the body that has a face there, since the nearest face elsewhere may not be in contact.
Bodies approach by at most the gap in a substep. The floor is a plane that may touch every body.
Sources: Bardenhagen et al. 2001, "An improved contact algorithm for the material point method" (velocity fields);
Kamrin, Rycroft and Nave 2012, "Reference map technique for finite-strain elasticity and fluid-solid interaction"
(distances by material coordinates); Nairn, Hammerquist and Smith 2020, "New material point method contact algorithms
for improved accuracy, large-deformation problems, and proper null-space filtering" (gaps from particles, not masses).
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.mpm.constitutive import SAND
from stages.core.kernels.mpm.grid import BLOCK, MpmGrid, NodeArrays, apply_walls, coulomb_contact, first_node
from stages.core.kernels.mpm.transfers import FREE, LOST, ParticleArrays, Substep

# Height above the floor or a held body up to which nodes are stopped [cells]. A larger value takes more energy out of
# an impact, a smaller one lets bodies sink further. It was chosen together with CONTACT_FLOOR_GAP (solver.py) on a
# tower of six, the rebound of a box and a slide.
STATIC_REACH = 0.25
CLEARLY = 1e-3  # difference of the lengths of two normals that is larger than rounding errors
# number of substeps for which the nearest particle of each node is kept; particles move little of a cell in one substep
REFRESH = 4
FLOOR_REST = 0.1  # gap above the floor at which bodies stop [cells]; the balls of a heap then sink by .17
SWEEPS = 2  # sweeps over the pairs of bodies at a node with more than two bodies
BLOCK_NODES = wp.constant(BLOCK**3)
NONE = wp.constant(wp.int64(2**62))  # key of a node without particles
ROW = wp.constant(wp.int64(2**32))  # a key is the squared distance of the nearest particle times ROW, plus its row
FINENESS = 2.0**24  # units of squared distance in keys [1/cell^2]


@wp.struct
class ContactBodies:
    """Signed distance fields of the undeformed bodies, each on its own lattice, and their friction."""

    texels: wp.array[wp.vec4]  # gradient and signed distance [m] at the lattice points of all bodies
    first: wp.array[int]  # first texel of each body
    size: wp.array[wp.vec3i]  # lattice points along each axis
    origin: wp.array[wp.vec3]  # material coordinates of the first texel [m]
    spacing: wp.array[float]  # distance between lattice points [m]
    friction: wp.array[float]  # Coulomb coefficient
    all: wp.array[int]  # indices of all bodies: 0, 1, ...


@wp.struct
class TouchingBlocks:
    """Blocks that may have contact, each with the bodies `present[starts[b] : starts[b + 1]]`."""

    corners: wp.array[int]  # first node of each block
    starts: wp.array[int]
    present: wp.array[int]  # bodies


@wp.struct
class ContactPatch:
    """A body in the neighbourhood of a node, linearised about its particle nearest to the node."""

    body: int
    node: int  # index over the grids of all bodies
    place: wp.vec3  # position of the node [m]
    held: bool
    x: wp.vec3  # position of the particle [m]
    X: wp.vec3  # material coordinates of the particle [m]
    inverse: wp.mat33  # inverse of the particle's deformation gradient
    radius: float  # radius of a grain [m]; 0 if the body keeps its surface


@wp.func
def _patch(rows: ParticleArrays, key: wp.int64, body: int, node: int, place: wp.vec3) -> ContactPatch:
    p = int(key % ROW)
    out = ContactPatch()
    out.body = body
    out.node = node
    out.place = place
    out.held = int(rows.held[p]) != FREE
    out.x = rows.x[p]
    out.X = rows.rest[p]
    out.inverse = wp.inverse(rows.F[p])
    if int(rows.model[p]) >= SAND:  # sand and snow flow and break, so any particle may reach the surface
        out.radius = wp.pow(0.75 / wp.pi * rows.volume[p], 1.0 / 3.0)
    return out


@wp.func
def shape_at(bodies: ContactBodies, body: int, X: wp.vec3) -> wp.vec4:
    """Gradient and signed distance [m] of an undeformed body at material coordinates X [m]."""
    n = bodies.size[body]
    h = bodies.spacing[body]
    g = (X - bodies.origin[body]) / h
    c = wp.vec3()
    f = wp.vec3i()
    for axis in range(3):
        c[axis] = wp.clamp(g[axis], 0.0, float(n[axis] - 1))
        f[axis] = wp.min(int(c[axis]), n[axis] - 2)
    out = wp.vec4()
    for corner in range(8):
        a = corner // 4
        b = (corner // 2) % 2
        d = corner % 2
        w = wp.abs(float(1 - a) - c[0] + float(f[0])) * wp.abs(float(1 - b) - c[1] + float(f[1]))
        w *= wp.abs(float(1 - d) - c[2] + float(f[2]))
        out += w * bodies.texels[bodies.first[body] + ((f[0] + a) * n[1] + f[1] + b) * n[2] + f[2] + d]
    out[3] += h * wp.length(g - c)
    return out


@wp.func
def surface_at(bodies: ContactBodies, near: ContactPatch, place: wp.vec3) -> wp.vec4:
    """Outward normal and signed distance [m] of a body at `place`; the normal is shorter at edges than at faces."""
    arm = place - near.x
    if near.radius > 0.0:
        length = wp.length(arm)
        normal = 0.5 * arm / wp.max(length, 1e-12)  # short, as at an edge: a body that has a surface takes precedence
        return wp.vec4(normal[0], normal[1], normal[2], length - near.radius)
    s = shape_at(bodies, near.body, near.X + near.inverse * arm)
    gradient = wp.vec3(s[0], s[1], s[2])
    turned = wp.transpose(near.inverse) * gradient
    stretch = wp.max(wp.length(turned) / wp.max(wp.length(gradient), 1e-12), 1e-12)
    turned = turned / stretch
    return wp.vec4(turned[0], turned[1], turned[2], s[3] / stretch)


@wp.func
def _on_surface(s: wp.vec4, place: wp.vec3) -> wp.vec3:
    """Projection of a point onto the surface whose normal and signed distance there are `s`."""
    return place - s[3] * wp.normalize(wp.vec3(s[0], s[1], s[2]))


@wp.func
def _contact_normal(other: wp.vec4, own: wp.vec4) -> wp.vec3:
    """Unit contact normal at a point on the surface of the own body, pointing out of the other body.

    `other` and `own` are the normals and signed distances of both bodies at that point. The opposite of the own normal
    is used if it is clearly longer, which means that the other body has an edge there and the own body a face.
    """
    out = wp.vec3(other[0], other[1], other[2])
    back = wp.vec3(own[0], own[1], own[2])
    return wp.normalize(wp.where(wp.length(back) > wp.length(out) + CLEARLY, -back, out))


@wp.func
def _resolve_pair(
    grid: MpmGrid, bodies: ContactBodies, velocity: wp.array[wp.vec4], a: ContactPatch, b: ContactPatch, dt: float
):
    """Limit the approach of two bodies at a node to their gap, with friction; conserves momentum."""
    place = a.place
    u = velocity[a.node]
    v = velocity[b.node]
    if u[3] <= 0.0 or v[3] <= 0.0:
        return
    of_a = surface_at(bodies, a, place)
    of_b = surface_at(bodies, b, place)
    if (a.held and of_a[3] > STATIC_REACH * grid.dx) or (b.held and of_b[3] > STATIC_REACH * grid.dx):
        return
    on_a = _on_surface(of_a, place)
    on_b = _on_surface(of_b, place)
    at_a = surface_at(bodies, a, on_b)
    at_b = surface_at(bodies, b, on_a)
    normal = wp.vec3()
    if at_a[3] <= at_b[3]:
        normal = _contact_normal(at_a, surface_at(bodies, b, on_b))
    else:
        normal = -_contact_normal(at_b, surface_at(bodies, a, on_a))
    free = wp.max(wp.min(at_a[3], at_b[3]), 0.0) / dt * normal
    relative = wp.vec3(u[0] - v[0], u[1] - v[1], u[2] - v[2]) - free
    change = relative - coulomb_contact(relative, -normal, wp.max(bodies.friction[a.body], bodies.friction[b.body]))
    if wp.dot(change, normal) <= 0.0:
        return
    share = v[3] / (u[3] + v[3])
    more = 1.0 - share
    velocity[a.node] = wp.vec4(u[0] - share * change[0], u[1] - share * change[1], u[2] - share * change[2], u[3])
    velocity[b.node] = wp.vec4(v[0] + more * change[0], v[1] + more * change[1], v[2] + more * change[2], v[3])


@wp.func
def _resolve_floor(grid: MpmGrid, bodies: ContactBodies, velocity: wp.array[wp.vec4], a: ContactPatch, dt: float):
    """Limit the approach of a body to the floor at a node, with friction."""
    place = a.place
    of_a = surface_at(bodies, a, place)
    at_a = surface_at(bodies, a, wp.vec3(place[0], place[1], grid.face_low[2]))
    gap = wp.min(at_a[3], _on_surface(of_a, place)[2] - grid.face_low[2]) - FLOOR_REST * grid.dx
    u = velocity[a.node]
    free = wp.vec3(0.0, 0.0, -wp.max(gap, 0.0) / dt)
    v = free + coulomb_contact(wp.vec3(u[0], u[1], u[2]) - free, wp.vec3(0.0, 0.0, 1.0), bodies.friction[a.body])
    velocity[a.node] = wp.vec4(v[0], v[1], v[2], u[3])


@wp.func
def may_touch(grid: MpmGrid, sharers: wp.array[int], i: int, j: int, k: int) -> bool:
    """Whether the block of a node may have contact: it has several bodies (`sharers` per block) or is at the floor."""
    at = ((i // BLOCK) * (grid.nodes[1] // BLOCK) + j // BLOCK) * (grid.nodes[2] // BLOCK) + k // BLOCK
    return sharers[at] > 1 or float(k - k % BLOCK) <= (grid.face_low[2] - grid.origin[2]) / grid.dx + STATIC_REACH


@wp.func
def resolve_node(
    grid: MpmGrid, rows: ParticleArrays, bodies: ContactBodies, nodes: NodeArrays, present: wp.array[int],
    at: wp.vec3i, step: Substep,
):  # fmt: skip
    """Resolve contact at node `at` between the bodies of `present` with particles near it, and with the floor."""
    node = (at[0] * grid.nodes[1] + at[1]) * grid.nodes[2] + at[2]
    place = grid.origin + grid.dx * wp.vec3(float(at[0]), float(at[1]), float(at[2]))
    here = int(0)
    for p in range(present.shape[0]):
        here += wp.where(nodes.nearest[present[p] * grid.count + node] < NONE, 1, 0)
    for _ in range(wp.where(here > 2, SWEEPS, wp.where(here > 1, 1, 0))):
        for p in range(present.shape[0]):
            own = present[p] * grid.count + node
            key = nodes.nearest[own]
            if key < NONE:
                a = _patch(rows, key, present[p], own, place)
                for q in range(p + 1, present.shape[0]):
                    other = present[q] * grid.count + node
                    theirs = nodes.nearest[other]
                    if theirs < NONE:
                        b = _patch(rows, theirs, present[q], other, place)
                        _resolve_pair(grid, bodies, nodes.velocity, a, b, step.dt)
    at_floor = place[2] - grid.face_low[2] <= STATIC_REACH * grid.dx
    for p in range(present.shape[0]):
        own = present[p] * grid.count + node
        key = nodes.nearest[own]
        if key < NONE:
            if step.forget > 0:
                nodes.nearest[own] = NONE
            if at_floor:
                _resolve_floor(grid, bodies, nodes.velocity, _patch(rows, key, present[p], own, place), step.dt)
            if here > 1:
                w = nodes.velocity[own]
                inside = apply_walls(grid, at, wp.vec3(w[0], w[1], w[2]), nodes.friction[own])
                nodes.velocity[own] = wp.vec4(inside[0], inside[1], inside[2], w[3])


@wp.kernel(enable_backward=False)
def find_nearest(grid: MpmGrid, rows: ParticleArrays, sharers: wp.array[int], nearest: wp.array[wp.int64]):
    """Find the nearest particle of each body for the nodes of blocks that may have contact.

    Takes the minimum of the nodes' keys `nearest` and the particle's key, so the order of the particles does not
    matter.
    """
    p = wp.tid()
    if int(rows.held[p]) == LOST:
        return
    g = (rows.x[p] - grid.origin) / grid.dx
    base = first_node(g)
    block = wp.vec3i(base[0] // BLOCK, base[1] // BLOCK, base[2] // BLOCK)
    last = wp.vec3i((base[0] + 2) // BLOCK, (base[1] + 2) // BLOCK, (base[2] + 2) // BLOCK)
    near = int(0)  # a bit for each of up to eight blocks
    for a in range(block[0], last[0] + 1):
        for b in range(block[1], last[1] + 1):
            for c in range(block[2], last[2] + 1):
                if may_touch(grid, sharers, a * BLOCK, b * BLOCK, c * BLOCK):
                    near |= 1 << (4 * (a - block[0]) + 2 * (b - block[1]) + c - block[2])
    if near == 0:
        return
    window = rows.scene[p] * grid.count
    for n in range(27):
        i = base[0] + n // 9
        j = base[1] + (n // 3) % 3
        k = base[2] + n % 3
        bit = 4 * (i // BLOCK - block[0]) + 2 * (j // BLOCK - block[1]) + k // BLOCK - block[2]
        if (near >> bit) & 1 > 0:
            d = g - wp.vec3(float(i), float(j), float(k))
            key = wp.int64(int(wp.dot(d, d) * FINENESS)) * ROW + wp.int64(p)
            wp.atomic_min(nearest, window + (i * grid.nodes[1] + j) * grid.nodes[2] + k, key)


@wp.kernel(enable_backward=False)
def contact_step(
    grid: MpmGrid, rows: ParticleArrays, bodies: ContactBodies, nodes: NodeArrays, blocks: TouchingBlocks, step: Substep
):
    """Resolve contact at one node of a block."""
    b = wp.tid() // BLOCK_NODES
    n = wp.tid() % BLOCK_NODES
    stride_y = grid.nodes[2]
    stride_x = grid.nodes[1] * stride_y
    corner = blocks.corners[b]
    i = corner // stride_x + n // (BLOCK * BLOCK)
    j = (corner // stride_y) % grid.nodes[1] + (n // BLOCK) % BLOCK
    k = corner % stride_y + n % BLOCK
    present = blocks.present[blocks.starts[b] : blocks.starts[b + 1]]
    resolve_node(grid, rows, bodies, nodes, present, wp.vec3i(i, j, k), step)
