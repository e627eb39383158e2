"""The integrators: order of convergence, exactness, names."""

import math
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from stages.core.errors import InputError
from stages.core.models.integrate import solve_ode


class Swing(NamedTuple):
    angle: Tensor
    rate: Tensor


def pendulum(t: Tensor, s: Swing) -> Swing:
    return Swing(s.rate, -s.angle)


def end(method: str, substeps: int) -> float:
    """Error at t = 2 of a harmonic swing from angle 1."""
    start = Swing(torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
    states = solve_ode(pendulum, start, torch.linspace(0, 2, 3, dtype=torch.float64), method, substeps)
    return abs(float(states.angle[-1]) - math.cos(2))


@pytest.mark.parametrize("method, order", [("euler", 1), ("rk4", 4)])
def test_order_of_convergence(method, order):
    measured = math.log2(end(method, 10) / end(method, 20))
    assert measured == pytest.approx(order, abs=0.2)


def test_dopri5_keeps_its_tolerance():
    assert end("dopri5", 1) < 3e-3


def test_free_flight_is_a_parabola():
    # rk4 is exact for quadratics: only rounding is left
    g = torch.tensor([0, 0, -9.81], dtype=torch.float64)
    start = Swing(torch.tensor([0.0, 0, 1]).double(), torch.tensor([2.0, 0, 0]).double())
    t = torch.linspace(0, 2, 101, dtype=torch.float64)
    x = solve_ode(lambda t, s: Swing(s.rate, g), start, t, "rk4").angle
    wanted = start.angle + start.rate * t[:, None] + g * t[:, None] ** 2 / 2
    torch.testing.assert_close(x, wanted, rtol=0, atol=1e-12)


def test_adjoint_gradients_converge_to_those_through_the_steps():
    def gradient(adjoint: bool) -> Tensor:
        k = torch.tensor(1.3, dtype=torch.float64, requires_grad=True)
        start = Swing(torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
        t = torch.linspace(0, 2, 3, dtype=torch.float64)
        states = solve_ode(lambda t, s: Swing(s.rate, -k * s.angle), start, t, "rk4", 20, [k] if adjoint else None)
        return torch.autograd.grad(states.angle[-1], k)[0]

    torch.testing.assert_close(gradient(True), gradient(False), rtol=1e-5, atol=0)


def test_an_unknown_method():
    with pytest.raises(InputError, match="no integration method called 'heun'; choose from euler, rk4, dopri5"):
        end("heun", 1)
