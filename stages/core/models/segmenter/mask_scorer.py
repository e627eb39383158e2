"""A 3D convolutional network that looks at candidate objects and their surroundings and corrects their scores.

The idea is the score branch of PointGroup (Jiang et al. 2020) and of Mask Scoring R-CNN (Huang et al. 2019): the
network sees the mask itself, not only sums over it, and says how well it fits an object.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

CELLS = 24  # along each side of a crop
CHANNELS = 18  # of a crop, see crops.py
KNOWN = 35  # of a candidate besides: its normalised features, present log odds and the logarithm of the scale
WIDTHS = (24, 48, 64)
HIDDEN = 96
BATCH = 32  # crops at a time on a CPU


class _Residual(nn.Module):
    """Two convolutions with a residual."""

    def __init__(self, width: int):
        super().__init__()
        self.norms = nn.ModuleList([nn.GroupNorm(8, width), nn.GroupNorm(8, width)])
        self.convolutions = nn.ModuleList([nn.Conv3d(width, width, 3, padding=1) for _ in range(2)])

    def forward(self, x: Float[Tensor, "k c d d d"]) -> Float[Tensor, "k c d d d"]:
        y = x
        for norm, convolution in zip(self.norms, self.convolutions, strict=True):
            y = convolution(nn.functional.relu(norm(y)))
        return x + y


class MaskScorer(nn.Module):
    """Log odds of the IoU of candidates from dense crops; untrained, those given."""

    def __init__(self):
        super().__init__()
        inputs = (CHANNELS, *WIDTHS[:-1])
        self.downsample = nn.ModuleList(
            nn.Conv3d(a, b, 3, stride=2, padding=1) for a, b in zip(inputs, WIDTHS, strict=True)
        )
        self.blocks = nn.ModuleList(_Residual(width) for width in WIDTHS)
        self.head = nn.Sequential(nn.Linear(2 * WIDTHS[-1] + KNOWN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 1))
        nn.init.zeros_(self.head[-1].weight)
        nn.init.zeros_(self.head[-1].bias)

    def forward(
        self, crops: Float[Tensor, "k c d d d"], known: Float[Tensor, "k f"], odds: Float[Tensor, "k"]
    ) -> Float[Tensor, "k"]:
        """Corrected log odds; `known` are the features of the candidates, `odds` the scores from them alone."""
        x = crops
        for downsample, block in zip(self.downsample, self.blocks, strict=True):
            x = block(downsample(x))
        x = x.flatten(2)
        return odds + self.head(torch.cat([x.mean(2), x.amax(2), known.to(x.dtype)], 1))[:, 0]
