"""Our force field: rigid bodies that deform, moved by learned forces where they touch.

What physics says is built in, what it leaves open is learned: bodies turn on SO(3) with their inertia tensor; a contact
force acts on both bodies, opposite and at one place, so linear and angular momentum are kept; nothing depends on the
directions of the axes, the order of things, or padding; no body gets deeper into the floor or a wall than `SINK`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from stages.core.geometry.rotations import matrix, multiply, quaternion
from stages.core.kernels.compilers import TRITON
from stages.core.models.dynamics import FRAME, Dynamics
from stages.core.models.external_forces import ExternalForces
from stages.core.models.field.contact_forces import ContactNet, ContactPoints
from stages.core.models.field.contact_points import (
    ARM_UNIT,
    GAP_UNIT,
    BodyKinematics,
    floor_contacts,
    pair_contacts,
    wall_contacts,
)
from stages.core.models.field.deformation import DeformationNet, bounded, projected
from stages.core.models.field.equivariant import matvec, mlp
from stages.core.models.field.rest_shape import RestShape, rest_shape_of
from stages.core.models.field.rigid_body import angular_velocity, clamp_norm, drift, fit_rigid_motion, pose
from stages.core.models.initial_conditions import InitialConditions, centre_of_mass, inertia

MAX_PENETRATION = 0.03  # deepest that a point may get into the floor or a wall [m]
MAX_RECOVERY_SPEED = 1.0  # fastest that a body is pushed out from deeper [m/s]
MAX_SPEED, MAX_SPIN = 8.0, 60.0  # speed [m/s] and spin [rad/s] are kept below
SEPARATION_SPEED = 0.5  # speed at which floor and walls push half as hard what leaves them [m/s]
MAX_FRICTION_SPEED = 0.07  # strongest grip of the floor [m/s]
FRICTION_CUTOFF_SPEED = 0.3  # speed from which it does not matter whether it lasts, to that grip [m/s]
MAX_TRAINED_STIFFNESS = (
    3.2e5  # E size / mass of the stiffest objects learned from [1/s^2]; what is stiffer bends less by the ratio
)
ELASTIC_STIFFNESS_RATIO = 4.0  # a solid ball's slowest swing, squared, over E size / mass: about as MPM has it
MAX_ELASTIC_STIFFNESS = 1e4  # of such springs, so that explicit steps of a frame are stable [1/s^2]
MAX_TRAINED_SOLID_STIFFNESS = (
    3e4  # the same of the stiffest that is round, the duck: to what is solid, that ratio begins there
)


class BodyState(NamedTuple):
    """Bodies, their points displaced in their own frame."""

    com: Float[Tensor, "b o 3"]  # [m]
    quat: Float[Tensor, "b o 4"]  # w x y z, relative to rest
    velocity: Float[Tensor, "b o 3"]  # [m/s]
    momentum: Float[Tensor, "b o 3"]  # angular, about the centre of mass, per unit of mass, world axes [m^2/s]
    u: Float[Tensor, "b o n 3"]  # displacement from rest [m]
    du: Float[Tensor, "b o n 3"]  # its rate [m/s]


@dataclass(frozen=True)
class FieldScene:
    """What a rollout computes once."""

    shape: RestShape
    code: Float[Tensor, "b o h"]  # shape and material of an object, as the network sees it
    stiffness: Float[Tensor, "b o"]  # of the displacements [1/s^2]
    damping: Float[Tensor, "b o"]  # [1/s]
    compliance_scale: Float[Tensor, "b o"]  # 1; less for what is stiffer than all that was learned from


class Accelerations(NamedTuple):
    """What acts, per unit of mass."""

    force: Float[Tensor, "b o 3"]  # [m/s^2]
    torque: Float[Tensor, "b o 3"]  # about the centre of mass [m^2/s^2]
    stress: Float[Tensor, "b o n 3"]  # in the object's frame [m/s^2]
    grip: Float[Tensor, "b o 1"]  # speed below which the floor, or what it holds, holds a body [m/s]


class ForceField(Dynamics):
    """`ngff`, the default."""

    inputs = frozenset({
        "points", "mass_fraction", "mass", "E", "solidity", "nu", "friction", "velocity", "spin", "gravity", "box"
    })  # fmt: skip

    def __init__(self, hidden: int = 64, deform: bool = True):
        super().__init__()
        self.config = {"hidden": hidden, "deform": deform}
        h = hidden
        self.point = mlp(13, h, h)
        self.code = mlp(2 * h, h, h)
        self.pairs, self.planes = ContactNet(10, 7, h, partner=True), ContactNet(8, 5, h, partner=False)
        self.status = mlp(3 * h, h, h)
        self.between, self.against = mlp(4 * h, h, h), mlp(2 * h, h, h)
        self.hold = nn.Linear(h, 1)
        nn.init.constant_(self.hold.bias, -3.0)
        self.stress = DeformationNet(h) if deform else None

    def precompute(self, initial: InitialConditions) -> RestShape:
        usual = initial.points.is_cuda and initial.points.dtype == torch.float32 and not torch.is_grad_enabled()
        return rest_shape_of(
            initial, half=TRITON and usual
        )  # reading neighbourhoods takes the longest of a step of many

    def encode(self, shape: RestShape) -> FieldScene:
        w = shape.initial
        unit, whole = w.mass.clamp_min(1e-6) / shape.size.clamp_min(1e-6), w.E * w.solidity
        E = torch.minimum(whole, torch.maximum(w.E, MAX_TRAINED_SOLID_STIFFNESS * unit)).minimum(
            MAX_TRAINED_STIFFNESS * unit
        )
        code, compliance_scale = self._encode(shape, E), E / whole  # linear elasticity: strain is stress over E
        if self.stress is None:
            none = torch.zeros_like(compliance_scale)
            return FieldScene(shape, code, none, none, compliance_scale)
        stiffness, damping = self.stress.springs(code)
        # what is hollow crumples, as in the published data; what is solid takes its shape again
        elastic = (ELASTIC_STIFFNESS_RATIO * w.E / unit).clamp_max(MAX_ELASTIC_STIFFNESS) * (1 - 1 / w.solidity)
        return FieldScene(shape, code, stiffness + elastic, damping, compliance_scale)

    def _encode(self, shape: RestShape, E: Float[Tensor, "b o"]) -> Float[Tensor, "b o h"]:
        """From numbers that no rotation changes: points in any order, and the material."""
        w, size = shape.initial, shape.size
        moments = (shape.principal * size[..., None] ** 2).log()
        mass = w.mass.clamp_min(1e-6)
        stiffness = (E * size / mass).log() / 5  # square of a frequency
        whole = torch.stack([size.log(), E.log10() - 5, w.nu, w.friction, mass.log(), stiffness], -1)
        whole = torch.cat([whole, moments], -1)[:, :, None].expand(*shape.spacing.shape, -1)
        arm, normal = shape.arm / size[..., None, None], shape.normal
        each = [arm.norm(dim=-1), normal.norm(dim=-1), (arm * normal).sum(-1), shape.spacing / size[..., None]]
        x = self.point(torch.cat([torch.stack(each, -1), whole], -1))
        most = x.masked_fill(~w.valid[..., None], -torch.inf).amax(2)
        most = torch.where(w.present[..., None], most, 0.0)
        return self.code(torch.cat([(w.mass_fraction[..., None] * x).sum(2), most], -1))

    def initial_state(self, scene: FieldScene) -> BodyState:
        w, shape = scene.shape.initial, scene.shape
        quat = torch.zeros_like(w.mass)[..., None].repeat(1, 1, 4)
        quat[..., 0] = 1
        momentum = matvec(inertia(w.mass_fraction, shape.arm), w.spin)
        rest = torch.zeros_like(shape.arm)
        return BodyState(centre_of_mass(w, w.points), quat, w.velocity, momentum, rest, rest)

    def state_from_motion(
        self, scene: FieldScene, points: Float[Tensor, "b o n 3"], speed: Float[Tensor, "b o n 3"]
    ) -> BodyState:
        shape = scene.shape
        m = fit_rigid_motion(shape.initial.mass_fraction, shape.arm, shape.inverse, points, speed)
        u, du = (m.u, m.du) if self.stress is not None else (torch.zeros_like(m.u), torch.zeros_like(m.du))
        return BodyState(m.com, quaternion(m.R), m.velocity, m.momentum, projected(shape, u), projected(shape, du))

    def points(self, scene: FieldScene, state: BodyState) -> Float[Tensor, "b o n 3"]:
        if self._fused(scene):
            from stages.core.models.field.fused_step import points

            return points(scene, state)
        return state.com[:, :, None] + matvec(matrix(state.quat)[:, :, None], scene.shape.arm + state.u)

    def point_velocity(self, scene: FieldScene, state: BodyState, external: ExternalForces) -> Float[Tensor, "b o n 3"]:
        return self._moving(scene, state).speed

    def derivative(self, scene: FieldScene, t: Tensor | float, state: BodyState, external: ExternalForces) -> BodyState:
        movable = ~external.pinned[..., None]
        state = _held(state, movable)
        moving = self._moving(scene, state)
        rates = self._rates(scene, state, moving, external, t, 0.0)
        same = state.velocity, moving.spin
        lost = 1 - self._slowed(scene, rates, same, same, FRAME)
        spin = torch.cat([torch.zeros_like(moving.spin[..., :1]), moving.spin], -1)
        stress = rates.stress - scene.stiffness[..., None, None] * state.u - scene.damping[..., None, None] * state.du
        ahead = state.velocity * (1 - lost) + FRAME * rates.force
        guard = self._guarded(scene, moving.points, ahead, FRAME) - ahead
        force = rates.force + (guard - lost * state.velocity) / FRAME
        torque = rates.torque - lost * state.momentum / FRAME
        spun = multiply(spin, state.quat) / 2
        return BodyState(state.velocity, spun, force * movable, torque * movable, state.du, stress * movable[..., None])

    def step(
        self, scene: FieldScene, state: BodyState, t: Tensor | float, dt: float, external: ExternalForces
    ) -> BodyState:
        """Half a drift, the forces, half a drift.

        Second order; exact for a parabola. As forces act at one place on both bodies and arms are those of the middle
        of the step, it keeps linear and angular momentum to rounding. Springs and dampers are taken implicitly.
        """
        if self._fused(scene):
            from stages.core.models.field.fused_step import step

            return step(self, scene, state, t, dt, external)
        movable = ~external.pinned[..., None]
        half = self._drifted(scene, _held(state, movable), dt / 2)
        moving = self._moving(scene, half)
        rates = self._rates(scene, half, moving, external, t, dt)
        momentum = half.momentum + dt * rates.torque
        spin = angular_velocity(momentum, scene.shape.inverse, moving.R)
        slower = MAX_SPIN / spin.norm(dim=-1, keepdim=True).clamp_min(MAX_SPIN)
        momentum, spin = momentum * slower, spin * slower
        velocity = clamp_norm(half.velocity + dt * rates.force, MAX_SPEED)
        kept = self._slowed(scene, rates, (half.velocity, moving.spin), (velocity, spin), dt)
        velocity, momentum, spin = velocity * kept, momentum * kept, spin * kept
        turning = torch.linalg.cross(spin[:, :, None].expand_as(moving.arm), moving.arm)
        velocity = self._guarded(scene, moving.points + dt / 2 * turning, velocity, dt / 2)
        k, c = scene.stiffness[..., None, None], scene.damping[..., None, None]
        du = (half.du + dt * (rates.stress - k * half.u)) / (1 + dt * c + dt * dt / 2 * k)
        kicked = half._replace(
            velocity=velocity, momentum=momentum, du=bounded(scene.shape, du / MAX_SPEED) * MAX_SPEED
        )
        return self._drifted(scene, _held(kicked, movable), dt / 2)

    def _fused(self, scene: FieldScene) -> bool:
        """Whether there are kernels that do all of a step: on CUDA without gradients, for the usual sizes."""
        arm = scene.shape.arm
        if not TRITON or not arm.is_cuda or torch.is_grad_enabled() or torch.compiler.is_compiling():
            return False
        from stages.core.models.field.fused_step import fits

        return fits(self, scene)

    def _drifted(self, scene: FieldScene, state: BodyState, dt: float) -> BodyState:
        """Motion without forces."""
        com, quat = drift(state.com, state.quat, state.velocity, state.momentum, scene.shape.inverse, dt)
        return state._replace(com=com, quat=quat, u=bounded(scene.shape, state.u + dt * state.du))

    def _moving(self, scene: FieldScene, state: BodyState) -> BodyKinematics:
        """Where everything is in the world, and how it moves."""
        R, spin = pose(state.quat, state.momentum, scene.shape.inverse)
        turn = R[:, :, None]
        arm = matvec(turn, scene.shape.arm + state.u)
        velocity = state.velocity[:, :, None] + torch.linalg.cross(spin[:, :, None].expand_as(arm), arm)
        inverse = R @ scene.shape.inverse @ R.mT
        return BodyKinematics(R, inverse, spin, state.com, state.velocity, arm, state.com[:, :, None] + arm,
                      velocity + matvec(turn, state.du), matvec(turn, scene.shape.normal))  # fmt: skip

    def _rates(
        self,
        scene: FieldScene,
        state: BodyState,
        moving: BodyKinematics,
        external: ExternalForces,
        t: Tensor | float,
        dt: float,
    ) -> Accelerations:
        """Contact, pushes, gravity and stress."""
        w = scene.shape.initial
        force, torque, touch, grip = self._contact(scene, moving, external)
        pushed, twisted = external.wrench(moving.points, moving.com, t, dt)
        mass = w.mass[..., None].clamp_min(1e-6)
        force = force + pushed / mass + w.gravity[:, None]
        torque = torque + twisted / mass
        if self.stress is None:
            return Accelerations(force, torque, torch.zeros_like(touch), grip)
        inwards = moving.R.mT
        gravity, touch = matvec(inwards, w.gravity[:, None]), matvec(inwards[:, :, None], touch)
        stress = self.stress(scene.shape, scene.code, scene.compliance_scale, state.u, state.du, touch, gravity)
        return Accelerations(force, torque, stress, grip)

    def _contact(
        self, scene: FieldScene, moving: BodyKinematics, external: ExternalForces
    ) -> tuple[Float[Tensor, "b o 3"], Float[Tensor, "b o 3"], Float[Tensor, "b o n 3"], Float[Tensor, "b o 1"]]:
        """Force and torque on each object and what its points feel, per unit of mass; and the grip of the floor."""
        shape, code = scene.shape, scene.code
        w, others, back = shape.initial, shape.others, shape.back
        pairs, floor, wall = pair_contacts(shape, moving), floor_contacts(shape, moving), wall_contacts(shape, moving)
        said, weight, heard = self.pairs.encode(pairs, _shares(w, pairs), code, code[:, others])
        said_f, weight_f, heard_f = self.planes.encode(floor, _shares(w, floor), code)
        said_w, weight_w, heard_w = self.planes.encode(wall, _shares(w, wall), code)
        status = self.status(torch.cat([code, heard.sum(2), heard_f[:, :, 0] + heard_w[:, :, 0]], -1))
        own, mine = status[:, :, None].expand_as(heard), status[:, :, None]
        context = self.between(torch.cat([heard, heard[:, others, back], own, status[:, others]], -1))
        context_f, context_w = (self.against(torch.cat([h, mine], -1)) for h in (heard_f, heard_w))
        a = self.pairs.decode(said, weight, context, pairs.vectors)
        a_f = _pushed(self.planes.decode(said_f, weight_f, context_f, floor.vectors), floor, weight_f)
        a_w = _pushed(self.planes.decode(said_w, weight_w, context_w, wall.vectors), wall, weight_w)
        mass, light = w.mass.clamp_min(1e-6), 1 / w.mass.clamp_min(1e-6) * ~external.pinned
        reduced = 1 / (light[:, :, None] + light[:, others]).clamp_min(1e-9)  # a pinned body weighs as much as it likes
        F = reduced[..., None, None] * a
        middle = moving.com[:, :, None, None] + pairs.vectors[..., 4, :] * ARM_UNIT
        middle = middle - pairs.vectors[..., 0, :] * (GAP_UNIT / 2)
        torque = torch.linalg.cross(middle - moving.com[:, :, None, None], F).sum((2, 3))
        counter = torch.linalg.cross(middle - moving.com[:, others][:, :, :, None], F).sum(3)
        F = F.sum(3)
        force = F.sum(2) - self._returned(shape, F)
        torque = torque - self._returned(shape, counter)
        ground = torch.cat([a_f, a_w], 3)[:, :, 0]
        arms = torch.cat([floor.vectors[..., 3, :], wall.vectors[..., 3, :]], 3)[:, :, 0] * ARM_UNIT
        torque = torque / mass[..., None] + torch.linalg.cross(arms, ground).sum(2)
        felt = torch.cat([((reduced / mass[..., None])[..., None, None] * a).flatten(2, 3), ground], 2)
        rows = torch.cat([pairs.row.flatten(2), floor.row[:, :, 0], wall.row[:, :, 0]], 2)
        touch = torch.zeros_like(moving.arm).scatter_add(2, rows[..., None].expand_as(felt), felt)
        touch = torch.where(w.valid[..., None], touch / w.mass_fraction.clamp_min(1e-9)[..., None], 0.0)
        grip = MAX_FRICTION_SPEED * torch.sigmoid(self.hold(status)) * weight_f[:, :, 0].sum(-1, keepdim=True)
        if others.shape[1]:  # what stands on what the floor holds is held as well
            grip = torch.maximum(grip, (weight.sum(-1) * grip[:, others, 0]).amax(-1, keepdim=True))
        return force / mass[..., None] + ground.sum(2), torque, touch, grip

    def _returned(self, shape: RestShape, x: Float[Tensor, "b o m c"]) -> Float[Tensor, "b o c"]:
        """What the others get from each object where they touch it: by that it is pushed back."""
        return x[:, shape.others, shape.back].sum(2)

    def _slowed(
        self,
        scene: FieldScene,
        rates: Accelerations,
        before: tuple[Tensor, Tensor],
        after: tuple[Tensor, Tensor],
        dt: float,
    ) -> Float[Tensor, "b o 1"]:
        """By how much dry friction slows a body: next to nothing when fast, to rest when slower than its grip.

        Forces that are only nearly in balance would let bodies creep for ever. `before` and `after` the forces are
        velocity and spin; their mean is what a step moves, and counts when slow: what the next step takes back, as
        stiff contacts do, would hide that a body rests.
        """
        extent = scene.shape.size[..., None].square()
        last = after[0].square().sum(-1, keepdim=True) + extent * after[1].square().sum(-1, keepdim=True)
        both = [(x + y) / 2 for x, y in zip(before, after, strict=True)]
        net = both[0].square().sum(-1, keepdim=True) + extent * both[1].square().sum(-1, keepdim=True)
        moving = (net + (last / FRICTION_CUTOFF_SPEED).square()).square() + 1e-16
        return moving / (moving + dt / FRAME * rates.grip.square().square())

    def _guarded(
        self, scene: FieldScene, points: Float[Tensor, "b o n 3"], velocity: Float[Tensor, "b o 3"], dt: float
    ) -> Float[Tensor, "b o 3"]:
        """Velocities with which no point gets deeper than SINK into floor, walls or ceiling within dt."""
        w = scene.shape.initial
        hidden = ~w.valid[..., None]
        # not amin: compiled, its gradient looks for the value again and, rounded otherwise, may not find it
        lowest = points.masked_fill(hidden, torch.inf).min(2).values
        highest = points.masked_fill(hidden, -torch.inf).max(2).values
        up = (w.box[..., 0, :] - MAX_PENETRATION - lowest) / dt
        down = (w.box[..., 1, :] + MAX_PENETRATION - highest) / dt
        velocity = torch.maximum(velocity, up.clamp(max=MAX_RECOVERY_SPEED))
        return torch.minimum(velocity, down.clamp(min=-MAX_RECOVERY_SPEED))


def _held(state: BodyState, movable: Bool[Tensor, "b o 1"]) -> BodyState:
    """Whoever is pinned does not move."""
    return state._replace(
        velocity=state.velocity * movable, momentum=state.momentum * movable, du=state.du * movable[..., None]
    )


def _shares(initial: InitialConditions, places: ContactPoints) -> Float[Tensor, "b o m n"]:
    """Of an object's mass, where it touches."""
    return initial.mass_fraction[:, :, None].expand(*places.row.shape[:3], -1).gather(-1, places.row)


def _pushed(
    a: Float[Tensor, "b o 1 n 3"], places: ContactPoints, weight: Float[Tensor, "b o 1 n"]
) -> Float[Tensor, "b o 1 n 3"]:
    """Floor and walls push, and do not pull; what leaves them they push less than what comes.

    Like the damping of Hunt and Crossley (1975), which grows with the push, this takes energy from every bounce: else
    a body in an odd pose may hop on for ever.
    """
    normal, unit = places.vectors[..., 0, :], weight[..., None].clamp_min(1e-9)
    along, leaving = ((x * normal).sum(-1, keepdim=True) for x in (a, places.vectors[..., 2, :]))
    push = unit * softplus(along / unit) / (1 + leaving.clamp_min(0) / SEPARATION_SPEED)
    return a + (push - along) * normal
