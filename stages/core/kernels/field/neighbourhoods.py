"""Gaussian neighbourhood weights between the points of objects, in half precision.

The kernel is written in Triton (see `compilers`), which is imported with this module.
"""

import torch
import triton
import triton.language as tl
from torch import Tensor

from stages.core.kernels.field.vec3 import dot, load3, sub

ROWS, CHUNK = (
    tl.constexpr(8),
    tl.constexpr(256),
)  # rows of the matrix per program, and columns per iteration


@triton.jit
def _weights(arm, mass_fraction, x, slope, s, n):
    """Weights of points s for points x before normalisation."""
    y = load3(arm + 3 * s, 1, s < n)
    d = sub((x[0][:, None], x[1][:, None], x[2][:, None]), (y[0][None, :], y[1][None, :], y[2][None, :]))
    return tl.exp(slope * dot(d, d)) * tl.load(mass_fraction + s, mask=s < n, other=0.0)[None, :]


@triton.jit
def _neighbourhood_weights(arm, valid, mass_fraction, radii, out, n):
    """Compute rows of the weight matrix of one object and radius in two passes: row sums, then normalised weights."""
    i = tl.program_id(0)
    table = i * tl.num_programs(1) + tl.program_id(1)
    arm, mass_fraction, valid = arm + 3 * i * n, mass_fraction + i * n, valid + i * n
    out += table.to(tl.int64) * n * n
    radius = tl.load(radii + table)
    slope = -1 / (radius * radius)
    r, column = tl.program_id(2) * ROWS + tl.arange(0, ROWS), tl.arange(0, CHUNK)
    x = load3(arm + 3 * r, 1, r < n)
    total = tl.zeros([ROWS, CHUNK], tl.float32)
    for first in range(0, n, CHUNK):
        total += _weights(arm, mass_fraction, x, slope, first + column, n)
    is_valid = tl.load(valid + r, mask=r < n, other=0) != 0
    unit = tl.where(is_valid, 1 / tl.maximum(tl.sum(total, 1), 1e-12), 0.0)
    for first in range(0, n, CHUNK):
        s = first + column
        weight = _weights(arm, mass_fraction, x, slope, s, n) * unit[:, None]
        inside = (r[:, None] < n) & (s[None, :] < n)
        tl.store(out + r[:, None] * n + s[None, :], weight.to(tl.float16), mask=inside)


def neighbourhood_weights(arm: Tensor, valid: Tensor, mass_fraction: Tensor, radii: Tensor) -> Tensor:
    """Return Gaussian weights exp(-(d / radius)^2) x mass fraction between points: (b o s n n), rows sum to 1.

    `arm` (b o n 3) are the points [m]; rows where `valid` (b o n) is false are 0; `mass_fraction` is (b o n), `radii`
    (b o s) [m].
    """
    b, o, n, _ = arm.shape
    inputs = [x.contiguous() for x in (arm, valid, mass_fraction, radii)]
    scales = radii.shape[-1]
    out = torch.empty(b, o, scales, n, n, dtype=torch.float16, device=arm.device)
    _neighbourhood_weights[(b * o, scales, triton.cdiv(n, ROWS.value))](*inputs, out, n)
    return out
