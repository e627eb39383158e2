"""Contact message passing: the networks that act on the contact points listed by `broad_phase`.

`project_embeddings` maps object embeddings into the first layers, `encode_messages` encodes features as weighted
messages, `aggregate_messages` averages the messages of each contact and object, `update_contacts` combines both sides
of a contact, and `decode_forces` decodes accelerations, forces and torques.
Reference: `stages.core.models.field.contact_forces`. Written in Triton (see `compilers`).
"""

from typing import NamedTuple

import triton
import triton.language as tl
from torch import Tensor

from stages.core.kernels.field.bodies import WRENCH_SIZE
from stages.core.kernels.field.broad_phase import other_object
from stages.core.kernels.field.contact_features import COLUMNS, GATE, MASS_FRACTION, contact_list
from stages.core.kernels.field.layers import (
    MAX_VECTORS,
    PADDED_VECTORS,
    ROWS,
    invariant_layer,
    linear_layer,
    matvec,
    silu,
    weighted_vectors,
)
from stages.core.kernels.field.vec3 import add, cross, dot, load3, scale3, store3, sub, sum3, write3


class EmbeddingLayers(NamedTuple):
    """Layers (weight, bias) that map object embeddings into the first layers of the other networks."""

    own: tuple  # for contacts between objects: the object's own embedding
    partner: tuple | None  # for contacts between objects: the other object's embedding
    plane: tuple  # for contacts with floor and walls
    deformation: tuple
    H: tl.constexpr  # hidden width


class ContactEncoder(NamedTuple):
    """Layers (weight, bias) from the features of a contact point to its message, and the numbers of features."""

    input_layer: tuple
    message: tuple
    VECTORS: tl.constexpr
    SCALARS: tl.constexpr


class ContactDecoder(NamedTuple):
    """Layers (weight, bias) from the message of a contact point to the weights of its vectors, and their number."""

    layers: tuple
    VECTORS: tl.constexpr


class EncoderLayers(NamedTuple):
    """Encoders of contacts between objects, and of contacts with floor and walls."""

    pairs: ContactEncoder
    planes: ContactEncoder
    H: tl.constexpr
    PRECISION: tl.constexpr  # input precision of tl.dot


class StatusLayers(NamedTuple):
    """Layers (weight, bias) that compute an object's status vector, and from it the friction of the floor."""

    update: tuple
    friction: tuple
    H: tl.constexpr


class ContextLayers(NamedTuple):
    """Layers (weight, bias) that update and project contacts between objects, and contacts with floor and walls."""

    pair_update: tuple
    pair_projection: tuple
    plane_update: tuple
    plane_projection: tuple
    H: tl.constexpr


class DecoderLayers(NamedTuple):
    """Decoders of contacts between objects, and of contacts with floor and walls."""

    pairs: ContactDecoder
    planes: ContactDecoder
    H: tl.constexpr
    PRECISION: tl.constexpr


class Messages(NamedTuple):
    """Intermediate and final outputs of the contact networks. A block has ROWS contact points."""

    offset: Tensor  # (b o, o + 2, h) embeddings' part of the first layer: for each list, then the deformation network
    message: Tensor  # (b o, slots, h) message of each contact point
    weight: Tensor  # (b o, slots) weight of each message
    block_sum: Tensor  # (b o, blocks, h) weighted sum of the messages of each block
    block_weight: Tensor  # (b o, blocks) sum of the weights of each block
    mean: Tensor  # (b o, o + 1, h) mean message of each list
    scale: Tensor  # (b o, o + 1) normalisation factor of the weights of each list
    status: Tensor  # (b o, h) status vector of each object
    friction: Tensor  # (b o) [m/s] friction threshold speed due to the floor
    context: Tensor  # (b o, o + 1, h) input of the second layer for the points of each list
    wrenches: Tensor  # (b o, blocks, WRENCH_SIZE) force and torque of each block, per unit of (reduced) mass


@triton.jit
def _project(layer, x, H: tl.constexpr):
    """Apply a layer (weight, bias) from H to H columns to one row."""
    return matvec(layer[0], x, 0, H, H) + tl.load(layer[1] + tl.arange(0, H))


@triton.jit
def project_embeddings(embedding, o, layers, offset):
    """Compute the object embeddings' part of the first layer of each contact.

    Writes `offset`, whose last row of each object belongs to the first layer of the deformation network.
    """
    H: tl.constexpr = layers.H
    i, k = tl.program_id(0), tl.program_id(1)
    m, h = o - 1, tl.arange(0, H)
    own = tl.load(embedding + i * H + h)
    if k < m:
        partner = tl.load(embedding + other_object(i, k, o) * H + h)
        y = _project(layers.own, own, H) + _project(layers.partner, partner, H)
    elif k < m + 2:
        y = _project(layers.plane, own, H)
    else:
        y = _project(layers.deformation, own, H)
    tl.store(offset + (i * (o + 2) + k) * H + h, y)


@triton.jit
def _encode(record, there, net, offset, H: tl.constexpr, PRECISION: tl.constexpr):
    """Return the messages of a block of contact points, and their weights."""
    r, h = tl.arange(0, ROWS), tl.arange(0, H)
    y = invariant_layer(record, net.input_layer, net.VECTORS, net.SCALARS, H, PRECISION)
    y = silu(y + tl.load(offset + h)[None, :])
    y = silu(linear_layer(y, net.message[0], H, H, H, PRECISION))
    w, b = net.message[1]
    attention = tl.sum(y * tl.load(w + H * H + h)[None, :], 1) + tl.load(b + H)
    y = linear_layer(y, net.message[1], H, H, H, PRECISION)
    attention = tl.exp(8 * tl.sigmoid(attention / 2) - 4)  # exp(4 tanh(attention / 4))
    gate = tl.load(record + GATE * ROWS + r, mask=there, other=0.0)
    mass_fraction = tl.load(record + MASS_FRACTION * ROWS + r)
    return y, tl.where(there, gate * mass_fraction * attention, 0.0)


@triton.jit
def encode_messages(lists, layers, messages):
    """Compute the message and weight of each contact point, and their weighted sums over each block."""
    H: tl.constexpr = layers.H
    i, o, slots = tl.program_id(0), lists.o, lists.slots
    m, slot = o - 1, tl.program_id(1) * ROWS
    k, start = contact_list(lists, slot, m)
    r, h = tl.arange(0, ROWS), tl.arange(0, H)
    listed = slot - start + r < tl.load(lists.count + i * (o + 1) + k)
    at, block = i * slots + slot, i * (slots // ROWS) + tl.program_id(1)
    if slot - start < tl.load(lists.count + i * (o + 1) + k):
        record, offset = lists.record + at * COLUMNS, messages.offset + (i * (o + 2) + k) * H
        if k < m:
            y, w = _encode(record, listed, layers.pairs, offset, H, layers.PRECISION)
        else:
            y, w = _encode(record, listed, layers.planes, offset, H, layers.PRECISION)
        tl.store(messages.message + (at + r[:, None]) * H + h[None, :], y)
        tl.store(messages.weight + at + r, w)
        tl.store(messages.block_sum + block * H + h, tl.sum(tl.where(listed[:, None], w[:, None] * y, 0.0), 0))
        tl.store(messages.block_weight + block, tl.sum(w))
    else:
        tl.store(messages.block_sum + block * H + h, tl.zeros([H], tl.float32))
        tl.store(messages.block_weight + block, 0.0)


@triton.jit
def aggregate_messages(embedding, lists, layers, messages, C: tl.constexpr):
    """Compute the mean message of each contact of an object, its status vector, and the friction of the floor."""
    H: tl.constexpr = layers.H
    i, o, slots = tl.program_id(0), lists.o, lists.slots
    m, h, block = o - 1, tl.arange(0, H), tl.arange(0, lists.FLOOR_BLOCKS)
    others, planes, supported = tl.zeros([H], tl.float32), tl.zeros([H], tl.float32), 0.0
    for k in range(o + 1):
        start = tl.where(k > m, slots - lists.narrow, k * lists.wide)
        end = tl.where(k > m, slots, tl.where(k < m, start + lists.wide, slots - lists.narrow))
        first, mask = (i * slots + start) // ROWS, block < (end - start) // ROWS
        at = messages.block_sum + (first + block)[:, None] * H + h[None, :]
        total = tl.sum(tl.load(at, mask=mask[:, None], other=0.0), 0)
        total_weight = tl.sum(tl.load(messages.block_weight + first + block, mask=mask, other=0.0))
        normaliser = 1 / (total_weight + C.CONTACT_SATURATION)
        x = normaliser * total
        tl.store(messages.mean + (i * (o + 1) + k) * H + h, x)
        tl.store(messages.scale + i * (o + 1) + k, normaliser)
        others += tl.where(k < m, x, 0.0)
        planes += tl.where(k < m, 0.0, x)
        supported += tl.where(k == m, total_weight * normaliser, 0.0)
    w, b = layers.update[0]
    y = matvec(w, tl.load(embedding + i * H + h), 0, 3 * H, H) + matvec(w, others, H, 3 * H, H)
    y = silu(y + matvec(w, planes, 2 * H, 3 * H, H) + tl.load(b + h))
    y = _project(layers.update[1], y, H)
    tl.store(messages.status + i * H + h, y)
    ratio = tl.sigmoid(tl.sum(y * tl.load(layers.friction[0] + h)) + tl.load(layers.friction[1]))
    tl.store(messages.friction + i, C.MAX_FRICTION_SPEED * ratio * supported)


@triton.jit
def update_contacts(o, layers, messages):
    """Compute the second-layer input `context` of a contact's points.

    It depends on both objects' mean messages of the contact and on their status vectors.
    """
    H: tl.constexpr = layers.H
    i, k = tl.program_id(0), tl.program_id(1)
    m, h = o - 1, tl.arange(0, H)
    x, own = tl.load(messages.mean + (i * (o + 1) + k) * H + h), tl.load(messages.status + i * H + h)
    if k < m:
        j = other_object(i, k, o)
        other = tl.load(messages.mean + (j * (o + 1) + i % o - (i > j)) * H + h)
        w, b = layers.pair_update[0]
        y = matvec(w, x, 0, 4 * H, H) + matvec(w, other, H, 4 * H, H)
        y += matvec(w, own, 2 * H, 4 * H, H)
        y += matvec(w, tl.load(messages.status + j * H + h), 3 * H, 4 * H, H)
        y = _project(layers.pair_update[1], silu(y + tl.load(b + h)), H)
        y = _project(layers.pair_projection, y, H)
    else:
        w, b = layers.plane_update[0]
        y = matvec(w, x, 0, 2 * H, H) + matvec(w, own, H, 2 * H, H)
        y = _project(layers.plane_update[1], silu(y + tl.load(b + h)), H)
        y = _project(layers.plane_projection, y, H)
    tl.store(messages.context + (i * (o + 1) + k) * H + h, y)


@triton.jit
def _decode(record, there, net, x, H: tl.constexpr, PRECISION: tl.constexpr):
    """Return the accelerations of a block of contact points (3 components of ROWS), from second-layer inputs x."""
    x = silu(linear_layer(silu(x), net.layers[0], H, H, H, PRECISION))
    x = linear_layer(x, net.layers[1], net.VECTORS, H, PADDED_VECTORS, PRECISION)
    return weighted_vectors(record, there, x, net.VECTORS)


@triton.jit
def decode_forces(lists, layers, messages, C: tl.constexpr):
    """Decode the acceleration of each contact point, and the force and torque of each block (`wrenches`).

    Values are per unit of mass; for contacts between objects, per unit of reduced mass.
    """
    H: tl.constexpr = layers.H
    i, o, n, slots = tl.program_id(0), lists.o, lists.n, lists.slots
    m, slot = o - 1, tl.program_id(1) * ROWS
    k, start = contact_list(lists, slot, m)
    row, to = i * (o + 1) + k, messages.wrenches + (i * (slots // ROWS) + tl.program_id(1)) * WRENCH_SIZE
    r, h = tl.arange(0, ROWS), tl.arange(0, H)
    listed = slot - start + r < tl.load(lists.count + row)
    if slot - start < tl.load(lists.count + row):
        at = i * slots + slot
        record = lists.record + at * COLUMNS
        w = tl.load(messages.weight + at + r, mask=listed, other=0.0) * tl.load(messages.scale + row)
        x = tl.load(messages.message + (at + r[:, None]) * H + h[None, :], mask=listed[:, None], other=0.0)
        x += tl.load(messages.context + row * H + h)[None, :]
        unit = w * C.ACCELERATION_UNIT
        if k < m:
            a = scale3(unit, _decode(record, listed, layers.pairs, x, H, layers.PRECISION))
            offset = load3(record + r, MAX_VECTORS * ROWS, listed)
            arm = load3(record + 4 * ROWS + r, MAX_VECTORS * ROWS, listed)
            arm = sub(scale3(C.ARM_UNIT, arm), scale3(C.GAP_UNIT / 2, offset))  # to the midpoint of the two points
        else:
            a = scale3(unit, _decode(record, listed, layers.planes, x, H, layers.PRECISION))
            inward = load3(record + r, MAX_VECTORS * ROWS, listed)
            arm = scale3(C.ARM_UNIT, load3(record + 3 * ROWS + r, MAX_VECTORS * ROWS, listed))
            separation_speed = dot(load3(record + 2 * ROWS + r, MAX_VECTORS * ROWS, listed), inward)
            along, weight = dot(a, inward), tl.maximum(w, 1e-9)
            pull = along / weight
            softplus = tl.maximum(pull, 0.0) + tl.log(1 + tl.exp(-tl.abs(pull)))
            push = weight * softplus  # floor and walls never attract
            push = push / (1 + tl.maximum(separation_speed, 0.0) / C.SEPARATION_SPEED)
            a = add(a, scale3(push - along, inward))
        own = tl.load(lists.point + at + r, mask=listed, other=0)
        store3(lists.acceleration + row * 3 * n + own, n, a, listed)
        F, T = sum3(a), sum3(cross(arm, a))
        write3(to, F)
        write3(to + 3, T)
    else:
        write3(to, (0.0, 0.0, 0.0))
        write3(to + 3, (0.0, 0.0, 0.0))
