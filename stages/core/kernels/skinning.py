"""Keypoint motion carried to Gaussians: where they go, how they turn and stretch.

A Gaussian at X follows keypoints X_j with displacement u_j and displacement gradient G_j (F_j = I + G_j):
    x = X + sum w_j (u_j + G_j (X - X_j)),    F = I + sum w_j G_j,    covariance -> F covariance F^T.
Gaussians whose G is exactly zero keep their quats and scales bit by bit.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from stages.core.geometry.rotations import matrix, nearest_rotation, quaternion
from stages.core.kernels.interop import device_of, launch, view
from stages.core.kernels.threads import run_parallel


@wp.func
def _rotation_of(F: wp.mat33) -> wp.mat33:
    """Polar factor of F with determinant +1.

    Newton's iteration R <- (R + R^-T) / 2 (Higham 1986) doubles the digits in each step; a body turned inside out or
    flattened takes the singular value decomposition.
    """
    if wp.determinant(F) > 1.0e-3:
        R = F
        for _ in range(14):
            new = 0.5 * (R + wp.transpose(wp.inverse(R)))
            step = wp.ddot(new - R, new - R)
            R = new
            if step < 1.0e-9:
                break
        return R
    U, s, V = wp.svd3(F)
    if wp.determinant(U) * wp.determinant(V) < 0.0:
        for row in range(3):
            U[row, 2] = -U[row, 2]
    return U * wp.transpose(V)


@wp.func
def _turn_apart(M: wp.mat33, p: int, q: int) -> wp.mat33:
    """Columns p and q of M turned into each other until they are orthogonal."""
    a = wp.vec3(M[0, p], M[1, p], M[2, p])
    b = wp.vec3(M[0, q], M[1, q], M[2, q])
    along = wp.dot(a, b)
    if wp.abs(along) <= 1.0e-7 * wp.length(a) * wp.length(b):
        return M
    zeta = 0.5 * (wp.dot(b, b) - wp.dot(a, a)) / along
    t = 1.0 / (wp.abs(zeta) + wp.sqrt(1.0 + zeta * zeta))
    if zeta < 0.0:
        t = -t
    c = 1.0 / wp.sqrt(1.0 + t * t)
    for row in range(3):
        M[row, p] = c * (a[row] - t * b[row])
        M[row, q] = c * (b[row] + t * a[row])
    return M


@wp.func
def _axes(M: wp.mat33) -> wp.mat33:
    """Columns: the principal axes of the ellipsoid that M makes of a ball, as long as they are.

    One-sided Jacobi (Hestenes 1958): two or three sweeps when M is nearly a rotation of an ellipsoid's axes, and the
    thin axis of a flat one comes out as accurately as the long ones. wp.svd3 is off by up to 1e-3 now and then.
    """
    for _ in range(8):
        before = M
        M = _turn_apart(_turn_apart(_turn_apart(M, 0, 1), 0, 2), 1, 2)
        if before == M:
            break
    return M


@wp.kernel
def _blend(
    start: int, index: wp.array2d[wp.int32], weight: wp.array2d[float],
    rest: wp.array[wp.vec3], displacement: wp.array[wp.vec3], gradient: wp.array[wp.mat33],
    means: wp.array[wp.vec3], quats: wp.array[wp.vec4], scales: wp.array[wp.vec3],
    new_means: wp.array[wp.vec3], new_quats: wp.array[wp.vec4], new_scales: wp.array[wp.vec3],
    rotation: wp.array[wp.mat33],
):  # fmt: skip
    i = start + wp.tid()
    X = means[i]
    shift = wp.vec3()
    G = wp.mat33()
    for j in range(index.shape[1]):
        k = index[i, j]
        if k >= 0:
            shift += weight[i, j] * (displacement[k] + gradient[k] * (X - rest[k]))
            G += weight[i, j] * gradient[k]
    new_means[i] = X + shift
    new_quats[i] = quats[i]
    new_scales[i] = scales[i]
    one = wp.identity(n=3, dtype=float)
    rotation[i] = one
    if wp.ddot(G, G) == 0.0:
        return
    F = one + G
    q = wp.normalize(quats[i])
    axes = wp.quat_to_matrix(wp.quat(q[1], q[2], q[3], q[0]))
    M = _axes(F * axes * wp.diag(scales[i]))
    thin = 1.0e-6 * wp.max(scales[i])
    x = wp.vec3(M[0, 0], M[1, 0], M[2, 0])
    y = wp.vec3(M[0, 1], M[1, 1], M[2, 1])
    z = wp.vec3(M[0, 2], M[1, 2], M[2, 2])
    new_scales[i] = wp.vec3(wp.max(wp.length(x), thin), wp.max(wp.length(y), thin), wp.max(wp.length(z), thin))
    # a right-handed frame, also where an axis vanished
    if wp.length(x) <= thin:
        x = wp.cross(y, z)
    if wp.length(y) <= thin:
        y = wp.cross(z, x)
    x = wp.normalize(x)
    y = wp.normalize(y - wp.dot(x, y) * x)
    turned = wp.quat_from_matrix(wp.matrix_from_cols(x, y, wp.cross(x, y)))
    new_quats[i] = wp.normalize(wp.vec4(turned[3], turned[0], turned[1], turned[2]))
    rotation[i] = _rotation_of(F)


def skin_gaussians(
    index: Tensor, weight: Tensor, rest: Tensor, displacement: Tensor, gradient: Tensor,
    means: Tensor, quats: Tensor, scales: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Moved means (n, 3), quats (n, 4), scales (n, 3) and rotations (n, 3, 3) of Gaussians.

    index (n, j) int32 with -1 for none, weight (n, j); rest, displacement (p, 3) and gradient (p, 3, 3) of keypoints.
    """
    n, device = len(means), device_of(means)
    out = [torch.empty_like(means), torch.empty_like(quats), torch.empty_like(scales), means.new_empty(n, 3, 3)]
    inputs = [
        view(index), view(weight), view(rest.contiguous(), wp.vec3), view(displacement.contiguous(), wp.vec3),
        view(gradient.contiguous(), wp.mat33), view(means, wp.vec3), view(quats, wp.vec4), view(scales, wp.vec3),
    ]  # fmt: skip
    outputs = [view(out[0], wp.vec3), view(out[1], wp.vec4), view(out[2], wp.vec3), view(out[3], wp.mat33)]
    if device != "cpu":
        launch(_blend, n, [0, *inputs], outputs, device)
        return tuple(out)
    halves = [
        wp.launch(_blend, b - a, [a, *inputs], outputs, device=device, record_cmd=True, record_tape=False)
        for a, b in ((0, n // 2), (n // 2, n)) if b > a
    ]  # fmt: skip
    run_parallel([half.launch for half in halves])
    return tuple(out)


def skin_gaussians_reference(
    index: Tensor, weight: Tensor, rest: Tensor, displacement: Tensor, gradient: Tensor,
    means: Tensor, quats: Tensor, scales: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """The same in PyTorch."""
    w = torch.where(index >= 0, weight, 0)
    k = index.clamp_min(0).long()
    G = (w[..., None, None] * gradient[k]).sum(1)
    shift = (w[..., None] * (displacement[k] + (gradient[k] @ (means[:, None] - rest[k])[..., None])[..., 0])).sum(1)
    F = torch.eye(3).to(G) + G
    U, s, _ = torch.linalg.svd(F @ matrix(quats) * scales[:, None, :])
    U = torch.cat([U[..., :2], U[..., 2:] * torch.linalg.det(U)[:, None, None]], -1)
    still = (G == 0).all(-1).all(-1)
    new_quats = torch.where(still[:, None], quats, quaternion(U))
    new_scales = torch.where(still[:, None], scales, s)
    R = torch.where(still[:, None, None], torch.eye(3).to(F), nearest_rotation(F))
    return means + shift, new_quats, new_scales, R
