"""Rigid motion with solved contacts: one launch for all substeps of a frame, with a group of threads per scene.

On a GPU a group is a thread block; on the CPU it is one thread, so scenes are simulated one after the other.
"""

from __future__ import annotations

import math

import torch
import warp as wp
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.kernels.field.contact_impulses import (
    FRICTION_REGULARISATION,
    NORMAL_REGULARISATION,
    BodyProperties,
    Contacts,
    ContactSolver,
    Velocities,
    contact_solver,
    effective_response,
)
from stages.core.kernels.field.contact_patches import Patches, add_load, single, spread, sum_patch
from stages.core.kernels.field.contact_search import NONE, SLOTS, CollisionWorld, Found, contact_in_slot, search
from stages.core.kernels.field.contact_turns import solve_in_turns
from stages.core.kernels.field.groups import GroupThread, wait_for_group
from stages.core.kernels.field.near_points import MARGIN, BodyMotion, NearPoint
from stages.core.kernels.field.rigid_motion import matrix, rotated, spin_of
from stages.core.kernels.interop import device_of, empty_arrays, launch, with_arrays

f64 = wp.float64
GROUP = 128  # threads per scene on a GPU
CONTACTS_PER_BODY = 512  # contacts per body for which memory is allocated; further contacts are dropped
RECOVERY = wp.constant(0.2)  # fraction of a penetration that is removed in one substep (Baumgarte 1972)
MAX_RECOVERY_SPEED = wp.constant(0.3)  # [m/s] limit of the speed at which penetration is removed; near REBOUND_SPEED
REBOUND_SPEED = wp.constant(0.2)  # smallest approach speed that rebounds [m/s]: a fall of a hundredth of an object
ROUGHNESS = wp.constant(0.005)  # gap up to which points take part in an impact [m]: the accuracy of the surfaces
HALF_PI = wp.constant(math.pi / 2)


@wp.func
def _double(x: wp.vec3) -> wp.vec3d:
    return wp.vec3d(f64(x[0]), f64(x[1]), f64(x[2]))


@wp.func
def _double_matrix(x: wp.mat33) -> wp.mat33d:
    out = wp.mat33d()
    for i in range(3):
        for j in range(3):
            out[i, j] = f64(x[i, j])
    return out


@wp.func
def _drifted(m: BodyMotion, bodies: BodyProperties, scene: int, i: int, h: float):
    """Advance a body by free motion for h [s]."""
    quat = m.quat[scene, i]
    L = m.momentum[scene, i]
    inverse = bodies.inverse[scene, i]
    spin = spin_of(L, inverse, matrix(quat))
    spin = spin_of(L, inverse, matrix(rotated(quat, h / 2.0 * spin)))
    m.com[scene, i] = m.com[scene, i] + h * m.velocity[scene, i]
    m.quat[scene, i] = rotated(quat, h * spin)


@wp.func
def _begin(bodies: BodyProperties, world: CollisionWorld, solver: ContactSolver, scene: int, i: int):
    """First half of a substep for body i: half a drift step, and the velocities that it would get without contact."""
    h = world.motion.step
    _drifted(world.motion, bodies, scene, i, h / 2.0)
    R = matrix(world.motion.quat[scene, i])
    inverse = bodies.inverse[scene, i]
    mass = f64(bodies.mass[scene, i])
    velocity = world.motion.velocity[scene, i]
    momentum = world.motion.momentum[scene, i]
    spin = spin_of(momentum, inverse, R)
    later = spin_of(momentum + h * bodies.twist[scene, i], inverse, R)
    world.motion.spin[scene, i] = spin
    world.motion.R[scene, i] = R
    reach = world.surfaces.reach[i]
    # upper bound of the distance that the body's surface travels in a substep without contact [m]
    way = h * (wp.length(velocity + h * bodies.acceleration[scene, i]) + wp.length(later) * reach)
    world.motion.margin[scene, i] = wp.max(MARGIN + h * (wp.length(velocity) + wp.length(spin) * reach), way)
    turn = _double_matrix(R)
    solver.inertia.tensor[scene, i] = mass * (turn * _double_matrix(bodies.inertia[scene, i]) * wp.transpose(turn))
    solver.inertia.inverse[scene, i] = turn * _double_matrix(inverse) * wp.transpose(turn) / mass
    solver.velocities.linear[scene, i] = _double(velocity)
    solver.velocities.angular[scene, i] = _double(spin)
    solver.free.linear[scene, i] = wp.vec3d()
    solver.free.angular[scene, i] = wp.vec3d()
    solver.impacted.linear[scene, i] = wp.vec3d()
    solver.impacted.angular[scene, i] = wp.vec3d()
    if not world.motion.pinned[scene, i]:
        solver.impacted.linear[scene, i] = _double(velocity)
        solver.impacted.angular[scene, i] = _double(spin)
        solver.free.linear[scene, i] = _double(velocity + h * bodies.acceleration[scene, i])
        solver.free.angular[scene, i] = _double(later)


@wp.func
def _add_contact(bodies: BodyProperties, m: BodyMotion, solver: ContactSolver, near: NearPoint, scene: int, i: int):
    """Write the contact at point `near` as contact i of a scene."""
    h = m.step
    a = near.a
    b = near.b
    at = near.at
    if b != a:
        at = near.at - near.gap / 2.0 * near.normal
    arm_a = at - m.com[scene, a]
    arm_b = at - m.com[scene, b]
    pull = bodies.acceleration[scene, a]
    loss = bodies.loss[scene, a]
    friction = bodies.friction[scene, a]
    response = effective_response(solver.inertia, scene, a, _double(arm_a))
    if b != a:
        pull -= bodies.acceleration[scene, b]
        loss = wp.max(loss, bodies.loss[scene, b])
        friction = wp.max(friction, bodies.friction[scene, b])
        response += effective_response(solver.inertia, scene, b, _double(arm_b))
    resting = -near.gap / h
    if near.gap <= 0.0:
        resting = wp.min(-RECOVERY / h * near.gap, MAX_RECOVERY_SPEED)
    solver.contacts.a[scene, i] = a
    solver.contacts.b[scene, i] = b
    solver.contacts.normal[scene, i] = _double(near.normal)
    solver.contacts.arm_a[scene, i] = _double(arm_a)
    solver.contacts.arm_b[scene, i] = _double(arm_b)
    solver.contacts.resting[scene, i] = f64(resting)
    solver.contacts.least[scene, i] = f64(wp.min(-REBOUND_SPEED, (ROUGHNESS - near.gap) / h))
    solver.contacts.gained[scene, i] = f64(h / 2.0 * wp.dot(pull, near.normal))
    solver.contacts.restitution[scene, i] = f64(wp.exp(-HALF_PI * loss))
    solver.contacts.friction[scene, i] = f64(friction)
    solver.contacts.R_n[scene, i] = NORMAL_REGULARISATION * response
    solver.contacts.R_t[scene, i] = FRICTION_REGULARISATION * response


@wp.func
def _end(bodies: BodyProperties, m: BodyMotion, v: Velocities, scene: int, i: int):
    """Second half of a substep for body i: set its velocities to the solution, and drift."""
    velocity = single(v.linear[scene, i])
    R = m.R[scene, i]
    momentum = R * (bodies.inertia[scene, i] * (wp.transpose(R) * single(v.angular[scene, i])))
    if m.pinned[scene, i]:
        velocity = wp.vec3()
        momentum = wp.vec3()
    m.velocity[scene, i] = velocity
    m.momentum[scene, i] = momentum
    _drifted(m, bodies, scene, i, m.step / 2.0)


@wp.func
def _list_contacts(c: Contacts, found: Found, scene: int):
    """Assign a range of contacts to each pair, and list the pairs that have contacts."""
    pairs = found.count.shape[1]
    total = int(0)
    active = int(0)
    for p in range(pairs):
        c.first[scene, p] = total
        total = wp.min(total + found.count[scene, p], c.target.shape[1])
        if total > c.first[scene, p]:
            c.active[scene, active] = p
            active += 1
    c.first[scene, pairs] = total
    c.active_count[scene] = active


@wp.kernel(enable_backward=False)
def _frames(
    bodies: BodyProperties, world: CollisionWorld, solver: ContactSolver, patches: Patches, substeps: int, lanes: int
):  # fmt: skip
    thread = GroupThread()
    thread.scene = wp.tid() // lanes
    thread.lane = wp.tid() % lanes
    thread.lanes = lanes
    scene = thread.scene
    count = world.surfaces.samples.shape[0]
    for _ in range(substeps):
        for i in range(thread.lane, count, lanes):
            _begin(bodies, world, solver, scene, i)
        wait_for_group()
        search(world, thread)
        if thread.lane == 0:
            _list_contacts(solver.contacts, world.found, scene)
        wait_for_group()
        for k in range(thread.lane, solver.contacts.active_count[scene], lanes):
            p = solver.contacts.active[scene, k]
            i = solver.contacts.first[scene, p]
            for slot in range(SLOTS):
                if world.found.row[scene, p * SLOTS + slot] != NONE and i < solver.contacts.first[scene, p + 1]:
                    _add_contact(bodies, world.motion, solver, contact_in_slot(world, scene, p, slot), scene, i)
                    i += 1
        wait_for_group()
        if solver.contacts.active_count[scene] > 0:
            solve_in_turns(solver, thread)
            for k in range(thread.lane, solver.contacts.active_count[scene], lanes):
                sum_patch(world, solver.contacts, patches, scene, solver.contacts.active[scene, k])
            wait_for_group()
            for i in range(thread.lane, count, lanes):
                for k in range(solver.contacts.active_count[scene]):
                    p = solver.contacts.active[scene, k]
                    if p // count == i or p % count == i:
                        add_load(solver.contacts, patches, scene, i, p)
            spread(bodies, world, solver.contacts, patches, thread, 1.0 / (world.motion.step * float(substeps)))
        else:
            for i in range(thread.lane, count, lanes):
                solver.velocities.linear[scene, i] = solver.free.linear[scene, i]
                solver.velocities.angular[scene, i] = solver.free.angular[scene, i]
        for i in range(thread.lane, count, lanes):
            _end(bodies, world.motion, solver.velocities, scene, i)
        wait_for_group()


class RigidFrames:
    """Rigid motion of batches of `scenes` scenes whose bodies have the given surfaces.

    `surfaces` are the fields of BodySurfaces.
    """

    def __init__(self, surfaces: dict[str, Tensor], scenes: int, keypoints: int):
        self.shape = b, o, _ = scenes, len(surfaces["low"]), keypoints
        self.device = device = device_of(surfaces["depth"])
        self.group = 1 if device == "cpu" else GROUP
        samples = surfaces["samples"].shape[1]
        slots, each = (b, o * o * SLOTS), (b, o * o, samples)
        self.world = CollisionWorld()
        with_arrays(self.world.surfaces, surfaces)
        self.world.motion = empty_arrays(BodyMotion, device, (b, o), low=None, high=None, pinned=None)
        self.world.found = empty_arrays(
            Found, device, (b, o * o), score=slots, row=slots, side=each, gap=each, other=each, near=each
        )
        self.solver = contact_solver(device, b, o, CONTACTS_PER_BODY * o, self.group)
        self.patches = empty_arrays(Patches, device, (b, o * o), accelerations=None, load=None, moment=None)

    def advance(
        self, bodies: dict[str, Tensor], box: Float[Tensor, "b o 2 3"], pinned: Bool[Tensor, "b o"],
        state: tuple[Tensor, Tensor, Tensor, Tensor], substeps: int, h: float,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Float[Tensor, "b o n 3"], Float[Tensor, "b o 6"]]:  # fmt: skip
        """Advance the state by `substeps` of h [s].

        `state` is com (b, o, 3), quat (b, o, 4), velocity (b, o, 3) and angular momentum per unit of mass (b, o, 3).
        `bodies` are the fields of BodyProperties.

        Returns the new state, the mean accelerations of the keypoints by contact [m/s^2] in the bodies' frames, and the
        mean contact force [N] on each body with its torque about the centre of mass [N m].
        """
        names = "com", "quat", "velocity", "momentum"
        new = {k: x.clone(memory_format=torch.contiguous_format) for k, x in zip(names, state, strict=True)}
        accelerations = new["com"].new_zeros(*self.shape, 3)
        load = new["com"].new_zeros(2, *self.shape[:2], 3)
        with_arrays(self.world.motion, new | {"low": box[:, :, 0], "high": box[:, :, 1], "pinned": pinned})
        self.world.motion.step = h
        with_arrays(self.solver.inertia, {"mass": bodies["mass"], "pinned": pinned})
        with_arrays(self.patches, {"accelerations": accelerations, "load": load[0], "moment": load[1]})
        launch(
            _frames, self.shape[0] * self.group,
            [with_arrays(BodyProperties(), bodies), self.world, self.solver, self.patches, substeps, self.group],
            device=self.device, block_dim=self.group,
        )  # fmt: skip
        return *new.values(), accelerations, torch.cat([*load], -1) / (substeps * h)
