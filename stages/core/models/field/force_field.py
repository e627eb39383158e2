"""Learned force field: rigid bodies with superimposed deformation, accelerated by learned contact forces.

Built in: orientations on SO(3) with the bodies' inertia tensors; equal and opposite contact forces at a common point of
both bodies, so that linear and angular momentum are conserved; equivariance under rotations and under permutations of
objects and keypoints; independence of padding; a limit on the penetration of floor and walls (`floor_response`).
Learned: the contact forces, the deformation and its stiffness.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from stages.core.geometry.rotations import matrix, multiply, quaternion
from stages.core.kernels.compilers import TRITON
from stages.core.kernels.threads import small_operations
from stages.core.models.dynamics import FRAME, Dynamics
from stages.core.models.external_forces import ExternalForces
from stages.core.models.field.contact_forces import ContactNet, ContactPoints
from stages.core.models.field.contact_points import (
    ARM_UNIT,
    GAP_UNIT,
    SEARCH_RADIUS,
    BodyKinematics,
    floor_contacts,
    pair_contacts,
    wall_contacts,
)
from stages.core.models.field.deformation import DeformationInputs, DeformationNet, bounded, projected
from stages.core.models.field.equivariant import matvec, mlp
from stages.core.models.field.floor_response import MAX_FRICTION_SPEED, friction_factor, limit_penetration, push_only
from stages.core.models.field.kernel_choice import triton_allowed
from stages.core.models.field.rest_shape import RestShape, rest_shape_of
from stages.core.models.field.rigid_body import angular_velocity, clamp_norm, drift, fit_rigid_motion, pose
from stages.core.models.field.state import MAX_SPEED, MAX_SPIN, Accelerations, BodyState, FieldScene
from stages.core.models.initial_conditions import InitialConditions, centre_of_mass

if TRITON:
    from stages.core.models.field import fused_step

# Keypoints of a batch up to which a step runs on one CPU thread; one thread was measured to be faster up to 6,144.
MAX_SINGLE_THREAD_POINTS = 10_000
# Stiffnesses are values of E * size / mass, the squared frequency of an elastic body.
MAX_TRAINED_STIFFNESS = 3.2e5  # largest stiffness in the training data [1/s^2]; upper limit of network inputs
MAX_TRAINED_SOLID_STIFFNESS = 3e4  # stiffest compact object in training, the duck [1/s^2]; limit for solid bodies
MAX_ELASTIC_STIFFNESS = 1e4  # limit for the analytic springs of solid bodies [1/s^2]; explicit FRAME steps stay stable
# Stiffness of the analytic springs over E size / mass: about the lowest mode of an MPM ball; hand-chosen.
ELASTIC_STIFFNESS_RATIO = 4.0


class ContactEffect(NamedTuple):
    """Sum of all contacts on each object, per unit of its mass."""

    force: Float[Tensor, "b o 3"]  # [m/s^2]
    torque: Float[Tensor, "b o 3"]  # about the centre of mass [m^2/s^2]
    accelerations: Float[Tensor, "b o n 3"]  # of each keypoint by its own contacts [m/s^2]
    friction_speed: Float[Tensor, "b o 1"]  # threshold of dry friction [m/s]


class ForceField(Dynamics):
    """Engine `ngff`, the default. Attribute names are the keys of the shipped weights."""

    inputs = frozenset({
        "points", "mass_fraction", "mass", "E", "solidity", "nu", "friction", "velocity", "spin", "gravity", "box"
    })  # fmt: skip

    def __init__(self, hidden: int = 64, deform: bool = True):
        super().__init__()
        self.config = {"hidden": hidden, "deform": deform}
        h = hidden
        self.keypoint_encoder = mlp(13, h, h)
        self.object_encoder = mlp(2 * h, h, h)  # embedding of an object, from its pooled keypoints
        self.pairs = ContactNet(10, 7, h, partner=True)  # contacts between objects
        self.planes = ContactNet(8, 5, h, partner=False)  # contacts with floor and walls
        self.object_update = mlp(3 * h, h, h)  # an object's embedding updated with its messages
        self.pair_update, self.plane_update = mlp(4 * h, h, h), mlp(2 * h, h, h)  # contexts of pairs and of planes
        self.friction = nn.Linear(h, 1)  # logit of the friction threshold
        nn.init.constant_(self.friction.bias, -3.0)
        self.deformation = DeformationNet(h) if deform else None

    def precompute(self, initial: InitialConditions) -> RestShape:
        """Compute the rest shapes of the objects: arms, normals, inertia and neighbourhoods."""
        # 16-bit neighbourhoods for rollouts on a GPU: reading them dominates the cost of a step with many keypoints
        return rest_shape_of(initial, half=triton_allowed(initial.points))

    def encode(self, shape: RestShape) -> FieldScene:
        """Compute the embeddings and springs of the objects.

        Stiffness beyond the range of the training data is clamped, and the deformation is scaled by the ratio instead
        (`compliance_scale`), since by linear elasticity strain is stress / E.
        """
        w = shape.initial
        unit = w.mass.clamp_min(1e-6) / shape.size.clamp_min(1e-6)
        effective_E = w.E * w.solidity
        E = torch.minimum(effective_E, torch.maximum(w.E, MAX_TRAINED_SOLID_STIFFNESS * unit))
        E = E.minimum(MAX_TRAINED_STIFFNESS * unit)
        embedding, compliance_scale = self._embed_objects(shape, E), E / effective_E
        if self.deformation is None:
            none = torch.zeros_like(compliance_scale)
            return FieldScene(shape, embedding, none, none, compliance_scale)
        stiffness, damping = self.deformation.springs(embedding)
        # hollow bodies (solidity 1), as in the published data, have only the learned springs and may stay dented
        elastic = (ELASTIC_STIFFNESS_RATIO * w.E / unit).clamp_max(MAX_ELASTIC_STIFFNESS) * (1 - 1 / w.solidity)
        return FieldScene(shape, embedding, stiffness + elastic, damping, compliance_scale)

    def _embed_objects(self, shape: RestShape, E: Float[Tensor, "b o"]) -> Float[Tensor, "b o h"]:
        """Embeddings from the materials and rotation-invariant keypoint features, pooled by mean and maximum."""
        w, size = shape.initial, shape.size
        moments = (shape.principal * size[..., None] ** 2).log()
        mass = w.mass.clamp_min(1e-6)
        stiffness = (E * size / mass).log() / 5  # log of a squared frequency
        object_features = torch.stack([size.log(), E.log10() - 5, w.nu, w.friction, mass.log(), stiffness], -1)
        object_features = torch.cat([object_features, moments], -1)[:, :, None].expand(*shape.spacing.shape, -1)
        arm, normal = shape.arm / size[..., None, None], shape.normal
        local = [arm.norm(dim=-1), normal.norm(dim=-1), (arm * normal).sum(-1), shape.spacing / size[..., None]]
        x = self.keypoint_encoder(torch.cat([torch.stack(local, -1), object_features], -1))
        maximum = x.masked_fill(~w.valid[..., None], -torch.inf).amax(2)
        maximum = torch.where(w.present[..., None], maximum, 0.0)
        return self.object_encoder(torch.cat([(w.mass_fraction[..., None] * x).sum(2), maximum], -1))

    def initial_state(self, scene: FieldScene) -> BodyState:
        """Undeformed objects at their initial pose, with the momentum of their initial spin."""
        w, shape = scene.shape.initial, scene.shape
        quat = torch.zeros_like(w.mass)[..., None].repeat(1, 1, 4)
        quat[..., 0] = 1
        momentum = matvec(w.body_inertia, w.spin)
        rest = torch.zeros_like(shape.arm)
        return BodyState(centre_of_mass(w, w.points), quat, w.velocity, momentum, rest, rest)

    def state_from_motion(
        self, scene: FieldScene, points: Float[Tensor, "b o n 3"], velocities: Float[Tensor, "b o n 3"]
    ) -> BodyState:
        """Rigid motion fitted to the keypoints; the residual is the deformation, 0 for a field without deformation."""
        shape = scene.shape
        m = fit_rigid_motion(shape.initial.mass_fraction, shape.arm, shape.keypoint_inverse, points, velocities)
        u, du = (m.u, m.du) if self.deformation is not None else (torch.zeros_like(m.u), torch.zeros_like(m.du))
        # the body has the spin of its keypoints, but its own inertia
        momentum = matvec(m.R, matvec(shape.initial.body_inertia, matvec(m.R.mT, m.spin)))
        return BodyState(m.com, quaternion(m.R), m.velocity, momentum, projected(shape, u), projected(shape, du))

    def points(self, scene: FieldScene, state: BodyState) -> Float[Tensor, "b o n 3"]:
        """Keypoints in world coordinates [m], by one kernel where the fused step is used."""
        if self._use_fused_step(scene):
            return fused_step.points(scene, state)
        return state.com[:, :, None] + matvec(matrix(state.quat)[:, :, None], scene.shape.arm + state.u)

    def point_velocity(self, scene: FieldScene, state: BodyState, external: ExternalForces) -> Float[Tensor, "b o n 3"]:
        """Velocities of the keypoints [m/s], in closed form; `external` has no effect."""
        return self._kinematics(scene, state).point_velocity

    def derivative(self, scene: FieldScene, t: Tensor | float, state: BodyState, external: ExternalForces) -> BodyState:
        """Rate of change of the state, for ODE solvers.

        Friction and the penetration limit are step rules, not forces; here they act as if spread over one FRAME.
        """
        movable = ~external.pinned[..., None]
        state = without_pinned(state, movable)
        bodies = self._kinematics(scene, state)
        rates = self._accelerations(scene, state, bodies, external, (t, 0.0))
        same = state.velocity, bodies.spin
        lost = 1 - friction_factor(scene.shape, rates.friction_speed, same, same, FRAME)
        spin = torch.cat([torch.zeros_like(bodies.spin[..., :1]), bodies.spin], -1)
        k, c = scene.stiffness[..., None, None], scene.damping[..., None, None]
        displacement_rate = rates.internal - k * state.u - c * state.du
        ahead = state.velocity * (1 - lost) + FRAME * rates.force
        correction = limit_penetration(scene.shape, bodies.points, ahead, FRAME) - ahead
        force = rates.force + (correction - lost * state.velocity) / FRAME
        torque = rates.torque - lost * state.momentum / FRAME
        quat_rate = multiply(spin, state.quat) / 2
        return BodyState(
            state.velocity, quat_rate, force * movable, torque * movable, state.du,
            displacement_rate * movable[..., None],
        )  # fmt: skip

    def step(
        self, scene: FieldScene, state: BodyState, t: Tensor | float, dt: float, external: ExternalForces
    ) -> BodyState:
        """Advance by dt with symplectic (Strang) splitting: half a drift, a velocity update by forces, half a drift.

        Second order, and exact for parabolic motion. Contact forces act at a common point of both bodies, with the arms
        at the middle of the step, so linear and angular momentum are conserved to rounding. The springs to the rest
        shape are integrated implicitly.
        """
        if self._use_fused_step(scene):
            return fused_step.step(self, scene, state, t, dt, external)
        if has_small_operations(scene.shape.arm):
            with small_operations():
                return self._split_step(scene, state, t, dt, external)
        return self._split_step(scene, state, t, dt, external)

    def stepping(
        self, scene: FieldScene, dt: float, external: ExternalForces
    ) -> Callable[[BodyState, Tensor | float], BodyState]:
        """As Dynamics.stepping; the inputs that all fused steps share are collected once."""
        if self._use_fused_step(scene):
            return fused_step.FusedStep(self, scene, dt, external)
        return super().stepping(scene, dt, external)

    def _split_step(
        self, scene: FieldScene, state: BodyState, t: Tensor | float, dt: float, external: ExternalForces
    ) -> BodyState:
        """`step` in PyTorch operations."""
        movable = ~external.pinned[..., None]
        half = self._drifted(scene, without_pinned(state, movable), dt / 2)
        bodies = self._kinematics(scene, half)
        rates = self._accelerations(scene, half, bodies, external, (t, dt))
        momentum = half.momentum + dt * rates.torque
        spin = angular_velocity(momentum, scene.shape.inverse, bodies.R)
        slower = MAX_SPIN / spin.norm(dim=-1, keepdim=True).clamp_min(MAX_SPIN)
        momentum, spin = momentum * slower, spin * slower
        velocity = clamp_norm(half.velocity + dt * rates.force, MAX_SPEED)
        before, after = (half.velocity, bodies.spin), (velocity, spin)
        factor = friction_factor(scene.shape, rates.friction_speed, before, after, dt)
        velocity, momentum, spin = velocity * factor, momentum * factor, spin * factor
        rotating = torch.linalg.cross(spin[:, :, None].expand_as(bodies.arm), bodies.arm)
        velocity = limit_penetration(scene.shape, bodies.points + dt / 2 * rotating, velocity, dt / 2)
        k, c = scene.stiffness[..., None, None], scene.damping[..., None, None]
        du = (half.du + dt * (rates.internal - k * half.u)) / (1 + dt * c + dt * dt / 2 * k)
        du = bounded(scene.shape, du / MAX_SPEED) * MAX_SPEED
        updated = half._replace(velocity=velocity, momentum=momentum, du=du)
        return self._drifted(scene, without_pinned(updated, movable), dt / 2)

    def _use_fused_step(self, scene: FieldScene) -> bool:
        """Whether `fused_step` can replace `step`: on CUDA, without gradients, for the sizes its kernels support."""
        if not triton_allowed(scene.shape.arm) or torch.compiler.is_compiling():
            return False
        return fused_step.fits(self, scene)

    def _drifted(self, scene: FieldScene, state: BodyState, dt: float) -> BodyState:
        """The state after dt [s] of force-free motion."""
        com, quat = drift(state.com, state.quat, state.velocity, state.momentum, scene.shape.inverse, dt)
        return state._replace(com=com, quat=quat, u=bounded(scene.shape, state.u + dt * state.du))

    def _kinematics(self, scene: FieldScene, state: BodyState) -> BodyKinematics:
        """Positions, velocities and inverse inertia in world coordinates."""
        R, spin = pose(state.quat, state.momentum, scene.shape.inverse)
        rotation = R[:, :, None]
        arm = matvec(rotation, scene.shape.arm + state.u)
        velocity = state.velocity[:, :, None] + torch.linalg.cross(spin[:, :, None].expand_as(arm), arm)
        return BodyKinematics(
            R=R, inverse=R @ scene.shape.inverse @ R.mT, spin=spin, com=state.com, velocity=state.velocity, arm=arm,
            points=state.com[:, :, None] + arm, point_velocity=velocity + matvec(rotation, state.du),
            normal=matvec(rotation, scene.shape.normal),
        )  # fmt: skip

    def _accelerations(
        self, scene: FieldScene, state: BodyState, bodies: BodyKinematics, external: ExternalForces,
        interval: tuple[Tensor | float, float],
    ) -> Accelerations:  # fmt: skip
        """Contact, external forces, gravity and internal accelerations in the `interval` (t, dt) [s]."""
        w = scene.shape.initial
        contact = self._contact(scene, bodies, external)
        applied, twist = external.wrench(bodies.points, bodies.com, *interval)
        mass = w.mass[..., None].clamp_min(1e-6)
        force = contact.force + applied / mass + w.gravity[:, None]
        torque = contact.torque + twist / mass
        if self.deformation is None:
            return Accelerations(force, torque, torch.zeros_like(contact.accelerations), contact.friction_speed)
        to_body = bodies.R.mT
        inputs = DeformationInputs(
            state.u, state.du, matvec(to_body[:, :, None], contact.accelerations),
            matvec(to_body, w.gravity[:, None]),
        )  # fmt: skip
        internal = self.deformation(scene.shape, scene.embedding, scene.compliance_scale, inputs)
        return Accelerations(force, torque, internal, contact.friction_speed)

    def _contact(self, scene: FieldScene, bodies: BodyKinematics, external: ExternalForces) -> ContactEffect:
        """One round of contact message passing: encode, aggregate, update, decode; then the sum of the forces."""
        shape, embedding = scene.shape, scene.embedding
        if not (bodies.points.is_cuda or torch.compiler.is_compiling()):
            # not on a GPU, where the host would have to wait for the number of near objects
            shape = shape.with_near_others(bodies.points, SEARCH_RADIUS)
        w, others, back = shape.initial, shape.others, shape.back
        pairs, floor, wall = pair_contacts(shape, bodies), floor_contacts(shape, bodies), wall_contacts(shape, bodies)
        x, weight, mean = self.pairs.encode(pairs, _fractions(w, pairs), embedding, embedding[:, others])
        x_f, weight_f, mean_f = self.planes.encode(floor, _fractions(w, floor), embedding)
        x_w, weight_w, mean_w = self.planes.encode(wall, _fractions(w, wall), embedding)
        status = self.object_update(torch.cat([embedding, mean.sum(2), mean_f[:, :, 0] + mean_w[:, :, 0]], -1))
        pair_status, plane_status = status[:, :, None].expand_as(mean), status[:, :, None]
        context = self.pair_update(torch.cat([mean, mean[:, others, back], pair_status, status[:, others]], -1))
        context_f, context_w = (self.plane_update(torch.cat([m, plane_status], -1)) for m in (mean_f, mean_w))
        a = self.pairs.decode(x, weight, context, pairs.vectors)
        a_f = push_only(self.planes.decode(x_f, weight_f, context_f, floor.vectors), floor, weight_f)
        a_w = push_only(self.planes.decode(x_w, weight_w, context_w, wall.vectors), wall, weight_w)
        friction = MAX_FRICTION_SPEED * torch.sigmoid(self.friction(status)) * weight_f[:, :, 0].sum(-1, keepdim=True)
        if others.shape[1]:  # an object also gets the friction of the objects that it touches, e.g. stands on
            friction = torch.maximum(friction, (weight.sum(-1) * friction[:, others, 0]).amax(-1, keepdim=True))
        mass, inverse_mass = w.mass.clamp_min(1e-6), 1 / w.mass.clamp_min(1e-6) * ~external.pinned
        # a pinned object has infinite mass
        reduced = 1 / (inverse_mass[:, :, None] + inverse_mass[:, others]).clamp_min(1e-9)
        force, torque = self._pair_sums(shape, bodies, pairs, reduced[..., None, None] * a)
        planes = torch.cat([a_f, a_w], 3)[:, :, 0]
        arms = torch.cat([floor.vectors[..., 3, :], wall.vectors[..., 3, :]], 3)[:, :, 0] * ARM_UNIT
        torque = torque / mass[..., None] + torch.linalg.cross(arms, planes).sum(2)
        local = torch.cat([((reduced / mass[..., None])[..., None, None] * a).flatten(2, 3), planes], 2)
        rows = torch.cat([pairs.row.flatten(2), floor.row[:, :, 0], wall.row[:, :, 0]], 2)
        local = torch.zeros_like(bodies.arm).scatter_add(2, rows[..., None].expand_as(local), local)
        local = torch.where(w.valid[..., None], local / w.mass_fraction.clamp_min(1e-9)[..., None], 0.0)
        return ContactEffect(force / mass[..., None] + planes.sum(2), torque, local, friction)

    def _pair_sums(
        self, shape: RestShape, bodies: BodyKinematics, pairs: ContactPoints, F: Float[Tensor, "b o m n 3"]
    ) -> tuple[Float[Tensor, "b o 3"], Float[Tensor, "b o 3"]]:
        """Force [N] and torque [N m] on each object by the pair forces F and their reactions, at gap midpoints."""
        com = bodies.com
        middle = com[:, :, None, None] + pairs.vectors[..., 4, :] * ARM_UNIT
        middle = middle - pairs.vectors[..., 0, :] * (GAP_UNIT / 2)
        torque = torch.linalg.cross(middle - com[:, :, None, None], F).sum((2, 3))
        counter = torch.linalg.cross(middle - com[:, shape.others][:, :, :, None], F).sum(3)
        F = F.sum(3)
        return F.sum(2) - self._reaction(shape, F), torque - self._reaction(shape, counter)

    def _reaction(self, shape: RestShape, x: Float[Tensor, "b o m c"]) -> Float[Tensor, "b o c"]:
        """Sum over each object's partners of the partners' values of x for it; subtracted as the reaction."""
        return x[:, shape.others, shape.back].sum(2)


def has_small_operations(arm: Float[Tensor, "b o n 3"]) -> bool:
    """Whether most operations of a step are too small for several CPU threads; false with gradients."""
    points = arm.shape[0] * arm.shape[1] * arm.shape[2]
    return not arm.is_cuda and not torch.is_grad_enabled() and points <= MAX_SINGLE_THREAD_POINTS


def without_pinned(state: BodyState, movable: Bool[Tensor, "b o 1"]) -> BodyState:
    """Return the state with the velocities of pinned objects set to zero."""
    return state._replace(
        velocity=state.velocity * movable, momentum=state.momentum * movable, du=state.du * movable[..., None]
    )


def _fractions(initial: InitialConditions, contacts: ContactPoints) -> Float[Tensor, "b o m n"]:
    """Mass fraction of each contact point."""
    return initial.mass_fraction[:, :, None].expand(*contacts.row.shape[:3], -1).gather(-1, contacts.row)
