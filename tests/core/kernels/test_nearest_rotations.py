"""Nearest rotations, compared with the singular value decomposition."""

import pytest
import torch

from stages.core.geometry.rotations import matrix, nearest_rotation
from stages.core.kernels.nearest_rotations import nearest_rotations

RNG = torch.Generator().manual_seed(0)
TURNS = matrix(torch.randn(500, 4, generator=RNG, dtype=torch.float64))
STRETCHES = TURNS.roll(1, 0) @ torch.diag_embed(torch.rand(500, 3, generator=RNG, dtype=torch.float64) + 0.1)
MATRICES = {
    "rotations": TURNS,
    "any": torch.randn(500, 3, 3, generator=RNG, dtype=torch.float64),  # half of them are inverted
    "stretched": TURNS @ STRETCHES @ TURNS.roll(1, 0).mT,
    "flat": TURNS @ torch.diag_embed(torch.tensor([1.0, 0.5, 1e-6], dtype=torch.float64)),
    "tiny": 1e-12 * TURNS @ STRETCHES @ TURNS.roll(1, 0).mT,
}


@pytest.mark.parametrize("kind", MATRICES)
def test_equals_the_singular_value_decomposition(kind, device):
    M = MATRICES[kind]
    exact, found = nearest_rotation(M), nearest_rotations(M.to(device)).cpu()
    torch.testing.assert_close(found, exact, rtol=0, atol=1e-9)
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(500, dtype=torch.float64), rtol=0, atol=1e-12)
    single = nearest_rotations(M.float().to(device)).cpu()
    torch.testing.assert_close(single, exact.float(), rtol=0, atol=1e-5)


def test_nothing_is_not_turned(device):
    zero = torch.zeros(2, 3, 3, device=device)
    assert torch.equal(nearest_rotations(zero).cpu(), torch.eye(3).expand(2, 3, 3))
    assert nearest_rotations(zero[:0]).shape == (0, 3, 3)
