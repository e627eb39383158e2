"""SSIM, compared with scipy, analytic values and finite differences."""

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from stages.core.kernels.splat import ssim_pixel
from stages.core.kernels.splat.ssim import ssim, ssim_reference

devices = ["cpu"] + (["cuda"] if torch.cuda.is_available() else [])
SIZES = [(37, 29, 3), (5, 3, 1), (64, 48, 3), (1, 1, 3), (12, 200, 4)]


def pair(shape, seed: int = 0):
    rng = torch.Generator().manual_seed(seed)
    first = torch.rand(shape, generator=rng)
    return first, (first + 0.2 * torch.randn(shape, generator=rng)).clamp(0, 1)


def scipy_ssim(first: np.ndarray, second: np.ndarray) -> float:
    """SSIM with scipy's filter: sigma 1.5, radius 5 pixels, zero padding."""

    def blur(image):
        return gaussian_filter(image, (1.5, 1.5, 0), truncate=5 / 1.5, mode="constant")

    mx, my = blur(first), blur(second)
    vx, vy, cov = blur(first**2) - mx**2, blur(second**2) - my**2, blur(first * second) - mx * my
    top = (2 * mx * my + 1e-4) * (2 * cov + 9e-4)
    return float((top / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))).mean())


@pytest.mark.parametrize("device", devices)
@pytest.mark.parametrize("shape", SIZES)
def test_value_equals_ssim_with_scipys_filter(device, shape):
    first, second = pair(shape)
    theirs = scipy_ssim(first.double().numpy(), second.double().numpy())
    assert float(ssim(first.to(device), second.to(device))) == pytest.approx(theirs, abs=2e-6)


@pytest.mark.parametrize("device", devices)
@pytest.mark.parametrize("shape", SIZES)
def test_gradients_by_both_images_equal_the_reference(device, shape):
    ours = [image.to(device).requires_grad_() for image in pair(shape)]
    exact = [image.detach().double().requires_grad_() for image in ours]
    mine = torch.autograd.grad(3 * ssim(*ours), ours)
    true = torch.autograd.grad(3 * ssim_reference(*exact), exact)
    for a, b in zip(mine, true, strict=True):
        assert float((a - b).norm() / b.norm()) < 1e-5


@pytest.mark.parametrize("device", devices)
@pytest.mark.parametrize("shape", SIZES)
def test_per_pixel_kernels_equal_the_reference(device, shape):
    first, second = (image.to(device) for image in pair(shape))
    leaf = first.clone().double().requires_grad_()
    true = ssim_reference(leaf, second.double())
    (grad,) = torch.autograd.grad(true, leaf)
    ssim_map, slopes = ssim_pixel.ssim_forward(first, second)
    assert float(ssim_map.mean()) == pytest.approx(float(true.detach()), abs=2e-6)
    assert float((ssim_pixel.ssim_backward(first, second, slopes) - grad).norm() / grad.norm()) < 1e-5


def test_gradient_equals_finite_differences():
    first, second = (image.double() for image in pair((9, 14, 3), seed=3))
    assert torch.autograd.gradcheck(lambda x: ssim_reference(x, second), first.requires_grad_())
    leaf = first.detach().float().requires_grad_()
    (grad,) = torch.autograd.grad(ssim(leaf, second.float()), leaf)
    step = torch.randn(first.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    h = 1e-4
    slope = (scipy_ssim((first + h * step).detach().numpy(), second.numpy())
             - scipy_ssim((first - h * step).detach().numpy(), second.numpy())) / (2 * h)  # fmt: skip
    assert float((grad.double() * step).sum()) == pytest.approx(slope, rel=1e-5)


def test_equal_images_have_ssim_one_and_zero_gradient():
    first, _ = pair((20, 20, 3))
    leaf = first.clone().requires_grad_()
    value = ssim(leaf, first)
    (grad,) = torch.autograd.grad(value, leaf)
    assert value.item() == pytest.approx(1, abs=1e-6) and grad.abs().max() < 1e-6


def test_black_against_white_equals_the_analytic_value():
    # interior: means 0 and 1, variance 0: C1 / (1 + C1); at the zero-padded border slightly more
    value = ssim(torch.zeros(31, 31, 1), torch.ones(31, 31, 1))
    assert float(value) == pytest.approx(scipy_ssim(np.zeros((31, 31, 1)), np.ones((31, 31, 1))), abs=1e-7)
    assert float(value) < 1e-3


def test_images_of_different_shape_raise():
    with pytest.raises(ValueError, match="different shape"):
        ssim(torch.zeros(3, 4, 3), torch.zeros(4, 3, 3))
