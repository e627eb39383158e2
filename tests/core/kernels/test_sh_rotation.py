"""Rotation of spherical harmonics, compared with the PyTorch implementation."""

import pytest
import torch

from stages.core.geometry.harmonics import rotate_sh
from stages.core.geometry.rotations import matrix
from stages.core.kernels.sh_rotation import rotate_each_sh


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 16, 1003])
def test_rotated_coefficients_equal_the_reference(degree, n, device):
    """The identity rotation also returns the input bitwise."""
    rng = torch.Generator().manual_seed(n + degree)
    sh = torch.randn(n, (degree + 1) ** 2, 3, generator=rng)
    R = matrix(torch.randn(n, 4, generator=rng))
    R[::3] = torch.eye(3)
    turned = rotate_each_sh(sh.to(device), R.to(device)).cpu()
    torch.testing.assert_close(turned, rotate_sh(sh.double(), R.double()).float(), rtol=0, atol=1e-5)
    assert torch.equal(turned[::3], sh[::3])


def test_coefficients_that_are_no_full_set_are_refused():
    with pytest.raises(ValueError, match="5 coefficients"):
        rotate_each_sh(torch.zeros(2, 5, 3), torch.eye(3).expand(2, 3, 3))
