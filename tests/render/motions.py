"""Trajectories of the two balls."""

import torch

from stages.core.physics.keypoints import bind_gaussians
from stages.core.scene.trajectory import Keypoints, SimulationInfo, TrajectoryWriter


def rising(path, scene, frames: int = 5, step: float = 0.01, forces: tuple = ()):
    """Write a trajectory in which both balls rise by `step` per frame, at 50 frames per second."""
    g = scene.gaussians
    rows = torch.cat([(g.object_id == o.id).nonzero()[:60, 0] for o in scene.objects])
    keypoints = Keypoints(g.means[rows], g.object_id[rows])
    motion = SimulationInfo(0.02, (0.0, 0.0, 0.0), "test", forces)
    centres = torch.stack([g.means[g.object_id == o.id].mean(0) for o in scene.objects])
    turns = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(scene.objects), 1)
    with TrajectoryWriter(path, scene, motion, keypoints, bind_gaussians(scene, keypoints)) as out:
        for t in range(frames):
            up = torch.tensor([0.0, 0.0, step * t])
            out.append(keypoints.rest + up, centres + up, turns)
    return path
