"""The files of each scene: published layout, contents, resuming after a kill, and verification."""

import hashlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch
from plyfile import PlyData

from stages.core.errors import InputError
from stages.core.geometry.rotations import covariance
from stages.core.physics.keypoints import nearest_weights
from stages.lab.dataset import disk_usage, generate
from stages.lab.dataset import layout as dataset_layout
from stages.lab.dataset.gaussian_frames import ObjectSkin, SkinnedScene, write_frames
from stages.lab.dataset.object_particles import Asset
from stages.lab.dataset.options import DatasetOptions
from stages.lab.dataset.scene_configs import SceneConfig, read_scene_configs
from tests.lab.small_world import OPTIONS, brick, shrink

SHAPES = {"pos": (3,), "cov3D": (6,), "rot": (3, 3)}


@pytest.fixture(scope="module")
def options(device) -> DatasetOptions:
    return replace(OPTIONS, device=device)


@pytest.fixture(scope="module")
def data(tmp_path_factory, options):
    """A data set with all parts of two small scenes."""
    with pytest.MonkeyPatch.context() as patch:
        shrink(patch.setattr, patch.setitem)
        root = tmp_path_factory.mktemp("data")
        generate.run(root, options)
        yield root


def digests(root: Path) -> dict[str, str]:
    return {p.relative_to(root).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
            for p in sorted(root.rglob("*")) if p.is_file()}  # fmt: skip


def test_files_have_the_published_layout(data):
    name = next(iter(read_scene_configs(data / "scene_configs" / "3_9.json")))
    expected = [
        "manifest.json", "scene_configs/3_9.json", "objects/duck/cameras.json",
        "objects/duck/point_cloud/iteration_30000/point_cloud.ply", "backgrounds/table0/gaussians_feedforward.ply",
        f"scenes/3_9/{name}/point_cloud/iteration_30000/point_cloud.ply",
        *(f"mpm/3_9/{name}/{file}.h5" for file in ("0000", "0001", "0002", "shs", "opacity")),
        *(f"initial/3_9/{name}/table0/{file}" for file in (f"{name}.mp4", "cameras.json", "prompts.json", "depth.h5")),
        *(f"dynamic/3_9/{name}/table0/view_{v}/{name}.mp4" for v in (0, 16)),
    ]  # fmt: skip
    files = set(digests(data))
    assert set(expected) <= files and not any(".part-" in f for f in files)
    assert len([f for f in files if f.startswith(("mpm", "initial", "dynamic", "scenes/"))]) == 2 * (5 + 4 + 2 + 1)


def test_frames_have_the_published_contents(data):
    config = next(iter(read_scene_configs(data / "scene_configs" / "3_9.json").values()))
    vertices = PlyData.read(data / f"scenes/3_9/{config.name}" / dataset_layout.POINT_CLOUD)["vertex"]
    logits = np.asarray(vertices["opacity"], float)
    matter = 1 / (1 + np.exp(-logits)) > 0.02
    assert 0.01 < 1 - matter.mean() < 0.03 and set(vertices["object_id"]) == {1, 2, 3}
    xyz = np.stack([vertices[a] for a in "xyz"], 1)[matter]
    folder = data / "mpm" / "3_9" / config.name
    frames = [h5py.File(folder / f"{t:04d}.h5") for t in range(3)]
    for frame in frames:
        assert {n: (d.shape[1:], d.dtype) for n, d in frame.items()} == {n: (s, "<f2") for n, s in SHAPES.items()}
        assert len(frame["pos"]) == matter.sum()
    with h5py.File(folder / "shs.h5") as sh, h5py.File(folder / "opacity.h5") as opacity:
        assert sh["shs"].shape == (matter.sum(), 9, 3) and opacity["opacity"].shape == (matter.sum(), 1)
        red = np.stack([vertices[f"f_rest_{i}"] for i in range(8)], 1)[matter]
        np.testing.assert_allclose(sh["shs"][:, 1:, 0], red, atol=2e-4)
        np.testing.assert_allclose(opacity["opacity"][:, 0], 1 / (1 + np.exp(-logits[matter])), atol=1e-3)
    # the first frame has the scene's positions, no rotation, and covariances R S S^T R^T
    np.testing.assert_allclose(frames[0]["pos"][:], xyz, atol=1e-3)
    np.testing.assert_allclose(frames[0]["rot"][:], np.eye(3)[None].repeat(len(xyz), 0), atol=1e-3)
    scales = np.exp(np.stack([vertices[f"scale_{i}"] for i in range(3)], 1)[matter])
    cov = frames[0]["cov3D"][:].astype(float)
    np.testing.assert_allclose(cov[:, [0, 3, 5]].sum(1), (scales**2).sum(1), rtol=2e-2)
    # the objects fall with 5 m/s^2 for two frames
    fallen = (frames[0]["pos"][:, 2].astype(float) - frames[2]["pos"][:, 2]).max()
    assert fallen == pytest.approx(5 / 2 * 0.04**2, abs=1.5e-3)


def test_rotated_gaussians_are_stored_rotated(tmp_path, device):
    """One object rotates by 90 degrees about z; positions, covariances and the (transposed) rotation follow."""
    g = brick()
    points, centre = g.means[::4].contiguous(), torch.tensor([0.1, 0.2, 0.3])
    index, weight = nearest_weights(points, g.means, 8)
    asset = Asset(7, 1.0, points, torch.ones(len(points)), 1e5, 500.0)
    start = SceneConfig("a", (7,), ((0.1, 0.2, 0.3),), (1.0,))
    scene = SkinnedScene(start, {7: ObjectSkin(g, g, index.int(), weight)}, {7: asset}, device)
    R = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    positions, gradients = (points @ R.T + centre).to(device), R.expand(len(points), 3, 3).to(device)
    write_frames(tmp_path, scene, [positions], [gradients])
    means = scene.at(positions, gradients)[0].means.cpu()
    torch.testing.assert_close(means, g.means @ R.T + centre, rtol=0, atol=1e-5)
    with h5py.File(tmp_path / "0000.h5") as file:
        np.testing.assert_allclose(file["rot"][:], R.T.expand(len(g), 3, 3), atol=1e-3)
        cov = R @ covariance(g.quats, g.scales) @ R.T
        upper = torch.stack([cov[:, i, j] for i in range(3) for j in range(i, 3)], 1)
        np.testing.assert_allclose(file["cov3D"][:], upper, rtol=5e-3, atol=2e-6)


def test_videos_cameras_prompts_and_depth(data):
    config = next(iter(read_scene_configs(data / "scene_configs" / "3_9.json").values()))
    folder = data / "initial" / "3_9" / config.name / "table0"
    rows = json.loads((folder / "cameras.json").read_text())
    assert len(rows) == 100 and rows[0]["width"] == 32 and rows[0]["fx"] == 48
    video = cv2.VideoCapture(str(folder / f"{config.name}.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 100 and video.get(cv2.CAP_PROP_FPS) == 50
    moving = cv2.VideoCapture(str(data / "dynamic/3_9" / config.name / "table0/view_0" / f"{config.name}.mp4"))
    assert moving.get(cv2.CAP_PROP_FRAME_COUNT) == 3
    first, started = video.read()[1].astype(float), moving.read()[1].astype(float)
    assert np.abs(first - started).mean() < 8  # the same view of the same frame, compressed twice
    prompts = json.loads((folder / "prompts.json").read_text())
    assert {k: len(v) for k, v in prompts.items()} == dict.fromkeys(("center_point", "bbox", "text"), 3)
    R, eye = np.array(rows[0]["rotation"]), np.array(rows[0]["position"])
    for (u, v), (x0, y0, x1, y1), p in zip(prompts["center_point"], prompts["bbox"], config.translation, strict=True):
        assert 0 <= x0 < u < x1 <= 32 and 0 <= y0 < v < y1 <= 32
        seen = R.T @ (np.array(p) - eye)
        assert np.hypot(u - 16 - 48 * seen[0] / seen[2], v - 16 - 48 * seen[1] / seen[2]) < 1.5
    with h5py.File(folder / "depth.h5") as file:
        depth = file["depth"][:] / 65535 * file["depth_max"][()]
        assert depth.shape == (2, 32, 32) and file["depth"].dtype == np.uint16 and list(file["view"]) == [0, 16]
    u, v = (int(np.clip(c, 0, 31)) for c in prompts["center_point"][0])
    nearest = min(np.linalg.norm(np.array(p) - eye) for p in config.translation)
    assert nearest - 0.6 < depth[0, v, u] < 5.5


def test_checksums_are_listed_and_settings_must_stay(data, capsys, options):
    generate.check(data)
    assert "files, all unchanged" in capsys.readouterr().out
    listed = sorted(line for path in (data / "sums").iterdir() for line in path.read_text().splitlines())
    assert [line.split("  ")[1] for line in listed if "mpm/" in line]
    done = subprocess.run(f"sha256sum --quiet -c {data}/sums/*.sha256", cwd=data, shell=True, capture_output=True)
    assert done.returncode == 0, done.stderr
    with pytest.raises(InputError, match="was started with frames 3, not 4"):
        generate.run(data, replace(options, frames=4))


def test_damaged_files_are_found_and_repaired(data, options):
    victim = next((data / "mpm").rglob("0001.h5"))
    before = digests(data)
    whole = victim.read_bytes()
    victim.write_bytes(whole[:-1] + b"x")
    with pytest.raises(InputError, match="0001.h5 has changed"):
        generate.check(data)
    for file in victim.parent.iterdir():
        file.unlink()
    victim.parent.rmdir()
    next((data / "dynamic").rglob("*.mp4")).unlink()
    with pytest.raises(InputError, match="is missing"):
        generate.check(data)
    generate.run(data, options)
    assert digests(data) == before  # only one scene was simulated again


@pytest.mark.slow
def test_killed_run_resumes_to_the_same_bytes(data, tmp_path, options):
    part = f"replace(OPTIONS, parts='scenes,mpm', device={options.device!r})"
    code = ("import os; from dataclasses import replace; from pathlib import Path\n"
            "from stages.lab.dataset import gaussian_frames, generate\n"
            "from tests.lab.small_world import OPTIONS, shrink_process; shrink_process()\n"
            "write = gaussian_frames._write\n"
            "def killed_after_first_frame(path, **arrays):\n"
            "    write(path, **arrays)\n"
            "    path.name == '0000.h5' and os.kill(os.getpid(), 9)\n"
            "gaussian_frames._write = killed_after_first_frame\n"
            f"generate.run(Path({str(tmp_path)!r}), {part})")  # fmt: skip
    process = subprocess.run([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
    assert process.returncode == -9 and list(tmp_path.glob("mpm/3_9/.part-*/0000.h5"))
    assert not (tmp_path / "sums" / "3_9.sha256").exists()  # the group was not complete
    generate.run(tmp_path, replace(options, parts="scenes,mpm"))
    files = {n: d for n, d in digests(tmp_path).items() if n.startswith(("scene", "mpm", "objects"))}
    whole = digests(data)
    assert files == {n: whole.get(n) for n in files} and len(list((tmp_path / "mpm" / "3_9").iterdir())) == 2
    generate.check(tmp_path)


def test_full_disk_is_reported_before_writing(tmp_path, monkeypatch):
    shrink(monkeypatch.setattr, monkeypatch.setitem)
    usage = disk_usage.shutil.disk_usage(tmp_path)._replace(free=500_000)
    monkeypatch.setattr(disk_usage.shutil, "disk_usage", lambda path: usage)
    with pytest.raises(InputError, match="about .* are needed, but 500 kB are free; choose fewer"):
        generate.run(tmp_path, OPTIONS)
    assert not (tmp_path / "mpm").exists()


def test_existing_files_are_not_counted(data):
    before = disk_usage.missing_bytes(dataset_layout.Layout(data / "none"), replace(OPTIONS, frames=100, limit=0))
    assert before["dynamic"] == 2 * 2 * 32**2 * 100 * disk_usage.VIDEO_FIXED_CAMERA  # 2 scenes with 2 views
    left = disk_usage.missing_bytes(dataset_layout.Layout(data), OPTIONS)
    assert left["mpm"] < 0.15 * 2 * disk_usage.SizeEstimate(3, 64, 32).mpm(1800)
    assert left["scene_configs"] == 0  # existing files are complete


def test_missing_sizes_are_printed(tmp_path, capsys):
    disk_usage.require_disk_space(tmp_path, {"scene_configs": 64_400.0, "motions": 0.0})
    assert ": about 64.4 kB to write (scene_configs 64.4 kB), " in capsys.readouterr().out
    disk_usage.require_disk_space(tmp_path, {"motions": 0.0})
    assert not capsys.readouterr().out


def test_size_estimates_match_the_files(data):
    """Only uncompressed parts are tested, because videos of 32 px consist mostly of headers."""
    sizes, folder = disk_usage.SizeEstimate(3, 64, 32), next((data / "mpm" / "3_9").iterdir())
    with h5py.File(folder / "opacity.h5") as file:
        count = len(file["opacity"])
    assert sum(p.stat().st_size for p in folder.iterdir()) == pytest.approx(sizes.mpm(count), rel=0.15)
    config = data / "scene_configs" / "3_9.json"
    assert config.stat().st_size == pytest.approx(2 * sizes.config(3), rel=0.15)


@pytest.mark.parametrize("options", [{"parts": "videos"}, {"views": "3"}, {"backgrounds": "table9"}, {"resolution": 33},
                                     {"parts": ""}, {"shard": "0/2"}])  # fmt: skip
def test_invalid_options_are_rejected(options):
    with pytest.raises(InputError, match=f"--{next(iter(options))}"):
        DatasetOptions(**options)
