"""Linear blend skinning of Gaussians by keypoints: new means, orientations and scales.

A Gaussian at X is bound to keypoints X_j with displacement u_j and displacement gradient G_j (F_j = I + G_j):
    x = X + sum w_j (u_j + G_j (X - X_j)),    F = I + sum w_j G_j,    covariance -> F covariance F^T.
Gaussians whose weighted gradient sum w_j G_j is exactly zero keep their quats and scales bit for bit.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.rotations import matrix, nearest_rotation, quaternion
from stages.core.kernels.interop import device_of, kernel_device, launch, view, with_arrays
from stages.core.kernels.threads import run_parallel
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.trajectory import Binding


class KeypointMotion(NamedTuple):
    """Rest positions of the keypoints, their displacements and displacement gradients."""

    rest: Float[Tensor, "p 3"]  # [m]
    displacement: Float[Tensor, "p 3"]  # [m]
    gradient: Float[Tensor, "p 3 3"]  # displacement gradient G


@wp.struct
class BindingArrays:
    """Binding for kernels."""

    index: wp.array2d[wp.int32]
    weight: wp.array2d[float]


@wp.struct
class KeypointMotionArrays:
    """KeypointMotion for kernels."""

    rest: wp.array[wp.vec3]
    displacement: wp.array[wp.vec3]
    gradient: wp.array[wp.mat33]


@wp.struct
class Ellipsoids:
    """The properties of Gaussians that skinning changes, for kernels."""

    means: wp.array[wp.vec3]
    quats: wp.array[wp.vec4]
    scales: wp.array[wp.vec3]


@wp.func
def _rotation_of(F: wp.mat33) -> wp.mat33:
    """Rotation of the polar decomposition of F (determinant +1).

    Newton's iteration R <- (R + R^-T) / 2 (Higham 1986) converges quadratically; for an inverted or nearly singular F
    the singular value decomposition is used.
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
def _orthogonalise(M: wp.mat33, p: int, q: int) -> wp.mat33:
    """Rotate columns p and q of M in their plane until they are orthogonal (one Jacobi rotation)."""
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
    """Semi-axes (columns) of the ellipsoid that is the image of the unit ball under M.

    One-sided Jacobi (Hestenes 1958): takes two or three sweeps when the columns of M are nearly orthogonal, and
    computes short axes as accurately as long ones. wp.svd3 has errors of up to 1e-3.
    """
    for _ in range(8):
        before = M
        M = _orthogonalise(_orthogonalise(_orthogonalise(M, 0, 1), 0, 2), 1, 2)
        if before == M:
            break
    return M


@wp.kernel
def _skin(
    start: int, binding: BindingArrays, keypoints: KeypointMotionArrays, given: Ellipsoids, moved: Ellipsoids,
    rotation: wp.array[wp.mat33],
):  # fmt: skip
    i = start + wp.tid()
    X = given.means[i]
    shift = wp.vec3()
    G = wp.mat33()
    for j in range(binding.index.shape[1]):
        k = binding.index[i, j]
        if k >= 0:
            weight = binding.weight[i, j]
            shift += weight * (keypoints.displacement[k] + keypoints.gradient[k] * (X - keypoints.rest[k]))
            G += weight * keypoints.gradient[k]
    moved.means[i] = X + shift
    moved.quats[i] = given.quats[i]
    moved.scales[i] = given.scales[i]
    one = wp.identity(n=3, dtype=float)
    rotation[i] = one
    if wp.ddot(G, G) == 0.0:
        return
    F = one + G
    q = wp.normalize(given.quats[i])
    axes = wp.quat_to_matrix(wp.quat(q[1], q[2], q[3], q[0]))
    M = _axes(F * axes * wp.diag(given.scales[i]))
    thin = 1.0e-6 * wp.max(given.scales[i])
    x = wp.vec3(M[0, 0], M[1, 0], M[2, 0])
    y = wp.vec3(M[0, 1], M[1, 1], M[2, 1])
    z = wp.vec3(M[0, 2], M[1, 2], M[2, 2])
    moved.scales[i] = wp.vec3(wp.max(wp.length(x), thin), wp.max(wp.length(y), thin), wp.max(wp.length(z), thin))
    # build a right-handed frame even where an axis has vanished
    if wp.length(x) <= thin:
        x = wp.cross(y, z)
    if wp.length(y) <= thin:
        y = wp.cross(z, x)
    x = wp.normalize(x)
    y = wp.normalize(y - wp.dot(x, y) * x)
    rotated = wp.quat_from_matrix(wp.matrix_from_cols(x, y, wp.cross(x, y)))
    moved.quats[i] = wp.normalize(wp.vec4(rotated[3], rotated[0], rotated[1], rotated[2]))
    rotation[i] = _rotation_of(F)


def skin_gaussians(
    binding: Binding, keypoints: KeypointMotion, gaussians: Gaussians
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"], Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Return the deformed means [m], quats, scales [m] and rotations of Gaussians that are bound to keypoints."""
    g, where = gaussians, kernel_device(gaussians.means)
    given = {name: getattr(g, name).to(where).contiguous() for name in ("means", "quats", "scales")}
    moved = {name: torch.empty_like(x) for name, x in given.items()}
    n, device, rotation = len(g), device_of(given["means"]), given["means"].new_empty(len(g), 3, 3)
    inputs = [
        with_arrays(BindingArrays(), {"index": binding.index.to(where), "weight": binding.weight.to(where)}),
        with_arrays(KeypointMotionArrays(), {name: x.to(where) for name, x in keypoints._asdict().items()}),
        with_arrays(Ellipsoids(), given), with_arrays(Ellipsoids(), moved), view(rotation, wp.mat33),
    ]  # fmt: skip
    if device != "cpu":
        launch(_skin, n, [0, *inputs], device=device)
    else:
        halves = [
            wp.launch(_skin, b - a, [a, *inputs], device=device, record_cmd=True, record_tape=False)
            for a, b in ((0, n // 2), (n // 2, n)) if b > a
        ]  # fmt: skip
        run_parallel([half.launch for half in halves])
    means, quats, scales, rotation = (x.to(g.means.device) for x in (*moved.values(), rotation))
    return means, quats, scales, rotation


def skin_gaussians_reference(
    binding: Binding, keypoints: KeypointMotion, gaussians: Gaussians
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"], Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """`skin_gaussians` in PyTorch, in any precision."""
    g, (rest, displacement, gradient) = gaussians, keypoints
    w = torch.where(binding.index >= 0, binding.weight, 0)
    k = binding.index.clamp_min(0).long()
    G = (w[..., None, None] * gradient[k]).sum(1)
    shift = (w[..., None] * (displacement[k] + (gradient[k] @ (g.means[:, None] - rest[k])[..., None])[..., 0])).sum(1)
    F = torch.eye(3).to(G) + G
    U, s, _ = torch.linalg.svd(F @ matrix(g.quats) * g.scales[:, None, :])
    U = torch.cat([U[..., :2], U[..., 2:] * torch.linalg.det(U)[:, None, None]], -1)
    still = (G == 0).all(-1).all(-1)
    new_quats = torch.where(still[:, None], g.quats, quaternion(U))
    new_scales = torch.where(still[:, None], g.scales, s)
    R = torch.where(still[:, None, None], torch.eye(3).to(F), nearest_rotation(F))
    return g.means + shift, new_quats, new_scales, R
