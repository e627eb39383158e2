"""An MPM grid that follows the particles, so that there is a floor but no walls and no ceiling.

Before a frame in which a particle could come near a face of the grid, the solver is rebuilt on a grid around the
particles. The nodes of both grids are on the same lattice, so that the result does not change.
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
MARGIN = 6  # nodes between the particles and the faces of the grid, for stencils and the elastic rebound after impacts
MAX_SUBSTEPS = 200_000  # substeps per frame, which take minutes; hundreds are usual
FRAMES = 10  # number of frames for which a new grid has room at the present speed


@dataclass(frozen=True)
class GridBodies:
    """The bodies on a grid, each with its own velocity field."""

    body: Int[Tensor, "p"]  # row of each particle's object in `objects`, ascending
    objects: Sequence[SceneObject]
    shapes: Sequence[BodyShape] | None = None  # by default made of voxels, see SolverOptions


class MovingGrid:
    """An MPM solver whose grid follows its particles.

    `box` is the initial domain [m]; a `fixed` domain never moves. `dx` is the grid spacing [m]. Raises InputError for a
    grid that is too large.
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
        """Advance by `duration` [s] with these accelerations [m/s^2], on a new grid if the present one is too small.

        Raises InputError for more than MAX_SUBSTEPS, and mpm.Diverged.
        """
        self._make_room(duration, acceleration)
        self.solver.advance(duration, acceleration, self.substeps(duration, acceleration))

    def substeps(self, duration: float, acceleration: Float[Tensor, "p 3"]) -> int:
        """Number of substeps in `duration` [s]. Raises InputError for more than MAX_SUBSTEPS."""
        count = self.solver.substeps(duration, acceleration)
        if count > MAX_SUBSTEPS:
            raise InputError(
                f"--engine mpm: a frame of {duration:g} s takes {count:.2g} substeps, as the grid spacing is "
                f"{self._dx:.2g} m and speeds reach {self._speed(duration, acceleration):.2g} m/s; check the scale of "
                "the scene and what acts on it, or give a smaller --dt or another --engine"
            )
        return count

    def _speed(self, duration: float, acceleration: Float[Tensor, "p 3"]) -> float:
        """Estimate of the highest particle speed at the end of `duration`, without elastic forces [m/s]."""
        return float(self.solver.rows["v"].norm(dim=1).max()) + duration * float(acceleration.norm(dim=1).max())

    def _make_room(self, duration: float, acceleration: Float[Tensor, "p 3"]) -> None:
        """Move the grid if a particle could come near one of its faces other than the floor within `duration` [s].

        If the grid would be too large, it stays where it is from then on, and a warning says so.
        """
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
            log.warning("%s moves too far away from the other objects for one grid and is stopped at %s; use a coarser "
                        "--quality, or simulate it alone", self._farthest(), self._ends())  # fmt: skip
            return
        self.box = box
        self.solver = self._build(self.solver.particles, box)

    def _around(self, low: Sequence[float], high: Sequence[float], room: float) -> mpm.Box:
        """A box with `room` [m] around the bounds of the particles; its lower corner is on the present lattice."""
        step = BLOCK * self._dx
        corner = [b + step * math.floor((a - room - b) / step) for a, b in zip(low[:2], self.box.low[:2], strict=True)]
        return replace(self.box, low=(*corner, self.box.low[2]), high=tuple(a + room for a in high))

    def _nodes(self, box: mpm.Box) -> float:
        return self._copies * math.prod((b - a) / self._dx + 16 for a, b in zip(box.low, box.high, strict=True))

    def _farthest(self) -> str:
        """The object whose mean position is farthest from the median of those of all objects, for a message."""
        x = self.solver.particles.x.cpu()
        body, objects = self._bodies.body, self._bodies.objects
        middles = torch.stack([x[body == row].mean(0) for row in range(len(objects))])
        o = objects[int((middles - middles.median(0).values).norm(dim=1).argmax())]
        return f"object {o.id} ({o.name})"

    def _ends(self) -> str:
        sides = zip("xyz", self.box.low, self.box.high, strict=True)
        return ", ".join(f"{name} = {low:.3g} and {high:.3g} m" for name, low, high in sides)
