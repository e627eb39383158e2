"""Networks that turn with the scene: numbers go in that no rotation changes, and weigh vectors that come out.

Source: Villar et al. 2021, "Scalars are universal: equivariant machine learning, structured like classical physics".
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import silu

from stages.core.kernels.compilers import TRITON

if TRITON:
    from stages.core.kernels.field.perceptron import MAX_LAYER_WIDTH, perceptron


def inner_products(vectors: Float[Tensor, "*b k 3"]) -> Float[Tensor, "*b g"]:
    """All k (k + 1) / 2 inner products, those of large vectors compressed to their logarithm."""
    k = vectors.shape[-2]
    row, column = torch.triu_indices(k, k, device=vectors.device)
    # index_select: the gradient of plain indexing sorts, which takes longer than all the rest
    if vectors.is_cuda:
        return torch.asinh((vectors.index_select(-2, row) * vectors.index_select(-2, column)).sum(-1))
    xyz = vectors.reshape(-1, k, 3).permute(2, 1, 0).contiguous()  # a CPU copies long rows faster than triples
    inner = sum(x.index_select(0, row) * x.index_select(0, column) for x in xyz)
    return torch.asinh(inner).mT.reshape(*vectors.shape[:-2], len(row))


def weighted_sum(weights: Float[Tensor, "*b k"], vectors: Float[Tensor, "*b k 3"]) -> Float[Tensor, "*b 3"]:
    """The weighted sum of vectors."""
    return (weights[..., None] * vectors).sum(-2)


def matvec(M: Float[Tensor, "*#b 3 3"], x: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*#b 3"]:
    """M x. For so small a product a sum is faster than a call of a library, and a compiler can fuse it."""
    return (M * x[..., None, :]).sum(-1)


def symmetric_solve(M: Float[Tensor, "*b 3 3"], *x: Float[Tensor, "*b 3"]) -> list[Float[Tensor, "*b 3"]]:
    """M^-1 x of each x by Cramer's rule: unlike a call of a library it can be recorded in a CUDA graph."""
    a, b, c = M.unbind(-2)
    ab, bc, ca = torch.linalg.cross(a, b), torch.linalg.cross(b, c), torch.linalg.cross(c, a)
    det = (a * bc).sum(-1, keepdim=True)
    return [(v[..., :1] * bc + v[..., 1:2] * ca + v[..., 2:] * ab) / det for v in x]


def smooth_norm(x: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """The norm, with a gradient at zero."""
    return (x.square().sum(-1) + 1e-12).sqrt()


def apply_layers(
    x: Float[Tensor, "*b i"], layers: Sequence[nn.Linear], vectors: Float[Tensor, "*b v 3"] | None = None,
    known: Float[Tensor, "*#b k"] | None = None, active: bool = False, near: Bool[Tensor, "*b"] | None = None,
) -> Float[Tensor, "*b j"]:  # fmt: skip
    """Linear layers with SiLU between, in one kernel where that can be (on CUDA, without gradients).

    Products of `vectors` go before x. `known`, the same along the last of the dimensions b, is added to the result of
    the first layer, or, if `active`, to x, which is then activated too. Where not `near` the result may be 0 instead.
    """
    fused = TRITON and x.is_cuda and x.dtype == torch.float32 and not torch.is_grad_enabled()
    if fused and len(layers) in (2, 3) and max(layer.out_features for layer in layers) <= MAX_LAYER_WIDTH:
        if known is not None:
            known = known.expand(*x.shape[:-2], 1, known.shape[-1]).flatten(0, -2)
        vectors = None if vectors is None else vectors.flatten(0, -3)
        near = None if near is None else near.flatten()
        weights, biases = [layer.weight for layer in layers], [layer.bias for layer in layers]
        return perceptron(x.flatten(0, -2), weights, biases, vectors, known, near, active).unflatten(0, x.shape[:-1])
    if vectors is not None:
        x = torch.cat([inner_products(vectors), x], -1)
    known = 0.0 if known is None else known
    y = layers[0](silu(x + known)) if active else layers[0](x) + known
    for layer in layers[1:]:
        y = layer(silu(y))
    return y


class Perceptron(nn.Sequential):
    """Linear, SiLU, Linear."""

    def forward(self, x: Float[Tensor, "*b i"]) -> Float[Tensor, "*b j"]:
        return apply_layers(x, (self[0], self[2]))


def mlp(inner: int, hidden: int, outer: int, quiet: float = 1.0) -> Perceptron:
    """Linear, SiLU, Linear; `quiet` scales what comes out at first."""
    last = nn.Linear(hidden, outer)
    with torch.no_grad():
        last.weight *= quiet
        last.bias *= quiet
    return Perceptron(nn.Linear(inner, hidden), nn.SiLU(), last)


def smooth_cutoff(x: Float[Tensor, "*b"], start: float, end: float) -> Float[Tensor, "*b"]:
    """1 below `start`, exactly 0 above `end`, smooth between."""
    s = ((end - x) / (end - start)).clamp(0, 1)
    return s * s * (3 - 2 * s)
