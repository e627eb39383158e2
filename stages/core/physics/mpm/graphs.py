"""Base class of the GPU schedules: the substeps of a frame as one CUDA graph.

The host does not synchronise with the device within a frame. The schedules also run on the CPU, on one thread, for
comparison in tests.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
import warp as wp

from stages.core.kernels.cuda_graphs import captured
from stages.core.kernels.interop import launch, view, with_arrays
from stages.core.kernels.mpm.active import ActiveBlocks, clear_active_blocks
from stages.core.kernels.mpm.grid import BLOCK
from stages.core.physics.mpm.particle_rows import ParticleRows

SORT_INTERVAL = 100  # substeps after which particles are sorted by cell again
CLEAR_ALIGNMENT = 256  # the threads that clear the grid start at a multiple of this
MAX_GRAPHS = 24  # CUDA graphs kept, one per substep duration and number of substeps


class GraphedFrames(ABC):
    """Runs the substeps of a frame for the particles in `rows`; parameters as in SplitSubsteps."""

    def __init__(self, rows: ParticleRows, scale: tuple[float, float] | None):
        """`scale`: fixed-point units of momentum and mass for exact sums, see core/kernels/mpm/exact.py."""
        self.rows, self.grid, self.device = rows, rows.grid, rows.device
        self._count = rows.scenes * self.grid.count
        self._width, self._scale = (1, wp.vec2()) if scale is None else (2, wp.vec2(*scale))
        self._friction = torch.zeros(self._count, device=self.device)
        ints = {"dtype": torch.int32, "device": self.device}
        self._marks = torch.zeros(self._count // BLOCK**3, **ints)
        self._blocks, self._total = torch.zeros_like(self._marks), torch.zeros(1, **ints)
        self._sharers = torch.zeros(self.grid.count // BLOCK**3, **ints)
        columns = {"marks": self._marks, "blocks": self._blocks, "total": self._total, "sharers": self._sharers}
        self._active = with_arrays(ActiveBlocks(), columns)
        self._active.sweepers = -(-len(rows) // CLEAR_ALIGNMENT) * CLEAR_ALIGNMENT
        self._last_total = torch.zeros(1, **ints)
        self._graphs: dict[tuple[float, int], torch.cuda.CUDAGraph | None] = {}
        self._pool = torch.cuda.graph_pool_handle() if self.device != "cpu" else None

    @abstractmethod
    def _substeps(self, dt: float, steps: int) -> None:
        """Launch the kernels of `steps` substeps of `dt` [s]."""

    @abstractmethod
    def _grids(self) -> list[torch.Tensor]:
        """One to three grids of the same size to clear at the end of a frame."""

    def frame(self, dt: float, steps: int) -> None:
        """Take `steps` substeps of `dt` [s]: kernel by kernel the first time with these arguments, then as a graph."""
        if self.device == "cpu":
            self._run(dt, steps)
            return
        with torch.cuda.device(self.device):
            key = (dt, steps)
            if key not in self._graphs:
                self._run(dt, steps)
                if len(self._graphs) >= MAX_GRAPHS:
                    self._graphs.pop(next(iter(self._graphs)))
                self._graphs[key] = None
                return
            if self._graphs[key] is None:
                self._graphs[key] = captured(lambda: self._run(dt, steps), pool=self._pool)
            self._graphs[key].replay()

    @property
    def blocks(self) -> int:
        """Number of grid blocks that were active in the last frame."""
        return int(self._last_total[0])

    def _run(self, dt: float, steps: int) -> None:
        self.rows.sort()
        self.rows["base_node"].fill_(-1)
        self._substeps(dt, steps)
        self._last_total.copy_(self._total)
        grids = self._grids()
        a, b, c = (view(grids[min(k, len(grids) - 1)], wp.vec4) for k in range(3))
        inputs = [self.grid, a, b, c, view(self._friction), self._active]
        launch(clear_active_blocks, self._active.sweepers, inputs, device=self.device)
        self._total.zero_()
