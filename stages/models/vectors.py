"""Networks that turn with the scene: numbers go in that no rotation changes, and weigh vectors that come out.

Source: Villar et al. 2021, "Scalars are universal: equivariant machine learning, structured like classical physics".
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn


def products(vectors: Float[Tensor, "*b k 3"]) -> Float[Tensor, "*b g"]:
    """All k (k + 1) / 2 inner products, those of large vectors compressed to their logarithm."""
    k = vectors.shape[-2]
    row, column = torch.triu_indices(k, k, device=vectors.device)
    return torch.asinh((vectors @ vectors.mT)[..., row, column])


def weigh(weights: Float[Tensor, "*b k"], vectors: Float[Tensor, "*b k 3"]) -> Float[Tensor, "*b 3"]:
    """The weighted sum of vectors."""
    return (weights[..., None] * vectors).sum(-2)


def length(x: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """The norm, with a gradient at zero."""
    return (x.square().sum(-1) + 1e-12).sqrt()


def mlp(inner: int, hidden: int, outer: int, quiet: float = 1.0) -> nn.Sequential:
    """Linear, SiLU, Linear; `quiet` scales what comes out at first."""
    last = nn.Linear(hidden, outer)
    with torch.no_grad():
        last.weight *= quiet
        last.bias *= quiet
    return nn.Sequential(nn.Linear(inner, hidden), nn.SiLU(), last)


def fade(x: Float[Tensor, "*b"], start: float, end: float) -> Float[Tensor, "*b"]:
    """1 below `start`, exactly 0 above `end`, smooth between."""
    s = ((end - x) / (end - start)).clamp(0, 1)
    return s * s * (3 - 2 * s)
