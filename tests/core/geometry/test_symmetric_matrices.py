"""Eigenvectors of batches of small symmetric matrices, and solutions of systems of equations."""

import subprocess
import sys

import numpy as np
import pytest
import torch

from stages.core.geometry.symmetric_matrices import BATCH, PAIRS, eigh, least_directions, symmetric_solve


def test_more_matrices_than_the_solver_takes_at_once(device):
    count = 2_000_003 if device == "cuda" else BATCH + 3  # the larger number is that of the voxels of a large scene
    A = torch.rand(count, 3, 3, generator=torch.Generator().manual_seed(0)).to(device) - 0.5
    A = A + A.mT
    values, vectors = eigh(A)
    assert (values.diff(dim=1) >= 0).all()
    torch.testing.assert_close(A @ vectors, vectors * values[:, None], atol=3e-6, rtol=0)
    torch.testing.assert_close(vectors.mT @ vectors, torch.eye(3, device=device).expand_as(A), atol=3e-6, rtol=0)


@pytest.mark.gpu
def test_first_calls_of_threads():
    """It runs in a new process, because PyTorch loads the solver on the first call."""
    subprocess.run([sys.executable, "-c", """
import threading, torch
from stages.core.geometry.symmetric_matrices import eigh
A, ready, done = torch.eye(3, device="cuda").expand(8, 3, 3), threading.Barrier(8), []
def work():
    ready.wait()
    done.append(eigh(A))
threads = [threading.Thread(target=work) for _ in range(8)]
for t in threads: t.start()
for t in threads: t.join()
assert len(done) == 8
"""], check=True)  # fmt: skip


@pytest.mark.parametrize("eigenvalues", [
    (0.2, 0.5, 1.0), (1e-9, 0.9, 1.0), (0.0, 1.0, 1.0), (1.0, 1.0, 1.0), (1e-3, 1e-3, 1.0), (1e-8, 1e-8, 1.0),
    (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (1e-24, 1e-20, 1e-20), (1 - 2e-9, 1 - 1e-9, 1.0),
])  # fmt: skip
def test_least_directions_are_those_of_lapack(eigenvalues):
    """Compared by the Rayleigh quotient: for two equal smallest eigenvalues any direction between them is valid."""
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(500, 3, 3)))[0]
    A = np.einsum("nij,j,nkj->nik", turn, eigenvalues, turn)
    A = (A + A.transpose(0, 2, 1)) / 2
    found = least_directions(A[:, PAIRS[0], PAIRS[1]])
    values, vectors = np.linalg.eigh(A)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-14)
    quotient = np.einsum("ni,nij,nj->n", found, A, found)
    np.testing.assert_allclose(quotient, values[:, 0], atol=1e-14 * max(eigenvalues))
    if eigenvalues[1] - eigenvalues[0] > 0.1 * max(eigenvalues):
        np.testing.assert_allclose(np.abs((found * vectors[:, :, 0]).sum(1)), 1, atol=1e-13)


def test_symmetric_solve_equals_linalg_solve():
    rng = torch.Generator().manual_seed(0)
    root = torch.randn(2, 5, 3, 3, generator=rng, dtype=torch.float64)
    M, x, y = root @ root.mT + 0.1 * torch.eye(3), *torch.randn(2, 2, 5, 3, generator=rng, dtype=torch.float64)
    for solution, b in zip(symmetric_solve(M, x, y), (x, y), strict=True):
        torch.testing.assert_close(solution, torch.linalg.solve(M, b[..., None])[..., 0])
