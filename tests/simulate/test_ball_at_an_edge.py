"""A ball that rolls over the edge of a box, compared with mechanics and with the distance to the box."""

import math

import pytest
import torch
from torch import Tensor

from stages.lab.assets.shapes import box, ellipsoid
from tests.simulate.motion import roll_out
from tests.simulate.test_rigid import options_of, scene_of

SIDE, RADIUS, SPEED, DT = 0.3, 0.06, 0.3, 0.02
G = 9.81


def distance_to_box(points: Tensor) -> Tensor:
    """Signed distance [m] to the cube that stands on z = 0."""
    out = (points - torch.tensor([0.0, 0.0, SIDE / 2])).abs() - SIDE / 2
    return out.clamp_min(0).norm(dim=-1) + out.amax(-1).clamp_max(0)


def leaving_speed(speed: float, inertia: float) -> float:
    """Horizontal speed [m/s] of a ball after leaving an edge.

    It pivots about the edge until its weight no longer holds it there: v^2 = g r cos(angle), with
    (1 + inertia) (v^2 - speed^2) = 2 g r (1 - cos(angle)).

    inertia: relative to m r^2; 2/5 without slip, 0 without friction.
    """
    froude = speed**2 / (G * RADIUS)
    cosine = ((1 + inertia) * froude + 2) / (3 + inertia)
    return math.sqrt(G * RADIUS * cosine) * cosine


@pytest.mark.parametrize("engine", ["ngff", "rigid"])
def test_leaves_an_edge_with_the_speed_of_mechanics_and_stays_outside(tmp_path, device, engine):
    """Its speed is between those without slip and without friction, because it slips on the last part of the edge.

    The hull of the box's Gaussians ends 1/3 of their spacing within its edges.
    """
    cube = box((SIDE, SIDE, SIDE), SIDE / 32).moved((0.0, 0.0, SIDE / 2))
    ball = ellipsoid((RADIUS,) * 3, 2000).moved((SIDE / 4, 0.0, SIDE + RADIUS))
    scene = scene_of((cube, ball))
    options = options_of(scene, tmp_path, engine=engine, pin=("1",), velocity=(f"object=2 {SPEED},0,0",), dt=DT,
                         steps=36, **({"contact": "solved"} if engine == "ngff" else {}))  # fmt: skip
    centre = roll_out(scene, options).com[:, 1]
    assert distance_to_box(centre).min() > RADIUS - 0.4 * SIDE / 32
    flying = (centre[:, 0] > SIDE / 2 + 0.7 * RADIUS) & (centre[:, 2] > 2 * RADIUS)
    speed = (centre[flying].diff(dim=0)[:, 0] / DT).mean()
    rolling = 5 / 7 * SPEED  # speed of a ball that initially slid
    assert 0.98 * leaving_speed(rolling, 0.4) < speed < 1.02 * leaving_speed(rolling, 0.0)
