"""MPM substeps as one kernel launch each over three rotating grids: the GPU schedule."""

from __future__ import annotations

import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import launch, view
from stages.core.kernels.mpm.fused import THREADS_PER_BLOCK, fused_step
from stages.core.physics.mpm.graphs import SORT_INTERVAL, GraphedFrames
from stages.core.physics.mpm.particle_rows import ParticleRows


class FusedSubsteps(GraphedFrames):
    """Runs the substeps of a frame; parameters as in SplitSubsteps."""

    def __init__(
        self, rows: ParticleRows, plastic: bool, bouncy: bool, damping: float, obstacles: wp.array,
        scale: tuple[float, float] | None = None,
    ):  # fmt: skip
        super().__init__(rows, damping, obstacles, scale)
        self._kernel = fused_step(plastic, obstacles.shape[0] > 0, bouncy, scale is not None)
        self._rotating = [torch.zeros(self._width * self._count, 4, device=self.device) for _ in range(3)]
        self._clock = torch.zeros(1, device=self.device)

    def _grids(self) -> list[Tensor]:
        return self._rotating

    def _substeps(self, dt: float, steps: int) -> None:
        self._clock.fill_(dt)
        self._launch(0, 0, 1)
        for step in range(1, steps):
            if step % SORT_INTERVAL == 0:
                self.rows.sort()
            self._launch(step, 1, 1)
        self._launch(steps, 1, 0)

    def _launch(self, step: int, gather: int, scatter: int) -> None:
        read, write, stale = (view(self._rotating[(step + shift) % 3], wp.vec4) for shift in (2, 0, 1))
        sweepers = self._sweepers if gather and scatter else 0
        inputs = [self.grid, self.rows.struct, self._sweepers, sweepers, gather, scatter, step - 1,
                  view(self._clock), self.damping, read, write, stale, view(self._friction), self._active,
                  self._obstacles, self._scale]  # fmt: skip
        launch(self._kernel, self._sweepers + sweepers, inputs, device=self.device, block_dim=THREADS_PER_BLOCK)
