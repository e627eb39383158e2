"""Pi3-splat: π³ with an additional head that predicts a Gaussian for each pixel."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stages.core.geometry.rotations import multiply, quaternion
from stages.core.geometry.symmetric_matrices import eigh
from stages.core.models.pi3.config import Pi3Config
from stages.core.models.pi3.feature_head import FeatureHead
from stages.core.models.pi3.network import CAMERA_REGISTERS, Geometry, Pi3, by_views
from stages.core.models.pi3.rope import RotaryEmbedding
from stages.core.scene.gaussians import Gaussians

DEGREE = 2  # degree of the spherical harmonics
CHANNELS = 1 + 3 + 4 + 3 * (DEGREE + 1) ** 2  # opacity, scales, quaternion x y z w, harmonics by colour
SCALE_FACTOR, MAX_SCALE = 0.001, 0.3  # scales of Gaussians: factor of the softplus, and maximum [units of the points]
BANDS = (1.0, 0.025, 0.00625)  # factor on the harmonics of each degree, as published


class SplatEncoder(Pi3):
    """π³ with a head for Gaussians on the same tokens."""

    def __init__(self, config: Pi3Config = Pi3Config()):  # noqa: B008 -- frozen
        super().__init__(config)
        c = config
        self.feature_decoder = self._decoder(c.width)
        self.feature_head = FeatureHead(c.width, c.splat_widths, c.splat_features, CHANNELS)

    def raw(
        self, images: Float[Tensor, "v 3 h w"], hidden: Float[Tensor, "v t c"], positions: RotaryEmbedding, at_once: int
    ) -> Float[Tensor, "v h w k"]:
        """Raw parameters of each pixel's Gaussian, before activation functions."""

        def one_part(images: Tensor, hidden: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
            tokens = self.feature_decoder(hidden, RotaryEmbedding(cos, sin))[:, CAMERA_REGISTERS:]
            return self.feature_head(tokens, (images - self.image_mean) / self.image_std).float()

        return by_views(one_part, at_once, images, hidden, *positions)


class Pi3Splat(nn.Module):
    """The published network, whose parameter names start with `encoder.`."""

    def __init__(self, config: Pi3Config = Pi3Config()):  # noqa: B008 -- frozen
        super().__init__()
        self.encoder = SplatEncoder(config)

    def forward(self, images: Float[Tensor, "v 3 h w"], at_once: int = 2) -> tuple[Geometry, Float[Tensor, "v h w k"]]:
        """Return the geometry, and the raw parameters that `splat` converts to Gaussians.

        The convolutions at pixel resolution dominate memory use, so the default `at_once` is small.
        """
        hidden, positions = self.encoder.tokens(images, at_once)
        geometry = self.encoder.geometry(hidden, positions, images.shape[2:], at_once)
        return geometry, self.encoder.raw(images, hidden, positions, at_once)


def splat(geometry: Geometry, raw: Float[Tensor, "v h w k"]) -> Gaussians:
    """Return one Gaussian per pixel, in order of views and rows, in world coordinates.

    Harmonics are in world axes, as in the published renderer. Differentiable in `raw`.
    """
    opacity, scales, xyzw, sh = raw.split((1, 3, 4, CHANNELS - 8), -1)
    R = geometry.poses[:, :3, :3]
    means = geometry.points @ R.mT[:, None] + geometry.poses[:, None, None, :3, 3]
    rotation = quaternion(R)[:, None, None].expand(*raw.shape[:3], 4)
    quats = multiply(rotation, F.normalize(xyzw, dim=-1).roll(1, -1))
    scales = (SCALE_FACTOR * F.softplus(scales)).clamp(max=MAX_SCALE)
    sh = sh.unflatten(-1, (3, -1)).mT * band_factors(raw.device)[:, None]
    fields = (part.flatten(0, 2) for part in (means, quats, scales, opacity[..., 0].sigmoid(), sh))
    return Gaussians(*fields, torch.zeros(opacity.numel(), dtype=torch.int64, device=raw.device))


def band_factors(device=None) -> Float[Tensor, "k"]:
    """Published factors of the k harmonics, which depend on their degrees."""
    return torch.cat([torch.full((2 * l + 1,), factor, device=device) for l, factor in enumerate(BANDS)])


def decompose(covariances: Float[Tensor, "n 3 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 4"]]:
    """Decompose covariances into scales, largest first, and quaternions w x y z; variances are at least 1e-8."""
    variances, axes = eigh(covariances)
    variances, axes = variances.flip(-1), axes.flip(-1)
    axes = torch.cat([axes[..., :2], axes[..., 2:] * torch.det(axes)[..., None, None]], -1)
    return variances.clamp_min(1e-8).sqrt(), quaternion(axes)
