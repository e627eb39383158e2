"""Moving particles on a grid: MLS-MPM with APIC transfers and quadratic B-splines.

A step is two launches. `particle_step` gathers velocities from the grid, moves the particles and scatters their
momentum and stress for the next step; `grid_step` turns momentum into velocity and applies floor and walls.
The grid is dense in memory, but only blocks of 4x4x4 nodes that particles can reach are read, written and cleared.

Several CPU threads may scatter at once, each into its own copy of the momentum; a block knows which copies it needs.

Source: Hu et al. 2018, "A Moving Least Squares Material Point Method", eq. 16-18 and its 88-line code;
Jiang et al. 2015, "The Affine Particle-In-Cell Method".
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from stages.kernels.mpm_nodes import gather_nodes, scatter_nodes, velocity_of_row

BLOCK = 4  # nodes along the edge of a block
PAD = 4  # nodes outside the walls on every side: room for the stencil of a particle pressed into a wall
HELD = 1e4  # a held particle weighs this much more on the grid, so that others stop at it
STALE, LOST = 0, 1  # slots of the alarm

@wp.struct
class Grid:
    """Node (i, j, k) lies at origin + dx (i, j, k) and is number (i ny + j) nz + k."""

    origin: wp.vec3
    dx: float
    nodes: wp.vec3i  # multiples of BLOCK
    low: wp.vec3i  # first node inside the walls; nodes up to and including `low` feel the wall
    high: wp.vec3i


@wp.func
def _weights(fx: wp.vec3) -> wp.mat33:
    """Quadratic B-spline: rows are axes; fx in [0.5, 1.5) is the distance to the first node."""
    w = wp.mat33()
    for axis in range(3):
        f = fx[axis]
        w[axis, 0] = 0.5 * (1.5 - f) * (1.5 - f)
        w[axis, 1] = 0.75 - (f - 1.0) * (f - 1.0)
        w[axis, 2] = 0.5 * (f - 0.5) * (f - 0.5)
    return w


@wp.func
def _kirchhoff(F: wp.mat33, rate: wp.mat33, stiffness: wp.vec3) -> wp.mat33:
    """Neo-Hookean with Kelvin-Voigt damping: tau = mu (F F^T - I) + lambda log(J) I + eta (dv/dx + transpose).

    `stiffness` is mu, lambda, eta. An inverted J counts as nearly flat, so that tau stays finite.
    Source: Bonet and Wood 2008, "Nonlinear Continuum Mechanics for Finite Element Analysis", eq. 6.29.
    """
    J = wp.max(wp.determinant(F), 0.05)
    one = wp.identity(n=3, dtype=float)
    elastic = stiffness[0] * (F * wp.transpose(F) - one) + stiffness[1] * wp.log(J) * one
    return elastic + stiffness[2] * (rate + wp.transpose(rate))


@wp.kernel
def particle_step(
    grid: Grid, start: int, gather: int, scatter: int, dt: float,
    velocity: wp.array[wp.vec4], momentum: wp.array[wp.vec4], copy: int,
    x: wp.array[wp.vec3], v: wp.array[wp.vec3], C: wp.array[wp.mat33], F: wp.array[wp.mat33],
    mass: wp.array[float], volume: wp.array[float], stiffness: wp.array[wp.vec3], push: wp.array[wp.vec3],
    held: wp.array[wp.int8], home: wp.array[wp.vec3i], alarm: wp.array[int],
):  # fmt: skip
    """Particles start + tid. `copy` is the first node of the momentum copy to scatter into; `push` an acceleration."""
    i = start + wp.tid()
    stride_y = grid.nodes[2]
    stride_x = grid.nodes[1] * grid.nodes[2]
    p = x[i]
    vel = v[i]
    B = C[i]
    Fi = F[i]
    inverse = 1.0 / grid.dx
    if gather > 0 and held[i] == wp.int8(0):
        g = (p - grid.origin) * inverse
        base = wp.vec3i(int(g[0] - 0.5), int(g[1] - 0.5), int(g[2] - 0.5))
        fx = wp.vec3(g[0] - float(base[0]), g[1] - float(base[1]), g[2] - float(base[2]))
        # a particle out of bounds was reported when it got there, and scattered nothing
        if base[0] >= 0 and base[0] <= grid.nodes[0] - 4 and base[1] >= 0 and base[1] <= grid.nodes[1] - 4 and \
                base[2] >= 0 and base[2] <= grid.nodes[2] - 4:
            first = base[0] * stride_x + base[1] * stride_y + base[2]
            s = gather_nodes(velocity, first, stride_x, stride_y, _weights(fx), fx)
            vel = wp.vec3(s[0, 0], s[0, 1], s[0, 2])
            k = 4.0 * inverse
            B = wp.mat33(k * s[1, 0], k * s[2, 0], k * s[3, 0], k * s[1, 1], k * s[2, 1], k * s[3, 1],
                         k * s[1, 2], k * s[2, 2], k * s[3, 2])  # fmt: skip
            p = p + dt * vel
            Fi = Fi + dt * (B * Fi)
            x[i] = p
            v[i] = vel
            C[i] = B
            F[i] = Fi
    if scatter > 0:
        g = (p - grid.origin) * inverse
        top = wp.vec3(float(grid.nodes[0] - 4), float(grid.nodes[1] - 4), float(grid.nodes[2] - 4))
        if not (g[0] >= 1.0 and g[0] < top[0] and g[1] >= 1.0 and g[1] < top[1] and g[2] >= 1.0 and g[2] < top[2]):
            alarm[LOST] = i + 1  # also when a coordinate is not a number
            return
        base = wp.vec3i(int(g[0] - 0.5), int(g[1] - 0.5), int(g[2] - 0.5))
        fx = wp.vec3(g[0] - float(base[0]), g[1] - float(base[1]), g[2] - float(base[2]))
        if wp.max(wp.max(wp.abs(base[0] - home[i][0]), wp.abs(base[1] - home[i][1])), wp.abs(base[2] - home[i][2])) > 1:
            alarm[STALE] = 1
        m = mass[i]
        A = m * B - (dt * volume[i] * 4.0 * inverse * inverse) * _kirchhoff(Fi, B, stiffness[i])
        A = A * grid.dx
        q = m * (vel + dt * push[i])
        if held[i] != wp.int8(0):
            m = m * HELD
            q = wp.vec3()
            A = wp.mat33()
        affine = wp.mat44(q[0], q[1], q[2], m, A[0, 0], A[1, 0], A[2, 0], 0.0, A[0, 1], A[1, 1], A[2, 1], 0.0,
                          A[0, 2], A[1, 2], A[2, 2], 0.0)  # fmt: skip
        first = copy + base[0] * stride_x + base[1] * stride_y + base[2]
        scatter_nodes(momentum, first, stride_x, stride_y, _weights(fx), fx, affine)


@wp.func
def _contact(v: wp.vec3, normal: wp.vec3, friction: float) -> wp.vec3:
    """Velocity after a wall with unit `normal` (into the box) stops what moves into it.

    Coulomb: the change along the wall is at most friction x the change across it, whatever the time step.
    """
    across = wp.dot(v, normal)
    if across >= 0.0:
        return v
    along = v - across * normal
    speed = wp.length(along)
    if speed <= -friction * across:
        return wp.vec3()
    return along * (1.0 + friction * across / speed)


@wp.kernel
def grid_step(
    grid: Grid, start: int, momentum: wp.array[wp.vec4], velocity: wp.array[wp.vec4], friction: wp.array[float],
    blocks: wp.array[wp.vec2i],
):  # fmt: skip
    """One row of four nodes of an active block; `blocks` holds the block's first node and which copies it needs."""
    t = start + wp.tid()
    block = blocks[t // (BLOCK * BLOCK)]
    row = t % (BLOCK * BLOCK)
    stride_y = grid.nodes[2]
    stride_x = grid.nodes[1] * stride_y
    corner = block[0]
    i = corner // stride_x + row // BLOCK
    j = (corner // stride_y) % grid.nodes[1] + row % BLOCK
    k = corner % stride_y
    first = i * stride_x + j * stride_y + k
    velocity_of_row(momentum, velocity, first, grid.nodes[0] * stride_x, block[1])
    inside = i > grid.low[0] and i < grid.high[0] and j > grid.low[1] and j < grid.high[1]
    if inside and k > grid.low[2] and k + BLOCK <= grid.high[2]:
        return
    for n in range(BLOCK):
        u = velocity[first + n]
        v = wp.vec3(u[0], u[1], u[2])
        mu = friction[first + n]
        if k + n <= grid.low[2]:
            v = _contact(v, wp.vec3(0.0, 0.0, 1.0), mu)
        if k + n >= grid.high[2]:
            v = _contact(v, wp.vec3(0.0, 0.0, -1.0), mu)
        if j <= grid.low[1]:
            v = _contact(v, wp.vec3(0.0, 1.0, 0.0), mu)
        if j >= grid.high[1]:
            v = _contact(v, wp.vec3(0.0, -1.0, 0.0), mu)
        if i <= grid.low[0]:
            v = _contact(v, wp.vec3(1.0, 0.0, 0.0), mu)
        if i >= grid.high[0]:
            v = _contact(v, wp.vec3(-1.0, 0.0, 0.0), mu)
        velocity[first + n] = wp.vec4(v[0], v[1], v[2], u[3])


@wp.kernel
def mark_blocks(
    grid: Grid, start: int, bit: int, x: wp.array[wp.vec3], home: wp.array[wp.vec3i], marks: wp.array3d[int]
):
    """Blocks that a particle reaches while it stays within one cell of where it is now."""
    i = start + wp.tid()
    g = (x[i] - grid.origin) / grid.dx
    base = wp.vec3i(int(g[0] - 0.5), int(g[1] - 0.5), int(g[2] - 0.5))
    home[i] = base
    lo = wp.vec3i(wp.max(base[0] - 1, 0), wp.max(base[1] - 1, 0), wp.max(base[2] - 1, 0))
    hi = wp.vec3i(wp.min(base[0] + 3, grid.nodes[0] - 1), wp.min(base[1] + 3, grid.nodes[1] - 1),
                  wp.min(base[2] + 3, grid.nodes[2] - 1))  # fmt: skip
    for a in range(lo[0] // BLOCK, hi[0] // BLOCK + 1):
        for b in range(lo[1] // BLOCK, hi[1] // BLOCK + 1):
            for c in range(lo[2] // BLOCK, hi[2] // BLOCK + 1):
                if marks[a, b, c] & bit == 0:
                    wp.atomic_or(marks, a, b, c, bit)


@wp.kernel
def mark_friction(grid: Grid, x: wp.array[wp.vec3], mu: wp.array[float], friction: wp.array[float]):
    """Nodes at floor and walls take the largest friction coefficient among the particles that may touch them."""
    i = wp.tid()
    g = (x[i] - grid.origin) / grid.dx
    base = wp.vec3i(int(g[0] - 0.5), int(g[1] - 0.5), int(g[2] - 0.5))
    near = bool(False)  # noqa: UP018 -- Warp takes a literal for a constant
    for axis in range(3):
        near = near or base[axis] <= grid.low[axis] + 2 or base[axis] + 4 >= grid.high[axis]
    if not near:
        return
    for a in range(wp.max(base[0] - 1, 0), wp.min(base[0] + 4, grid.nodes[0])):
        for b in range(wp.max(base[1] - 1, 0), wp.min(base[1] + 4, grid.nodes[1])):
            for c in range(wp.max(base[2] - 1, 0), wp.min(base[2] + 4, grid.nodes[2])):
                wp.atomic_max(friction, (a * grid.nodes[1] + b) * grid.nodes[2] + c, mu[i])


def substep_reference(
    x: Tensor, v: Tensor, C: Tensor, F: Tensor, mass: Tensor, volume: Tensor, stiffness: Tensor, push: Tensor,
    dt: float, dx: float, nodes: tuple[int, int, int], low: Tensor, high: Tensor, friction: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """One whole step in PyTorch, origin 0: the specification of the kernels above. All particles are free.

    x, v, push (p, 3); C, F (p, 3, 3); mass, volume (p); stiffness (p, 3); low, high (3,) node indices of the walls.
    """
    offsets = torch.cartesian_prod(*[torch.arange(3)] * 3)
    base = (x / dx - 0.5).floor().long()
    fx = x / dx - base
    w = torch.stack([0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2], 1)  # p 3nodes 3axes
    weight = w[:, offsets[:, 0], 0] * w[:, offsets[:, 1], 1] * w[:, offsets[:, 2], 2]
    reach = (offsets - fx[:, None]) * dx  # p 27 3
    ijk = base[:, None] + offsets
    flat = (ijk[..., 0] * nodes[1] + ijk[..., 1]) * nodes[2] + ijk[..., 2]

    one = torch.eye(3).to(F)
    J = torch.linalg.det(F).clamp_min(0.05)
    tau = stiffness[:, 0, None, None] * (F @ F.mT - one) + (stiffness[:, 1] * J.log())[:, None, None] * one
    tau = tau + stiffness[:, 2, None, None] * (C + C.mT)
    A = mass[:, None, None] * C - (dt * volume * 4 / dx**2)[:, None, None] * tau
    momentum = (mass[:, None] * (v + dt * push))[:, None] + torch.einsum("pab,pnb->pna", A, reach)
    count = nodes[0] * nodes[1] * nodes[2]
    grid_m = torch.zeros(count).to(x).index_add(0, flat.flatten(), (weight * mass[:, None]).flatten())
    grid_v = torch.zeros(count, 3).to(x).index_add(0, flat.flatten(), (weight[..., None] * momentum).flatten(0, 1))
    grid_v = grid_v / grid_m.clamp_min(1e-30)[:, None]

    at = torch.cartesian_prod(*[torch.arange(n) for n in nodes])
    for axis, sign, hit in [(a, s, at[:, a] <= low[a] if s > 0 else at[:, a] >= high[a]) for a in (2, 1, 0)
                            for s in (1.0, -1.0)]:  # fmt: skip
        across = sign * grid_v[:, axis]
        along = grid_v.clone()
        along[:, axis] = 0
        speed = along.norm(dim=1)
        keep = ((speed + friction * across) / speed.clamp_min(1e-30)).clamp_min(0)
        grid_v = torch.where((hit & (across < 0))[:, None], along * keep[:, None], grid_v)

    near = grid_v[flat]
    v = (weight[..., None] * near).sum(1)
    C = 4 / dx**2 * torch.einsum("pn,pna,pnb->pab", weight, near, reach)
    return x + dt * v, v, C, F + dt * C @ F
