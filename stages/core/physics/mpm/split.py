"""CPU schedule: MPM substeps as two kernel launches, particles and grid.

The particles are split into a fixed number of parts, each of which scatters into its own copy of the momentum grid; the
grid launch adds the copies in order. Threads launch the parts in parallel. Neither the parts nor the order of the
additions depend on the number of threads, so the result does not either.
"""

from __future__ import annotations

import numpy as np
import torch
import warp as wp
from torch import Tensor

from stages.core.kernels.interop import launch, view, with_arrays
from stages.core.kernels.mpm import split as kernels
from stages.core.kernels.mpm.active import ActiveBlocks
from stages.core.kernels.mpm.contact import NONE, REFRESH, STATIC_REACH, TouchingBlocks, contact_step, find_nearest
from stages.core.kernels.mpm.grid import NodeArrays
from stages.core.kernels.mpm.pins import pin_nodes
from stages.core.kernels.mpm.transfers import Features, substep
from stages.core.kernels.threads import run_parallel
from stages.core.physics.mpm.body_shapes import BodyContact
from stages.core.physics.mpm.particle_rows import ParticleRows
from stages.core.physics.mpm.pins import Pins

CPU_PARTS = 4  # parts that the particles are split into on the CPU
LAUNCH_MULTIPLE = 32  # particle launches are padded to a multiple of this, the size of a GPU warp
MIN_SPLIT_ROWS = 20_000  # grid rows of four nodes above which the grid launch is split; a split costs about 5,000 rows


class SplitSubsteps:
    """Runs the substeps of a frame for the particles in `rows`.

    `features` selects the variant of the kernels. With `contact` the scenes of `rows` are bodies in contact with each
    other.
    """

    def __init__(self, rows: ParticleRows, features: Features, contact: BodyContact | None = None):
        self._contact, self._contact_commands, self._refresh = contact, [], True
        self._pins, self._pin_commands = None, []
        self.rows, self.grid, self.device = rows, rows.grid, rows.device
        self.parts = CPU_PARTS if self.device == "cpu" else 1
        self._step = kernels.particle_step(features)
        self._count = rows.scenes * self.grid.count
        self._velocity = _lazy_zeros((self._count, 4), self.device)
        self._momentum = _lazy_zeros((self.parts * self._count, 4), self.device)
        self._friction = _lazy_zeros((self._count,), self.device)
        shape = [n // kernels.BLOCK for n in self.grid.nodes]
        self._marks = torch.zeros(rows.scenes, *shape, dtype=torch.int32, device=self.device)
        self._stale = torch.zeros(1, dtype=torch.int32, device=self.device)
        self._clock = torch.zeros(1, device=self.device)
        keys = self._count if contact is not None else 0
        self._nearest = torch.full((keys,), int(NONE), dtype=torch.int64, device=self.device)
        columns = {"velocity": self._velocity, "momentum": self._momentum, "friction": self._friction}
        self._nodes = with_arrays(NodeArrays(), columns)
        self._nodes.nearest = view(self._nearest)  # with_arrays would treat it as 32-bit numbers
        self._active = with_arrays(ActiveBlocks(), {"stale": self._stale})
        self._blocks = torch.zeros(0, 2, dtype=torch.int32, device=self.device)

    def frame(self, dt: float, steps: int) -> None:
        """Take `steps` substeps of `dt` [s]."""
        self._clear_friction()
        self.rows.sort()
        self._clock.fill_(-dt)
        clock = view(self._clock)
        self._run(self._particles(substep(dt, 0, 1, clock)))
        self._list_blocks(dt)
        between, last = (self._particles(substep(dt, 1, scatter, clock)) for scatter in (1, 0))
        for step in range(steps):
            if int(self._stale[0]):
                self._nearest.fill_(int(NONE))
                self._list_blocks(dt)
            self._clock.fill_(step * dt)
            self._run(self._grid_commands)
            self._run(self._pin_commands)
            self._contact_step(step, step == steps - 1)
            self._run(last if step == steps - 1 else between)

    def pin(self, pins: Pins) -> None:
        """Let these pins act from the next frame on."""
        self._pins = pins  # keeps the memory that the launch reads
        inputs = [pins.nodes, self._nodes.velocity]
        self._pin_commands = [self._record(pin_nodes, pins.count, inputs)] if pins.count else []

    @property
    def blocks(self) -> int:
        """Number of active grid blocks; these are read, written and cleared in every substep."""
        return len(self._blocks)

    def _particles(self, step) -> list[wp.Launch]:
        commands = []
        for n, (start, stop) in enumerate(self._ranges(len(self.rows))):
            part = kernels.ParticlePart()
            part.start, part.stop, part.copy = start, stop, n * self._count
            inputs = [self.grid, self.rows.struct, part, self._nodes, self._active, step]
            threads = -(-(stop - start) // LAUNCH_MULTIPLE) * LAUNCH_MULTIPLE
            commands.append(self._record(self._step, threads, inputs))
        return commands

    def _list_blocks(self, dt: float) -> None:
        """List the active blocks with the momentum copies that each needs, and set the friction at floor and walls."""
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
        inputs = [self._nodes, view(self._blocks, wp.vec2i), view(self._clock)]
        rows = len(at) * B * B
        ranges = self._ranges(rows) if rows > MIN_SPLIT_ROWS else [(0, rows)]
        self._grid_commands = [
            self._record(kernels.grid_step, stop - start, [self.grid, start, *inputs])
            for start, stop in ranges if stop > start  # empty if all particles are lost
        ]  # fmt: skip
        if self._contact is not None:
            self._contact_commands = self._contact_launches(dt, at[:, 0].int(), first - at[:, 0] * self.grid.count)

    def _contact_step(self, step: int, last: bool) -> None:
        if self._contact_commands:
            find, keep, clear = self._contact_commands
            if self._refresh or step % REFRESH == 0:
                self._run([find])
            self._run([clear if last or (step + 1) % REFRESH == 0 else keep])
        self._refresh = False

    def _contact_launches(self, dt: float, body: Tensor, corner: Tensor) -> list[wp.Launch]:
        """The launches for contact. For each active block, `body` is its body and `corner` its first node."""
        self._refresh = True
        self._sharers = (self._marks > 0).sum(0, dtype=torch.int32).contiguous()
        floor = (self.grid.face_low[2] - self.grid.origin[2]) / self.grid.dx + STATIC_REACH
        corners, block, count = corner.unique(return_inverse=True, return_counts=True)
        touch = (count > 1) | (corners % self.grid.nodes[2] <= floor)
        mine = touch[block].nonzero()[:, 0]
        if not len(mine):
            return []
        mine = mine[block[mine].argsort(stable=True)]
        corners, count = corners[touch].int(), count[touch]
        starts = torch.cat([torch.zeros(1, dtype=torch.int64, device=count.device), count.cumsum(0)]).int()
        blocks = {"corners": corners, "starts": starts, "present": body[mine]}
        self._touching = with_arrays(TouchingBlocks(), blocks)  # keeps the memory that the launches read
        near = [self.grid, self.rows.struct, view(self._sharers.flatten()), self._nodes.nearest]
        inputs = [self.grid, self.rows.struct, self._contact.bodies, self._nodes, self._touching]
        nodes = len(corners) * kernels.BLOCK**3
        return [
            self._record(find_nearest, len(self.rows), near),
            *(self._record(contact_step, nodes, [*inputs, substep(dt, forget=n)]) for n in (0, 1)),
        ]

    def _clear_friction(self) -> None:
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
            run_parallel([command.launch for command in commands])
        else:
            stream = wp.stream_from_torch(torch.cuda.current_stream(self.device))
            for command in commands:
                command.launch(stream)


def _lazy_zeros(shape: tuple[int, ...], device: str) -> Tensor:
    """Zeros; on the CPU, memory is committed only where it is touched (torch.zeros writes every page)."""
    return torch.from_numpy(np.zeros(shape, np.float32)) if device == "cpu" else torch.zeros(shape, device=device)
