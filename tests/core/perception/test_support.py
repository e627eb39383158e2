"""Focus and viewing distance of a scene without cameras, and closing of its surface."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage

from stages.core.perception.support import MAX_QUANTILE_POINTS, _closed, evenly_spaced, view_extent
from stages.core.scene.scene import Scene
from tests.conftest import random_gaussians


def test_evenly_spaced_keeps_extremes_and_quantiles():
    values = torch.rand(1001, generator=torch.Generator().manual_seed(0))
    some = evenly_spaced(values, 101)
    assert len(some) == 101 and some[0] == values.min() and some[-1] == values.max()
    # exact, because it is rank 800 of 1000
    torch.testing.assert_close(some.quantile(0.8), values.quantile(0.8), rtol=0, atol=1e-6)
    assert torch.equal(evenly_spaced(values, 1001), values)


def test_view_extent_of_many_gaussians_does_not_depend_on_random_state_or_order():
    g = random_gaussians(10)
    index = torch.arange(MAX_QUANTILE_POINTS + 20_001) % 10
    means = torch.randn(len(index), 3, generator=torch.Generator().manual_seed(0))
    many = replace(g[index], means=means, opacities=torch.ones(len(index)))
    state = torch.random.get_rng_state()
    first = view_extent(Scene(many))
    assert torch.equal(torch.random.get_rng_state(), state)
    assert view_extent(Scene(many)).radius == first.radius
    assert view_extent(Scene(many[torch.arange(len(many) - 1, -1, -1)])).radius == first.radius
    expected = 1.5 * float((means - first.focus).norm(dim=1).sort().values[int(0.8 * len(means))])
    assert abs(first.radius - expected) < 1e-3 * expected


@pytest.mark.parametrize("radius", [1, 4, 9])
def test_closing_by_distances_is_that_by_a_disc(radius):
    x = np.arange(-radius, radius + 1)
    disc = x[:, None] ** 2 + x[None] ** 2 <= radius**2
    for share in (0.0, 0.005, 0.1, 1.0):
        mask = np.random.default_rng(0).random((60, 45)) < share
        assert np.array_equal(_closed(mask, radius), ndimage.binary_closing(mask, disc))
