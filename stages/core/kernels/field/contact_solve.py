"""Contacts of rigid bodies, solved for the velocities at the end of a step: no penetration, and Coulomb's friction.

With M for the bodies' inertia, the velocities v minimise the convex function

    (v - v0)' M (v - v0) / 2 + sum of the potentials of the contacts' impulses,

where v0 are the velocities without contact. The impulse along a normal, (target - normal speed) / R_n, never pulls;
that across it, -slip / R_t, is at most friction times the normal impulse in the minimum before, a fixed point that few
rounds reach. R_n and R_t are small fractions of the inverse effective mass, so that contacts are as stiff as a step
resolves. Minimised by Newton's method with a line search, in double precision, by the threads of one scene; every sum
has a fixed order.
Sources: Castro, Permenter and Han 2022, "An unconstrained convex formulation of compliant contact"; friction bounded by
the normal forces before: Castro et al. 2023, "A theory of irrotational contact fields".
"""

from __future__ import annotations

from collections.abc import Callable

import warp as wp

from stages.core.kernels.field.groups import wait_for_group
from stages.core.kernels.interop import empty_arrays
from stages.core.kernels.splat.simd import by_device

f64 = wp.float64
# Of the inverse effective mass; a box creeps on a slope by a thousandth of what it would gain in a step.
NORMAL_REGULARISATION = wp.constant(f64(1e-3))
FRICTION_REGULARISATION = wp.constant(f64(1e-3))
ROUNDS = wp.constant(5)  # of the fixed point, at most
ITERATIONS = wp.constant(20)  # of Newton's method in each round, at most
SEARCHES = wp.constant(20)  # of the line search, at most
SEARCH_TOLERANCE = wp.constant(f64(0.1))  # of the derivative along the step at its start
TOLERANCE = wp.constant(f64(1e-6))  # change of velocities at which both end [m/s]
ZERO, ONE, TINY = wp.constant(f64(0.0)), wp.constant(f64(1.0)), wp.constant(f64(1e-30))


# Sum over k = start .. end - 1 of H[i + k] H[j + k] inverse[k], of one scene
_ROWS = r"""
const double* a = H.data + (size_t)scene * H.shape[1] + i;
const double* b = H.data + (size_t)scene * H.shape[1] + j;
const double* d = inverse.data + (size_t)scene * inverse.shape[1];
double sum = 0.0;
int k = start;
"""
_VECTORS = r"""
typedef double D __attribute__((ext_vector_type(4)));  // the compiler may not reorder sums
auto load = [](const double* p) { D v; __builtin_memcpy(&v, p, sizeof(v)); return v; };
D s = 0.0, t = 0.0;
for (; k + 8 <= end; k += 8) {
    s += load(a + k) * load(b + k) * load(d + k);
    t += load(a + k + 4) * load(b + k + 4) * load(d + k + 4);
}
s += t;
sum = (s[0] + s[1]) + (s[2] + s[3]);
"""
_SCALARS = r"""
for (; k < end; ++k) sum += a[k] * b[k] * d[k];
return sum;
"""


@wp.struct
class Velocities:
    """Of the bodies of each scene."""

    linear: wp.array2d[wp.vec3d]  # of the centres of mass [m/s]
    angular: wp.array2d[wp.vec3d]  # [rad/s]


@wp.struct
class Inertias:
    """Inertia of the bodies of each scene, in world axes."""

    mass: wp.array2d[float]  # [kg]
    tensor: wp.array2d[wp.mat33d]  # [kg m^2]
    inverse: wp.array2d[wp.mat33d]
    pinned: wp.array2d[wp.bool]


@wp.struct
class Contacts:
    """The contacts of each scene, ordered by pairs of bodies a and b, or a = b for those of a with what is fixed."""

    first: wp.array2d[int]  # contact of each pair a * bodies + b; one more for the end
    active: wp.array2d[int]  # pairs with contacts
    active_count: wp.array[int]
    a: wp.array2d[int]
    b: wp.array2d[int]
    normal: wp.array2d[wp.vec3d]  # from b to a
    arm_a: wp.array2d[wp.vec3d]  # from the centres of mass [m]
    arm_b: wp.array2d[wp.vec3d]
    target: wp.array2d[f64]  # least normal speed of a relative to b after the step [m/s]
    friction: wp.array2d[f64]
    R_n: wp.array2d[f64]
    R_t: wp.array2d[f64]
    impulse: wp.array2d[wp.vec3d]  # on a [N s]; the result


@wp.struct
class SolverMemory:
    """What the solver computes in between."""

    bound: wp.array2d[f64]  # of the friction of each contact
    relative: wp.array2d[wp.vec3d]  # velocity of a relative to b at each contact
    along: wp.array2d[wp.vec3d]  # its change by a whole step
    matrices: wp.array3d[wp.mat33d]  # of each contact, see `_evaluate`
    vectors: wp.array3d[wp.vec3d]
    pair_matrices: wp.array3d[wp.mat33d]  # their sums over the contacts of each pair
    pair_vectors: wp.array3d[wp.vec3d]
    step: Velocities
    before: Velocities
    H: wp.array2d[f64]  # lower triangle of the Hessian, and below it the negative gradient
    inverse: wp.array2d[f64]  # of the diagonal of its LDL' decomposition
    order: wp.array2d[int]  # of the bodies in the Hessian, in which those that touch are near each other
    rank: wp.array2d[int]  # of each body in it
    first_rank: wp.array2d[int]  # least rank that the body of each rank is coupled to
    last_rank: wp.array2d[int]  # largest rank whose `first_rank` is not larger
    partial: wp.array2d[f64]  # results of the threads


def solver_arrays(device: str, scenes: int, bodies: int, contacts: int, group: int) -> tuple[Contacts, SolverMemory]:
    """Room for `contacts` contacts in each scene, and for their solution by `group` threads for each scene."""
    b, pairs, n = scenes, bodies * bodies, 6 * bodies
    found = empty_arrays(Contacts, device, (b, contacts), first=(b, pairs + 1), active=(b, pairs), active_count=(b,))
    memory = empty_arrays(
        SolverMemory, device, (b, contacts), matrices=(b, contacts, 6), vectors=(b, contacts, 3),
        pair_matrices=(b, pairs, 6), pair_vectors=(b, pairs, 3), step=None, before=None,
        H=(b, n * (n + 1)), inverse=(b, n), order=(b, bodies), rank=(b, bodies), first_rank=(b, bodies),
        last_rank=(b, bodies), partial=(b, group),
    )  # fmt: skip
    memory.step, memory.before = (empty_arrays(Velocities, device, (b, bodies)) for _ in range(2))
    return found, memory


def _over_group(combine: Callable) -> wp.Function:
    """A function that gives all threads the values of the first `used` ones and 0, `combine`d in their order."""

    @wp.func
    def over_group(memory: SolverMemory, scene: int, lane: int, used: int, value: f64) -> f64:
        memory.partial[scene, lane] = value
        wait_for_group()
        out = f64(0.0)
        for i in range(used):
            out = combine(out, memory.partial[scene, i])
        wait_for_group()
        return out

    return over_group


_total, _largest = _over_group(wp.add), _over_group(wp.max)


@wp.func
def effective_response(inertia: Inertias, scene: int, body: int, arm: wp.vec3d) -> f64:
    """Speed that a unit impulse at `arm` gives its point, the mean over all directions."""
    if inertia.pinned[scene, body]:
        return ZERO
    K = wp.skew(arm)
    turned = wp.transpose(K) * inertia.inverse[scene, body] * K
    return ONE / f64(inertia.mass[scene, body]) + (turned[0, 0] + turned[1, 1] + turned[2, 2]) / f64(3.0)


@wp.func
def _relative(c: Contacts, v: Velocities, scene: int, i: int) -> wp.vec3d:
    """Velocity of a relative to b at a contact."""
    a = c.a[scene, i]
    b = c.b[scene, i]
    out = v.linear[scene, a] + wp.cross(v.angular[scene, a], c.arm_a[scene, i])
    if b != a:
        out -= v.linear[scene, b] + wp.cross(v.angular[scene, b], c.arm_b[scene, i])
    return out


@wp.func
def _along(c: Contacts, scene: int, i: int, relative: wp.vec3d) -> f64:
    """Impulse along the normal."""
    return wp.max((c.target[scene, i] - wp.dot(relative, c.normal[scene, i])) / c.R_n[scene, i], ZERO)


@wp.func
def _impulse(c: Contacts, scene: int, i: int, relative: wp.vec3d, bound: f64) -> wp.vec3d:
    n = c.normal[scene, i]
    slip = relative - wp.dot(relative, n) * n
    across = wp.min(ONE / c.R_t[scene, i], bound / wp.max(wp.length(slip), TINY))
    return _along(c, scene, i, relative) * n - across * slip


@wp.func
def _hessian(c: Contacts, scene: int, i: int, relative: wp.vec3d, bound: f64) -> wp.mat33d:
    """Derivative of the negative impulse by the relative velocity."""
    n = c.normal[scene, i]
    slip = relative - wp.dot(relative, n) * n
    speed = wp.max(wp.length(slip), TINY)
    across = wp.min(ONE / c.R_t[scene, i], bound / speed)
    nn = wp.outer(n, n)
    out = across * (wp.identity(3, dtype=f64) - nn)
    if across < ONE / c.R_t[scene, i]:
        out -= across * wp.outer(slip / speed, slip / speed)
    if _along(c, scene, i, relative) > ZERO:
        out += nn / c.R_n[scene, i]
    return out


@wp.func
def _evaluate(c: Contacts, memory: SolverMemory, v: Velocities, scene: int, i: int):
    """The terms of a contact, with G its Hessian, J its impulse and K the cross products with its arms:
    G, K_a G, K_b G, K_a G K_a', K_a G K_b', K_b G K_b', and J, K_a J, K_b J.
    """
    relative = _relative(c, v, scene, i)
    G = _hessian(c, scene, i, relative, memory.bound[scene, i])
    J = _impulse(c, scene, i, relative, memory.bound[scene, i])
    K_a = wp.skew(c.arm_a[scene, i])
    K_b = wp.skew(c.arm_b[scene, i])
    memory.relative[scene, i] = relative
    memory.matrices[scene, i, 0] = G
    memory.matrices[scene, i, 1] = K_a * G
    memory.matrices[scene, i, 2] = K_b * G
    memory.matrices[scene, i, 3] = K_a * G * wp.transpose(K_a)
    memory.matrices[scene, i, 4] = K_a * G * wp.transpose(K_b)
    memory.matrices[scene, i, 5] = K_b * G * wp.transpose(K_b)
    memory.vectors[scene, i, 0] = J
    memory.vectors[scene, i, 1] = K_a * J
    memory.vectors[scene, i, 2] = K_b * J


@wp.func
def _sum_pair(c: Contacts, memory: SolverMemory, scene: int, pair: int, term: int):
    """The sum of one of the matrices, or of the vectors after them, over the contacts of a pair."""
    if term < 6:
        matrix = wp.mat33d()
        for i in range(c.first[scene, pair], c.first[scene, pair + 1]):
            matrix += memory.matrices[scene, i, term]
        memory.pair_matrices[scene, pair, term] = matrix
    else:
        vector = wp.vec3d()
        for i in range(c.first[scene, pair], c.first[scene, pair + 1]):
            vector += memory.vectors[scene, i, term - 6]
        memory.pair_vectors[scene, pair, term - 6] = vector


@wp.func
def _has_contacts(c: Contacts, scene: int, pair: int) -> bool:
    return c.first[scene, pair + 1] > c.first[scene, pair]


@wp.func
def _write_block(
    memory: SolverMemory, scene: int, i: int, j: int, bodies: int, top: wp.mat33d, right: wp.mat33d, left: wp.mat33d,
    bottom: wp.mat33d,
):  # fmt: skip
    """Write the block of ranks i and j to the Hessian; `top` acts on velocities, `bottom` on spins."""
    n = 6 * bodies
    for r in range(3):
        for k in range(3):
            memory.H[scene, (6 * i + r) * n + 6 * j + k] = top[r, k]
            memory.H[scene, (6 * i + r) * n + 6 * j + 3 + k] = right[r, k]
            memory.H[scene, (6 * i + 3 + r) * n + 6 * j + k] = left[r, k]
            memory.H[scene, (6 * i + 3 + r) * n + 6 * j + 3 + k] = bottom[r, k]


@wp.func
def _assemble_own(
    c: Contacts, inertia: Inertias, memory: SolverMemory, v: Velocities, free: Velocities, scene: int, i: int,
    bodies: int,
):  # fmt: skip
    """The block of body i with itself, and its negative gradient."""
    n = 6 * bodies
    eye = wp.identity(3, dtype=f64)
    top = eye
    left = wp.mat33d()
    bottom = eye
    force = wp.vec3d()
    torque = wp.vec3d()
    if not inertia.pinned[scene, i]:
        mass = f64(inertia.mass[scene, i])
        top = mass * eye
        bottom = inertia.tensor[scene, i]
        force = -mass * (v.linear[scene, i] - free.linear[scene, i])
        torque = -(bottom * (v.angular[scene, i] - free.angular[scene, i]))
        for other in range(bodies):
            pair = i * bodies + other
            if _has_contacts(c, scene, pair):
                top += memory.pair_matrices[scene, pair, 0]
                left += memory.pair_matrices[scene, pair, 1]
                bottom += memory.pair_matrices[scene, pair, 3]
                force += memory.pair_vectors[scene, pair, 0]
                torque += memory.pair_vectors[scene, pair, 1]
            pair = other * bodies + i
            if other != i and _has_contacts(c, scene, pair):
                top += memory.pair_matrices[scene, pair, 0]
                left += memory.pair_matrices[scene, pair, 2]
                bottom += memory.pair_matrices[scene, pair, 5]
                force -= memory.pair_vectors[scene, pair, 0]
                torque -= memory.pair_vectors[scene, pair, 2]
    row = memory.rank[scene, i]
    _write_block(memory, scene, row, row, bodies, top, wp.transpose(left), left, bottom)
    for k in range(3):
        memory.H[scene, n * n + 6 * row + k] = force[k]
        memory.H[scene, n * n + 6 * row + 3 + k] = torque[k]


@wp.func
def _assemble_pair(c: Contacts, inertia: Inertias, memory: SolverMemory, scene: int, i: int, j: int, bodies: int):
    """The block of body i with a body j of lower rank."""
    top = wp.mat33d()
    right = wp.mat33d()
    left = wp.mat33d()
    bottom = wp.mat33d()
    if not (inertia.pinned[scene, i] or inertia.pinned[scene, j]):
        pair = i * bodies + j
        if _has_contacts(c, scene, pair):
            top -= memory.pair_matrices[scene, pair, 0]
            right -= wp.transpose(memory.pair_matrices[scene, pair, 2])
            left -= memory.pair_matrices[scene, pair, 1]
            bottom -= memory.pair_matrices[scene, pair, 4]
        pair = j * bodies + i
        if _has_contacts(c, scene, pair):
            top -= memory.pair_matrices[scene, pair, 0]
            right -= wp.transpose(memory.pair_matrices[scene, pair, 1])
            left -= memory.pair_matrices[scene, pair, 2]
            bottom -= wp.transpose(memory.pair_matrices[scene, pair, 4])
    _write_block(memory, scene, memory.rank[scene, i], memory.rank[scene, j], bodies, top, right, left, bottom)


@wp.func_native(_ROWS + by_device("", _VECTORS) + _SCALARS)
def _weighted_product(H: wp.array2d[f64], inverse: wp.array2d[f64], scene: int, i: int, j: int, start: int, end: int
                      ) -> f64: ...  # fmt: skip


@wp.func
def _factorise(memory: SolverMemory, scene: int, lane: int, lanes: int, bodies: int):
    """LDL' of the Hessian in place, each row from the first rank it is coupled to; the last row is solved with L."""
    n = 6 * bodies
    for j in range(n):
        start_j = 6 * memory.first_rank[scene, j // 6]
        end = 6 * memory.last_rank[scene, j // 6] + 6
        for row in range(j + lane, end + 1, lanes):
            i = row
            start = start_j
            if row < end:
                start = wp.max(start, 6 * memory.first_rank[scene, i // 6])
            else:
                i = n
            if start <= j:
                s = memory.H[scene, i * n + j] - _weighted_product(
                    memory.H, memory.inverse, scene, i * n, j * n, start, j
                )  # fmt: skip
                memory.H[scene, i * n + j] = s
                if i == j:
                    memory.inverse[scene, j] = ONE / s
        wait_for_group()


@wp.func
def _back_substitute(memory: SolverMemory, scene: int, lane: int, lanes: int, bodies: int):
    """The step of Newton's method from the decomposition."""
    n = 6 * bodies
    for back in range(n):
        j = n - 1 - back
        x = memory.H[scene, n * n + j] * memory.inverse[scene, j]
        for i in range(6 * memory.first_rank[scene, j // 6] + lane, j, lanes):
            memory.H[scene, n * n + i] = memory.H[scene, n * n + i] - memory.H[scene, j * n + i] * x
        wait_for_group()
    for i in range(lane, bodies, lanes):
        linear = wp.vec3d()
        angular = wp.vec3d()
        row = 6 * memory.rank[scene, i]
        for k in range(3):
            linear[k] = memory.H[scene, n * n + row + k] * memory.inverse[scene, row + k]
            angular[k] = memory.H[scene, n * n + row + 3 + k] * memory.inverse[scene, row + 3 + k]
        memory.step.linear[scene, i] = linear
        memory.step.angular[scene, i] = angular
    wait_for_group()


@wp.func
def _slope(
    c: Contacts, memory: SolverMemory, scene: int, lane: int, lanes: int, count: int, size: f64, inertial: f64
) -> f64:
    """Derivative of the function along the step, at this size of it; `inertial` is the part of the inertia."""
    s = f64(0.0)
    for i in range(lane, count, lanes):
        along = memory.along[scene, i]
        impulse = _impulse(c, scene, i, memory.relative[scene, i] + size * along, memory.bound[scene, i])
        s -= wp.dot(impulse, along)
    return inertial + _total(memory, scene, lane, wp.min(lanes, count), s)


@wp.func
def _step_size(
    c: Contacts, inertia: Inertias, memory: SolverMemory, v: Velocities, free: Velocities, scene: int, lane: int,
    lanes: int, bodies: int,
) -> f64:  # fmt: skip
    """Where the derivative along the step vanishes, at most 1."""
    count = c.first[scene, bodies * bodies]
    for i in range(lane, count, lanes):
        memory.along[scene, i] = _relative(c, memory.step, scene, i)
    at_zero = f64(0.0)
    gain = f64(0.0)
    for i in range(lane, bodies, lanes):
        if not inertia.pinned[scene, i]:
            linear = memory.step.linear[scene, i]
            angular = memory.step.angular[scene, i]
            mass = f64(inertia.mass[scene, i])
            pushed = inertia.tensor[scene, i] * angular
            at_zero += mass * wp.dot(v.linear[scene, i] - free.linear[scene, i], linear)
            at_zero += wp.dot(v.angular[scene, i] - free.angular[scene, i], pushed)
            gain += mass * wp.dot(linear, linear) + wp.dot(angular, pushed)
    at_zero = _total(memory, scene, lane, wp.min(lanes, bodies), at_zero)
    gain = _total(memory, scene, lane, wp.min(lanes, bodies), gain)
    low = f64(0.0)
    slope_low = _slope(c, memory, scene, lane, lanes, count, low, at_zero)
    high = f64(1.0)
    slope_high = _slope(c, memory, scene, lane, lanes, count, high, at_zero + gain)
    if slope_high <= ZERO or slope_low >= ZERO:  # the latter by rounding, at the minimum
        return high
    size = high
    side = int(0)
    limit = wp.abs(slope_low) * SEARCH_TOLERANCE
    for _ in range(SEARCHES):  # false position, with the end that stays counting half (Dowell and Jarratt 1971)
        size = low + (high - low) * slope_low / (slope_low - slope_high)
        slope = _slope(c, memory, scene, lane, lanes, count, size, at_zero + size * gain)
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
def _newton_step(
    c: Contacts, inertia: Inertias, memory: SolverMemory, v: Velocities, free: Velocities, scene: int, lane: int,
    lanes: int, bodies: int,
) -> f64:  # fmt: skip
    """Change the velocities by a step of Newton's method; the largest change."""
    for i in range(lane, c.first[scene, bodies * bodies], lanes):
        _evaluate(c, memory, v, scene, i)
    wait_for_group()
    for k in range(lane, 9 * c.active_count[scene], lanes):
        _sum_pair(c, memory, scene, c.active[scene, k // 9], k % 9)
    wait_for_group()
    for i in range(lane, bodies, lanes):
        _assemble_own(c, inertia, memory, v, free, scene, i, bodies)
    for i in range(lane, bodies, lanes):  # ranks
        for j in range(memory.first_rank[scene, i], i):
            _assemble_pair(c, inertia, memory, scene, memory.order[scene, i], memory.order[scene, j], bodies)
    wait_for_group()
    _factorise(memory, scene, lane, lanes, bodies)
    _back_substitute(memory, scene, lane, lanes, bodies)
    size = _step_size(c, inertia, memory, v, free, scene, lane, lanes, bodies)
    change = f64(0.0)
    for i in range(lane, bodies, lanes):
        linear = size * memory.step.linear[scene, i]
        angular = size * memory.step.angular[scene, i]
        v.linear[scene, i] = v.linear[scene, i] + linear
        v.angular[scene, i] = v.angular[scene, i] + angular
        for k in range(3):
            change = wp.max(change, wp.max(wp.abs(linear[k]), wp.abs(angular[k])))
    return _largest(memory, scene, lane, wp.min(lanes, bodies), change)


@wp.func
def _coupled(c: Contacts, inertia: Inertias, scene: int, i: int, j: int, bodies: int) -> bool:
    free = not (inertia.pinned[scene, i] or inertia.pinned[scene, j])
    return free and (_has_contacts(c, scene, i * bodies + j) or _has_contacts(c, scene, j * bodies + i))


@wp.func
def _sort_bodies(c: Contacts, inertia: Inertias, memory: SolverMemory, scene: int, bodies: int):
    """Order the bodies by breadth-first search, island by island (Cuthill and McKee 1969): the Hessian is then zero
    outside a band.
    """
    for i in range(bodies):
        memory.rank[scene, i] = -1
    end = int(0)
    for i in range(bodies):
        if memory.rank[scene, i] < 0:
            memory.rank[scene, i] = end
            memory.order[scene, end] = i
            at = int(end)
            end += 1
            while at < end:
                body = memory.order[scene, at]
                least = int(at)
                for j in range(bodies):
                    if j != body and _coupled(c, inertia, scene, body, j, bodies):
                        if memory.rank[scene, j] < 0:
                            memory.rank[scene, j] = end
                            memory.order[scene, end] = j
                            end += 1
                        least = wp.min(least, memory.rank[scene, j])
                memory.first_rank[scene, at] = least
                for rank in range(least, at + 1):
                    memory.last_rank[scene, rank] = at
                at += 1


@wp.func
def solve(
    c: Contacts, inertia: Inertias, memory: SolverMemory, v: Velocities, free: Velocities, scene: int, lane: int,
    lanes: int, bodies: int,
):  # fmt: skip
    """Change velocities `v`, which are near the solution at first, to those after the step, and set the impulses.

    `free` are those without contact; of pinned bodies both are 0.
    """
    if lane == 0:
        _sort_bodies(c, inertia, memory, scene, bodies)
    count = c.first[scene, bodies * bodies]
    for i in range(lane, count, lanes):
        memory.bound[scene, i] = ZERO
    wait_for_group()
    for k in range(ROUNDS):  # the first without friction
        if k > 0:
            for i in range(lane, count, lanes):
                memory.bound[scene, i] = c.friction[scene, i] * _along(c, scene, i, _relative(c, v, scene, i))
        for i in range(lane, bodies, lanes):
            memory.before.linear[scene, i] = v.linear[scene, i]
            memory.before.angular[scene, i] = v.angular[scene, i]
        wait_for_group()
        for _ in range(ITERATIONS):
            if _newton_step(c, inertia, memory, v, free, scene, lane, lanes, bodies) < TOLERANCE:
                break
        change = f64(0.0)
        for i in range(lane, bodies, lanes):
            linear = v.linear[scene, i] - memory.before.linear[scene, i]
            angular = v.angular[scene, i] - memory.before.angular[scene, i]
            for axis in range(3):
                change = wp.max(change, wp.max(wp.abs(linear[axis]), wp.abs(angular[axis])))
        if _largest(memory, scene, lane, wp.min(lanes, bodies), change) < TOLERANCE and k > 0:
            break
    for i in range(lane, count, lanes):
        c.impulse[scene, i] = _impulse(c, scene, i, _relative(c, v, scene, i), memory.bound[scene, i])
    wait_for_group()
