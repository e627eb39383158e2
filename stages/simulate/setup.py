"""The initial state, common to all engines: particles, materials, floor, lifts and domain."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.perception.table_outline import TableOutline, table_outline
from stages.core.physics.forces import ForcePrompts, vector
from stages.core.physics.material_parts import averaged, located, uneven_moments
from stages.core.physics.materials import MaterialChoice, choose_materials
from stages.core.physics.mpm.domain import MAX_NODES, Box
from stages.core.physics.mpm.surface_particles import surface_particles
from stages.core.physics.particles import Bodies, sample_bodies
from stages.core.scene.scene import Scene
from stages.core.scene.schema import LARGEST
from stages.simulate.options import SimulateOptions

log = logging.getLogger(__name__)
MIN_ROOM = 20  # minimum distance from the objects to the walls of the default domain [particle spacings]


@dataclass(frozen=True)
class SceneSetup:
    """Objects, materials and domain at the start of a simulation, in scene units; `o` follows scene.objects."""

    bodies: Bodies  # particles at the reconstructed position
    materials: dict[int, MaterialChoice]  # by object id
    lift: Float[Tensor, "o 3"]  # displacement by --lift, part of the output
    on_floor: Bool[Tensor, "o"]  # stands on the floor after the lift
    floor_offset: Float[Tensor, "o 3"]  # displacement onto the floor; internal, not part of the output
    bottom: Float[Tensor, "o"]  # height of the lowest point of each object as reconstructed
    on_floor_as_seen: Bool[Tensor, "o"]  # stands on the floor as reconstructed
    box: Box  # floor, walls and ceiling

    @property
    def start(self) -> Float[Tensor, "p 3"]:
        """Particle positions at the start of the simulation."""
        return self.bodies.x + (self.lift + self.floor_offset)[self.bodies.body]

    def warn_of_lifted(self, scene: Scene) -> None:
        """Warn of objects that reach far below the floor; for engines that place them on it."""
        for o, raised in zip(scene.objects, self.floor_offset[:, 2].tolist(), strict=True):
            if raised > 4 * self.bodies.spacing:
                log.warning("object %d (%s) extends %.3g below the floor; it is placed on the floor",
                            o.id, o.name, raised)  # fmt: skip

    def uneven_moments(self, row: int) -> tuple[Float[Tensor, "3"], Float[Tensor, "3 3"]]:
        """`material_parts.uneven_moments` of the object at this row."""
        mine = self.bodies.body == row
        return uneven_moments(list(self.materials.values())[row], self.bodies.x[mine], self.bodies.volume[mine])


def set_up_scene(scene: Scene, prompts: ForcePrompts, options: SimulateOptions, refinement: int = 0) -> SceneSetup:
    """Sample the particles, choose the materials and place the objects in the domain.

    Objects whose lowest point is within two particle spacings of the floor, or below it, are moved onto it. With a
    `refinement` of 1 or more, particles fill the bodies up to the surface, at the particle spacing of the quality level
    divided by `refinement`; with 0 they leave the outermost layer empty. Raises InputError if --box does not contain
    the objects.
    """
    bodies = sample_bodies(scene, options.level.particles, options.seed, skin=refinement > 0)
    if refinement:
        bodies = surface_particles(scene, bodies, refinement, options.seed)
    materials = choose_for_bodies(scene, bodies, options)
    count, h = len(scene.objects), bodies.spacing
    lift = torch.zeros(count, 3)
    for row, o in enumerate(scene.objects):
        lift[row, 2] = prompts.lift.get(o.id, 0.0)
    # Lowest point: the lower face of a particle's voxel, or that of the filled upper part of a voxel that is partly
    # filled. Without the outermost layer the visible body ends 1.5 spacings below its lowest particles.
    below = 0.5 if refinement else 1.5
    ends = bodies.x[:, 2] - below * h
    if refinement:  # particles are not at the centres of their voxels
        ends = ((bodies.x[:, 2] / h).floor() + 1) * h - bodies.volume / h**2
    bottom = torch.stack([ends[bodies.body == row].quantile(0.01) for row in range(count)])
    start = bottom + lift[:, 2]
    asked = parse_box(options.box) if options.box else None
    floor = _floor_height(scene, options, asked, start)
    floor_offset = torch.zeros(count, 3)
    gap = start - floor
    on_floor, on_floor_as_seen = gap < 2 * h, bottom - floor < 2 * h
    for row, o in enumerate(scene.objects):
        if on_floor[row] and o.id not in prompts.pinned:
            floor_offset[row, 2] = -gap[row]
    x = bodies.x + (lift + floor_offset)[bodies.body]
    box = asked or _default_box(x, floor, h)
    box = Box((*box.low[:2], floor), box.high)
    low, high = torch.tensor(box.low), torch.tensor(box.high)
    # particles below the 1 % quantile may still be under the floor, which would eject them
    x[:, 2].clamp_(min=floor + (below - 0.25) * h)
    outside = ((x < low) | (x > high)).any(1)
    if bool(outside.any()):
        row = int(bodies.body[outside.nonzero()[0, 0]])
        o = scene.objects[row]
        raise InputError(f"--box {options.box}: object {o.id} ({o.name}) is not inside the box; enlarge it or "
                         "move the object, which spans "
                         f"{_extent(x[bodies.body == row])}")  # fmt: skip
    at_rest = x - (lift + floor_offset)[bodies.body]
    bodies = replace(bodies, x=at_rest)
    return SceneSetup(bodies, materials, lift, on_floor, floor_offset, bottom, on_floor_as_seen, box)


def choose_for_bodies(scene: Scene, bodies: Bodies, options: SimulateOptions) -> dict[int, MaterialChoice]:
    """The materials that the options select, by object id; those of parts are averaged over the object's particles."""
    chosen = choose_materials(scene.objects, options.material, options.materials)
    for row, o in enumerate(scene.objects):
        mine = bodies.body == row
        chosen[o.id] = averaged(located(chosen[o.id], scene.gaussians, o), bodies.x[mine], bodies.volume[mine])
    return chosen


def _floor_height(scene: Scene, options: SimulateOptions, box: Box | None, bottom: Float[Tensor, "o"]) -> float:
    """Height of the floor: the first known of --floor, --box, the scene, and the lowest point of the objects."""
    if options.floor is not None:
        return options.floor
    if box is not None:
        return box.low[2]
    if scene.floor is not None:
        return scene.floor
    floor = float(bottom.min())
    log.info(
        "the scene has no floor; a floor is placed under the lowest object, at height %.3g (change it with --floor)",
        floor,
    )
    return floor


def parse_box(text: str) -> Box:
    """Parse the domain of --box, "x0,y0,z0,x1,y1,z1": lower and upper corner. Raises InputError if malformed."""
    where, parts = f"--box {text!r}", text.split(",")
    if len(parts) != 6:
        raise InputError(f"{where}: needs six numbers; write x0,y0,z0,x1,y1,z1")
    box = Box(vector(",".join(parts[:3]), where), vector(",".join(parts[3:]), where))
    if any(low >= high for low, high in zip(box.low, box.high, strict=True)):
        raise InputError(f"{where}: the first corner must be below the second in x, y and z")
    return box


def _extent(x: Float[Tensor, "p 3"]) -> str:
    """The ranges of the coordinates, for an error message."""
    low, high = x.amin(0), x.amax(0)
    return " x ".join(f"{a:.3g}..{b:.3g}" for a, b in zip(low.tolist(), high.tolist(), strict=True))


def _default_box(x: Float[Tensor, "p 3"], floor: float, h: float) -> Box:
    """A domain of twice the largest extent of the objects, with at least their height above the floor at the sides.

    It is smaller if the MPM grid would take too much memory.
    """
    low, high = x.amin(0), x.amax(0)
    size = float((high - low).max())
    room = max(size / 2, float(high[2]) - floor, MIN_ROOM * h)
    while True:
        box = Box((float(low[0]) - room, float(low[1]) - room, floor),
                  (float(high[0]) + room, float(high[1]) + room, float(high[2]) + max(room, size)))  # fmt: skip
        nodes = math.prod((b - a) / (2 * h) + 16 for a, b in zip(box.low, box.high, strict=True))
        if nodes < MAX_NODES / 2 or room <= MIN_ROOM * h:
            return box
        room *= 0.8
        size *= 0.8


def check_motion(points: Float[Tensor, "*k 3"], frame: int, options: SimulateOptions) -> None:
    """Raise InputError if points [scene units] are not finite or too far away for a trajectory file."""
    if not bool((points.abs() < LARGEST).all()):
        raise InputError(f"the motion diverged at {frame * options.dt:.2f} s; use a smaller --velocity or "
                         "--force, or another --engine")  # fmt: skip


def table_of(scene: Scene, options: SimulateOptions) -> TableOutline | None:
    """The outline of the table of a scene of photos; None if no edge is visible or the options place the floor."""
    given = options.floor is not None or options.box
    return None if given or not from_photos(scene) else table_outline(scene, str(pick_device(options.device)))


def from_photos(scene: Scene) -> bool:
    """Whether `ngff reconstruct` is among the commands that made the scene."""
    return "reconstruct" in scene.commands


def starts_released(scene: Scene, options: SimulateOptions) -> bool:
    """Whether all objects may move from the start: with --no-rest, and in films, which begin with the release."""
    return not options.rest or scene.sequence is not None


def held_as_seen(scene: Scene, options: SimulateOptions) -> bool:
    """Whether objects are held at rest where photos show them."""
    return from_photos(scene) and not starts_released(scene, options)


def tell_of_unseen_sides(scene: Scene, path: Path) -> None:
    """Log that sides not visible in any photo are missing, unless `ngff refine` has added them."""
    if from_photos(scene) and "refine" not in scene.commands:
        log.info("%s: sides that no photo shows are missing, so that objects may be hollow and too light; "
                 "`ngff refine` adds them", path)  # fmt: skip
