"""Rigid colliders of the MPM solver: half-spaces, spheres and boxes, fixed or with prescribed motion.

A collider must be at least four grid cells thick, because its outermost cell belongs to the bodies in contact with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import warp as wp

from stages.core.errors import InputError
from stages.core.kernels.mpm import grid as mpm_grid

KINDS = {"plane": mpm_grid.PLANE, "sphere": mpm_grid.SPHERE, "box": mpm_grid.BOX}
SURFACES = {"separate": mpm_grid.SEPARATE, "slip": mpm_grid.SLIP, "sticky": mpm_grid.STICKY}
Vector = tuple[float | int, float | int, float | int]


@dataclass(frozen=True)
class Collider:
    """A rigid obstacle. Raises InputError for an unknown kind or surface, a missing size or coefficients out of range.

    Surfaces: `separate` lets bodies separate and has Coulomb friction, `slip` has neither separation nor friction, and
    bodies stick to a `sticky` one.
    """

    kind: str  # plane, sphere or box
    centre: Vector  # [m]; any point of the plane
    size: Vector = (0.0, 0.0, 0.0)  # half edges of a box, radius of a sphere first [m]
    rotation: tuple[float | int, float | int, float | int, float | int] = (1.0, 0.0, 0.0, 0.0)  # to world, w x y z
    velocity: Vector = (0.0, 0.0, 0.0)  # [m/s]
    angular_velocity: Vector = (0.0, 0.0, 0.0)  # about the centre [rad/s]
    surface: str = "separate"
    friction: float = 0.5  # Coulomb coefficient
    restitution: float = 0.0  # fraction of normal speed returned; 0: only the body's own elasticity

    def __post_init__(self):
        for what, value, table in (("kind", self.kind, KINDS), ("surface", self.surface, SURFACES)):
            if value not in table:
                raise InputError(f"a collider's {what} must be one of {', '.join(table)}, not {value!r}")
        if min(self.size[: {"plane": 0, "sphere": 1, "box": 3}[self.kind]], default=1) <= 0:
            raise InputError(f"a collider that is a {self.kind} needs a positive size")
        if self.friction < 0 or not 0 <= self.restitution <= 1:
            raise InputError("a collider's friction must be 0 or more, and restitution 0 to 1")

    def advanced(self, duration: float) -> Collider:
        """The collider `duration` [s] later."""
        centre = tuple(c + duration * v for c, v in zip(self.centre, self.velocity, strict=True))
        rate = math.sqrt(sum(s * s for s in self.angular_velocity))
        if not rate:
            return replace(self, centre=centre)
        half = rate * duration / 2
        a = (math.cos(half), *(math.sin(half) * s / rate for s in self.angular_velocity))
        return replace(self, centre=centre, rotation=_product(a, self.rotation))


def _product(a: tuple, b: tuple) -> tuple[float, float, float, float]:
    """Quaternion product a b, w x y z."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return (aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw)  # fmt: skip


def as_obstacles(colliders: Sequence[Collider], device: str) -> wp.array:
    """Colliders as an array for the kernels; empty if there are none."""
    rows = []
    for c in colliders:
        o = mpm_grid.Obstacle()
        o.kind, o.surface = KINDS[c.kind], SURFACES[c.surface]
        o.centre, o.size = wp.vec3(*c.centre), wp.vec3(*c.size)
        length = math.sqrt(sum(q * q for q in c.rotation))
        w, x, y, z = (q / length for q in c.rotation)
        o.turn = wp.quat(x, y, z, w)
        o.velocity, o.spin = wp.vec3(*c.velocity), wp.vec3(*c.angular_velocity)
        o.friction, o.restitution = c.friction, c.restitution
        rows.append(o)
    return wp.array(rows, dtype=mpm_grid.Obstacle, device=device) if rows else wp.empty(0, mpm_grid.Obstacle, device)
