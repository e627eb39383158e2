"""Removal of outliers."""

from dataclasses import replace

import pytest
import torch

from stages.core.geometry.neighbours import knn
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.refine.outliers import MIN_LOG_SPACING_MAD, floaters, modified_z_score
from tests.segment.tabletop import block, egg


def with_floaters(body: Gaussians, count: int = 60) -> Gaussians:
    """A body with stray Gaussians around it, single or in pairs, as caused by wrong matches."""
    rng = torch.Generator().manual_seed(0)
    size = float((body.means.amax(0) - body.means.amin(0)).norm())
    out = torch.nn.functional.normalize(torch.randn(count, 3, generator=rng), dim=1)
    far = size * (0.8 + 2 * torch.rand(count, 1, generator=rng))
    stray = replace(body[torch.arange(count)], means=body.means.mean(0) + far * out)
    stray.means[1::2] = stray.means[::2] + 0.02 * size
    return concatenate([body, stray])


@pytest.mark.parametrize("kind", ["block", "egg", "rod"])
def test_no_outliers_beyond_three_robust_deviations_remain(kind):
    body = {
        "block": lambda: block((0.0, 0.0), (0.2, 0.16, 0.12), (0.8, 0.1, 0.1), 1),
        "egg": lambda: egg((0.0, 0.0, 0.1), (0.06, 0.06, 0.09), (0.1, 0.2, 0.8), 1),
        "rod": lambda: block((0.0, 0.0), (0.6, 0.03, 0.03), (0.1, 0.6, 0.2), 1),
    }[kind]()
    g = with_floaters(body)
    found = floaters(g)
    assert found[len(body) :].all()
    assert float(found[: len(body)].float().mean()) < 0.01
    left = g.means[~found]
    far = modified_z_score((left - left.median(0).values).norm(dim=1))
    alone = modified_z_score(knn(left, left, 9)[0][:, -1].log(), MIN_LOG_SPACING_MAD)
    assert not ((far > 3) & (alone > 3)).any()
