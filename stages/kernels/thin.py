"""Large matrices of weights times a few columns. Libraries are slow at it, as one side has too little to share out.

The kernel is written in Triton (see `compilers`), which is imported with this module.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

ROWS, CHUNK = 32, 128
MOST = 16  # columns


@triton.jit
def _thin(A, x, out, n, k, c, ROWS: tl.constexpr, CHUNK: tl.constexpr, COLUMNS: tl.constexpr):
    blocks = tl.cdiv(n, ROWS)
    matrix, block = (tl.program_id(0) // blocks).to(tl.int64), tl.program_id(0) % blocks
    r, col = block * ROWS + tl.arange(0, ROWS), tl.arange(0, COLUMNS)
    total = tl.zeros([ROWS, COLUMNS], tl.float32)
    for first in range(0, k, CHUNK):
        s = first + tl.arange(0, CHUNK)
        a = tl.load(A + matrix * n * k + r[:, None] * k + s[None, :], mask=(r[:, None] < n) & (s[None, :] < k),
                    other=0.0).to(tl.float32)  # fmt: skip
        b = tl.load(x + matrix * k * c + s[:, None] * c + col[None, :], mask=(s[:, None] < k) & (col[None, :] < c),
                    other=0.0)  # fmt: skip
        # half precision is exact in tf32, and so are the two parts of x but for its last bits
        high = (b.to(tl.int32, bitcast=True) & -8192).to(tl.float32, bitcast=True)
        total += tl.dot(a, high, input_precision="tf32") + tl.dot(a, b - high, input_precision="tf32")
    tl.store(out + matrix * n * c + r[:, None] * c + col[None, :], total, mask=(r[:, None] < n) & (col[None, :] < c))


@torch.library.custom_op("ngff::thin_product", mutates_args=())
def _product(A: Tensor, x: Tensor) -> Tensor:
    g, n, k = A.shape
    out = x.new_empty(g, n, x.shape[-1])
    _thin[(g * triton.cdiv(n, ROWS),)](A, x, out, n, k, x.shape[-1], ROWS, CHUNK, MOST, num_stages=4)
    return out


@_product.register_fake
def _(A: Tensor, x: Tensor) -> Tensor:
    return x.new_empty(*A.shape[:2], x.shape[-1])


def thin_product(A: Tensor, x: Tensor) -> Tensor:
    """A @ x in single precision for A (..., n, k) in half precision and x (..., k, c) of at most MOST columns c."""
    return _product(A.flatten(0, -3).contiguous(), x.flatten(0, -3).contiguous()).unflatten(0, A.shape[:-2])
