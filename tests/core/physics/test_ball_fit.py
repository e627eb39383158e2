"""Balls recognised by their surface, with noise, missing parts, and shapes that are nearly round."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stages.core.geometry.extremes import fibonacci
from stages.core.physics.ball_fit import Ball, fitted_ball

UNIT = fibonacci(4000)
GOLDEN = (1 + 5**0.5) / 2
NO_FLOOR = -np.inf


def polyhedron(normals: np.ndarray) -> np.ndarray:
    """Points on the polyhedron whose faces are tangent to the unit ball at the directions of vectors (f, 3)."""
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return UNIT / (UNIT @ normals.T).max(1)[:, None]


def signs(*rows: tuple) -> np.ndarray:
    """All cyclic permutations of vectors' coordinates with all combinations of signs."""
    every = np.concatenate([np.array(rows) * s for s in np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3)])
    return np.concatenate([np.roll(every, k, 1) for k in range(3)])


def cylinder(half_height: float) -> np.ndarray:
    return UNIT / np.maximum(np.linalg.norm(UNIT[:, :2], axis=1), np.abs(UNIT[:, 2]) / half_height)[:, None]


def capsule(half: float) -> np.ndarray:
    return UNIT + half * np.sign(UNIT[:, :1]) * [1, 0, 0]


OTHERS = {
    "egg 1:1.1": UNIT * [1, 1, 1.1],
    "lying egg 1:1.1": UNIT * [1.1, 1, 1],
    "flat 1:1.1": UNIT * [1.1, 1.1, 1],
    "cube": polyhedron(signs((0, 0, 1))),
    "dodecahedron": polyhedron(signs((0, 1, GOLDEN))),
    "icosahedron": polyhedron(np.concatenate([signs((1, 1, 1)), signs((0, 1 / GOLDEN, GOLDEN))])),
    "cylinder as high as wide": cylinder(1.0),
    "capsule longer by 15 %": capsule(0.15),
    "apple": UNIT * (1 - 0.2 * np.abs(UNIT[:, 2:]) ** 12),
    "pear": UNIT * (1 + 0.3 * np.maximum(UNIT[:, 2:], 0) ** 6),
    "half a ball": UNIT[UNIT[:, 2] > 0],
}


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("all_seen", [True, False])
@pytest.mark.parametrize("turn", [0, 1])
def test_other_shapes_are_not_balls(name, all_seen, turn):
    """The shapes stand on a floor or are randomly rotated, and are partly or completely visible."""
    points = OTHERS[name]
    if turn:
        points = Rotation.random(random_state=3).apply(points)
    floor = points[:, 2].min() - 1e-6
    assert fitted_ball(points, floor, all_seen) is None


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_centre_and_radius_from_uneven_noisy_points(noise):
    """One side has three times as many points as the other, and a tuft protrudes by up to 0.3 radii."""
    rng = np.random.default_rng(0)
    points = np.concatenate([UNIT, UNIT[UNIT[:, 0] > 0], UNIT[UNIT[:, 0] > 0]])
    points = points * (1 + noise * rng.standard_normal((len(points), 1)))
    tuft = UNIT[UNIT[:, 2] > 0.95] * rng.uniform(1.0, 1.3, (np.sum(UNIT[:, 2] > 0.95), 1))
    ball = fitted_ball(0.07 * np.concatenate([points, tuft]) + [1.0, -2.0, 3.0], NO_FLOOR, all_seen=True)
    np.testing.assert_allclose(ball.centre, [1.0, -2.0, 3.0], rtol=0, atol=0.07 * 0.004)
    assert ball.radius == pytest.approx(0.07, rel=0.004)


def skirted(depth: float) -> np.ndarray:
    """The convex hull of a ball and its shadow on the floor z = 0, which is `depth` below the ball's centre."""
    upper, below = UNIT[UNIT[:, 2] > -0.5], UNIT[UNIT[:, 2] <= -0.5]
    ring = below * np.minimum(1 / np.linalg.norm(below[:, :2], axis=1), -depth / below[:, 2])[:, None]
    return np.concatenate([upper, ring]) + [0, 0, depth]


def test_a_skirt_where_a_ball_rests_is_no_part_of_it_in_photos():
    ball = fitted_ball(skirted(1.0), -1e-6, all_seen=False)
    np.testing.assert_allclose([*ball.centre, ball.radius], [0, 0, 1, 1], rtol=0, atol=2e-3)
    assert fitted_ball(skirted(1.0), -1e-6, all_seen=True) is None


@pytest.mark.parametrize(("depth", "floor", "is_ball"), [(0.95, 0.0, True), (0.8, 0.0, False), (0.8, NO_FLOOR, True)])
def test_a_ball_whose_flat_face_is_on_the_floor_is_a_dome(depth, floor, is_ball):
    """On the floor, a ball would penetrate by the missing part; in the air, that part may just not have been seen."""
    dome = np.column_stack([UNIT[:, :2], np.maximum(UNIT[:, 2], -depth)]) + [0, 0, depth + 1e-3]
    assert (fitted_ball(dome, floor, all_seen=False) is not None) == is_ball


@pytest.mark.parametrize(("height", "is_ball"), [(0.05, True), (0.2, False)])
def test_a_ball_on_a_foot_is_not_a_ball(height, is_ball):
    foot = np.concatenate([0.5 * UNIT[:, :2], np.full((len(UNIT), 1), -1 - height)], 1)
    points = np.concatenate([UNIT, foot[np.linalg.norm(foot[:, :2], axis=1) < 0.5]])
    assert (fitted_ball(points, NO_FLOOR, all_seen=False) is not None) == is_ball


def test_a_surface_that_is_open_or_empty_has_no_ball():
    assert fitted_ball(np.empty((0, 3)), 0.0, all_seen=False) is None
    assert fitted_ball(UNIT[np.abs(UNIT[:, 0]) < 0.6], NO_FLOOR, all_seen=False) is None
    assert fitted_ball(UNIT + [0, 0, 1], 3.0, all_seen=False) is None  # all points are below the floor


def test_a_ball_is_clear_of_points_up_to_a_tenth_of_its_radius_inside():
    ball = Ball(np.array([0.0, 0.0, 1.0]), 0.5)
    assert ball.clear_of(np.empty((0, 3))) and ball.clear_of(np.array([[0, 0, 0.54]]))
    assert not ball.clear_of(np.array([[0, 0, 0.54], [0.0, 0.44, 1.0]]))


def test_a_ball_does_not_depend_on_the_number_of_threads(with_threads):
    points = 0.1 * UNIT * (1 + 0.01 * np.random.default_rng(0).standard_normal((len(UNIT), 1)))
    one, two = (with_threads(count, lambda: fitted_ball(points, NO_FLOOR, True)) for count in (1, 2))
    assert np.array_equal(one.centre, two.centre) and one.radius == two.radius
