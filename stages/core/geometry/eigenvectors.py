"""Eigenvectors of many small symmetric matrices."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

BATCH = 1 << 14  # matrices at once: cuSOLVER fails for some hundred thousand, with an internal error or invalid value


def eigh(matrices: Float[Tensor, "b n n"]) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n n"]]:
    """Eigenvalues in ascending order and eigenvectors in columns, as torch.linalg.eigh, for a batch of any size."""
    if not matrices.is_cuda or len(matrices) <= BATCH:
        return torch.linalg.eigh(matrices)
    values, vectors = zip(*(torch.linalg.eigh(part) for part in matrices.split(BATCH)), strict=True)
    return torch.cat(values), torch.cat(vectors)
