"""The stress field at blocks of points: what they see of their displacements, and what the network makes of it.

The reference in PyTorch is `stages.core.models.field.deformation.Stress`. Written in Triton (see `compilers`).
"""

import triton
import triton.language as tl

from stages.core.kernels.field.bodies import BODY, DU, FIELD, SPREAD, TURN, U
from stages.core.kernels.field.layers import MOST, WIDE, layer, seen, silu, weighed
from stages.core.kernels.field.vec3 import add, back, load3, row3, row9, scaled, store3, sub

SEEN = tl.constexpr(36)  # columns of a point: 12 vectors


@triton.jit
def _mean(felt, scale, n, mask, KIND: tl.constexpr, WHICH: tl.constexpr):
    """Averages over a neighbourhood: of the touch (KIND 0), of displacements (1), of their rates (2)."""
    s = row3(scale + 3 * KIND)
    x = load3(felt + (3 * KIND * 2 + WHICH) * n, 2 * n, mask)
    return (s[0] * x[0], s[1] * x[1], s[2] * x[2])


@triton.jit
def watch(
    body, field, felt, scale, arm, normal, size, gravity, record, o, n, blocks, ROWS: tl.constexpr,
):  # fmt: skip
    """Vectors of a block of points, whole and less their averages, in the object's frame."""
    i, block = tl.program_id(0), tl.program_id(1)
    r = tl.arange(0, ROWS)
    p = block * ROWS + r
    inside = p < n
    to = record + (i * blocks + block) * SEEN * ROWS + r
    own = field + FIELD * i * n + p
    u, du = load3(own + U * n, n, inside), load3(own + DU * n, n, inside)
    store3(to, WIDE * ROWS, scaled(20.0, u), inside)
    store3(to + 3 * ROWS, WIDE * ROWS, scaled(2.0, du), inside)
    felt, scale = felt + 18 * i * n + p, scale + 9 * i
    for s in tl.static_range(2):
        store3(to + (1 + s) * ROWS, WIDE * ROWS, scaled(20.0, sub(u, _mean(felt, scale, n, inside, 1, s))), inside)
        store3(to + (4 + s) * ROWS, WIDE * ROWS, scaled(2.0, sub(du, _mean(felt, scale, n, inside, 2, s))), inside)
        store3(to + (6 + s) * ROWS, WIDE * ROWS, scaled(0.1, _mean(felt, scale, n, inside, 0, s)), inside)
    at = (i * n + p) * 3
    store3(to + 8 * ROWS, WIDE * ROWS, scaled(0.1, load3(own + SPREAD * n, n, inside)), inside)
    store3(to + 9 * ROWS, WIDE * ROWS, load3(normal + at, 1, inside), inside)
    store3(to + 10 * ROWS, WIDE * ROWS, scaled(1 / tl.load(size + i), load3(arm + at, 1, inside)), inside)
    fall = back(row9(body + BODY * i + TURN), scaled(0.2, row3(gravity + 3 * (i // o))))
    zero = u[0] * 0.0
    store3(to + 11 * ROWS, WIDE * ROWS, add(fall, (zero, zero, zero)), inside)


@triton.jit
def strain(
    record, known, yields, see, say, stress, n, blocks, kinds, HARDEST: tl.constexpr, HEAVIEST: tl.constexpr,
    ROWS: tl.constexpr, H: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Acceleration of a block of points: springs pull back, dampers slow, the rest drives."""
    i, block = tl.program_id(0), tl.program_id(1)
    r, h = tl.arange(0, ROWS), tl.arange(0, H)
    p = block * ROWS + r
    record += (i * blocks + block) * SEEN * ROWS
    y = seen(record, r, see[0], see[1], ROWS, WIDE, 0, H, PRECISION)
    y = silu(y + tl.load(known + (i * (kinds + 1) + kinds) * H + h)[None, :])
    y = silu(layer(y, say[0], say[1], H, H, H, PRECISION))
    y = layer(y, say[2], say[3], 9, H, MOST, PRECISION)
    v = tl.arange(0, MOST)[None, :]
    drive = tl.load(yields + i) * y
    y = tl.where(v < 3, -HARDEST * tl.sigmoid(y - 3), tl.where(v < 6, -HEAVIEST * tl.sigmoid(y - 2), drive))
    a = weighed(record, r, p < n, y, ROWS, 9)
    store3(stress + 3 * i * n + p, n, scaled(10.0, a), p < n)
