"""Displace, rotate and stretch Gaussians with their keypoints. At rest the output equals the input bit for bit."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.neighbours import knn
from stages.core.geometry.rotations import quaternion
from stages.core.kernels.nearest_rotations import nearest_rotations
from stages.core.kernels.sh_rotation import rotate_each_sh
from stages.core.kernels.skinning import KeypointMotion, skin_gaussians
from stages.core.scene.cached import cached_in_scene
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.trajectory import Binding, Keypoints

DEFORMATION_NEIGHBOURS = 16  # keypoints from which the deformation around a keypoint is estimated
RIDGE = 1e-3  # weight of a rigid rotation relative to the neighbours' deformation


class Skinning:
    """Linear blend skinning with deformation gradients, prepared once for many frames."""

    def __init__(self, gaussians: Gaussians, binding: Binding, keypoints: Keypoints):
        device = gaussians.means.device  # holds everything that a frame needs; the arguments stay on their own devices
        self.gaussians, self._deformation = gaussians, keypoint_deformation(keypoints, device)
        moving = (binding.index >= 0).any(1).nonzero()[:, 0]
        self._binding = Binding(binding.index[moving].int().to(device), binding.weight[moving].float().to(device))
        self._moving = moving.to(device)
        self._part = gaussians[self._moving]

    def __call__(self, positions: Float[Tensor, "p 3"]) -> Gaussians:
        """The Gaussians for these keypoint positions [scene units]."""
        g, part = self.gaussians, self._part
        motion = self._deformation.of(positions) if len(self._moving) else None
        if motion is None:
            return g
        means, quats, scales, R = skin_gaussians(self._binding, motion, part)
        moved = {"means": means, "quats": quats, "scales": scales, "sh": rotate_each_sh(part.sh, R)}
        whole = {name: getattr(g, name).index_copy(0, self._moving, value) for name, value in moved.items()}
        return Gaussians(**whole, opacities=g.opacities, object_id=g.object_id)


class KeypointDeformation:
    """Displacement and displacement gradient of each keypoint.

    The motion for the last positions is cached, since several sets of Gaussians follow the same keypoints.
    """

    def __init__(self, keypoints: Keypoints, device: torch.device):
        self.rest = keypoints.rest.float().contiguous().to(device)
        self._neighbours_of = keypoint_neighbours(keypoints).to(device)
        d = self.rest[self._neighbours_of] - self.rest[:, None]
        a = 1 / (d.square().sum(-1) + 1e-12 + d.square().sum(-1).mean(1, keepdim=True))
        a[self._neighbours_of == torch.arange(len(d), device=device)[:, None]] = 0  # padding with the keypoint itself
        self._ad = a[..., None] * d
        self._M = self._ad.mT @ d  # (p, 3, 3) sum a d d^T
        self._ridge = RIDGE / 3 * self._M.diagonal(dim1=1, dim2=2).sum(-1)[:, None, None].clamp_min(1e-12)
        self._inverse = torch.linalg.inv(self._M.double() + self._ridge * torch.eye(3, device=device)).float()
        _, self._body = keypoints.object_id.to(device).unique(return_inverse=True)
        self._last: tuple[Tensor, KeypointMotion | None] | None = None  # last displacements and their motion

    def of(self, positions: Float[Tensor, "p 3"]) -> KeypointMotion | None:
        """The motion to these positions [scene units]; None where all are at rest."""
        u = positions.to(self.rest) - self.rest
        if self._last is None or not torch.equal(self._last[0], u):
            self._last = u, KeypointMotion(self.rest, u, self._gradients(u)) if bool(u.any()) else None
        return self._last[1]

    def _gradients(self, u: Float[Tensor, "p 3"]) -> Float[Tensor, "p 3 3"]:
        """Displacement gradient F - I at each keypoint: weighted least squares over its neighbours, with a ridge.

        The ridge pulls F towards the best rotation R of the neighbourhood, so that directions in which the neighbours
        have no extent (normal to a sheet, across a rope) rotate with the others:
            F = (A + r R)(M + r I)^-1,  A = sum a d' d^T,  M = sum a d d^T,
        where d and d' are the offsets of the neighbours at rest and now. A rigid motion is reproduced exactly, since
        then A = R M. The rotation of the whole object has a small weight in R, which determines the rotation about the
        axis if the neighbours lie on a line.
        """
        relative = (u[self._neighbours_of] - u[:, None]).mT @ self._ad  # A - M
        moved = (relative != 0).flatten(1).any(1).nonzero()[:, 0]  # mostly few; resting keypoints are exactly at rest
        ridge, relative = self._ridge[moved], relative[moved]
        whole = self._object_rotations(u)[self._body[moved]]
        R = nearest_rotations(self._M[moved] + relative + 0.3 * ridge * whole)
        G = (relative + ridge * (R - torch.eye(3, device=R.device))) @ self._inverse[moved]
        return torch.zeros_like(self._M).index_copy(0, moved, G)

    def _object_rotations(self, u: Float[Tensor, "p 3"]) -> Float[Tensor, "o 3 3"]:
        return fit_rotations(self.rest, self.rest + u, self._body)


@cached_in_scene
def keypoint_deformation(keypoints: Keypoints, device: torch.device) -> KeypointDeformation:
    """The `KeypointDeformation` of keypoints, prepared once for each device."""
    return KeypointDeformation(keypoints, device)


def fit_rotations(
    rest: Float[Tensor, "p 3"], positions: Float[Tensor, "p 3"], body: Int[Tensor, "p"]
) -> Float[Tensor, "o 3 3"]:
    """Rotation of each body 0..o-1 that best maps `rest` to `positions`; the identity where it is undetermined.

    Source: Kabsch 1976, "A solution for the best rotation to relate two sets of vectors".
    """
    count = int(body.max()) + 1 if len(body) else 0
    size = torch.bincount(body, minlength=count).clamp_min(1)[:, None].to(rest)
    both = rest.double(), positions.double()
    X, x = (p - (torch.zeros(count, 3).to(p).index_add(0, body, p) / size)[body] for p in both)
    H = torch.zeros(count, 3, 3).to(x).index_add(0, body, x[:, :, None] * X[:, None, :])
    # a small multiple of the identity makes the fit unique for collinear and coincident points
    H = H + 1e-6 * (X.square().sum() / max(len(X), 1) + 1e-12) * torch.eye(3).to(H)
    return nearest_rotations(H).to(rest)


def object_rotations(keypoints: Keypoints, positions: Float[Tensor, "p 3"], ids: list[int]) -> Float[Tensor, "o 4"]:
    """Quaternions w x y z of the objects `ids` relative to rest, fitted to their keypoints."""
    of = torch.full((max([*ids, int(keypoints.object_id.max()) if len(keypoints.rest) else 0]) + 1,), len(ids))
    of[torch.tensor(ids, dtype=torch.int64)] = torch.arange(len(ids))
    out = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(ids) + 1, 1)
    if len(keypoints.rest):
        fitted = quaternion(fit_rotations(keypoints.rest, positions.to(keypoints.rest), of[keypoints.object_id]))
        out[: len(fitted)] = fitted
    return out[: len(ids)]


def keypoint_neighbours(keypoints: Keypoints) -> Int[Tensor, "p j"]:
    """The nearest other keypoints of the same object, padded with the keypoint itself."""
    rest = keypoints.rest.float()
    around = torch.zeros(len(rest), DEFORMATION_NEIGHBOURS, dtype=torch.int64)
    for id in keypoints.object_id.unique():
        own = (keypoints.object_id == id).nonzero()[:, 0]
        _, index = knn(rest[own], rest[own], DEFORMATION_NEIGHBOURS + 1)
        around[own] = own[index[:, 1:]]
    return around
