"""Lookup in depths below surfaces: the kernels against NumPy, and a ball's analytic distances."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.core.kernels.depth_lookup import CompiledDepthLookup, DepthLookup, depth_lookup, interpolated, slope
from stages.core.kernels.interop import compiles_for_cpu

kernels = pytest.mark.skipif(not compiles_for_cpu(), reason="Warp has no compiler for the CPU here")


def scene(count: int):
    """Grids of three bodies at random poses, and points that are looked up from body a in body b."""
    rng = np.random.default_rng(count)
    shapes = [(5, 6, 7), (4, 3, 9), (8, 8, 2)]
    grids = [rng.normal(size=shape) for shape in shapes], rng.uniform(-0.6, -0.2, (3, 3)), np.array([0.1, 0.15, 0.12])
    poses = Rotation.random(3, random_state=count).as_matrix(), rng.normal(size=(3, 3)) * 0.1
    a, b = rng.integers(0, 3, (2, count))
    return grids, poses, 0.3 * rng.normal(size=(count, 3)), a, b


@kernels
@pytest.mark.parametrize("counts", [(0, 7), (300, 5000, 40)])  # buffers grow, and are not cleared in between
def test_kernels_agree_with_numpy(counts):
    grids, *_ = scene(1)
    compiled, numpy = CompiledDepthLookup(*grids), DepthLookup(*grids)
    for count in counts:
        _, poses, points, a, b = scene(count)
        distance = numpy.distances(points, a, b, *poses)
        np.testing.assert_allclose(compiled.distances(points, a, b, *poses), distance, atol=1e-12)
        found, wanted = (x.inside(points, a, b, *poses) for x in (compiled, numpy))
        assert len(wanted[0]) >= count // 50  # some are inside
        for one, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-10)


@pytest.mark.parametrize("make", [DepthLookup, pytest.param(CompiledDepthLookup, marks=kernels)])
def test_distances_and_contacts_of_a_ball(make):
    """A ball of radius 1 about (2, 0, 0), and points of a body that is turned by 90 degrees about z."""
    line = np.arange(-1.2, 1.21, 0.05)
    x = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1)
    ball = 1 - np.linalg.norm(x, axis=-1)
    lookup = make([ball, ball], np.full((2, 3), -1.2), np.full(2, 0.05))
    turn = np.stack([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], np.eye(3)])
    at = np.array([[0.0, 0, 0], [2, 0, 0]])
    points = np.array([[0.0, -1.1, 0], [0, -0.5, 0], [0, 5, 0]])  # at x = 1.1, .5 and -5
    zeros, ones = np.zeros(3, np.int64), np.ones(3, np.int64)
    distance = lookup.distances(points, zeros, ones, turn, at)
    assert distance[0] == pytest.approx(-0.1, abs=2e-3)
    assert 0.3 < distance[1] <= 0.5 and 5.7 < distance[2] <= 6  # bounds for points outside of the grid
    rows, place, outwards, depth, node = lookup.inside(points, zeros, ones, turn, at)
    assert rows.tolist() == [0] and depth == pytest.approx([0.1], abs=2e-3)
    np.testing.assert_allclose(place, [[1.1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(outwards, [[-1, 0, 0]], atol=0.03)  # half a cell over the radius: the point is on a node
    nearest = x.reshape(-1, 3)[node[0] - ball.size]  # the second grid follows the first
    np.testing.assert_allclose(nearest, [-0.9, 0, 0], atol=0.026)


def test_gradient_of_the_interpolation():
    rng = np.random.default_rng(0)
    value, f, step = rng.normal(size=(50, 8)), rng.uniform(0.1, 0.9, (50, 3)), 1e-5
    numeric = [(interpolated(value, f + step * e) - interpolated(value, f - step * e)) / (2 * step) for e in np.eye(3)]
    np.testing.assert_allclose(slope(value, f), np.stack(numeric, 1), atol=1e-8)


def test_the_kernels_are_taken_where_they_can_be_compiled():
    grids, *_ = scene(1)
    assert type(depth_lookup(*grids)) is (CompiledDepthLookup if compiles_for_cpu() else DepthLookup)
