"""Normals, spacings and inverses, compared with the full distance matrix and LAPACK in double precision."""

import pytest
import torch

from stages.core.kernels.field.normals import invert_spd, normals_and_spacing, normals_and_spacing_reference
from tests.core.models.dynamics_fixtures import add_padding, overlapping_objects


@pytest.mark.parametrize("world", [
    overlapping_objects(2, 3, 70), add_padding(overlapping_objects(2, 3, 70), 1, 3),
    overlapping_objects(1, 2, 7), overlapping_objects(1, 1, 2), overlapping_objects(1, 1, 1)
], ids=["many", "padded", "few", "two", "one"])  # fmt: skip
@pytest.mark.parametrize("dtype, near", [(torch.float64, 1e-12), (torch.float32, 1e-6)])
def test_normals_and_spacing_equal_the_reference(world, dtype, near, device):
    found = normals_and_spacing(world.points.to(device, dtype), world.valid.to(device))
    normal, spacing = (x.double().cpu() for x in found)
    wanted, apart = normals_and_spacing_reference(world.points.to(dtype).double(), world.valid)
    if world.points.shape[2] > 2:  # with fewer points the normal is arbitrary
        assert (1 - (normal * wanted).sum(-1).abs())[world.valid].abs().max() < near  # the sign is arbitrary
    assert (normal.norm(dim=-1) - world.valid.double()).abs().max() < near
    torch.testing.assert_close(spacing, apart, rtol=near, atol=1e-12)


def test_normals_of_a_curved_sheet_equal_the_analytic_ones(device):
    rng = torch.Generator().manual_seed(0)
    x, y = torch.rand(2, 1000, generator=rng, dtype=torch.float64).unbind(0)
    points = torch.stack([x, y, x.square() / 2], -1).to(device)
    normal, _ = normals_and_spacing(points[None, None], torch.ones(1, 1, 1000, dtype=torch.bool, device=device))
    true = torch.nn.functional.normalize(torch.stack([-x, 0 * x, 1 + 0 * x], -1), dim=-1).to(device)
    inside = ((points[:, :2] - 0.5).abs() < 0.4).all(-1)
    assert (normal[0, 0] * true).sum(-1).abs()[inside].min() > 0.999


def test_inverses_and_eigenvalues_equal_lapack(device):
    rng = torch.Generator().manual_seed(0)
    rotation = torch.linalg.qr(torch.randn(2, 50, 3, 3, generator=rng, dtype=torch.float64)).Q
    extent = 10 ** (3 * torch.rand(2, 50, 3, generator=rng, dtype=torch.float64) - 4)  # widely separated eigenvalues
    extent[0, 0] = 1e-6  # a threefold eigenvalue
    matrix = (rotation * extent[..., None, :]) @ rotation.mT
    inverse, values = (x.cpu() for x in invert_spd(matrix.to(device)))
    torch.testing.assert_close(inverse @ matrix, torch.eye(3).double().expand_as(matrix), rtol=0, atol=1e-11)
    torch.testing.assert_close(values, torch.linalg.eigvalsh(torch.linalg.inv(matrix)), rtol=1e-11, atol=0)
