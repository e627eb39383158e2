"""The engine of `--engine auto` and its contacts: by how far weight and impacts deform the objects."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import replace

from stages.core.physics.forces import ForcePrompts
from stages.core.physics.materials import MODELS, Material, MaterialChoice, choose_materials
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.trajectory import Keypoints
from stages.simulate.options import AUTO, SimulateOptions

log = logging.getLogger(__name__)
MAX_RIGID_SAG = 0.02  # largest compression under its own weight of a body that counts as rigid
MAX_SOLVED_SAG = 0.027  # the same of a body with solved contacts, whose dents then leave gaps of 5 % of its height
MAX_RIGID_IMPACT = 0.1  # largest compression by its own impact; that of which `plausibility.py` warns
NO_PROMPTS = ForcePrompts()


def with_engine(
    options: SimulateOptions, scene: Scene, keypoints: Keypoints, prompts: ForcePrompts = NO_PROMPTS
) -> SimulateOptions:
    """The options with an engine and contacts in place of `auto`.

    MPM if an object yields or flows, or has parts of different materials. Rigid bodies if no weight compresses an
    object by more than MAX_RIGID_SAG, nor the speed that the prompts give it by more than MAX_RIGID_IMPACT. Of the two
    engines for soft bodies MPM if the prompts move an object sideways or the impact is what compresses it, since the
    learned field has next to no friction and rebound; else the learned field, which keeps bodies in contact better.
    Options of learned engines (weights, an integrator, its contacts) select it. Its contacts are learned if weight
    compresses an object by more than MAX_SOLVED_SAG and the prompts move none sideways, with an integrator, since
    solved ones have no rate of change, or with weights, which may be of a model without these contacts; else they are
    solved.
    """
    engine = options.engine
    if engine == AUTO:
        engine = _engine(options, scene, keypoints, prompts)
    options = replace(options, engine=engine)
    if options.contact != AUTO or engine != "ngff":
        return options
    if options.weights is not None or options.integrator != "step":
        return replace(options, contact="learned")
    materials = choose_materials(scene.objects, options.material, options.materials)
    soft = [] if _sideways(prompts) else _soft(materials, scene, keypoints, options.gravity, MAX_SOLVED_SAG)
    if soft:
        log.info("--contact learned, as object %d is compressed by more than %.1f %% by its own weight",
                 soft[0].id, 100 * MAX_SOLVED_SAG)  # fmt: skip
    return replace(options, contact="learned" if soft else "solved")


def _engine(options: SimulateOptions, scene: Scene, keypoints: Keypoints, prompts: ForcePrompts) -> str:
    """The engine in place of `auto`."""
    if options.weights is not None or options.integrator != "step" or options.contact != AUTO:
        return "ngff"
    materials = choose_materials(scene.objects, options.material, options.materials)
    uneven = [o for o in scene.objects if materials[o.id].several]
    plastic = [o for o in scene.objects if MODELS[materials[o.id].material.model].plastic]
    soft = _soft(materials, scene, keypoints, options.gravity, MAX_RIGID_SAG)
    crushed = [o for o in scene.objects if impact(materials[o.id].material, _speed(scene, o.id, prompts, options))
               > MAX_RIGID_IMPACT]  # fmt: skip
    sideways = _sideways(prompts) if soft or crushed else []
    if plastic:
        engine, reason = "mpm", f"object {plastic[0].id} yields or flows"
    elif uneven:
        engine, reason = "mpm", f"object {uneven[0].id} has parts of different materials"
    elif sideways:
        engine, reason = "mpm", f"object {(soft or crushed)[0].id} is soft, and friction acts on object {sideways[0]}"
    elif soft:
        engine, reason = "ngff", f"object {soft[0].id} is compressed by more than {MAX_RIGID_SAG:.0%} by its own weight"
    elif crushed:
        engine, reason = "mpm", f"an impact compresses object {crushed[0].id} by more than {MAX_RIGID_IMPACT:.0%}"
    else:
        engine, reason = "rigid", "all objects are stiff"
    log.info("--engine %s, as %s", engine, reason)
    return engine


def _soft(
    materials: Mapping[int, MaterialChoice], scene: Scene, keypoints: Keypoints, gravity: float, limit: float
) -> list[SceneObject]:
    """The objects that their own weight compresses by more than `limit`."""
    return [o for o in scene.objects
            if sag(materials[o.id].material, _height(scene, keypoints, o.id), gravity) > limit]  # fmt: skip


def for_engine(prompts: ForcePrompts, scene: Scene, options: SimulateOptions) -> ForcePrompts:
    """The prompts, with objects that have a pinned part pinned as a whole where the engine has no parts."""
    if options.engine == "mpm":
        return prompts
    choices = choose_materials(scene.objects, options.material, options.materials)
    for o in scene.objects:
        parts = choices[o.id].several
        held = any(part.pinned for part in parts)
        if parts:
            log.warning("object %d (%s): --engine %s has one material for an object and takes the average of its parts"
                        "%s; with --engine mpm each part has its own", o.id, o.name, options.engine,
                        ", and pins it as a whole" * held)  # fmt: skip
        prompts = replace(prompts, pinned=prompts.pinned | {o.id}) if held else prompts
    return prompts


def sag(material: Material, height: float, gravity: float) -> float:
    """Compression of a body of some height [m] under its own weight, about; gravity in m/s^2."""
    return material.density * abs(gravity) * height / material.E


def impact(material: Material, speed: float) -> float:
    """Compression of a body that hits a rigid one at some speed [m/s], about: that behind the elastic wave in a rod."""
    return speed * math.sqrt(material.density / material.E)


def _speed(scene: Scene, object_id: int, prompts: ForcePrompts, options: SimulateOptions) -> float:
    """Speed [m/s] of an object at the start and after the fall of its lift."""
    unit = scene.metres_per_unit
    lift = unit * max(prompts.lift.get(object_id, 0.0), 0.0)
    thrown = unit * math.hypot(*prompts.velocity.get(object_id, (0.0,)))
    return math.sqrt(thrown**2 + 2 * abs(options.gravity) * lift)


def _sideways(prompts: ForcePrompts) -> list[int]:
    """Ids of the objects that the prompts throw or push horizontally."""
    pushes = [*prompts.velocity.items(), *((f.object_id, f.force) for f in prompts.forces)]
    return [id for id, v in pushes if any(v[:2])]


def _height(scene: Scene, keypoints: Keypoints, object_id: int) -> float:
    z = keypoints.rest[keypoints.object_id == object_id, 2]
    return float(z.max() - z.min()) * scene.metres_per_unit
