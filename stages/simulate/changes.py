"""Changes of gravity, friction, materials and pins during a simulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from stages.core.physics.forces import Change
from stages.simulate.options import SimulateOptions


def changed_options(options: SimulateOptions, changes: Sequence[Change]) -> SimulateOptions:
    """Apply changes of gravity, friction and materials to the options."""
    for c in changes:
        if c.what == "material":
            options = replace(options, material=(*options.material, f"{c.object_id}={c.value}"))
        elif c.what in ("gravity", "friction"):
            options = replace(options, **{c.what: c.value})
    return options


def changed_pins(pinned: frozenset[int], changes: Sequence[Change]) -> frozenset[int]:
    """Apply changes of pins to the ids of the pinned objects."""
    for c in changes:
        if c.what == "pinned":
            pinned = pinned | {c.object_id} if c.value else pinned - {c.object_id}
    return pinned
