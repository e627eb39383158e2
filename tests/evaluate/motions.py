"""Trajectories of the two balls with analytic motion."""

from dataclasses import replace

import torch

from stages.core.geometry.rotations import matrix
from stages.core.physics.keypoints import bind_gaussians
from stages.core.scene.trajectory import Keypoints, SimulationInfo, TrajectoryWriter


def rotation(angle: float) -> torch.Tensor:
    """Rotation by an angle [rad] about a fixed oblique axis."""
    axis = torch.tensor([1.0, 2, 2]) / 3
    half = torch.tensor(angle / 2)
    return matrix(torch.cat([half.cos()[None], half.sin() * axis]))


def moved(points, object_id, t: int, spin: float = 0.15, speed: float = 0.03):
    """Positions of points of two objects that rotate about their centres, fall and drift along y (the second more)."""
    out = points.clone()
    for id, centre in ((1, torch.tensor([-0.3, 0.0, 0.15])), (2, torch.tensor([0.3, 0.0, 0.40]))):
        mine = object_id == id
        drift = torch.tensor([0.0, speed * t * id, -0.01 * t])
        out[mine] = (points[mine] - centre) @ rotation(spin * t).mT + centre + drift
    return out


def write_motion(path, scene, seed=0, count=100, frames=12, dt=0.02, change=None, **motion):
    """Write a trajectory with `count` random keypoints per object; `change` modifies their positions in each frame."""
    g = scene.gaussians
    rng = torch.Generator().manual_seed(seed)
    rows = [ids[torch.randperm(len(ids), generator=rng)[:count]] for ids in
            ((g.object_id == o.id).nonzero()[:, 0] for o in scene.objects)]  # fmt: skip
    rows = torch.cat(rows)
    keypoints = Keypoints(g.means[rows], g.object_id[rows])
    info = SimulationInfo(dt, (0.0, 0.0, -9.81), "test")
    with TrajectoryWriter(path, scene, info, keypoints, bind_gaussians(scene, keypoints)) as out:
        for t in range(frames):
            positions = moved(keypoints.rest, keypoints.object_id, t, **motion)
            com = torch.stack([positions[keypoints.object_id == o.id].mean(0) for o in scene.objects])
            positions = positions if change is None else change(positions)
            out.append(positions, com, torch.tensor([[1.0, 0, 0, 0]]).repeat(len(scene.objects), 1))
    return path


def renamed(scene, names):
    return replace(scene, objects=tuple(replace(o, name=n) for o, n in zip(scene.objects, names, strict=True)))


def transformed_scene(scene, similarity):
    """The scene after a similarity transform of its Gaussians and cameras."""
    g = scene.gaussians
    g = replace(g, means=similarity(g.means), scales=g.scales * similarity.scale)
    return replace(scene, gaussians=g, cameras=scene.cameras.transformed(similarity))
