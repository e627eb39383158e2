"""The learned engine: the force field advances the keypoints, in the units of its training data.

Bodies have the mass and inertia of filled objects.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.models import checkpoints
from stages.core.models.dynamics import FRAME, Dynamics
from stages.core.models.external_forces import ExternalForces
from stages.core.models.field.force_field import ForceField
from stages.core.models.field.solidity import MIN_STIFFNESS, box_sides, solidity
from stages.core.models.field.solved_field import SolvedForceField
from stages.core.models.initial_conditions import FLOOR, InitialConditions, centre_of_mass
from stages.core.models.rollout import TimeStepper
from stages.core.physics.forces import Change, Force, ForcePrompts
from stages.core.physics.materials import MODELS
from stages.core.physics.rigid_shapes import standing_shapes
from stages.core.physics.skinning import object_rotations
from stages.core.physics.state import FrameState
from stages.core.scene.field_start import FieldStart, FieldUnits
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.trajectory import Keypoints
from stages.simulate.changes import changed_options, changed_pins
from stages.simulate.field_surfaces import body_surfaces
from stages.simulate.held_bodies import HeldBodies
from stages.simulate.model_units import TYPICAL_SIZE, ModelUnits
from stages.simulate.options import ENGINES, SimulateOptions
from stages.simulate.setup import (
    SceneSetup,
    check_motion,
    choose_for_bodies,
    from_photos,
    set_up_scene,
    starts_released,
)
from stages.simulate.sleep import SleepState
from stages.simulate.solid_bodies import SolidBody, mass_fractions, solid_bodies

log = logging.getLogger(__name__)
# Limits of the training data, in model units:
SIZE_RANGE = (0.25, 1.2)  # smallest and largest longest side of an object in training [m]
MAX_OBJECTS = 6  # most objects in a scene of the benchmark
MIN_THICKNESS = 0.044  # thickness of the thinnest object in training, the cloth [m]
MAX_SPEED = 5.0  # highest speed of falls in training [m/s]

FAR_WALL = 100.0  # distance of the walls of a scene without walls [m]
MAX_STEPS = 1000  # largest number of model steps per frame
FLOOR_OUTLIERS = 0.02  # fraction of an object's keypoints that may lie below the floor under it


@dataclass(frozen=True)
class FieldObjects:
    """The objects of a scene as input of the learned field, before the conversion to model units."""

    scene: Scene
    keypoints: list[Float[Tensor, "k 3"]]  # keypoints of each object at rest [scene units]
    solids: list[SolidBody]
    setup: SceneSetup
    units: ModelUnits
    velocity: Mapping[int, Sequence[float]]  # initial velocity by object id [scene units/s]

    @property
    def volumes(self) -> Float[Tensor, "o"]:
        """Volumes of the solid bodies [m^3]."""
        return torch.tensor([s.volume for s in self.solids]) * self.scene.metres_per_unit**3


def rollout(
    scene: Scene, keypoints: Keypoints, prompts: ForcePrompts, options: SimulateOptions
) -> Iterator[FrameState]:
    """Yield one state per frame, the first of which is the initial state.

    Raises InputError if the motion is no longer finite, for frames of more than MAX_STEPS model steps, and for weights
    that have no solved contacts if these are asked for.
    """
    device = pick_device(options.device)
    model, card = checkpoints.load(checkpoints.find(ENGINES[options.engine].weights, options.weights), device)
    if card.get("warning"):
        log.warning("%s", card["warning"])
    setup = set_up_scene(scene, prompts, options)
    setup.warn_of_lifted(scene)
    ids = [o.id for o in scene.objects]
    per_object = [keypoints.rest[keypoints.object_id == i] for i in ids]
    uneven = map(setup.uneven_moments, range(len(ids)))
    solids = [replace(s, centre=s.centre + shift, inertia=s.inertia + inertia)
              for s, (shift, inertia) in zip(_solids(scene, setup, options, device), uneven, strict=True)]  # fmt: skip
    density = torch.tensor([setup.materials[i].material.density for i in ids])
    masses = density * (torch.tensor([solid.volume for solid in solids]) * scene.metres_per_unit**3)
    units = ModelUnits.for_objects(per_object, masses, setup.box.low[2], scene.metres_per_unit, options.gravity)
    objects = FieldObjects(scene, per_object, solids, setup, units, prompts.velocity)
    initial = _initial_conditions(objects, options)
    _warn_extrapolation(initial, model)
    if options.contact == "solved":
        if not isinstance(model, ForceField):
            raise InputError(
                f"--contact solved: only works with weights of the engine ngff, not with weights of {card['model']}"
            )
        floors = _floor_heights(per_object, setup, options)
        surfaces = body_surfaces(scene, initial, units, setup.lift, floors, options.seed)
        model = SolvedForceField(model, surfaces.to(device))
    in_model_units = ForcePrompts(units.forces(prompts.forces, setup.lift, ids), prompts.pinned)
    forces = ExternalForces.from_prompts(initial, in_model_units, ids)
    steps = max(1, math.ceil(options.dt * units.time / FRAME - 1e-6))
    if steps > MAX_STEPS:
        raise InputError(f"--dt {options.dt:g}: a frame takes {steps} steps of the learned field, as the objects are "
                         f"about {TYPICAL_SIZE / units.length:.2g} scene units large; give a smaller --dt or use "
                         "another "
                         "--engine")  # fmt: skip
    log.info("%s (weights %s): %d objects, %d keypoints, lengths scaled by %.3g, times by %.3g, %d steps per frame",
             options.engine, card["sha256"][:8], len(ids), len(keypoints.rest), units.length / scene.metres_per_unit,
             units.time, steps)  # fmt: skip
    awake = _starts_awake(initial, units, setup) | starts_released(scene, options)
    if options.contact == "solved":
        awake |= not from_photos(scene)  # scenes that are not from photos lack no supports
        seen = centre_of_mass(initial, initial.points)[0] - units.length * setup.lift
        rest = HeldBodies(initial, surfaces, seen, awake, setup.on_floor_as_seen)
    else:
        rest = SleepState(initial.to(device), awake, setup.on_floor)
    log.info(
        "%d of %d objects are at rest and stay fixed until something touches them", int(rest.asleep.sum()), len(ids)
    )
    model_units = FieldUnits(
        units.length, units.scale, units.time, units.mass, tuple(units.origin.tolist()), units.gravity, steps,
        card["sha256"], options.friction,
    )  # fmt: skip
    field_start = _field_start(keypoints, objects, initial, awake, model_units)
    row = torch.tensor([ids.index(i) for i in keypoints.object_id.tolist()], dtype=torch.int64)
    lifted = keypoints.rest + setup.lift[row]

    def states() -> Iterator[FrameState]:
        current, held, acting, dt = options, prompts.pinned, prompts.forces, options.dt * units.time / steps
        stepper = TimeStepper(model, initial.to(device), dt, forces.to(device), options.integrator)
        first, mass = stepper.points.clone(), initial.mass[0]
        for n in range(options.steps):
            moved = ((stepper.points - first) / units.length).cpu()
            check_motion(moved, n, options)
            state = _state(keypoints, ids, (row, lifted), initial, moved)
            yield replace(state, mass=mass / units.mass, start=None if n else field_start)
            if n == options.steps - 1:
                continue
            start, end = n * options.dt, (n + 1) * options.dt
            active, changes = prompts.during(start, end)
            if active is not acting:
                _load_forces(stepper.external, initial, units.forces(active, setup.lift, ids), ids)
                acting = active
            if changes:
                current, held = changed_options(current, changes), changed_pins(held, changes)
                new = _changed(objects, current)
                stepper.change(new.to(device))
                mass = new.mass[0]
            rest.wake(_pushed(active, ids, start, end) | _woken(changes, ids))
            if bool(rest.asleep.all()):
                stepper.step_count += steps
            else:
                rest.advance(stepper, steps, _rows(held, ids))

    return states()


def _solids(scene: Scene, setup: SceneSetup, options: SimulateOptions, device: str) -> list[SolidBody]:
    """The mass properties of the objects; with solved contacts those of the shapes that collide."""
    if options.contact != "solved":
        return solid_bodies(scene, setup.bodies.spacing, device)
    shapes = standing_shapes(scene, options.seed, setup.box.low[2])
    return [SolidBody(shape.volume, shape.com, shape.inertia / shape.volume) for shape, _ in shapes]


def _field_start(
    keypoints: Keypoints, objects: FieldObjects, initial: InitialConditions, awake: Bool[Tensor, "o"], units: FieldUnits
) -> FieldStart:
    """The initial state for the trajectory file; values per keypoint are in the order of `keypoints`."""
    setup, ids = objects.setup, [o.id for o in objects.scene.objects]

    def of_keypoints(values: Tensor) -> Tensor:
        out = values.new_zeros(len(keypoints.rest), *values.shape[3:])
        for row, i in enumerate(ids):
            out[keypoints.object_id == i] = values[0, row, initial.valid[0, row]]
        return out

    return FieldStart(
        of_keypoints(initial.points), of_keypoints(initial.mass_fraction), initial.mass[0], objects.volumes,
        initial.E[0], initial.solidity[0], initial.nu[0], initial.friction[0], initial.velocity[0],
        initial.body_inertia[0], initial.box[0], awake.long(), setup.on_floor.long(),
        tuple(setup.materials[i].name for i in ids), units,
    )  # fmt: skip


def _initial_conditions(objects: FieldObjects, options: SimulateOptions) -> InitialConditions:
    """Initial keypoints, materials and velocities of the objects, in model units."""
    scene, setup, units = objects.scene, objects.setup, objects.units
    per_object, solids = objects.keypoints, objects.solids
    count, most = len(per_object), max(len(p) for p in per_object)
    points, valid = torch.zeros(1, count, most, 3), torch.zeros(1, count, most, dtype=torch.bool)
    mass, E, ratio, nu, friction, loss = torch.ones(6, 1, count)
    fraction, inertia = torch.zeros(1, count, most), torch.zeros(1, count, 3, 3)
    velocity, floors = torch.zeros(1, count, 3), _floor_heights(per_object, setup, options)
    for row, (o, p) in enumerate(zip(scene.objects, per_object, strict=True)):
        low = torch.tensor([-math.inf, -math.inf, float(floors[row])])  # points below the floor would be ejected
        points[0, row, : len(p)] = units.to_model(p.maximum(low) + setup.lift[row])
        valid[0, row, : len(p)] = True
        choice = setup.materials[o.id]
        fraction[0, row, : len(p)] = mass_fractions(p, solids[row].centre)
        inertia[0, row] = solids[row].inertia * units.length**2
        volume = solids[row].volume * scene.metres_per_unit**3
        mass[0, row] = choice.material.density * volume * units.mass
        ratio[0, row] = solidity(points[0, row, : len(p)], volume * units.scale**3)
        E[0, row] = _model_stiffness(o, choice.material.E * units.stress, float(ratio[0, row]))
        nu[0, row] = choice.material.nu
        friction[0, row] = choice.material.friction if options.friction is None else options.friction
        loss[0, row] = choice.material.loss
        velocity[0, row] = torch.tensor(objects.velocity.get(o.id, (0.0, 0.0, 0.0))) * units.length / units.time
        if MODELS[choice.material.model].plastic:
            log.warning("object %d (%s): %s yields or flows, which the learned field does not model; use --engine mpm",
                        o.id, o.name, choice.name)  # fmt: skip
        guess = f"; material not known, taking {choice.name} (--material {o.id}=... changes it)" * choice.guessed
        weight = scene.mass_text(float(mass[0, row]) / units.mass)
        log.info("object %d (%s): %s, %s%s", o.id, o.name, choice.name, weight, guess)
    box = torch.tensor([[-FAR_WALL, -FAR_WALL, FLOOR], [FAR_WALL] * 3]).repeat(count, 1, 1)
    if options.box:
        box[:] = torch.stack([units.to_model(torch.tensor(corner)) for corner in (setup.box.low, setup.box.high)])
    box[:, 0, 2] = (floors - units.origin[2]) * units.length + FLOOR
    gravity = torch.tensor([0.0, 0.0, -units.gravity])
    return InitialConditions.of(
        points, valid, mass_fraction=fraction, mass=mass, body_inertia=inertia, E=E,
        solidity=ratio, nu=nu, friction=friction, loss=loss, velocity=velocity, gravity=gravity, box=box,
    )  # fmt: skip


def _floor_heights(
    per_object: list[Float[Tensor, "k 3"]], setup: SceneSetup, options: SimulateOptions
) -> Float[Tensor, "o"]:
    """Height of the floor under each object [scene units].

    With solved contacts it is the floor of the scene, below which objects are cut off; an object that is mostly below
    the floor has its own lowest point instead. With learned contacts each standing object keeps its reconstructed
    height, since seats sag and undersides are not visible: its floor is at its lowest keypoints, without outliers. A
    common plane would lift low objects into others. An object that does not stand on the floor has the median floor of
    the standing objects, or its own lowest keypoints if these are lower.
    """
    if options.contact == "solved":
        floor = setup.box.low[2]
        return torch.tensor([float(p[:, 2].min()) if float(p[:, 2].median()) < floor else floor for p in per_object])
    ends = torch.stack([p[:, 2].quantile(FLOOR_OUTLIERS) for p in per_object]).maximum(setup.bottom)
    standing = setup.on_floor_as_seen
    usual = ends[standing].median() if bool(standing.any()) else torch.tensor(setup.box.low[2])
    return torch.where(standing, ends, usual.minimum(ends))


def _model_stiffness(o: SceneObject, E: float, ratio: float) -> float:
    """Young's modulus [Pa], raised so that the body is at least as stiff as the softest bodies in training."""
    bounded = max(E, MIN_STIFFNESS / ratio)
    if bounded / 2 > E:
        log.warning("object %d (%s): %.2g Pa (at this size) is softer than training objects of its thickness; "
                    "%.2g Pa is used instead; compare with --engine mpm", o.id, o.name, E, bounded)  # fmt: skip
    return bounded


def _starts_awake(initial: InitialConditions, units: ModelUnits, setup: SceneSetup) -> Bool[Tensor, "o"]:
    """Mask of the objects with an initial velocity or lift; all objects if gravity does not act downwards."""
    return (initial.velocity[0] != 0).any(-1) | (setup.lift != 0).any(-1) | (units.gravity <= 0)


def _rows(chosen: Collection[int], ids: list[int]) -> Bool[Tensor, "o"]:
    """Mask of the objects with these ids."""
    return torch.tensor([i in chosen for i in ids])


def _pushed(forces: Sequence[Force], ids: list[int], start: float, end: float) -> Bool[Tensor, "o"]:
    """Mask of the objects on which a force acts at some time from `start` to `end` [s]."""
    return _rows({f.object_id for f in forces if f.active_fraction(start, end) > 0}, ids)


def _woken(changes: Sequence[Change], ids: list[int]) -> Bool[Tensor, "o"]:
    """Mask of the objects that changes wake: all by a change of gravity, else the objects of the changes."""
    whole = any(c.what == "gravity" for c in changes)
    return _rows(ids if whole else {c.object_id for c in changes}, ids)


def _changed(objects: FieldObjects, options: SimulateOptions) -> InitialConditions:
    """`_initial_conditions` with the materials, friction and gravity of these options, in unchanged units."""
    setup, units = objects.setup, objects.units
    setup = replace(setup, materials=choose_for_bodies(objects.scene, setup.bodies, options))
    gravity = options.gravity * units.length / objects.scene.metres_per_unit / units.time**2
    return _initial_conditions(replace(objects, setup=setup, units=replace(units, gravity=gravity)), options)


def _load_forces(slots: ExternalForces, initial: InitialConditions, forces: Sequence[Force], ids: list[int]) -> None:
    """Overwrite `slots` with these forces, in place. There must be enough slots; unused ones have no effect."""
    rest = [Force(ids[0], start=0.0, end=0.0)] * (slots.object.shape[1] - len(forces))
    new = ExternalForces.from_prompts(initial, ForcePrompts((*forces, *rest)), ids)
    for name in ("object", "force", "torque", "start", "end", "point"):
        getattr(slots, name).copy_(getattr(new, name))


def _warn_extrapolation(initial: InitialConditions, model: Dynamics) -> None:
    """Warn of conditions outside the training data, and of quantities that the model does not take into account."""
    points = initial.points[0]
    hidden = ~initial.valid[0, ..., None]
    long = (points.masked_fill(hidden, -torch.inf).amax(1) - points.masked_fill(hidden, torch.inf).amin(1)).amax(1)
    if float(long.max() / long.min()) > SIZE_RANGE[1] / SIZE_RANGE[0]:
        log.warning("the largest object is %.1f times as long as the smallest, but at most %.1f times in training; "
                    "compare with --engine mpm", long.max() / long.min(), SIZE_RANGE[1] / SIZE_RANGE[0])  # fmt: skip
    thin = min(float(box_sides(p[valid])[0]) for p, valid in zip(points, initial.valid[0], strict=True))
    if thin < MIN_THICKNESS / 1.5:
        log.warning("an object is %.2g times thinner than any in training and may sink into others; "
                    "compare with --engine mpm", MIN_THICKNESS / thin)  # fmt: skip
    if len(long) > MAX_OBJECTS:
        log.warning("the scene has %d objects, but the model was tested with up to %d; compare with --engine mpm",
                    len(long), MAX_OBJECTS)  # fmt: skip
    if float(initial.velocity.norm(dim=-1).max()) > MAX_SPEED:
        log.warning("an object has a higher initial speed than any in training; compare with --engine mpm")
    for name in sorted({"mass", "E", "friction", "gravity"} - model.inputs):
        log.warning("this model does not take the %s into account", name)


def _state(
    keypoints: Keypoints, ids: list[int], start: tuple[Int[Tensor, "p"], Float[Tensor, "p 3"]],
    initial: InitialConditions, moved: Float[Tensor, "1 o n 3"],
) -> FrameState:  # fmt: skip
    """The state with keypoints displaced by `moved` [scene units], and the centres of mass of the objects.

    start: row of each keypoint's object, and each keypoint's position after the lift [scene units].
    """
    row, lifted = start
    order = row.argsort(stable=True)  # keypoints sorted by object, as in `initial`
    valid = initial.valid[0]
    positions = lifted.index_add(0, order, moved[0][valid])
    weighted = initial.mass_fraction[0][valid][:, None] * positions[order]
    centre = torch.zeros(len(ids), 3).index_add(0, row[order], weighted)
    return FrameState(positions, centre, object_rotations(keypoints, positions, ids))
