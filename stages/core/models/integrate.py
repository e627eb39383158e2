"""torchdiffeq around states with named fields."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor
from torchdiffeq import odeint, odeint_adjoint

from stages.core.errors import InputError

METHODS = ("euler", "rk4", "dopri5")
TOLERANCE = {"rtol": 1e-3, "atol": 1e-4}  # of dopri5, as published
State = TypeVar("State", bound=tuple)  # a NamedTuple of tensors


def solve_ode(
    rate: Callable[[Tensor, State], State], start: State, times: Tensor, method: str = "euler", substeps: int = 1,
    adjoint: Sequence[Tensor] | None = None,
) -> State:  # fmt: skip
    """States at `times` [s], stacked along a new first dimension; the first is `start`.

    The fixed steps of euler and rk4 are the intervals of `times` cut into `substeps`; dopri5 chooses its own, the same
    for a whole batch. `adjoint` names tensors that shall get gradients from the adjoint equation (memory of one step,
    Chen et al. 2018, "Neural Ordinary Differential Equations"); without it gradients go back through the steps.
    """
    if method not in METHODS:
        raise InputError(f"no integration method called {method!r}; choose from {', '.join(METHODS)}")
    kind = type(start)
    if len(times) == 1:
        return kind(*(y[None] for y in start))

    def f(t: Tensor, state: tuple) -> tuple:
        return tuple(rate(t, kind(*state)))

    settings: dict = {"method": method, **TOLERANCE}
    if method != "dopri5" and substeps > 1:
        settings["options"] = {"grid_constructor": lambda f, y, t: _refined(t, substeps)}
    if adjoint is None:
        return kind(*odeint(f, tuple(start), times, **settings))
    params = tuple(p for p in adjoint if p.requires_grad)
    return kind(*odeint_adjoint(f, tuple(start), times, adjoint_params=params, **settings))


def _refined(t: Tensor, substeps: int) -> Tensor:
    """Each interval of `t` in equal parts."""
    part = torch.arange(substeps, dtype=t.dtype, device=t.device) / substeps
    inner = t[:-1, None] + part * t.diff()[:, None]
    return torch.cat([inner.flatten(), t[-1:]])
