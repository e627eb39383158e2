"""Rigid motion with solved contacts: one launch for all substeps of a frame, a group of threads for each scene.

On a GPU a group is a block of threads; on the CPU it is one thread, so that scenes are simulated one after the other.
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
    Contacts,
    ContactSolver,
    Velocities,
    contact_solver,
    effective_response,
)
from stages.core.kernels.field.contact_search import (
    MARGIN,
    NONE,
    SLOTS,
    BodyMotion,
    CollisionWorld,
    Found,
    NearPoint,
    SurfaceArrays,
    contact_in_slot,
    search,
)
from stages.core.kernels.field.contact_solve import solve
from stages.core.kernels.field.groups import GroupThread, wait_for_group
from stages.core.kernels.field.rigid_motion import matrix, rotated, spin_of
from stages.core.kernels.interop import device_of, empty_arrays, launch, with_arrays

f64 = wp.float64
GROUP = 128  # threads of a scene on a GPU
CONTACTS_PER_BODY = 512  # room for contacts; more are left out
RECOVERY = wp.constant(0.2)  # share of an overlap that is removed in a step (Baumgarte 1972)
MAX_RECOVERY_SPEED = wp.constant(0.3)  # [m/s], about the speed below which bodies do not rebound
REBOUND_SPEED = wp.constant(0.2)  # least speed of approach that rebounds [m/s]: of a fall of a hundredth of an object
ROUGHNESS = wp.constant(0.005)  # gap up to which points take part in an impact, as surfaces are known to [m]
PATCH = wp.constant(0.02)  # samples with gaps this much larger than the least share a contact's force [m]
HALF_PI = wp.constant(math.pi / 2)


@wp.struct
class BodyProperties:
    """Properties of the bodies of each scene."""

    mass: wp.array2d[float]  # [kg]
    inertia: wp.array2d[wp.mat33]  # per unit of mass, rest orientation [m^2]
    inverse: wp.array2d[wp.mat33]
    friction: wp.array2d[float]
    loss: wp.array2d[float]
    acceleration: wp.array2d[wp.vec3]  # without contact, of the centres of mass [m/s^2]
    twist: wp.array2d[wp.vec3]  # torque per unit of mass [m^2/s^2]
    mass_fraction: wp.array3d[float]  # of keypoints


@wp.struct
class Patches:
    """How the contacts of each pair are spread over its nodes, the samples that touch: at x each bears
    share + turn x (x - centre).
    """

    limit: wp.array2d[float]  # of the nodes' gaps [m]
    centre: wp.array2d[wp.vec3]
    share: wp.array2d[wp.vec3]
    turn: wp.array2d[wp.vec3]
    accelerations: wp.array3d[wp.vec3]  # of keypoints in the bodies' frames; the result
    load: wp.array2d[wp.vec3]  # sum of all impulses on each body; the result
    moment: wp.array2d[wp.vec3]  # that about its centre of mass


@wp.func
def _double(x: wp.vec3) -> wp.vec3d:
    return wp.vec3d(f64(x[0]), f64(x[1]), f64(x[2]))


@wp.func
def _single(x: wp.vec3d) -> wp.vec3:
    return wp.vec3(float(x[0]), float(x[1]), float(x[2]))


@wp.func
def _double_matrix(x: wp.mat33) -> wp.mat33d:
    out = wp.mat33d()
    for i in range(3):
        for j in range(3):
            out[i, j] = f64(x[i, j])
    return out


@wp.func
def _drifted(m: BodyMotion, bodies: BodyProperties, scene: int, i: int, h: float):
    """Free motion of a body for h [s]."""
    quat = m.quat[scene, i]
    L = m.momentum[scene, i]
    inverse = bodies.inverse[scene, i]
    spin = spin_of(L, inverse, matrix(quat))
    spin = spin_of(L, inverse, matrix(rotated(quat, h / 2.0 * spin)))
    m.com[scene, i] = m.com[scene, i] + h * m.velocity[scene, i]
    m.quat[scene, i] = rotated(quat, h * spin)


@wp.func
def _begin(bodies: BodyProperties, world: CollisionWorld, solver: ContactSolver, scene: int, i: int):
    """The first half of a substep for body i, and its velocities without contact."""
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
    world.motion.margin[scene, i] = MARGIN + h * (wp.length(velocity) + wp.length(spin) * world.surfaces.reach[i])
    turn = _double_matrix(R)
    solver.inertia.tensor[scene, i] = mass * (turn * _double_matrix(bodies.inertia[scene, i]) * wp.transpose(turn))
    solver.inertia.inverse[scene, i] = turn * _double_matrix(inverse) * wp.transpose(turn) / mass
    solver.velocities.linear[scene, i] = _double(velocity)
    solver.velocities.angular[scene, i] = _double(spin)
    solver.free.linear[scene, i] = wp.vec3d()
    solver.free.angular[scene, i] = wp.vec3d()
    if not world.motion.pinned[scene, i]:
        solver.free.linear[scene, i] = _double(velocity + h * bodies.acceleration[scene, i])
        solver.free.angular[scene, i] = _double(later)


@wp.func
def _add_contact(bodies: BodyProperties, m: BodyMotion, solver: ContactSolver, near: NearPoint, scene: int, i: int):
    """Write the contact at a point as contact i."""
    h = m.step
    a = near.a
    b = near.b
    at = near.at
    if b != a:
        at = near.at - near.gap / 2.0 * near.normal
    arm_a = at - m.com[scene, a]
    arm_b = at - m.com[scene, b]
    speed = m.velocity[scene, a] + wp.cross(m.spin[scene, a], arm_a)
    pull = bodies.acceleration[scene, a]
    loss = bodies.loss[scene, a]
    friction = bodies.friction[scene, a]
    response = effective_response(solver.inertia, scene, a, _double(arm_a))
    if b != a:
        speed -= m.velocity[scene, b] + wp.cross(m.spin[scene, b], arm_b)
        pull -= bodies.acceleration[scene, b]
        loss = wp.max(loss, bodies.loss[scene, b])
        friction = wp.max(friction, bodies.friction[scene, b])
        response += effective_response(solver.inertia, scene, b, _double(arm_b))
    approach = wp.dot(speed, near.normal)
    gained = h / 2.0 * wp.dot(pull, near.normal)  # until the middle of the step, and again after it
    target = -near.gap / h
    if near.gap <= 0.0:
        target = wp.min(-RECOVERY / h * near.gap, MAX_RECOVERY_SPEED)
    if approach < -REBOUND_SPEED and near.gap + h * approach < ROUGHNESS:
        target = wp.max(target, gained - wp.exp(-HALF_PI * loss) * (approach + gained))
    solver.contacts.a[scene, i] = a
    solver.contacts.b[scene, i] = b
    solver.contacts.normal[scene, i] = _double(near.normal)
    solver.contacts.arm_a[scene, i] = _double(arm_a)
    solver.contacts.arm_b[scene, i] = _double(arm_b)
    solver.contacts.target[scene, i] = f64(target)
    solver.contacts.friction[scene, i] = f64(friction)
    solver.contacts.R_n[scene, i] = NORMAL_REGULARISATION * response
    solver.contacts.R_t[scene, i] = FRICTION_REGULARISATION * response


@wp.func
def _end(bodies: BodyProperties, m: BodyMotion, v: Velocities, scene: int, i: int):
    """The second half of a substep."""
    velocity = _single(v.linear[scene, i])
    R = m.R[scene, i]
    momentum = R * (bodies.inertia[scene, i] * (wp.transpose(R) * _single(v.angular[scene, i])))
    if m.pinned[scene, i]:
        velocity = wp.vec3()
        momentum = wp.vec3()
    m.velocity[scene, i] = velocity
    m.momentum[scene, i] = momentum
    _drifted(m, bodies, scene, i, m.step / 2.0)


@wp.func
def _place(w: CollisionWorld, scene: int, a: int, q: int) -> wp.vec3:
    return w.motion.com[scene, a] + w.motion.R[scene, a] * w.surfaces.samples[a, q]


@wp.func
def _least_gap(found: Found, scene: int, pair: int) -> float:
    out = float(1.0e30)
    for k in range(found.near_count[scene, pair]):
        out = wp.min(out, found.gap[scene, pair, found.near[scene, pair, k]])
    return out


@wp.func
def _sum_patch(w: CollisionWorld, c: Contacts, patches: Patches, scene: int, pair: int):
    """Force and torque of the contacts of a pair, and the nodes that they are spread over."""
    a = pair // w.surfaces.near.shape[0]
    limit = _least_gap(w.found, scene, pair) + PATCH
    nodes = int(0)
    centre = wp.vec3()
    for k in range(w.found.near_count[scene, pair]):
        q = w.found.near[scene, pair, k]
        if w.found.gap[scene, pair, q] < limit:
            nodes += 1
            centre += _place(w, scene, a, q)
    centre = centre / float(wp.max(nodes, 1))
    moment = wp.mat33()
    for k in range(w.found.near_count[scene, pair]):
        q = w.found.near[scene, pair, k]
        if w.found.gap[scene, pair, q] < limit:
            arm = _place(w, scene, a, q) - centre
            moment += wp.dot(arm, arm) * wp.identity(3, dtype=float) - wp.outer(arm, arm)
    force = wp.vec3()
    torque = wp.vec3()
    for i in range(c.first[scene, pair], c.first[scene, pair + 1]):
        J = _single(c.impulse[scene, i])
        force += J
        torque += wp.cross(_single(c.arm_a[scene, i]) + w.motion.com[scene, a] - centre, J)
    patches.limit[scene, pair] = limit
    patches.centre[scene, pair] = centre
    patches.share[scene, pair] = force / float(wp.max(nodes, 1))
    # a multiple of the identity: nodes on a line cannot bear a torque about it
    extra = 1.0e-2 * wp.trace(moment) + 1.0e-9
    patches.turn[scene, pair] = wp.inverse(moment + extra * wp.identity(3, dtype=float)) * torque


@wp.func
def _spread(
    bodies: BodyProperties, w: CollisionWorld, c: Contacts, patches: Patches, thread: GroupThread, weight: float
):  # fmt: skip
    """Add the accelerations of the keypoints by all contacts, times `weight`; threads share those of each body.

    Forces and torques are divided among the nodes as by interpolation elements (RBE3) of finite-element codes.
    """
    scene = thread.scene
    count = w.surfaces.near.shape[0]
    parts = wp.max(thread.lanes // count, 1)
    for task in range(thread.lane, count * parts, thread.lanes):
        i = task // parts
        part = task % parts
        to_body = wp.transpose(w.motion.R[scene, i])
        for active in range(c.active_count[scene]):
            pair = c.active[scene, active]
            a = pair // count
            if a == i or pair % count == i:
                for k in range(w.found.near_count[scene, pair]):
                    q = w.found.near[scene, pair, k]
                    row = w.surfaces.near[a, q]
                    if i != a:
                        row = w.found.other[scene, pair, q]
                    if row % parts == part and w.found.gap[scene, pair, q] < patches.limit[scene, pair]:
                        arm = _place(w, scene, a, q) - patches.centre[scene, pair]
                        F = weight * (patches.share[scene, pair] + wp.cross(patches.turn[scene, pair], arm))
                        if i != a:
                            F = -F
                        mass = bodies.mass[scene, i] * wp.max(bodies.mass_fraction[scene, i, row], 1.0e-9)
                        before = patches.accelerations[scene, i, row]
                        patches.accelerations[scene, i, row] = before + to_body * F / mass


@wp.func
def _add_load(c: Contacts, patches: Patches, scene: int, i: int, pair: int):
    """Add the impulses of a pair's contacts on body i."""
    force = wp.vec3d()
    moment = wp.vec3d()
    for k in range(c.first[scene, pair], c.first[scene, pair + 1]):
        J = c.impulse[scene, k]
        if pair // patches.load.shape[1] == i:
            force += J
            moment += wp.cross(c.arm_a[scene, k], J)
        else:
            force -= J
            moment -= wp.cross(c.arm_b[scene, k], J)
    patches.load[scene, i] = patches.load[scene, i] + _single(force)
    patches.moment[scene, i] = patches.moment[scene, i] + _single(moment)


@wp.func
def _list_contacts(c: Contacts, found: Found, scene: int):
    """Divide the room for contacts among the pairs."""
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
            solve(solver, thread)
            for k in range(thread.lane, solver.contacts.active_count[scene], lanes):
                _sum_patch(world, solver.contacts, patches, scene, solver.contacts.active[scene, k])
            wait_for_group()
            for i in range(thread.lane, count, lanes):
                for k in range(solver.contacts.active_count[scene]):
                    p = solver.contacts.active[scene, k]
                    if p // count == i or p % count == i:
                        _add_load(solver.contacts, patches, scene, i, p)
            _spread(bodies, world, solver.contacts, patches, thread, 1.0 / (world.motion.step * float(substeps)))
        else:
            for i in range(thread.lane, count, lanes):
                solver.velocities.linear[scene, i] = solver.free.linear[scene, i]
                solver.velocities.angular[scene, i] = solver.free.angular[scene, i]
        for i in range(thread.lane, count, lanes):
            _end(bodies, world.motion, solver.velocities, scene, i)
        wait_for_group()


class RigidFrames:
    """The rigid motion of batches of `scenes` scenes whose bodies have these surfaces.

    `surfaces`: the fields of BodySurfaces.
    """

    def __init__(self, surfaces: dict[str, Tensor], scenes: int, keypoints: int):
        self.shape = b, o, _ = scenes, len(surfaces["low"]), keypoints
        self.device = device = device_of(surfaces["depth"])
        self.group = 1 if device == "cpu" else GROUP
        samples = surfaces["samples"].shape[1]
        slots, each = (b, o * o * SLOTS), (b, o * o, samples)
        self.world = CollisionWorld()
        self.world.surfaces = with_arrays(SurfaceArrays(), surfaces)
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
        """The state after `substeps` of h [s], the mean accelerations of the keypoints by contact [m/s^2], and the
        mean force [N] of contacts on each body with its torque about the centre of mass [N m].

        state: com (b, o, 3), quat (b, o, 4), velocity (b, o, 3) and angular momentum per unit of mass (b, o, 3).
        bodies: the fields of BodyProperties. Accelerations are in the bodies' frames.
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
