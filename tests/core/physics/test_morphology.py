"""Morphology of voxel masks, compared with scipy.ndimage."""

import numpy as np
import pytest
from scipy import ndimage

from stages.core.physics.morphology import dilated, eroded, opened, squared_distances, surrounded, within

CUBE = np.ones((3, 3, 3), bool)


@pytest.fixture(params=[0.02, 0.5, 0.9])
def mask(request) -> np.ndarray:
    return np.random.default_rng(0).random((7, 12, 9)) < request.param


def test_neighbourhoods_are_those_of_scipy(mask):
    for n in (1, 2):
        assert (dilated(mask, n) == ndimage.binary_dilation(mask, iterations=n)).all()
        assert (eroded(mask, n) == ndimage.binary_erosion(mask, iterations=n)).all()
        assert (surrounded(mask, n) == ndimage.binary_dilation(mask, CUBE, iterations=n)).all()
    assert (opened(mask) == ndimage.binary_opening(mask, CUBE[:2, :2, :2])).all()


@pytest.mark.parametrize("most", [1, 5, 12])
def test_squared_distances_are_exact_up_to_a_limit(mask, most):
    exact = np.round(ndimage.distance_transform_edt(~mask) ** 2)
    assert (squared_distances(mask, most) == np.minimum(exact, most**2 + 1)).all()


def test_distances_in_an_empty_grid_are_beyond_the_limit():
    assert (squared_distances(np.zeros((3, 3, 3), bool), 4) == 17).all()


@pytest.mark.parametrize("radius", [1, 3])
def test_within_is_dilation_by_a_ball(mask, radius):
    x = np.indices((2 * radius + 1,) * 3) - radius
    assert (within(mask, radius) == ndimage.binary_dilation(mask, (x**2).sum(0) <= radius**2)).all()
