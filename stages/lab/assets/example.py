"""The shipped example: rendered photos of toys, with ground truth."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from tqdm import tqdm

from stages.core.geometry.cameras import intrinsics, orbit
from stages.core.raster.rasterise import rasterise, visibility
from stages.core.scene.cameras import Cameras
from stages.core.scene.images import write_jpeg, write_labels
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import write_scene
from stages.core.scene.trajectory import Binding, TrajectoryWriter, read_trajectory
from stages.lab.assets.toys import falling_toys
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run as simulate

WIDTH, HEIGHT, FOCAL = 640, 480, 620.0  # size and focal length of the photos [px]
WALL = torch.tensor([0.62, 0.66, 0.70])  # background colour of the photos


def make_example(out: Path, photos: int = 26) -> None:
    """Write photos/NN.jpg, masks/NN.png (object ids), masks/names.json, cameras.json (transforms) and truth.h5."""
    out = Path(out)
    for folder in ("photos", "masks"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    scene = replace(falling_toys(), cameras=_cameras(photos))
    for i, name in enumerate(tqdm(scene.cameras.names, desc="photos", unit="photo")):
        viewmat, K = scene.cameras.viewmats[i], scene.cameras.Ks[i]
        drawn = rasterise(scene.gaussians, viewmat[None], K[None], WIDTH, HEIGHT, WALL)
        write_jpeg(out / "photos" / name, drawn.rgb[0])
        index = visibility(scene.gaussians, viewmat, K, WIDTH, HEIGHT).index
        labels = torch.where(index >= 0, scene.gaussians.object_id[index.clamp_min(0)], 0)
        write_labels(out / "masks" / f"{Path(name).stem}.png", labels)
    (out / "masks/names.json").write_text(json.dumps({o.id: o.name for o in scene.objects}))
    (out / "cameras.json").write_text(json.dumps(_transforms(scene.cameras), indent=1))
    _write_truth(scene, out / "truth.h5")


def _cameras(count: int) -> Cameras:
    """Two rings of views around the toys: a low one, from which the undersides are visible, and a high one."""
    low = count * 3 // 5
    centre = torch.tensor([0.0, 0.0, 0.11])
    rings = [orbit(low, centre, 1.0, 20.0), orbit(count - low, centre, 1.05, 42.0, azimuth=127.0)]
    K = intrinsics(WIDTH, HEIGHT, FOCAL).expand(count, 3, 3).clone()
    names = tuple(f"{i:02d}.jpg" for i in range(count))
    return Cameras(torch.cat(rings), K, torch.tensor([[WIDTH, HEIGHT]] * count), names)


def _transforms(cameras: Cameras) -> dict:
    """Cameras in the format of nerfstudio: camera-to-world with OpenGL axes."""
    poses = torch.linalg.inv(cameras.viewmats) @ torch.diag(torch.tensor([1.0, -1, -1, 1]))
    rows = zip(cameras.names, poses.tolist(), strict=True)
    frames = [{"file_path": f"photos/{name}", "transform_matrix": pose} for name, pose in rows]
    return {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2, "frames": frames}


def _write_truth(scene: Scene, out: Path) -> None:
    """Simulate every third Gaussian of the toys by MPM, without the table, and store every fourth of those."""
    toys = scene.gaussians[scene.gaussians.object_id > 0]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "toys.ply"
        write_scene(path, replace(scene, gaussians=toys[torch.arange(0, len(toys), 3)]))
        simulate(path, path.with_suffix(".h5"), SimulateOptions(engine="mpm", keypoints=64))
        full = read_trajectory(path.with_suffix(".h5"))
    some = torch.arange(0, len(full.scene.gaussians), 4)
    thinned = replace(full.scene, gaussians=full.scene.gaussians[some])
    binding = Binding(full.binding.index[some], full.binding.weight[some])
    with TrajectoryWriter(out, thinned, full.info, full.keypoints, binding) as trajectory:
        for t in range(len(full)):
            trajectory.append(full.positions[t], full.com[t], full.rotation[t])
