"""Similarity transforms x -> s R x + t, and their least-squares estimate."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.rotations import nearest_rotation


class Similarity(NamedTuple):
    """x -> scale * rotation @ x + translation."""

    scale: float
    rotation: Tensor  # (3, 3)
    translation: Tensor  # (3,)

    def __call__(self, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """Transform points."""
        return self.scale * points @ self.rotation.mT + self.translation

    def inverse(self) -> "Similarity":
        """The inverse transform."""
        R = self.rotation.mT
        return Similarity(1 / self.scale, R, -(R @ self.translation) / self.scale)

    def to(self, device: str | torch.device) -> "Similarity":
        """The transform on a device."""
        return Similarity(self.scale, self.rotation.to(device), self.translation.to(device))

    def viewmats(self, viewmats: Float[Tensor, "c 4 4"]) -> Float[Tensor, "c 4 4"]:
        """World-to-camera matrices in the transformed world: same pixels, depths multiplied by the scale."""
        out = viewmats.clone()
        out[:, :3, :3] = viewmats[:, :3, :3] @ self.rotation.mT
        out[:, :3, 3] = self.scale * viewmats[:, :3, 3] - out[:, :3, :3] @ self.translation
        return out


def umeyama(source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"], scaled: bool = True) -> Similarity:
    """Least-squares similarity from `source` to `target`; a rigid motion unless `scaled`.

    Source: Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns".
    """
    mean_s, mean_t = source.mean(0), target.mean(0)
    S, T = source - mean_s, target - mean_t
    H = T.mT @ S
    R = nearest_rotation(H)
    scale = float((R * H).sum() / S.square().sum().clamp_min(torch.finfo(S.dtype).tiny)) if scaled else 1.0
    return Similarity(scale, R, mean_t - scale * R @ mean_s)
