"""The head that predicts the parameters of a Gaussian for each pixel, with a token branch and a colour branch.

Names are those of the published weights of Pi3-splat (the Gaussian splat variant of NGFF's reconstruction).
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stages.core.models.pi3.dinov2 import PATCH


def conv(width_in: int, width_out: int) -> nn.Conv2d:
    """3 x 3 convolution without bias."""
    return nn.Conv2d(width_in, width_out, 3, padding=1, bias=False)


class ResidualConv(nn.Module):
    """Two convolutions with a residual connection. Source: He et al. 2016, "Deep residual learning", fig. 2."""

    def __init__(self, width: int):
        super().__init__()
        self.conv1, self.norm1 = conv(width, width), nn.BatchNorm2d(width)
        self.conv2, self.norm2 = conv(width, width), nn.BatchNorm2d(width)

    def forward(self, x: Float[Tensor, "b c h w"]) -> Float[Tensor, "b c h w"]:
        """Feature maps of the same shape; ReLU is applied after the addition."""
        return F.relu(x + self.norm2(self.conv2(F.relu(self.norm1(self.conv1(x))))))


class TokenBranch(nn.Module):
    """Upsampling of token features from patch to pixel resolution."""

    def __init__(self, width: int, widths: tuple[int, int, int], features: int):
        super().__init__()
        layers: list[nn.Module] = []
        for wide in widths:
            layers += [conv(width, wide), nn.BatchNorm2d(wide), nn.ReLU(), ResidualConv(wide), ResidualConv(wide)]
            width = wide
        layers.append(nn.ConvTranspose2d(width, features, PATCH, stride=PATCH))
        for _ in range(2):
            layers += [conv(features, features), nn.BatchNorm2d(features), nn.ReLU()]
        self.model = nn.Sequential(*layers)


class ColourBranch(nn.Module):
    """Features of the image at pixel resolution."""

    def __init__(self, features: int):
        super().__init__()
        first = nn.Sequential(conv(3, features), nn.BatchNorm2d(features), nn.ReLU())
        self.layers = nn.Sequential(first, *(ResidualConv(features) for _ in range(3)))


class FeatureHead(nn.Module):
    """Token and colour branches, joined by a pixelwise linear layer."""

    def __init__(self, width: int, widths: tuple[int, int, int], features: int, channels: int):
        super().__init__()
        self.upsample_proj = TokenBranch(width, widths, features)
        self.conv_net = ColourBranch(features)
        self.down_proj = nn.Linear(2 * features, channels)

    def forward(self, tokens: Float[Tensor, "b t c"], images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b h w k"]:
        """Return `channels` values per pixel, from the patch tokens in row order and the normalised images."""
        grid = images.shape[2] // PATCH, images.shape[3] // PATCH
        coarse = self.upsample_proj.model(tokens.mT.unflatten(2, grid))
        fine = self.conv_net.layers(images)
        return self.down_proj(torch.cat([coarse, fine], 1).permute(0, 2, 3, 1))
