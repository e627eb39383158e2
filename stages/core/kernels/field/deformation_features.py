"""Deformation network for blocks of points: features of the displacements, and the internal accelerations.

Reference: `stages.core.models.field.deformation`. Written in Triton (see `compilers`).
"""

from typing import NamedTuple

import triton
import triton.language as tl

from stages.core.kernels.field.bodies import BODY_SIZE, DU, FIELD_SIZE, ROTATION, VIRIAL, U
from stages.core.kernels.field.layers import (
    MAX_VECTORS,
    PADDED_VECTORS,
    ROWS,
    invariant_layer,
    linear_layer,
    silu,
    weighted_vectors,
)
from stages.core.kernels.field.vec3 import add, load3, read3, read9, scale3, store3, sub, transposed_matvec3

FEATURE_COLUMNS = tl.constexpr(36)  # columns of a point in a record: 12 vectors


class DeformationLayers(NamedTuple):
    """Layers (weight, bias) of the deformation network."""

    input_layer: tuple
    decoder: tuple
    H: tl.constexpr  # hidden width
    PRECISION: tl.constexpr  # input precision of tl.dot


@triton.jit
def _mean(averages, unit, n, mask, KIND: tl.constexpr, WHICH: tl.constexpr):
    """Neighbourhood average at scale WHICH: of contact accelerations (KIND 0), displacements (1) or their rates (2)."""
    s = read3(unit + 3 * KIND)
    x = load3(averages + (3 * KIND * 2 + WHICH) * n, 2 * n, mask)
    return (s[0] * x[0], s[1] * x[1], s[2] * x[2])


@triton.jit
def deformation_features(inputs, drifted, averages, unit, record):
    """Write the feature vectors of a block of points in the body frame: values and differences to neighbourhood means.

    `averages` (b o, 9, 2, n) are the neighbourhood means, at two scales, of the fields that `update_velocities`
    prepares, in units of `unit` (b o, 9).
    """
    i, block, blocks, n = tl.program_id(0), tl.program_id(1), tl.num_programs(1), inputs.n
    r = tl.arange(0, ROWS)
    p = block * ROWS + r
    inside = p < n
    to = record + (i * blocks + block) * FEATURE_COLUMNS * ROWS + r
    at_field = drifted.field + FIELD_SIZE * i * n + p
    u, du = load3(at_field + U * n, n, inside), load3(at_field + DU * n, n, inside)
    store3(to, MAX_VECTORS * ROWS, scale3(20.0, u), inside)
    store3(to + 3 * ROWS, MAX_VECTORS * ROWS, scale3(2.0, du), inside)
    averages, unit = averages + 18 * i * n + p, unit + 9 * i
    for s in tl.static_range(2):
        local_u = scale3(20.0, sub(u, _mean(averages, unit, n, inside, 1, s)))
        local_du = scale3(2.0, sub(du, _mean(averages, unit, n, inside, 2, s)))
        store3(to + (1 + s) * ROWS, MAX_VECTORS * ROWS, local_u, inside)
        store3(to + (4 + s) * ROWS, MAX_VECTORS * ROWS, local_du, inside)
        store3(to + (6 + s) * ROWS, MAX_VECTORS * ROWS, scale3(0.1, _mean(averages, unit, n, inside, 0, s)), inside)
    at = (i * n + p) * 3
    store3(to + 8 * ROWS, MAX_VECTORS * ROWS, scale3(0.1, load3(at_field + VIRIAL * n, n, inside)), inside)
    store3(to + 9 * ROWS, MAX_VECTORS * ROWS, load3(inputs.normal + at, 1, inside), inside)
    store3(
        to + 10 * ROWS,
        MAX_VECTORS * ROWS,
        scale3(1 / tl.load(inputs.size + i), load3(inputs.arm + at, 1, inside)),
        inside,
    )
    R = read9(drifted.body + BODY_SIZE * i + ROTATION)
    gravity_term = transposed_matvec3(R, scale3(0.2, read3(inputs.gravity + 3 * (i // inputs.o))))
    zero = u[0] * 0.0
    store3(to + 11 * ROWS, MAX_VECTORS * ROWS, add(gravity_term, (zero, zero, zero)), inside)


@triton.jit
def internal_accelerations(inputs, record, layers, offset, acceleration, C: tl.constexpr):
    """Compute the internal accelerations [m/s^2] of a block of points.

    They are the sum of springs, dampers and a driving term scaled by compliance. `offset` (b o, o + 2, h) is the
    embeddings' part of the first layers, see `Messages`.
    """
    H: tl.constexpr = layers.H
    i, block, o, n = tl.program_id(0), tl.program_id(1), inputs.o, inputs.n
    p = block * ROWS + tl.arange(0, ROWS)
    record += (i * tl.num_programs(1) + block) * FEATURE_COLUMNS * ROWS
    y = invariant_layer(record, layers.input_layer, MAX_VECTORS, 0, H, layers.PRECISION)
    y = silu(y + tl.load(offset + (i * (o + 2) + o + 1) * H + tl.arange(0, H))[None, :])
    y = silu(linear_layer(y, layers.decoder[0], H, H, H, layers.PRECISION))
    y = linear_layer(y, layers.decoder[1], 9, H, PADDED_VECTORS, layers.PRECISION)
    v = tl.arange(0, PADDED_VECTORS)[None, :]
    driving = tl.load(inputs.compliance_scale + i) * y
    damping = tl.where(v < 6, -C.MAX_DAMPER_WEIGHT * tl.sigmoid(y - 2), driving)
    y = tl.where(v < 3, -C.MAX_SPRING_WEIGHT * tl.sigmoid(y - 3), damping)
    a = weighted_vectors(record, p < n, y, 9)
    store3(acceleration + 3 * i * n + p, n, scale3(10.0, a), p < n)
