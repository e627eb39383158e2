"""MPM substeps as one kernel launch each over three rotating grids, a frame as one CUDA graph: the GPU schedule.

The host reads nothing within a frame. The schedule also runs on the CPU, on one thread, where tests compare the two.
"""

from __future__ import annotations

import torch
import warp as wp

from stages.core.kernels.interop import launch, view
from stages.core.kernels.mpm.fused import THREADS_PER_BLOCK, ActiveBlocks, clear_active_blocks, fused_step
from stages.core.kernels.mpm.grid import BLOCK
from stages.core.physics.mpm.particle_rows import ParticleRows

SORT_INTERVAL = 100  # substeps after which particles are sorted by cell again
CLEAR_ALIGNMENT = 256  # the threads that clear the grid begin at a multiple of this
MAX_GRAPHS = 24  # CUDA graphs kept, one per number of substeps


class FusedSubsteps:
    """Runs the substeps of a frame for the particles in `rows`; parameters as in SplitSubsteps."""

    def __init__(
        self, rows: ParticleRows, plastic: bool, bouncy: bool, damping: float, obstacles: wp.array,
        scale: tuple[float, float] | None = None,
    ):  # fmt: skip
        """`scale`: fixed-point units of momentum and mass for exact sums, see core/kernels/mpm/exact.py."""
        self.rows, self.grid, self.device, self.damping = rows, rows.grid, rows.device, damping
        self._kernel = fused_step(plastic, obstacles.shape[0] > 0, bouncy, scale is not None)
        self._obstacles = obstacles
        count = rows.scenes * self.grid.count
        self._width, self._scale = (1, wp.vec2()) if scale is None else (2, wp.vec2(*scale))
        self._grids = [torch.zeros(self._width * count, 4, device=self.device) for _ in range(3)]
        self._friction = torch.zeros(count, device=self.device)
        ints = {"dtype": torch.int32, "device": self.device}
        self._marks = torch.zeros(count // BLOCK**3, **ints)
        self._blocks, self._total = torch.zeros_like(self._marks), torch.zeros(1, **ints)
        self._active = ActiveBlocks()
        self._active.marks, self._active.blocks = view(self._marks), view(self._blocks)
        self._active.total = view(self._total)
        self._clock = torch.zeros(1, device=self.device)
        self._last_total = torch.zeros(1, **ints)
        self._sweep_from = -(-len(rows) // CLEAR_ALIGNMENT) * CLEAR_ALIGNMENT
        self._graphs: dict[int, torch.cuda.CUDAGraph | None] = {}
        self._pool = torch.cuda.graph_pool_handle() if self.device != "cpu" else None

    def frame(self, dt: float, steps: int) -> None:
        """Take `steps` substeps of `dt` [s]: launched one by one the first time with this `steps`, then as a graph."""
        self._clock.fill_(dt)
        if self.device == "cpu":
            self._run(steps)
            return
        with torch.cuda.device(self.device):
            if steps not in self._graphs:
                self._run(steps)
                if len(self._graphs) >= MAX_GRAPHS:
                    self._graphs.pop(next(iter(self._graphs)))
                self._graphs[steps] = None
                return
            if self._graphs[steps] is None:
                graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(graph, pool=self._pool):
                    self._run(steps)
                self._graphs[steps] = graph
            self._graphs[steps].replay()

    @property
    def blocks(self) -> int:
        """Number of grid blocks that were active in the last frame."""
        return int(self._last_total[0])

    def _run(self, steps: int) -> None:
        self.rows.sort()
        self.rows["base_node"].fill_(-1)
        self._launch(0, 0, 1)
        for step in range(1, steps):
            if step % SORT_INTERVAL == 0:
                self.rows.sort()
            self._launch(step, 1, 1)
        self._launch(steps, 1, 0)
        self._last_total.copy_(self._total)
        grids = [view(g, wp.vec4) for g in self._grids]
        inputs = [self.grid, self._sweep_from, *grids, view(self._friction), self._active, self._width]
        launch(clear_active_blocks, self._sweep_from, inputs, device=self.device)
        self._total.zero_()

    def _launch(self, step: int, gather: int, scatter: int) -> None:
        read, write, stale = (view(self._grids[(step + shift) % 3], wp.vec4) for shift in (2, 0, 1))
        sweepers = self._sweep_from if gather and scatter else 0
        inputs = [self.grid, self.rows.struct, self._sweep_from, sweepers, gather, scatter, step - 1,
                  view(self._clock), self.damping, read, write, stale, view(self._friction), self._active,
                  self._obstacles, self._scale]  # fmt: skip
        launch(self._kernel, self._sweep_from + sweepers, inputs, device=self.device, block_dim=THREADS_PER_BLOCK)
