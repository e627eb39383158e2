"""Products of large half-precision matrices with a few columns, a shape for which BLAS libraries are slow.

The kernel is written in Triton (see `compilers`), which is imported with this module.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from stages.core.kernels.operators import operator

ROWS, CHUNK = tl.constexpr(64), tl.constexpr(128)  # rows per program, and part of the inner dimension per iteration
COLUMNS = tl.constexpr(16)  # number of columns c, padded


@triton.jit
def _skinny_matmul(A, columns, out, n, k, c):
    """Multiply matrices (n, k) by columns, given as a high and a low part (c, k) each; `out` is (c, n).

    Inputs are in half precision, sums in single precision.
    """
    high, low = columns
    blocks = tl.cdiv(n, ROWS)
    matrix, block = (tl.program_id(0) // blocks).to(tl.int64), tl.program_id(0) % blocks
    r, col = block * ROWS + tl.arange(0, ROWS), tl.arange(0, COLUMNS)
    total = tl.zeros([ROWS, COLUMNS], tl.float32)
    for first in range(0, k, CHUNK):
        s = first + tl.arange(0, CHUNK)
        a = tl.load(A + matrix * n * k + r[:, None] * k + s[None, :], mask=(r[:, None] < n) & (s[None, :] < k),
                    other=0.0)  # fmt: skip
        at, mask = matrix * k * c + s[:, None] + col[None, :] * k, (s[:, None] < k) & (col[None, :] < c)
        total = tl.dot(a, tl.load(high + at, mask=mask, other=0.0), total)
        total = tl.dot(a, tl.load(low + at, mask=mask, other=0.0), total)
    tl.store(out + matrix * n * c + r[:, None] + col[None, :] * n, total, mask=(r[:, None] < n) & (col[None, :] < c))


def _split_matmul_shapes(A: Tensor, high: Tensor, low: Tensor) -> Tensor:
    return torch.empty(A.shape[0], high.shape[1], A.shape[1], dtype=torch.float32, device=A.device)


@operator("skinny_matmul", _split_matmul_shapes)
def split_matmul(A: Tensor, high: Tensor, low: Tensor) -> Tensor:
    """Return A (g, n, k) times the columns high + low (g, c, k): (g, c, n) in single precision.

    All inputs are in half precision.
    """
    g, n, k = A.shape
    out = torch.empty(g, high.shape[1], n, dtype=torch.float32, device=A.device)
    blocks = (g * triton.cdiv(n, ROWS.value),)
    _skinny_matmul[blocks](A, (high, low), out, n, k, high.shape[1], num_stages=4)
    return out


def skinny_matmul(A: Tensor, x: Tensor) -> Tensor:
    """Return A @ x in single precision, for A (..., n, k) in half precision and x (..., k, c) with c <= COLUMNS."""
    columns = x.flatten(0, -3).mT
    scale = columns.abs().amax(-1, keepdim=True).clamp_min(1e-30) / 1024
    columns = (columns / scale).contiguous()
    high = columns.half()  # the sum of two half-precision numbers, high + low, has 22 bits
    out = split_matmul(A.flatten(0, -3).contiguous(), high, (columns - high).half()) * scale
    return out.mT.unflatten(0, A.shape[:-2])
