"""The MPM solver: elastic bodies on one grid, in a box with friction.

Explicit MLS-MPM/APIC in float32; the kernels, and the sources, are in stages/kernels/mpm.py. On the CPU the particles
are split into fixed parts, so that a run gives the same bytes whatever the number of threads.
"""

from __future__ import annotations

import math
import os
import threading
from dataclasses import dataclass, fields, replace
from functools import cache

import numpy as np
import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from stages.kernels import mpm as kernels
from stages.kernels.interop import launch, view

SAFETY = 0.5  # of a cell that a wave or a particle may cross in a substep; free vibration diverges from 1.1
VISCOUS = 0.15  # largest dt eta / (density dx^2); violent vibration diverges from 0.3
FLOOR_GAP = 1.0  # cells: a body coming to rest stays this far above the outermost held nodes (measured; see tests)
PARTS = 4  # of the particles, on the CPU
MAX_NODES = 60_000_000  # of the grid: about 1 GB of address space a copy, of which only touched pages are used


class Diverged(Exception):
    """A particle left the box or stopped being a number; `particle` is its index."""

    def __init__(self, particle: int):
        super().__init__(f"particle {particle} left the box or is not finite")
        self.particle = particle


@dataclass(frozen=True)
class Box:
    """Floor and walls: axis-aligned, solid, with the friction of the body that touches them."""

    low: tuple[float | int, float | int, float | int]  # z is the floor
    high: tuple[float | int, float | int, float | int]


@dataclass
class Particles:
    """What the solver moves. Rows keep their order."""

    x: Float[Tensor, "p 3"]  # positions [m]
    v: Float[Tensor, "p 3"]  # velocities [m/s]
    C: Float[Tensor, "p 3 3"]  # affine velocity: dv/dx [1/s]
    F: Float[Tensor, "p 3 3"]  # deformation gradient
    mass: Float[Tensor, "p"]  # [kg]
    volume: Float[Tensor, "p"]  # at rest [m^3]
    stiffness: Float[Tensor, "p 3"]  # Lame constants mu, lambda [Pa] and viscosity eta [Pa s]
    friction: Float[Tensor, "p"]  # Coulomb coefficient against floor and walls
    held: Int[Tensor, "p"]  # 1: stays where it is

    def __len__(self) -> int:
        return len(self.x)


def at_rest(
    x: Float[Tensor, "p 3"], volume: Float[Tensor, "p"], density: Float[Tensor, "p"], E: Float[Tensor, "p"],
    nu: Float[Tensor, "p"], viscosity: Float[Tensor, "p"], friction: Float[Tensor, "p"],
) -> Particles:  # fmt: skip
    """Particles of undeformed bodies that do not move. E [Pa], density [kg/m^3], viscosity [Pa s]."""
    p = len(x)
    still, identity = torch.zeros(p, 3, 3), torch.eye(3).repeat(p, 1, 1)
    stiffness = torch.stack([E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu)), viscosity], -1)
    held = torch.zeros(p, dtype=torch.int8)
    return Particles(x, torch.zeros(p, 3), still, identity, density * volume, volume, stiffness, friction, held)


def wave_speed(E, nu, density):
    """Speed of pressure waves, sqrt((lambda + 2 mu) / density) [m/s]."""
    return (E * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) / density) ** 0.5


def stiffest(speed: float, nu: float, density: float) -> float:
    """Young's modulus [Pa] at which pressure waves have this speed: the inverse of wave_speed."""
    return density * speed**2 * (1 + nu) * (1 - 2 * nu) / (1 - nu)


class Solver:
    """Bodies in a box. `advance` moves them through one frame; read x, v, F in between."""

    def __init__(self, particles: Particles, box: Box, dx: float, device: str = "cpu"):
        self.device, self.dx = device, dx
        self._sorted = Particles(
            *(getattr(particles, f.name).to(device, copy=True).contiguous() for f in fields(Particles))
        )
        self._order = torch.arange(len(particles), device=device)  # original index of each sorted row
        self.grid = _grid(box, dx)
        self.parts = PARTS if device == "cpu" else 1
        shape, count = tuple(self.grid.nodes), math.prod(self.grid.nodes)
        self._velocity = _lazy_zeros((count, 4), device)
        self._momentum = _lazy_zeros((self.parts * count, 4), device)
        self._friction = _lazy_zeros((count,), device)
        self._marks = torch.zeros([n // kernels.BLOCK for n in shape], dtype=torch.int32, device=device)
        self._home = torch.zeros(len(particles), 3, dtype=torch.int32, device=device)
        self._alarm = torch.zeros(2, dtype=torch.int32, device=device)
        self._rates = self._fastest()
        self.cells = 0  # of the grid that particles touch

    @property
    def particles(self) -> Particles:
        """The state in the order of the particles given."""
        back = torch.empty_like(self._order)
        back[self._order] = torch.arange(len(back), device=back.device)
        return Particles(*(getattr(self._sorted, f.name)[back] for f in fields(Particles)))

    def set(self, **changes: Tensor) -> None:
        """Overwrite fields of all particles, given in the original order."""
        ordered = {k: value.to(self.device)[self._order].contiguous() for k, value in changes.items()}
        self._sorted = replace(self._sorted, **ordered)

    def substeps(self, duration: float, push: Float[Tensor, "p 3"]) -> int:
        """Substeps that the CFL condition asks for: dt <= SAFETY dx / (wave speed + particle speed).

        Viscosity must not spread momentum by more than VISCOUS cells^2 a substep either.
        """
        speed = float(self._sorted.v.norm(dim=1).max()) + float(push.norm(dim=1).max()) * duration
        if not math.isfinite(speed):
            raise Diverged(int(self._order[self._sorted.v.norm(dim=1).isfinite().logical_not().nonzero()[0, 0]]))
        wave, viscous = self._rates
        rate = max((wave + speed) / (SAFETY * self.dx), viscous / (VISCOUS * self.dx**2))
        return max(1, math.ceil(duration * rate))

    def advance(self, duration: float, push: Float[Tensor, "p 3"], substeps: int | None = None) -> int:
        """Move on by `duration` [s] under accelerations `push` [m/s^2]; returns the substeps taken.

        Raises Diverged when a particle leaves the box or is no number.
        """
        steps = substeps or self.substeps(duration, push)
        self._sort()
        s, push = self._sorted, push.to(self.device)[self._order].contiguous()
        dt, steady = duration / steps, None
        self._particle_step(dt, push, gather=0, scatter=1)
        self._mark()
        for step in range(steps):
            if int(self._alarm[kernels.LOST]):
                break
            if int(self._alarm[kernels.STALE]):
                self._mark()
            self._grid_step()
            if step == steps - 1:
                self._particle_step(dt, push, gather=1, scatter=0)
            else:
                steady = steady or self._particle_commands(dt, push, 1, 1)
                self._run(steady)
        lost = int(self._alarm[kernels.LOST])
        if lost or not bool(s.x.isfinite().all()):
            row = lost - 1 if lost else int(s.x.isfinite().all(1).logical_not().nonzero()[0, 0])
            raise Diverged(int(self._order[row]))
        return steps

    def _fastest(self) -> tuple[float, float]:
        """Speed of the fastest pressure wave [m/s] and largest kinematic viscosity [m^2/s] of what can move."""
        s = self._sorted
        moving = s.held == 0
        if not bool(moving.any()):
            return 0.0, 0.0
        density = (s.mass / s.volume)[moving]
        mu, lam, eta = s.stiffness[moving].unbind(1)
        return float(((lam + 2 * mu) / density).sqrt().max()), float((eta / density).max())

    def _sort(self) -> None:
        """Neighbours in space become neighbours in memory."""
        s = self._sorted
        base = ((s.x - torch.tensor(list(self.grid.origin)).to(s.x)) / self.dx - 0.5).long()
        order = ((base[:, 0] * self.grid.nodes[1] + base[:, 1]) * self.grid.nodes[2] + base[:, 2]).argsort(stable=True)
        self._sorted = Particles(*(getattr(s, f.name)[order] for f in fields(Particles)))
        self._order = self._order[order]

    def _particle_commands(self, dt: float, push: Tensor, gather: int, scatter: int) -> list[wp.Launch]:
        s, count = self._sorted, math.prod(self.grid.nodes)
        # wp.Launch keeps these views, and they keep the tensors
        arrays = [
            view(s.x, wp.vec3), view(s.v, wp.vec3), view(s.C, wp.mat33), view(s.F, wp.mat33), view(s.mass),
            view(s.volume), view(s.stiffness, wp.vec3), view(push, wp.vec3), view(s.held), view(self._home, wp.vec3i),
            view(self._alarm),
        ]  # fmt: skip
        fields_ = view(self._velocity, wp.vec4), view(self._momentum, wp.vec4)
        return [
            self._record(kernels.particle_step, stop - start,
                         [self.grid, start, gather, scatter, dt, *fields_, part * count, *arrays])
            for part, (start, stop) in enumerate(self._ranges(len(s)))
        ]  # fmt: skip

    def _particle_step(self, dt: float, push: Tensor, gather: int, scatter: int) -> None:
        self._run(self._particle_commands(dt, push, gather, scatter))

    def _mark(self) -> None:
        """List the blocks that particles reach, and what friction holds at floor and walls."""
        self._marks.zero_()
        self._alarm[kernels.STALE] = 0
        x = view(self._sorted.x, wp.vec3)
        for part, (start, stop) in enumerate(self._ranges(len(self._sorted))):
            inputs = [self.grid, start, 1 << part, x, view(self._home, wp.vec3i), view(self._marks)]
            launch(kernels.mark_blocks, stop - start, inputs, device=self.device)
        at = self._marks.nonzero()
        nodes, B = self.grid.nodes, kernels.BLOCK
        first = ((at[:, 0] * B * nodes[1] + at[:, 1] * B) * nodes[2]) + at[:, 2] * B
        self._blocks = torch.stack([first, self._marks[tuple(at.T)]], 1).int().contiguous()
        self.cells = len(at) * B**3
        launch(kernels.mark_friction, len(self._sorted),
               [self.grid, x, view(self._sorted.friction), view(self._friction)], device=self.device)  # fmt: skip
        inputs = [view(self._momentum, wp.vec4), view(self._velocity, wp.vec4), view(self._friction),
                  view(self._blocks, wp.vec2i)]  # fmt: skip
        rows = len(at) * B * B
        ranges = self._ranges(rows) if rows > 20_000 else [(0, rows)]  # a hand-over costs as much as 5,000 rows
        self._grid_commands = [
            self._record(kernels.grid_step, stop - start, [self.grid, start, *inputs]) for start, stop in ranges
        ]

    def _grid_step(self) -> None:
        self._run(self._grid_commands)

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


def _grid(box: Box, dx: float):
    """A grid whose outermost held nodes lie FLOOR_GAP cells outside the box, so that bodies rest on its faces.

    Exact for the lower faces, the floor among them; the upper ones are moved out to the next node.
    """
    grid, n = kernels.Grid(), []
    for low, high in zip(box.low, box.high, strict=True):
        inside = max(math.ceil((high - low) / dx + 2 * FLOOR_GAP), 4)
        n.append((inside, math.ceil((inside + 1 + 2 * kernels.PAD) / kernels.BLOCK) * kernels.BLOCK))
    if math.prod(total for _, total in n) > MAX_NODES:
        raise ValueError(f"a grid of {' x '.join(str(total) for _, total in n)} nodes is too large")
    grid.origin = wp.vec3(*(low - (kernels.PAD + FLOOR_GAP) * dx for low in box.low))
    grid.dx = dx
    grid.nodes = wp.vec3i(*(total for _, total in n))
    grid.low = wp.vec3i(*[kernels.PAD] * 3)
    grid.high = wp.vec3i(*(kernels.PAD + inside for inside, _ in n))
    return grid


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
