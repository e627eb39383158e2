"""Normals, spacings and inverses against a table of all distances and LAPACK, in double precision."""

import pytest
import torch

from stages.core.kernels.field.normals import invert_spd, normals_and_spacing, normals_and_spacing_reference
from tests.core.models.worlds import crowd, padded


@pytest.mark.parametrize("world", [
    crowd(2, 3, 70), padded(crowd(2, 3, 70), 1, 3), crowd(1, 2, 7), crowd(1, 1, 2), crowd(1, 1, 1)
], ids=["many", "padded", "few", "two", "one"])  # fmt: skip
@pytest.mark.parametrize("dtype, near", [(torch.float64, 1e-12), (torch.float32, 1e-6)])
def test_they_are_those_of_the_table(world, dtype, near, device):
    found = normals_and_spacing(world.points.to(device, dtype), world.valid.to(device))
    normal, spacing = (x.double().cpu() for x in found)
    wanted, apart = normals_and_spacing_reference(world.points.to(dtype).double(), world.valid)
    if world.points.shape[2] > 2:  # of fewer any is as good
        assert (1 - (normal * wanted).sum(-1).abs())[world.valid].abs().max() < near  # either way round
    assert (normal.norm(dim=-1) - world.valid.double()).abs().max() < near
    torch.testing.assert_close(spacing, apart, rtol=near, atol=1e-12)


def test_the_normal_of_a_bent_sheet_is_its_own(device):
    rng = torch.Generator().manual_seed(0)
    x, y = torch.rand(2, 2000, generator=rng, dtype=torch.float64).unbind(0)
    points = torch.stack([x, y, x.square() / 2], -1).to(device)
    normal, _ = normals_and_spacing(points[None, None], torch.ones(1, 1, 2000, dtype=torch.bool, device=device))
    true = torch.nn.functional.normalize(torch.stack([-x, 0 * x, 1 + 0 * x], -1), dim=-1).to(device)
    inside = ((points[:, :2] - 0.5).abs() < 0.4).all(-1)
    assert (normal[0, 0] * true).sum(-1).abs()[inside].min() > 0.999


def test_inverses_are_lapack_s(device):
    rng = torch.Generator().manual_seed(0)
    turn = torch.linalg.qr(torch.randn(2, 50, 3, 3, generator=rng, dtype=torch.float64)).Q
    extent = 10 ** (3 * torch.rand(2, 50, 3, generator=rng, dtype=torch.float64) - 4)  # as of rods
    extent[0, 0] = 1e-6  # a point has the same about all axes
    matrix = (turn * extent[..., None, :]) @ turn.mT
    inverse, values = (x.cpu() for x in invert_spd(matrix.to(device)))
    torch.testing.assert_close(inverse @ matrix, torch.eye(3).double().expand_as(matrix), rtol=0, atol=1e-11)
    torch.testing.assert_close(values, torch.linalg.eigvalsh(torch.linalg.inv(matrix)), rtol=1e-11, atol=0)
