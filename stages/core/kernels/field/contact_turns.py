"""Impacts within a step, passed on in turns from contact to contact, as in Newton's cradle.

Contacts that approach are solved for without those that merely touch, then those that this makes approach, and so on;
at last all contacts that do not rebound are. In one solution of all contacts the last one of a row of balls would take
only a part of the speed of the first. Source: Smith et al. 2012, "Reflections on simultaneous impact".
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.field.contact_impulses import ONE, ZERO, ContactSolver, contact_count, relative_velocity
from stages.core.kernels.field.contact_solve import largest, solve
from stages.core.kernels.field.groups import GroupThread, wait_for_group

f64 = wp.float64
MAX_TURNS = wp.constant(20)  # a light body between heavy ones would need hundreds, so that none rebounds in the last
APART = wp.constant(f64(-1e9))  # target of a contact that takes no part [m/s]


@wp.func
def _set_targets(s: ContactSolver, thread: GroupThread, last: bool) -> bool:
    """Whether contacts rebound in this turn; then these take part, else all."""
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
    """Change the velocities to those after the step, and set the impulses of the contacts.

    Changes `free` to the velocities after the last impacts.
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
