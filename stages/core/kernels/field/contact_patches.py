"""Contact forces of rigid bodies spread over the keypoints that touch, and summed for each body."""

from __future__ import annotations

import warp as wp

from stages.core.kernels.field.contact_impulses import BodyProperties, Contacts
from stages.core.kernels.field.contact_search import CollisionWorld, Found
from stages.core.kernels.field.groups import GroupThread

PATCH = wp.constant(0.02)  # samples with gaps this much larger than the least share a contact's force [m]


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
def single(x: wp.vec3d) -> wp.vec3:
    """The vector in single precision."""
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
        J = single(c.impulse[scene, i])
        force += J
        torque += wp.cross(single(c.arm_a[scene, i]) + w.motion.com[scene, a] - centre, J)
    patches.limit[scene, pair] = limit
    patches.centre[scene, pair] = centre
    patches.share[scene, pair] = force / float(wp.max(nodes, 1))
    # a multiple of the identity: nodes on a line cannot bear a torque about it
    extra = 1.0e-2 * wp.trace(moment) + 1.0e-9
    patches.turn[scene, pair] = wp.inverse(moment + extra * wp.identity(3, dtype=float)) * torque


@wp.func
def spread(
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
def add_load(c: Contacts, patches: Patches, scene: int, i: int, pair: int):
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
    patches.load[scene, i] = patches.load[scene, i] + single(force)
    patches.moment[scene, i] = patches.moment[scene, i] + single(moment)
