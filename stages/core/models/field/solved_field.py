"""The force field with solved contacts: rigid motion by `kernels.field.rigid_frames`, deformation by the network.

For one scene whose bodies' surfaces are known. In the published simulation, from which `ForceField` has learned,
contacts are sticky and have a single coefficient of friction. Here a contact solver prevents penetration, with the
friction and restitution of the materials, and the learned deformation responds to its contact forces. Contacts use the
undeformed surfaces: the network's displacements under a sustained load do not become constant, so bodies on deformed
surfaces did not come to rest.
"""

from __future__ import annotations

from dataclasses import fields

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.rotations import matrix
from stages.core.kernels.field.rigid_frames import RigidFrames
from stages.core.kernels.threads import small_operations
from stages.core.models.dynamics import FRAME
from stages.core.models.external_forces import ExternalForces
from stages.core.models.field.body_surfaces import BodySurfaces
from stages.core.models.field.deformation import DeformationInputs, bounded
from stages.core.models.field.equivariant import matvec
from stages.core.models.field.force_field import ForceField, has_small_operations, without_pinned
from stages.core.models.field.state import MAX_SPEED, BodyState, FieldScene

SUBSTEPS = 4  # substeps of rigid motion per step: contacts are linearised, so a body may rotate only little in each


class SolvedForceField(ForceField):
    """`field` with solved contacts between bodies with the given surfaces, for batches of one scene.

    `load` is the mean contact force [N] on each body in the last step, and its torque about the centre of mass [N m].
    """

    def __init__(self, field: ForceField, surfaces: BodySurfaces):
        super().__init__(**field.config)
        self.load_state_dict(field.state_dict())
        self.to(next(field.parameters()).device)
        self.surfaces = surfaces
        self._frames: RigidFrames | None = None
        self.load: Float[Tensor, "b o 6"] | None = None

    def step(
        self, scene: FieldScene, state: BodyState, t: Tensor | float, dt: float, external: ExternalForces
    ) -> BodyState:
        """As ForceField.step, with velocities from the contact solver."""
        if has_small_operations(scene.shape.arm):
            with small_operations():
                return self._solved_step(scene, state, t, dt, external)
        return self._solved_step(scene, state, t, dt, external)

    def derivative(self, scene: FieldScene, t: Tensor | float, state: BodyState, external: ExternalForces) -> BodyState:
        """Rate of change of the state, for ODE solvers: the mean over a step of one FRAME."""
        new = self._solved_step(scene, state, t, FRAME, external)
        return BodyState(*((y - x) / FRAME for x, y in zip(state, new, strict=True)))

    def _use_fused_step(self, scene: FieldScene) -> bool:
        return False

    def _solved_step(
        self, scene: FieldScene, state: BodyState, t: Tensor | float, dt: float, external: ExternalForces
    ) -> BodyState:
        movable = ~external.pinned[..., None]
        w, shape = scene.shape.initial, scene.shape
        state = without_pinned(state, movable)
        state = state._replace(u=bounded(shape, state.u + dt / 2 * state.du))
        state, accelerations = self._rigid_motion(scene, state, (t, dt), external)
        if self.deformation is None:
            return state
        inputs = DeformationInputs(state.u, state.du, accelerations, matvec(matrix(state.quat).mT, w.gravity[:, None]))
        internal = self.deformation(shape, scene.embedding, scene.compliance_scale, inputs)
        k, c = scene.stiffness[..., None, None], scene.damping[..., None, None]
        du = (state.du + dt * (internal - k * state.u)) / (1 + dt * c + dt * dt / 2 * k)
        du = bounded(shape, du / MAX_SPEED) * MAX_SPEED * movable[..., None]
        return state._replace(du=du, u=bounded(shape, state.u + dt / 2 * du))

    def _rigid_motion(
        self, scene: FieldScene, state: BodyState, interval: tuple[Tensor | float, float], external: ExternalForces
    ) -> tuple[BodyState, Float[Tensor, "b o n 3"]]:
        """Advance the rigid motion over the `interval` (t, dt) [s].

        Returns the new state, and the mean accelerations of the keypoints by contact [m/s^2] in the bodies' frames.
        External forces act at the initial positions of the keypoints.
        """
        w, shape, (_, dt) = scene.shape.initial, scene.shape, interval
        applied, twist = external.wrench(self.points(scene, state), state.com, *interval)
        mass = w.mass[..., None].clamp_min(1e-6)
        bodies = {
            "mass": w.mass, "inertia": w.body_inertia, "inverse": shape.inverse, "friction": w.friction, "loss": w.loss,
            "acceleration": applied / mass + w.gravity[:, None], "twist": twist / mass,
            "mass_fraction": w.mass_fraction,
        }  # fmt: skip
        if self._frames is None or self._frames.shape != shape.arm.shape[:3]:
            surfaces = {f.name: getattr(self.surfaces, f.name) for f in fields(self.surfaces)}
            self._frames = RigidFrames(surfaces, *shape.arm.shape[::2])
        rigid = state.com, state.quat, state.velocity, state.momentum
        *rigid, accelerations, load = self._frames.advance(
            bodies, w.box, external.pinned, rigid, SUBSTEPS, dt / SUBSTEPS
        )  # fmt: skip
        if self.load is None or self.load.shape != load.shape:
            self.load = torch.empty_like(load)
        self.load.copy_(load)  # keeps its address, as CUDA graphs need
        return BodyState(*rigid, state.u, state.du), accelerations
