"""What places of contact say, hear and answer: the networks of touch, for lists of places (see `meeting`, `places`).

`listen` turns what places see into messages, `hear` and `explain` into what each object knows of its contacts, and
`answer` into forces. The reference in PyTorch is `stages.core.models.field.contact_forces`. Written in Triton.
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
    code, own, own_b, other, other_b, plane, plane_b, stress, stress_b, known, o, H: tl.constexpr,
):  # fmt: skip
    """What is known of the two before they touch; in the row after those of all contacts, for the stress field."""
    i, k, m = tl.program_id(0), tl.program_id(1), o - 1
    h = tl.arange(0, H)
    mine = tl.load(code + i * H + h)
    if k < m:
        their = tl.load(code + other_object(i, k, o) * H + h)
        y = matvec(own, mine, 0, H, H) + tl.load(own_b + h) + matvec(other, their, 0, H, H) + tl.load(other_b + h)
    elif k < m + 2:
        y = matvec(plane, mine, 0, H, H) + tl.load(plane_b + h)
    else:
        y = matvec(stress, mine, 0, H, H) + tl.load(stress_b + h)
    tl.store(known + (i * (o + 2) + k) * H + h, y)


@triton.jit
def _heard(
    record, there, net, known, message, weight, heard, total, VECTORS: tl.constexpr, MORE: tl.constexpr,
    ROWS: tl.constexpr, H: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    r, h = tl.arange(0, ROWS), tl.arange(0, H)
    y = invariant_layer(record, r, net[0], net[1], ROWS, VECTORS, MORE, H, PRECISION)
    y = silu(y + tl.load(known + h)[None, :])
    y = silu(linear_layer(y, net[2], net[3], H, H, H, PRECISION))
    loud = tl.sum(y * tl.load(net[4] + H * H + h)[None, :], 1) + tl.load(net[5] + H)
    y = linear_layer(y, net[4], net[5], H, H, H, PRECISION)
    loud = tl.exp(8 * tl.sigmoid(loud / 2) - 4)  # exp(4 tanh(loud / 4))
    gate, share = tl.load(record + GATE * ROWS + r, mask=there, other=0.0), tl.load(record + MASS_FRACTION * ROWS + r)
    w = tl.where(there, gate * share * loud, 0.0)
    tl.store(message + r[:, None] * H + h[None, :], y)
    tl.store(weight + r, w)
    tl.store(heard + h, tl.sum(tl.where(there[:, None], w[:, None] * y, 0.0), 0))
    tl.store(total, tl.sum(w))


@triton.jit
def encode_messages(
    record, count, pairs, planes, known, message, weight, heard, total, o, n, wide, narrow, slots, ROWS: tl.constexpr,
    H: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """What each place says and how much it weighs; sums of both over a block."""
    i, m, slot = tl.program_id(0), o - 1, tl.program_id(1) * ROWS
    k, start = contact_list(slot, m, n, wide, narrow, slots)
    there = slot - start + tl.arange(0, ROWS) < tl.load(count + i * (o + 1) + k)
    at, block = i * slots + slot, i * (slots // ROWS) + tl.program_id(1)
    if slot - start < tl.load(count + i * (o + 1) + k):
        if k < m:
            _heard(record + at * COLUMNS, there, pairs, known + (i * (o + 2) + k) * H, message + at * H, weight + at,
                   heard + block * H, total + block, 10, 7, ROWS, H, PRECISION)  # fmt: skip
        else:
            _heard(record + at * COLUMNS, there, planes, known + (i * (o + 2) + k) * H, message + at * H, weight + at,
                   heard + block * H, total + block, 8, 5, ROWS, H, PRECISION)  # fmt: skip
    else:
        h = tl.arange(0, H)
        tl.store(heard + block * H + h, tl.zeros([H], tl.float32))
        tl.store(total + block, 0.0)


@triton.jit
def aggregate_messages(
    code, heard, total, net, hold, hold_b, listened, scale, status, grip, o, n, wide, narrow, slots,
    GRIP: tl.constexpr, HOLD: tl.constexpr, ROWS: tl.constexpr, BLOCKS: tl.constexpr, H: tl.constexpr,
):  # fmt: skip
    """What an object hears from each of its contacts, from all, and what it makes of that; how the floor holds it."""
    i, m = tl.program_id(0), o - 1
    h, block = tl.arange(0, H), tl.arange(0, BLOCKS)
    others, planes, held = tl.zeros([H], tl.float32), tl.zeros([H], tl.float32), 0.0
    for k in range(o + 1):
        start = tl.where(k > m, slots - narrow, k * wide)
        end = tl.where(k > m, slots, tl.where(k < m, start + wide, slots - narrow))
        first, some = (i * slots + start) // ROWS, block < (end - start) // ROWS
        said = tl.load(heard + (first + block)[:, None] * H + h[None, :], mask=some[:, None], other=0.0)
        sure = tl.sum(tl.load(total + first + block, mask=some, other=0.0))
        one = 1 / (sure + GRIP)
        x = one * tl.sum(said, 0)
        tl.store(listened + (i * (o + 1) + k) * H + h, x)
        tl.store(scale + i * (o + 1) + k, one)
        others += tl.where(k < m, x, 0.0)
        planes += tl.where(k < m, 0.0, x)
        held += tl.where(k == m, sure * one, 0.0)
    y = matvec(net[0], tl.load(code + i * H + h), 0, 3 * H, H) + matvec(net[0], others, H, 3 * H, H)
    y = silu(y + matvec(net[0], planes, 2 * H, 3 * H, H) + tl.load(net[1] + h))
    y = matvec(net[2], y, 0, H, H) + tl.load(net[3] + h)
    tl.store(status + i * H + h, y)
    tl.store(grip + i, HOLD * tl.sigmoid(tl.sum(y * tl.load(hold + h)) + tl.load(hold_b)) * held)


@triton.jit
def update_contacts(listened, status, between, against, pairs, pairs_b, planes, planes_b, told, o, H: tl.constexpr):
    """What the places of a contact are told: what both objects hear from it, and how they are."""
    i, k, m = tl.program_id(0), tl.program_id(1), o - 1
    h = tl.arange(0, H)
    x, own = tl.load(listened + (i * (o + 1) + k) * H + h), tl.load(status + i * H + h)
    if k < m:
        j = other_object(i, k, o)
        other = tl.load(listened + (j * (o + 1) + i % o - (i > j)) * H + h)
        y = matvec(between[0], x, 0, 4 * H, H) + matvec(between[0], other, H, 4 * H, H)
        y += matvec(between[0], own, 2 * H, 4 * H, H)
        y += matvec(between[0], tl.load(status + j * H + h), 3 * H, 4 * H, H)
        y = matvec(between[2], silu(y + tl.load(between[1] + h)), 0, H, H) + tl.load(between[3] + h)
        y = matvec(pairs, y, 0, H, H) + tl.load(pairs_b + h)
    else:
        y = matvec(against[0], x, 0, 2 * H, H) + matvec(against[0], own, H, 2 * H, H)
        y = matvec(against[2], silu(y + tl.load(against[1] + h)), 0, H, H) + tl.load(against[3] + h)
        y = matvec(planes, y, 0, H, H) + tl.load(planes_b + h)
    tl.store(told + (i * (o + 1) + k) * H + h, y)


@triton.jit
def _said(
    record, there, net, told, message, weight, VECTORS: tl.constexpr, STRENGTH: tl.constexpr, ROWS: tl.constexpr,
    H: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Weighted accelerations of a block of places."""
    r, h = tl.arange(0, ROWS), tl.arange(0, H)
    x = tl.load(message + r[:, None] * H + h[None, :], mask=there[:, None], other=0.0)
    x = silu(linear_layer(silu(x + tl.load(told + h)[None, :]), net[0], net[1], H, H, H, PRECISION))
    x = linear_layer(x, net[2], net[3], VECTORS, H, PADDED_VECTORS, PRECISION)
    a = weighted_vectors(record, r, there, x, ROWS, VECTORS)
    return scale3(weight * STRENGTH, a)


@triton.jit
def decode_forces(
    record, count, point, pairs, planes, told, message, weight, scale, felt, parts, o, n, wide, narrow, slots,
    STRENGTH: tl.constexpr, LEAVING: tl.constexpr, CLOSE: tl.constexpr, LEVER: tl.constexpr, ROWS: tl.constexpr,
    H: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Acceleration by each place at its point; force and torque of a block, for contacts of pairs for unit mass."""
    i, m, slot = tl.program_id(0), o - 1, tl.program_id(1) * ROWS
    k, start = contact_list(slot, m, n, wide, narrow, slots)
    row, to = i * (o + 1) + k, parts + (i * (slots // ROWS) + tl.program_id(1)) * WRENCH_SIZE
    r = tl.arange(0, ROWS)
    there = slot - start + r < tl.load(count + row)
    if slot - start < tl.load(count + row):
        at = i * slots + slot
        w = tl.load(weight + at + r, mask=there, other=0.0) * tl.load(scale + row)
        seen_by = record + at * COLUMNS
        if k < m:
            a = _said(seen_by, there, pairs, told + row * H, message + at * H, w, 10, STRENGTH, ROWS, H, PRECISION)
            way = load3(seen_by + r, MAX_VECTORS * ROWS, there)
            arm = load3(seen_by + 4 * ROWS + r, MAX_VECTORS * ROWS, there)
            arm = sub(scale3(LEVER, arm), scale3(CLOSE / 2, way))  # both bodies are pushed amid their points
        else:
            a = _said(seen_by, there, planes, told + row * H, message + at * H, w, 8, STRENGTH, ROWS, H, PRECISION)
            inward = load3(seen_by + r, MAX_VECTORS * ROWS, there)
            arm = scale3(LEVER, load3(seen_by + 3 * ROWS + r, MAX_VECTORS * ROWS, there))
            leaving = dot(load3(seen_by + 2 * ROWS + r, MAX_VECTORS * ROWS, there), inward)
            along, unit = dot(a, inward), tl.maximum(w, 1e-9)
            x = along / unit
            push = unit * (tl.maximum(x, 0.0) + tl.log(1 + tl.exp(-tl.abs(x))))  # floor and walls do not pull
            push = push / (1 + tl.maximum(leaving, 0.0) / LEAVING)
            a = add(a, scale3(push - along, inward))
        mine = tl.load(point + at + r, mask=there, other=0)
        store3(felt + row * 3 * n + mine, n, a, there)
        F, T = sum3(a), sum3(cross(arm, a))
        write3(to, F)
        write3(to + 3, T)
    else:
        write3(to, (0.0, 0.0, 0.0))
        write3(to + 3, (0.0, 0.0, 0.0))
