"""Rotations as unit quaternions (w x y z) and matrices."""

import torch
from jaxtyping import Float
from torch import Tensor


def matrix(quats: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 3 3"]:
    """Rotation matrices of quaternions w x y z, which need not be normalised; a zero quaternion gives nan."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def quaternion(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 4"]:
    """Unit quaternions w x y z, w >= 0, of rotation matrices.

    The largest of the four components, found from the diagonal, is used as divisor.
    Source: Shepperd 1978, "Quaternion from rotation matrix".
    """
    m = R.flatten(-2)
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = m.unbind(-1)
    # row i of the products is 4 q_i (w, x, y, z)
    products = torch.stack([
        torch.stack([1 + m00 + m11 + m22, m21 - m12, m02 - m20, m10 - m01], -1),
        torch.stack([m21 - m12, 1 + m00 - m11 - m22, m01 + m10, m02 + m20], -1),
        torch.stack([m02 - m20, m01 + m10, 1 - m00 + m11 - m22, m12 + m21], -1),
        torch.stack([m10 - m01, m02 + m20, m12 + m21, 1 - m00 - m11 + m22], -1),
    ], -2)  # fmt: skip
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(-1)
    q = products.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
    q = q / q.norm(dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def multiply(a: Float[Tensor, "*b 4"], b: Float[Tensor, "*b 4"]) -> Float[Tensor, "*b 4"]:
    """Hamilton product: matrix(multiply(a, b)) = matrix(a) @ matrix(b)."""
    aw, av = a[..., :1], a[..., 1:]
    bw, bv = b[..., :1], b[..., 1:]
    w = aw * bw - (av * bv).sum(-1, keepdim=True)
    v = aw * bv + bw * av + torch.linalg.cross(av, bv)
    return torch.cat([w, v], -1)


def covariance(quats: Float[Tensor, "*b 4"], scales: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """Covariance R S S^T R^T of each Gaussian [m^2].

    Source: Kerbl et al. 2023, "3D Gaussian Splatting", eq. 6.
    """
    RS = matrix(quats) * scales[..., None, :]  # scales the columns: R @ diag(scales)
    return RS @ RS.mT


def rotation_between(a: Float[Tensor, "3"], b: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Smallest rotation from direction `a` to direction `b`; opposite directions get an arbitrary axis."""
    a, b = a / a.norm(), b / b.norm()
    if torch.dot(a, b) < -1 + 1e-6:
        axis = torch.linalg.cross(a, torch.eye(3).to(a)[a.abs().argmin()])
        axis = axis / axis.norm()
        return 2 * torch.outer(axis, axis) - torch.eye(3).to(a)
    q = torch.cat([1 + torch.dot(a, b)[None], torch.linalg.cross(a, b)])
    return matrix(q)


def rotation_angle(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b"]:
    """Angle of each rotation, 0 to 180 [degrees]."""
    cosine = (R.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    return torch.rad2deg(torch.acos(cosine.clamp(-1, 1)))


def nearest_rotation(M: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3 3"]:
    """The rotation nearest to M in the Frobenius norm (polar factor, determinant +1)."""
    U, _, Vt = torch.linalg.svd(M)
    sign = torch.det(U @ Vt)
    U = torch.cat([U[..., :2], U[..., 2:] * sign[..., None, None]], -1)
    return U @ Vt
