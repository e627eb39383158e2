"""Where contacts are, and what can be seen there, in units of order one."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stages.models.contact import nearest
from stages.models.dynamics import FRAME
from stages.models.shape import Shape
from stages.models.touch import Places
from stages.models.vectors import fade, length

NEAR, FAR = 0.04, 0.1  # a contact is full below and none above, now or a frame ahead [m]
SEEN = 0.2  # farther things are not looked at, however fast they come: at 5 m/s they are contacts a frame later [m]
CLOSE = 0.05  # what distances are measured in [m]
LEVER = 0.3  # what arms are measured in [m]


class Moving(NamedTuple):
    """Bodies in the world."""

    R: Float[Tensor, "b o 3 3"]
    spin: Float[Tensor, "b o 3"]  # [rad/s]
    com: Float[Tensor, "b o 3"]  # [m]
    velocity: Float[Tensor, "b o 3"]  # [m/s]
    arm: Float[Tensor, "b o n 3"]  # points about the centre of mass [m]
    points: Float[Tensor, "b o n 3"]  # [m]
    speed: Float[Tensor, "b o n 3"]  # of the points [m/s]
    normal: Float[Tensor, "b o n 3"]


def pair_places(shape: Shape, moving: Moving) -> Places:
    """Every keypoint and the nearest one of every other object. The first vector is the way between them, in CLOSE."""
    w, others = shape.world, shape.others
    distance, index = nearest(moving.points, w.valid, SEEN)
    row = torch.arange(len(others), device=others.device)[:, None]
    there = distance[:, row, others].isfinite()
    index = index[:, row, others]
    scene = torch.arange(len(index), device=index.device)[:, None, None, None]

    def there_of(x: Tensor) -> Tensor:
        return x[scene, others[None, :, :, None], index]

    def here_of(x: Tensor) -> Tensor:
        return x[:, :, None].expand(*index.shape, *x.shape[3:])

    way = here_of(moving.points) - there_of(moving.points)
    pass_by = here_of(moving.speed) - there_of(moving.speed)
    apart = moving.velocity[:, :, None] - moving.velocity[:, others]
    gravity = (w.gravity / 5)[:, None, None, None].expand_as(way)
    vectors = torch.stack([
        way / CLOSE, here_of(moving.normal), there_of(moving.normal), pass_by, here_of(moving.arm) / LEVER,
        there_of(moving.arm) / LEVER, apart[:, :, :, None].expand_as(way), gravity,
    ], -2)  # fmt: skip
    now, ahead = length(way), length(way + FRAME * pass_by)
    gate = torch.where(there, fade(torch.minimum(now, ahead), NEAR, FAR), 0.0)
    mine, theirs = shape.size[:, :, None, None], shape.size[:, others][..., None]
    scalars = torch.stack([
        now / CLOSE, ahead / CLOSE, gate, here_of(shape.spacing) / CLOSE, there_of(shape.spacing) / CLOSE,
        mine.log().expand_as(now), theirs.log().expand_as(now),
    ], -1)  # fmt: skip
    return Places(_shown(vectors, gate, 2), _shown(scalars, gate, 1), gate)


def plane_places(shape: Shape, moving: Moving) -> Places:
    """Every keypoint and the floor, and every keypoint and the nearest of walls and ceiling; however deep."""
    w, x = shape.world, moving.points
    low, high = w.box[:, None, None, 0], w.box[:, None, None, 1]
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    above = (x - low)[..., 2]
    room = torch.cat([(x - low)[..., :2], high - x], -1)
    inward = torch.cat([eye[:2], -eye])
    wall, which = room.min(-1)
    height = torch.stack([above, wall], 2)
    normal = torch.stack([eye[2].expand_as(x), inward[which]], 2)

    def twice(v: Tensor) -> Tensor:
        return v[:, :, None].expand_as(normal)

    speed = twice(moving.speed)
    whole, gravity = moving.velocity[:, :, None, None], (w.gravity / 5)[:, None, None, None]
    vectors = torch.stack([
        normal, twice(moving.normal), speed, twice(moving.arm) / LEVER, whole.expand_as(normal),
        gravity.expand_as(normal),
    ], -2)  # fmt: skip
    ahead = height + FRAME * (speed * normal).sum(-1)
    gate = torch.where(w.valid[:, :, None], fade(torch.minimum(height, ahead), NEAR, FAR), 0.0)
    spacing, size = (v.expand_as(height) for v in (shape.spacing[:, :, None], shape.size[:, :, None, None]))
    scalars = torch.stack([
        (height / CLOSE).clamp(-2, 2), (ahead / CLOSE).clamp(-2, 2), gate, spacing / CLOSE, size.log(),
    ], -1)  # fmt: skip
    return Places(_shown(vectors, gate, 2), _shown(scalars, gate, 1), gate)


def _shown(x: Tensor, gate: Tensor, more: int) -> Tensor:
    """Far places show nothing: what they hold may be huge, and must not reach the gradient."""
    return torch.where(gate[(...,) + (None,) * more] > 0, x, 0.0)
