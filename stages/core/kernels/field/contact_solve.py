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

from stages.core.kernels.field.groups import GroupThread, wait_for_group
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
const double* a = d.H.data + (size_t)scene * d.H.shape[1] + i;
const double* b = d.H.data + (size_t)scene * d.H.shape[1] + j;
const double* inverse = d.inverse.data + (size_t)scene * d.inverse.shape[1];
double sum = 0.0;
int k = start;
"""
_VECTORS = r"""
typedef double D __attribute__((ext_vector_type(4)));  // the compiler may not reorder sums
auto load = [](const double* p) { D v; __builtin_memcpy(&v, p, sizeof(v)); return v; };
D s = 0.0, t = 0.0;
for (; k + 8 <= end; k += 8) {
    s += load(a + k) * load(b + k) * load(inverse + k);
    t += load(a + k + 4) * load(b + k + 4) * load(inverse + k + 4);
}
s += t;
sum = (s[0] + s[1]) + (s[2] + s[3]);
"""
_SCALARS = r"""
for (; k < end; ++k) sum += a[k] * b[k] * inverse[k];
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
class Decomposition:
    """The Hessian of each scene, replaced by its LDL' decomposition."""

    H: wp.array2d[f64]  # lower triangle of the Hessian, and below it the negative gradient
    inverse: wp.array2d[f64]  # of the diagonal of D


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
    decomposition: Decomposition
    order: wp.array2d[int]  # of the bodies in the Hessian, in which those that touch are near each other
    rank: wp.array2d[int]  # of each body in it
    first_rank: wp.array2d[int]  # least rank that the body of each rank is coupled to
    last_rank: wp.array2d[int]  # largest rank whose `first_rank` is not larger
    partial: wp.array2d[f64]  # results of the threads


@wp.struct
class ContactSolver:
    """The contacts of each scene, the bodies that they are between, and what their solution takes."""

    contacts: Contacts
    inertia: Inertias
    velocities: Velocities  # near the solution at first, then those after the step; 0 of pinned bodies
    free: Velocities  # those without contact; 0 of pinned bodies
    memory: SolverMemory


def contact_solver(device: str, scenes: int, bodies: int, contacts: int, group: int) -> ContactSolver:
    """Room for `contacts` contacts in each scene, and for their solution by `group` threads for each scene.

    Masses and what is pinned are to be filled in.
    """
    b, pairs, n = scenes, bodies * bodies, 6 * bodies
    out = ContactSolver()
    out.contacts = empty_arrays(
        Contacts, device, (b, contacts), first=(b, pairs + 1), active=(b, pairs), active_count=(b,)
    )  # fmt: skip
    out.inertia = empty_arrays(Inertias, device, (b, bodies), mass=None, pinned=None)
    memory = empty_arrays(
        SolverMemory, device, (b, contacts), matrices=(b, contacts, 6), vectors=(b, contacts, 3),
        pair_matrices=(b, pairs, 6), pair_vectors=(b, pairs, 3), step=None, before=None, decomposition=None,
        order=(b, bodies), rank=(b, bodies), first_rank=(b, bodies), last_rank=(b, bodies), partial=(b, group),
    )  # fmt: skip
    memory.decomposition = empty_arrays(Decomposition, device, (b, n), H=(b, n * (n + 1)))
    memory.step, memory.before, out.velocities, out.free = (
        empty_arrays(Velocities, device, (b, bodies)) for _ in range(4)
    )  # fmt: skip
    out.memory = memory
    return out


def _over_group(combine: Callable) -> wp.Function:
    """A function that gives all threads their values and 0, `combine`d in their order; at most `count` have any."""

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
def _contact_count(c: Contacts, scene: int) -> int:
    return c.first[scene, c.first.shape[1] - 1]


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
def _evaluate(s: ContactSolver, scene: int, i: int):
    """The terms of a contact, with G its Hessian, J its impulse and K the cross products with its arms:
    G, K_a G, K_b G, K_a G K_a', K_a G K_b', K_b G K_b', and J, K_a J, K_b J.
    """
    relative = _relative(s.contacts, s.velocities, scene, i)
    G = _hessian(s.contacts, scene, i, relative, s.memory.bound[scene, i])
    J = _impulse(s.contacts, scene, i, relative, s.memory.bound[scene, i])
    K_a = wp.skew(s.contacts.arm_a[scene, i])
    K_b = wp.skew(s.contacts.arm_b[scene, i])
    s.memory.relative[scene, i] = relative
    s.memory.matrices[scene, i, 0] = G
    s.memory.matrices[scene, i, 1] = K_a * G
    s.memory.matrices[scene, i, 2] = K_b * G
    s.memory.matrices[scene, i, 3] = K_a * G * wp.transpose(K_a)
    s.memory.matrices[scene, i, 4] = K_a * G * wp.transpose(K_b)
    s.memory.matrices[scene, i, 5] = K_b * G * wp.transpose(K_b)
    s.memory.vectors[scene, i, 0] = J
    s.memory.vectors[scene, i, 1] = K_a * J
    s.memory.vectors[scene, i, 2] = K_b * J


@wp.func
def _sum_pair(s: ContactSolver, scene: int, pair: int, term: int):
    """The sum of one of the matrices, or of the vectors after them, over the contacts of a pair."""
    if term < 6:
        matrix = wp.mat33d()
        for i in range(s.contacts.first[scene, pair], s.contacts.first[scene, pair + 1]):
            matrix += s.memory.matrices[scene, i, term]
        s.memory.pair_matrices[scene, pair, term] = matrix
    else:
        vector = wp.vec3d()
        for i in range(s.contacts.first[scene, pair], s.contacts.first[scene, pair + 1]):
            vector += s.memory.vectors[scene, i, term - 6]
        s.memory.pair_vectors[scene, pair, term - 6] = vector


@wp.func
def _has_contacts(c: Contacts, scene: int, pair: int) -> bool:
    return c.first[scene, pair + 1] > c.first[scene, pair]


@wp.struct
class HessianBlock:
    """The rows of one body and the columns of another one, or of the same."""

    top: wp.mat33d  # of velocities
    right: wp.mat33d
    left: wp.mat33d
    bottom: wp.mat33d  # of spins


@wp.func
def _write_block(memory: SolverMemory, scene: int, i: int, j: int, block: HessianBlock):
    """Write the block of ranks i and j to the Hessian."""
    n = 6 * memory.rank.shape[1]
    for r in range(3):
        for k in range(3):
            memory.decomposition.H[scene, (6 * i + r) * n + 6 * j + k] = block.top[r, k]
            memory.decomposition.H[scene, (6 * i + r) * n + 6 * j + 3 + k] = block.right[r, k]
            memory.decomposition.H[scene, (6 * i + 3 + r) * n + 6 * j + k] = block.left[r, k]
            memory.decomposition.H[scene, (6 * i + 3 + r) * n + 6 * j + 3 + k] = block.bottom[r, k]


@wp.func
def _assemble_own(s: ContactSolver, scene: int, i: int):
    """The block of body i with itself, and its negative gradient."""
    bodies = s.memory.rank.shape[1]
    n = 6 * bodies
    eye = wp.identity(3, dtype=f64)
    block = HessianBlock()
    block.top = eye
    block.bottom = eye
    force = wp.vec3d()
    torque = wp.vec3d()
    if not s.inertia.pinned[scene, i]:
        mass = f64(s.inertia.mass[scene, i])
        block.top = mass * eye
        block.bottom = s.inertia.tensor[scene, i]
        force = -mass * (s.velocities.linear[scene, i] - s.free.linear[scene, i])
        torque = -(block.bottom * (s.velocities.angular[scene, i] - s.free.angular[scene, i]))
        for other in range(bodies):
            pair = i * bodies + other
            if _has_contacts(s.contacts, scene, pair):
                block.top += s.memory.pair_matrices[scene, pair, 0]
                block.left += s.memory.pair_matrices[scene, pair, 1]
                block.bottom += s.memory.pair_matrices[scene, pair, 3]
                force += s.memory.pair_vectors[scene, pair, 0]
                torque += s.memory.pair_vectors[scene, pair, 1]
            pair = other * bodies + i
            if other != i and _has_contacts(s.contacts, scene, pair):
                block.top += s.memory.pair_matrices[scene, pair, 0]
                block.left += s.memory.pair_matrices[scene, pair, 2]
                block.bottom += s.memory.pair_matrices[scene, pair, 5]
                force -= s.memory.pair_vectors[scene, pair, 0]
                torque -= s.memory.pair_vectors[scene, pair, 2]
    block.right = wp.transpose(block.left)
    row = s.memory.rank[scene, i]
    _write_block(s.memory, scene, row, row, block)
    for k in range(3):
        s.memory.decomposition.H[scene, n * n + 6 * row + k] = force[k]
        s.memory.decomposition.H[scene, n * n + 6 * row + 3 + k] = torque[k]


@wp.func
def _assemble_pair(s: ContactSolver, scene: int, i: int, j: int):
    """The block of body i with a body j of lower rank."""
    bodies = s.memory.rank.shape[1]
    block = HessianBlock()
    if not (s.inertia.pinned[scene, i] or s.inertia.pinned[scene, j]):
        pair = i * bodies + j
        if _has_contacts(s.contacts, scene, pair):
            block.top -= s.memory.pair_matrices[scene, pair, 0]
            block.right -= wp.transpose(s.memory.pair_matrices[scene, pair, 2])
            block.left -= s.memory.pair_matrices[scene, pair, 1]
            block.bottom -= s.memory.pair_matrices[scene, pair, 4]
        pair = j * bodies + i
        if _has_contacts(s.contacts, scene, pair):
            block.top -= s.memory.pair_matrices[scene, pair, 0]
            block.right -= wp.transpose(s.memory.pair_matrices[scene, pair, 1])
            block.left -= s.memory.pair_matrices[scene, pair, 2]
            block.bottom -= wp.transpose(s.memory.pair_matrices[scene, pair, 4])
    _write_block(s.memory, scene, s.memory.rank[scene, i], s.memory.rank[scene, j], block)


@wp.func_native(_ROWS + by_device("", _VECTORS) + _SCALARS)
def _weighted_product(d: Decomposition, scene: int, i: int, j: int, start: int, end: int) -> f64: ...


@wp.func
def _factorise(memory: SolverMemory, thread: GroupThread):
    """LDL' of the Hessian in place, each row from the first rank it is coupled to; the last row is solved with L."""
    d = memory.decomposition
    scene = thread.scene
    n = 6 * memory.rank.shape[1]
    for j in range(n):
        start_j = 6 * memory.first_rank[scene, j // 6]
        end = 6 * memory.last_rank[scene, j // 6] + 6
        for row in range(j + thread.lane, end + 1, thread.lanes):
            i = row
            start = start_j
            if row < end:
                start = wp.max(start, 6 * memory.first_rank[scene, i // 6])
            else:
                i = n
            if start <= j:
                s = d.H[scene, i * n + j]
                s -= _weighted_product(d, scene, i * n, j * n, start, j)
                d.H[scene, i * n + j] = s
                if i == j:
                    d.inverse[scene, j] = ONE / s
        wait_for_group()


@wp.func
def _back_substitute(memory: SolverMemory, thread: GroupThread):
    """The step of Newton's method from the decomposition."""
    d = memory.decomposition
    scene = thread.scene
    bodies = memory.rank.shape[1]
    n = 6 * bodies
    for back in range(n):
        j = n - 1 - back
        x = d.H[scene, n * n + j] * d.inverse[scene, j]
        for i in range(6 * memory.first_rank[scene, j // 6] + thread.lane, j, thread.lanes):
            d.H[scene, n * n + i] = d.H[scene, n * n + i] - d.H[scene, j * n + i] * x
        wait_for_group()
    for i in range(thread.lane, bodies, thread.lanes):
        linear = wp.vec3d()
        angular = wp.vec3d()
        row = 6 * memory.rank[scene, i]
        for k in range(3):
            linear[k] = d.H[scene, n * n + row + k] * d.inverse[scene, row + k]
            angular[k] = d.H[scene, n * n + row + 3 + k] * d.inverse[scene, row + 3 + k]
        memory.step.linear[scene, i] = linear
        memory.step.angular[scene, i] = angular
    wait_for_group()


@wp.func
def _slope(s: ContactSolver, thread: GroupThread, size: f64, inertial: f64) -> f64:
    """Derivative of the function along the step, at this size of it; `inertial` is the part of the inertia."""
    scene = thread.scene
    count = _contact_count(s.contacts, scene)
    slope = f64(0.0)
    for i in range(thread.lane, count, thread.lanes):
        along = s.memory.along[scene, i]
        relative = s.memory.relative[scene, i] + size * along
        slope -= wp.dot(_impulse(s.contacts, scene, i, relative, s.memory.bound[scene, i]), along)
    return inertial + _total(s.memory, thread, count, slope)


@wp.func
def _step_size(s: ContactSolver, thread: GroupThread) -> f64:
    """Where the derivative along the step vanishes, at most 1."""
    scene = thread.scene
    bodies = s.memory.rank.shape[1]
    for i in range(thread.lane, _contact_count(s.contacts, scene), thread.lanes):
        s.memory.along[scene, i] = _relative(s.contacts, s.memory.step, scene, i)
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
    if slope_high <= ZERO or slope_low >= ZERO:  # the latter by rounding, at the minimum
        return high
    size = high
    side = int(0)
    limit = wp.abs(slope_low) * SEARCH_TOLERANCE
    for _ in range(SEARCHES):  # false position, with the end that stays counting half (Dowell and Jarratt 1971)
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
    """Change the velocities by a step of Newton's method; the largest change."""
    scene = thread.scene
    bodies = s.memory.rank.shape[1]
    for i in range(thread.lane, _contact_count(s.contacts, scene), thread.lanes):
        _evaluate(s, scene, i)
    wait_for_group()
    for k in range(thread.lane, 9 * s.contacts.active_count[scene], thread.lanes):
        _sum_pair(s, scene, s.contacts.active[scene, k // 9], k % 9)
    wait_for_group()
    for i in range(thread.lane, bodies, thread.lanes):
        _assemble_own(s, scene, i)
    for i in range(thread.lane, bodies, thread.lanes):  # ranks
        for j in range(s.memory.first_rank[scene, i], i):
            _assemble_pair(s, scene, s.memory.order[scene, i], s.memory.order[scene, j])
    wait_for_group()
    _factorise(s.memory, thread)
    _back_substitute(s.memory, thread)
    size = _step_size(s, thread)
    change = f64(0.0)
    for i in range(thread.lane, bodies, thread.lanes):
        linear = size * s.memory.step.linear[scene, i]
        angular = size * s.memory.step.angular[scene, i]
        s.velocities.linear[scene, i] = s.velocities.linear[scene, i] + linear
        s.velocities.angular[scene, i] = s.velocities.angular[scene, i] + angular
        for k in range(3):
            change = wp.max(change, wp.max(wp.abs(linear[k]), wp.abs(angular[k])))
    return _largest(s.memory, thread, bodies, change)


@wp.func
def _coupled(s: ContactSolver, scene: int, i: int, j: int) -> bool:
    bodies = s.memory.rank.shape[1]
    free = not (s.inertia.pinned[scene, i] or s.inertia.pinned[scene, j])
    touching = _has_contacts(s.contacts, scene, i * bodies + j) or _has_contacts(s.contacts, scene, j * bodies + i)
    return free and touching


@wp.func
def _sort_bodies(s: ContactSolver, scene: int):
    """Order the bodies by breadth-first search, island by island (Cuthill and McKee 1969): the Hessian is then zero
    outside a band.
    """
    bodies = s.memory.rank.shape[1]
    for i in range(bodies):
        s.memory.rank[scene, i] = -1
    end = int(0)
    for i in range(bodies):
        if s.memory.rank[scene, i] < 0:
            s.memory.rank[scene, i] = end
            s.memory.order[scene, end] = i
            at = int(end)
            end += 1
            while at < end:
                body = s.memory.order[scene, at]
                least = int(at)
                for j in range(bodies):
                    if j != body and _coupled(s, scene, body, j):
                        if s.memory.rank[scene, j] < 0:
                            s.memory.rank[scene, j] = end
                            s.memory.order[scene, end] = j
                            end += 1
                        least = wp.min(least, s.memory.rank[scene, j])
                s.memory.first_rank[scene, at] = least
                for rank in range(least, at + 1):
                    s.memory.last_rank[scene, rank] = at
                at += 1


@wp.func
def solve(s: ContactSolver, thread: GroupThread):
    """Change the velocities to those after the step, and set the impulses of the contacts."""
    scene = thread.scene
    bodies = s.memory.rank.shape[1]
    if thread.lane == 0:
        _sort_bodies(s, scene)
    count = _contact_count(s.contacts, scene)
    for i in range(thread.lane, count, thread.lanes):
        s.memory.bound[scene, i] = ZERO
    wait_for_group()
    for k in range(ROUNDS):  # the first without friction
        if k > 0:
            for i in range(thread.lane, count, thread.lanes):
                along = _along(s.contacts, scene, i, _relative(s.contacts, s.velocities, scene, i))
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
        if _largest(s.memory, thread, bodies, change) < TOLERANCE and k > 0:
            break
    for i in range(thread.lane, count, thread.lanes):
        relative = _relative(s.contacts, s.velocities, scene, i)
        s.contacts.impulse[scene, i] = _impulse(s.contacts, scene, i, relative, s.memory.bound[scene, i])
    wait_for_group()
