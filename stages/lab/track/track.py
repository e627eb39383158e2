"""`ngff-lab track`: a scene and the films of its cameras -> the motion of its objects."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from itertools import repeat
from pathlib import Path

import torch
from jaxtyping import Int
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.physics.keypoints import bind_gaussians, choose_keypoints
from stages.core.scene.files import check_output, provenance
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.trajectory import Keypoints, SimulationInfo, TrajectoryWriter
from stages.lab.track.deform import deformations, followed, soft_rows
from stages.lab.track.films import list_films, read_films
from stages.lab.track.follow import TrackedMotion, Tracker, follow
from stages.lab.track.options import TrackOptions

log = logging.getLogger(__name__)
GRAVITY = 9.81  # acceleration of gravity [m/s^2]


def run(scene: Path, folder: Path, out: Path, options: TrackOptions) -> Iterator[str]:
    """Track the objects of a scene through films, write their motion, and yield a line for each object.

    Raises InputError for a scene without objects or film times, and for films or label images that do not match it.
    """
    check_output(Path(out), "trajectory")
    world, device = read_scene(scene), pick_device(options.device)
    if world.sequence is None or world.cameras is None:
        raise InputError(
            f"{scene}: does not state when its cameras filmed; reconstruct it with `ngff reconstruct --sequence`"
        )
    check_objects(world, scene)
    fps, frames = world.sequence.fps, options.frames or world.sequence.frames
    cameras, films = read_films(world, list_films(world, folder), frames, options.resolution, options.masks)
    tracker = Tracker(world, cameras, films, device)
    fall = torch.tensor([0.0, 0.0, -GRAVITY / world.metres_per_unit], device=device)
    rows = soft_rows(world, options.soft)
    track, bodies = deformations(tracker, follow(tracker, frames, fall / fps**2), rows)
    made_by = {**provenance("track", [scene, folder], options), "scene": world.provenance, "starts": track.starts}
    keypoints = choose_keypoints(world, options.keypoints, options.seed)
    info = SimulationInfo(1 / fps, tuple(fall.tolist()), "track")
    binding = bind_gaussians(world, keypoints)
    row, each = rows_of(world, keypoints), torch.arange(len(world.objects))
    middle = torch.stack([keypoints.rest[row == i].mean(0) for i in each])
    poses, rest = track.poses.to("cpu"), tracker.rest.centre.cpu()
    arm = keypoints.rest - rest[row]
    bends = followed(bodies, row, arm) if bodies else repeat(torch.zeros_like(arm))
    with TrajectoryWriter(out, replace(world, provenance=made_by), info, keypoints, binding) as writer:
        for frame, bend in zip(range(frames), bends, strict=False):
            now = poses[frame]
            writer.append(now.place(arm + bend, row), now.place(middle - rest, each), now.quaternions())
        writer.store_confidence(track.confidence)
    log.info("%s: %d frames of %d objects from %d films", out, frames, len(world.objects), len(films))
    yield from report(world, track)


def rows_of(world: Scene, keypoints: Keypoints) -> Int[Tensor, "k"]:
    """The scene row of the object that each keypoint belongs to."""
    return (keypoints.object_id[:, None] == torch.tensor([o.id for o in world.objects])).int().argmax(1)


def check_objects(world: Scene, path: Path) -> None:
    """Raise InputError for a scene without objects, or with an object that has no Gaussians."""
    present = set(world.gaussians.object_id.unique().tolist())
    if not world.objects or (empty := [o.name for o in world.objects if o.id not in present]):
        what = f"{empty[0]} has no Gaussians" if world.objects else "it has no objects"
        raise InputError(f"{path}: {what}; label its objects with `ngff segment`")


def report(world: Scene, track: TrackedMotion) -> Iterator[str]:
    """A line for each object: in how many frames it was seen, and when and why it was lost."""
    for i, o in enumerate(world.objects):
        share, pixels = track.confidence[:, i], track.pixels[:, i]
        seen = share > 0
        line = f"{o.id} {o.name}: seen in {int(seen.sum())} of {len(seen)} frames, mean confidence "
        line += f"{float(share[seen].mean()):.2f}" if seen.any() else "0"
        for first, last in _runs((~seen).tolist()):
            why = "hidden or not recognised" if float(pixels[first : last + 1].median()) > 0 else "out of view"
            line += f"; lost in {first} to {last} ({why})" if last > first else f"; lost in {first} ({why})"
        yield line


def _runs(mask: list[bool]) -> list[tuple[int, int]]:
    """First and last index of each run of true values."""
    starts = [i for i, x in enumerate(mask) if x and (i == 0 or not mask[i - 1])]
    ends = [i for i, x in enumerate(mask) if x and (i == len(mask) - 1 or not mask[i + 1])]
    return list(zip(starts, ends, strict=True))
