"""Merging of Gaussians."""

import dataclasses

import torch

from stages.core.geometry.rotations import covariance
from stages.reconstruct.merge import merge_gaussians
from tests.conftest import random_gaussians


def test_merging_keeps_mean_and_covariance():
    # Gaussians of equal weight at x = 0.1 and 0.3 have mean 0.2 and a variance along x that is increased by 0.1^2
    two = random_gaussians(2, degree=1)
    same = dataclasses.replace(
        two, means=torch.tensor([[0.1, 0.2, 0.2], [0.3, 0.2, 0.2]]), scales=torch.full((2, 3), 0.05),
        opacities=torch.tensor([0.6, 0.6]),
    )  # fmt: skip
    one = merge_gaussians(same, torch.full((2,), 0.05), 1)
    assert len(one) == 1
    torch.testing.assert_close(one.means[0], torch.tensor([0.2, 0.2, 0.2]))
    expected = torch.diag(torch.tensor([0.05**2 + 0.1**2, 0.05**2, 0.05**2]))
    torch.testing.assert_close(covariance(one.quats, one.scales)[0], expected, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(one.opacities, torch.tensor([0.6]))
    torch.testing.assert_close(one.sh[0], same.sh.mean(0))


def test_target_number_is_kept_and_few_are_unchanged():
    many = random_gaussians(4000)
    fewer = merge_gaussians(many, torch.full((4000,), 0.01), 500)
    assert 350 < len(fewer) <= 500
    torch.testing.assert_close(fewer.means.mean(0), many.means.mean(0), rtol=0, atol=0.05)
    assert merge_gaussians(many, torch.full((4000,), 0.01), 4000) is many


def test_near_gaussians_keep_more_detail():
    near, far = random_gaussians(2000), random_gaussians(2000, seed=1)
    both = dataclasses.replace(
        near, **{name: torch.cat([getattr(near, name), getattr(far, name)]) for name in
                 ("means", "quats", "scales", "opacities", "sh", "object_id")}
    )  # fmt: skip
    both.means[2000:, 0] += 10
    footprint = torch.cat([torch.full((2000,), 0.01), torch.full((2000,), 0.08)])
    fewer = merge_gaussians(both, footprint, 1000)
    assert (fewer.means[:, 0] < 5).sum() > 2 * (fewer.means[:, 0] > 5).sum()
