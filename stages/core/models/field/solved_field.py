"""The force field with solved contacts: rigid motion by `contact_solve`, deformation by the network.

For one scene whose bodies' surfaces are known. Contact of the published simulation, which `ForceField` has learned,
makes bodies stick and knows one coefficient of friction. Here bodies do not enter each other, friction and restitution
are those of the materials, and the learned deformation answers the forces that this takes. Contacts are those of the
undeformed surfaces: forces at single keypoints, as the solution has them, dent a body as those of the training never
did, and contacts of dents did not come to rest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.rotations import matrix
from stages.core.kernels.threads import small_operations
from stages.core.models.dynamics import FRAME
from stages.core.models.external_forces import ExternalForces
from stages.core.models.field.body_surfaces import BodySurfaces
from stages.core.models.field.contact_points import BodyKinematics
from stages.core.models.field.contact_solve import BodyInertia, Contacts, solve
from stages.core.models.field.deformation import DeformationInputs, bounded
from stages.core.models.field.equivariant import matvec
from stages.core.models.field.force_field import ForceField, has_small_operations, without_pinned
from stages.core.models.field.rigid_body import angular_velocity, drift
from stages.core.models.field.state import MAX_SPEED, BodyState, FieldScene

MARGIN = 0.05  # gap up to which points count, in addition to the way of a step [m]; a tenth of a typical object
RECOVERY = 0.2  # share of an overlap that is removed in a step (Baumgarte 1972)
MAX_RECOVERY_SPEED = 0.3  # [m/s], about the speed below which bodies do not rebound
REBOUND_SPEED = 0.2  # least speed of approach that rebounds [m/s]: that of a fall of 4 mm, a hundredth of an object
# Least cosine of the angle at which two surfaces face each other in a contact; .58 for a cube standing on its corner.
# Larger for points on a face: otherwise an edge that passes over them gives contacts with oblique normals.
MIN_FACING, MIN_FACING_OF_FACE = 0.3, 0.9
CLOSEST_POINT_STEPS = 3  # to the point of a ball that is nearest to a surface
SUBSTEPS = 4  # of rigid motion per step: contacts are linear in the motion, so a body may turn little in each


class _NearPoints(NamedTuple):
    """Points of bodies a near bodies b, or near a plane."""

    a: Int[Tensor, "r"]
    b: Int[Tensor, "r"]
    keypoint: Int[Tensor, "r"]  # of a
    other: Int[Tensor, "r"]  # of b, near it
    gap: Float[Tensor, "r"]  # [m]
    normal: Float[Tensor, "r 3"]  # of b, towards a
    at: Float[Tensor, "r 3"]  # the point of a [m]


class SolvedForceField(ForceField):
    """`field` with solved contacts of bodies with these surfaces, for batches of one scene."""

    capturable = False  # the number of contacts changes

    def __init__(self, field: ForceField, surfaces: BodySurfaces):
        super().__init__(**field.config)
        self.load_state_dict(field.state_dict())
        self.to(next(field.parameters()).device)
        self.surfaces = surfaces

    def step(
        self, scene: FieldScene, state: BodyState, t: Tensor | float, dt: float, external: ExternalForces
    ) -> BodyState:
        """As that of ForceField, with the velocities that the contacts allow."""
        if has_small_operations(scene.shape.arm):
            with small_operations():
                return self._solved_step(scene, state, t, dt, external)
        return self._solved_step(scene, state, t, dt, external)

    def derivative(self, scene: FieldScene, t: Tensor | float, state: BodyState, external: ExternalForces) -> BodyState:
        """Rate of change of the state, for ODE solvers: the mean of a step of one FRAME."""
        new = self._solved_step(scene, state, t, FRAME, external)
        return BodyState(*((y - x) / FRAME for x, y in zip(state, new, strict=True)))

    def _use_fused_step(self, scene: FieldScene) -> bool:
        return False

    def _solved_step(
        self, scene: FieldScene, state: BodyState, t: Tensor | float, dt: float, external: ExternalForces
    ) -> BodyState:
        movable = ~external.pinned[..., None]
        w, shape, h = scene.shape.initial, scene.shape, dt / SUBSTEPS
        state = without_pinned(state, movable)
        state = state._replace(u=bounded(shape, state.u + dt / 2 * state.du))
        accelerations = torch.zeros_like(state.u)
        for k in range(SUBSTEPS):
            state, by_contact = self._rigid_step(scene, state, t + k * h, h, external)
            accelerations += by_contact / SUBSTEPS
        if self.deformation is None:
            return state
        inputs = DeformationInputs(state.u, state.du, accelerations, matvec(matrix(state.quat).mT, w.gravity[:, None]))
        internal = self.deformation(shape, scene.embedding, scene.compliance_scale, inputs)
        k, c = scene.stiffness[..., None, None], scene.damping[..., None, None]
        du = (state.du + dt * (internal - k * state.u)) / (1 + dt * c + dt * dt / 2 * k)
        du = bounded(shape, du / MAX_SPEED) * MAX_SPEED * movable[..., None]
        return state._replace(du=du, u=bounded(shape, state.u + dt / 2 * du))

    def _rigid_step(
        self, scene: FieldScene, state: BodyState, t: Tensor | float, h: float, external: ExternalForces
    ) -> tuple[BodyState, Float[Tensor, "1 o n 3"]]:
        """Rigid motion in h [s], and the accelerations of the keypoints by contact, in the bodies' frames [m/s^2]."""
        w, inverse = scene.shape.initial, scene.shape.inverse
        movable = ~external.pinned[..., None]
        com, quat = drift(state.com, state.quat, state.velocity, state.momentum, inverse, h / 2)
        half = state._replace(com=com, quat=quat)
        undeformed = torch.zeros_like(half.u)
        bodies = self._kinematics(scene, half._replace(u=undeformed, du=undeformed))
        applied, twist = external.wrench(bodies.points, bodies.com, t, h)
        mass = w.mass[..., None].clamp_min(1e-6)
        acceleration = applied / mass + w.gravity[:, None]
        spin = angular_velocity(half.momentum + h * twist / mass, inverse, bodies.R)
        free = torch.cat([half.velocity + h * acceleration, spin], -1)
        velocity, accelerations = self._contacts(scene, bodies, free, acceleration, external.pinned, h)
        inertia = bodies.R @ w.body_inertia @ bodies.R.mT
        velocity, momentum = velocity[..., :3] * movable, matvec(inertia, velocity[..., 3:]) * movable
        com, quat = drift(com, quat, velocity, momentum, inverse, h / 2)
        accelerations = matvec(bodies.R.mT[:, :, None], accelerations)
        return half._replace(com=com, quat=quat, velocity=velocity, momentum=momentum), accelerations

    def _contacts(
        self, scene: FieldScene, bodies: BodyKinematics, free: Float[Tensor, "1 o 6"],
        acceleration: Float[Tensor, "1 o 3"], pinned: Bool[Tensor, "1 o"], dt: float,
    ) -> tuple[Float[Tensor, "1 o 6"], Float[Tensor, "1 o n 3"]]:  # fmt: skip
        """Velocities after the step, and accelerations of the keypoints by contact [m/s^2]."""
        w = scene.shape.initial
        before = torch.cat([bodies.velocity, bodies.spin], -1)[0]
        found = self._candidates(scene, bodies, pinned[0], dt)
        local = torch.zeros_like(bodies.arm)
        if not len(found.a):
            return free, local
        fixed = found.a == found.b
        at = found.at - torch.where(fixed, 0.0, found.gap / 2)[:, None] * found.normal
        arm_a, arm_b = at - bodies.com[0, found.a], at - bodies.com[0, found.b]
        approach = _speed(before, found.a, arm_a) - torch.where(fixed[:, None], 0.0, _speed(before, found.b, arm_b))
        approach = (approach * found.normal).sum(-1)
        pull = acceleration[0, found.a] - torch.where(fixed[:, None], 0.0, acceleration[0, found.b])
        gained = dt / 2 * (pull * found.normal).sum(-1)  # until the middle of the step, and again after it
        loss = w.loss[0, found.a].maximum(w.loss[0, found.b])
        rebound = -torch.exp(-math.pi / 2 * loss) * (approach + gained) + gained
        rebounds = (approach < -REBOUND_SPEED) & (found.gap + dt * approach < 0)
        target = torch.where(found.gap > 0, -found.gap / dt, (-RECOVERY / dt * found.gap).clamp_max(MAX_RECOVERY_SPEED))
        target = torch.where(rebounds, target.maximum(rebound), target)
        friction = w.friction[0, found.a].maximum(w.friction[0, found.b])
        inertia = w.mass[0, :, None, None] * (bodies.R @ w.body_inertia @ bodies.R.mT)[0]
        system = BodyInertia(w.mass[0], inertia, bodies.inverse[0] / w.mass[0, :, None, None], free[0], pinned[0])
        contacts = Contacts(found.a, found.b, fixed, found.normal, arm_a, arm_b, target, friction)
        v, impulse = solve(BodyInertia(*map(_double, system)), Contacts(*map(_double, contacts)), before.double())
        per_mass = (impulse / dt).to(free)
        for body, keypoint, F in ((found.a, found.keypoint, per_mass),
                                  (found.b, found.other, torch.where(fixed[:, None], 0.0, -per_mass))):  # fmt: skip
            F = F / (w.mass[0, body] * w.mass_fraction[0, body, keypoint].clamp_min(1e-9))[:, None]
            local = local.index_put((torch.zeros_like(body), body, keypoint), F, accumulate=True)
        return v.to(free)[None], local

    def _candidates(
        self, scene: FieldScene, bodies: BodyKinematics, pinned: Bool[Tensor, "o"], dt: float
    ) -> _NearPoints:  # fmt: skip
        """Samples of each body near another one, near the floor or near a wall, at present."""
        s, w = self.surfaces, scene.shape.initial
        motion = torch.cat([bodies.velocity, bodies.spin], -1)[0]
        o, k = s.samples.shape
        body = torch.arange(o, device=s.samples.device)[:, None].expand(o, k)
        real = s.samples >= 0
        row = s.samples.clamp_min(0)
        x, R = bodies.points[0], bodies.R[0]
        at = x[body, row]  # o k 3
        radius = (scene.shape.arm[0].norm(dim=-1) * w.valid[0]).amax(-1)
        reach = MARGIN + dt * (motion[:, :3].norm(dim=-1) + motion[:, 3:].norm(dim=-1) * radius)
        parts = [self._at_planes(scene, bodies, at, row, reach, pinned)]
        apart = (bodies.com[0, :, None] - bodies.com[0]).norm(dim=-1) - radius[:, None] - radius
        near = (apart < reach[:, None] + reach) & ~(pinned[:, None] & pinned)
        near = near & ~torch.eye(o, dtype=torch.bool, device=near.device)
        round_ = s.radius > 0
        parts.append(self._of_balls(bodies, reach, *(near & round_[:, None]).nonzero().T))
        a, b = (near & ~round_[:, None] & ~round_).nonzero().T
        if len(a):
            local = (at[a] - bodies.com[0, b, None]) @ R[b]  # p k 3
            limit = (reach[a] + reach[b])[:, None, None]
            low, high = s.low[b, None], s.low[b, None] + s.spacing[b, None, None] * (s.shape[b, None] - 1)
            inside = ((local > low - limit) & (local < high + limit)).all(-1) & real[a]
            p, q = inside.nonzero().T
            a, b, local = a[p], b[p], local[p, q]
            other = s.nearest_keypoint(b, local)
            depth, slope = s.look_up(b, local)
            normal = -matvec(R[b], slope)
            facing = -(matvec(R[a], s.normals[a, q]) * normal).sum(-1)
            gap = -depth + s.overlap[a, b]
            facing = facing - torch.where(s.flat[a, q], MIN_FACING_OF_FACE, MIN_FACING)
            keep = ((gap < reach[a] + reach[b]) & (facing > 0)).nonzero()[:, 0]
            parts.append(_NearPoints(*(y[keep] for y in (a, b, row[a, q], other, gap, normal, at[a, q]))))
        return _NearPoints(*(torch.cat(each) for each in zip(*parts, strict=True)))

    def _of_balls(
        self, bodies: BodyKinematics, reach: Float[Tensor, "o"], a: Int[Tensor, "p"],
        b: Int[Tensor, "p"],
    ) -> _NearPoints:  # fmt: skip
        """The point of each ball a that is nearest to a body b."""
        s, R = self.surfaces, bodies.R[0]
        centre = bodies.com[0, a] + matvec(R[a], s.centre[a])
        other_centre = bodies.com[0, b] + matvec(R[b], s.centre[b])
        at = centre + s.radius[a, None] * _unit(other_centre - centre)
        gap, normal = (centre - other_centre).norm(dim=-1) - s.radius[a] - s.radius[b], _unit(centre - other_centre)
        rough = s.radius[b] == 0
        for _ in range(CLOSEST_POINT_STEPS):
            local = matvec(R[b].mT, at - bodies.com[0, b])
            depth, slope = s.look_up(b, local)
            gap = torch.where(rough, -depth, gap)
            normal = torch.where(rough[:, None], -matvec(R[b], slope), normal)
            at = centre - s.radius[a, None] * normal
        own, other = (s.nearest_keypoint(i, matvec(R[i].mT, at - bodies.com[0, i])) for i in (a, b))
        gap = gap + s.overlap[a, b]
        keep = (gap < reach[a] + reach[b]).nonzero()[:, 0]
        return _NearPoints(*(y[keep] for y in (a, b, own, other, gap, normal, at)))

    def _at_planes(
        self, scene: FieldScene, bodies: BodyKinematics, at: Float[Tensor, "o k 3"], row: Int[Tensor, "o k"],
        reach: Float[Tensor, "o"], pinned: Bool[Tensor, "o"],
    ) -> _NearPoints:  # fmt: skip
        """Samples, and lowest points of balls, near floor, walls and ceiling."""
        s = self.surfaces
        eye = torch.eye(3, dtype=at.dtype, device=at.device)
        inward = torch.cat([eye, -eye])
        centre = bodies.com[0] + matvec(bodies.R[0], s.centre)
        ends = centre[:, None] - s.radius[:, None, None] * inward  # o 6 3
        low, high = scene.shape.initial.box[0].unbind(1)
        across = ends.unflatten(1, (2, 3)).diagonal(dim1=2, dim2=3)  # o 2 3
        of_ball = torch.cat([across[:, 0] - low, high - across[:, 1]], -1)
        gap = torch.cat([at - low[:, None], high[:, None] - at], -1)  # o k 6
        round_ = s.radius > 0
        near = (gap < reach[:, None, None]) & (s.samples >= 0)[..., None] & ~(pinned | round_)[:, None, None]
        a, q, side = near.nonzero().T
        c, end = ((of_ball < reach[:, None]) & (round_ & ~pinned)[:, None]).nonzero().T
        touching = s.nearest_keypoint(c, matvec(bodies.R[0, c].mT, ends[c, end] - bodies.com[0, c]))
        body, keypoint = torch.cat([a, c]), torch.cat([row[a, q], touching])
        return _NearPoints(
            body, body, keypoint, keypoint, torch.cat([gap[a, q, side], of_ball[c, end]]),
            inward[torch.cat([side, end])], torch.cat([at[a, q], ends[c, end]]),
        )  # fmt: skip


def _unit(x: Float[Tensor, "r 3"]) -> Float[Tensor, "r 3"]:
    return x / x.norm(dim=-1, keepdim=True).clamp_min(1e-12)


def _speed(motion: Float[Tensor, "o 6"], body: Int[Tensor, "r"], arm: Float[Tensor, "r 3"]) -> Float[Tensor, "r 3"]:
    return motion[body, :3] + torch.linalg.cross(motion[body, 3:], arm)


def _double(x: Tensor) -> Tensor:
    return x.double() if x.is_floating_point() else x
