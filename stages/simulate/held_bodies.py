"""Bodies of the learned engine that photos show at rest, held until their equilibrium is disturbed.

The conditions and limits are those of `resting_bodies.py`, which does the same for MuJoCo.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.models.field.body_surfaces import BodySurfaces
from stages.core.models.initial_conditions import InitialConditions
from stages.core.models.rollout import TimeStepper
from stages.simulate.resting_bodies import SUPPORT_COSINE, SUPPORT_GAP, Stance, excess_force, highest_below, leans

RELEASE_FALL = 0.005  # bodies are released at the speed after a fall of this height [size of the smallest body]


class HeldBodies:
    """Tracks which of the `o` bodies of a scene are held (`asleep`); masks are on the CPU."""

    def __init__(
        self, initial: InitialConditions, surfaces: BodySurfaces, seen: Float[Tensor, "o 3"], awake: Bool[Tensor, "o"],
        standing: Bool[Tensor, "o"],
    ):  # fmt: skip
        """`seen`: centres of mass as reconstructed, without lifts [m]; `awake` bodies are not held; `standing` bodies
        stand on the floor as reconstructed.
        """
        self._stances = [
            _stance(surfaces, row, seen[row], float(initial.friction[0, row]), bool(standing[row]))
            for row in range(len(seen))
        ]
        size = min(float((s.high - s.low).max()) for s in self._stances)
        self._resting_on = _supports(surfaces, seen, self._stances, SUPPORT_GAP * size)
        self._fall, self._impulse = RELEASE_FALL * size, np.zeros(len(seen))
        self.asleep = torch.ones_like(awake)
        self.wake(awake)

    def wake(self, rows: Bool[Tensor, "o"]) -> None:
        """Release these bodies and, recursively, those that rest on them."""
        while bool((more := (self._resting_on[:, rows].any(1) & ~rows)).any()):
            rows = rows | more
        self.asleep = self.asleep & ~rows

    def advance(self, stepper: TimeStepper, steps: int, pinned: Bool[Tensor, "o"]) -> None:
        """Make the steps of one frame; `pinned` and held bodies do not move.

        A step that disturbs held bodies is repeated with these bodies released.
        """
        for _ in range(steps):
            while True:
                stepper.external.pinned.copy_(pinned | self.asleep)
                if not bool(self.asleep.any()):
                    stepper.step()
                    break
                before = stepper.saved()
                stepper.step()
                if not bool((woken := self._disturbed(stepper.model.load[0], stepper.initial, stepper.dt)).any()):
                    break
                stepper.restore(before)
                self.wake(woken)

    def _disturbed(self, load: Float[Tensor, "o 6"], initial: InitialConditions, dt: float) -> Bool[Tensor, "o"]:
        """Mask of the held bodies that the contact forces and torques `load` of the last step dt [s] disturb."""
        friction, height, half_width = (
            np.array([getattr(s, name) for s in self._stances]) for name in ("friction", "height", "half_width")
        )
        mass, gravity = initial.mass[0].cpu().double().numpy(), -float(initial.gravity[0, 2])
        excess = excess_force(load.cpu().double().numpy(), gravity * mass, friction, height, half_width)
        self._impulse = np.where(excess > 0, self._impulse + excess * dt, 0.0)
        return self.asleep & torch.from_numpy(self._impulse > mass * (2 * max(gravity, 0.0) * self._fall) ** 0.5)


def _stance(surfaces: BodySurfaces, row: int, com: Float[Tensor, "3"], friction: float, standing: bool) -> Stance:
    at = surfaces.samples[row, surfaces.near[row] >= 0]
    low, high = (com + corner for corner in (at.amin(0), at.amax(0)))
    half_width = float((high - low)[:2].min()) / 2
    height, leaning = max(float(-at[:, 2].min()), 1e-6), leans(at.numpy(), np.zeros(3))
    return Stance(friction, height, half_width, standing, low.numpy(), high.numpy(), leaning)


def _supports(
    surfaces: BodySurfaces, com: Float[Tensor, "o 3"], stances: list[Stance], gap: float
) -> Bool[Tensor, "o o"]:
    """Mask of the pairs (a, b) in which body a rests on body b.

    Body a is at most `gap` [m] away from the upper side of b and not on the floor; or it leans and is near any side of
    b; or it is above b without touching any body.
    """
    o, k, _ = surfaces.samples.shape
    at, real = com[:, None] + surfaces.samples, surfaces.near >= 0
    out, beside = torch.zeros(2, o, o, dtype=torch.bool)
    for b in range(o):
        depth, slope = surfaces.look_up(torch.full((o * k,), b), (at - com[b]).flatten(0, 1))
        touching = (depth.view(o, k) > -gap) & real
        up = -slope[:, 2].view(o, k)
        out[:, b] |= (touching & (up > SUPPORT_COSINE)).any(1)
        out[b] |= (touching & (up < -SUPPORT_COSINE)).any(1)
        beside[:, b] |= (level := (touching & (up.abs() <= SUPPORT_COSINE)).any(1))
        beside[b] |= level
    for row, stance in enumerate(stances):
        if stance.leaning:
            out[row] |= beside[row]
    out.fill_diagonal_(False)
    for row, stance in enumerate(stances):
        if stance.leaning and bool(out[row].any()):
            continue
        if stance.on_floor:
            out[row] = False
        elif not bool(out[row].any()) and (lower := highest_below(stances, row)) is not None:
            out[row, lower] = True
    return out
