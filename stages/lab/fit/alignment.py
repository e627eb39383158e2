"""Conversion of a track to the frame of reference of a scene."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import torch

from stages.core.errors import InputError
from stages.core.physics.recording import read_prompts_file
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Keypoints, Trajectory
from stages.evaluate.align import find_alignment
from stages.evaluate.matching import match_objects
from stages.evaluate.scenes import scene_reference_frame
from stages.evaluate.trajectories import trajectory_reference_frame

log = logging.getLogger(__name__)


def aligned(track: Trajectory, scene: Scene, file: Path) -> Trajectory:
    """The track with the positions, gravity and object ids expressed in the frame of the scene read from `file`.

    Cameras and objects are matched as by `ngff evaluate --align`. Raises InputError if they do not match, or if the
    track has forces, pins or lifts, since these are given in the frame of the track.
    """
    prompts = read_prompts_file(track.path, file.stem, track.scene.objects)
    if replace(prompts, velocity={}):  # velocities are ignored: they are fitted
        raise InputError(f"{track.path}: contains prompts, whose objects and directions refer to another scene "
                         f"than {file}; fit the "
                         "scene to which they refer, without --align")  # fmt: skip
    predicted, true = scene_reference_frame(file, scene), trajectory_reference_frame(track)
    similarity, how = find_alignment(predicted, true)
    pairs, matched = match_objects(predicted.transformed(similarity), true, [])
    log.info("%s; scale %.4g; %s", how, similarity.scale, matched)
    to_scene, ids = similarity.inverse(), {b.id: a.id for a, b in pairs}
    keypoints, info = track.keypoints, track.info
    object_id = torch.tensor([ids[int(i)] for i in keypoints.object_id], dtype=keypoints.object_id.dtype)
    gravity = tuple((to_scene.scale * to_scene.rotation @ torch.tensor(info.gravity).float()).tolist())
    return replace(track, keypoints=Keypoints(to_scene(keypoints.rest), object_id),
                   positions=to_scene(track.positions), info=replace(info, gravity=gravity))  # fmt: skip
