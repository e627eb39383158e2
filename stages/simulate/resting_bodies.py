"""Rigid bodies of photos, held at rest until their equilibrium is disturbed.

Photos show a static equilibrium, but not everything that maintains it: undersides, the relief of the table and
unlabelled objects are missing. So every body is held until a body that it rests or leans on is released (if it touches
none, the highest one below it), until the user acts on it, or until contact forces exceed what weight and friction can
resist. A contact force F slides a body of mass m if |Fxy| > friction (m g - Fz), lifts it if Fz > m g, and tips it over
if its moment about the base exceeds (m g - Fz) times half the shorter horizontal side. The excess must last until it
would have accelerated the body to RELEASE_SPEED. Held bodies have so much inertia that contacts do not move them, and
do not collide with each other.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

HELD_MASS = 1e6  # inertia added to a held body, relative to its own mass or the median mass, whichever is larger
RELEASE_SPEED = 0.1  # speed at which a disturbed body is released [units]; from a fall of 0.5 % of the smallest size
SUPPORT_GAP = 0.05  # largest gap between a body and its support, as photos show little of contact regions [units]
SUPPORT_COSINE = 0.5  # smallest vertical component of the unit normal of a contact that supports
BASE = 0.1  # height above the lowest point below which points belong to the base, as undersides are ragged [height]
BEYOND = 0.02  # smallest horizontal distance of the centre of mass beyond the base of a leaning body [height]
FREE, FALLING = 7, 6  # numbers of position and velocity coordinates of a free joint


@dataclass(frozen=True)
class Stance:
    """Properties that determine how a body at rest resists disturbances, in simulation units."""

    friction: float
    height: float  # of the centre of mass above the lowest point
    half_width: float  # half the shorter horizontal side
    on_floor: bool
    low: np.ndarray  # (3,), lower corner of the axis-aligned bounds
    high: np.ndarray  # (3,), upper corner of the axis-aligned bounds
    leaning: bool = False  # would fall over without lateral support


class RestingBodies:
    """Tracks which bodies of a MuJoCo model are held. Bodies are numbered as in the model: 0 is the world."""

    def __init__(self, model, stances: list[Stance], pairs: np.ndarray, normals: np.ndarray, at_rest: Iterable[int]):
        """`stances` of the bodies from 1 on; `pairs` (k, 2) of bodies that touch at rest, with gaps of up to
        SUPPORT_GAP; contact normals (k, 3) from the first to the second body; bodies `at_rest` are held.
        """
        self._model = model
        self._bodies = model.dof_bodyid[::FALLING].copy()  # body of each free joint
        self._stances = [stances[i - 1] for i in self._bodies]
        self._friction, self._height, self._half_width = (
            np.array([getattr(s, name) for s in self._stances]) for name in ("friction", "height", "half_width")
        )
        self.resting_on = _supports(stances, pairs, normals[:, 2])
        self.held = np.isin(self._bodies, list(at_rest))
        self.fixed = np.ones(model.nbody, bool)  # mask of the bodies of the model that do not move
        self.fixed[self._bodies] = self.held
        self._impulse = np.zeros(len(self._bodies))
        self._added = np.where(self.held, HELD_MASS * np.maximum(1.0, model.body_mass[self._bodies]), 0.0)
        self._add_inertia(self._added)
        self._set_collisions()

    def _add_inertia(self, added: np.ndarray) -> None:
        each = np.repeat(added, FALLING)
        self._model.dof_armature += each
        self._model.dof_M0 += each  # MuJoCo takes the inertia of bodies with a diagonal tensor from here

    def _set_collisions(self) -> None:
        """Let only those pairs collide of which at least one body moves."""
        model = self._model
        model.body_contype[:] = np.where(self.fixed, 1, 3)
        model.body_conaffinity[:] = np.where(self.fixed, 2, 3)
        model.geom_contype[:] = model.body_contype[model.geom_bodyid]
        model.geom_conaffinity[:] = model.body_conaffinity[model.geom_bodyid]

    def restore(self, data, start: np.ndarray) -> None:
        """Reset the held bodies to their rows of `start` (n, 7), the coordinates of all free bodies."""
        if self.held.any():
            data.qpos.reshape(-1, FREE)[self.held] = start[self.held]
            data.qvel.reshape(-1, FALLING)[self.held] = 0

    def release_disturbed(self, data) -> list[int]:
        """Release and return the bodies that the contact forces of this substep would move.

        If any are released, contact forces must be computed again, since these bodies can now move.
        """
        if not self.held.any():
            return []
        model = self._model
        wrench = data.qfrc_constraint.reshape(-1, FALLING)  # held bodies are not rotated: torques are in world axes too
        mass = model.body_mass[self._bodies]
        excess = excess_force(wrench, -model.opt.gravity[2] * mass, self._friction, self._height, self._half_width)
        impulse = np.where(excess > 0, self._impulse + excess * model.opt.timestep, 0.0)
        moved = self.held & (impulse > mass * RELEASE_SPEED)
        if moved.any():
            return self.release(self._bodies[moved])
        self._impulse = impulse
        return []

    def release(self, bodies: Iterable[int]) -> list[int]:
        """Release bodies and, recursively, those that rest on them; returns those that were held."""
        todo, done, released = [int(i) for i in bodies], set(), []
        while todo:
            i = todo.pop()
            if i not in done:
                done.add(i)
                todo += self.resting_on.get(i, ())
                released += [i] if self.fixed[i] and i in self._bodies else []
        if released:
            rows = np.isin(self._bodies, released)
            self._add_inertia(np.where(rows, -self._added, 0.0))
            self.held &= ~rows
            self.fixed[released] = False
            self._set_collisions()
        return released


def excess_force(
    wrench: np.ndarray, weight: np.ndarray, friction: np.ndarray, height: np.ndarray, half_width: np.ndarray
) -> np.ndarray:
    """Contact force (k,) in excess of what weight and friction resist; negative if the equilibrium holds.

    `wrench` (k, 6): contact forces, and torques about the centres of mass. The other arguments (k,) are as in Stance.
    The conditions are those of the module docstring; the excess moment of tipping is divided by the height.
    """
    load = weight - wrench[:, 2]
    push = np.hypot(wrench[:, 0], wrench[:, 1])
    moment = np.hypot(wrench[:, 3] - height * wrench[:, 1], wrench[:, 4] + height * wrench[:, 0])
    pressing = np.maximum(load, 0)
    excess = np.maximum(push - friction * pressing, (moment - half_width * pressing) / height)
    return np.maximum(excess, -load)


def leans(points: np.ndarray, com: np.ndarray) -> bool:
    """Whether the centre of mass (3,) of a body with these surface points (n, 3) is horizontally outside its base."""
    height = np.ptp(points[:, 2])
    base = points[points[:, 2] < points[:, 2].min() + BASE * height, :2]
    way = com[:2] - base.mean(0)
    return bool(((com[:2] - base) @ way).min() > BEYOND * height * np.linalg.norm(way))


def _supports(stances: list[Stance], pairs: np.ndarray, upwards: np.ndarray) -> dict[int, set[int]]:
    """Map each body to the bodies that rest on it.

    These touch it from above and are not on the floor, or lean and touch it at any angle, or are above it without
    touching any body.
    """
    found: dict[int, set[int]] = {}
    of = np.where(pairs > len(stances), 0, pairs)  # ground bodies are fixed, like the world
    for pair, up in zip(of, upwards, strict=True):
        lower, upper = map(int, pair if up > 0 else pair[::-1])
        if lower == 0 or upper == 0:
            continue
        steep = abs(up) > SUPPORT_COSINE
        if stances[upper - 1].leaning or (steep and not stances[upper - 1].on_floor):
            found.setdefault(lower, set()).add(upper)
        if stances[lower - 1].leaning and not steep:
            found.setdefault(upper, set()).add(lower)
    supported = set().union(*found.values())
    for i, s in enumerate(stances):
        if not s.on_floor and i + 1 not in supported and (lower := highest_below(stances, i)) is not None:
            found.setdefault(lower + 1, set()).add(i + 1)
    return found


def highest_below(stances: list[Stance], row: int) -> int | None:
    """Row of the stance with the highest top among those under the middle of the stance `row`; None without any."""
    own = stances[row]
    middle = (own.low + own.high) / 2
    under = [k for k, s in enumerate(stances) if k != row and s.high[2] < middle[2]
             and (s.low[:2] < middle[:2]).all() and (middle[:2] < s.high[:2]).all()]  # fmt: skip
    return max(under, key=lambda k: stances[k].high[2], default=None)
