"""GPU schedule for bodies in contact: MPM substeps of up to five kernel launches each.

They are the particle step, the grid step, the search for the nearest particle of each node (every REFRESH substeps),
the contact step and, if parts of bodies are pinned, the step of the nodes at the faces of these parts.
"""

from __future__ import annotations

import torch
from torch import Tensor

from stages.core.kernels.interop import launch, view, with_arrays
from stages.core.kernels.mpm.active import contact_sweep, grid_sweep
from stages.core.kernels.mpm.contact import NONE, REFRESH, find_nearest
from stages.core.kernels.mpm.grid import NodeArrays
from stages.core.kernels.mpm.pins import pin_nodes
from stages.core.kernels.mpm.split import ParticlePart, particle_step
from stages.core.kernels.mpm.transfers import Features, substep
from stages.core.physics.mpm.body_shapes import BodyContact
from stages.core.physics.mpm.graphs import SORT_INTERVAL, GraphedFrames
from stages.core.physics.mpm.particle_rows import ParticleRows
from stages.core.physics.mpm.pins import Pins


class ContactSubsteps(GraphedFrames):
    """Runs the substeps of a frame; the scenes of `rows` are bodies in contact. Parameters as in SplitSubsteps."""

    def __init__(self, rows: ParticleRows, features: Features, contact: BodyContact, scale: tuple[float, float]):
        super().__init__(rows, scale)
        self._step, self._contact = particle_step(features, exact=True), contact
        self._velocity = torch.zeros(self._count, 4, device=self.device)
        self._momentum = torch.zeros(2 * self._count, 4, device=self.device)
        self._nearest = torch.full((self._count,), int(NONE), dtype=torch.int64, device=self.device)
        columns = {"velocity": self._velocity, "momentum": self._momentum, "friction": self._friction}
        self._nodes = with_arrays(NodeArrays(), columns)
        self._nodes.nearest, self._nodes.scale = view(self._nearest), self._scale
        self._part = ParticlePart()
        self._part.stop = len(rows)
        self._times: dict[tuple[float, int], Tensor] = {}  # of the substeps [s]; kept because the graphs read them
        self._pins: Pins | None = None

    def pin(self, pins: Pins) -> None:
        """Let these pins act from the next frame on."""
        self._pins = pins
        self._graphs.clear()  # the captured graphs read the previous pins

    def _grids(self) -> list[Tensor]:
        return [self._velocity]

    def _substeps(self, dt: float, steps: int) -> None:
        if (dt, steps) not in self._times:
            self._times[dt, steps] = dt * torch.arange(-1, steps, device=self.device, dtype=torch.float32)
        times = self._times[dt, steps]
        self._particles(substep(dt, 0, 1, view(times)))
        nodes, active = self._nodes, self._active
        for n in range(steps):
            if n and n % SORT_INTERVAL == 0:
                self.rows.sort()
            last = n == steps - 1
            step = substep(dt, 1, int(not last), view(times[n + 1 :]), int(last or (n + 1) % REFRESH == 0))
            launch(grid_sweep, active.sweepers, [self.grid, nodes, active, step], device=self.device)
            if self._pins is not None and self._pins.count:
                launch(pin_nodes, self._pins.count, [self._pins.nodes, nodes.velocity], device=self.device)
            if n % REFRESH == 0:
                inputs = [self.grid, self.rows.struct, active.sharers, nodes.nearest]
                launch(find_nearest, len(self.rows), inputs, device=self.device)
            inputs = [self.grid, self.rows.struct, self._contact.bodies, nodes, active, step]
            launch(contact_sweep, active.sweepers, inputs, device=self.device)
            self._particles(step)

    def _particles(self, step) -> None:
        inputs = [self.grid, self.rows.struct, self._part, self._nodes, self._active, step]
        launch(self._step, self._active.sweepers, inputs, device=self.device)
