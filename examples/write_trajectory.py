"""Write a traj.h5 with h5py alone, as another tool would: a thrown ball. python write_trajectory.py traj.h5"""

import argparse

import h5py
import numpy as np

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("out", help="trajectory to write (.h5)")
out = parser.parse_args().out

n, frames, dt = 500, 50, 0.02
rng = np.random.default_rng(0)
normals = rng.normal(size=(n, 3))
means = 0.1 * normals / np.linalg.norm(normals, axis=1, keepdims=True) + [0, 0, 0.1]
time = dt * np.arange(frames)[:, None]
path = time * [1.0, 0, 3] - [0, 0, 9.81 / 2] * time**2

with h5py.File(out, "w") as f:
    f.attrs.update(format="ngff-trajectory", version=1, fps=1 / dt, dt=dt, gravity=[0, 0, -9.81], engine="mine")
    f["gaussians/means"], f["gaussians/scales"] = np.float32(means), np.full((n, 3), 0.01, np.float32)
    f["gaussians/quats"] = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    f["gaussians/opacities"], f["gaussians/object_id"] = np.ones(n, np.float32), np.ones(n, np.int64)
    f["gaussians/sh"] = rng.uniform(-1, 1, (n, 1, 3)).astype(np.float32)
    f["objects/id"], f["objects/name"] = [1], ["ball"]
    f["objects/com"] = np.float32(path[:, None] + [0, 0, 0.1])
    f["objects/rotation"] = np.tile(np.float32([1, 0, 0, 0]), (frames, 1, 1))
    f["keypoints/rest"], f["keypoints/object_id"] = np.float32([[0, 0, 0.1]]), [1]
    f["keypoints/positions"] = np.float32(path[:, None] + [0, 0, 0.1])
    f["binding/index"], f["binding/weight"] = np.zeros((n, 1), np.int64), np.ones((n, 1), np.float32)
