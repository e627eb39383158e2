"""Many independent scenes at once, by name: what data making needs.

    batch = Batch({"a": particles_a, "b": particles_b}, Box((-1, -1, 0), (1, 1, 2)), dx=0.04, device="cuda")
    for frame in batch.frames(100, 0.02, 200, (0.0, 0.0, -5.0)):   # the first is the start
        frame.x, frame.F            # (p, 3) [m] and (p, 3, 3) of all scenes, on the device, in the order given
        frame.of("b").x             # of one scene: a view
    batch.failures()                # {"b": "particle 17 left the box or is not finite (frame 31)"}

Particles come from `mpm.at_rest(x, volume, density, E, nu, viscosity, friction)`, one value a particle each; set
`.v`, `.held`, `.model` afterwards, and join bodies with `mpm.together`. Which body a particle is of is the caller's to
know: rows keep their order. Scenes share box, spacing, substep and colliders. A scene takes about 52 bytes for each
node of the box on a GPU, touched or not, and 500 for each particle: `Batch.fits` says how many scenes that makes.

`batch.solver.substeps(duration, push)` says how many substeps a frame needs for the CFL condition; fewer may diverge.
With `exact`, a scene comes out the same to the byte in every run on the same kind of GPU, whatever other scenes are in
its batch, at about twice the time: for data that are made in pieces.

A frame waits for nothing; tensors of a frame are its own and stay valid. A scene in which a particle leaves the box or
is no longer finite is told by `failures`, with the frame it happened in; all others go on as if nothing had happened.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.physics.colliders import Collider
from stages.core.physics.mpm.solver import Box, Particles, Solver, join_particles, make_grid, max_batch_nodes

GRID_BYTES, NODE_BYTES = 48, 4.5  # of a node: three grids, twice as much when exact; friction and marks
PARTICLE_BYTES = 700  # sorted, with room to sort


@dataclass(frozen=True)
class BatchFrame:
    """All scenes at one time."""

    names: tuple[str, ...]
    starts: tuple[int, ...]  # first row of each scene, and the end
    x: Float[Tensor, "p 3"]  # [m]
    F: Float[Tensor, "p 3 3"]  # deformation gradients; of what yields, the elastic part

    def of(self, name: str) -> BatchFrame:
        """One scene of it."""
        n = self.names.index(name)
        rows = slice(self.starts[n], self.starts[n + 1])
        return BatchFrame((name,), (0, rows.stop - rows.start), self.x[rows], self.F[rows])


class Batch:
    """Scenes by name, each on its own grid."""

    def __init__(
        self, scenes: Mapping[str, Particles], box: Box, dx: float, device: str = "cuda",
        colliders: Sequence[Collider] = (), damping: float = 0.0, exact: bool = False,
    ):  # fmt: skip
        self.names = tuple(scenes)
        sizes = [len(p) for p in scenes.values()]
        self.starts = tuple([0, *torch.tensor(sizes).cumsum(0).tolist()])
        self.solver = Solver(join_particles(list(scenes.values())), box, dx, device, sizes, colliders, damping,
                             exact=exact)  # fmt: skip
        self._when = torch.full((len(sizes),), -1, dtype=torch.int32, device=device)
        self._frame = 0

    @staticmethod
    def fits(box: Box, dx: float, particles: int, device: str = "cuda", exact: bool = False) -> int:
        """How many scenes of so many particles go into a batch on this device.

        On a CPU only nodes count, as memory is taken only where particles go.
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
        """`count` frames, the first as things are now, `duration` [s] and `substeps` apart; gravity in m/s^2."""
        rows = self.solver.rows
        push = torch.tensor(gravity, device=self.solver.device).repeat(len(rows), 1)
        for n in range(count):
            if n:
                self.solver.enqueue_frame(duration, push, substeps)
                self._frame += 1
                new = (self.solver.lost >= 0) & (self._when < 0)
                self._when.masked_fill_(new, self._frame)
            yield BatchFrame(self.names, self.starts, rows.get("x"), rows.get("F"))

    def lost(self) -> tuple[Int[Tensor, "s"], Int[Tensor, "s"]]:
        """For each scene, the first particle lost within it (-1: none) and in which frame; waits for the device."""
        lost = self.solver.lost
        first = torch.tensor(self.starts[:-1], device=lost.device)
        return torch.where(lost < 0, -1, lost - first).int(), self._when

    def failures(self) -> dict[str, str]:
        """What went wrong in which scene; empty when nothing did. Waits for the device."""
        particle, frame = (t.tolist() for t in self.lost())
        return {
            name: f"particle {p} left the box or is not finite (frame {f})"
            for name, p, f in zip(self.names, particle, frame, strict=True)
            if p >= 0
        }
