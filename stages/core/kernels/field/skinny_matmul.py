"""Large matrices of weights times a few columns. Libraries are slow at it, as one side has too little to share out.

The kernel is written in Triton (see `compilers`), which is imported with this module.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

ROWS, CHUNK = 64, 128
MAX_COLUMNS = 16  # columns


@triton.jit
def _skinny_matmul(A, high, low, out, n, k, c, ROWS: tl.constexpr, CHUNK: tl.constexpr, COLUMNS: tl.constexpr):
    """Of matrices (n, k) and columns (c, k), the sum of two, all in half precision, sums in single; out (c, n)."""
    blocks = tl.cdiv(n, ROWS)
    matrix, block = (tl.program_id(0) // blocks).to(tl.int64), tl.program_id(0) % blocks
    r, col = block * ROWS + tl.arange(0, ROWS), tl.arange(0, COLUMNS)
    total = tl.zeros([ROWS, COLUMNS], tl.float32)
    for first in range(0, k, CHUNK):
        s = first + tl.arange(0, CHUNK)
        a = tl.load(A + matrix * n * k + r[:, None] * k + s[None, :], mask=(r[:, None] < n) & (s[None, :] < k),
                    other=0.0)  # fmt: skip
        at, some = matrix * k * c + s[:, None] + col[None, :] * k, (s[:, None] < k) & (col[None, :] < c)
        total = tl.dot(a, tl.load(high + at, mask=some, other=0.0), total)
        total = tl.dot(a, tl.load(low + at, mask=some, other=0.0), total)
    tl.store(out + matrix * n * c + r[:, None] + col[None, :] * n, total, mask=(r[:, None] < n) & (col[None, :] < c))


@torch.library.custom_op("ngff::thin_product", mutates_args=())
def split_matmul(A: Tensor, high: Tensor, low: Tensor) -> Tensor:
    g, n, k = A.shape
    out = torch.empty(g, high.shape[1], n, dtype=torch.float32, device=A.device)
    blocks = (g * triton.cdiv(n, ROWS),)
    _skinny_matmul[blocks](A, high, low, out, n, k, high.shape[1], ROWS, CHUNK, MAX_COLUMNS, num_stages=4)
    return out


@split_matmul.register_fake
def _(A: Tensor, high: Tensor, low: Tensor) -> Tensor:
    return torch.empty(A.shape[0], high.shape[1], A.shape[1], dtype=torch.float32, device=A.device)


def skinny_matmul(A: Tensor, x: Tensor) -> Tensor:
    """A @ x in single precision for A (..., n, k) in half precision and x (..., k, c) of at most MOST columns c."""
    columns = x.flatten(0, -3).mT
    scale = columns.abs().amax(-1, keepdim=True).clamp_min(1e-30) / 1024
    columns = (columns / scale).contiguous()
    high = columns.half()  # two numbers of half precision hold 22 bits
    out = split_matmul(A.flatten(0, -3).contiguous(), high, (columns - high).half()) * scale
    return out.mT.unflatten(0, A.shape[:-2])
