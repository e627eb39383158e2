"""A wider force field that does what a narrower, trained one does, to go on from."""

from __future__ import annotations

import torch

from stages.core.errors import InputError
from stages.core.models.field.force_field import ForceField


@torch.no_grad()
def widen(model: ForceField, hidden: int) -> ForceField:
    """The same function with `hidden` channels: new ones see as untrained ones do, and nobody listens to them yet."""
    old = model.config["hidden"]
    if hidden < old:
        raise InputError(f"--hidden {hidden}: the weights have {old} channels, and can only be widened")
    wide = ForceField(**{**model.config, "hidden": hidden}).to(next(model.parameters()))
    known = model.state_dict()
    for name, new in wide.state_dict().items():
        x = known[name]
        rows = _places(x.shape[0], new.shape[0], old, hidden)
        if x.ndim == 1:
            new[rows] = x
            continue
        columns = _places(x.shape[1], new.shape[1], old, hidden)
        new[rows] = 0.0
        new[rows[:, None], columns] = x
    return wide


def _places(few: int, many: int, old: int, new: int) -> torch.Tensor:
    """Where the old channels are among the new ones: blocks of `old`, then of `new`, and what is of neither width."""
    blocks = (many - few) // (new - old) if new > old else 0
    inner = (torch.arange(blocks)[:, None] * new + torch.arange(old)).flatten()
    return torch.cat([inner, torch.arange(blocks * new, many)])
