"""Contacts between the sides of cylinders."""

import math

import numpy as np
import pytest
import torch

from stages.lab.assets.shapes import Surface
from stages.simulate.cylinder_contacts import side_contacts
from tests.core.physics.test_cylinder_fit import cylinder
from tests.simulate.test_rigid import roll

UP = [0.0, 0.0, 1.0]


def contacts(at, axis, radius: float = 1.0, half: float = 2.0):
    """Positions, normals and depths of contacts between a cylinder about z (radius 1, z = -2 to 2) and another one."""
    axes = np.array([[UP, axis / np.linalg.norm(axis)]])
    row, x, normal, depth, beside = side_contacts(
        np.array([[[0.0] * 3, at]]), axes, np.array([[1.0, radius]]), np.array([[2.0, half]])
    )
    assert (row == 0).all() and (len(row) > 0) == beside[0]
    return x, normal, depth


@pytest.mark.parametrize("depth", [-1e-3, 0.0, 1e-9, 1e-3])
@pytest.mark.parametrize("sign", [-1, 1])
def test_parallel_cylinders_touch_at_both_ends_of_the_length_along_which_they_are_beside_each_other(depth, sign):
    """Their radii are 1 and 0.5, and they extend from z = -2 to 2 and from 0 to 2.5."""
    turn = np.array([math.sin(0.3), math.cos(0.3), 0.0])
    x, normal, found = contacts((1.5 - depth) * turn + [0, 0, 1.25], np.array([0, 0, sign]), 0.5, 1.25)
    deep = found > depth - 1e-9
    assert deep.all() if depth <= 0 else deep.sum() == 2
    np.testing.assert_allclose(found[deep], depth, atol=1e-12)
    np.testing.assert_allclose(normal, np.tile(turn, (len(x), 1)), atol=1e-12)
    ends = x[np.argsort(x[:, 2])][[0, -1]]
    np.testing.assert_allclose(ends, [(1 - depth / 2) * turn, (1 - depth / 2) * turn + [0, 0, 2]], atol=1e-9)


@pytest.mark.parametrize("degrees", [30, 90, 150])
def test_crossed_cylinders_touch_where_their_axes_are_nearest(degrees):
    """The nearest point is (0, 0, 0.3), at 0.2 from the middle of the second cylinder."""
    along = np.array([math.sin(math.radians(degrees)), 0, math.cos(math.radians(degrees))])
    x, normal, depth = contacts(np.array([0, 1.99, 0.3]) - 0.2 * along, along)
    k = depth > 0
    assert k.sum() == 1 and depth[k][0] == pytest.approx(0.01)
    np.testing.assert_allclose(x[k][0], [0, 0.995, 0.3], atol=1e-9)
    np.testing.assert_allclose(normal[k][0], [0, 1, 0], atol=1e-9)


def test_a_slightly_turned_cylinder_touches_at_the_lower_end():
    tilt = 1e-3
    x, normal, depth = contacts(np.array([1.999, 0, 0]), np.array([tilt, 0, 1.0]))
    k = depth > 0
    assert k.sum() == 1 and x[k][0, 2] == pytest.approx(-2, abs=0.01)
    assert depth[k][0] == pytest.approx(0.001 + 2 * tilt, rel=1e-3) and normal[k][0, 0] > 0.999


@pytest.mark.parametrize(
    ("at", "axis"),
    [((0.0, 0, 3.99), UP), ((0.9, 0, 3.99), UP), ((2.99, 0, 0), [1.0, 0, 0]), ((0, 0, 3.0), [1.0, 0, 0.0])],
)
def test_contacts_with_an_end_are_none_of_the_sides(at, axis):
    """One on the other, centred and off-centre; an end on a side, and a side on an end."""
    assert len(contacts(np.array(at), np.array(axis))[0]) == 0


@pytest.mark.parametrize(("friction", "stands"), [(0.24, False), (0.3, True)])
def test_a_log_on_two_others_stays_if_friction_exceeds_the_tangent_of_15_degrees(tmp_path, friction, stands):
    """The force between two logs must act along the line through their contact and the floor contact: tangent 0.268."""
    log = torch.from_numpy(0.1 * cylinder(3.0)[:, [0, 2, 1]]).float()
    out = torch.nn.functional.normalize(log, dim=1)
    places = ((-0.1, 0.1), (0.1, 0.1), (0.0, 0.1 + 0.1 * math.sqrt(3)))
    logs = [Surface(log + torch.tensor([x, 0.0, z]), out) for x, z in places]
    t = roll(tmp_path, *logs, friction=friction, loss=0.02, steps=51)
    fall = float(t.com[0, 2, 2] - t.com[-1, 2, 2]) / 0.1
    assert fall < 0.01 if stands else fall > 0.5
