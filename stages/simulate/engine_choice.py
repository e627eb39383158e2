"""The choice of `--engine auto` and `--contact auto`, by how far weight, forces and impacts deform the objects."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial import ConvexHull, QhullError

from stages.core.physics.forces import ForcePrompts
from stages.core.physics.materials import MODELS, Material, choose_materials
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Keypoints
from stages.simulate.options import AUTO, SimulateOptions
from stages.simulate.setup import held_as_seen

log = logging.getLogger(__name__)
MAX_RIGID_SAG = 0.02  # largest compressive strain of a rigid body by its own weight and the load on it
MAX_SOLVED_SAG = 0.027  # largest strain by own weight with solved contacts; dents then leave gaps of 5 % of height
MAX_RIGID_DROOP = 0.1  # largest `droop` of a rigid body
MAX_RIGID_IMPACT = 0.1  # largest compressive strain of a rigid body by an impact; `plausibility.py` warns above it
NO_PROMPTS = ForcePrompts()


def with_engine(
    options: SimulateOptions, scene: Scene, keypoints: Keypoints, prompts: ForcePrompts = NO_PROMPTS
) -> SimulateOptions:
    """Replace `auto` in the options by an engine and a kind of contacts.

    The engine is the learned one if weights, an integrator or contacts are given. Otherwise it is MPM if an object
    yields or flows, has parts of different materials, or is soft, and rigid bodies if there is no such object. An
    object is soft if its own weight and the load on it, or a force of the prompts, compress it by more than
    MAX_RIGID_SAG; if an impact, at the speed that the prompts give it or of an object that falls on it, compresses it
    by more than MAX_RIGID_IMPACT; or if it is a sheet or rod off the floor that bends by more than MAX_RIGID_DROOP.
    An object whose material is not known counts as rigid.

    In live sessions, and for objects of photos that are held at rest, MPM is not suitable. There the learned engine
    replaces it, unless the prompts move an object sideways, since learned contacts have almost no friction; and rigid
    bodies replace it if only impacts deform objects, since learned contacts have almost no restitution.

    Contacts of the learned engine are learned if weight compresses an object by more than MAX_SOLVED_SAG and the
    prompts move no object sideways; with an integrator, since solved contacts have no rate of change; and with given
    weights, which may be of a model without solved contacts. Otherwise they are solved.
    """
    engine = options.engine
    if engine == AUTO:
        engine = _engine(options, scene, keypoints, prompts)
    options = replace(options, engine=engine)
    if options.contact != AUTO or engine != "ngff":
        return options
    if options.weights is not None or options.integrator != "step":
        return replace(options, contact="learned")
    blocks = [] if _sideways(prompts) else _blocks(options, scene, keypoints, prompts)
    soft = [block for block in blocks if sag(block.material, block.sides[2], options.gravity) > MAX_SOLVED_SAG]
    if soft:
        log.info("--contact learned, as object %d is compressed by more than %.1f %% by its own weight",
                 soft[0].id, 100 * MAX_SOLVED_SAG)  # fmt: skip
    return replace(options, contact="learned" if soft else "solved")


def _engine(options: SimulateOptions, scene: Scene, keypoints: Keypoints, prompts: ForcePrompts) -> str:
    """The engine for `--engine auto`, with a log message that gives the reason."""
    if options.weights is not None or options.integrator != "step" or options.contact != AUTO:
        return "ngff"
    materials = choose_materials(scene.objects, options.material, options.materials)
    uneven = [o for o in scene.objects if materials[o.id].several]
    plastic = [o for o in scene.objects if MODELS[materials[o.id].material.model].plastic]
    blocks, held = _blocks(options, scene, keypoints, prompts), held_as_seen(scene, options)
    # objects of photos are already deformed by the objects that rest on them
    falling = [block for block in blocks if block.speed or not held]
    floor = _floor(options, scene, blocks)
    reasons = [reason for block in blocks if (reason := _deformed(block, falling, floor, options.gravity))]
    lasting, sideways = [reason for reason in reasons if not reason.impact], _sideways(prompts)
    if plastic:
        engine, reason = "mpm", f"object {plastic[0].id} yields or flows"
    elif uneven:
        engine, reason = "mpm", f"object {uneven[0].id} has parts of different materials"
    elif reasons and (options.live or held) and not (lasting and sideways):
        unlike = "is too slow for live sessions" if options.live else "does not hold objects of photos at rest"
        engine = "ngff" if lasting else "rigid"
        reason = f"{(lasting or reasons)[0].text}, and --engine mpm {unlike}"
    elif reasons:
        engine, reason = "mpm", (lasting or reasons)[0].text
    else:
        engine, reason = "rigid", "all objects are stiff"
    log.info("--engine %s, as %s", engine, reason)
    return engine


class _Block(NamedTuple):
    """The axis-aligned bounding box of an object after its lift, with its material and what acts on it, in SI units."""

    id: int
    material: Material
    guessed: bool  # the material is not known
    low: Float[np.ndarray, "3"]  # lower corner
    high: Float[np.ndarray, "3"]  # upper corner
    extents: Float[np.ndarray, "3"]  # along the principal axes of the object, ascending
    mass: float
    speed: float  # initial speed, increased by the fall from the height of the lift [m/s]
    force: float  # largest force of the prompts [N]

    @property
    def sides(self) -> Float[np.ndarray, "3"]:
        return self.high - self.low

    @property
    def base(self) -> float:
        """Area of the base [m^2]."""
        return float(max(self.sides[0] * self.sides[1], 1e-12))

    def is_above(self, other: _Block) -> bool:
        """Whether it is over another block and above its middle, so that it may fall or rest on it."""
        beside = (self.low[:2] >= other.high[:2]).any() or (self.high[:2] <= other.low[:2]).any()
        return not beside and bool(self.low[2] >= (other.low[2] + other.high[2]) / 2)


def _blocks(options: SimulateOptions, scene: Scene, keypoints: Keypoints, prompts: ForcePrompts) -> list[_Block]:
    """Blocks of the objects that have keypoints; masses are those of the convex hulls of the keypoints."""
    materials = choose_materials(scene.objects, options.material, options.materials)
    unit, blocks = scene.metres_per_unit, []
    for o in scene.objects:
        x = unit * keypoints.rest[keypoints.object_id == o.id].double().numpy()
        if not len(x):
            continue
        _, axes = np.linalg.eigh(np.cov(x.T, bias=True))
        try:
            volume = float(ConvexHull(x).volume)
        except (QhullError, ValueError):  # coplanar keypoints
            volume = 0.0
        lift = np.array([0.0, 0.0, unit * prompts.lift.get(o.id, 0.0)])
        choice = materials[o.id]
        force = max((math.hypot(*f.force) for f in prompts.forces if f.object_id == o.id), default=0.0)
        blocks.append(_Block(o.id, choice.material, choice.guessed, x.min(0) + lift, x.max(0) + lift,
                             np.ptp(x @ axes, axis=0), choice.material.density * volume,
                             _speed(scene, o.id, prompts, options), force))  # fmt: skip
    return blocks


def _floor(options: SimulateOptions, scene: Scene, blocks: Sequence[_Block]) -> float:
    """Height of the floor [m]; the lowest point of all objects if the scene has no floor."""
    floor = options.floor if options.floor is not None else scene.floor
    lowest = min((float(block.low[2]) for block in blocks), default=0.0)
    return lowest if floor is None else scene.metres_per_unit * floor


class _Reason(NamedTuple):
    """Why an object counts as soft."""

    text: str
    impact: bool  # deformed only by an impact, not permanently


def _deformed(block: _Block, others: Sequence[_Block], floor: float, gravity: float) -> _Reason | None:
    """Why an object deforms too much to count as rigid; None if it is rigid or its material is not known.

    `others` may press on it or hit it.
    """
    if block.guessed:
        return None
    m, height, g = block.material, float(block.sides[2]), abs(gravity)
    above = [other for other in others if other is not block and other.is_above(block)]
    load = g * sum(other.mass / min(other.base, block.base) for other in above)  # [Pa]
    hits = (v * math.sqrt(other.mass / (m.E * min(other.base, block.base) * max(height, 1e-12)))
            for other in above if (v := other.speed))  # fmt: skip
    if sag(m, height, g) > MAX_RIGID_SAG:
        return _Reason(f"object {block.id} is compressed by more than {MAX_RIGID_SAG:.0%} by its own weight", False)
    if load / m.E + sag(m, height, g) > MAX_RIGID_SAG:
        return _Reason(f"object {block.id} is compressed by more than {MAX_RIGID_SAG:.0%} by what is above it", False)
    least_face = max(float(np.prod(np.sort(block.sides)[:2])), 1e-12)
    if block.force / (m.E * least_face) > MAX_RIGID_SAG:
        return _Reason(f"object {block.id} is compressed by more than {MAX_RIGID_SAG:.0%} by a force on it", False)
    off_floor = block.low[2] - floor > block.extents[0]
    if off_floor and droop(m, block.extents, g) > MAX_RIGID_DROOP:
        return _Reason(f"object {block.id} is so thin that it bends under its own weight", False)
    if max(impact(m, block.speed), *hits, 0.0) > MAX_RIGID_IMPACT:
        return _Reason(f"an impact compresses object {block.id} by more than {MAX_RIGID_IMPACT:.0%}", True)
    return None


def for_engine(prompts: ForcePrompts, scene: Scene, options: SimulateOptions) -> ForcePrompts:
    """Adapt the prompts to the engine: those without parts pin an object as a whole if one of its parts is pinned."""
    if options.engine == "mpm":
        return prompts
    choices = choose_materials(scene.objects, options.material, options.materials)
    for o in scene.objects:
        parts = choices[o.id].several
        held = any(part.pinned for part in parts)
        if parts:
            log.warning("object %d (%s): --engine %s supports one material per object and uses the average of the "
                        "object's parts%s; with --engine mpm each part has its own material", o.id, o.name,
                        options.engine, ", and holds the whole object fixed" * held)  # fmt: skip
        prompts = replace(prompts, pinned=prompts.pinned | {o.id}) if held else prompts
    return prompts


def sag(material: Material, height: float, gravity: float) -> float:
    """Approximate compressive strain of a body of this height [m] under its own weight; gravity in m/s^2."""
    return material.density * abs(gravity) * height / material.E


def droop(material: Material, extents: Sequence[float], gravity: float) -> float:
    """Tip deflection of a sheet or rod with half of its length overhanging an edge, relative to the overhang.

    Euler-Bernoulli cantilever under its own weight. `extents` [m] are ascending, the first is the thickness; gravity in
    m/s^2.
    """
    return 1.5 * material.density * abs(gravity) * (extents[2] / 2) ** 3 / (material.E * max(extents[0], 1e-12) ** 2)


def impact(material: Material, speed: float) -> float:
    """Approximate compressive strain of a body that hits a rigid one at this speed [m/s].

    It is the strain behind the elastic wave in a rod, speed / sqrt(E / density).
    """
    return speed * math.sqrt(material.density / material.E)


def _speed(scene: Scene, object_id: int, prompts: ForcePrompts, options: SimulateOptions) -> float:
    """Initial speed of an object, increased by the fall from the height of its lift [m/s]."""
    unit = scene.metres_per_unit
    lift = unit * max(prompts.lift.get(object_id, 0.0), 0.0)
    thrown = unit * math.hypot(*prompts.velocity.get(object_id, (0.0,)))
    return math.sqrt(thrown**2 + 2 * abs(options.gravity) * lift)


def _sideways(prompts: ForcePrompts) -> list[int]:
    """Ids of the objects that the prompts throw or push horizontally."""
    pushes = [*prompts.velocity.items(), *((f.object_id, f.force) for f in prompts.forces)]
    return [id for id, v in pushes if any(v[:2])]
