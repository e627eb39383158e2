"""MLS-MPM with APIC transfers and quadratic B-splines for batches of scenes: code shared by both launch orders.

`fused` does a whole substep in one launch, which is fastest on a GPU. `split` launches particles and grid in turn,
which is fastest on a CPU, because mass division and walls are evaluated once per node instead of 27 times per particle.

The grids are dense in memory, but only blocks of 4 x 4 x 4 nodes near particles are read, written and cleared.

Source: Hu et al. 2018, "A Moving Least Squares Material Point Method", eq. 16-18 and its 88-line code;
Jiang et al. 2015, "The Affine Particle-In-Cell Method"; Jiang et al. 2017, "An angular momentum conserving affine
particle-in-cell method" (RPIC damping).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.mpm.constitutive import branch_stress, branch_update
from stages.core.kernels.mpm.grid import BLOCK, MpmGrid, first_node, stencil_inside
from stages.core.kernels.mpm.nodes import mat43

KINEMATIC_MASS_FACTOR = 1e4  # mass factor of kinematic particles on the grid, so that they impose their velocity
# Values of `held`. FREE: moved by the grid; KINEMATIC: moved by its own velocity; LOST: outside the grid; PINNED: as
# KINEMATIC, but not scattered to the grid, where the velocities of nodes are set instead (pins.py).
FREE, KINEMATIC, LOST, PINNED = 0, 1, 2, 3


class Features(NamedTuple):
    """Features that a kernel needs besides neo-Hookean elasticity."""

    plastic: bool  # other material models
    viscoelastic: bool  # Maxwell branches
    restitution: bool  # of floor, walls or obstacles


@wp.struct
class ParticleArrays:
    """Particles of all scenes, sorted by cell."""

    count: int
    x: wp.array[wp.vec3]  # [m]
    rest: wp.array[wp.vec3]  # material coordinates: position in the undeformed body [m]
    v: wp.array[wp.vec3]  # [m/s]
    C: wp.array[wp.mat33]  # APIC velocity gradient [1/s]
    F: wp.array[wp.mat33]  # deformation gradient, elastic part
    mass: wp.array[float]  # [kg]
    volume: wp.array[float]  # undeformed volume [m^3]
    stiffness: wp.array[wp.vec3]  # mu, lambda [Pa], eta [Pa s]
    friction: wp.array[float]
    held: wp.array[wp.int8]
    model: wp.array[wp.int8]  # see constitutive.py, also for `plastic` and `state`
    plastic: wp.array[wp.vec3]
    state: wp.array[float]
    branch_modulus: wp.array[wp.vec2]  # see constitutive.py, also for `branch_rate` and `branch_strain`
    branch_rate: wp.array[wp.vec2]  # [1/s]
    branch_strain: wp.array2d[wp.mat33]
    acceleration: wp.array[wp.vec3]  # due to external forces [m/s^2]
    scene: wp.array[int]
    order: wp.array[int]  # original row
    base_node: wp.array[wp.vec3i]  # first node of the stencil when the list of blocks was made
    lost: wp.array[int]  # per scene: lowest `order` of its lost particles


@wp.struct
class ParticleUpdate:
    """State of a particle within a substep; `alive` is False once it has left the grid."""

    x: wp.vec3
    v: wp.vec3
    C: wp.mat33
    F: wp.mat33
    tau: wp.mat33  # Kirchhoff stress without damping [Pa]
    alive: bool


@wp.struct
class Substep:
    """Length of a substep, and the parts of it to carry out."""

    dt: float  # [s]
    clock: wp.array[float]  # time since the start of the frame [s], for moving obstacles; unused by the fused order
    gather: int  # 1: particles gather velocities from the grid (G2P) and move
    scatter: int  # 1: particles scatter momentum and stress (P2G) for the next substep
    forget: int  # 1: clear the nearest particles of nodes, so that find_nearest must follow


def substep(dt: float, gather: int = 0, scatter: int = 0, clock: wp.array | None = None, forget: int = 0) -> Substep:
    """Return a Substep with these values."""
    step = Substep()
    step.dt, step.gather, step.scatter, step.clock, step.forget = dt, gather, scatter, clock, forget
    return step


@wp.func
def advance_free(grid: MpmGrid, x: wp.vec3, F: wp.mat33, s: mat43, dt: float) -> ParticleUpdate:
    """Advance a free particle by `dt` [s] with the G2P stencil sums `s`; it is lost if it would leave the grid."""
    out = ParticleUpdate()
    k = 4.0 / grid.dx
    out.v = wp.vec3(s[0, 0], s[0, 1], s[0, 2])
    out.C = wp.mat33(k * s[1, 0], k * s[2, 0], k * s[3, 0], k * s[1, 1], k * s[2, 1], k * s[3, 1],
                     k * s[1, 2], k * s[2, 2], k * s[3, 2])  # fmt: skip
    out.x = x + dt * out.v
    out.F = F + dt * (out.C * F)
    out.alive = stencil_inside(grid, (out.x - grid.origin) / grid.dx)
    if not out.alive:
        return lost_particle(x, F)
    return out


@wp.func
def lost_particle(x: wp.vec3, F: wp.mat33) -> ParticleUpdate:
    """State of a lost particle: it stays where it is and is not scattered."""
    out = ParticleUpdate()
    out.x = x
    out.F = F
    out.alive = False
    return out


@wp.func
def advance_kinematic(grid: MpmGrid, x: wp.vec3, v: wp.vec3, C: wp.mat33, F: wp.mat33, dt: float) -> ParticleUpdate:
    """Advance a kinematic particle by `dt` [s] at its own velocity; dt = 0 returns its current state."""
    out = ParticleUpdate()
    out.x = x + dt * v
    out.v = v
    out.C = C
    out.F = F
    out.alive = stencil_inside(grid, (out.x - grid.origin) / grid.dx)
    if not out.alive:
        return lost_particle(x, F)
    return out


@wp.func
def mark_lost(held: wp.array[wp.int8], lost: wp.array[int], i: int, scene: int, order: int):
    """Mark particle i as lost, and keep the lowest original row of the scene's lost particles."""
    held[i] = wp.int8(LOST)
    wp.atomic_min(lost, scene, order)


@wp.func
def affine_momentum(
    grid: MpmGrid, rows: ParticleArrays, i: int, now: ParticleUpdate, held: int, dt: float
) -> wp.mat44:  # fmt: skip
    """P2G contribution of particle i: row 0 is momentum and mass, rows 1 to 3 their change per cell along x, y, z.

    Consists of the APIC momentum with RPIC damping, and the MLS-MPM stress impulse over `dt` [s].
    """
    m = rows.mass[i]
    both = now.C + wp.transpose(now.C)
    tau = now.tau + rows.stiffness[i][2] * both  # read again: keeping it since the stress update would cost a register
    A = (grid.dx * m) * (now.C - (0.5 * grid.damping) * both) - (dt * 4.0 / grid.dx * rows.volume[i]) * tau
    q = m * (now.v + dt * rows.acceleration[i])
    if held != FREE:
        m = wp.where(held == PINNED, 0.0, m * KINEMATIC_MASS_FACTOR)
        q = m * now.v
        A = wp.mat33()
    return wp.mat44(q[0], q[1], q[2], m, A[0, 0], A[1, 0], A[2, 0], 0.0, A[0, 1], A[1, 1], A[2, 1], 0.0,
                    A[0, 2], A[1, 2], A[2, 2], 0.0)  # fmt: skip


@wp.func
def relax(rows: ParticleArrays, i: int, now: ParticleUpdate, stiffness: wp.vec3, dt: float) -> wp.mat33:
    """Advance the strains of the Maxwell branches of particle i by `dt` [s]; return their Kirchhoff stress [Pa]."""
    modulus = rows.branch_modulus[i]
    rate = rows.branch_rate[i]
    together = wp.mat33()
    for n in range(2):
        e = branch_update(rows.branch_strain[i, n], now.C, rate[n], dt)
        rows.branch_strain[i, n] = e
        together += modulus[n] * e
    return branch_stress(together, stiffness)


@wp.kernel(enable_backward=False)
def sort_keys(grid: MpmGrid, rows: ParticleArrays, keys: wp.array[int]):
    """Compute sort keys by scene, block, and cell within the block, for memory locality; lost particles come last."""
    i = wp.tid()
    if rows.held[i] == wp.int8(LOST):
        keys[i] = 2147483647
        return
    b = first_node((rows.x[i] - grid.origin) / grid.dx)
    n = wp.vec3i(grid.nodes[0] // BLOCK, grid.nodes[1] // BLOCK, grid.nodes[2] // BLOCK)
    block = ((rows.scene[i] * n[0] + b[0] // BLOCK) * n[1] + b[1] // BLOCK) * n[2] + b[2] // BLOCK
    keys[i] = ((block * BLOCK + b[0] % BLOCK) * BLOCK + b[1] % BLOCK) * BLOCK + b[2] % BLOCK


def substep_reference(
    rows: dict[str, Tensor], grid: MpmGrid, friction: float, dt: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """One substep of `dt` [s] of free neo-Hookean particles in PyTorch, which specifies the kernels.

    `rows` holds x, v, C, F, mass, volume, stiffness, acceleration and the columns of the Maxwell branches as in
    ParticleArrays; `friction` is that of floor and walls. Returns x, v, C, F.
    """
    v, C, F, mass, volume, stiffness = (rows[k] for k in ("v", "C", "F", "mass", "volume", "stiffness"))
    dx, nodes, origin = grid.dx, tuple(grid.nodes), torch.tensor(list(grid.origin)).to(v)
    x = rows["x"] - origin
    offsets = torch.cartesian_prod(*[torch.arange(3)] * 3)
    base = (x / dx - 0.5).floor().long()
    fx = x / dx - base
    w = torch.stack([0.5 * (1.5 - fx) ** 2, 0.75 - (fx - 1) ** 2, 0.5 * (fx - 0.5) ** 2], 1)  # p 3nodes 3axes
    weight = w[:, offsets[:, 0], 0] * w[:, offsets[:, 1], 1] * w[:, offsets[:, 2], 2]
    offset = (offsets - fx[:, None]) * dx  # p 27 3
    ijk = base[:, None] + offsets
    flat = (ijk[..., 0] * nodes[1] + ijk[..., 1]) * nodes[2] + ijk[..., 2]

    one = torch.eye(3).to(F)
    J = torch.linalg.det(F).clamp_min(0.05)
    tau = stiffness[:, 0, None, None] * (F @ F.mT - one) + (stiffness[:, 1] * J.log())[:, None, None] * one
    tau = tau + stiffness[:, 2, None, None] * (C + C.mT)
    e = (rows["branch_modulus"][..., None, None] * rows["branch_strain"]).sum(1)
    trace = e.diagonal(dim1=1, dim2=2).sum(1)
    tau = tau + stiffness[:, 0, None, None] * e + (stiffness[:, 1] * trace / 2)[:, None, None] * one
    A = mass[:, None, None] * C - (dt * volume * 4 / dx**2)[:, None, None] * tau
    momentum = (mass[:, None] * (v + dt * rows["acceleration"]))[:, None] + torch.einsum("pab,pnb->pna", A, offset)
    count = nodes[0] * nodes[1] * nodes[2]
    grid_m = torch.zeros(count).to(x).index_add(0, flat.flatten(), (weight * mass[:, None]).flatten())
    grid_v = torch.zeros(count, 3).to(x).index_add(0, flat.flatten(), (weight[..., None] * momentum).flatten(0, 1))
    grid_v = grid_v / grid_m.clamp_min(1e-30)[:, None]

    at = torch.cartesian_prod(*[torch.arange(n) for n in nodes])
    for axis, sign, hit in [(a, s, at[:, a] <= grid.low[a] if s > 0 else at[:, a] >= grid.high[a]) for a in (2, 1, 0)
                            for s in (1.0, -1.0)]:  # fmt: skip
        across = sign * grid_v[:, axis]
        along = grid_v.clone()
        along[:, axis] = 0
        speed = along.norm(dim=1)
        keep = ((speed + friction * across) / speed.clamp_min(1e-30)).clamp_min(0)
        grid_v = torch.where((hit & (across < 0))[:, None], along * keep[:, None], grid_v)

    near = grid_v[flat]
    v = (weight[..., None] * near).sum(1)
    C = 4 / dx**2 * torch.einsum("pn,pna,pnb->pab", weight, near, offset)
    return rows["x"] + dt * v, v, C, F + dt * C @ F
