"""The skinning kernel, compared with its PyTorch reference."""

from dataclasses import replace

import pytest
import torch

from stages.core.geometry.rotations import covariance
from stages.core.kernels.skinning import KeypointMotion, skin_gaussians, skin_gaussians_reference
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.trajectory import Binding
from tests.conftest import DEVICES


def random_inputs(device: str, n: int = 1000, p: int = 40) -> tuple[Binding, KeypointMotion, Gaussians]:
    rng = torch.Generator().manual_seed(0)
    index = torch.randint(-1, p, (n, 8), generator=rng, dtype=torch.int32)
    weight = torch.rand(n, 8, generator=rng)
    weight = weight / weight.sum(1, keepdim=True)
    gradient = 0.4 * torch.randn(p, 3, 3, generator=rng)
    quats = torch.nn.functional.normalize(torch.randn(n, 4, generator=rng), dim=1)
    scales = 10 ** (-1 - 2 * torch.rand(n, 3, generator=rng))  # aspect ratios of up to 100
    rest, displacement, means = (torch.randn(m, 3, generator=rng) for m in (p, p, n))
    motion = KeypointMotion(*(t.to(device) for t in (rest, displacement, gradient)))
    g = Gaussians(means, quats, scales, torch.ones(n), torch.zeros(n, 1, 3), torch.ones(n, dtype=torch.int64))
    return Binding(index.to(device), weight.to(device)), motion, g.to(device)


def in_double(binding: Binding, motion: KeypointMotion, g: Gaussians) -> tuple[Binding, KeypointMotion, Gaussians]:
    exact = {name: getattr(g, name).double() for name in ("means", "quats", "scales")}
    weights, motion = Binding(binding.index, binding.weight.double()), KeypointMotion(*(x.double() for x in motion))
    return weights, motion, replace(g, **exact)


@pytest.mark.parametrize("device", DEVICES)
def test_skinning_equals_its_reference(device):
    args = random_inputs(device)
    means, quats, scales, R = skin_gaussians(*args)
    exact = skin_gaussians_reference(*in_double(*args))
    torch.testing.assert_close(means.double(), exact[0], rtol=1e-5, atol=1e-5)
    # quats and scales of an ellipsoid are not unique, but their covariance is
    ours, theirs = covariance(quats.double(), scales.double()), covariance(exact[1], exact[2])
    size = theirs.flatten(1).abs().amax(1)[:, None, None]
    torch.testing.assert_close(ours / size, theirs / size, rtol=0, atol=2e-5)
    F = exact_gradient(*in_double(*args)[:2])
    regular = (torch.linalg.svdvals(F)[:, -1] > 0.1) & (torch.linalg.det(F) > 1e-3)  # others have ill-defined rotations
    torch.testing.assert_close(R.double()[regular], exact[3][regular], rtol=0, atol=1e-4)


def exact_gradient(binding: Binding, motion: KeypointMotion) -> torch.Tensor:
    weight, rows = torch.where(binding.index >= 0, binding.weight, 0), binding.index.clamp_min(0).long()
    return torch.eye(3).to(weight) + (weight[..., None, None] * motion.gradient[rows]).sum(1)


@pytest.mark.parametrize("device", DEVICES)
def test_zero_displacement_leaves_gaussians_bit_identical(device):
    binding, motion, g = random_inputs(device)
    still = KeypointMotion(motion.rest, 0 * motion.displacement, 0 * motion.gradient)
    unmoved = skin_gaussians(binding, still, g)
    for got, given in zip(unmoved, (g.means, g.quats, g.scales), strict=False):
        assert torch.equal(got, given)
    assert torch.equal(unmoved[3], torch.eye(3).to(device).expand(len(g), 3, 3))


@pytest.mark.parametrize("n", [0, 1, 2])
def test_very_few_gaussians(n):
    args = random_inputs("cpu", n=n)
    assert [len(t) for t in skin_gaussians(*args)] == [n] * 4
