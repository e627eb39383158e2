"""Small multilayer perceptron over dot products of vectors, fused into one launch: only its output is written.

The kernel is written in Triton (see `compilers`), which is imported with this module.
"""

from collections.abc import Sequence
from typing import Optional

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.nn.functional import linear, silu

from stages.core.kernels.operators import operator

MAX_LAYER_WIDTH = 128  # hidden and output layers: their weights and a block of rows are kept on chip
CHUNK = 64  # input columns read at a time
SMALL_BLOCK_ROWS = 65_536  # up to so many rows use smaller blocks, to occupy all multiprocessors


@triton.jit
def _component(vectors, r, there, i, VECTORS: tl.constexpr):
    """The i-th vector of each row."""
    at = vectors + (r * VECTORS + i) * 3
    return (tl.load(at, mask=there, other=0.0), tl.load(at + 1, mask=there, other=0.0),
            tl.load(at + 2, mask=there, other=0.0))  # fmt: skip


@triton.jit
def _layer(h, weight, bias, INNER: tl.constexpr, OUTER: tl.constexpr, I: tl.constexpr, O: tl.constexpr,
           PRECISION: tl.constexpr):  # fmt: skip
    """SiLU, then a linear layer; I and O are the padded widths."""
    i, o = tl.arange(0, I), tl.arange(0, O)
    h = h * tl.sigmoid(h)
    W = tl.load(weight + o[None, :] * INNER + i[:, None], mask=(i[:, None] < INNER) & (o[None, :] < OUTER), other=0.0)
    b = tl.load(bias + o, mask=o < OUTER, other=0.0)
    return tl.dot(h, W, input_precision=PRECISION) + b[None, :]


@triton.jit
def _perceptron(
    x, vectors, known, near, w0, b0, w1, b1, w2, b2, out, rows, each, VECTORS: tl.constexpr, COLUMNS: tl.constexpr,
    HIDDEN: tl.constexpr, MIDDLE: tl.constexpr, OUTER: tl.constexpr, KNOWN: tl.constexpr, NEAR: tl.constexpr,
    ACTIVE: tl.constexpr, DEEP: tl.constexpr, PRECISION: tl.constexpr, BLOCK: tl.constexpr, K: tl.constexpr,
    H: tl.constexpr, M: tl.constexpr, O: tl.constexpr,
):  # fmt: skip
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    in_range = r < rows
    o, h = tl.arange(0, O), tl.arange(0, H)
    to, store = out + r[:, None] * OUTER + o[None, :], in_range[:, None] & (o[None, :] < OUTER)
    needed = BLOCK
    if NEAR:
        needed = tl.sum(tl.load(near + r, mask=in_range, other=0).to(tl.int32))
    if needed == 0:
        tl.store(to, tl.zeros([BLOCK, O], tl.float32), mask=store)
    else:
        PRODUCTS: tl.constexpr = VECTORS * (VECTORS + 1) // 2
        INNER: tl.constexpr = PRODUCTS + COLUMNS
        y = tl.zeros([BLOCK, H], tl.float32)
        if VECTORS:
            for i in range(VECTORS):  # not unrolled, to limit register use
                ax, ay, az = _component(vectors, r, in_range, i, VECTORS)
                for j in range(i, VECTORS):
                    bx, by, bz = _component(vectors, r, in_range, j, VECTORS)
                    p = ax * bx + ay * by + az * bz
                    size = tl.log(tl.abs(p) + tl.sqrt(p * p + 1))  # asinh(|p|)
                    value = tl.where(p < 0, -size, size)
                    column = i * VECTORS - i * (i - 1) // 2 + j - i
                    y += value[:, None] * tl.load(w0 + h * INNER + column, mask=h < HIDDEN, other=0.0)[None, :]
        for first in range(0, COLUMNS, K):
            k = first + tl.arange(0, K)
            inside = in_range[:, None] & (k[None, :] < COLUMNS)
            part = tl.load(x + r[:, None] * COLUMNS + k[None, :], mask=inside, other=0.0)
            if ACTIVE:
                if KNOWN:
                    part += tl.load(known + (r // each)[:, None] * COLUMNS + k[None, :], mask=inside, other=0.0)
                part = part * tl.sigmoid(part)
            W = tl.load(w0 + h[None, :] * INNER + PRODUCTS + k[:, None],
                        mask=(k[:, None] < COLUMNS) & (h[None, :] < HIDDEN), other=0.0)  # fmt: skip
            y += tl.dot(part, W, input_precision=PRECISION)
        y += tl.load(b0 + h, mask=h < HIDDEN, other=0.0)[None, :]
        if KNOWN and not ACTIVE:
            wide = in_range[:, None] & (h[None, :] < HIDDEN)
            y += tl.load(known + (r // each)[:, None] * HIDDEN + h[None, :], mask=wide, other=0.0)
        if DEEP:
            y = _layer(y, w1, b1, HIDDEN, MIDDLE, H, M, PRECISION)
            y = _layer(y, w2, b2, MIDDLE, OUTER, M, O, PRECISION)
        else:
            y = _layer(y, w1, b1, HIDDEN, OUTER, H, O, PRECISION)
        tl.store(to, y, mask=store)


def _fused_shapes(x, vectors, offset, needed, active, weights, biases):
    return x.new_empty(len(x), weights[-1].shape[0])


@operator("perceptron", _fused_shapes)
def _fused(
    x: Tensor, vectors: Optional[Tensor], offset: Optional[Tensor], needed: Optional[Tensor], active: bool,  # noqa: UP045
    weights: Sequence[Tensor], biases: Sequence[Tensor],
) -> Tensor:  # fmt: skip
    rows, widths = len(x), [w.shape[0] for w in weights]
    out = x.new_empty(rows, widths[-1])
    if not rows:
        return out
    columns = x.shape[1]
    K, H, M, O = (max(16, triton.next_power_of_2(w)) for w in (min(columns, CHUNK), widths[0], widths[-2], widths[-1]))
    precision = "tf32x3" if torch.get_float32_matmul_precision() == "highest" else "tf32"
    block = 32 if rows <= SMALL_BLOCK_ROWS else 64
    layers = [t for pair in zip(weights, biases, strict=True) for t in pair]
    _perceptron[(triton.cdiv(rows, block),)](
        x, vectors, offset, needed, *layers[:4], *layers[-2:], out, rows, 1 if offset is None else rows // len(offset),
        0 if vectors is None else vectors.shape[1], columns, widths[0], widths[-2], widths[-1], offset is not None,
        needed is not None, active, len(weights) == 3, precision, block, K, H, M, O,
    )  # fmt: skip
    return out


def perceptron(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], vectors: Tensor | None = None,
    offset: Tensor | None = None, needed: Tensor | None = None, active: bool = False,
) -> Tensor:  # fmt: skip
    """Apply two or three linear layers with SiLU between them, in single precision, without gradients.

    The input of the first layer is the asinh of all dot products of `vectors` (r, v, 3), then the columns of `x`
    (r, i). Rows come in g groups of equal size; the group's row of `offset` (g, _) is added to the first layer's output
    or, if `active`, to `x`, which is then activated as well. `needed` (r) masks the rows whose result is used: others
    may be 0. With torch.set_float32_matmul_precision("high") products are rounded to TF32.
    """
    x, vectors, offset, needed = (t if t is None else t.contiguous() for t in (x, vectors, offset, needed))
    return _fused(x, vectors, offset, needed, active, list(weights), list(biases))


def perceptron_reference(x, weights, biases, vectors=None, offset=None, needed=None, active: bool = False) -> Tensor:
    """`perceptron` layer by layer, in any precision, for all rows."""
    if vectors is not None:
        i, j = torch.triu_indices(vectors.shape[1], vectors.shape[1], device=x.device)
        x = torch.cat([torch.asinh((vectors @ vectors.mT)[:, i, j]), x], -1)
    offset = 0.0 if offset is None else offset.repeat_interleave(len(x) // len(offset), 0)
    y = linear(silu(x + offset), weights[0], biases[0]) if active else linear(x, weights[0], biases[0]) + offset
    for w, b in zip(weights[1:], biases[1:], strict=True):
        y = linear(silu(y), w, b)
    return y
