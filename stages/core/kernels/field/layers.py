"""Small networks in Triton's kernels: layers for blocks of rows, and their first layer over products of vectors.

A block of rows shows its vectors in a record: a column of ROWS numbers for each component, x of all vectors first, then
y and z, then scalars.
"""

import triton
import triton.language as tl

MAX_VECTORS = tl.constexpr(12)  # vectors that a record has room for
FIRST_SCALAR = tl.constexpr(36)
PADDED_VECTORS = tl.constexpr(16)  # vectors that are weighed, padded


@triton.jit
def silu(x):
    return x * tl.sigmoid(x)


@triton.jit
def matvec(w, x, first, INNER: tl.constexpr, H: tl.constexpr):
    """Some columns of a matrix (H outer, INNER) times x."""
    o, i = tl.arange(0, H), tl.arange(0, H)
    return tl.sum(tl.load(w + o[:, None] * INNER + first + i[None, :]) * x[None, :], 1)


@triton.jit
def linear_layer(x, w, b, OUTER: tl.constexpr, H: tl.constexpr, O: tl.constexpr, PRECISION: tl.constexpr):
    """A linear layer from H columns to OUTER, padded to O."""
    i, o = tl.arange(0, H), tl.arange(0, O)
    W = tl.load(w + o[None, :] * H + i[:, None], mask=o[None, :] < OUTER, other=0.0)
    return tl.dot(x, W, input_precision=PRECISION) + tl.load(b + o, mask=o < OUTER, other=0.0)[None, :]


@triton.jit
def invariant_layer(record, r, w, b, ROWS: tl.constexpr, VECTORS: tl.constexpr, MORE: tl.constexpr, H: tl.constexpr,
         PRECISION: tl.constexpr):  # fmt: skip
    """The first layer over products of vectors, compressed, and scalars."""
    PRODUCTS: tl.constexpr = VECTORS * (VECTORS + 1) // 2
    h = tl.arange(0, H)
    y = tl.zeros([ROWS, H], tl.float32)
    for first in tl.static_range(0, PRODUCTS + MORE, 32):
        c = first + tl.arange(0, 32)
        i = tl.zeros([32], tl.int32)
        for v in tl.static_range(1, VECTORS):
            i += (c >= v * VECTORS - v * (v - 1) // 2).to(tl.int32)
        j = c - i * VECTORS + i * (i - 1) // 2 + i
        some = (c < PRODUCTS)[None, :]
        p = tl.zeros([ROWS, 32], tl.float32)
        for axis in tl.static_range(3):
            at = record + axis * MAX_VECTORS * ROWS + r[:, None]
            p += tl.load(at + i[None, :] * ROWS, mask=some, other=0.0) * tl.load(at + j[None, :] * ROWS, mask=some,
                                                                                 other=0.0)  # fmt: skip
        size = tl.log(tl.abs(p) + tl.sqrt(p * p + 1))  # asinh, but for the sign
        p = tl.where(p < 0, -size, size)
        if first + 32 > PRODUCTS:
            number = (c >= PRODUCTS) & (c < PRODUCTS + MORE)
            at = record + (c + FIRST_SCALAR - PRODUCTS)[None, :] * ROWS + r[:, None]
            p = tl.where(number[None, :], tl.load(at, mask=number[None, :], other=0.0), p)
        W = tl.load(w + h[None, :] * (PRODUCTS + MORE) + c[:, None], mask=(c < PRODUCTS + MORE)[:, None], other=0.0)
        y += tl.dot(p, W, input_precision=PRECISION)
    return y + tl.load(b + h)[None, :]


@triton.jit
def weighted_vectors(record, r, there, weights, ROWS: tl.constexpr, VECTORS: tl.constexpr):
    """The weighted sum of the first vectors."""
    v = tl.arange(0, PADDED_VECTORS)
    at, some = record + v[None, :] * ROWS + r[:, None], (v < VECTORS)[None, :] & there[:, None]
    return (tl.sum(weights * tl.load(at, mask=some, other=0.0), 1),
            tl.sum(weights * tl.load(at + MAX_VECTORS * ROWS, mask=some, other=0.0), 1),
            tl.sum(weights * tl.load(at + 2 * MAX_VECTORS * ROWS, mask=some, other=0.0), 1))  # fmt: skip
