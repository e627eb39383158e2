"""Regularised contact impulses of rigid bodies as functions of the bodies' velocities, and the arrays of the solver.

The normal impulse is (target - normal speed) / R_n, and never attractive. The friction impulse is -slip / R_t, with a
magnitude of at most `bound`.
"""

from __future__ import annotations

import warp as wp

from stages.core.kernels.interop import empty_arrays

f64 = wp.float64
# R_n and R_t as fractions of the inverse effective mass of a contact. With these values a box held by friction on a
# slope creeps at a thousandth of the speed that gravity along the slope would add in one step.
NORMAL_REGULARISATION = wp.constant(f64(1e-3))
FRICTION_REGULARISATION = wp.constant(f64(1e-3))
ZERO, ONE, TINY = wp.constant(f64(0.0)), wp.constant(f64(1.0)), wp.constant(f64(1e-30))


@wp.struct
class Velocities:
    """Velocities of the bodies of each scene."""

    linear: wp.array2d[wp.vec3d]  # velocity of the centre of mass [m/s]
    angular: wp.array2d[wp.vec3d]  # angular velocity [rad/s]


@wp.struct
class BodyProperties:
    """Properties of the bodies of each scene."""

    mass: wp.array2d[float]  # [kg]
    inertia: wp.array2d[wp.mat33]  # per unit of mass, rest orientation [m^2]
    inverse: wp.array2d[wp.mat33]  # inverse of `inertia` [1/m^2]
    friction: wp.array2d[float]  # coefficient of friction
    loss: wp.array2d[float]  # loss factor; the coefficient of restitution is exp(-pi/2 loss)
    acceleration: wp.array2d[wp.vec3]  # of the centre of mass without contact [m/s^2]
    twist: wp.array2d[wp.vec3]  # torque per unit of mass without contact [m^2/s^2]
    mass_fraction: wp.array3d[float]  # fraction of the body's mass at each keypoint


@wp.struct
class Inertias:
    """Inertia of the bodies of each scene, in world axes."""

    mass: wp.array2d[float]  # [kg]
    tensor: wp.array2d[wp.mat33d]  # [kg m^2]
    inverse: wp.array2d[wp.mat33d]  # inverse of `tensor` [1/(kg m^2)]
    pinned: wp.array2d[wp.bool]


@wp.struct
class Contacts:
    """Contacts of each scene, grouped by pairs of bodies a and b; a = b for contacts of a with the fixed planes."""

    first: wp.array2d[int]  # first contact of pair a * bodies + b; one more entry for the end
    active: wp.array2d[int]  # pairs that have contacts
    active_count: wp.array[int]
    a: wp.array2d[int]
    b: wp.array2d[int]
    normal: wp.array2d[wp.vec3d]  # contact normal, from b to a
    arm_a: wp.array2d[wp.vec3d]  # contact point relative to the centre of mass of a [m]
    arm_b: wp.array2d[wp.vec3d]  # contact point relative to the centre of mass of b [m]
    target: wp.array2d[f64]  # smallest normal speed of a relative to b that is allowed after the step [m/s]
    resting: wp.array2d[f64]  # `target` of a contact that does not rebound [m/s]
    least: wp.array2d[f64]  # normal speed below which the contact rebounds [m/s]
    gained: wp.array2d[f64]  # normal speed added by other forces up to the middle of the step [m/s]
    restitution: wp.array2d[f64]
    friction: wp.array2d[f64]
    R_n: wp.array2d[f64]  # normal regularisation
    R_t: wp.array2d[f64]  # friction regularisation
    impulse: wp.array2d[wp.vec3d]  # impulse on a [N s]; the result
    total: wp.array2d[wp.vec3d]  # sum of the impulses over all turns (`contact_turns`) [N s]


@wp.struct
class Decomposition:
    """The Hessian of each scene, overwritten by its LDL' decomposition."""

    H: wp.array2d[f64]  # lower triangle of the Hessian; its extra last row is the negative gradient
    inverse: wp.array2d[f64]  # reciprocals of the diagonal of D


@wp.struct
class SolverMemory:
    """Intermediate results of the solver."""

    bound: wp.array2d[f64]  # upper bound of the friction impulse of each contact [N s]
    relative: wp.array2d[wp.vec3d]  # velocity of a relative to b at each contact [m/s]
    along: wp.array2d[wp.vec3d]  # change of `relative` by a full Newton step [m/s]
    matrices: wp.array3d[wp.mat33d]  # matrix terms of each contact, see `_evaluate`
    vectors: wp.array3d[wp.vec3d]  # vector terms of each contact, see `_evaluate`
    pair_matrices: wp.array3d[wp.mat33d]  # sums of `matrices` over the contacts of each pair
    pair_vectors: wp.array3d[wp.vec3d]  # sums of `vectors` over the contacts of each pair
    step: Velocities  # Newton step
    before: Velocities  # velocities at the start of a round of the fixed-point iteration
    decomposition: Decomposition
    order: wp.array2d[int]  # body of each rank; the order of bodies in the Hessian, with small bandwidth
    rank: wp.array2d[int]  # rank of each body; the inverse of `order`
    first_rank: wp.array2d[int]  # lowest rank that the body of each rank is coupled to
    last_rank: wp.array2d[int]  # for each rank, the highest rank whose `first_rank` is not above it
    partial: wp.array2d[f64]  # partial results of the threads, for reductions


@wp.struct
class ContactSolver:
    """Contacts and bodies of each scene, with the velocities and working memory of the solver."""

    contacts: Contacts
    inertia: Inertias
    velocities: Velocities  # in: initial guess; out: velocities after the step; 0 for pinned bodies
    free: Velocities  # velocities without contact; 0 for pinned bodies
    impacted: Velocities  # velocities at the start of the step, then changed by impacts; 0 for pinned bodies
    memory: SolverMemory


def contact_solver(device: str, scenes: int, bodies: int, contacts: int, group: int) -> ContactSolver:
    """Allocate a solver for up to `contacts` contacts per scene, with `group` threads per scene.

    The caller sets `inertia.mass` and `inertia.pinned`.
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
    """Inverse effective mass at `arm` [1/kg]: the speed per unit impulse, averaged over all directions."""
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
    """Whether a pair of bodies has contacts."""
    return c.first[scene, pair + 1] > c.first[scene, pair]


@wp.func
def relative_velocity(c: Contacts, v: Velocities, scene: int, i: int) -> wp.vec3d:
    """Velocity of body a relative to body b at contact i [m/s]."""
    a = c.a[scene, i]
    b = c.b[scene, i]
    out = v.linear[scene, a] + wp.cross(v.angular[scene, a], c.arm_a[scene, i])
    if b != a:
        out -= v.linear[scene, b] + wp.cross(v.angular[scene, b], c.arm_b[scene, i])
    return out


@wp.func
def normal_impulse(c: Contacts, scene: int, i: int, relative: wp.vec3d) -> f64:
    """Impulse on body a along the contact normal [N s]."""
    return wp.max((c.target[scene, i] - wp.dot(relative, c.normal[scene, i])) / c.R_n[scene, i], ZERO)


@wp.func
def contact_impulse(c: Contacts, scene: int, i: int, relative: wp.vec3d, bound: f64) -> wp.vec3d:
    """Impulse on body a at a given relative velocity [N s]; the magnitude of its tangential part is at most `bound`."""
    n = c.normal[scene, i]
    slip = relative - wp.dot(relative, n) * n
    across = wp.min(ONE / c.R_t[scene, i], bound / wp.max(wp.length(slip), TINY))
    return normal_impulse(c, scene, i, relative) * n - across * slip


@wp.func
def contact_hessian(c: Contacts, scene: int, i: int, relative: wp.vec3d, bound: f64) -> wp.mat33d:
    """Derivative of the negative impulse with respect to the relative velocity."""
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
