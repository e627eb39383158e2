"""LightGlue: matches the keypoints of two images by attention within and between the images.

Source: Lindenberger et al. 2023, "LightGlue: Local feature matching at light speed", for ALIKED's descriptors.
Modules have the published names, so that the published weights load. Inference stops early at the layer where nearly
all keypoints are confident; keypoints are not pruned.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

INPUT, DIM, HEADS, LAYERS = 128, 256, 4, 9
MIN_PROBABILITY = 0.1  # smallest probability of a match
CONFIDENT_FRACTION = 0.95  # fraction of confident keypoints above which inference stops early


def _ffn() -> nn.Sequential:
    return nn.Sequential(nn.Linear(2 * DIM, 2 * DIM), nn.LayerNorm(2 * DIM), nn.GELU(), nn.Linear(2 * DIM, DIM))


def _heads(x: Float[Tensor, "n d"]) -> Float[Tensor, "h n e"]:
    return x.unflatten(1, (HEADS, -1)).transpose(0, 1)


def _attend(q: Tensor, k: Tensor, v: Tensor) -> Float[Tensor, "n d"]:
    return F.scaled_dot_product_attention(q[None], k[None], v[None])[0].transpose(0, 1).flatten(1)


class Position(nn.Module):
    """Rotary position embedding with learned frequencies."""

    def __init__(self):
        super().__init__()
        self.Wr = nn.Linear(2, DIM // HEADS // 2, bias=False)

    def forward(self, keypoints: Float[Tensor, "n 2"]) -> tuple[Tensor, Tensor]:
        """Return cosine and sine of the rotation angles, each (n, DIM / HEADS), at normalised keypoint positions."""
        angle = self.Wr(keypoints).repeat_interleave(2, 1)
        return angle.cos(), angle.sin()


def _rotated(x: Float[Tensor, "h n e"], position: tuple[Tensor, Tensor]) -> Float[Tensor, "h n e"]:
    """Features with the rotary embedding applied. Source: Su et al. 2021, "RoFormer"."""
    a, b = x.unflatten(-1, (-1, 2)).unbind(-1)
    return x * position[0] + torch.stack([-b, a], -1).flatten(-2) * position[1]


class SelfBlock(nn.Module):
    """Attention among the keypoints of one image."""

    def __init__(self):
        super().__init__()
        self.Wqkv, self.out_proj, self.ffn = nn.Linear(DIM, 3 * DIM), nn.Linear(DIM, DIM), _ffn()

    def forward(self, x: Float[Tensor, "n d"], position: tuple[Tensor, Tensor]) -> Float[Tensor, "n d"]:
        """Updated features; `position` as returned by `Position`."""
        q, k, v = self.Wqkv(x).unflatten(1, (HEADS, -1, 3)).permute(3, 1, 0, 2)
        message = self.out_proj(_attend(_rotated(q, position), _rotated(k, position), v))
        return x + self.ffn(torch.cat([x, message], 1))


class CrossBlock(nn.Module):
    """Attention to the keypoints of the other image; queries and keys share one projection."""

    def __init__(self):
        super().__init__()
        self.to_qk, self.to_v, self.to_out = (nn.Linear(DIM, DIM) for _ in range(3))
        self.ffn = _ffn()

    def forward(self, a: Float[Tensor, "n d"], b: Float[Tensor, "m d"]) -> tuple[Tensor, Tensor]:
        """Updated features of both images, each attending to the other; shapes as the inputs."""
        qk = [_heads(self.to_qk(x)) for x in (a, b)]
        v = [_heads(self.to_v(x)) for x in (a, b)]
        messages = self.to_out(_attend(qk[0], qk[1], v[1])), self.to_out(_attend(qk[1], qk[0], v[0]))
        return tuple(x + self.ffn(torch.cat([x, m], 1)) for x, m in zip((a, b), messages, strict=True))


class Layer(nn.Module):
    """Attention within each image, then between them."""

    def __init__(self):
        super().__init__()
        self.self_attn, self.cross_attn = SelfBlock(), CrossBlock()

    def forward(self, a: Tensor, b: Tensor, at_a: tuple, at_b: tuple) -> tuple[Tensor, Tensor]:
        """Updated features of both images; `at_a` and `at_b` are their rotary embeddings."""
        return self.cross_attn(self.self_attn(a, at_a), self.self_attn(b, at_b))


class Assignment(nn.Module):
    """Log probability of matches: dual softmax of similarities times the matchabilities of both keypoints."""

    def __init__(self):
        super().__init__()
        self.matchability, self.final_proj = nn.Linear(DIM, 1), nn.Linear(DIM, DIM)

    def forward(self, a: Float[Tensor, "n d"], b: Float[Tensor, "m d"]) -> Float[Tensor, "n m"]:
        """Log match probability of every pair of keypoints. Source: Lindenberger et al. 2023, "LightGlue"."""
        alike = self.final_proj(a) @ self.final_proj(b).mT / DIM**0.5
        matched = F.logsigmoid(self.matchability(a)) + F.logsigmoid(self.matchability(b)).mT
        return alike.log_softmax(0) + alike.log_softmax(1) + matched


class Confidence(nn.Module):
    """Confidence that later layers would not change a keypoint's match."""

    def __init__(self):
        super().__init__()
        self.token = nn.Sequential(nn.Linear(DIM, 1), nn.Sigmoid())


class LightGlue(nn.Module):
    """The network; `match` is its public method."""

    def __init__(self):
        super().__init__()
        self.input_proj, self.posenc = nn.Linear(INPUT, DIM), Position()
        self.transformers = nn.ModuleList(Layer() for _ in range(LAYERS))
        self.log_assignment = nn.ModuleList(Assignment() for _ in range(LAYERS))
        self.token_confidence = nn.ModuleList(Confidence() for _ in range(LAYERS - 1))

    @torch.no_grad()
    def match(
        self,
        keypoints: tuple[Float[Tensor, "n 2"], Float[Tensor, "m 2"]],
        descriptors: tuple[Float[Tensor, "n f"], Float[Tensor, "m f"]],
        sizes: tuple[tuple[int, int], tuple[int, int]],
    ) -> Int[Tensor, "k 2"]:
        """Match keypoints [px] of two images; returns rows (index in the first, index in the second image).

        `sizes` are (width, height) of the images [px].
        """
        if min(len(keypoints[0]), len(keypoints[1])) == 0:
            return torch.zeros(0, 2, dtype=torch.int64, device=keypoints[0].device)
        positions = [self.posenc(normalised(k, size)) for k, size in zip(keypoints, sizes, strict=True)]
        a, b = (self.input_proj(d) for d in descriptors)
        for i, layer in enumerate(self.transformers):
            a, b = layer(a, b, *positions)
            if i == LAYERS - 1 or self._confident(torch.cat([a, b]), i):
                return mutual(self.log_assignment[i](a, b).exp())
        raise AssertionError("unreachable: the last layer returns")

    def _confident(self, x: Float[Tensor, "n d"], layer: int) -> bool:
        threshold = 0.8 + 0.1 * math.exp(-4 * layer / LAYERS)
        return float((self.token_confidence[layer].token(x) >= threshold).float().mean()) > CONFIDENT_FRACTION


def normalised(keypoints: Float[Tensor, "n 2"], size: tuple[int, int]) -> Float[Tensor, "n 2"]:
    """Positions relative to the image centre, scaled so that the longer side is from -1 to 1."""
    return (keypoints - torch.tensor(size).to(keypoints) / 2) / (max(size) / 2)


def mutual(probability: Float[Tensor, "n m"]) -> Int[Tensor, "k 2"]:
    """Return mutual best matches with more than MIN_PROBABILITY, as pairs of indices."""
    value, to_b = probability.max(1)
    rows = torch.arange(len(value), device=value.device)
    keep = (probability.argmax(0)[to_b] == rows) & (value > MIN_PROBABILITY)
    return torch.stack([rows[keep], to_b[keep]], 1)
