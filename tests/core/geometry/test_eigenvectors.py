"""Eigenvectors of many small symmetric matrices."""

import torch

from stages.core.geometry.eigenvectors import BATCH, eigh


def test_more_matrices_than_the_solver_takes_at_once(device):
    count = 2_000_003 if device == "cuda" else BATCH + 3  # on a GPU as many as a large scene has voxels
    A = torch.rand(count, 3, 3, generator=torch.Generator().manual_seed(0)).to(device) - 0.5
    A = A + A.mT
    values, vectors = eigh(A)
    assert (values.diff(dim=1) >= 0).all()
    torch.testing.assert_close(A @ vectors, vectors * values[:, None], atol=3e-6, rtol=0)
    torch.testing.assert_close(vectors.mT @ vectors, torch.eye(3, device=device).expand_as(A), atol=3e-6, rtol=0)
