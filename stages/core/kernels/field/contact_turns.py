"""Propagation of impacts from contact to contact within a step, as in Newton's cradle.

Each turn solves the contacts that approach, without those that merely touch; their impulses may make others approach,
which the next turn solves. The final turn solves all contacts without rebound. If all contacts were solved together,
the last ball of a row would get only part of the speed of the first.
Source: Smith et al. 2012, "Reflections on simultaneous impact".
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.field.contact_impulses import ONE, ZERO, ContactSolver, contact_count, relative_velocity
from stages.core.kernels.field.contact_solve import largest, solve
from stages.core.kernels.field.groups import GroupThread, wait_for_group

f64 = wp.float64
# Maximum number of turns; no contact rebounds in the last one. A light body between heavy ones would need hundreds.
MAX_TURNS = wp.constant(20)
APART = wp.constant(f64(-1e9))  # target normal speed that excludes a contact from a turn [m/s]


@wp.func
def _set_targets(s: ContactSolver, thread: GroupThread, last: bool) -> bool:
    """Set the target speeds of a turn; return whether any contact rebounds in it.

    If so, only rebounding contacts take part; otherwise all do, without rebound.
    """
    scene = thread.scene
    count = contact_count(s.contacts, scene)
    rebounds = ZERO
    for i in range(thread.lane, count, thread.lanes):
        speed = wp.dot(relative_velocity(s.contacts, s.impacted, scene, i), s.contacts.normal[scene, i])
        s.contacts.target[scene, i] = APART
        if speed < s.contacts.least[scene, i] and not last:
            gained = s.contacts.gained[scene, i]
            s.contacts.target[scene, i] = wp.max(
                s.contacts.resting[scene, i], gained - s.contacts.restitution[scene, i] * (speed + gained)
            )
            rebounds = ONE
    rebounds = largest(s.memory, thread, count, rebounds)
    if rebounds == ZERO:
        for i in range(thread.lane, count, thread.lanes):
            s.contacts.target[scene, i] = s.contacts.resting[scene, i]
        wait_for_group()
    return rebounds > ZERO


@wp.func
def solve_in_turns(s: ContactSolver, thread: GroupThread):
    """Replace the velocities by those after the step, and set the impulses of the contacts.

    Overwrites `free` with the velocities after the last impacts.
    """
    scene = thread.scene
    count = contact_count(s.contacts, scene)
    for i in range(thread.lane, count, thread.lanes):
        s.contacts.total[scene, i] = wp.vec3d()
    for turn in range(MAX_TURNS):
        rebounds = _set_targets(s, thread, turn == MAX_TURNS - 1)
        solve(s, thread)
        for i in range(thread.lane, count, thread.lanes):
            s.contacts.total[scene, i] = s.contacts.total[scene, i] + s.contacts.impulse[scene, i]
        if not rebounds:
            break
        for i in range(thread.lane, s.memory.rank.shape[1], thread.lanes):
            linear = s.velocities.linear[scene, i]
            angular = s.velocities.angular[scene, i]
            s.impacted.linear[scene, i] = s.impacted.linear[scene, i] + linear - s.free.linear[scene, i]
            s.impacted.angular[scene, i] = s.impacted.angular[scene, i] + angular - s.free.angular[scene, i]
            s.free.linear[scene, i] = linear
            s.free.angular[scene, i] = angular
        wait_for_group()
    for i in range(thread.lane, count, thread.lanes):
        s.contacts.impulse[scene, i] = s.contacts.total[scene, i]
    wait_for_group()
