"""Simulate many independent scenes at once, by name, as for the data set.

    batch = Batch({"a": particles_a, "b": particles_b}, Box((-1, -1, 0), (1, 1, 2)), dx=0.04, device="cuda")
    for frame in batch.frames(100, 0.02, 200, (0.0, 0.0, -5.0)):   # the first is the initial state
        frame.x, frame.F            # (p, 3) [m] and (p, 3, 3) of all scenes, on the device, in the original order
        frame.of("b").x             # a view of one scene
    batch.failures()                # {"b": "particle 17 left the box or is not finite (frame 31)"}

Particles come from `solver.at_rest(x, volume, ParticleMaterial(...))`, with one value per particle or one for all; set
`.v`, `.held` and `.model` afterwards, and join bodies with `solver.join_particles`. Rows keep their order, so that the
caller can keep track of which body a particle belongs to. All scenes have the same box, spacing, substep and colliders.
On a GPU a scene takes about 52 bytes per node of the box, active or not, and 700 per particle; `Batch.fits` computes
how many scenes fit.

`batch.solver.substeps(duration, acceleration)` is the number of substeps by the CFL condition; fewer may diverge. With
the schedule `exact`, a scene gives the same bytes in every run on the same kind of GPU and in any batch, in about twice
the time.

Frames are returned without waiting for the device, and their tensors stay valid. If a particle leaves the box or is not
finite, `failures` lists its scene with the frame in which that happened; the other scenes are not affected.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.physics.mpm.solver import (
    DEFAULTS,
    Box,
    Particles,
    Solver,
    SolverOptions,
    join_particles,
    make_grid,
    max_batch_nodes,
)

GRID_BYTES = 48  # of the three grids [bytes/node]; twice as much for `exact`
NODE_BYTES = 4.5  # of friction and block flags [bytes/node]
PARTICLE_BYTES = 700  # including buffers for sorting [bytes/particle]


@dataclass(frozen=True)
class BatchFrame:
    """State of all scenes of a batch at one time."""

    names: tuple[str, ...]
    starts: tuple[int, ...]  # first row of each scene, followed by the total number of rows
    x: Float[Tensor, "p 3"]  # [m]
    F: Float[Tensor, "p 3 3"]  # deformation gradients; their elastic part for plastic materials

    def of(self, name: str) -> BatchFrame:
        """The state of one scene."""
        n = self.names.index(name)
        rows = slice(self.starts[n], self.starts[n + 1])
        return BatchFrame((name,), (0, rows.stop - rows.start), self.x[rows], self.F[rows])


class Batch:
    """Scenes by name, each on its own grid."""

    def __init__(
        self, scenes: Mapping[str, Particles], box: Box, dx: float, device: str = "cuda",
        options: SolverOptions = DEFAULTS,
    ):  # fmt: skip
        self.names = tuple(scenes)
        sizes = [len(p) for p in scenes.values()]
        self.starts = tuple([0, *torch.tensor(sizes).cumsum(0).tolist()])
        self.solver = Solver(join_particles(list(scenes.values())), box, dx, device, options, sizes)
        self._failure_frame = torch.full((len(sizes),), -1, dtype=torch.int32, device=device)
        self._frame = 0

    @staticmethod
    def fits(box: Box, dx: float, particles: int, device: str = "cuda", exact: bool = False) -> int:
        """Number of scenes of `particles` particles each that fit into a batch on this device.

        On the CPU only the number of nodes counts, as memory is committed only where particles go.
        """
        count = make_grid(box, dx).count
        width = 2 if exact else 1
        indices = max_batch_nodes(device) // (count * width)
        if device == "cpu":
            return max(1, indices)
        free = 0.8 * torch.cuda.mem_get_info(device)[0]
        each = count * (width * GRID_BYTES + NODE_BYTES) + particles * PARTICLE_BYTES
        return max(1, min(indices, int(free / each)))

    def frames(
        self, count: int, duration: float, substeps: int, gravity: tuple[float, float, float]
    ) -> Iterator[BatchFrame]:
        """Yield `count` frames, the first being the current state.

        Frames are `duration` [s] apart, with `substeps` substeps in between; `gravity` [m/s^2].
        """
        rows = self.solver.rows
        acceleration = torch.tensor(gravity, device=self.solver.device).repeat(len(rows), 1)
        for n in range(count):
            if n:
                self.solver.enqueue_frame(duration, acceleration, substeps)
                self._frame += 1
                new = (self.solver.lost >= 0) & (self._failure_frame < 0)
                self._failure_frame.masked_fill_(new, self._frame)
            yield BatchFrame(self.names, self.starts, rows.get("x"), rows.get("F"))

    def lost(self) -> tuple[Int[Tensor, "s"], Int[Tensor, "s"]]:
        """For each scene, its first lost particle (-1: none) and the frame of the loss; waits for the device."""
        lost = self.solver.lost
        first = torch.tensor(self.starts[:-1], device=lost.device)
        return torch.where(lost < 0, -1, lost - first).int(), self._failure_frame

    def failures(self) -> dict[str, str]:
        """Description of the failure of each failed scene, by name; waits for the device."""
        particle, frame = (t.tolist() for t in self.lost())
        return {
            name: f"particle {p} left the box or is not finite (frame {f})"
            for name, p, f in zip(self.names, particle, frame, strict=True)
            if p >= 0
        }
