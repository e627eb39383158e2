"""ODE solvers for dynamics models: torchdiffeq applied to states that are named tuples of tensors.

The published model is integrated with explicit Euler steps of one frame or, adaptively, with dopri5 (TOLERANCE below).
`Dynamics.rollout` and `rollout.TimeStepper` use torchdiffeq if the method is one of METHODS, as with `ngff simulate
--integrator`, and for gradients by the adjoint equation. The default method "step" is a model's own step. For models
that are plain ODEs (`gcn`, `pointformer`, `transformer`, `ngff-paper`) it is explicit Euler, equal to "euler" up to
rounding; for `ngff` it is a splitting with implicit springs, friction and a penetration limit, which a general ODE
solver does not offer. With the shipped weights of `ngff`, rk4 agrees with this step to millimetres in first contacts,
euler with steps of one frame diverges, and dopri5 fails at stiff contacts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import Tensor

from stages.core.errors import InputError

METHODS = ("euler", "rk4", "dopri5")
TOLERANCE = {"rtol": 1e-3, "atol": 1e-4}  # tolerances of dopri5, as published
State = TypeVar("State", bound=tuple)  # a NamedTuple of tensors


@dataclass(frozen=True)
class Integration:
    """Time integration of a rollout. Raises ValueError for an adjoint without an ODE solver."""

    method: str = "step"  # the model's own step, or one of METHODS
    substeps: int = 1  # equal parts that each frame is divided into; dopri5 chooses its own steps
    adjoint: bool = False  # gradients of the parameters by the adjoint equation, see `solve_ode`

    def __post_init__(self):
        if self.adjoint and self.method == "step":
            raise ValueError("the adjoint equation needs an ODE method")


def solve_ode(
    rate: Callable[[Tensor, State], State], start: State, times: Tensor, method: str = "euler", substeps: int = 1,
    adjoint: Sequence[Tensor] | None = None,
) -> State:  # fmt: skip
    """Return the states at `times` [s], stacked along a new first dimension; the first is `start`.

    rate: time derivative of a state at a given time.
    method: euler and rk4 divide each interval into `substeps`; dopri5 chooses its steps, the same for a whole batch.
    adjoint: tensors that get gradients from the adjoint equation (memory of one step; Chen et al. 2018, "Neural
        Ordinary Differential Equations"); without it gradients are backpropagated through the steps.
    Raises InputError for an unknown method, and if the step of dopri5 underflows, as at stiff contacts.
    """
    from torchdiffeq import odeint, odeint_adjoint  # imports scipy.optimize, which the method "step" does not need

    if method not in METHODS:
        raise InputError(f"no integration method called {method!r}; choose from {', '.join(METHODS)}")
    kind = type(start)
    if len(times) == 1:
        return kind(*(y[None] for y in start))

    def f(t: Tensor, state: tuple) -> tuple:
        return tuple(rate(t, kind(*state)))

    settings: dict = {"method": method, **TOLERANCE}
    if method != "dopri5" and substeps > 1:
        settings["options"] = {"grid_constructor": lambda f, y, t: _subdivided(t, substeps)}
    try:
        if adjoint is None:
            return kind(*odeint(f, tuple(start), times, **settings))
        params = tuple(p for p in adjoint if p.requires_grad)
        return kind(*odeint_adjoint(f, tuple(start), times, adjoint_params=params, **settings))
    except AssertionError as error:  # raised by torchdiffeq
        if "underflow" not in str(error):
            raise
        raise InputError(
            f"--integrator {method}: the step size became too small for these forces; use rk4 or step"
        ) from error


def _subdivided(t: Tensor, substeps: int) -> Tensor:
    """Divide each interval of the times `t` into equal parts."""
    part = torch.arange(substeps, dtype=t.dtype, device=t.device) / substeps
    inner = t[:-1, None] + part * t.diff()[:, None]
    return torch.cat([inner.flatten(), t[-1:]])
