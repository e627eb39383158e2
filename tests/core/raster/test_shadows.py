"""Shadows of spheres: comparison with ray casting, limits, and shadows that the colours contain."""

from dataclasses import replace

import pytest
import torch

from stages.core.geometry.harmonics import C0
from stages.core.kernels.sphere_shadows import Spheres
from stages.core.raster.shadows import GAMMA, OVERHEAD, Light, blocked, irradiance, shaded, shadow_factor
from tests.conftest import random_gaussians
from tests.core.raster.lit_world import RADIUS, REST, floor_irradiance

BALL = Spheres(torch.tensor([[0.0, 0.0, 0.3]]), torch.tensor([0.1]), torch.ones(1), torch.tensor([1]))
HIGH = Light(0.5, 0.5, (0.6, 0.0, 0.8), 0.2, in_colours=True)


def test_a_sphere_blocks_what_cast_rays_say():
    """Exact for the sky; for the lamp, the overlap of discs is approximated (Oat and Sander)."""
    ball = replace(BALL, radii=torch.tensor([RADIUS]))
    away = replace(REST, block=(50.0, 0.0, 0.1), ball=(0.0, 0.0, 0.3))
    line = torch.linspace(-0.5, 0.5, 41)
    xy = torch.stack([line, torch.zeros(41)], 1)
    points = torch.cat([xy, torch.zeros(41, 1)], 1)
    sky, lamp = blocked(points, torch.zeros(41, dtype=torch.int64), ball, HIGH)
    true_sky = 1 - floor_irradiance(xy, away, replace(HIGH, sky=1.0, lamp=0.0), count=4096)
    true_lamp = 1 - floor_irradiance(xy, away, replace(HIGH, sky=0.0, lamp=1.0), count=4096)
    assert float((sky - true_sky).abs().max()) < 0.012  # blocked fractions below 0.01 are omitted
    error = (lamp - true_lamp).abs()
    assert float(error.max()) < 0.15 and float(error.mean()) < 0.03
    assert true_lamp.max() > 0.9 and true_sky.max() > 0.1


def test_spheres_above_the_horizon_only_and_never_their_own_object():
    points = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.6], [0.0, 0.0, 0.0]])
    e = irradiance(points, torch.tensor([0, 0, 1]), BALL, replace(HIGH, direction=(0.0, 0.0, 1.0)))
    assert e[0] < 0.7 and e[1] == 1 and e[2] == 1


def test_shadow_fades_with_distance_and_weights_of_overlapping_spheres_count_once():
    points, ids = torch.zeros(1, 3), torch.zeros(1, dtype=torch.int64)
    at = [replace(BALL, centres=torch.tensor([[0.0, 0.0, z]])) for z in (0.1, 0.3, 0.9)]
    sky = [float(blocked(points, ids, ball, HIGH)[0]) for ball in at]
    assert sky[0] > 0.99 and sky[1] == pytest.approx(1 / 9, rel=1e-4) and sky[2] == pytest.approx(1 / 81, rel=1e-4)
    twice = Spheres(*(torch.cat([x, x]) for x in (BALL.centres, BALL.radii, BALL.weights / 2, BALL.object_id)))
    torch.testing.assert_close(blocked(points, ids, twice, HIGH)[0], blocked(points, ids, BALL, HIGH)[0])


def test_factor_is_one_where_nothing_changed_and_lifts_at_most_what_the_colours_hold():
    rest = torch.tensor([0.2, 0.6, 1.0])
    for light in (HIGH, OVERHEAD, replace(HIGH, beneath=0.3)):
        assert torch.equal(shadow_factor(rest, rest, light), torch.ones(3))
    one = torch.ones(3)
    # the colours beneath were filled in and are not dark
    torch.testing.assert_close(shadow_factor(one, rest, HIGH), one)
    dark = shadow_factor(one, rest, replace(HIGH, beneath=0.5)) ** GAMMA
    torch.testing.assert_close(dark, torch.tensor([2.0, 1 / 0.6, 1.0]))
    torch.testing.assert_close(shadow_factor(0.5 * rest, rest, HIGH) ** GAMMA, 0.5 * one)


def test_colours_are_multiplied_in_every_direction():
    g = random_gaussians(20, degree=2)
    factor = torch.linspace(0.2, 1.5, 20)
    colour = lambda g: C0 * g.sh[:, 0] + 0.5  # noqa: E731
    dark = shaded(g, factor)
    torch.testing.assert_close(colour(dark), factor[:, None] * colour(g))
    torch.testing.assert_close(dark.sh[:, 1:], factor[:, None, None] * g.sh[:, 1:])
