"""Small multilayer perceptron on dot products of vectors, fused into one launch that writes only its output.

The kernel is written in Triton (see `compilers`), which is imported with this module.
"""

from collections.abc import Sequence
from typing import NamedTuple, Optional

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.nn.functional import linear, silu

from stages.core.kernels.operators import operator

MAX_LAYER_WIDTH = 128  # of hidden and output layers, whose weights are kept on chip with a block of rows
CHUNK = 64  # input columns per iteration
SMALL_BLOCK_ROWS = 65_536  # up to this number of rows, blocks are smaller so that all multiprocessors are occupied


class _Rows(NamedTuple):
    """Inputs of the rows, see `perceptron`; all tensors except x may be None."""

    x: Tensor
    vectors: Tensor | None
    offset: Tensor | None
    needed: Tensor | None
    count: int
    each: int  # rows per group


class _Widths(NamedTuple):
    """Sizes of the input and of each layer's output, and the latter padded to powers of two."""

    VECTORS: int  # vectors of the input
    COLUMNS: int  # scalar columns of the input
    HIDDEN: int  # output of the first layer
    MIDDLE: int  # output of the second of three layers
    OUTER: int  # output of the last layer
    K: int  # input columns per iteration
    H: int  # HIDDEN, padded
    M: int  # MIDDLE, padded
    O: int  # OUTER, padded


@triton.jit
def _component(vectors, r, there, i, VECTORS: tl.constexpr):
    """The i-th vector of each row."""
    at = vectors + (r * VECTORS + i) * 3
    return (tl.load(at, mask=there, other=0.0), tl.load(at + 1, mask=there, other=0.0),
            tl.load(at + 2, mask=there, other=0.0))  # fmt: skip


@triton.jit
def _layer(h, layer, INNER: tl.constexpr, OUTER: tl.constexpr, O: tl.constexpr, PRECISION: tl.constexpr):
    """SiLU, then a linear layer from INNER columns (padded in h) to OUTER columns padded to O."""
    weight, bias = layer
    i, o = tl.arange(0, h.shape[1]), tl.arange(0, O)
    h = h * tl.sigmoid(h)
    W = tl.load(weight + o[None, :] * INNER + i[:, None], mask=(i[:, None] < INNER) & (o[None, :] < OUTER), other=0.0)
    b = tl.load(bias + o, mask=o < OUTER, other=0.0)
    return tl.dot(h, W, input_precision=PRECISION) + b[None, :]


@triton.jit
def _first_layer(rows, r, in_range, layer, ACTIVE: tl.constexpr, D: tl.constexpr, PRECISION: tl.constexpr):
    """First layer of a block of rows r, after SiLU if ACTIVE; D is the _Widths."""
    weight, bias = layer
    PRODUCTS: tl.constexpr = D.VECTORS * (D.VECTORS + 1) // 2
    INNER: tl.constexpr = PRODUCTS + D.COLUMNS
    H: tl.constexpr = D.H
    h = tl.arange(0, H)
    y = tl.zeros([r.shape[0], H], tl.float32)
    if D.VECTORS:
        for i in range(D.VECTORS):  # not unrolled, to limit register use
            ax, ay, az = _component(rows.vectors, r, in_range, i, D.VECTORS)
            for j in range(i, D.VECTORS):
                bx, by, bz = _component(rows.vectors, r, in_range, j, D.VECTORS)
                p = ax * bx + ay * by + az * bz
                size = tl.log(tl.abs(p) + tl.sqrt(p * p + 1))  # asinh(|p|)
                value = tl.where(p < 0, -size, size)
                column = i * D.VECTORS - i * (i - 1) // 2 + j - i
                y += value[:, None] * tl.load(weight + h * INNER + column, mask=h < D.HIDDEN, other=0.0)[None, :]
    for first in range(0, D.COLUMNS, D.K):
        k = first + tl.arange(0, D.K)
        inside = in_range[:, None] & (k[None, :] < D.COLUMNS)
        part = tl.load(rows.x + r[:, None] * D.COLUMNS + k[None, :], mask=inside, other=0.0)
        if ACTIVE:
            if rows.offset is not None:
                at = rows.offset + (r // rows.each)[:, None] * D.COLUMNS + k[None, :]
                part += tl.load(at, mask=inside, other=0.0)
            part = part * tl.sigmoid(part)
        W = tl.load(weight + h[None, :] * INNER + PRODUCTS + k[:, None],
                    mask=(k[:, None] < D.COLUMNS) & (h[None, :] < D.HIDDEN), other=0.0)  # fmt: skip
        y += tl.dot(part, W, input_precision=PRECISION)
    y += tl.load(bias + h, mask=h < D.HIDDEN, other=0.0)[None, :]
    if rows.offset is not None and not ACTIVE:
        wide = in_range[:, None] & (h[None, :] < D.HIDDEN)
        y += tl.load(rows.offset + (r // rows.each)[:, None] * D.HIDDEN + h[None, :], mask=wide, other=0.0)
    return y


@triton.jit
def _perceptron(rows, layers, out, ACTIVE: tl.constexpr, D: tl.constexpr, PRECISION: tl.constexpr, BLOCK: tl.constexpr):
    """Apply the layers to BLOCK rows; `layers` (weight, bias) are the first, the second of three or None, the last."""
    r = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    in_range = r < rows.count
    O: tl.constexpr = D.O
    o = tl.arange(0, O)
    to, store = out + r[:, None] * D.OUTER + o[None, :], in_range[:, None] & (o[None, :] < D.OUTER)
    needed = BLOCK
    if rows.needed is not None:
        needed = tl.sum(tl.load(rows.needed + r, mask=in_range, other=0).to(tl.int32))
    if needed == 0:
        tl.store(to, tl.zeros([BLOCK, O], tl.float32), mask=store)
    else:
        y = _first_layer(rows, r, in_range, layers[0], ACTIVE, D, PRECISION)
        if layers[1] is not None:
            y = _layer(y, layers[1], D.HIDDEN, D.MIDDLE, D.M, PRECISION)
            y = _layer(y, layers[2], D.MIDDLE, D.OUTER, D.O, PRECISION)
        else:
            y = _layer(y, layers[2], D.HIDDEN, D.OUTER, D.O, PRECISION)
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
    inputs = _Rows(x, vectors, offset, needed, rows, 1 if offset is None else rows // len(offset))
    numbers = 0 if vectors is None else vectors.shape[1], x.shape[1], widths[0], widths[-2], widths[-1]
    padded = (max(16, triton.next_power_of_2(w)) for w in (min(x.shape[1], CHUNK), widths[0], widths[-2], widths[-1]))
    first, *middle, last = zip(weights, biases, strict=True)
    precision = "tf32x3" if torch.get_float32_matmul_precision() == "highest" else "tf32"
    block = 32 if rows <= SMALL_BLOCK_ROWS else 64
    _perceptron[(triton.cdiv(rows, block),)](
        inputs, (first, middle[0] if middle else None, last), out, active, _Widths(*numbers, *padded), precision, block
    )
    return out


def perceptron(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], vectors: Tensor | None = None,
    offset: Tensor | None = None, needed: Tensor | None = None, active: bool = False,
) -> Tensor:  # fmt: skip
    """Apply two or three linear layers with SiLU between them, in single precision, without gradients.

    The input of the first layer is the asinh of all dot products of `vectors` (r, v, 3), followed by the columns of `x`
    (r, i). Rows form g groups of equal size; the group's row of `offset` (g, _) is added to the first layer's output
    or, if `active`, to `x`, to which SiLU is then applied as well. `needed` (r) masks the rows whose result is used;
    the others may be 0. With torch.set_float32_matmul_precision("high") products are rounded to TF32.
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
