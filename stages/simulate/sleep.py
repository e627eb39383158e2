"""Sleeping objects: objects at rest at the start keep their position until another object hits them.

Photos show a static equilibrium, which a learned force field maintains only approximately, and reconstructed objects
overlap slightly and would be pushed apart. Rigid-body engines put islands of bodies at rest to sleep in the same way.

Limits: contact in any direction counts as support, so an object in mid-air that touches a supported one sleeps too.
Objects that come to rest later do not fall asleep.
"""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.models.field.narrow_phase import nearest
from stages.core.models.initial_conditions import InitialConditions
from stages.core.models.rollout import TimeStepper

CONTACT_DISTANCE = 0.05  # distance at which objects touch, in addition to half the keypoint spacing [m]
INITIAL_CONTACT_DISTANCE = 0.1  # contact distance at the start, as photos show little of contact regions [m]
WAKE_SPEED = 0.25  # minimum speed that a perfectly inelastic impact must give an object to wake it [m/s]


class SleepState:
    """Tracks which of `o` objects are `asleep`.

    At the start, objects that are not `awake` sleep if they are `standing` on the floor or touch a supported sleeping
    object. Contacts are found on the device of `initial`; masks of objects are on the CPU.
    """

    def __init__(self, initial: InitialConditions, awake: Bool[Tensor, "o"], standing: Bool[Tensor, "o"]):
        self.valid, self.mass = initial.valid, initial.mass[0].clamp_min(1e-6)
        self.spacing = _keypoint_spacing(initial)
        near = self._near(initial.points, INITIAL_CONTACT_DISTANCE).any(-1).cpu()
        self.in_contact = near | near.T
        self.standing, self.asleep = standing, ~awake
        self._wake_unsupported()
        self._before = initial.points

    def advance(self, stepper: TimeStepper, steps: int, pinned: Bool[Tensor, "o"]) -> None:
        """Make the steps of one frame without moving `pinned` and sleeping objects; then wake those that are hit."""
        stepper.external.pinned.copy_(pinned | self.asleep)
        for _ in range(steps):
            stepper.step()
        points = stepper.points.clone()
        self.wake_on_impact(points, (points - self._before) / (steps * stepper.dt))
        self._before = points

    def wake_on_impact(self, points: Float[Tensor, "1 o n 3"], speed: Float[Tensor, "1 o n 3"]) -> None:
        """Wake objects hit by an awake object, and those that they supported.

        `points` [m] and their velocities `speed` [m/s] are in model units.
        """
        if not bool(self.asleep.any()):
            return
        ratio = self.mass[:, None] / (self.mass[:, None] + self.mass)
        fast = speed[0].norm(dim=-1)[:, None] * ratio[..., None] > WAKE_SPEED
        hit = (self._near(points, CONTACT_DISTANCE) & fast).any(-1).cpu() & ~self.asleep[:, None]
        self.wake(hit.any(0))

    def wake(self, rows: Bool[Tensor, "o"]) -> None:
        """Wake these objects and those that they supported."""
        self.asleep = self.asleep & ~rows
        self._wake_unsupported()

    def _near(self, points: Float[Tensor, "1 o n 3"], gap: float) -> Bool[Tensor, "o o n"]:
        """Mask [i, j, k]: keypoint k of object i touches object j."""
        limit = gap + torch.maximum(self.spacing[:, None], self.spacing) / 2
        distance, _ = nearest(points, self.valid, float(limit.max()))
        return distance[0] < limit[..., None]

    def _wake_unsupported(self) -> None:
        """Wake sleeping objects that neither stand on the floor nor touch a supported sleeping object."""
        supported = self.asleep & self.standing
        while True:
            more = supported | (self.asleep & (self.in_contact & supported).any(-1))
            if bool((more == supported).all()):
                break
            supported = more
        self.asleep = supported


def _keypoint_spacing(initial: InitialConditions) -> Float[Tensor, "o"]:
    """Approximate keypoint spacing of each object [m], as if keypoints were spread over its bounding box's surface."""
    hidden = ~initial.valid[0, ..., None]
    high = initial.points[0].masked_fill(hidden, -torch.inf).amax(1)
    a, b, c = (high - initial.points[0].masked_fill(hidden, torch.inf).amin(1)).unbind(-1)
    return (2 * (a * b + b * c + c * a) / initial.valid[0].sum(-1)).sqrt()
