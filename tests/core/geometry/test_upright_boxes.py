"""Longest sides of upright bounding boxes, which may be rotated about the vertical."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from stages.core.geometry.upright_boxes import longest_side
from stages.lab.assets.shapes import ellipsoid


@pytest.mark.parametrize("sides", [(0.3, 0.2, 0.1), (0.2, 0.2, 0.1), (0.1, 0.2, 0.4)])
def test_of_a_box_turned_about_the_vertical(sides):
    """The axis-aligned bounding box of a box with sides 0.3, 0.2 and 0.1 would have sides up to 0.36."""
    points = torch.cartesian_prod(*(torch.tensor([0.0, side], dtype=torch.float64) for side in sides))
    lengths = [longest_side(points @ turned(angle)) for angle in np.linspace(0, 7, 20)]
    np.testing.assert_allclose(lengths, max(sides), rtol=1e-9)


def turned(angle: float) -> torch.Tensor:
    return torch.from_numpy(Rotation.from_rotvec([0, 0, angle]).as_matrix()).T


def test_does_not_depend_on_the_axes_for_other_shapes():
    """Test an egg, random points, and a triangle, for which the boxes along each of its sides have equal area."""
    rng = torch.Generator().manual_seed(0)
    triangle = torch.tensor([[0.0, 0, 0], [0.3, 0, 0], [0.1, 0.25, 0]]).double()
    for points in (
        ellipsoid((0.1, 0.2, 0.05), 500).points.double(),
        torch.rand(40, 3, generator=rng).double(),
        triangle,
    ):
        lengths = [longest_side(points @ turned(angle)) for angle in np.linspace(0, 7, 20)]
        np.testing.assert_allclose(lengths, lengths[0], rtol=1e-9)


def test_of_points_on_a_line_and_of_one():
    line = torch.linspace(0, 1, 5)[:, None] * torch.tensor([0.3, 0.4, 0.1])
    assert longest_side(line) == pytest.approx(0.5)
    assert longest_side(torch.eye(3)[2:] * torch.tensor([[0.0], [2.0]])) == pytest.approx(2)
    assert longest_side(torch.zeros(1, 3)) == 0
    assert longest_side(torch.tensor([[0.0, 0, 0], [0.3, 0.4, 0.0]])) == pytest.approx(math.hypot(0.3, 0.4))
