"""Integrators: order of convergence, exact cases, error messages."""

import math
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from stages.core.errors import InputError
from stages.core.models.integrate import solve_ode


class PendulumState(NamedTuple):
    angle: Tensor
    rate: Tensor


def pendulum(t: Tensor, s: PendulumState) -> PendulumState:
    return PendulumState(s.rate, -s.angle)


def final_error(method: str, substeps: int) -> float:
    """Error at t = 2 of a harmonic oscillation from angle 1."""
    start = PendulumState(torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
    states = solve_ode(pendulum, start, torch.linspace(0, 2, 3, dtype=torch.float64), method, substeps)
    return abs(float(states.angle[-1]) - math.cos(2))


@pytest.mark.parametrize("method, order", [("euler", 1), ("rk4", 4)])
def test_order_of_convergence(method, order):
    measured = math.log2(final_error(method, 10) / final_error(method, 20))
    assert measured == pytest.approx(order, abs=0.2)


def test_dopri5_meets_its_tolerance():
    assert final_error("dopri5", 1) < 3e-3


def test_free_flight_is_a_parabola():
    # rk4 is exact for quadratics up to rounding
    g = torch.tensor([0, 0, -9.81], dtype=torch.float64)
    start = PendulumState(torch.tensor([0.0, 0, 1]).double(), torch.tensor([2.0, 0, 0]).double())
    t = torch.linspace(0, 2, 101, dtype=torch.float64)
    x = solve_ode(lambda t, s: PendulumState(s.rate, g), start, t, "rk4").angle
    expected = start.angle + start.rate * t[:, None] + g * t[:, None] ** 2 / 2
    torch.testing.assert_close(x, expected, rtol=0, atol=1e-12)


def test_adjoint_gradients_converge_to_backpropagated_gradients():
    def gradient(adjoint: bool) -> Tensor:
        k = torch.tensor(1.3, dtype=torch.float64, requires_grad=True)
        start = PendulumState(torch.ones(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64))
        t = torch.linspace(0, 2, 3, dtype=torch.float64)
        states = solve_ode(
            lambda t, s: PendulumState(s.rate, -k * s.angle), start, t, "rk4", 20, [k] if adjoint else None
        )
        return torch.autograd.grad(states.angle[-1], k)[0]

    torch.testing.assert_close(gradient(True), gradient(False), rtol=1e-5, atol=0)


def test_unknown_method_is_refused():
    with pytest.raises(InputError, match="no integration method called 'heun'; choose from euler, rk4, dopri5"):
        final_error("heun", 1)
