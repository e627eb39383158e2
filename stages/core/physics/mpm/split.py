"""Substeps as two launches, particles and grid: fastest on a CPU, where several threads launch side by side.

The particles are split into fixed parts, each with its own copy of the momentum, so that a run gives the same bytes
whatever the number of threads.
"""

from __future__ import annotations

import os
import threading
from functools import cache

import numpy as np
import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import launch, view
from stages.core.kernels.mpm import split as kernels
from stages.core.physics.mpm.particle_rows import ParticleRows

PARTS = 4  # of the particles, on the CPU
WARP = 32


class SplitSubsteps:
    """Runs frames of the particles in `rows`."""

    def __init__(self, rows: ParticleRows, plastic: bool, bouncy: bool, damping: float, obstacles: wp.array):
        self.rows, self.grid, self.device, self.damping = rows, rows.grid, rows.device, damping
        self.parts = PARTS if self.device == "cpu" else 1
        self._step, self._obstacles = kernels.particle_step(plastic, bouncy), obstacles
        self._count = rows.scenes * self.grid.count
        self._velocity = _lazy_zeros((self._count, 4), self.device)
        self._momentum = _lazy_zeros((self.parts * self._count, 4), self.device)
        self._friction = _lazy_zeros((self._count,), self.device)
        shape = [n // kernels.BLOCK for n in self.grid.nodes]
        self._marks = torch.zeros(rows.scenes, *shape, dtype=torch.int32, device=self.device)
        self._stale = torch.zeros(1, dtype=torch.int32, device=self.device)
        self._clock = torch.zeros(1, device=self.device)
        self._blocks = torch.zeros(0, 2, dtype=torch.int32, device=self.device)

    def frame(self, dt: float, steps: int) -> None:
        """`steps` substeps of `dt` [s]."""
        self._forget_friction()
        self.rows.sort()
        self._clock.fill_(-dt)
        self._run(self._particles(dt, gather=0, scatter=1))
        self._mark()
        between, last = self._particles(dt, 1, 1), self._particles(dt, 1, 0)
        for step in range(steps):
            if int(self._stale[0]):
                self._mark()
            self._clock.fill_(step * dt)
            self._run(self._grid_commands)
            self._run(last if step == steps - 1 else between)

    @property
    def blocks(self) -> int:
        """Blocks that are read, written and cleared now."""
        return len(self._blocks)

    def _particles(self, dt: float, gather: int, scatter: int) -> list[wp.Launch]:
        # wp.Launch keeps these views, and they keep the tensors
        grids = view(self._velocity, wp.vec4), view(self._momentum, wp.vec4)
        return [
            self._record(self._step, -(-(stop - start) // WARP) * WARP,
                         [self.grid, self.rows.struct, start, stop, gather, scatter, dt, self.damping, *grids,
                          part * self._count, view(self._stale), self._obstacles, view(self._clock)])
            for part, (start, stop) in enumerate(self._ranges(len(self.rows)))
        ]  # fmt: skip

    def _mark(self) -> None:
        """List the blocks that particles reach, and what friction holds at floor and walls."""
        self._marks.zero_()
        self._stale.zero_()
        for part, (start, stop) in enumerate(self._ranges(len(self.rows))):
            inputs = [self.grid, self.rows.struct, start, 1 << part, view(self._marks)]
            launch(kernels.mark_blocks, stop - start, inputs, device=self.device)
        at = self._marks.nonzero()
        nodes, B = self.grid.nodes, kernels.BLOCK
        first = at[:, 0] * self.grid.count + ((at[:, 1] * B * nodes[1] + at[:, 2] * B) * nodes[2]) + at[:, 3] * B
        self._blocks = torch.stack([first, self._marks[tuple(at.T)]], 1).int().contiguous()
        launch(kernels.mark_friction, len(self.rows), [self.grid, self.rows.struct, view(self._friction)],
               device=self.device)  # fmt: skip
        inputs = [view(self._momentum, wp.vec4), view(self._velocity, wp.vec4), view(self._friction),
                  view(self._blocks, wp.vec2i), self._obstacles, view(self._clock), self.rows.scenes]  # fmt: skip
        rows = len(at) * B * B
        ranges = self._ranges(rows) if rows > 20_000 else [(0, rows)]  # a hand-over costs as much as 5,000 rows
        self._grid_commands = [
            self._record(kernels.grid_step, stop - start, [self.grid, start, *inputs]) for start, stop in ranges
        ]

    def _forget_friction(self) -> None:
        rows = len(self._blocks) * kernels.BLOCK**2
        inputs = [self.grid, view(self._blocks, wp.vec2i), view(self._friction)]
        launch(kernels.clear_friction, rows, inputs, device=self.device)

    def _ranges(self, count: int) -> list[tuple[int, int]]:
        cuts = [count * part // self.parts for part in range(self.parts + 1)]
        return list(zip(cuts[:-1], cuts[1:], strict=True))

    def _record(self, kernel: wp.Kernel, dim: int, inputs: list) -> wp.Launch:
        return wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, record_cmd=True, record_tape=False)

    def _run(self, commands: list[wp.Launch]) -> None:
        if self.device == "cpu":
            _crew().run(commands)
        else:
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
            for command in commands:
                command.launch(stream)


def _lazy_zeros(shape: tuple[int, ...], device: str) -> Tensor:
    """Zeros; on the CPU the pages come into being when they are touched (torch.zeros would write them all)."""
    return torch.from_numpy(np.zeros(shape, np.float32)) if device == "cpu" else torch.zeros(shape, device=device)


class _Crew:
    """Threads that launch on the CPU side by side: a Warp launch uses one core and releases Python's lock."""

    def __init__(self, size: int):
        self.size, self._work, self._error = size, [], None
        self._go = [threading.Semaphore(0) for _ in range(size - 1)]
        self._done = threading.Semaphore(0)
        for i in range(size - 1):
            threading.Thread(target=self._serve, args=(i + 1,), daemon=True).start()

    def _serve(self, i: int) -> None:
        while True:
            self._go[i - 1].acquire()
            try:
                for command in self._work[i :: self.size]:
                    command.launch()
            finally:
                self._done.release()

    def run(self, commands: list[wp.Launch]) -> None:
        helpers = self._go[: len(commands) - 1]
        self._work = commands
        for go in helpers:
            go.release()
        for command in commands[:: self.size]:
            command.launch()
        for _ in helpers:
            self._done.acquire()


@cache
def _crew() -> _Crew:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return _Crew(min(PARTS, cores))
