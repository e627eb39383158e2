"""Output heads: tokens to points, confidences and cameras."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stages.core.geometry.rotations import nearest_rotation
from stages.core.models.pi3.dinov2 import PATCH
from stages.core.models.pi3.layers import ViTBlock
from stages.core.models.pi3.rope import RotaryEmbedding


class TransformerDecoder(nn.Module):
    """Transformer blocks within each view, between two linear layers."""

    def __init__(self, width_in: int, width: int, width_out: int, head: int, depth: int = 5):
        super().__init__()
        self.projects = nn.Linear(width_in, width)
        self.blocks = nn.ModuleList(ViTBlock(width, head) for _ in range(depth))
        self.linear_out = nn.Linear(width, width_out)

    def forward(self, x: Float[Tensor, "b t c"], positions: RotaryEmbedding) -> Float[Tensor, "b t d"]:
        """Decoded tokens; `positions` are the rotary embeddings of their image positions."""
        x = self.projects(x)
        for block in self.blocks:
            x = block(x, positions)
        return self.linear_out(x)


class LinearMap(nn.Module):
    """Linear layer and pixel shuffle: tokens to a map of `channels` values per pixel."""

    def __init__(self, width: int, channels: int):
        super().__init__()
        self.proj = nn.Linear(width, channels * PATCH * PATCH)

    def forward(self, tokens: Float[Tensor, "b t c"], rows: int, columns: int) -> Float[Tensor, "b h w k"]:
        """Return a map of k values per pixel from the tokens of `rows` x `columns` patches, in row order."""
        maps = self.proj(tokens).mT.unflatten(2, (rows, columns))
        return F.pixel_shuffle(maps, PATCH).permute(0, 2, 3, 1)


def local_points(raw: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
    """Convert the network's output (x / z, y / z, log z) to points in the frame of their camera."""
    z = raw[..., 2:].exp()
    return torch.cat([raw[..., :2] * z, z], -1)


class ResidualMLP(nn.Module):
    """Three linear layers with ReLU and a residual connection."""

    def __init__(self, width: int):
        super().__init__()
        self.res_conv1, self.res_conv2, self.res_conv3 = (nn.Linear(width, width) for _ in range(3))

    def forward(self, x: Float[Tensor, "b t c"]) -> Float[Tensor, "b t c"]:
        """Tokens plus the output of the layers, same width."""
        inner = F.relu(self.res_conv2(F.relu(self.res_conv1(x))))
        return x + F.relu(self.res_conv3(inner))


class CameraHead(nn.Module):
    """Camera pose of a view, from its pooled tokens."""

    def __init__(self, width: int):
        super().__init__()
        self.res_conv = nn.ModuleList(ResidualMLP(width) for _ in range(2))
        self.more_mlps = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.fc_t = nn.Linear(width, 3)
        self.fc_rot = nn.Linear(width, 9)

    def forward(self, tokens: Float[Tensor, "b t c"]) -> Float[Tensor, "b 4 4"]:
        """Camera-to-world matrices (x right, y down, z forward), up to a common similarity transform."""
        for block in self.res_conv:
            tokens = block(tokens)
        pooled = self.more_mlps(tokens.mean(1))
        pose = torch.zeros(len(tokens), 4, 4, dtype=pooled.dtype, device=pooled.device)
        pose[:, :3, :3] = orthogonal(self.fc_rot(pooled))
        pose[:, :3, 3] = self.fc_t(pooled)
        pose[:, 3, 3] = 1
        return pose


def orthogonal(nine: Float[Tensor, "b 9"]) -> Float[Tensor, "b 3 3"]:
    """Rotations from nine numbers: the rotation nearest to the matrix with rows normalised.

    Source: Levinson et al. 2020, "An analysis of SVD for deep rotation estimation", eq. 3.
    """
    rows = F.normalize(nine.float().unflatten(-1, (3, 3)), dim=-1)
    return nearest_rotation(rows)
