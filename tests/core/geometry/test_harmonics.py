import pytest
import torch
from scipy.special import sph_harm_y

from stages.core.geometry.harmonics import basis, degree_of, evaluate_sh, rgb_to_sh, rotate_sh
from stages.core.geometry.rotations import covariance, matrix
from stages.core.geometry.similarity import Similarity
from stages.core.scene.gaussians import transformed
from tests.conftest import random_gaussians


def random_dirs(n: int) -> torch.Tensor:
    dirs = torch.randn(n, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return dirs / dirs.norm(dim=1, keepdim=True)


def test_basis_agrees_with_scipy_up_to_convention():
    # scipy's complex harmonics carry the Condon-Shortley phase; the real ones used by 3D Gaussians are
    # sqrt(2) Im Y_l|m| for m < 0 and sqrt(2) Re Y_lm for m > 0.
    dirs = random_dirs(50)
    theta, phi = torch.arccos(dirs[:, 2]).numpy(), torch.atan2(dirs[:, 1], dirs[:, 0]).numpy()
    column = 0
    for l in range(4):
        for m in range(-l, l + 1):
            Y = sph_harm_y(l, abs(m), theta, phi)
            expected = Y.real if m == 0 else 2**0.5 * (Y.imag if m < 0 else Y.real)
            torch.testing.assert_close(basis(dirs, 3)[:, column], torch.from_numpy(expected))
            column += 1


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_coefficients_give_the_same_colour_in_the_rotated_direction(degree):
    rng = torch.Generator().manual_seed(2)
    sh = torch.randn(50, (degree + 1) ** 2, 3, generator=rng, dtype=torch.float64)
    R = matrix(torch.randn(50, 4, generator=rng, dtype=torch.float64))
    dirs = random_dirs(50)
    torch.testing.assert_close(evaluate_sh(rotate_sh(sh, R), (R @ dirs[..., None])[..., 0]), evaluate_sh(sh, dirs))


def test_degree_zero_is_constant_colour():
    rgb = torch.rand(5, 3)
    torch.testing.assert_close(evaluate_sh(rgb_to_sh(rgb), random_dirs(5).float()), rgb)


@pytest.mark.parametrize("degree", [0, 2])
def test_transformed_gaussians_have_their_colours_in_the_rotated_direction(degree):
    g = random_gaussians(20, degree=degree)
    similarity = Similarity(2.0, matrix(torch.tensor([0.8, 0.0, 0.6, 0.0])), torch.tensor([1.0, 2.0, 3.0]))
    moved, dirs = transformed(g, similarity), random_dirs(20).float()
    torch.testing.assert_close(moved.means, 2 * g.means @ similarity.rotation.T + similarity.translation)
    rotated = dirs @ similarity.rotation.T
    torch.testing.assert_close(evaluate_sh(moved.sh, rotated), evaluate_sh(g.sh, dirs), atol=1e-5, rtol=1e-5)
    R, C = similarity.rotation, covariance(g.quats, g.scales)
    torch.testing.assert_close(covariance(moved.quats, moved.scales), 4 * R @ C @ R.T, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("k", [0, 2, 3, 5, 15, 17, 25])
def test_incomplete_or_higher_bands_are_refused(k):
    with pytest.raises(ValueError, match=f"{k} coefficients"):
        degree_of(k)
