"""MPM substeps of bodies in contact as four kernel launches each: the schedule for a GPU.

These are particles, grid, the nearest particles at nodes, and contact; and where parts of bodies are pinned, the nodes
at their faces.
"""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import launch, view
from stages.core.kernels.mpm.active import contact_sweep, grid_sweep
from stages.core.kernels.mpm.contact import NONE, REFRESH, find_nearest
from stages.core.kernels.mpm.pins import pin_nodes
from stages.core.kernels.mpm.split import particle_step
from stages.core.physics.mpm.body_shapes import BodyContact
from stages.core.physics.mpm.graphs import CLEAR_ALIGNMENT, SORT_INTERVAL, GraphedFrames
from stages.core.physics.mpm.particle_rows import ParticleRows
from stages.core.physics.mpm.pins import Pins


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
        self._nearest = torch.full((self._count,), int(NONE), dtype=torch.int64, device=self.device)
        self._present = torch.arange(rows.scenes, dtype=torch.int32, device=self.device)
        self._lengths: dict[float, Tensor] = {}  # of substeps [s]; the graphs read them
        self._stale = torch.zeros(1, dtype=torch.int32, device=self.device)  # unused
        self._times: dict[tuple[float, int], Tensor] = {}  # of the substeps [s]; the graphs read them
        self._pins: Pins | None = None

    def pin(self, pins: Pins) -> None:
        """Let these pins act from the next frame on."""
        self._pins = pins
        self._graphs.clear()  # they read the pins before

    def _grids(self) -> list[Tensor]:
        return [self._velocity]

    def _substeps(self, dt: float, steps: int) -> None:
        if (dt, steps) not in self._times:
            self._times[dt, steps] = dt * torch.arange(-1, steps, device=self.device, dtype=torch.float32)
        if dt not in self._lengths:
            self._lengths[dt] = torch.full((1,), dt, device=self.device)
        times = self._times[dt, steps]
        self._particles(dt, times, 0, 1)
        active, velocity, friction = self._active, view(self._velocity, wp.vec4), view(self._friction)
        nearest = view(self._nearest)
        for step in range(steps):
            if step and step % SORT_INTERVAL == 0:
                self.rows.sort()
            clock = times[step + 1 :]
            inputs = [self.grid, self._sweepers, view(self._momentum, wp.vec4), velocity, friction, active,
                      self._obstacles, view(clock), self._scale]  # fmt: skip
            launch(grid_sweep, self._sweepers, inputs, device=self.device)
            if self._pins is not None and self._pins.count:
                launch(pin_nodes, self._pins.count, [self._pins.nodes, velocity], device=self.device)
            if step % REFRESH == 0:
                inputs = [self.grid, self.rows.struct, view(self._sharers), nearest]
                launch(find_nearest, len(self.rows), inputs, device=self.device)
            inputs = [self.grid, self._sweepers, self.rows.struct, self._contact.bodies, velocity, nearest,
                      view(self._present), friction, active, view(self._lengths[dt]),
                      int((step + 1) % REFRESH == 0 or step == steps - 1)]  # fmt: skip
            launch(contact_sweep, self._sweepers, inputs, device=self.device)
            self._particles(dt, clock, 1, int(step < steps - 1))

    def _particles(self, dt: float, clock: Tensor, gather: int, scatter: int) -> None:
        inputs = [self.grid, self.rows.struct, 0, len(self.rows), gather, scatter, dt, self.damping,
                  view(self._velocity, wp.vec4), view(self._momentum, wp.vec4), 0, view(self._stale), self._obstacles,
                  view(clock), self._scale, view(self._friction), self._active]  # fmt: skip
        launch(self._step, -(-len(self.rows) // CLEAR_ALIGNMENT) * CLEAR_ALIGNMENT, inputs, device=self.device)
