"""Contact solver for rigid bodies: velocities at the end of a step without penetration, with Coulomb friction.

With the mass matrix M, the velocities v minimise the convex function

    (v - v0)' M (v - v0) / 2 + sum of the potentials of the contact impulses,

where v0 are the velocities without contact. The normal impulse is (target - normal speed) / R_n, and never attractive.
The friction impulse is -slip / R_t, bounded by the coefficient of friction times the normal impulse at the previous
minimum; this fixed-point iteration converges in a few rounds. R_n and R_t are small fractions of the inverse effective
mass, so contacts are as stiff as the time step resolves. The minimum is found by Newton's method with a line search in
double precision, by the threads of one scene; every sum has a fixed order, so that results are reproducible.
Sources: Castro, Permenter and Han 2022, "An unconstrained convex formulation of compliant contact"; friction bounded by
the normal forces before: Castro et al. 2023, "A theory of irrotational contact fields".
"""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from stages.core.kernels.field.contact_impulses import (
    ZERO,
    ContactSolver,
    SolverMemory,
    contact_count,
    contact_impulse,
    normal_impulse,
    relative_velocity,
)
from stages.core.kernels.field.groups import GroupThread, wait_for_group
from stages.core.kernels.field.newton_system import assemble, back_substitute, factorise, sort_bodies

f64 = wp.float64
ROUNDS = wp.constant(5)  # maximum number of rounds of the fixed-point iteration for friction
ITERATIONS = wp.constant(20)  # maximum number of Newton steps per round
SEARCHES = wp.constant(20)  # maximum number of iterations of a line search
SEARCH_TOLERANCE = wp.constant(f64(0.1))  # the line search ends at this fraction of the initial slope along the step
TOLERANCE = wp.constant(f64(1e-6))  # velocity change at which Newton's method and the rounds end [m/s or rad/s]


def _over_group(combine: Callable) -> wp.Function:
    """Return a reduction over the threads of a group: `combine` of 0 and the values of the first `count` threads.

    All threads get the result; the values are combined in the order of the threads.
    """

    @wp.func
    def over_group(memory: SolverMemory, thread: GroupThread, count: int, value: f64) -> f64:
        memory.partial[thread.scene, thread.lane] = value
        wait_for_group()
        out = f64(0.0)
        for i in range(wp.min(thread.lanes, count)):
            out = combine(out, memory.partial[thread.scene, i])
        wait_for_group()
        return out

    return over_group


_total, largest = _over_group(wp.add), _over_group(wp.max)


@wp.func
def _slope(s: ContactSolver, thread: GroupThread, size: f64, inertial: f64) -> f64:
    """Derivative of the objective along the Newton step, at a multiple `size` of it; `inertial` is the mass term."""
    scene = thread.scene
    count = contact_count(s.contacts, scene)
    slope = f64(0.0)
    for i in range(thread.lane, count, thread.lanes):
        along = s.memory.along[scene, i]
        relative = s.memory.relative[scene, i] + size * along
        slope -= wp.dot(contact_impulse(s.contacts, scene, i, relative, s.memory.bound[scene, i]), along)
    return inertial + _total(s.memory, thread, count, slope)


@wp.func
def _step_size(s: ContactSolver, thread: GroupThread) -> f64:
    """Line search: the multiple of the Newton step, at most 1, at which the derivative along it vanishes."""
    scene = thread.scene
    bodies = s.memory.rank.shape[1]
    for i in range(thread.lane, contact_count(s.contacts, scene), thread.lanes):
        s.memory.along[scene, i] = relative_velocity(s.contacts, s.memory.step, scene, i)
    at_zero = f64(0.0)
    gain = f64(0.0)
    for i in range(thread.lane, bodies, thread.lanes):
        if not s.inertia.pinned[scene, i]:
            linear = s.memory.step.linear[scene, i]
            angular = s.memory.step.angular[scene, i]
            mass = f64(s.inertia.mass[scene, i])
            pushed = s.inertia.tensor[scene, i] * angular
            at_zero += mass * wp.dot(s.velocities.linear[scene, i] - s.free.linear[scene, i], linear)
            at_zero += wp.dot(s.velocities.angular[scene, i] - s.free.angular[scene, i], pushed)
            gain += mass * wp.dot(linear, linear) + wp.dot(angular, pushed)
    at_zero = _total(s.memory, thread, bodies, at_zero)
    gain = _total(s.memory, thread, bodies, gain)
    low = f64(0.0)
    slope_low = _slope(s, thread, low, at_zero)
    high = f64(1.0)
    slope_high = _slope(s, thread, high, at_zero + gain)
    if slope_high <= ZERO or slope_low >= ZERO:  # the latter only by rounding errors at the minimum
        return high
    size = high
    side = int(0)
    limit = wp.abs(slope_low) * SEARCH_TOLERANCE
    for _ in range(SEARCHES):  # false position that halves the slope at an end kept twice (Dowell and Jarratt 1971)
        size = low + (high - low) * slope_low / (slope_low - slope_high)
        slope = _slope(s, thread, size, at_zero + size * gain)
        if wp.abs(slope) < limit:
            break
        if slope > ZERO:
            high = size
            slope_high = slope
            if side == 1:
                slope_low = slope_low / f64(2.0)
            side = 1
        else:
            low = size
            slope_low = slope
            if side == -1:
                slope_high = slope_high / f64(2.0)
            side = -1
    return size


@wp.func
def _newton_step(s: ContactSolver, thread: GroupThread) -> f64:
    """Update the velocities by one Newton step; return the largest change."""
    scene = thread.scene
    bodies = s.memory.rank.shape[1]
    assemble(s, thread)
    factorise(s.memory, thread)
    back_substitute(s.memory, thread)
    size = _step_size(s, thread)
    change = f64(0.0)
    for i in range(thread.lane, bodies, thread.lanes):
        linear = size * s.memory.step.linear[scene, i]
        angular = size * s.memory.step.angular[scene, i]
        s.velocities.linear[scene, i] = s.velocities.linear[scene, i] + linear
        s.velocities.angular[scene, i] = s.velocities.angular[scene, i] + angular
        for k in range(3):
            change = wp.max(change, wp.max(wp.abs(linear[k]), wp.abs(angular[k])))
    return largest(s.memory, thread, bodies, change)


@wp.func
def solve(s: ContactSolver, thread: GroupThread):
    """Replace the velocities by those after the step, and set the impulses of the contacts."""
    scene = thread.scene
    bodies = s.memory.rank.shape[1]
    if thread.lane == 0:
        sort_bodies(s, scene)
    count = contact_count(s.contacts, scene)
    for i in range(thread.lane, count, thread.lanes):
        s.memory.bound[scene, i] = ZERO
    wait_for_group()
    for k in range(ROUNDS):  # the first round has no friction
        if k > 0:
            for i in range(thread.lane, count, thread.lanes):
                along = normal_impulse(s.contacts, scene, i, relative_velocity(s.contacts, s.velocities, scene, i))
                s.memory.bound[scene, i] = s.contacts.friction[scene, i] * along
        for i in range(thread.lane, bodies, thread.lanes):
            s.memory.before.linear[scene, i] = s.velocities.linear[scene, i]
            s.memory.before.angular[scene, i] = s.velocities.angular[scene, i]
        wait_for_group()
        for _ in range(ITERATIONS):
            if _newton_step(s, thread) < TOLERANCE:
                break
        change = f64(0.0)
        for i in range(thread.lane, bodies, thread.lanes):
            linear = s.velocities.linear[scene, i] - s.memory.before.linear[scene, i]
            angular = s.velocities.angular[scene, i] - s.memory.before.angular[scene, i]
            for axis in range(3):
                change = wp.max(change, wp.max(wp.abs(linear[axis]), wp.abs(angular[axis])))
        if largest(s.memory, thread, bodies, change) < TOLERANCE and k > 0:
            break
    for i in range(thread.lane, count, thread.lanes):
        relative = relative_velocity(s.contacts, s.velocities, scene, i)
        s.contacts.impulse[scene, i] = contact_impulse(s.contacts, scene, i, relative, s.memory.bound[scene, i])
    wait_for_group()
