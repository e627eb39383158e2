"""Contact points and their features: selection of keypoints near other objects, floor and walls."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.geometry.symmetric_matrices import symmetric_solve
from stages.core.models.dynamics import FRAME
from stages.core.models.field.contact_forces import ContactPoints, at_contacts
from stages.core.models.field.equivariant import smooth_cutoff, smooth_norm
from stages.core.models.field.narrow_phase import nearest
from stages.core.models.field.rest_shape import RestShape

# Distances are the smaller of the current one and the one extrapolated linearly to one FRAME ahead. The constants are
# hand-chosen, without a source.
FULL_CONTACT, NO_CONTACT = 0.04, 0.1  # the gate is 1 below the first and 0 above the second distance [m]
# Points farther apart than this are never paired [m]; at 5 m/s a point this far is within NO_CONTACT one FRAME later.
SEARCH_RADIUS = 0.2
PAIR_FRACTION, WALL_FRACTION = 0.375, 0.125  # largest fraction of keypoints in contact with another object, with walls
GAP_UNIT = 0.05  # network inputs: unit of distances [m]
ARM_UNIT = 0.3  # network inputs: unit of offsets from the centre of mass [m]


class BodyKinematics(NamedTuple):
    """Kinematics of the bodies and their keypoints in world coordinates."""

    R: Float[Tensor, "b o 3 3"]
    inverse: Float[Tensor, "b o 3 3"]  # inverse of the inertia tensor per unit of mass [1/m^2]
    spin: Float[Tensor, "b o 3"]  # angular velocity [rad/s]
    com: Float[Tensor, "b o 3"]  # centre of mass [m]
    velocity: Float[Tensor, "b o 3"]  # of the centre of mass [m/s]
    arm: Float[Tensor, "b o n 3"]  # keypoints relative to the centre of mass [m]
    points: Float[Tensor, "b o n 3"]  # [m]
    point_velocity: Float[Tensor, "b o n 3"]  # of the keypoints [m/s]
    normal: Float[Tensor, "b o n 3"]  # outward, of length up to 1


class PairRows(NamedTuple):
    """Inputs for the features of contacts between two bodies, one row per contact."""

    own: Int[Tensor, "*#r"]  # keypoint of the body, counted over all objects
    partner: Int[Tensor, "*#r"]  # keypoint of the partner, counted over all objects
    difference: Float[Tensor, "*#r 6"]  # of the keypoints' positions [m] and velocities [m/s]
    distances: Float[Tensor, "*#r 3"]  # distance now and one FRAME ahead [GAP_UNIT], and the gate
    inverse: Float[Tensor, "*#r 3 3"]  # inverse inertia of the body, as in BodyKinematics
    other_inverse: Float[Tensor, "*#r 3 3"]  # inverse inertia of the partner
    ratio: Float[Tensor, "*#r"]  # mass of the partner over the mass of both
    relative: Float[Tensor, "*#r 3"]  # relative velocity of the bodies [m/s]
    gravity: Float[Tensor, "*#r 3"]  # [5 m/s^2]
    sizes: Float[Tensor, "*#r 2"]  # logarithms of the sizes of both bodies


class PlaneRows(NamedTuple):
    """Inputs for the features of contacts with planes, one row per contact."""

    state: Float[Tensor, "*#r 11"]  # of the keypoint: velocity, normal, arm, spacing, and whether it is valid
    normal: Float[Tensor, "*#r 3"]  # normal of the plane
    distances: Float[Tensor, "*#r 3"]  # distance now and one FRAME ahead [GAP_UNIT], and the gate
    inverse: Float[Tensor, "*#r 3 3"]  # inverse inertia of the body, as in BodyKinematics
    velocity: Float[Tensor, "*#r 3"]  # velocity of the body [m/s]
    gravity: Float[Tensor, "*#r 3"]  # [5 m/s^2]
    size: Float[Tensor, "*#r 1"]  # logarithm of the size of the body


def pair_contacts(shape: RestShape, bodies: BodyKinematics) -> ContactPoints:
    """Find the contacts of every object with every other one, and compute their features.

    The contact points with a partner are at most PAIR_FRACTION of an object's keypoints, those closest to the partner
    now or one FRAME ahead, each paired with the partner's nearest keypoint. Vectors, in this order: gap (from the
    partner's point, in GAP_UNIT), normals of both, relative velocity of the points, arms of both (in ARM_UNIT),
    relative velocity of the bodies, gravity, and the impulses per reduced mass that (up to sign) cancel the relative
    velocity and that give a unit velocity along the partner's normal.
    """
    w, others = shape.initial, shape.others
    own, partner, distance = _nearest_pairs(shape, bodies)
    b, o, m, _ = own.shape
    first = w.valid.shape[2] * torch.arange(b * o, device=own.device).view(b, o, 1, 1)  # keypoint of each object
    rows = first + own, partner
    motion = torch.cat([bodies.points, bodies.point_velocity], -1).flatten(0, 2)
    difference = _rows(motion, rows[0]) - _rows(motion, rows[1])
    gap, approach = difference.split(3, -1)
    now, ahead = smooth_norm(gap), smooth_norm(gap + FRAME * approach)
    gate = torch.where(
        distance.isfinite(), smooth_cutoff(torch.minimum(now, ahead), FULL_CONTACT, NO_CONTACT), 0.0
    )  # fmt: skip
    mass = w.mass.clamp_min(1e-6)
    ratio = mass[:, others] / (mass[:, :, None] + mass[:, others])
    relative = bodies.velocity[:, :, None] - bodies.velocity[:, others]
    sizes = torch.stack([shape.size[:, :, None].expand(b, o, m), shape.size[:, others]], -1).log()
    state = torch.cat([bodies.normal, bodies.arm, shape.spacing[..., None]], -1).flatten(0, 2)

    def features(*inputs: Tensor, needed: Tensor | None = None) -> Tensor:
        """Concatenated vectors and scalars."""
        x = PairRows(*inputs)
        gap, approach = x.difference.split(3, -1)
        own_normal, own_arm, own_spacing = _rows(state, x.own).split([3, 3, 1], -1)
        normal, arm, spacing = _rows(state, x.partner).split([3, 3, 1], -1)
        ratio = x.ratio[..., None, None]
        K = ratio * _impulse_response(x.inverse, own_arm) + (1 - ratio) * _impulse_response(x.other_inverse, arm)
        vectors = torch.cat([
            gap / GAP_UNIT, own_normal, normal, approach, own_arm / ARM_UNIT, arm / ARM_UNIT, x.relative.expand_as(gap),
            x.gravity.expand_as(gap), *symmetric_solve(K, approach, normal),
        ], -1)  # fmt: skip
        sizes = x.sizes.expand(*gap.shape[:-1], 2)
        return torch.cat([vectors, x.distances, own_spacing / GAP_UNIT, spacing / GAP_UNIT, sizes], -1)

    of_pairs = [bodies.inverse[:, :, None], bodies.inverse[:, others], ratio, relative, (w.gravity / 5)[:, None, None],
                sizes]  # fmt: skip
    distances = torch.stack([now / GAP_UNIT, ahead / GAP_UNIT, gate], -1)
    inputs = PairRows(*rows, difference, distances, *(x[:, :, :, None] for x in of_pairs))
    values = at_contacts(gate > 0, features, *inputs)
    values = _within_cutoff(values, gate)
    return ContactPoints(values[..., :30].unflatten(-1, (10, 3)), values[..., 30:], gate, own)


def _rows(x: Float[Tensor, "n c"], index: Int[Tensor, "*p"]) -> Float[Tensor, "*p c"]:
    """Rows of x; its gradient needs no sorting, unlike the gradient of `x[index]`."""
    return x.index_select(0, index.flatten()).reshape(*index.shape, x.shape[1])


def _nearest_pairs(
    shape: RestShape, bodies: BodyKinematics
) -> tuple[Int[Tensor, "b o m k"], Int[Tensor, "b o m k"], Float[Tensor, "b o m k"]]:
    """Return keypoints of each object near each partner, the partner's keypoints nearest to them, and distances [m].

    The partner's keypoints are counted over all objects of the batch. Distances are infinite where there is no contact.
    """
    w, others = shape.initial, shape.others
    distance, index = nearest(bodies.points, w.valid, SEARCH_RADIUS)
    b, o, _, n = distance.shape
    count = math.ceil(PAIR_FRACTION * n)
    pick = others[None, :, :, None].expand(b, o, others.shape[1], n)
    distance, index = distance.gather(2, pick), index.gather(2, pick)
    partner = index + n * (others + o * torch.arange(b, device=others.device)[:, None, None])[..., None]
    if count >= n:
        return torch.arange(n, device=index.device).expand_as(index), partner, distance
    with torch.no_grad():
        ahead = bodies.points + FRAME * bodies.point_velocity
        ahead = smooth_norm(ahead[:, :, None] - _rows(ahead.flatten(0, 2), partner))
        key = torch.where(distance.isfinite(), torch.minimum(distance, ahead), torch.inf)
        own = key.topk(count, largest=False).indices
    partner, distance = partner.gather(-1, own), distance.gather(-1, own)
    return own, partner, distance.masked_fill(_beyond(own, PAIR_FRACTION, w.valid)[:, :, None], torch.inf)


def _impulse_response(inverse: Float[Tensor, "*#b 3 3"], arm: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Velocity change of a point at `arm` per unit impulse on it and unit mass: 1 - [r] J^-1 [r]."""
    r = arm[..., None, :]
    K = torch.linalg.cross(*torch.broadcast_tensors(inverse, r))  # J^-1 [r], by rows
    K = torch.linalg.cross(*torch.broadcast_tensors(r, K.mT)).mT
    return torch.eye(3, dtype=arm.dtype, device=arm.device) - K


def floor_contacts(shape: RestShape, bodies: BodyKinematics) -> ContactPoints:
    """Contacts of every keypoint with the floor, at any depth."""
    height = bodies.points[..., 2] - shape.initial.floor[..., None]
    up = torch.eye(3, dtype=height.dtype, device=height.device)[2].expand_as(bodies.points)
    row = torch.arange(height.shape[2], device=height.device).expand_as(height)
    return _plane_contacts(shape, bodies, row, height, up)


def wall_contacts(shape: RestShape, bodies: BodyKinematics) -> ContactPoints:
    """Contacts of the keypoints nearest to walls or ceiling (at most WALL_FRACTION), each with its nearest plane."""
    w, x, count = shape.initial, bodies.points, math.ceil(WALL_FRACTION * bodies.points.shape[2])
    low, high = w.box[..., None, 0, :], w.box[..., None, 1, :]
    eye = torch.eye(3, dtype=x.dtype, device=x.device)
    distance, which = torch.cat([(x - low)[..., :2], high - x], -1).min(-1)
    inward = torch.cat([eye[:2], -eye])[which]
    if count < distance.shape[-1]:
        with torch.no_grad():
            key = distance + FRAME * (bodies.point_velocity * inward).sum(-1)
            key = key.minimum(distance).masked_fill(~w.valid, torch.inf)
            row = key.topk(count, largest=False).indices
    else:
        row = torch.arange(distance.shape[-1], device=x.device).expand_as(distance)
    height = distance.gather(-1, row).masked_fill(_beyond(row, WALL_FRACTION, w.valid), 10 * NO_CONTACT)
    return _plane_contacts(shape, bodies, row, height, _gather_own(inward, row))


def _beyond(row: Int[Tensor, "*p k"], fraction: float, valid: Bool[Tensor, "b o n"]) -> Bool[Tensor, "b o k"]:
    """Mask of slots beyond an object's own limit; they exist because another object of the batch has more keypoints."""
    return torch.arange(row.shape[-1], device=row.device) >= (fraction * valid.sum(-1, keepdim=True)).ceil()


def _gather_own(x: Float[Tensor, "b o n c"], row: Int[Tensor, "b o k"]) -> Float[Tensor, "b o k c"]:
    """Values at keypoints `row`, counted within each object."""
    return x.gather(2, row[..., None].expand(*row.shape, x.shape[-1]))


def _plane_contacts(
    shape: RestShape, bodies: BodyKinematics, row: Int[Tensor, "b o k"], height: Float[Tensor, "b o k"],
    normal: Float[Tensor, "b o k 3"],
) -> ContactPoints:  # fmt: skip
    """Contacts of keypoints `row` that are `height` [m] above a plane with this normal, and their features.

    Vectors, in this order: plane normal, keypoint normal, velocity of the point, arm (in ARM_UNIT), velocity of the
    body, gravity, and the impulses per mass that (up to sign) stop the point and that give it a unit velocity along
    the plane's normal.
    """
    w = shape.initial
    state = [bodies.point_velocity, bodies.normal, bodies.arm, shape.spacing[..., None], w.valid[..., None]]
    state = _gather_own(torch.cat(state, -1), row)
    ahead = height + FRAME * (state[..., :3] * normal).sum(-1)
    gate = smooth_cutoff(torch.minimum(height, ahead), FULL_CONTACT, NO_CONTACT)
    gate = torch.where(state[..., 10] > 0, gate, 0.0)

    def features(*inputs: Tensor, needed: Tensor | None = None) -> Tensor:
        """Concatenated vectors and scalars."""
        x = PlaneRows(*inputs)
        point_velocity, own_normal, arm, spacing, _ = x.state.split([3, 3, 3, 1, 1], -1)
        K = _impulse_response(x.inverse, arm)
        vectors = torch.cat([
            x.normal, own_normal, point_velocity, arm / ARM_UNIT, x.velocity.expand_as(arm), x.gravity.expand_as(arm),
            *symmetric_solve(K, point_velocity, x.normal),
        ], -1)  # fmt: skip
        return torch.cat([vectors, x.distances, spacing / GAP_UNIT, x.size.expand_as(spacing)], -1)

    of_points = [
        state,
        normal,
        torch.stack([(height / GAP_UNIT).clamp(-2, 2), (ahead / GAP_UNIT).clamp(-2, 2), gate], -1),
    ]
    of_bodies = [bodies.inverse, bodies.velocity, (w.gravity / 5)[:, None], shape.size[..., None].log()]
    inputs = PlaneRows(*(x[:, :, None] for x in of_points), *(x[:, :, None, None] for x in of_bodies))
    gate = gate[:, :, None]
    values = _within_cutoff(at_contacts(gate > 0, features, *inputs), gate)
    return ContactPoints(values[..., :24].unflatten(-1, (8, 3)), values[..., 24:], gate, row[:, :, None])


def _within_cutoff(x: Float[Tensor, "*p c"], gate: Float[Tensor, "*p"]) -> Float[Tensor, "*p c"]:
    """Set features to 0 where the gate is 0, where they may be huge and must not enter the gradient."""
    return torch.where(gate[..., None] > 0, x, 0.0)
