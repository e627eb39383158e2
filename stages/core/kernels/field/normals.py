"""Surface normals of point clouds and inverses of inertia tensors, from the eigenvectors of many 3 x 3 matrices.

Unlike the batched eigensolvers of libraries, these Warp kernels do not synchronise with the host. Distances have the
precision of the points; everything else is in double precision.
"""

from typing import Any

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import device_of, launch, view

NORMAL_NEIGHBOURS = wp.constant(12)  # points to which a normal is fitted, including the point itself
SPACING_NEIGHBOURS = wp.constant(5)  # points in the mean spacing, including the point itself
JACOBI_SWEEPS = 6  # number of Jacobi sweeps; convergence is quadratic
THREADS_PER_BLOCK = 64  # threads per block on a GPU; ten blocks fit on a multiprocessor

Indices = wp.types.vector(length=NORMAL_NEIGHBOURS, dtype=wp.int32)


@wp.func
def _jacobi_rotation(A: wp.mat33d, V: wp.mat33d, p: int, q: int):
    """Return A and V after the rotation in the plane of axes p and q that zeroes A[p, q]."""
    G = wp.identity(n=3, dtype=wp.float64)
    if A[p, q] != wp.float64(0.0):
        cot = (A[q, q] - A[p, p]) / (wp.float64(2.0) * A[p, q])  # cotangent of twice the rotation angle
        tan = wp.float64(1.0) / (wp.abs(cot) + wp.sqrt(cot * cot + wp.float64(1.0)))
        if cot < wp.float64(0.0):
            tan = -tan
        cos = wp.float64(1.0) / wp.sqrt(tan * tan + wp.float64(1.0))
        G[p, p] = cos
        G[q, q] = cos
        G[p, q] = tan * cos
        G[q, p] = -tan * cos
    return wp.transpose(G) * A * G, V * G


@wp.func
def _eigen(A: wp.mat33d, sweeps: int):
    """Eigenvalues (unordered) and eigenvectors (columns) of a symmetric matrix, by cyclic Jacobi rotations."""
    V = wp.identity(n=3, dtype=wp.float64)
    for _ in range(sweeps):
        A, V = _jacobi_rotation(A, V, 0, 1)
        A, V = _jacobi_rotation(A, V, 0, 2)
        A, V = _jacobi_rotation(A, V, 1, 2)
    return wp.get_diag(A), V


@wp.kernel(enable_backward=False, launch_bounds=(THREADS_PER_BLOCK, 10))
def _normals(points: wp.array2d[Any], valid: wp.array2d[wp.bool], sweeps: int,
             normal: wp.array2d[wp.vec3d], spacing: wp.array2d[wp.float64]):  # fmt: skip
    o, i = wp.tid()
    if not valid[o, i]:
        return
    x = points[o, i]
    nearest, index = wp.vector(x.dtype(wp.inf), length=NORMAL_NEIGHBOURS), Indices(-1)
    for j in range(points.shape[1]):
        d = wp.length_sq(points[o, j] - x)
        if d < nearest[NORMAL_NEIGHBOURS - 1] and valid[o, j]:
            which = wp.int32(j)
            for k in range(NORMAL_NEIGHBOURS):  # insertion into the sorted list
                if d < nearest[k]:
                    next_d = nearest[k]
                    next_index = index[k]
                    nearest[k] = d
                    index[k] = which
                    d = next_d
                    which = next_index
    mean, count = wp.vec3d(), wp.float64(0.0)
    for k in range(NORMAL_NEIGHBOURS):
        if index[k] >= 0:
            mean += wp.vec3d(points[o, index[k]] - x)
            count += wp.float64(1.0)
    mean = mean / count
    spread = wp.mat33d()
    for k in range(NORMAL_NEIGHBOURS):
        if index[k] >= 0:
            arm = wp.vec3d(points[o, index[k]] - x) - mean
            spread += wp.outer(arm, arm)
    extent, axes = _eigen(spread, sweeps)
    smallest = wp.int32(wp.argmin(extent))
    normal[o, i] = wp.vec3d(axes[0, smallest], axes[1, smallest], axes[2, smallest])
    total, neighbours = wp.float64(0.0), wp.float64(0.0)
    for k in range(1, SPACING_NEIGHBOURS):
        if index[k] >= 0:
            total += wp.sqrt(wp.float64(nearest[k]))
            neighbours += wp.float64(1.0)
    spacing[o, i] = total / wp.max(neighbours, wp.float64(1.0))


for _vector in (wp.vec3, wp.vec3d):  # declare both now: adding an overload later would recompile the module
    wp.overload(_normals, {"points": wp.array2d(dtype=_vector)})


def normals_and_spacing(points: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Return surface normals (b o n 3) and spacings (b o n) [m] at points (b o n 3) [m]; 0 where not `valid` (b o n).

    A normal is the direction of least extent of the NORMAL_NEIGHBOURS nearest points, with arbitrary sign. The spacing
    is the mean distance to the SPACING_NEIGHBOURS - 1 nearest other points.
    """
    normal = torch.zeros_like(points, dtype=torch.float64, memory_format=torch.contiguous_format)
    spacing = normal.new_zeros(valid.shape)
    vector = wp.vec3d if points.dtype == torch.float64 else wp.vec3
    flat = points.contiguous().flatten(0, 1), valid.contiguous().flatten(0, 1)
    inputs = [view(flat[0], vector), view(flat[1], wp.bool), JACOBI_SWEEPS]
    outputs = [view(normal.flatten(0, 1), wp.vec3d), view(spacing.flatten(0, 1), wp.float64)]
    launch(_normals, inputs[1].shape, inputs, outputs, device_of(points), block_dim=THREADS_PER_BLOCK)
    return normal.to(points), spacing.to(points)


def normals_and_spacing_reference(points: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """`normals_and_spacing` from the full distance matrix, in any precision."""
    gap = (points[..., :, None, :] - points[..., None, :, :]).norm(dim=-1)
    gap = gap.masked_fill(~(valid[..., :, None] & valid[..., None, :]), torch.inf)
    distances, index = gap.topk(min(NORMAL_NEIGHBOURS, gap.shape[-1]), largest=False)
    found, next_ = distances.isfinite().to(points)[..., None], distances[..., 1:SPACING_NEIGHBOURS]
    rows = index[..., None].expand(*index.shape, 3)
    cloud = torch.gather(points[:, :, None].expand(*index.shape[:3], *points.shape[2:]), 3, rows)
    mean = (found * cloud).sum(-2, keepdim=True) / found.sum(-2, keepdim=True).clamp_min(1)
    cloud = found * (cloud - mean)
    normal = torch.linalg.eigh(cloud.mT @ cloud).eigenvectors[..., 0]
    spacing = next_.masked_fill(~next_.isfinite(), 0).sum(-1) / next_.isfinite().sum(-1).clamp_min(1)
    return normal * valid[..., None], spacing


@wp.kernel(enable_backward=False)
def _invert_spd(matrix: wp.array[wp.mat33d], sweeps: int, inverse: wp.array[wp.mat33d], values: wp.array[wp.vec3d]):
    i = wp.tid()
    extent, axes = _eigen(matrix[i], sweeps)
    d = wp.cw_div(wp.vec3d(wp.float64(1.0)), extent)
    inverse[i] = axes * wp.diag(d) * wp.transpose(axes)
    minimum, maximum = wp.min(d), wp.max(d)
    values[i] = wp.vec3d(minimum, d[0] + d[1] + d[2] - minimum - maximum, maximum)


def invert_spd(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Return inverses (b o 3 3) of symmetric positive definite matrices, and the inverses' eigenvalues (b o 3) sorted.

    The eigenvalues are in ascending order.
    """
    real = matrix.double().contiguous()
    inverse, values = torch.empty_like(real), torch.empty_like(real[..., 0])
    inputs = [view(real.flatten(0, 1), wp.mat33d), JACOBI_SWEEPS]
    outputs = [view(inverse.flatten(0, 1), wp.mat33d), view(values.flatten(0, 1), wp.vec3d)]
    launch(_invert_spd, inputs[0].shape, inputs, outputs, device_of(matrix), block_dim=THREADS_PER_BLOCK)
    return inverse.to(matrix), values.to(matrix)
