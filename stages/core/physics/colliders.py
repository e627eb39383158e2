"""Solids in the way of particles: half-spaces, balls and boxes, still or moving as prescribed.

A collider needs to be at least four cells thick: the outermost cell of it is left to the bodies that rest on it.
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
    """What touches it may `separate` again, with friction; `slip` along it but not leave; or be `sticky`, and stay."""

    kind: str  # plane, sphere or box
    centre: Vector  # [m]; any point of the plane
    size: Vector = (0.0, 0.0, 0.0)  # half edges of a box; the first is the radius of a sphere [m]
    rotation: tuple[float | int, float | int, float | int, float | int] = (1.0, 0.0, 0.0, 0.0)  # to world, w x y z
    velocity: Vector = (0.0, 0.0, 0.0)  # [m/s]
    angular_velocity: Vector = (0.0, 0.0, 0.0)  # about the centre [rad/s]
    surface: str = "separate"
    friction: float = 0.5  # Coulomb coefficient
    restitution: float = 0.0  # 0: a body bounces by its own elasticity; up to 1: this gives back that share of speed

    def __post_init__(self):
        for what, value, table in (("kind", self.kind, KINDS), ("surface", self.surface, SURFACES)):
            if value not in table:
                raise InputError(f"a collider's {what} is one of {', '.join(table)}, not {value!r}")
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
    """Quaternion a b, w x y z."""
    (aw, ax, ay, az), (bw, bx, by, bz) = a, b
    return (aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw)  # fmt: skip


def as_obstacles(colliders: Sequence[Collider], device: str) -> wp.array:
    """For the kernels; of length 0 when there are none."""
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
