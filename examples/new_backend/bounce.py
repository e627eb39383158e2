"""A custom simulator: every object is a rigid body that falls and bounces. python bounce.py scene.ply traj.h5"""

import argparse
from pathlib import Path

import torch

from stages.core.physics.keypoints import bind_gaussians, choose_keypoints
from stages.core.scene.files import provenance
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.trajectory import SimulationInfo, TrajectoryWriter

DT, FRAMES, RESTITUTION = 0.02, 100, 0.6


def heights(start: float, gravity: float, substeps: int = 20) -> list[float]:
    """Height above the floor in every frame [scene units]: semi-implicit Euler with inelastic bounces."""
    z, v, out = start, 0.0, []
    for _ in range(FRAMES):
        out.append(z)
        for _ in range(substeps):
            v -= gravity * DT / substeps
            z += v * DT / substeps
            if z < 0:
                z, v = 0.0, -RESTITUTION * v
    return out


def simulate(scene: Scene, out: Path) -> None:
    """Write the trajectory of a scene with labelled objects, which `ngff render` and `ngff evaluate` read."""
    keypoints = choose_keypoints(scene, 512, seed=0)
    gravity = 9.81 / scene.metres_per_unit
    of = [keypoints.object_id == o.id for o in scene.objects]
    paths = [heights(float(keypoints.rest[mask, 2].min()) - scene.floor, gravity) for mask in of]
    upright = torch.tensor([[1.0, 0, 0, 0]]).repeat(len(of), 1)
    motion = SimulationInfo(DT, (0.0, 0.0, -gravity), "bounce")
    with TrajectoryWriter(out, scene, motion, keypoints, bind_gaussians(scene, keypoints)) as traj:
        for t in range(FRAMES):
            positions = keypoints.rest.clone()
            for mask, path in zip(of, paths, strict=True):
                positions[mask, 2] += path[t] - path[0]
            traj.append(positions, torch.stack([positions[mask].mean(0) for mask in of]), upright)
    assert all(path[-1] < max(path[0], 0.05) + 1e-6 for path in paths)  # no object ends higher than it started


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, help="scene with labelled objects (.ply), as `ngff segment` writes")
    parser.add_argument("out", type=Path, help="trajectory to write (.h5)")
    given = parser.parse_args()
    simulate(read_scene(given.scene), given.out)
    print(given.out, provenance("bounce", [given.scene])["inputs"])
