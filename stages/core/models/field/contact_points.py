"""Where contacts are, and what can be seen there, in units of order one."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.models.dynamics import FRAME
from stages.core.models.field.contact_forces import ContactPoints
from stages.core.models.field.equivariant import smooth_cutoff, smooth_norm, symmetric_solve
from stages.core.models.field.narrow_phase import nearest
from stages.core.models.field.rest_shape import RestShape

FULL_CONTACT, NO_CONTACT = 0.04, 0.1  # a contact is full below and none above, now or a frame ahead [m]
SEARCH_RADIUS = (
    0.2  # farther things are not looked at, however fast they come: at 5 m/s they are contacts a frame later [m]
)
GAP_UNIT = 0.05  # what distances are measured in [m]
PAIR_FRACTION, WALL_FRACTION = (
    0.375,
    0.125,
)  # share of the keypoints of an object that can touch another one, or the walls
ARM_UNIT = 0.3  # what arms are measured in [m]


class BodyKinematics(NamedTuple):
    """Bodies in the world."""

    R: Float[Tensor, "b o 3 3"]
    inverse: Float[Tensor, "b o 3 3"]  # of the inertia per unit of mass, world axes [1/m^2]
    spin: Float[Tensor, "b o 3"]  # [rad/s]
    com: Float[Tensor, "b o 3"]  # [m]
    velocity: Float[Tensor, "b o 3"]  # [m/s]
    arm: Float[Tensor, "b o n 3"]  # points about the centre of mass [m]
    points: Float[Tensor, "b o n 3"]  # [m]
    speed: Float[Tensor, "b o n 3"]  # of the points [m/s]
    normal: Float[Tensor, "b o n 3"]


def pair_contacts(shape: RestShape, moving: BodyKinematics) -> ContactPoints:
    """The keypoints of every object that are nearest to every other object, and its keypoint next to each of them.

    The first vector is the way between the two, in CLOSE. Only MOST of the keypoints of an object, those nearest now or
    a frame ahead, are places of contact with another.
    """
    w, others = shape.initial, shape.others
    distance, index = nearest(moving.points, w.valid, SEARCH_RADIUS)
    b, o, _, n = distance.shape
    m, most = others.shape[1], math.ceil(PAIR_FRACTION * n)
    pick = others[None, :, :, None].expand(b, o, m, n)
    distance, index = distance.gather(2, pick), index.gather(2, pick)
    theirs = index + n * others[:, :, None]
    state = torch.cat([moving.points, moving.speed, moving.normal, moving.arm, shape.spacing[..., None]], -1)
    if most < n:
        with torch.no_grad():
            ahead = moving.points + FRAME * moving.speed
            ahead = smooth_norm(ahead[:, :, None] - _rows(ahead, theirs))
            key = torch.where(distance.isfinite(), torch.minimum(distance, ahead), torch.inf)
            mine = key.topk(most, largest=False).indices
        theirs, distance = theirs.gather(-1, mine), distance.gather(-1, mine)
        distance = distance.masked_fill(_beyond(mine, PAIR_FRACTION, w.valid)[:, :, None], torch.inf)
    else:
        mine = torch.arange(n, device=index.device).expand_as(index)
    here = _rows(state, mine + n * torch.arange(o, device=mine.device)[:, None, None])
    there = _rows(state, theirs)
    way, pass_by = (here - there)[..., :3], (here - there)[..., 3:6]
    apart = (moving.velocity[:, :, None] - moving.velocity[:, others])[:, :, :, None].expand_as(way)
    gravity = (w.gravity / 5)[:, None, None, None].expand_as(way)
    now, ahead = smooth_norm(way), smooth_norm(way + FRAME * pass_by)
    gate = torch.where(distance.isfinite(), smooth_cutoff(torch.minimum(now, ahead), FULL_CONTACT, NO_CONTACT), 0.0)
    mass = w.mass.clamp_min(1e-6)
    light = (mass[:, others] / (mass[:, :, None] + mass[:, others]))[..., None, None, None]
    K = light * _response(moving.inverse[:, :, None, None], here[..., 9:12])
    K = K + (1 - light) * _response(moving.inverse[:, others][:, :, :, None], there[..., 9:12])
    vectors = torch.stack([
        way / GAP_UNIT, here[..., 6:9], there[..., 6:9], pass_by, here[..., 9:12] / ARM_UNIT, there[...,
        9:12] / ARM_UNIT,
        apart, gravity, *symmetric_solve(K, pass_by, there[..., 6:9]),
    ], -2)  # fmt: skip
    sizes = torch.stack([shape.size[:, :, None].expand(b, o, m), shape.size[:, others]], -1).log()
    scalars = torch.cat([
        torch.stack([now / GAP_UNIT, ahead / GAP_UNIT, gate, here[..., 12] / GAP_UNIT, there[..., 12] / GAP_UNIT], -1),
        sizes[:, :, :, None].expand(*now.shape, 2),
    ], -1)  # fmt: skip
    return ContactPoints(_shown(vectors, gate, 2), _shown(scalars, gate, 1), gate, mine)


def _rows(x: Float[Tensor, "b o n c"], rows: Int[Tensor, "b *p"]) -> Float[Tensor, "b *p c"]:
    """Rows of the points of a scene, counted through its objects."""
    flat = rows.flatten(1)[..., None].expand(-1, -1, x.shape[-1])
    return x.flatten(1, 2).gather(1, flat).reshape(*rows.shape, x.shape[-1])


def _response(inverse: Float[Tensor, "*#b 3 3"], arm: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b 3 3"]:
    """How fast a point of a body moves after an impulse on it, for unit mass: 1 - [r] J^-1 [r]."""
    r = arm[..., None, :]
    rotated = torch.linalg.cross(*torch.broadcast_tensors(inverse, r))  # J^-1 [r], by rows
    rotated = torch.linalg.cross(*torch.broadcast_tensors(r, rotated.mT)).mT
    return torch.eye(3, dtype=arm.dtype, device=arm.device) - rotated


def floor_contacts(shape: RestShape, moving: BodyKinematics) -> ContactPoints:
    """Every keypoint and the floor, however deep."""
    height = moving.points[..., 2] - shape.initial.floor[..., None]
    up = torch.eye(3, dtype=height.dtype, device=height.device)[2].expand_as(moving.points)
    row = torch.arange(height.shape[2], device=height.device).expand_as(height)
    return _plane(shape, moving, row, height, up)


def wall_contacts(shape: RestShape, moving: BodyKinematics) -> ContactPoints:
    """The keypoints nearest to a wall or the ceiling, each with the nearest of them."""
    w, x, most = shape.initial, moving.points, math.ceil(WALL_FRACTION * moving.points.shape[2])
    low, high = w.box[..., None, 0, :], w.box[..., None, 1, :]
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    wall, which = torch.cat([(x - low)[..., :2], high - x], -1).min(-1)
    inward = torch.cat([eye[:2], -eye])[which]
    if most < wall.shape[-1]:
        with torch.no_grad():
            key = (wall + FRAME * (moving.speed * inward).sum(-1)).minimum(wall).masked_fill(~w.valid, torch.inf)
            row = key.topk(most, largest=False).indices
    else:
        row = torch.arange(wall.shape[-1], device=x.device).expand_as(wall)
    height = wall.gather(-1, row).masked_fill(_beyond(row, WALL_FRACTION, w.valid), 10 * NO_CONTACT)
    return _plane(shape, moving, row, height, _own(inward, row))


def _beyond(row: Int[Tensor, "*p k"], part: float, valid: Bool[Tensor, "b o n"]) -> Bool[Tensor, "b o k"]:
    """Places that are there only because others have more keypoints."""
    return torch.arange(row.shape[-1], device=row.device) >= (part * valid.sum(-1, keepdim=True)).ceil()


def _own(x: Float[Tensor, "b o n c"], row: Int[Tensor, "b o k"]) -> Float[Tensor, "b o k c"]:
    return x.gather(2, row[..., None].expand(*row.shape, x.shape[-1]))


def _plane(
    shape: RestShape, moving: BodyKinematics, row: Int[Tensor, "b o k"], height: Float[Tensor, "b o k"],
    normal: Float[Tensor, "b o k 3"],
) -> ContactPoints:  # fmt: skip
    w = shape.initial
    state = torch.cat([moving.speed, moving.normal, moving.arm, shape.spacing[..., None], w.valid[..., None]], -1)
    state = _own(state, row)
    speed, arm = state[..., :3], state[..., 6:9]
    whole, gravity = moving.velocity[:, :, None].expand_as(arm), (w.gravity / 5)[:, None, None].expand_as(arm)
    ahead = height + FRAME * (speed * normal).sum(-1)
    gate = torch.where(state[..., 10] > 0, smooth_cutoff(torch.minimum(height, ahead), FULL_CONTACT, NO_CONTACT), 0.0)
    K = _response(moving.inverse[:, :, None], arm)
    vectors = torch.stack([
        normal, state[..., 3:6], speed, arm / ARM_UNIT, whole, gravity, *symmetric_solve(K, speed, normal)
    ], -2)  # fmt: skip
    scalars = torch.stack([
        (height / GAP_UNIT).clamp(-2, 2), (ahead / GAP_UNIT).clamp(-2, 2), gate, state[..., 9] / GAP_UNIT,
        shape.size[..., None].log().expand_as(height),
    ], -1)  # fmt: skip
    vectors, scalars = _shown(vectors, gate, 2), _shown(scalars, gate, 1)
    return ContactPoints(vectors[:, :, None], scalars[:, :, None], gate[:, :, None], row[:, :, None])


def _shown(x: Tensor, gate: Tensor, more: int) -> Tensor:
    """Far places show nothing: what they hold may be huge, and must not reach the gradient."""
    return torch.where(gate[(...,) + (None,) * more] > 0, x, 0.0)
