"""Function-preserving widening: a wider force field with the same outputs as a trained, narrower one."""

from __future__ import annotations

import torch

from stages.core.errors import InputError
from stages.core.models.field.force_field import ForceField


@torch.no_grad()
def widen(model: ForceField, hidden: int) -> ForceField:
    """A force field with `hidden` channels that computes the same function, as a start for further training.

    New channels have random input weights and zero output weights. Raises InputError for fewer channels than before.
    """
    old = model.config["hidden"]
    if hidden < old:
        raise InputError(
            f"--width {hidden}: the initial weights have {old} channels and can only be widened; give a larger width"
        )
    wide = ForceField(**{**model.config, "hidden": hidden}).to(next(model.parameters()))
    known = model.state_dict()
    for name, new in wide.state_dict().items():
        x = known[name]
        rows = _old_channels(x.shape[0], new.shape[0], old, hidden)
        if x.ndim == 1:
            new[rows] = x
            continue
        columns = _old_channels(x.shape[1], new.shape[1], old, hidden)
        new[rows] = 0.0
        new[rows[:, None], columns] = x
    return wide


def _old_channels(before: int, after: int, old: int, new: int) -> torch.Tensor:
    """Indices of the old channels along an axis that grew from `before` to `after` entries.

    The axis consists of blocks of `old` channels, now `new` each, followed by entries that do not depend on the width.
    """
    blocks = (after - before) // (new - old) if new > old else 0
    inner = (torch.arange(blocks)[:, None] * new + torch.arange(old)).flatten()
    return torch.cat([inner, torch.arange(blocks * new, after)])
