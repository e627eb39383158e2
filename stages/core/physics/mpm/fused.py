"""GPU schedule: MPM substeps as one kernel launch each, over three rotating grids."""

from __future__ import annotations

import torch
from torch import Tensor

from stages.core.kernels.interop import launch, with_arrays
from stages.core.kernels.mpm.fused import THREADS_PER_BLOCK, RotatingNodes, fused_step
from stages.core.kernels.mpm.transfers import Features, substep
from stages.core.physics.mpm.graphs import SORT_INTERVAL, GraphedFrames
from stages.core.physics.mpm.particle_rows import ParticleRows


class FusedSubsteps(GraphedFrames):
    """Runs the substeps of a frame; arguments as in SplitSubsteps, `scale` as in GraphedFrames."""

    def __init__(self, rows: ParticleRows, features: Features, scale: tuple[float, float] | None = None):
        super().__init__(rows, scale)
        self._kernel = fused_step(features, self.grid.obstacles.shape[0] > 0, scale is not None)
        self._rotating = [torch.zeros(self._width * self._count, 4, device=self.device) for _ in range(3)]
        self._nodes = [self._roles(step) for step in range(3)]

    def _grids(self) -> list[Tensor]:
        return self._rotating

    def _substeps(self, dt: float, steps: int) -> None:
        first, between, last = (substep(dt, *done) for done in ((0, 1), (1, 1), (1, 0)))
        self._launch(0, first)
        for step in range(1, steps):
            if step % SORT_INTERVAL == 0:
                self.rows.sort()
            self._launch(step, between)
        self._launch(steps, last)

    def _launch(self, number: int, step) -> None:
        threads = self._active.sweepers * (1 + step.gather * step.scatter)
        inputs = [self.grid, self.rows.struct, self._nodes[number % 3], self._active, step, number - 1]
        launch(self._kernel, threads, inputs, device=self.device, block_dim=THREADS_PER_BLOCK)

    def _roles(self, number: int):
        """The grids in their roles of substep `number`: read, written and cleared."""
        read, write, stale = (self._rotating[(number + shift) % 3] for shift in (2, 0, 1))
        columns = {"read": read, "write": write, "stale": stale, "friction": self._friction}
        nodes = with_arrays(RotatingNodes(), columns)
        nodes.scale = self._scale
        return nodes
