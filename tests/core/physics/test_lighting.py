"""The fit of the light to log colours, compared with colours computed from known shadows."""

import math
from dataclasses import replace

import pytest
import torch

from stages.core.kernels.sphere_shadows import Spheres
from stages.core.perception.support import find_support
from stages.core.physics import lighting
from stages.core.physics.lighting import _best_fit, _lamps, _surface_terms
from stages.core.raster.shadows import Light
from stages.core.scene.gaussians import concatenate
from tests.conftest import two_balls_scene


def surface(count: int = 600):
    """Random cells of a surface: terms of its own colour, shares of sky and lamp blocked for three lamps, and noise."""
    rng = torch.Generator().manual_seed(0)
    points, colours = torch.rand(count, 3, generator=rng), 0.2 * torch.randn(count, 3, generator=rng)
    hidden = torch.rand(3, count, 2, generator=rng) * (torch.rand(3, count, 2, generator=rng) < 0.5)
    return _surface_terms(points, colours), hidden, 0.003 * torch.randn(count, generator=rng)


LAMPS = [Light(0.0, 0.0, (0.0, 0.0, 1.0), spread, in_colours=True) for spread in (0.1, 0.2, 0.3)]


@pytest.mark.parametrize("outliers", [0.0, 0.1])
@pytest.mark.parametrize("shares", [(0.3, 0.5), (0.6, 0.1), (0.0, 0.7)])
def test_the_lamp_and_the_shares_of_sky_and_lamp_are_found(shares, outliers):
    """y = A a + log(1 - hidden s) with noise; optionally, a tenth of the cells is dark for another reason."""
    (_, A), hidden, noise = surface()
    own = torch.linspace(-0.3, 0.4, A.shape[1])
    y = A @ own + (1 - hidden[1] @ torch.tensor(shares)).log() + noise
    y[: int(outliers * len(y))] -= 1.0
    fit = _best_fit(A, hidden, y, LAMPS)
    assert fit.light == replace(LAMPS[1], sky=fit.light.sky, lamp=fit.light.lamp)
    assert (fit.light.sky, fit.light.lamp) == pytest.approx(shares, abs=0.005)
    torch.testing.assert_close(fit.own.float(), own, rtol=0, atol=0.01)
    assert fit.odds > 20


@pytest.mark.parametrize(("share", "found"), [(0.07, False), (0.14, True)])
def test_shadows_of_less_than_a_tenth_of_the_light_are_texture(share, found):
    (_, A), hidden, noise = surface()
    y = (1 - hidden[1] @ torch.tensor([0.0, share])).log() + 0.1 * noise
    fit = _best_fit(A, hidden, y, LAMPS)
    assert (fit.odds > 5) == found and (fit.odds == 0) == (not found)


def test_brightness_without_shadows_has_no_odds():
    (_, A), hidden, noise = surface()
    assert _best_fit(A, hidden, A @ torch.ones(A.shape[1]) + noise, LAMPS).odds < 0.05


def test_the_own_terms_of_a_surface_leave_out_what_shadows_do():
    """A shadow changes the log brightness of all channels equally and no other term."""
    rng = torch.Generator().manual_seed(1)
    points, colours = torch.rand(50, 3, generator=rng), torch.randn(50, 3, generator=rng)
    (before, terms), (after, same) = (_surface_terms(points, c) for c in (colours, colours - 0.7))
    torch.testing.assert_close(after, before - 0.7)
    torch.testing.assert_close(same, terms)
    torch.testing.assert_close(before, colours.mean(1))


def test_lamps_are_all_around_above_the_horizon():
    directions = torch.tensor([lamp.direction for lamp in _lamps()])
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(len(directions)))
    elevations = torch.rad2deg(torch.asin(directions[:, 2])).round().int()
    assert elevations.unique().tolist() == [25, 40, 55, 70, 90]
    assert len({(lamp.direction, lamp.spread) for lamp in _lamps()}) == len(_lamps()) == 2 * (4 * 12 + 1)
    around = torch.atan2(directions[elevations == 25, 1], directions[elevations == 25, 0]) % (2 * math.pi)
    assert sorted(torch.rad2deg(around).round().int().unique().tolist()) == list(range(0, 360, 30))


def test_the_terms_of_a_surface_are_of_second_degree_in_place_and_chromaticity():
    points = torch.tensor([[0.0, 0.0, 9.0], [2.0, 0.0, 9.0], [0.0, 4.0, 9.0], [2.0, 4.0, 9.0]])
    colours = torch.tensor([[0.3, 0.0, 0.0], [0.0, 0.3, 0.0], [0.0, 0.0, 0.3], [0.3, 0.3, 0.3]])
    brightness, terms = _surface_terms(points, colours)
    torch.testing.assert_close(brightness, torch.tensor([0.1, 0.1, 0.1, 0.3]))
    x, y = ((points[:, :2] - torch.tensor([1.0, 2.0])) / points[:, :2].std()).T
    u, v = torch.tensor([0.2, -0.1, -0.1, 0.0]), torch.tensor([-0.1, 0.2, -0.1, 0.0])
    u, v = u / u.std(), v / v.std()
    expected = [x**0, x, y, x * x, x * y, y * y, u, v, u * u, u * v, v * v]
    torch.testing.assert_close(terms, torch.stack(expected, 1))
    _, grey = _surface_terms(points, colours[3:].expand(4, 3))
    assert not grey[:, 6:].any()


def test_weighted_least_squares():
    """Fit of a line to three points, the second with weight 2 and the third with weight 0."""
    A = torch.tensor([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0]]).double().expand(2, -1, -1)
    y = torch.tensor([[1.0, 3.0, 99.0], [1.0, 3.0, 5.0]]).double()
    weights = torch.tensor([[1.0, 2.0, 0.0], [1.0, 1.0, 1.0]]).double()
    expected = torch.tensor([[1.0, 2.0], [1.0, 2.0]]).double()
    found = lighting._solve(A, y, weights)
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-5)
    torch.testing.assert_close(lighting._times(A, found)[1], y[1], rtol=0, atol=2e-5)
    y[1, 1] = 6.0  # the fitted values are 2, 4 and 6, thus the residuals 1, -2 and 1
    torch.testing.assert_close(lighting._times(A, lighting._solve(A, y, weights))[1] - y[1],
                               torch.tensor([1.0, -2.0, 1.0]).double(), rtol=0, atol=1e-4)  # fmt: skip
    singular = lighting._solve(torch.zeros(1, 3, 2).double(), y[:1], weights[:1])
    assert not singular.any()  # the ridge makes the solution zero


def test_shares_of_sky_and_lamp_stay_below_all_of_the_light():
    (_, A), hidden, _ = surface()
    y = A @ torch.zeros(A.shape[1]) + 3 * (1 - 0.99 * hidden[1].amax(1)).log()
    fit = _best_fit(A, hidden, y, LAMPS)
    assert fit.light.sky >= 0 and fit.light.lamp >= 0
    assert fit.light.sky + fit.light.lamp == pytest.approx(lighting.MAX_SHARE, abs=1e-6)


def test_cells_are_of_opaque_background_near_the_objects():
    """Floor below two balls, with bright Gaussians that are ignored: transparent, above the floor, or of an object."""
    scene = two_balls_scene()
    g = scene.gaussians
    near = Spheres(torch.tensor([[0.0, 0, 0.15]]), torch.tensor([0.15]), torch.ones(1), torch.tensor([1]))
    support = find_support(scene)
    points, colours = lighting._surface_cells(scene, support, near)
    assert len(points) > 20 and float(points[:, :2].norm(dim=1).max()) < 0.15 * 4 + 0.1  # 1 + 3 radii and one cell
    torch.testing.assert_close(colours, torch.full_like(colours, lighting.GAMMA * math.log(0.5)), atol=1e-3, rtol=0)
    floor = (g.object_id == 0).nonzero()[:, 0]
    for change in ({"opacities": 0.01}, {"object_id": 2}, {"means": 0.3}):
        more = g[floor]
        more.sh[:] = 1.0
        for name, value in change.items():
            if name == "means":
                more.means[:, 2] += value
            else:
                getattr(more, name)[:] = value
        both = replace(scene, gaussians=concatenate([g, more, more, more]))
        again = lighting._surface_cells(both, support, near)
        torch.testing.assert_close(again, (points, colours))
