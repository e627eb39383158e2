"""Hand-written response to floor and walls: non-negative normal forces, a penetration limit and a friction threshold.

These rules are applied in addition to the learned forces. They are heuristics, not a Coulomb contact solver; their
constants were chosen by hand from rollouts and have no published source.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import softplus

from stages.core.models.dynamics import FRAME
from stages.core.models.field.contact_forces import ContactPoints
from stages.core.models.field.rest_shape import RestShape

MAX_PENETRATION = 0.03  # largest depth of a keypoint in floor, wall or ceiling [m]; hand-chosen, no source
MAX_RECOVERY_SPEED = 1.0  # speed limit for moving out a body deeper than MAX_PENETRATION [m/s]; hand-chosen, no source
SEPARATION_SPEED = 0.5  # normal speed away from a plane that halves its normal force [m/s]; hand-chosen, no source
MAX_FRICTION_SPEED = 0.07  # largest friction threshold of the floor [m/s]; hand-chosen, no source
FRICTION_CUTOFF_SPEED = 0.3  # scale of the term that fades out friction of fast bodies [m/s]; hand-chosen, no source


def push_only(
    a: Float[Tensor, "b o 1 n 3"], contacts: ContactPoints, weight: Float[Tensor, "b o 1 n"]
) -> Float[Tensor, "b o 1 n 3"]:
    """Make the normal part of accelerations `a` by a plane [m/s^2] non-negative, and smaller during separation.

    The normal part passes through a softplus and is divided by 1 + separation speed / SEPARATION_SPEED, so that each
    bounce loses energy (similar to the damping of Hunt and Crossley 1975, which is proportional to the force).
    """
    normal, unit = contacts.vectors[..., 0, :], weight[..., None].clamp_min(1e-9)
    along, separation = ((x * normal).sum(-1, keepdim=True) for x in (a, contacts.vectors[..., 2, :]))
    push = unit * softplus(along / unit) / (1 + separation.clamp_min(0) / SEPARATION_SPEED)
    return a + (push - along) * normal


def friction_factor(
    shape: RestShape, friction_speed: Float[Tensor, "b o 1"],
    before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor], dt: float,
) -> Float[Tensor, "b o 1"]:  # fmt: skip
    """Factor in 0..1 on velocity and spin: about 1 above `friction_speed`, towards 0 below it (quartic).

    Without it, resting bodies creep, since the forces on them balance only approximately. `before` and `after` are
    (velocity, spin) [m/s, rad/s] before and after the forces of the step. For slow bodies the mean of both is used,
    because stiff contact forces alternate from step to step and the mean cancels the alternation.
    """
    extent = shape.size[..., None].square()
    last = after[0].square().sum(-1, keepdim=True) + extent * after[1].square().sum(-1, keepdim=True)
    both = [(x + y) / 2 for x, y in zip(before, after, strict=True)]
    net = both[0].square().sum(-1, keepdim=True) + extent * both[1].square().sum(-1, keepdim=True)
    moving = (net + (last / FRICTION_CUTOFF_SPEED).square()).square() + 1e-16
    return moving / (moving + dt / FRAME * friction_speed.square().square())


def limit_penetration(
    shape: RestShape, points: Float[Tensor, "b o n 3"], velocity: Float[Tensor, "b o 3"], dt: float
) -> Float[Tensor, "b o 3"]:
    """Change velocities [m/s] so that after dt no point is deeper than MAX_PENETRATION in floor, walls or ceiling."""
    w = shape.initial
    hidden = ~w.valid[..., None]
    # not amin: when compiled, its gradient compares for equality with the minimum, which may be rounded differently
    lowest = points.masked_fill(hidden, torch.inf).min(2).values
    highest = points.masked_fill(hidden, -torch.inf).max(2).values
    up = (w.box[..., 0, :] - MAX_PENETRATION - lowest) / dt
    down = (w.box[..., 1, :] + MAX_PENETRATION - highest) / dt
    velocity = torch.maximum(velocity, up.clamp(max=MAX_RECOVERY_SPEED))
    return torch.minimum(velocity, down.clamp(min=-MAX_RECOVERY_SPEED))
