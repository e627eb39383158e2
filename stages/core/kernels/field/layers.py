"""Network layers for Triton kernels, applied to blocks of rows, with a rotation-invariant first layer.

The input of a block of ROWS rows is a record with one column of ROWS numbers per component: first x of all MAX_VECTORS
vectors, then y, then z, then the scalars.
"""

import triton
import triton.language as tl

ROWS = tl.constexpr(64)  # rows of a block
MAX_VECTORS = tl.constexpr(12)  # vectors in a record
FIRST_SCALAR = tl.constexpr(36)  # column of the first scalar
PADDED_VECTORS = tl.constexpr(16)  # outputs that weight vectors, padded to a size that tl.dot supports


@triton.jit
def silu(x):
    """SiLU activation."""
    return x * tl.sigmoid(x)


@triton.jit
def matvec(w, x, first, INNER: tl.constexpr, H: tl.constexpr):
    """Product of the columns `first` to `first` + H of a matrix (H, INNER) and x (H)."""
    o, i = tl.arange(0, H), tl.arange(0, H)
    return tl.sum(tl.load(w + o[:, None] * INNER + first + i[None, :]) * x[None, :], 1)


@triton.jit
def linear_layer(x, layer, OUTER: tl.constexpr, H: tl.constexpr, O: tl.constexpr, PRECISION: tl.constexpr):
    """Linear layer (weight, bias) on a block of rows, from H columns to OUTER columns padded to O."""
    w, b = layer
    i, o = tl.arange(0, H), tl.arange(0, O)
    W = tl.load(w + o[None, :] * H + i[:, None], mask=o[None, :] < OUTER, other=0.0)
    return tl.dot(x, W, input_precision=PRECISION) + tl.load(b + o, mask=o < OUTER, other=0.0)[None, :]


@triton.jit
def invariant_layer(
    record, layer, VECTORS: tl.constexpr, SCALARS: tl.constexpr, H: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Linear layer (ROWS, H) on the asinh of all dot products of the first VECTORS vectors, and SCALARS scalars."""
    w, b = layer
    PRODUCTS: tl.constexpr = VECTORS * (VECTORS + 1) // 2
    r, h = tl.arange(0, ROWS), tl.arange(0, H)
    y = tl.zeros([ROWS, H], tl.float32)
    for first in tl.static_range(0, PRODUCTS + SCALARS, 32):
        c = first + tl.arange(0, 32)
        i = tl.zeros([32], tl.int32)
        for v in tl.static_range(1, VECTORS):
            i += (c >= v * VECTORS - v * (v - 1) // 2).to(tl.int32)
        j = c - i * VECTORS + i * (i - 1) // 2 + i
        mask = (c < PRODUCTS)[None, :]
        p = tl.zeros([ROWS, 32], tl.float32)
        for axis in tl.static_range(3):
            at = record + axis * MAX_VECTORS * ROWS + r[:, None]
            p += tl.load(at + i[None, :] * ROWS, mask=mask, other=0.0) * tl.load(at + j[None, :] * ROWS, mask=mask,
                                                                                 other=0.0)  # fmt: skip
        size = tl.log(tl.abs(p) + tl.sqrt(p * p + 1))  # asinh(|p|)
        p = tl.where(p < 0, -size, size)
        if first + 32 > PRODUCTS:
            number = (c >= PRODUCTS) & (c < PRODUCTS + SCALARS)
            at = record + (c + FIRST_SCALAR - PRODUCTS)[None, :] * ROWS + r[:, None]
            p = tl.where(number[None, :], tl.load(at, mask=number[None, :], other=0.0), p)
        at = w + h[None, :] * (PRODUCTS + SCALARS) + c[:, None]
        W = tl.load(at, mask=(c < PRODUCTS + SCALARS)[:, None], other=0.0)
        y += tl.dot(p, W, input_precision=PRECISION)
    return y + tl.load(b + h)[None, :]


@triton.jit
def weighted_vectors(record, there, weights, VECTORS: tl.constexpr):
    """Weighted sum of the first VECTORS vectors of each row, with `weights` (ROWS, PADDED_VECTORS)."""
    r, v = tl.arange(0, ROWS), tl.arange(0, PADDED_VECTORS)
    at, mask = record + v[None, :] * ROWS + r[:, None], (v < VECTORS)[None, :] & there[:, None]
    return (tl.sum(weights * tl.load(at, mask=mask, other=0.0), 1),
            tl.sum(weights * tl.load(at + MAX_VECTORS * ROWS, mask=mask, other=0.0), 1),
            tl.sum(weights * tl.load(at + 2 * MAX_VECTORS * ROWS, mask=mask, other=0.0), 1))  # fmt: skip
