"""An MPM grid that follows the particles: there is a floor, but no walls and no ceiling.

Before a frame in which a particle could come near a face of the grid, the solver is built again on a grid around the
particles, with its nodes on the same lattice, so that nothing else changes.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.errors import InputError
from stages.core.kernels.mpm.grid import BLOCK
from stages.core.physics.mpm import solver as mpm
from stages.core.physics.mpm.body_shapes import BodyShape
from stages.core.scene.scene import SceneObject

log = logging.getLogger(__name__)
MARGIN = 6  # nodes between the particles and the faces of the grid: stencils, and the elastic rebound of what was hit
MAX_SUBSTEPS = 200_000  # of a frame: minutes, where hundreds are usual
FRAMES = 10  # frames for which a new grid has room at the present speed


@dataclass(frozen=True)
class GridBodies:
    """The bodies on a grid, each with its own velocity field."""

    body: Int[Tensor, "p"]  # row of each particle's object in `objects`; particles are in the order of their bodies
    objects: Sequence[SceneObject]
    shapes: Sequence[BodyShape] | None = None  # by default of voxels, see SolverOptions


class MovingGrid:
    """Particles on a grid that follows them; `box` is the first domain [m], and the only one if it is `fixed`.

    Raises InputError for a grid that is too large.
    """

    def __init__(self, particles: mpm.Particles, box: mpm.Box, dx: float, device: str, bodies: GridBodies, fixed: bool):
        self.box, self._bodies, self._fixed, self._dx = box, bodies, fixed, dx
        sizes = torch.bincount(bodies.body).tolist()
        self._copies, self._max_nodes = len(sizes), mpm.max_contact_nodes(device)
        if not fixed and self._nodes(box) > self._max_nodes:
            self.box = self._around(particles.x.amin(0).tolist(), particles.x.amax(0).tolist(), MARGIN * dx)
        options = mpm.SolverOptions(schedule="contact", shapes=bodies.shapes)
        self._build = lambda p, b: mpm.Solver(p, b, dx, device, options, sizes)
        try:
            self.solver = self._build(particles, self.box)
        except ValueError as error:
            remedy = "give a smaller --box" if fixed else "simulate fewer objects, or objects nearer to each other"
            raise InputError(f"--engine mpm: {error}; {remedy}, use a coarser --quality or another --engine") from error

    def advance(self, duration: float, acceleration: Float[Tensor, "p 3"]) -> None:
        """Advance by `duration` [s] under these accelerations [m/s^2], on a new grid where the old one is too small.

        Raises InputError as `substeps` does, and mpm.Diverged.
        """
        self._make_room(duration, acceleration)
        self.solver.advance(duration, acceleration, self.substeps(duration, acceleration))

    def substeps(self, duration: float, acceleration: Float[Tensor, "p 3"]) -> int:
        """Number of substeps in `duration` [s]; InputError for more than MAX_SUBSTEPS, which would take minutes."""
        count = self.solver.substeps(duration, acceleration)
        if count > MAX_SUBSTEPS:
            raise InputError(
                f"--engine mpm: a frame of {duration:g} s takes {count:.2g} substeps, as the grid spacing is "
                f"{self._dx:.2g} m and speeds reach {self._speed(duration, acceleration):.2g} m/s; check the scale of "
                "the scene and what acts on it, or give a smaller --dt or another --engine"
            )
        return count

    def _speed(self, duration: float, acceleration: Float[Tensor, "p 3"]) -> float:
        """Bound of the speed of particles at the end of `duration` [m/s]."""
        return float(self.solver.rows["v"].norm(dim=1).max()) + duration * float(acceleration.norm(dim=1).max())

    def _make_room(self, duration: float, acceleration: Float[Tensor, "p 3"]) -> None:
        """Move the grid if a particle could come near one of its faces, except the floor, within a frame."""
        x, speed, dx = self.solver.rows["x"], self._speed(duration, acceleration), self._dx
        if not math.isfinite(speed) or self._fixed:
            return
        low, high = x.amin(0).tolist(), x.amax(0).tolist()
        reach = duration * speed + MARGIN * dx
        near = any(a - reach < b for a, b in zip(low[:2], self.box.low[:2], strict=True))
        if not near and all(a + reach <= b for a, b in zip(high, self.box.high, strict=True)):
            return
        room = reach + FRAMES * duration * speed
        while self._nodes(box := self._around(low, high, room)) > self._max_nodes and room > reach:
            room *= 0.8
        if self._nodes(box) > self._max_nodes:
            self._fixed = True
            log.warning("%s moves too far from the other objects for one grid, and is stopped at %s; use a coarser "
                        "--quality, or simulate it alone", self._farthest(), self._ends())  # fmt: skip
            return
        self.box = box
        self.solver = self._build(self.solver.particles, box)

    def _around(self, low: Sequence[float], high: Sequence[float], room: float) -> mpm.Box:
        """A box that leaves `room` [m] around the particles, its lower corner on the lattice of the present one."""
        step = BLOCK * self._dx
        corner = [b + step * math.floor((a - room - b) / step) for a, b in zip(low[:2], self.box.low[:2], strict=True)]
        return replace(self.box, low=(*corner, self.box.low[2]), high=tuple(a + room for a in high))

    def _nodes(self, box: mpm.Box) -> float:
        return self._copies * math.prod((b - a) / self._dx + 16 for a, b in zip(box.low, box.high, strict=True))

    def _farthest(self) -> str:
        """The object whose middle is farthest from the median of all."""
        x = self.solver.particles.x.cpu()
        body, objects = self._bodies.body, self._bodies.objects
        middles = torch.stack([x[body == row].mean(0) for row in range(len(objects))])
        o = objects[int((middles - middles.median(0).values).norm(dim=1).argmax())]
        return f"object {o.id} ({o.name})"

    def _ends(self) -> str:
        sides = zip("xyz", self.box.low, self.box.high, strict=True)
        return ", ".join(f"{name} = {low:.3g} and {high:.3g} m" for name, low, high in sides)
