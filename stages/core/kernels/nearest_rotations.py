"""Rotations nearest to many matrices, one thread per matrix, without a singular value decomposition.

The rotation R(q) that maximises tr(R^T M) belongs to the unit quaternion q that maximises q^T N q, where the symmetric
4 x 4 matrix N is linear in M. So q is the eigenvector of N with the largest eigenvalue, which Jacobi's method finds in
double precision.
Source: Horn 1987, "Closed-form solution of absolute orientation using unit quaternions".
"""

from __future__ import annotations

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from stages.core.kernels.interop import device_of, kernel_device, launch, view
from stages.core.kernels.simd import even_bounds, launch_ranges, num_threads

wp.set_module_options({"enable_backward": False})

SWEEPS = 10  # maximum number of Jacobi sweeps; convergence is quadratic


@wp.func
def _rotate(A: wp.mat44d, c: wp.float64, s: wp.float64, p: int, q: int, columns: bool) -> wp.mat44d:
    """Rotate rows or columns p and q of A in their plane, by the angle with cosine c and sine s."""
    for k in range(4):
        if columns:
            x, y = A[k, p], A[k, q]
            A[k, p] = c * x - s * y
            A[k, q] = s * x + c * y
        else:
            x, y = A[p, k], A[q, k]
            A[p, k] = c * x - s * y
            A[q, k] = s * x + c * y
    return A


@wp.kernel
def _nearest(start: int, piece: int, matrices: wp.array[wp.mat33d], out: wp.array[wp.mat33d]):
    i = start + wp.tid()
    M = matrices[i]
    one, two = wp.float64(1.0), wp.float64(2.0)
    x, y, z = M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]
    xy, yz, zx = M[0, 1] + M[1, 0], M[1, 2] + M[2, 1], M[2, 0] + M[0, 2]
    a, b, d = M[0, 0], M[1, 1], M[2, 2]
    N = wp.mat44d(a + b + d, x, y, z, x, a - b - d, xy, zx, y, xy, b - a - d, yz, z, zx, yz, d - a - b)
    V = wp.identity(n=4, dtype=wp.float64)
    scale = wp.ddot(N, N)
    for _ in range(SWEEPS):
        off = wp.float64(0.0)
        for p in range(3):
            for q in range(p + 1, 4):
                off += N[p, q] * N[p, q]
        if off <= wp.float64(1.0e-30) * scale:
            break
        for p in range(3):
            for q in range(p + 1, 4):
                if N[p, q] != wp.float64(0.0):
                    theta = (N[q, q] - N[p, p]) / (two * N[p, q])
                    t = one / (wp.abs(theta) + wp.sqrt(one + theta * theta))
                    if theta < wp.float64(0.0):
                        t = -t
                    c = one / wp.sqrt(one + t * t)
                    N = _rotate(N, c, t * c, p, q, True)
                    N = _rotate(N, c, t * c, p, q, False)
                    V = _rotate(V, c, t * c, p, q, True)
    best = wp.int32(0)
    for k in range(1, 4):
        if N[k, k] > N[best, best]:
            best = k
    out[i] = wp.quat_to_matrix(wp.normalize(wp.quatd(V[1, best], V[2, best], V[3, best], V[0, best])))


def nearest_rotations(matrices: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """Return the rotation nearest to each matrix in the Frobenius norm, without gradients.

    Equivalent to `geometry.rotations.nearest_rotation`. Where several rotations are equally near, as for the zero
    matrix, one of them.
    """
    where = kernel_device(matrices)
    if where != matrices.device:
        return nearest_rotations(matrices.to(where)).to(matrices.device)
    doubles = matrices.double().contiguous()
    out = torch.empty_like(doubles)
    inputs = [view(doubles, wp.mat33d), view(out, wp.mat33d)]
    if matrices.is_cuda:
        launch(_nearest, len(doubles), [0, 0, *inputs], device=device_of(doubles))
    else:
        launch_ranges(_nearest, even_bounds(len(doubles), num_threads()), inputs)
    return out.to(matrices)
