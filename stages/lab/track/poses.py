"""Rigid poses of several objects about their centres at rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.geometry.rotations import matrix, quaternion


@dataclass(frozen=True)
class Poses:
    """Rotation of each object about its centre at rest, and position of this centre.

    A point x moves to rotation (x - rest centre) + centre.
    """

    rotation: Float[Tensor, "*b o 3 3"]
    centre: Float[Tensor, "*b o 3"]  # centre of each object [scene units]

    def __getitem__(self, index) -> Poses:
        """The poses of some frames."""
        return Poses(self.rotation[index], self.centre[index])

    def place(self, arm: Float[Tensor, "*b p 3"], row: Int[Tensor, "p"]) -> Float[Tensor, "*b p 3"]:
        """Positions of points of the objects `row`, given as offsets from the centres at rest."""
        return (self.rotation[..., row, :, :] @ arm[..., None])[..., 0] + self.centre[..., row, :]

    def to(self, device: str) -> Poses:
        """The same poses on a device."""
        return Poses(self.rotation.to(device), self.centre.to(device))

    def quaternions(self) -> Float[Tensor, "*b o 4"]:
        """The rotations as unit quaternions w x y z."""
        return quaternion(self.rotation)

    @staticmethod
    def stack(poses: Sequence[Poses]) -> Poses:
        """The poses of several frames."""
        return Poses(torch.stack([p.rotation for p in poses]), torch.stack([p.centre for p in poses]))

    def moved(self, step: Float[Tensor, "*b o 6"]) -> Poses:
        """The poses after an additional rotation [rad] and displacement [scene units] of each object."""
        return Poses(rotation_of(step[..., :3]) @ self.rotation, self.centre + step[..., 3:])

    def step_to(self, other: Poses) -> Float[Tensor, "*b o 6"]:
        """Rotation [rad] and displacement [scene units] that lead from these poses to `other`."""
        turn = rotation_vector(other.rotation @ self.rotation.mT)
        return torch.cat([turn, other.centre - self.centre], -1)


def rotation_of(vector: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3 3"]:
    """The rotation matrix of a rotation vector, whose length is the angle [rad]."""
    half = vector.norm(dim=-1, keepdim=True) / 2
    return matrix(torch.cat([half.cos(), vector / 2 * torch.sinc(half / torch.pi)], -1))


def rotation_vector(R: Float[Tensor, "*b 3 3"]) -> Float[Tensor, "*b 3"]:
    """The rotation vector (axis times angle [rad]) of a rotation, the inverse of `rotation_of` up to half a turn."""
    q = quaternion(R)
    length = q[..., 1:].norm(dim=-1, keepdim=True)
    angle = 2 * torch.atan2(length, q[..., :1])
    return q[..., 1:] * torch.where(length > 1e-9, angle / length.clamp_min(1e-9), 2.0)
