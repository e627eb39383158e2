"""What rests at the start stays as it is until something reaches it: photos show things in equilibrium.

A learned force field holds a body only about as well as it has learned to, and parts found in photos overlap a little,
so that they would be pushed apart. Source of the idea: sleeping islands, as rigid body engines have them.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.models.field.narrow_phase import nearest
from stages.core.models.initial_conditions import InitialConditions

TOUCH = 0.05  # what is nearer touches, beside half the distance between keypoints [m]
SEAM = 0.1  # the same of things at the start: photos show little of where they touch
STIR = 0.25  # what would make something so fast if it stuck to it wakes it [m/s]


class SleepState:
    """Which objects of a scene sleep; `awake` (o) are those that are thrown, lifted, or pushed at once.

    The others sleep if they are `standing` on the floor (o), or touch what sleeps and does so.
    """

    def __init__(self, world: InitialConditions, awake: Bool[Tensor, "o"], standing: Bool[Tensor, "o"]):
        self.valid, self.mass = world.valid, world.mass[0].clamp_min(1e-6)
        self.spacing = _spacing(world)
        near = self._near(world.points, SEAM).any(-1)
        self.touches = near | near.T
        self.standing, self.asleep = standing, ~awake
        self._supported()

    def wake(self, points: Float[Tensor, "1 o n 3"], speed: Float[Tensor, "1 o n 3"]) -> bool:
        """Wake whatever something awake has reached, or no longer holds; whether anything woke."""
        if not bool(self.asleep.any()):
            return False
        share = self.mass[:, None] / (self.mass[:, None] + self.mass)
        quick = speed[0].norm(dim=-1)[:, None] * share[..., None] > STIR
        hit = (self._near(points, TOUCH) & quick).any(-1) & ~self.asleep[:, None]
        return self.rouse(hit.any(0))

    def rouse(self, rows: Bool[Tensor, "o"]) -> bool:
        """Wake these and whatever they held; whether anything woke."""
        before = int(self.asleep.sum())
        self.asleep = self.asleep & ~rows
        self._supported()
        return int(self.asleep.sum()) < before

    def _near(self, points: Float[Tensor, "1 o n 3"], gap: float) -> Bool[Tensor, "o o n"]:
        """Which keypoints of object i (first) touch object j (second)."""
        most = gap + torch.maximum(self.spacing[:, None], self.spacing) / 2
        distance, _ = nearest(points, self.valid, float(most.max()))
        return distance[0] < most[..., None]

    def _supported(self) -> None:
        """Whoever sleeps on nothing wakes."""
        held = self.asleep & self.standing
        while True:
            more = held | (self.asleep & (self.touches & held).any(-1))
            if bool((more == held).all()):
                break
            held = more
        self.asleep = held


def _spacing(world: InitialConditions) -> Float[Tensor, "o"]:
    """About how far apart the keypoints of each object are [m]: as on the surface of its bounding box."""
    hidden = ~world.valid[0, ..., None]
    high = world.points[0].masked_fill(hidden, -torch.inf).amax(1)
    a, b, c = (high - world.points[0].masked_fill(hidden, torch.inf).amin(1)).unbind(-1)
    return (2 * (a * b + b * c + c * a) / world.valid[0].sum(-1)).sqrt()
