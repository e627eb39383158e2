"""Eigenvectors of, and linear systems with, many small symmetric matrices."""

from __future__ import annotations

import threading

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

BATCH = 1 << 14  # matrices per call: cuSOLVER fails for some hundred thousand, with an internal error or invalid value
PAIRS = np.array([[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])  # row and column of the six entries of a symmetric matrix
FULL = np.array([0, 3, 4, 3, 1, 5, 4, 5, 2])  # indices into PAIRS of the nine entries of the full matrix
ON_GPU = threading.Lock()  # PyTorch loads cuSOLVER in the first call, and fails if threads do so at once (#90613)
UNCLEAR = 1e-6  # length of the cross products of rows below which rounding matters [squared size of the matrix]


def eigh(matrices: Float[Tensor, "b n n"]) -> tuple[Float[Tensor, "b n"], Float[Tensor, "b n n"]]:
    """Eigenvalues in ascending order and eigenvectors in columns, as torch.linalg.eigh, for batches of any size."""
    if not matrices.is_cuda:
        return torch.linalg.eigh(matrices)
    with ON_GPU:
        values, vectors = zip(*(torch.linalg.eigh(part) for part in matrices.split(BATCH)), strict=True)
    return torch.cat(values), torch.cat(vectors)


def least_directions(matrices: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "n 3"]:
    """Unit eigenvectors for the smallest eigenvalue of symmetric 3 x 3 matrices, given by their entries in PAIRS.

    Computed in closed form, ten times as fast as LAPACK: the cross product of two rows of M - l I, where l is the
    smallest eigenvalue. Source: Smith 1961, "Eigenvalues of a symmetric 3 x 3 matrix".
    """
    xx, yy, zz, xy, xz, yz = np.ascontiguousarray(matrices.T)
    mean = (xx + yy + zz) / 3
    xx, yy, zz = xx - mean, yy - mean, zz - mean
    size = np.sqrt((xx * xx + yy * yy + zz * zz + 2 * (xy * xy + xz * xz + yz * yz)) / 6)
    det = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    least = 2 * size * np.cos((np.arccos((det / (2 * size**3).clip(1e-300)).clip(-1, 1)) + 2 * np.pi) / 3)
    xx, yy, zz = xx - least, yy - least, zz - least
    across = np.array([[xy * yz - xz * yy, xz * xy - xx * yz, xx * yy - xy * xy],
                       [yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz],
                       [yz * xz - zz * xy, zz * xx - xz * xz, xz * xy - yz * xx]])  # fmt: skip
    length = np.sqrt((across**2).sum(1))
    best = length.argmax(0)
    row = np.arange(len(best))
    length = length[best, row]
    out = across[best, :, row] / length.clip(1e-300)[:, None]
    unclear = length <= UNCLEAR * size**2  # the two smaller eigenvalues are about equal
    out[unclear] = np.linalg.eigh(matrices[unclear][:, FULL].reshape(-1, 3, 3))[1][:, :, 0]
    return out


def symmetric_solve(M: Float[Tensor, "*b 3 3"], *x: Float[Tensor, "*b 3"]) -> list[Float[Tensor, "*b 3"]]:
    """M^-1 x for each x, by Cramer's rule; unlike torch.linalg.solve, it can be captured in a CUDA graph."""
    a, b, c = M.unbind(-2)
    ab, bc, ca = torch.linalg.cross(a, b), torch.linalg.cross(b, c), torch.linalg.cross(c, a)
    det = (a * bc).sum(-1, keepdim=True)
    return [(v[..., :1] * bc + v[..., 1:2] * ca + v[..., 2:] * ab) / det for v in x]
