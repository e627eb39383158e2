"""Rotation-equivariant layers: an MLP on the inner products of vectors, whose outputs weight the same vectors.

Source: Villar et al. 2021, "Scalars are universal: equivariant machine learning, structured like classical physics".
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import silu

from stages.core.kernels.compilers import TRITON
from stages.core.models.field.kernel_choice import kernels_allowed, triton_allowed

if TRITON:
    from stages.core.kernels.field.perceptron import MAX_LAYER_WIDTH, perceptron


def inner_products(vectors: Float[Tensor, "*b k 3"]) -> Float[Tensor, "*b g"]:
    """asinh of all g = k (k + 1) / 2 inner products; asinh compresses large values to about their logarithm."""
    k = vectors.shape[-2]
    row, column = torch.triu_indices(k, k, device=vectors.device)
    # index_select, because the backward pass of plain indexing sorts, which takes longer than everything else here
    if vectors.is_cuda:
        return torch.asinh((vectors.index_select(-2, row) * vectors.index_select(-2, column)).sum(-1))
    xyz = vectors.reshape(-1, k, 3).permute(2, 1, 0).contiguous()  # a CPU copies long rows faster than rows of three
    inner = sum(x.index_select(0, row) * x.index_select(0, column) for x in xyz)
    return _asinh(inner).mT.reshape(*vectors.shape[:-2], len(row))


def _asinh(x: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """asinh; without gradients by the formula of the GPU kernels: 0.8 instead of 3.6 ms for 480,000 (Intel Xeon).

    The faster formula is log(sqrt(x^2 + 1) + |x|) with the sign of x.
    """
    if not kernels_allowed(x):
        return torch.asinh(x)
    return x.square().add_(1).sqrt_().add_(x.abs()).log_().copysign_(x)


def weighted_sum(weights: Float[Tensor, "*b k"], vectors: Float[Tensor, "*b k 3"]) -> Float[Tensor, "*b 3"]:
    """Sum of the k vectors times their weights."""
    return (weights[..., None] * vectors).sum(-2)


def matvec(M: Float[Tensor, "*#b 3 3"], x: Float[Tensor, "*#b 3"]) -> Float[Tensor, "*#b 3"]:
    """M x, as an elementwise product and a sum: for 3 x 3 faster than a BLAS call, and a compiler can fuse it."""
    return (M * x[..., None, :]).sum(-1)


def smooth_norm(x: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
    """sqrt(|x|^2 + 1e-12): the norm, differentiable at zero."""
    return (x.square().sum(-1) + 1e-12).sqrt()


def apply_layers(
    x: Float[Tensor, "*b i"], layers: Sequence[nn.Linear], vectors: Float[Tensor, "*b v 3"] | None = None,
    offset: Float[Tensor, "*#b k"] | None = None, active: bool = False, needed: Bool[Tensor, "*b"] | None = None,
) -> Float[Tensor, "*b j"]:  # fmt: skip
    """Apply linear layers with SiLU between them; one Triton kernel where `kernel_choice.triton_allowed`.

    x: input; the inner products of `vectors` are prepended to it.
    offset: added to the output of the first layer or, if `active`, to x; constant along the last batch dimension.
    active: apply SiLU to x + offset before the first layer.
    needed: rows whose result is needed; the kernel may return 0 in the others.
    """
    if triton_allowed(x) and len(layers) in (2, 3) and max(layer.out_features for layer in layers) <= MAX_LAYER_WIDTH:
        if offset is not None:
            offset = offset.expand(*x.shape[:-2], 1, offset.shape[-1]).flatten(0, -2)
        vectors = None if vectors is None else vectors.flatten(0, -3)
        needed = None if needed is None else needed.flatten()
        weights, biases = [layer.weight for layer in layers], [layer.bias for layer in layers]
        return perceptron(x.flatten(0, -2), weights, biases, vectors, offset, needed, active).unflatten(0, x.shape[:-1])
    if vectors is not None:
        x = torch.cat([inner_products(vectors), x], -1)
    offset = 0.0 if offset is None else offset
    y = layers[0](silu(x + offset)) if active else layers[0](x) + offset
    for layer in layers[1:]:
        y = layer(silu(y))
    return y


class Perceptron(nn.Sequential):
    """Linear, SiLU, Linear."""

    def forward(self, x: Float[Tensor, "*b i"]) -> Float[Tensor, "*b j"]:
        """Output of both layers, by one kernel where `apply_layers` allows it."""
        return apply_layers(x, (self[0], self[2]))


def mlp(inner: int, hidden: int, outer: int, output_scale: float = 1.0) -> Perceptron:
    """Build Linear, SiLU, Linear; the initial weights of the last layer are multiplied by `output_scale`."""
    last = nn.Linear(hidden, outer)
    with torch.no_grad():
        last.weight *= output_scale
        last.bias *= output_scale
    return Perceptron(nn.Linear(inner, hidden), nn.SiLU(), last)


def smooth_cutoff(x: Float[Tensor, "*b"], start: float, end: float) -> Float[Tensor, "*b"]:
    """1 below `start`, exactly 0 above `end`, a cubic smoothstep between."""
    s = ((end - x) / (end - start)).clamp(0, 1)
    return s * s * (3 - 2 * s)
