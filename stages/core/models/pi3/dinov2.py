"""DINOv2 vision transformer with registers: features of the patches of a photo.

Source: Oquab et al. 2023, "DINOv2"; Darcet et al. 2023, "Vision transformers need registers".
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stages.core.models.pi3.layers import EPS, ViTBlock

PATCH = 14  # side of a patch [px]
REGISTERS = 4  # register tokens


class PatchEmbed(nn.Module):
    """Linear projection of patches."""

    def __init__(self, width: int):
        super().__init__()
        self.proj = nn.Conv2d(3, width, PATCH, stride=PATCH)


class DinoV2(nn.Module):
    """The encoder; `table` is the side of the grid of learned position embeddings [patches]."""

    def __init__(self, width: int, head: int, depth: int, table: int = 37):
        super().__init__()
        self.table = table
        self.cls_token = nn.Parameter(torch.zeros(1, 1, width))
        self.pos_embed = nn.Parameter(torch.zeros(1, table * table + 1, width))
        self.register_tokens = nn.Parameter(torch.zeros(1, REGISTERS, width))
        self.patch_embed = PatchEmbed(width)
        self.blocks = nn.ModuleList(ViTBlock(width, head, scaled=True) for _ in range(depth))
        self.norm = nn.LayerNorm(width, EPS)

    def forward(self, images: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b t c"]:
        """Tokens of normalised images with sides that are multiples of 14: class, registers, patches in row order."""
        maps = self.patch_embed.proj(images)
        patches = maps.flatten(2).mT + self._position_embeddings(*maps.shape[2:]).to(maps.dtype)
        first = self.cls_token + self.pos_embed[:, :1]
        parts = first, self.register_tokens, patches
        x = torch.cat([part.expand(len(images), -1, -1).to(patches.dtype) for part in parts], 1)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)

    def _position_embeddings(self, rows: int, columns: int) -> Float[Tensor, "1 t c"]:
        """The learned position embeddings, resampled to the grid of patches."""
        table = self.pos_embed[:, 1:]
        if (rows, columns) == (self.table, self.table):
            return table
        square = table.unflatten(1, (self.table, self.table)).permute(0, 3, 1, 2).float()
        return F.interpolate(square, (rows, columns), mode="bicubic", antialias=True).flatten(2).mT
