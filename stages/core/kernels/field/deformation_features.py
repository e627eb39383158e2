"""The stress field at blocks of points: what they see of their displacements, and what the network makes of it.

The reference in PyTorch is `stages.core.models.field.deformation.Stress`. Written in Triton (see `compilers`).
"""

import triton
import triton.language as tl

from stages.core.kernels.field.bodies import BODY_SIZE, DU, FIELD_SIZE, ROTATION, VIRIAL, U
from stages.core.kernels.field.layers import (
    MAX_VECTORS,
    PADDED_VECTORS,
    invariant_layer,
    linear_layer,
    silu,
    weighted_vectors,
)
from stages.core.kernels.field.vec3 import add, load3, read3, read9, scale3, store3, sub, transposed_matvec3

FEATURE_COLUMNS = tl.constexpr(36)  # columns of a point: 12 vectors


@triton.jit
def _mean(felt, scale, n, mask, KIND: tl.constexpr, WHICH: tl.constexpr):
    """Averages over a neighbourhood: of the touch (KIND 0), of displacements (1), of their rates (2)."""
    s = read3(scale + 3 * KIND)
    x = load3(felt + (3 * KIND * 2 + WHICH) * n, 2 * n, mask)
    return (s[0] * x[0], s[1] * x[1], s[2] * x[2])


@triton.jit
def deformation_features(
    body, field, felt, scale, arm, normal, size, gravity, record, o, n, blocks, ROWS: tl.constexpr,
):  # fmt: skip
    """Vectors of a block of points, whole and less their averages, in the object's frame."""
    i, block = tl.program_id(0), tl.program_id(1)
    r = tl.arange(0, ROWS)
    p = block * ROWS + r
    inside = p < n
    to = record + (i * blocks + block) * FEATURE_COLUMNS * ROWS + r
    own = field + FIELD_SIZE * i * n + p
    u, du = load3(own + U * n, n, inside), load3(own + DU * n, n, inside)
    store3(to, MAX_VECTORS * ROWS, scale3(20.0, u), inside)
    store3(to + 3 * ROWS, MAX_VECTORS * ROWS, scale3(2.0, du), inside)
    felt, scale = felt + 18 * i * n + p, scale + 9 * i
    for s in tl.static_range(2):
        local_u = scale3(20.0, sub(u, _mean(felt, scale, n, inside, 1, s)))
        local_du = scale3(2.0, sub(du, _mean(felt, scale, n, inside, 2, s)))
        store3(to + (1 + s) * ROWS, MAX_VECTORS * ROWS, local_u, inside)
        store3(to + (4 + s) * ROWS, MAX_VECTORS * ROWS, local_du, inside)
        store3(to + (6 + s) * ROWS, MAX_VECTORS * ROWS, scale3(0.1, _mean(felt, scale, n, inside, 0, s)), inside)
    at = (i * n + p) * 3
    store3(to + 8 * ROWS, MAX_VECTORS * ROWS, scale3(0.1, load3(own + VIRIAL * n, n, inside)), inside)
    store3(to + 9 * ROWS, MAX_VECTORS * ROWS, load3(normal + at, 1, inside), inside)
    store3(to + 10 * ROWS, MAX_VECTORS * ROWS, scale3(1 / tl.load(size + i), load3(arm + at, 1, inside)), inside)
    fall = transposed_matvec3(read9(body + BODY_SIZE * i + ROTATION), scale3(0.2, read3(gravity + 3 * (i // o))))
    zero = u[0] * 0.0
    store3(to + 11 * ROWS, MAX_VECTORS * ROWS, add(fall, (zero, zero, zero)), inside)


@triton.jit
def internal_accelerations(
    record, known, yields, see, say, stress, n, blocks, kinds, HARDEST: tl.constexpr, HEAVIEST: tl.constexpr,
    ROWS: tl.constexpr, H: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Acceleration of a block of points: springs pull back, dampers slow, the rest drives."""
    i, block = tl.program_id(0), tl.program_id(1)
    r, h = tl.arange(0, ROWS), tl.arange(0, H)
    p = block * ROWS + r
    record += (i * blocks + block) * FEATURE_COLUMNS * ROWS
    y = invariant_layer(record, r, see[0], see[1], ROWS, MAX_VECTORS, 0, H, PRECISION)
    y = silu(y + tl.load(known + (i * (kinds + 1) + kinds) * H + h)[None, :])
    y = silu(linear_layer(y, say[0], say[1], H, H, H, PRECISION))
    y = linear_layer(y, say[2], say[3], 9, H, PADDED_VECTORS, PRECISION)
    v = tl.arange(0, PADDED_VECTORS)[None, :]
    drive = tl.load(yields + i) * y
    y = tl.where(v < 3, -HARDEST * tl.sigmoid(y - 3), tl.where(v < 6, -HEAVIEST * tl.sigmoid(y - 2), drive))
    a = weighted_vectors(record, r, p < n, y, ROWS, 9)
    store3(stress + 3 * i * n + p, n, scale3(10.0, a), p < n)
