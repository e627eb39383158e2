"""The learned force field as an engine: the scene is taken to the size, gravity and place of the model's world.

Motion under gravity looks the same at any size when times grow with the root of lengths over gravity. So a scene of
things larger or smaller than the model was trained on is made as large, given its gravity, and taken back. With lengths
s times longer and gravity g' instead of g: times are sqrt(s g / g') longer, masses s^3, Young's moduli s g' / g, forces
s^3 g' / g.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.models import checkpoints as weights
from stages.core.models.dynamics import FRAME, Dynamics
from stages.core.models.external_forces import ExternalForces
from stages.core.models.field.solidity import box_sides, solidity
from stages.core.models.initial_conditions import FLOOR, InitialConditions, centre_of_mass
from stages.core.models.rollout import TimeStepper
from stages.core.physics.forces import ForcePrompts
from stages.core.physics.materials import MODELS
from stages.core.physics.skinning import object_rotations
from stages.core.physics.state import FrameState
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.trajectory import Keypoints
from stages.simulate.options import ENGINES, SimulateOptions
from stages.simulate.setup import SceneSetup, set_up_scene
from stages.simulate.sleep import SleepState

log = logging.getLogger(__name__)
SIZE = 0.55  # usual longest side of an object in training [m]
SIZES = (0.25, 1.2)  # and the smallest and largest
MOST = 6  # objects that scenes of the benchmark have
THIN = 0.044  # thickness of the thinnest, the cloth [m]
SOFTEST = 3e3  # [Pa]; for stiffer bodies than there the model itself goes by linear elasticity
FALL = 5.0  # gravity in training [m/s^2]
FAST = 5.0  # speeds that falls reach there [m/s]
FAR = 100.0  # walls where there are none [m]
STRAY = 0.02  # share of keypoints that may lie below the floor that their object stands on


@dataclass(frozen=True)
class ModelUnits:
    """From the scene to the model's world and back."""

    length: float  # model metres in a scene unit
    time: float  # model seconds in a second
    mass: float  # model kilograms in a kilogram
    stress: float  # model pascals in a pascal
    origin: Float[Tensor, "3"]  # where the model's world has its point (0, 0, FLOOR) [scene units]
    gravity: float  # in the model's world, downwards [m/s^2]

    @staticmethod
    def for_objects(keypoints: list[Float[Tensor, "k 3"]], floor: float, unit: float, gravity: float) -> ModelUnits:
        """`keypoints` of each object and `floor` in scene units, `unit` metres each."""
        sides = torch.stack([(p.amax(0) - p.amin(0)).amax() for p in keypoints])
        size = unit * float(sides.median().clamp_min(1e-9))
        scale = 1.0 if SIZES[0] <= size <= SIZES[1] else SIZE / size
        length = scale * unit
        fall = math.copysign(FALL, gravity) if abs(gravity) > 1e-3 else 0.0
        quick = fall / gravity if fall else 1.0  # without weight, time is as it is
        middle = torch.cat(keypoints).mean(0)
        origin = torch.tensor([float(middle[0]), float(middle[1]), floor])
        return ModelUnits(length, math.sqrt(scale / quick), scale**3, scale * quick, origin, fall)

    def to_model(self, points: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
        """Scene units to model metres."""
        return (points - self.origin) * self.length + torch.tensor([0.0, 0.0, FLOOR])


def rollout(
    scene: Scene, keypoints: Keypoints, prompts: ForcePrompts, options: SimulateOptions
) -> Iterator[FrameState]:
    """One state a frame, the first being the start. Raises InputError when the motion is no longer finite."""
    device = pick_device(options.device)
    model, card = weights.load(weights.find(ENGINES[options.engine].weights, options.weights), device)
    if card.get("warning"):
        log.warning("%s", card["warning"])
    stage = set_up_scene(scene, prompts, options)
    ids = [o.id for o in scene.objects]
    each = [keypoints.rest[keypoints.object_id == i] for i in ids]
    frame = ModelUnits.for_objects(each, stage.box.low[2], scene.metres_per_unit, options.gravity)
    world = _world(scene, each, stage, frame, prompts, options)
    _warn(world, model)
    pushes = ExternalForces.from_prompts(world, _scaled(prompts, frame, stage, ids), ids)
    steps = max(1, math.ceil(options.dt * frame.time / FRAME - 1e-6))
    log.info("%s (%s): %d objects, %d keypoints, %.3g times as large and %.3g times slower, %d steps a frame",
             options.engine, card["sha256"][:8], len(ids), len(keypoints.rest), frame.length / scene.metres_per_unit,
             frame.time, steps)  # fmt: skip
    sleepers = SleepState(world, _awake(world, frame, stage), stage.on_floor)
    log.info("%d objects rest until something reaches them", int(sleepers.asleep.sum()))
    lifted = keypoints.rest + stage.lift[[ids.index(int(i)) for i in keypoints.object_id]]

    def states() -> Iterator[FrameState]:
        place = world.to(device)
        pinned, dt = pushes.pinned, options.dt * frame.time / steps
        held = replace(pushes, pinned=pinned | sleepers.asleep)
        stepper = TimeStepper(model, place, dt, held.to(device), options.integrator)
        first, before = stepper.points.clone(), world.points
        for n in range(options.steps):
            if not bool(stepper.points.isfinite().all()):
                raise InputError(f"the motion ceased to be finite at {n * options.dt:.2f} s; use a smaller --velocity "
                                 "or --force, or --engine mpm")  # fmt: skip
            yield _state(keypoints, ids, lifted, place, (stepper.points - first) / frame.length, stage)
            if n == options.steps - 1:
                continue
            if sleepers.rouse(_pushed(prompts, ids, n * options.dt, (n + 1) * options.dt)):
                stepper.external.pinned.copy_(pinned | sleepers.asleep)
            if bool(sleepers.asleep.all()):
                stepper.step_count += steps
                continue
            for _ in range(steps):
                stepper.step()
            here = stepper.points.cpu()
            if sleepers.wake(here, (here - before) / (steps * dt)):
                stepper.external.pinned.copy_(pinned | sleepers.asleep)
            before = here.clone()

    return states()


def _world(
    scene: Scene, each: list[Tensor], stage: SceneSetup, frame: ModelUnits, prompts: ForcePrompts,
    options: SimulateOptions,
) -> InitialConditions:  # fmt: skip
    """The objects where they start, in the model's world."""
    most = max(len(p) for p in each)
    points, valid = torch.zeros(1, len(each), most, 3), torch.zeros(1, len(each), most, dtype=torch.bool)
    mass, E, firmer, nu, friction = torch.ones(5, 1, len(each))
    velocity, floors = torch.zeros(1, len(each), 3), _floors(each, stage)
    for row, (o, p) in enumerate(zip(scene.objects, each, strict=True)):
        low = torch.tensor([-math.inf, -math.inf, float(floors[row])])  # what ends below would be thrown up
        points[0, row, : len(p)] = frame.to_model(p.maximum(low) + stage.lift[row])
        valid[0, row, : len(p)] = True
        choice = stage.materials[o.id]
        volume = float(stage.bodies.volume[stage.bodies.body == row].sum()) * scene.metres_per_unit**3
        mass[0, row] = choice.material.density * volume * frame.mass
        firmer[0, row] = solidity(points[0, row, : len(p)], volume * frame.mass)
        E[0, row] = _known_stiffness(o, choice.material.E * frame.stress, float(firmer[0, row]))
        nu[0, row] = choice.material.nu
        friction[0, row] = choice.material.friction if options.friction is None else options.friction
        velocity[0, row] = torch.tensor(prompts.velocity.get(o.id, (0.0, 0.0, 0.0))) * frame.length / frame.time
        if MODELS[choice.material.model].plastic:
            log.warning("object %d (%s): %s yields or flows, which the learned field does not know; take --engine mpm",
                        o.id, o.name, choice.name)  # fmt: skip
        guess = f"; material not known, taking {choice.name} (--material {o.id}=... changes it)" * choice.guessed
        log.info("object %d (%s): %s, %.3g kg%s", o.id, o.name, choice.name, mass[0, row] / frame.mass, guess)
    box = torch.tensor([[-FAR, -FAR, FLOOR], [FAR, FAR, FAR]]).repeat(len(each), 1, 1)
    if options.box:
        box[:] = torch.stack([frame.to_model(torch.tensor(corner)) for corner in (stage.box.low, stage.box.high)])
    box[:, 0, 2] = (floors - frame.origin[2]) * frame.length + FLOOR
    gravity = torch.tensor([0.0, 0.0, -frame.gravity])
    return InitialConditions.of(points, valid, mass=mass, E=E, solidity=firmer, nu=nu, friction=friction,
                                velocity=velocity, gravity=gravity, box=box)  # fmt: skip


def _floors(each: list[Float[Tensor, "k 3"]], stage: SceneSetup) -> Float[Tensor, "o"]:
    """How high the floor is under each object [scene units].

    What stands on it is where it was seen, for a seat sags and photos do not show undersides: the floor is where its
    keypoints end, but for a few. Were it put onto a plane, what lies deeper would be lifted into what does not. What
    stands on something else falls as deep as others stand.
    """
    ends = torch.stack([p[:, 2].quantile(STRAY) for p in each]).maximum(stage.bottom)
    on_floor = stage.on_floor_as_seen
    usual = ends[on_floor].median() if bool(on_floor.any()) else torch.tensor(stage.box.low[2])
    return torch.where(on_floor, ends, usual.minimum(ends))


def _known_stiffness(o: SceneObject, E: float, solidity: float) -> float:
    """Young's modulus [Pa], or what makes the body as soft as the softest in training if it is softer."""
    known = max(E, SOFTEST / solidity)
    if known / 2 > E:
        log.warning("object %d (%s): %.2g Pa (at this size) is softer than what is as thick in training, and taken as "
                    "%.2g Pa; compare with --engine mpm", o.id, o.name, E, known)  # fmt: skip
    return known


def _awake(world: InitialConditions, frame: ModelUnits, stage: SceneSetup) -> Bool[Tensor, "o"]:
    """Objects that are thrown or lifted; all, where weight does not hold them down."""
    return (world.velocity[0] != 0).any(-1) | (stage.lift != 0).any(-1) | (frame.gravity <= 0)


def _pushed(prompts: ForcePrompts, ids: list[int], start: float, end: float) -> Bool[Tensor, "o"]:
    """Objects that are pushed at some time from `start` to `end` [s]."""
    now = {f.object_id for f in prompts.forces if f.active_fraction(start, end) > 0}
    return torch.tensor([i in now for i in ids])


def _scaled(prompts: ForcePrompts, frame: ModelUnits, stage: SceneSetup, ids: list[int]) -> ForcePrompts:
    """Pushes in the model's units."""
    metres = frame.mass ** (1 / 3)
    newtons = frame.mass * metres / frame.time**2

    def scaled(f):
        at = None
        if f.at is not None:
            row = ids.index(f.object_id)
            at = tuple(frame.to_model(torch.tensor(f.at) + stage.lift[row]).tolist())
        return replace(
            f, force=tuple(newtons * v for v in f.force), torque=tuple(newtons * metres * v for v in f.torque),
            start=f.start * frame.time, end=f.end * frame.time, at=at,
        )  # fmt: skip

    return replace(prompts, forces=tuple(scaled(f) for f in prompts.forces))


def _warn(world: InitialConditions, model: Dynamics) -> None:
    """What the model has not seen in training, or does not hear of."""
    points = world.points[0]
    hidden = ~world.valid[0, ..., None]
    long = (points.masked_fill(hidden, -torch.inf).amax(1) - points.masked_fill(hidden, torch.inf).amin(1)).amax(1)
    if float(long.max() / long.min()) > SIZES[1] / SIZES[0]:
        log.warning("the largest object is %.1f times as long as the smallest, and in training never more than %.1f; "
                    "compare with --engine mpm", long.max() / long.min(), SIZES[1] / SIZES[0])  # fmt: skip
    thin = min(float(box_sides(p[seen])[0]) for p, seen in zip(points, world.valid[0], strict=True))
    if thin < THIN / 1.5:
        log.warning("an object is %.2g times thinner than any in training; it may sink into others, so "
                    "compare with --engine mpm", THIN / thin)  # fmt: skip
    if len(long) > MOST:
        log.warning("%d objects; the model was tested with up to %d, so compare with --engine mpm", len(long), MOST)
    if float(world.velocity.norm(dim=-1).max()) > FAST:
        log.warning("an object starts faster than any in training; compare with --engine mpm")
    for name in sorted({"mass", "E", "friction", "gravity"} - model.inputs):
        log.warning("this model is not told the %s", name)


def _state(
    keypoints: Keypoints, ids: list[int], lifted: Float[Tensor, "p 3"], world: InitialConditions,
    moved: Float[Tensor, "1 o n 3"], stage: SceneSetup,
) -> FrameState:  # fmt: skip
    """Keypoints have `moved` [scene units] since the start, where they are exactly as seen, but for the lift."""
    positions, moved = lifted.clone(), moved.cpu()
    for row, i in enumerate(ids):
        mine = keypoints.object_id == i
        positions[mine] += moved[0, row, : int(mine.sum())]
    start = torch.stack([lifted[keypoints.object_id == i].mean(0) for i in ids])
    centre = start + centre_of_mass(world.to("cpu"), moved)[0]
    return FrameState(positions, centre, object_rotations(keypoints, positions, ids))
