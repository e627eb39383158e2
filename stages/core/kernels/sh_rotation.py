"""Rotation of the spherical harmonics of many Gaussians, each by its own matrix.

Processes 16 Gaussians at a time on a CPU and one per thread on CUDA. Same method as `geometry.harmonics.rotate_sh`,
with its probe directions and pseudo-inverses. Coefficients with an identity rotation are unchanged, bit for bit.
"""

from __future__ import annotations

from functools import cache

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.harmonics import degree_of, probes
from stages.core.kernels.interop import device_of, kernel_device, launch, view
from stages.core.kernels.simd import LANES, SCALARS, VECTORS, by_device, even_bounds, launch_ranges, num_threads
from stages.core.kernels.splat.harmonics import BASIS

wp.set_module_options({"enable_backward": False})

_ROWS = by_device(
    SCALARS
    + r"""
const long long row = group;
auto gather = [row](const float* p, int stride, int column) { return p[row * stride + column]; };
auto scatter = [row](float* p, int stride, int column, F value) { p[row * stride + column] = value; };
""",
    VECTORS
    + r"""
const long first = 16 * (long)group, left = sh.shape[0] - first;
const int count = left < 16 ? left : 16;
auto gather = [&](const float* p, int stride, int column) {
    F v = (F)(0.0f);
    for (int l = 0; l < count; ++l) v[l] = p[(first + l) * stride + column];
    return v;
};
auto scatter = [&](float* p, int stride, int column, F value) {
    for (int l = 0; l < count; ++l) p[(first + l) * stride + column] = value[l];
};
""",
)

# Evaluates the old colour functions at the probe directions rotated back, and solves for the coefficients of each band.
_ROTATE = r"""
const int k = sh.shape[1], directions = probes.shape[0];
F R[9], given[48], turned[48];
for (int i = 0; i < 9; ++i) R[i] = gather(rotation.data, 9, i);
for (int i = 0; i < 3 * k; ++i) { given[i] = gather(sh.data, 3 * k, i); turned[i] = (F)(0.0f); }
for (int p = 0; p < directions; ++p) {
    const float* d = probes.data + 3 * p;
    F x = R[0] * d[0] + R[3] * d[1] + R[6] * d[2];
    F y = R[1] * d[0] + R[4] * d[1] + R[7] * d[2];
    F h = R[2] * d[0] + R[5] * d[1] + R[8] * d[2];
BASIS
    for (int from = 1, to = 4, width = 5; to <= k; from = to, to += width, width += 2)
        for (int c = 0; c < 3; ++c) {
            F value = (F)(0.0f);
            for (int i = from; i < to; ++i) value += Y[i] * given[3 * i + c];
            for (int i = from; i < to; ++i) turned[3 * i + c] += inverses.data[directions * i + p] * value;
        }
}
I same = R[0] == 1.0f;
for (int i = 1; i < 9; ++i) same &= R[i] == (i % 4 ? 0.0f : 1.0f);
for (int i = 0; i < 3; ++i) scatter(out.data, 3 * k, i, given[i]);
for (int i = 3; i < 3 * k; ++i) scatter(out.data, 3 * k, i, same ? given[i] : turned[i]);
""".replace("BASIS", BASIS)


@wp.func_native(_ROWS + _ROTATE)
def _rotate_group(
    group: int, sh: wp.array3d[float], rotation: wp.array3d[float], probes: wp.array2d[float],
    inverses: wp.array2d[float], out: wp.array3d[float],
): ...  # fmt: skip


@wp.kernel
def _rotate(
    start: int, piece: int, sh: wp.array3d[float], rotation: wp.array3d[float], probes: wp.array2d[float],
    inverses: wp.array2d[float], out: wp.array3d[float],
):  # fmt: skip
    _rotate_group(start + wp.tid(), sh, rotation, probes, inverses, out)


@cache
def _tables(device: str) -> tuple[wp.array, wp.array]:
    """Return the probe directions (d, 3), and the weights (16, d) of the values there for each coefficient."""
    directions, inverses = probes()
    rows = torch.cat([torch.zeros(1, len(directions)), *inverses.values()])
    return tuple(view(x.float().contiguous().to(device)) for x in (directions, rows))


def rotate_each_sh(sh: Float[Tensor, "n k 3"], R: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n k 3"]:
    """Rotate the colour function of each Gaussian by its own R; return the new coefficients."""
    if degree_of(sh.shape[1]) == 0:
        return sh
    where = kernel_device(sh)
    given, turns = (x.detach().float().to(where).contiguous() for x in (sh, R))
    out, device = torch.empty_like(given), device_of(given)
    inputs = [view(given), view(turns), *_tables(device), view(out)]
    if device != "cpu":
        launch(_rotate, len(sh), [0, 0, *inputs], device=device)
    else:
        launch_ranges(_rotate, even_bounds(-(-len(sh) // LANES), num_threads()), inputs)
    return out.to(sh)
