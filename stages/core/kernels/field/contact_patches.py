"""Distribution of the contact forces of rigid bodies over the touching keypoints, and their sums for each body."""

from __future__ import annotations

import warp as wp

from stages.core.kernels.field.contact_impulses import BodyProperties, Contacts
from stages.core.kernels.field.contact_search import CollisionWorld, Found
from stages.core.kernels.field.groups import GroupThread

PATCH = wp.constant(0.02)  # samples whose gap exceeds a pair's smallest gap by less than this share its force [m]


@wp.struct
class Patches:
    """Distribution of each pair's contact impulses over its nodes, which are the samples with gaps below `limit`.

    A node at x bears share + turn x (x - centre).
    """

    limit: wp.array2d[float]  # upper bound of the nodes' gaps [m]
    centre: wp.array2d[wp.vec3]  # mean position of the nodes [m]
    share: wp.array2d[wp.vec3]  # impulse per node [N s]
    turn: wp.array2d[wp.vec3]  # transmits the angular impulse about `centre`
    accelerations: wp.array3d[wp.vec3]  # mean accelerations of the keypoints, body frames [m/s^2]; result
    load: wp.array2d[wp.vec3]  # sum of all contact impulses on each body [N s]; result
    moment: wp.array2d[wp.vec3]  # sum of their moments about the centre of mass [N m s]; result


@wp.func
def single(x: wp.vec3d) -> wp.vec3:
    """Convert a vector to single precision."""
    return wp.vec3(float(x[0]), float(x[1]), float(x[2]))


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
def sum_patch(w: CollisionWorld, c: Contacts, patches: Patches, scene: int, pair: int):
    """Sum the contact impulses of a pair, and compute their distribution over the nodes."""
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
        J = single(c.impulse[scene, i])
        force += J
        torque += wp.cross(single(c.arm_a[scene, i]) + w.motion.com[scene, a] - centre, J)
    patches.limit[scene, pair] = limit
    patches.centre[scene, pair] = centre
    patches.share[scene, pair] = force / float(wp.max(nodes, 1))
    # regularise by a multiple of the identity: collinear nodes cannot transmit a torque about their line
    extra = 1.0e-2 * wp.trace(moment) + 1.0e-9
    patches.turn[scene, pair] = wp.inverse(moment + extra * wp.identity(3, dtype=float)) * torque


@wp.func
def spread(
    bodies: BodyProperties, w: CollisionWorld, c: Contacts, patches: Patches, thread: GroupThread, weight: float
):  # fmt: skip
    """Add the accelerations of the keypoints due to all contacts, times `weight`.

    Force and torque are distributed over the nodes as by the RBE3 interpolation elements of finite-element codes. The
    keypoints of each body are divided among the threads.
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
def add_load(c: Contacts, patches: Patches, scene: int, i: int, pair: int):
    """Add the impulses of a pair's contacts on body i to its load and moment."""
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
    patches.load[scene, i] = patches.load[scene, i] + single(force)
    patches.moment[scene, i] = patches.moment[scene, i] + single(moment)
