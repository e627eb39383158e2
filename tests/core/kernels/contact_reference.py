"""Reference for the solver of `stages.core.kernels.field.contact_solve` in PyTorch, for one scene.

With the bodies' inertia M, the velocities v minimise the convex function

    (v - v0)' M (v - v0) / 2 + sum of the potentials of the contact impulses,

where v0 are the velocities without contact. The normal impulse (target - normal speed) / R_n is never negative. The
tangential impulse -slip / R_t is limited to friction times the normal impulse of the previous minimum, which is a fixed
point iteration that converges in few rounds. R_n and R_t are small fractions of the inverse effective mass, so that
contacts are as stiff as a step resolves. The minimum is found by Newton's method with a line search.
Sources: Castro, Permenter and Han 2022, "An unconstrained convex formulation of compliant contact"; friction bounded by
the previous normal forces: Castro et al. 2023, "A theory of irrotational contact fields".
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

NORMAL_REGULARISATION, FRICTION_REGULARISATION = 1e-3, 1e-3  # R_n and R_t [inverse effective masses]
ROUNDS = 5  # maximum number of fixed point iterations
ITERATIONS = 20  # maximum number of Newton iterations in each round
TOLERANCE = 1e-6  # change of velocities at which both iterations stop [m/s]
SEARCHED = 2.0 ** -torch.arange(16)  # step sizes between which the line search interpolates
PINNED_MASS = 1e6  # mass of a pinned body, relative to the heaviest body


class Contacts(NamedTuple):
    """r contact points of a body a with a body b, or with a fixed surface (b = a)."""

    a: Int[Tensor, "r"]
    b: Int[Tensor, "r"]
    fixed: Tensor  # r; whether the other side is a fixed surface
    normal: Float[Tensor, "r 3"]  # contact normals from body b to body a
    arm_a: Float[Tensor, "r 3"]  # vector from the centre of mass to the contact point [m]
    arm_b: Float[Tensor, "r 3"]
    target: Float[Tensor, "r"]  # smallest normal speed of a relative to b after the step [m/s]
    friction: Float[Tensor, "r"]


class BodyInertia(NamedTuple):
    """Inertia of the bodies in world axes, and their velocities without contact."""

    mass: Float[Tensor, "o"]  # mass of each object [kg]
    inertia: Float[Tensor, "o 3 3"]  # about the centres of mass [kg m^2]
    inverse: Float[Tensor, "o 3 3"]
    velocity: Float[Tensor, "o 6"]  # linear, of the centres of mass [m/s], then angular [rad/s]
    pinned: Tensor  # o


def solve(
    bodies: BodyInertia, contacts: Contacts, start: Float[Tensor, "o 6"]
) -> tuple[Float[Tensor, "o 6"], Float[Tensor, "r 3"]]:
    """Velocities of the bodies after the step, and the impulses on the bodies a [N s], in double precision.

    `start` holds the initial velocities of the iteration.
    """
    system = _System(bodies, contacts)
    v = torch.where(bodies.pinned[:, None], 0.0, start)
    bound = torch.zeros_like(contacts.target)
    for k in range(ROUNDS):  # the first round is without friction
        if k:
            bound = contacts.friction * system.impulses(system.relative(v), bound)[1]
        before = v
        for _ in range(ITERATIONS):
            new = system.newton_step(v, bound)
            change, v = float((new - v).abs().amax()), new
            if change < TOLERANCE:
                break
        if k and float((v - before).abs().amax()) < TOLERANCE:
            break
    return v, system.impulses(system.relative(v), bound)[0]


class _System:
    """The function to be minimised, for given contacts."""

    def __init__(self, bodies: BodyInertia, contacts: Contacts):
        self.contacts, self.free = contacts, torch.where(bodies.pinned[:, None], 0.0, bodies.velocity)
        heavy = 1 + (PINNED_MASS * bodies.mass.max() / bodies.mass - 1) * bodies.pinned
        o, eye = len(bodies.mass), torch.eye(3).to(bodies.mass)
        self.M = torch.zeros(o, 6, 6).to(bodies.mass)
        self.M[:, :3, :3] = (heavy * bodies.mass)[:, None, None] * eye
        self.M[:, 3:, 3:] = heavy[:, None, None] * bodies.inertia
        movable = (~bodies.pinned).to(bodies.mass)
        c = contacts
        response = _response(movable[c.a] / bodies.mass[c.a], movable[c.a, None, None] * bodies.inverse[c.a], c.arm_a)
        other = _response(movable[c.b] / bodies.mass[c.b], movable[c.b, None, None] * bodies.inverse[c.b], c.arm_b)
        response = response + torch.where(c.fixed, 0.0, other)  # inverse effective mass, averaged over all directions
        self.R_n, self.R_t = NORMAL_REGULARISATION * response, FRICTION_REGULARISATION * response
        # wrench of a force at the contact point on each body: r 6 3
        self.P_a = torch.cat([eye.expand(len(c.a), 3, 3), _cross(c.arm_a)], 1)
        self.P_b = torch.cat([eye.expand(len(c.b), 3, 3), _cross(c.arm_b)], 1)
        self.P_b = torch.where(c.fixed[:, None, None], 0.0, -self.P_b)

    def relative(self, v: Float[Tensor, "*s o 6"]) -> Float[Tensor, "*s r 3"]:
        """Velocities of the contact points of a relative to b."""
        c = self.contacts
        return (v[..., c.a, None, :] @ self.P_a)[..., 0, :] + (v[..., c.b, None, :] @ self.P_b)[..., 0, :]

    def impulses(self, relative: Float[Tensor, "*s r 3"], bound: Float[Tensor, "r"]) -> tuple[Tensor, Tensor, Tensor]:
        """Impulses on the bodies a (*s r 3), their normal components (*s r), and tangential impulse per slip (*s r).

        `relative` are the velocities of a relative to b.
        """
        n = self.contacts.normal
        speed = (relative * n).sum(-1)
        slip = relative - speed[..., None] * n
        along = ((self.contacts.target - speed) / self.R_n).clamp_min(0)
        across = torch.minimum(1 / self.R_t, bound / slip.norm(dim=-1).clamp_min(1e-30))
        return along[..., None] * n - across[..., None] * slip, along, across

    def newton_step(self, v: Float[Tensor, "o 6"], bound: Float[Tensor, "r"]) -> Float[Tensor, "o 6"]:
        """The velocities after one Newton step; the tangential impulse is at most `bound`."""
        c, n, o, eye = self.contacts, self.contacts.normal, len(v), torch.eye(3).to(v)
        relative = self.relative(v)
        impulse, along, across = self.impulses(relative, bound)
        gradient = (self.M @ (v - self.free)[..., None])[..., 0]
        gradient = gradient.index_add(0, c.a, -(self.P_a @ impulse[..., None])[..., 0])
        gradient = gradient.index_add(0, c.b, -(self.P_b @ impulse[..., None])[..., 0])
        nn = n[:, :, None] * n[:, None]
        slip = relative - (relative * n).sum(-1, keepdim=True) * n
        slides = (across < 1 / self.R_t).to(v) / slip.square().sum(-1).clamp_min(1e-30)
        tangent = eye - nn - slides[:, None, None] * slip[:, :, None] * slip[:, None]
        G = ((along > 0) / self.R_n)[:, None, None] * nn + across[:, None, None] * tangent
        G_a, G_b = self.P_a @ G, self.P_b @ G
        H = torch.zeros(o * o, 6, 6).to(v)
        H[:: o + 1] = self.M
        H = H.index_add(0, c.a * (o + 1), G_a @ self.P_a.mT).index_add(0, c.b * (o + 1), G_b @ self.P_b.mT)
        cross = G_a @ self.P_b.mT
        H = H.index_add(0, c.a * o + c.b, cross).index_add(0, c.b * o + c.a, cross.mT)
        H = H.view(o, o, 6, 6).transpose(1, 2).reshape(6 * o, 6 * o)
        factor, _ = torch.linalg.cholesky_ex(H)
        step = -torch.cholesky_solve(gradient.reshape(-1, 1), factor).view(o, 6)
        return v + self._step_size(v, step, relative, bound) * step

    def _step_size(self, v: Tensor, step: Tensor, relative: Tensor, bound: Tensor) -> Tensor:
        """Step size at which the derivative along the step vanishes, at most 1."""
        sizes = SEARCHED.to(v)
        along = self.relative(step)
        pushed = self.M @ step[..., None]
        inertial = ((v - self.free)[..., None] * pushed).sum() + sizes * (step[..., None] * pushed).sum()
        impulse, _, _ = self.impulses(relative + sizes[:, None, None] * along, bound)
        slope = inertial - (impulse * along).sum((-1, -2))  # decreases with the step size
        if float(slope[0]) <= 0:
            return sizes[0]
        row = int((slope > 0).sum())  # first step size with a negative slope
        if row == len(sizes):
            return sizes[-1]
        high, low = slope[row - 1], slope[row]
        # if rounding determines the signs, the step is too small to matter
        return sizes[row] + (sizes[row - 1] - sizes[row]) * (low / (low - high)).nan_to_num(0.0).clamp(0, 1)


def _cross(x: Float[Tensor, "r 3"]) -> Float[Tensor, "r 3 3"]:
    """Matrices that compute the cross product with x from the left."""
    zero = torch.zeros_like(x[:, 0])
    a, b, c = x.unbind(1)
    return torch.stack([zero, -c, b, c, zero, -a, -b, a, zero], 1).view(-1, 3, 3)


def _response(inverse_mass: Tensor, inverse: Tensor, arm: Tensor) -> Float[Tensor, "r"]:
    """Velocity response of a point at `arm` to a unit impulse there, averaged over all directions."""
    K = _cross(arm)
    return inverse_mass + (K.mT @ inverse @ K).diagonal(dim1=-2, dim2=-1).sum(-1) / 3
