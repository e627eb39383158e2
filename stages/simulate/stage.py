"""`ngff simulate`: scene.ply -> traj.h5."""

from __future__ import annotations

import logging
import time
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import tqdm

from stages.core.backends import load, pick_device
from stages.core.errors import InputError
from stages.core.physics import forces
from stages.core.physics.keypoints import bind_gaussians, choose_keypoints
from stages.core.physics.material_parts import segment_files
from stages.core.physics.materials import choose_materials
from stages.core.physics.recording import read_prompts_file, read_recording
from stages.core.scene.files import check_output, provenance, seconds_since
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.trajectory import SimulationInfo, TrajectoryWriter
from stages.core.torch_state import standard_torch
from stages.simulate.engine_choice import for_engine, with_engine
from stages.simulate.options import AUTO, ENGINES, SimulateOptions
from stages.simulate.plausibility import PlausibilityMonitor
from stages.simulate.setup import tell_of_unseen_sides

log = logging.getLogger(__name__)
MIN_EXTENT = 1e-5  # smallest extent of an object, relative to its coordinates, which have 24 bits of precision


@standard_torch()
def run(
    scene: Path, out: Path,
    options: SimulateOptions = SimulateOptions(),  # noqa: B008 -- frozen
    given: Collection[str] = (),
) -> None:  # fmt: skip
    """Simulate the objects of a scene: scene.ply -> traj.h5.

    With --live the simulation runs until Ctrl-C. `given`: names of options that a recording (--forces) does not
    replace, in addition to those that differ from their defaults. Raises InputError for wrong options or input, and if
    the simulation diverges; the frames so far are then kept in OUT.partial.h5.
    """
    began, options = time.monotonic(), with_recorded(options, given)
    options = replace(options, keypoints=options.keypoint_count)
    if options.engine not in (AUTO, *ENGINES):
        raise InputError(f"--engine {options.engine}: choose from {', '.join((AUTO, *ENGINES))}")
    pick_device(options.device)  # a wrong name is an error with every engine
    check_output(Path(out), "trajectory")
    world = with_objects(read_scene(scene), scene, options.seed, options.device)
    tell_of_unseen_sides(world, Path(scene))
    stored = forces.ForcePrompts()
    if options.forces is not None:
        stored = read_prompts_file(options.forces, Path(scene).stem, world.objects)
    prompts = forces.parse(world.objects, options.force, options.pin, options.velocity, options.lift, stored)
    _tell_of_idle_prompts(prompts, world, options)
    keypoints = choose_keypoints(world, options.keypoint_count, options.seed)
    options = with_engine(options, world, keypoints, prompts)
    prompts = for_engine(prompts, world, options)
    rollout = load(ENGINES[options.engine].rollout)
    inputs = [scene, *segment_files(choose_materials(world.objects, options.material, options.materials))]
    world = replace(world, provenance={**provenance("simulate", inputs, options), "scene": world.provenance})
    gravity = (0.0, 0.0, -options.gravity / world.metres_per_unit)
    motion = SimulationInfo(options.dt, gravity, options.engine, prompts.as_dicts())
    if options.live:
        from stages.simulate.live.loop import LiveScene, run_live  # noqa: PLC0415 -- most runs are not live

        return run_live(LiveScene(world, keypoints, prompts, options, rollout), Path(out), motion)
    states = rollout(world, keypoints, prompts, options)
    monitor = PlausibilityMonitor(world, keypoints, prompts, options)
    start, max_displacement = None, 0.0
    with TrajectoryWriter(out, world, motion, keypoints, bind_gaussians(world, keypoints)) as trajectory:
        for state in tqdm(states, total=options.steps, unit="frame"):
            trajectory.append(state.positions, state.com, state.rotation)
            trajectory.store_field(state.start)
            monitor.add(state)
            start = state.positions if start is None else start
            displacement = float((state.positions - start).norm(dim=1).max())
            max_displacement = max(max_displacement, displacement)
        measured = monitor.result()
        trajectory.store_plausibility(measured)
        trajectory.store_provenance({**world.provenance, **seconds_since(began)})
    monitor.warn(measured)
    size = float((keypoints.rest.amax(0) - keypoints.rest.amin(0)).max())
    if max_displacement < 0.02 * size and not prompts:
        log.info(
            "all objects stay at rest (maximum displacement: %.2g); make them move with --lift 0.3 or a --force",
            max_displacement,
        )
    log.info("%s: %d frames, %.2f s", out, options.steps, options.steps * options.dt)


def _tell_of_idle_prompts(prompts: forces.ForcePrompts, scene: Scene, options: SimulateOptions) -> None:
    """Warn of prompts without effect: those that contradict others, or begin after the end of the simulation."""
    for id in sorted(prompts.pinned & prompts.velocity.keys()):
        log.warning(
            "object %d (%s) is held fixed by --pin, so that its --velocity has no effect", id, scene.name_of(id)
        )
    end = (options.steps - 1) * options.dt
    if late := [f for f in prompts.forces if f.start >= end]:
        name = scene.name_of(late[0].object_id)
        log.warning("%d of %d forces begin after the end of the simulation at %g s, such as a force on %s at %g s; "
                    "increase --steps", len(late), len(prompts.forces), end, name, late[0].start)  # fmt: skip


def with_recorded(options: SimulateOptions, given: Collection[str] = ()) -> SimulateOptions:
    """With --forces RECORDING, replace options that are not given by those of the recording, and `steps` by its length.

    Options that name other files (--materials, --weights) must be given again. If another engine is given, the options
    of the recorded engine are ignored.
    """
    recording = None if options.forces is None else read_recording(options.forces)
    if recording is None:
        return options
    default, recorded = SimulateOptions(), {**recording.options, "steps": recording.frames}
    given = {k for k in recorded if k in given or getattr(options, k) != getattr(default, k)}
    if "engine" in given and options.engine != recorded["engine"]:
        given |= {"contact", "integrator"}
    return replace(options, **{k: v for k, v in recorded.items() if k not in given})


def with_objects(scene: Scene, path: Path, seed: int = 0, device: str = "auto") -> Scene:
    """The scene with the objects that can move; an unlabelled scene is segmented as by `ngff segment`.

    `seed` and `device` are for the segmentation. Objects without Gaussians or extent are left out, with a warning.
    Raises InputError if no object is found.
    """
    present = []
    for o in scene.objects:
        means = scene.gaussians.means[scene.gaussians.object_id == o.id].double()
        if not len(means):
            log.warning("object %d (%s) has no Gaussians and is skipped", o.id, o.name)
        elif (extent := float((means.amax(0) - means.amin(0)).max())) <= MIN_EXTENT * float(means.abs().max()):
            why = "too far from the origin for its size" if extent else "a point"
            log.warning("object %d (%s) is %s (%d Gaussians) and is skipped", o.id, o.name, why, len(means))
        else:
            present.append(o)
    if present:
        return replace(scene, objects=tuple(present))
    if scene.gaussians.object_id.any():
        raise InputError(f"{path}: its objects are single points, or too far from the origin for their size, and "
                         "cannot be "
                         "simulated; label it with `ngff segment`, or move the scene to the origin")  # fmt: skip
    from stages.core.models.segmenter.segment import segment_by_network  # noqa: PLC0415 -- only unlabelled scenes need it

    grouped = segment_by_network(scene, seed=seed, device=pick_device(device))
    if not grouped.objects or not torch.any(grouped.gaussians.object_id > 0):
        raise InputError(f"{path}: no objects were found in the scene; label them with `ngff segment`")
    names = ", ".join(f"{o.id} ({o.name})" for o in grouped.objects)
    log.info("%s has no labelled objects; %d objects were found: %s", path, len(grouped.objects), names)
    return grouped
