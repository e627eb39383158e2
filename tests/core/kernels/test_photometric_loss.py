"""The fused photometric loss, compared with plain PyTorch."""

import pytest
import torch

from stages.core.kernels.splat.photometric_loss import LossTerms, PhotoTarget, _Loss, photometric_loss_reference

TERMS = LossTerms(0.2, 0.1, 2.5, 0.25)
HEIGHT, WIDTH = 37, 50


def inputs(device: str) -> tuple:
    """Images with some equal values, and depths of which some are unknown or below the minimum."""
    rng = torch.Generator().manual_seed(0)
    photo = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=rng, dtype=torch.uint8)
    rgb = (photo.float() / 255 + 0.2 * torch.randn(HEIGHT, WIDTH, 3, generator=rng)).clamp_min(0)
    alpha, depth = torch.rand(2, HEIGHT, WIDTH, generator=rng)
    inverse = 1 + torch.rand(HEIGHT, WIDTH, generator=rng)
    inverse[torch.rand(HEIGHT, WIDTH, generator=rng) < 0.3] = torch.inf
    gain = torch.tensor([0.9, 1.0, 1.2])
    return tuple(t.to(device) for t in (rgb, alpha, 3 * depth, gain, photo, inverse))


@pytest.mark.parametrize("with_depth", [True, False])
def test_value_and_gradients_equal_the_reference(device, with_depth):
    rgb, alpha, depth, gain, photo, inverse = inputs(device)
    target = PhotoTarget(photo, inverse if with_depth else None)
    results = []
    for loss in (_Loss.apply, photometric_loss_reference):
        leaves = [t.clone().requires_grad_() for t in (rgb, depth, gain)]
        value = loss(leaves[0], alpha, leaves[1], leaves[2], target, TERMS)
        (3 * value).backward()
        results.append((value.detach(), *(t.grad if t.grad is not None else torch.zeros_like(t) for t in leaves)))
    fused, reference = results
    assert abs(float(fused[0] - reference[0])) < 1e-6 * float(reference[0]) + 1e-6
    for mine, theirs in zip(fused[1:], reference[1:], strict=True):
        assert float((mine - theirs).norm()) <= 1e-5 * float(theirs.norm())
    assert (float(fused[2].norm()) > 0) == with_depth
