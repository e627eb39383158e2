"""The transformer block that all parts of the network use."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from stages.core.models.pi3.rope import RotaryEmbedding, rotate

EPS = 1e-6  # epsilon of the layer norms outside attention


class Attention(nn.Module):
    """Self-attention, optionally with rotary position embedding and normalised queries and keys."""

    def __init__(self, width: int, head: int, normalised: bool = False):
        super().__init__()
        self.head = head
        self.qkv = nn.Linear(width, 3 * width)
        self.proj = nn.Linear(width, width)
        self.q_norm = nn.LayerNorm(head) if normalised else nn.Identity()
        self.k_norm = nn.LayerNorm(head) if normalised else nn.Identity()
        self.attend = F.scaled_dot_product_attention  # does not store the t x t matrix; replaced in a benchmark

    def forward(self, x: Float[Tensor, "b t c"], positions: RotaryEmbedding | None = None) -> Float[Tensor, "b t c"]:
        """Attention among the t tokens of each sequence; `positions` are their rotary embeddings, if any."""
        q, k, v = self.qkv(x).unflatten(-1, (3, -1, self.head)).permute(2, 0, 3, 1, 4)  # each (b, heads, t, d)
        q, k = self.q_norm(q), self.k_norm(k)
        if positions is not None:
            q, k = rotate(q, positions), rotate(k, positions)
        out = self.attend(q.to(v.dtype), k.to(v.dtype), v)  # under autocast, norms and rotations are in 32 bit
        return self.proj(out.transpose(1, 2).flatten(2))


class MLP(nn.Module):
    """Linear, GELU, Linear."""

    def __init__(self, width: int, hidden: int):
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, width)

    def forward(self, x: Float[Tensor, "b t c"]) -> Float[Tensor, "b t c"]:
        """Transform each token separately; the width stays the same."""
        return self.fc2(F.gelu(self.fc1(x)))


class LayerScale(nn.Module):
    """A learned factor for each feature, initially small. Source: Touvron et al. 2021, "Going deeper with CaiT"."""

    def __init__(self, width: int, start: float = 0.01):
        super().__init__()
        self.gamma = nn.Parameter(torch.full((width,), start))

    def forward(self, x: Float[Tensor, "b t c"]) -> Float[Tensor, "b t c"]:
        """Tokens with each feature multiplied by its factor."""
        return x * self.gamma


class ViTBlock(nn.Module):
    """Pre-norm transformer block, optionally with LayerScale (`scaled`)."""

    def __init__(self, width: int, head: int, normalised: bool = False, scaled: bool = False):
        super().__init__()
        self.norm1 = nn.LayerNorm(width, EPS)
        self.attn = Attention(width, head, normalised)
        self.ls1 = LayerScale(width) if scaled else nn.Identity()
        self.norm2 = nn.LayerNorm(width, EPS)
        self.mlp = MLP(width, 4 * width)
        self.ls2 = LayerScale(width) if scaled else nn.Identity()

    def forward(self, x: Float[Tensor, "b t c"], positions: RotaryEmbedding | None = None) -> Float[Tensor, "b t c"]:
        """Tokens after attention and MLP, each with a residual connection; `positions` as in `Attention`."""
        x = x + self.ls1(self.attn(self.norm1(x), positions))
        return x + self.ls2(self.mlp(self.norm2(x)))
