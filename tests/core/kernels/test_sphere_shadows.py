"""Light blocked by spheres, compared with plain PyTorch."""

import pytest
import torch

from stages.core.kernels.sphere_shadows import Lamp, Spheres, blocked_light, blocked_light_reference

LAMPS = [Lamp((0.6, 0.0, 0.8), 0.2), Lamp((0.0, 0.0, 1.0), 0.6)]


def world(device: str, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor, Spheres]:
    """Points, and four objects of eight spheres; one is so large and near that the transmitted light would vanish."""
    rng = torch.Generator().manual_seed(0)
    points = torch.rand(3000, 3, generator=rng) * torch.tensor([2.0, 2.0, 0.5]) - torch.tensor([1.0, 1.0, 0.1])
    own = torch.randint(0, 6, (3000,), generator=rng)
    ids = torch.tensor([2, 5, 1, 3]).repeat_interleave(8)
    centres = torch.rand(32, 3, generator=rng) * 0.2 + torch.rand(4, 3, generator=rng).repeat_interleave(8, 0)
    radii = 0.02 + 0.05 * torch.rand(32, generator=rng)
    centres[:8], radii[:8] = torch.tensor([0.0, 0.0, 0.6]), 0.5
    weights = torch.tensor([0.9, 0.3, 1.0, 0.6]).repeat_interleave(8)
    spheres = Spheres(centres.to(dtype), radii.to(dtype), weights.to(dtype), ids)
    return points.to(device, dtype), own.to(device), spheres.to(device)


@pytest.mark.parametrize("lamp", LAMPS)
def test_equals_the_reference(device, lamp):
    exact = blocked_light_reference(*world("cpu", torch.float64), lamp).float()
    mine = blocked_light(*world(device), lamp).cpu()
    assert mine.shape == (3000, 2) and 0.05 < float(exact.mean()) < 0.95
    error = (mine - exact).abs()
    assert float(error.quantile(0.999)) < 1e-5  # except where rounding determines whether an object is near
    assert float(error.max()) < 0.02
    assert float(exact.max()) > 0.999


def test_no_points_and_no_spheres(device):
    points, own, spheres = world(device)
    assert blocked_light(points[:0], own[:0], spheres, LAMPS[0]).shape == (0, 2)
    none = Spheres(*(values[:0] for values in vars(spheres).values()))
    assert not blocked_light(points, own, none, LAMPS[0]).any()
