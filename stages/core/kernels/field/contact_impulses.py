"""Contacts of rigid bodies: their impulses as functions of the bodies' velocities, and the arrays of their solution.

The impulse along a normal, (target - normal speed) / R_n, never pulls; that across it, -slip / R_t, is at most `bound`.
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.interop import empty_arrays

f64 = wp.float64
# Of the inverse effective mass; a box creeps on a slope by a thousandth of what it would gain in a step.
NORMAL_REGULARISATION = wp.constant(f64(1e-3))
FRICTION_REGULARISATION = wp.constant(f64(1e-3))
ZERO, ONE, TINY = wp.constant(f64(0.0)), wp.constant(f64(1.0)), wp.constant(f64(1e-30))


@wp.struct
class Velocities:
    """Of the bodies of each scene."""

    linear: wp.array2d[wp.vec3d]  # of the centres of mass [m/s]
    angular: wp.array2d[wp.vec3d]  # [rad/s]


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
    resting: wp.array2d[f64]  # the same of a contact that does not rebound
    least: wp.array2d[f64]  # normal speed below which it rebounds [m/s]
    gained: wp.array2d[f64]  # normal speed that other forces give until the middle of the step [m/s]
    restitution: wp.array2d[f64]
    friction: wp.array2d[f64]
    R_n: wp.array2d[f64]
    R_t: wp.array2d[f64]
    impulse: wp.array2d[wp.vec3d]  # on a [N s]; the result
    total: wp.array2d[wp.vec3d]  # that of all turns of impacts


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
    impacted: Velocities  # those at the start of the step, changed by impacts; 0 of pinned bodies
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
    memory.step, memory.before, out.velocities, out.free, out.impacted = (
        empty_arrays(Velocities, device, (b, bodies)) for _ in range(5)
    )  # fmt: skip
    out.memory = memory
    return out


@wp.func
def effective_response(inertia: Inertias, scene: int, body: int, arm: wp.vec3d) -> f64:
    """Speed that a unit impulse at `arm` gives its point, the mean over all directions."""
    if inertia.pinned[scene, body]:
        return ZERO
    K = wp.skew(arm)
    turned = wp.transpose(K) * inertia.inverse[scene, body] * K
    return ONE / f64(inertia.mass[scene, body]) + (turned[0, 0] + turned[1, 1] + turned[2, 2]) / f64(3.0)


@wp.func
def contact_count(c: Contacts, scene: int) -> int:
    """Number of contacts in a scene."""
    return c.first[scene, c.first.shape[1] - 1]


@wp.func
def has_contacts(c: Contacts, scene: int, pair: int) -> bool:
    """Whether a pair of bodies has any."""
    return c.first[scene, pair + 1] > c.first[scene, pair]


@wp.func
def relative_velocity(c: Contacts, v: Velocities, scene: int, i: int) -> wp.vec3d:
    """Velocity of a relative to b at a contact."""
    a = c.a[scene, i]
    b = c.b[scene, i]
    out = v.linear[scene, a] + wp.cross(v.angular[scene, a], c.arm_a[scene, i])
    if b != a:
        out -= v.linear[scene, b] + wp.cross(v.angular[scene, b], c.arm_b[scene, i])
    return out


@wp.func
def normal_impulse(c: Contacts, scene: int, i: int, relative: wp.vec3d) -> f64:
    """Impulse along the normal."""
    return wp.max((c.target[scene, i] - wp.dot(relative, c.normal[scene, i])) / c.R_n[scene, i], ZERO)


@wp.func
def contact_impulse(c: Contacts, scene: int, i: int, relative: wp.vec3d, bound: f64) -> wp.vec3d:
    """Impulse on body a at this relative velocity [N s]; its tangential part is at most `bound`."""
    n = c.normal[scene, i]
    slip = relative - wp.dot(relative, n) * n
    across = wp.min(ONE / c.R_t[scene, i], bound / wp.max(wp.length(slip), TINY))
    return normal_impulse(c, scene, i, relative) * n - across * slip


@wp.func
def contact_hessian(c: Contacts, scene: int, i: int, relative: wp.vec3d, bound: f64) -> wp.mat33d:
    """Derivative of the negative impulse by the relative velocity."""
    n = c.normal[scene, i]
    slip = relative - wp.dot(relative, n) * n
    speed = wp.max(wp.length(slip), TINY)
    across = wp.min(ONE / c.R_t[scene, i], bound / speed)
    nn = wp.outer(n, n)
    out = across * (wp.identity(3, dtype=f64) - nn)
    if across < ONE / c.R_t[scene, i]:
        out -= across * wp.outer(slip / speed, slip / speed)
    if normal_impulse(c, scene, i, relative) > ZERO:
        out += nn / c.R_n[scene, i]
    return out
