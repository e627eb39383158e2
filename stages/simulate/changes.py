"""Conditions that change during a simulation: the options that hold from then on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from stages.core.physics.forces import Change
from stages.simulate.options import SimulateOptions


def changed_options(options: SimulateOptions, changes: Sequence[Change]) -> SimulateOptions:
    """The options with other gravity, friction and materials."""
    for c in changes:
        if c.what == "material":
            options = replace(options, material=(*options.material, f"{c.object_id}={c.value}"))
        elif c.what in ("gravity", "friction"):
            options = replace(options, **{c.what: c.value})
    return options


def changed_pins(pinned: frozenset[int], changes: Sequence[Change]) -> frozenset[int]:
    """The ids of the objects that are held at their position."""
    for c in changes:
        if c.what == "pinned":
            pinned = pinned | {c.object_id} if c.value else pinned - {c.object_id}
    return pinned
