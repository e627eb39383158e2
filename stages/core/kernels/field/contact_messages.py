"""Contact message passing: the networks over the contact points listed by `broad_phase`.

`project_embeddings` maps object embeddings into the first layers, `encode_messages` encodes features as weighted
messages, `aggregate_messages` averages them for each contact and object, `update_contacts` combines both sides of a
contact, and `decode_forces` decodes accelerations, forces and torques.
Reference: `stages.core.models.field.contact_forces`. Written in Triton (see `compilers`).
"""

import triton
import triton.language as tl

from stages.core.kernels.field.bodies import WRENCH_SIZE
from stages.core.kernels.field.broad_phase import other_object
from stages.core.kernels.field.contact_features import COLUMNS, GATE, MASS_FRACTION, contact_list
from stages.core.kernels.field.layers import (
    MAX_VECTORS,
    PADDED_VECTORS,
    invariant_layer,
    linear_layer,
    matvec,
    silu,
    weighted_vectors,
)
from stages.core.kernels.field.vec3 import add, cross, dot, load3, scale3, store3, sub, sum3, write3


@triton.jit
def project_embeddings(
    embedding, own, own_b, partner, partner_b, plane, plane_b, deformation, deformation_b, offset, o, H: tl.constexpr,
):  # fmt: skip
    """Contribution of the object embeddings to the first layer of each contact; in the row after all contacts, to the
    first layer of the deformation network."""
    i, k, m = tl.program_id(0), tl.program_id(1), o - 1
    h = tl.arange(0, H)
    own_embedding = tl.load(embedding + i * H + h)
    if k < m:
        partner_embedding = tl.load(embedding + other_object(i, k, o) * H + h)
        y = (
            matvec(own, own_embedding, 0, H, H)
            + tl.load(own_b + h)
            + matvec(partner, partner_embedding, 0, H, H)
            + tl.load(partner_b + h)
        )
    elif k < m + 2:
        y = matvec(plane, own_embedding, 0, H, H) + tl.load(plane_b + h)
    else:
        y = matvec(deformation, own_embedding, 0, H, H) + tl.load(deformation_b + h)
    tl.store(offset + (i * (o + 2) + k) * H + h, y)


@triton.jit
def _encode(
    record, there, net, offset, message, weight, message_sum, total, VECTORS: tl.constexpr, SCALARS: tl.constexpr,
    ROWS: tl.constexpr, H: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Messages of a block of contact points, their weights, and the weighted sums of both over the block."""
    r, h = tl.arange(0, ROWS), tl.arange(0, H)
    y = invariant_layer(record, r, net[0], net[1], ROWS, VECTORS, SCALARS, H, PRECISION)
    y = silu(y + tl.load(offset + h)[None, :])
    y = silu(linear_layer(y, net[2], net[3], H, H, H, PRECISION))
    attention = tl.sum(y * tl.load(net[4] + H * H + h)[None, :], 1) + tl.load(net[5] + H)
    y = linear_layer(y, net[4], net[5], H, H, H, PRECISION)
    attention = tl.exp(8 * tl.sigmoid(attention / 2) - 4)  # exp(4 tanh(attention / 4))
    gate = tl.load(record + GATE * ROWS + r, mask=there, other=0.0)
    mass_fraction = tl.load(record + MASS_FRACTION * ROWS + r)
    w = tl.where(there, gate * mass_fraction * attention, 0.0)
    tl.store(message + r[:, None] * H + h[None, :], y)
    tl.store(weight + r, w)
    tl.store(message_sum + h, tl.sum(tl.where(there[:, None], w[:, None] * y, 0.0), 0))
    tl.store(total, tl.sum(w))


@triton.jit
def encode_messages(
    record, count, pairs, planes, offset, message, weight, message_sum, total, o, n, wide, narrow, slots,
    ROWS: tl.constexpr, H: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Message and weight of each contact point; weighted sums over each block."""
    i, m, slot = tl.program_id(0), o - 1, tl.program_id(1) * ROWS
    k, start = contact_list(slot, m, n, wide, narrow, slots)
    listed = slot - start + tl.arange(0, ROWS) < tl.load(count + i * (o + 1) + k)
    at, block = i * slots + slot, i * (slots // ROWS) + tl.program_id(1)
    if slot - start < tl.load(count + i * (o + 1) + k):
        if k < m:
            _encode(record + at * COLUMNS, listed, pairs, offset + (i * (o + 2) + k) * H, message + at * H,
                    weight + at, message_sum + block * H, total + block, 10, 7, ROWS, H, PRECISION)  # fmt: skip
        else:
            _encode(record + at * COLUMNS, listed, planes, offset + (i * (o + 2) + k) * H, message + at * H,
                    weight + at, message_sum + block * H, total + block, 8, 5, ROWS, H, PRECISION)  # fmt: skip
    else:
        h = tl.arange(0, H)
        tl.store(message_sum + block * H + h, tl.zeros([H], tl.float32))
        tl.store(total + block, 0.0)


@triton.jit
def aggregate_messages(
    embedding, message_sum, total, net, friction_w, friction_b, mean_message, scale, status, friction, o, n, wide,
    narrow, slots, CONTACT_SATURATION: tl.constexpr, MAX_FRICTION_SPEED: tl.constexpr, ROWS: tl.constexpr,
    BLOCKS: tl.constexpr, H: tl.constexpr,
):  # fmt: skip
    """Mean message of each contact of an object, its status vector from all of them, and the floor's friction [m/s]."""
    i, m = tl.program_id(0), o - 1
    h, block = tl.arange(0, H), tl.arange(0, BLOCKS)
    others, planes, supported = tl.zeros([H], tl.float32), tl.zeros([H], tl.float32), 0.0
    for k in range(o + 1):
        start = tl.where(k > m, slots - narrow, k * wide)
        end = tl.where(k > m, slots, tl.where(k < m, start + wide, slots - narrow))
        first, mask = (i * slots + start) // ROWS, block < (end - start) // ROWS
        messages = tl.load(message_sum + (first + block)[:, None] * H + h[None, :], mask=mask[:, None], other=0.0)
        total_weight = tl.sum(tl.load(total + first + block, mask=mask, other=0.0))
        normaliser = 1 / (total_weight + CONTACT_SATURATION)
        x = normaliser * tl.sum(messages, 0)
        tl.store(mean_message + (i * (o + 1) + k) * H + h, x)
        tl.store(scale + i * (o + 1) + k, normaliser)
        others += tl.where(k < m, x, 0.0)
        planes += tl.where(k < m, 0.0, x)
        supported += tl.where(k == m, total_weight * normaliser, 0.0)
    y = matvec(net[0], tl.load(embedding + i * H + h), 0, 3 * H, H) + matvec(net[0], others, H, 3 * H, H)
    y = silu(y + matvec(net[0], planes, 2 * H, 3 * H, H) + tl.load(net[1] + h))
    y = matvec(net[2], y, 0, H, H) + tl.load(net[3] + h)
    tl.store(status + i * H + h, y)
    ratio = tl.sigmoid(tl.sum(y * tl.load(friction_w + h)) + tl.load(friction_b))
    tl.store(friction + i, MAX_FRICTION_SPEED * ratio * supported)


@triton.jit
def update_contacts(
    mean_message, status, pair_update, plane_update, pairs, pairs_b, planes, planes_b, context, o, H: tl.constexpr,
):  # fmt: skip
    """Second-layer input of a contact's points: from both objects' mean messages of it and their status vectors."""
    i, k, m = tl.program_id(0), tl.program_id(1), o - 1
    h = tl.arange(0, H)
    x, own = tl.load(mean_message + (i * (o + 1) + k) * H + h), tl.load(status + i * H + h)
    if k < m:
        j = other_object(i, k, o)
        other = tl.load(mean_message + (j * (o + 1) + i % o - (i > j)) * H + h)
        y = matvec(pair_update[0], x, 0, 4 * H, H) + matvec(pair_update[0], other, H, 4 * H, H)
        y += matvec(pair_update[0], own, 2 * H, 4 * H, H)
        y += matvec(pair_update[0], tl.load(status + j * H + h), 3 * H, 4 * H, H)
        y = matvec(pair_update[2], silu(y + tl.load(pair_update[1] + h)), 0, H, H) + tl.load(pair_update[3] + h)
        y = matvec(pairs, y, 0, H, H) + tl.load(pairs_b + h)
    else:
        y = matvec(plane_update[0], x, 0, 2 * H, H) + matvec(plane_update[0], own, H, 2 * H, H)
        y = matvec(plane_update[2], silu(y + tl.load(plane_update[1] + h)), 0, H, H) + tl.load(plane_update[3] + h)
        y = matvec(planes, y, 0, H, H) + tl.load(planes_b + h)
    tl.store(context + (i * (o + 1) + k) * H + h, y)


@triton.jit
def _decode(
    record, there, net, context, message, weight, VECTORS: tl.constexpr, ACCELERATION_UNIT: tl.constexpr,
    ROWS: tl.constexpr, H: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Weighted accelerations (3 vectors of ROWS) of a block of contact points."""
    r, h = tl.arange(0, ROWS), tl.arange(0, H)
    x = tl.load(message + r[:, None] * H + h[None, :], mask=there[:, None], other=0.0)
    x = silu(linear_layer(silu(x + tl.load(context + h)[None, :]), net[0], net[1], H, H, H, PRECISION))
    x = linear_layer(x, net[2], net[3], VECTORS, H, PADDED_VECTORS, PRECISION)
    a = weighted_vectors(record, r, there, x, ROWS, VECTORS)
    return scale3(weight * ACCELERATION_UNIT, a)


@triton.jit
def decode_forces(
    record, count, point, pairs, planes, context, message, weight, scale, acceleration, parts, o, n, wide, narrow,
    slots, ACCELERATION_UNIT: tl.constexpr, SEPARATION_SPEED: tl.constexpr, GAP_UNIT: tl.constexpr,
    ARM_UNIT: tl.constexpr, ROWS: tl.constexpr, H: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Decode the acceleration of each contact point [m/s^2], and force and torque of each block into `parts`: per unit
    of mass, for pairs of objects of reduced mass."""
    i, m, slot = tl.program_id(0), o - 1, tl.program_id(1) * ROWS
    k, start = contact_list(slot, m, n, wide, narrow, slots)
    row, to = i * (o + 1) + k, parts + (i * (slots // ROWS) + tl.program_id(1)) * WRENCH_SIZE
    r = tl.arange(0, ROWS)
    listed = slot - start + r < tl.load(count + row)
    if slot - start < tl.load(count + row):
        at = i * slots + slot
        w = tl.load(weight + at + r, mask=listed, other=0.0) * tl.load(scale + row)
        features = record + at * COLUMNS
        if k < m:
            a = _decode(features, listed, pairs, context + row * H, message + at * H, w, 10, ACCELERATION_UNIT, ROWS, H,
                        PRECISION)  # fmt: skip
            offset = load3(features + r, MAX_VECTORS * ROWS, listed)
            arm = load3(features + 4 * ROWS + r, MAX_VECTORS * ROWS, listed)
            arm = sub(scale3(ARM_UNIT, arm), scale3(GAP_UNIT / 2, offset))  # to the midpoint of the two points
        else:
            a = _decode(features, listed, planes, context + row * H, message + at * H, w, 8, ACCELERATION_UNIT, ROWS, H,
                        PRECISION)  # fmt: skip
            inward = load3(features + r, MAX_VECTORS * ROWS, listed)
            arm = scale3(ARM_UNIT, load3(features + 3 * ROWS + r, MAX_VECTORS * ROWS, listed))
            separation_speed = dot(load3(features + 2 * ROWS + r, MAX_VECTORS * ROWS, listed), inward)
            along, unit = dot(a, inward), tl.maximum(w, 1e-9)
            x = along / unit
            push = unit * (tl.maximum(x, 0.0) + tl.log(1 + tl.exp(-tl.abs(x))))  # softplus: floor and walls only push
            push = push / (1 + tl.maximum(separation_speed, 0.0) / SEPARATION_SPEED)
            a = add(a, scale3(push - along, inward))
        own = tl.load(point + at + r, mask=listed, other=0)
        store3(acceleration + row * 3 * n + own, n, a, listed)
        F, T = sum3(a), sum3(cross(arm, a))
        write3(to, F)
        write3(to + 3, T)
    else:
        write3(to, (0.0, 0.0, 0.0))
        write3(to + 3, (0.0, 0.0, 0.0))
