"""MPM solver: deformable bodies of any material in a box with friction, one scene or many independent ones.

Explicit MLS-MPM with APIC transfers in float32; kernels and sources are in core/kernels/mpm/transfers.py. Substeps run
by the schedule of split.py on the CPU and of fused.py on a GPU, with the same physics. batch.py runs named scenes.

Reproducibility: on the CPU a run gives the same bytes for any number of threads. On a GPU floating-point sums depend on
the order of atomic additions, so runs differ in the last bits, unless the schedule is `exact`, which sums in fixed
point. Even then the friction of a node shared by bodies of different friction may change one substep earlier or later,
because threads of the fused kernel raise it while others read it.
The solver is not differentiable.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.kernels.mpm import grid as mpm_grid
from stages.core.kernels.mpm.constitutive import MAX_STIFFENING, NEO_HOOKEAN
from stages.core.kernels.mpm.transfers import KINEMATIC, PINNED, Features
from stages.core.physics.colliders import Collider, as_obstacles
from stages.core.physics.mpm.body_shapes import BodyContact, BodyShape, shape_of_voxels
from stages.core.physics.mpm.contact import ContactSubsteps
from stages.core.physics.mpm.domain import MAX_NODES, Box
from stages.core.physics.mpm.fused import FusedSubsteps
from stages.core.physics.mpm.particle_rows import NEVER, ParticleRows
from stages.core.physics.mpm.pins import Pins
from stages.core.physics.mpm.split import SplitSubsteps

SAFETY = 0.5  # Courant number: fraction of a cell that the fastest wave and particle cross in a substep (substep_rate)
VISCOUS = 0.15  # maximum of dt eta / (density dx^2); violent vibration diverges from 0.3
FLOOR_GAP = mpm_grid.FLOOR_GAP
SCHEDULES = ("auto", "split", "fused", "exact", "contact")
# FLOOR_GAP of the schedule `contact`, where the floor is a contact plane [cells]; see STATIC_REACH in
# kernels/mpm/contact.py
CONTACT_FLOOR_GAP = 0.7
CONTACT_NODE_BYTES = 60  # velocity, fixed-point momentum, friction and nearest particle on a GPU [bytes/node]
SUBSTEP_MULTIPLE = 8  # on a GPU, substeps per frame are a multiple of this, so that few CUDA graphs are captured


class Diverged(Exception):
    """A particle left the box or is not finite; `particle` is its index."""

    def __init__(self, particle: int):
        super().__init__(f"particle {particle} left the box or is not finite")
        self.particle = particle


@dataclass
class Particles:
    """State and material of the particles; rows keep their order."""

    x: Float[Tensor, "p 3"]  # positions [m]
    v: Float[Tensor, "p 3"]  # velocities [m/s]
    rest: Float[Tensor, "p 3"]  # material coordinates: positions in the undeformed body [m]
    C: Float[Tensor, "p 3 3"]  # affine velocity: dv/dx [1/s]
    F: Float[Tensor, "p 3 3"]  # deformation gradient; its elastic part for plastic materials
    mass: Float[Tensor, "p"]  # [kg]
    volume: Float[Tensor, "p"]  # at rest [m^3]
    stiffness: Float[Tensor, "p 3"]  # Lame constants mu, lambda [Pa] and viscosity eta [Pa s]
    friction: Float[Tensor, "p"]  # Coulomb coefficient against floor and walls
    held: Int[Tensor, "p"]  # 1: kinematic, moves with its own velocity; 2: lost, stays in place
    model: Int[Tensor, "p"]  # number of the material model, see core/kernels/mpm/constitutive.py
    plastic: Float[Tensor, "p 3"]  # parameters of the material model
    state: Float[Tensor, "p"]  # internal variable of the material model; initially 0
    # Maxwell branches, none (b = 0) or two; see core/kernels/mpm/constitutive.py
    branch_modulus: Float[Tensor, "p b"]  # relative to the elastic moduli
    branch_rate: Float[Tensor, "p b"]  # relaxation rate [1/s]
    branch_strain: Float[Tensor, "p b 3 3"]  # left Cauchy-Green tensor of the springs, less the identity

    def __len__(self) -> int:
        return len(self.x)


class ParticleMaterial(NamedTuple):
    """Material constants, one value per particle or one for all."""

    E: Float[Tensor, "p"] | float  # Young's modulus [Pa]
    nu: Float[Tensor, "p"] | float  # Poisson ratio
    density: Float[Tensor, "p"] | float  # at rest [kg/m^3]
    viscosity: Float[Tensor, "p"] | float  # [Pa s]
    friction: Float[Tensor, "p"] | float  # Coulomb coefficient against floor and walls


def at_rest(
    x: Float[Tensor, "p 3"], volume: Float[Tensor, "p"] | float, material: ParticleMaterial, model: int = NEO_HOOKEAN,
    plastic: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Particles:  # fmt: skip
    """Undeformed particles at rest at `x` [m], with the given `volume` [m^3] per particle.

    `model` (number of the material model) and `plastic` (its parameters) apply to all; overwrite the fields for a
    mixture.
    """
    p = len(x)
    each = (v if isinstance(v, Tensor) else torch.full((p,), float(v)) for v in (volume, *material))
    volume, E, nu, density, viscosity, friction = each
    still, identity = torch.zeros(p, 3, 3), torch.eye(3).repeat(p, 1, 1)
    stiffness = torch.stack([E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu)), viscosity], -1)
    held, models = torch.zeros(p, dtype=torch.int8), torch.full((p,), model, dtype=torch.int8)
    return Particles(x, torch.zeros(p, 3), x.clone(), still, identity, density * volume, volume, stiffness, friction,
                     held, models, torch.tensor(plastic).repeat(p, 1), torch.zeros(p), torch.zeros(p, 0),
                     torch.zeros(p, 0), torch.zeros(p, 0, 3, 3))  # fmt: skip


def with_branches(
    particles: Particles, modulus: Float[Tensor, "p 2"], rate: Float[Tensor, "p 2"]
) -> Particles:  # fmt: skip
    """The particles with two relaxed Maxwell branches: moduli relative to the elastic ones, relaxation rates [1/s]."""
    return replace(
        particles, branch_modulus=modulus, branch_rate=rate, branch_strain=torch.zeros(len(modulus), 2, 3, 3)
    )


def join_particles(parts: Sequence[Particles]) -> Particles:
    """Concatenate particles."""
    return Particles(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Particles)))


def wave_speed(E, nu, density):
    """Speed of pressure waves, sqrt((lambda + 2 mu) / density) [m/s]; E [Pa], density [kg/m^3]."""
    return (E * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) / density) ** 0.5


def modulus_at_wave_speed(speed: float, nu: float, density: float) -> float:
    """Young's modulus [Pa] at which pressure waves have this `speed` [m/s]: the inverse of wave_speed."""
    return density * speed**2 * (1 + nu) * (1 - 2 * nu) / (1 - nu)


def substep_rate(dx: float, speed: float, viscosity: float = 0.0) -> float:
    """Substeps per second [1/s] at which explicit integration is stable, by the CFL condition.

    `dx` is the grid spacing [m], `speed` the sum of the speeds of the fastest pressure wave and the fastest particle
    [m/s], and `viscosity` eta / density [m^2/s]. The Courant number is SAFETY: free vibration of a block diverges from
    1.1, but falling shells gain energy from 0.7, since boundaries are less stable than the interior. Masses and rest
    volumes are constant, so the density is that at rest. Sources: Sun, Shinar and Schroeder 2020, "Effective time step
    restrictions for explicit MPM simulation"; Bai and Schroeder 2022, "Stability analysis of explicit MPM".
    """
    return max(speed / (SAFETY * dx), viscosity / (VISCOUS * dx**2))


@dataclass(frozen=True)
class SolverOptions:
    """Colliders, damping, schedule and body shapes of the solver.

    `damping` (0 to 1) removes that fraction of the symmetric part of C at every transfer (RPIC). `schedule` is one of

        auto      `split` on a CPU, `fused` on a GPU
        split     two launches per substep (split.py)
        fused     one launch per substep (fused.py)
        exact     `fused` with sums in fixed point: a GPU then gives the same bytes in every run in about twice the
                  time, and a scene the same result in any batch (unless a surface has restitution, whose stiffness
                  follows from the stiffest material of the batch)
        contact   `split`, or on a GPU contact.py with sums in fixed point; the scenes are bodies in one space, each
                  with its own velocity field, in contact with Coulomb friction (kernels/mpm/contact.py). With the other
                  schedules, bodies in one scene share one velocity field, so they stick to each other

    `shapes` are the surfaces of the bodies for the schedule `contact`; by default the voxels, of half a grid cell, that
    contain the particles. Raises ValueError for an unknown schedule.
    """

    colliders: tuple[Collider, ...] = ()
    damping: float = 0.0
    schedule: str = "auto"
    shapes: Sequence[BodyShape] | None = None

    def __post_init__(self):
        if self.schedule not in SCHEDULES:
            raise ValueError(f"{self.schedule!r} is not a schedule of the solver; choose from {', '.join(SCHEDULES)}")


DEFAULTS = SolverOptions()


class Solver:
    """Particles in a box with grid spacing `dx` [m]; `advance` moves them through one frame.

    `sizes` gives the number of particles of each scene of a batch. Scenes have the same box and colliders, and interact
    only with the schedule `contact`. Raises ValueError for sizes that do not match the particles and for grids that are
    too large.
    """

    def __init__(
        self, particles: Particles, box: Box, dx: float, device: str = "cpu", options: SolverOptions = DEFAULTS,
        sizes: Sequence[int] | None = None,
    ):  # fmt: skip
        schedule = options.schedule
        if schedule == "auto":
            schedule = "split" if device == "cpu" else "fused"
        fused = schedule in ("fused", "exact")
        exact = schedule == "exact" or (schedule == "contact" and device != "cpu")
        self.device, self.dx, self.grid = device, dx, make_grid(box, dx, floor_contact=schedule == "contact")
        sizes = [len(particles)] if sizes is None else list(sizes)
        if sum(sizes) != len(particles) or min(sizes) < 1:
            raise ValueError(f"{len(particles)} particles cannot be split into scenes of {sizes}")
        if len(sizes) * self.grid.count * (2 if exact else 1) > max_batch_nodes(device):
            raise ValueError(f"{len(sizes)} grids of {self.grid.count} nodes each are too many")
        columns = {f.name: getattr(particles, f.name) for f in fields(Particles)}
        self.rows = ParticleRows(columns, sizes, self.grid, device)
        self.colliders = options.colliders
        self.grid.damping, self.grid.obstacles = options.damping, as_obstacles(self.colliders, device)
        self._rates = self._max_rates()
        self.grid.spring = self._rates[0] / (2 * dx)  # as stiff as the bodies, so that the CFL substep is stable
        features = Features(
            plastic=bool((particles.model != NEO_HOOKEAN).any()),
            viscoelastic=particles.branch_modulus.shape[1] > 0,
            restitution=any(surface.restitution > 0 for surface in (box, *self.colliders)),
        )
        quanta = self._quanta() if exact else None
        contact = self._body_contact(particles, sizes, options.shapes) if schedule == "contact" else None
        if fused:
            self._substepper = FusedSubsteps(self.rows, features, quanta)
        elif exact:
            self._substepper = ContactSubsteps(self.rows, features, contact, quanta)
        else:
            self._substepper = SplitSubsteps(self.rows, features, contact)
        self._bodies = schedule == "contact"
        self._pin()
        self._substep_multiple = SUBSTEP_MULTIPLE if device != "cpu" and (fused or exact) else 1

    @property
    def particles(self) -> Particles:
        """The current state, with the particles in their original order, on the solver's device."""
        out = Particles(*(self.rows.get(f.name) for f in fields(Particles)))
        out.held[out.held == PINNED] = KINEMATIC
        return out

    @property
    def active_nodes(self) -> int:
        """Number of nodes in the blocks that the last frame read, wrote and cleared."""
        return self._substepper.blocks * mpm_grid.BLOCK**3

    def set(self, **changes: Tensor) -> None:
        """Overwrite fields of all particles, in the original order."""
        for name, value in changes.items():
            self.rows.put(name, value)
        if {"mass", "stiffness", "held", "branch_modulus"} & changes.keys():
            self._rates = self._max_rates()
        if "held" in changes:
            self._pin()

    def substeps(self, duration: float, acceleration: Float[Tensor, "p 3"]) -> int:
        """Number of substeps for a stable frame (see substep_rate). Raises Diverged if a velocity is not finite.

        `duration` [s] is that of the frame, `acceleration` [m/s^2].
        """
        fast = self.rows["v"].norm(dim=1)
        speed = float(fast.max()) + float(acceleration.norm(dim=1).max()) * duration
        if not math.isfinite(speed):
            raise Diverged(int(self.rows["order"][fast.isfinite().logical_not()].min()))
        wave, viscous = self._rates
        steps = math.ceil(duration * substep_rate(self.dx, wave + speed, viscous))
        return math.ceil(max(1, steps) / self._substep_multiple) * self._substep_multiple

    def advance(self, duration: float, acceleration: Float[Tensor, "p 3"], substeps: int | None = None) -> int:
        """Advance by `duration` [s] under the given accelerations [m/s^2]; return the number of substeps.

        Raises Diverged when a particle leaves the box or is not finite.
        """
        steps = substeps or self.substeps(duration, acceleration)
        self.enqueue_frame(duration, acceleration, steps)
        first = int(self.rows.lost.min())
        if first != NEVER:
            raise Diverged(first)
        return steps

    def enqueue_frame(self, duration: float, acceleration: Float[Tensor, "p 3"], substeps: int) -> None:
        """As `advance`, but without waiting for the device: divergence is only recorded, in `lost`.

        A particle that would leave the box or is not finite stays in place; other scenes are not affected.
        """
        self.rows.put("acceleration", acceleration)
        self._substepper.frame(duration / substeps, substeps)
        if self.colliders:
            self.colliders = tuple(c.advanced(duration) for c in self.colliders)
            self.grid.obstacles.assign(as_obstacles(self.colliders, "cpu"))

    @property
    def lost(self) -> Int[Tensor, "s"]:
        """Index of the first lost particle of each scene, or -1."""
        return torch.where(self.rows.lost == NEVER, -1, self.rows.lost)

    def _pin(self) -> None:
        """Find the nodes at the faces of pinned parts of bodies."""
        if self._bodies:
            self._substepper.pin(Pins(self.rows))

    def _body_contact(
        self, particles: Particles, sizes: Sequence[int], shapes: Sequence[BodyShape] | None
    ) -> BodyContact:
        """Shape and friction of each body; all particles of a body have the same friction."""
        if shapes is None:
            parts = particles.rest.cpu().double().split(list(sizes))
            shapes = [shape_of_voxels(x.numpy(), self.dx / 2) for x in parts]
        return BodyContact(
            shapes, torch.stack([part[0] for part in particles.friction.split(list(sizes))]), self.device
        )

    def _quanta(self) -> tuple[float, float]:
        """Fixed-point units per kg m/s and per kg: powers of two that depend only on dx, not on the batch.

        Full cells of 10 g/cm^3, including kinematic ones at metres per second, fit into 63 bits; in a cell of foam one
        unit is a speed of 1e-11 m/s.
        """
        cell = math.ceil(math.log2(1e4 * self.dx**3))
        return 2.0 ** (47 - cell), 2.0 ** (42 - cell)

    def _max_rates(self) -> tuple[float, float]:
        """Maximum pressure wave speed [m/s] and kinematic viscosity [m^2/s] of the free particles."""
        moving = self.rows["held"] == 0
        if not bool(moving.any()):
            return 0.0, 0.0
        density = (self.rows["mass"] / self.rows["volume"])[moving]
        mu, lam, eta = self.rows["stiffness"][moving].unbind(1)
        stiffening = torch.tensor(MAX_STIFFENING, device=mu.device)[self.rows["model"][moving].long()]
        stiffening = stiffening + self.rows["branch_modulus"][moving].sum(1)
        return float((stiffening * (lam + 2 * mu) / density).sqrt().max()), float((eta / density).max())


def max_batch_nodes(device: str) -> int:
    """Maximum total number of grid nodes of a batch: indices have 31 bits, and the CPU keeps several copies."""
    return 2 * MAX_NODES if device == "cpu" else 2**31 - 1


def max_contact_nodes(device: str) -> int:
    """Maximum total number of grid nodes of bodies in contact: on a GPU, as many as half of its free memory holds."""
    if device == "cpu":
        return MAX_NODES // 2
    return min(max_batch_nodes(device) // 4, int(0.5 * torch.cuda.mem_get_info(device)[0] / CONTACT_NODE_BYTES))


def make_grid(box: Box, dx: float, floor_contact: bool = False):
    """A grid whose boundary nodes lie FLOOR_GAP cells outside the box, so that bodies rest on its faces.

    This is exact for the lower faces, including the floor; the upper faces are moved outwards to the next node. With
    `floor_contact` the contact step handles the floor, not the boundary nodes. Raises ValueError if the grid would have
    more than MAX_NODES nodes.
    """
    grid, n = mpm_grid.MpmGrid(), []
    for low, high in zip(box.low, box.high, strict=True):
        inside = max(math.ceil((high - low) / dx + 2 * FLOOR_GAP - 1e-6), 4)
        n.append((inside, math.ceil((inside + 1 + 2 * mpm_grid.GRID_PADDING) / mpm_grid.BLOCK) * mpm_grid.BLOCK))
    grid.count = math.prod(total for _, total in n)
    if grid.count > MAX_NODES:
        raise ValueError(f"a grid of {' x '.join(str(total) for _, total in n)} nodes is too large")
    gaps = FLOOR_GAP, FLOOR_GAP, CONTACT_FLOOR_GAP if floor_contact else FLOOR_GAP
    outside = [dx * (mpm_grid.GRID_PADDING + gap) for gap in gaps]
    grid.origin = wp.vec3(*(low - out for low, out in zip(box.low, outside, strict=True)))
    grid.dx = dx
    grid.nodes = wp.vec3i(*(total for _, total in n))
    soft = round(mpm_grid.RESTITUTION_MARGIN) if box.restitution > 0 else 0
    low = mpm_grid.GRID_PADDING - soft
    grid.low = wp.vec3i(low, low, 1 if floor_contact else low)
    grid.high = wp.vec3i(*(mpm_grid.GRID_PADDING + inside + soft for inside, _ in n))
    grid.face_low, grid.face_high = wp.vec3(*box.low), wp.vec3(*box.high)
    grid.restitution, grid.tangential_retention = box.restitution, box.tangential_retention
    return grid
