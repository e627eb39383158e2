"""MPM substeps of bodies in contact as three kernel launches each, particles, grid and contact: the GPU schedule."""

from __future__ import annotations

from typing import NamedTuple

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from stages.core.kernels.interop import launch, view
from stages.core.kernels.mpm.active import contact_sweep, grid_sweep
from stages.core.kernels.mpm.split import particle_step
from stages.core.physics.mpm.graphs import CLEAR_ALIGNMENT, SORT_INTERVAL, GraphedFrames
from stages.core.physics.mpm.particle_rows import ParticleRows


class BodyContact(NamedTuple):
    """Parameters of the contact between bodies, one value per body."""

    full_cell: Float[Tensor, "s"]  # mass of a filled grid cell, as it is on the grid [kg]
    friction: Float[Tensor, "s"]  # Coulomb coefficient


class ContactSubsteps(GraphedFrames):
    """Runs the substeps of a frame; the scenes of `rows` are bodies in contact. Parameters as in SplitSubsteps."""

    def __init__(
        self, rows: ParticleRows, plastic: bool, bouncy: bool, damping: float, obstacles: wp.array,
        contact: BodyContact, scale: tuple[float, float],
    ):  # fmt: skip
        super().__init__(rows, damping, obstacles, scale)
        self._step, self._contact = particle_step(plastic, bouncy, exact=True), contact
        self._velocity = torch.zeros(self._count, 4, device=self.device)
        self._momentum = torch.zeros(2 * self._count, 4, device=self.device)
        self._stale = torch.zeros(1, dtype=torch.int32, device=self.device)  # unused
        self._times: dict[tuple[float, int], Tensor] = {}  # of the substeps [s]; the graphs read them

    def _grids(self) -> list[Tensor]:
        return [self._velocity]

    def _substeps(self, dt: float, steps: int) -> None:
        if (dt, steps) not in self._times:
            self._times[dt, steps] = dt * torch.arange(-1, steps, device=self.device, dtype=torch.float32)
        times = self._times[dt, steps]
        self._particles(dt, times, 0, 1)
        active, velocity, friction = self._active, view(self._velocity, wp.vec4), view(self._friction)
        for step in range(steps):
            if step and step % SORT_INTERVAL == 0:
                self.rows.sort()
            clock = times[step + 1 :]
            inputs = [self.grid, self._sweepers, view(self._momentum, wp.vec4), velocity, friction, active,
                      self._obstacles, view(clock), self._scale]  # fmt: skip
            launch(grid_sweep, self._sweepers, inputs, device=self.device)
            if self.rows.scenes > 1:
                full, mu = (view(t) for t in self._contact)
                inputs = [self.grid, self._sweepers, velocity, full, mu, friction, active]
                launch(contact_sweep, self._sweepers, inputs, device=self.device)
            self._particles(dt, clock, 1, int(step < steps - 1))

    def _particles(self, dt: float, clock: Tensor, gather: int, scatter: int) -> None:
        inputs = [self.grid, self.rows.struct, 0, len(self.rows), gather, scatter, dt, self.damping,
                  view(self._velocity, wp.vec4), view(self._momentum, wp.vec4), 0, view(self._stale), self._obstacles,
                  view(clock), self._scale, view(self._friction), self._active]  # fmt: skip
        launch(self._step, -(-len(self.rows) // CLEAR_ALIGNMENT) * CLEAR_ALIGNMENT, inputs, device=self.device)
