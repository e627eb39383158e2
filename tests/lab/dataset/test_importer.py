"""Import of published frames: a folder written with h5py and plyfile alone, and one written by ngff."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from ngff_cli.app import app as ngff
from ngff_cli.lab import app as lab
from stages.core.errors import InputError
from stages.core.geometry.rotations import matrix
from stages.core.physics.skinning import Skinning
from stages.core.scene.trajectory import read_trajectory
from stages.lab.dataset import generate, importer
from tests.conftest import CliRunner
from tests.lab.small_world import OPTIONS, shrink

DUCK, PHONE, FRAMES = 60, 40, 5
NAME = "2700_7_11"


def turn(t: int) -> np.ndarray:
    """Rotation of the phone in frame t, by 20 degrees per frame about z."""
    c, s = np.cos(np.radians(20 * t)), np.sin(np.radians(20 * t))
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


@pytest.fixture
def published(tmp_path):
    """A data set of one scene: a falling duck and a rotating phone; one Gaussian is below the opacity threshold."""
    rng = np.random.default_rng(0)
    start = np.concatenate([rng.uniform(-0.1, 0.1, (DUCK, 3)) + [0, 0, 0.3], rng.uniform(-0.2, 0.2, (PHONE, 3)) - 0.5])
    n, opacity = len(start), np.full(len(start), 2.0)
    opacity[7] = -6.0  # an opacity of 0.0025
    fields = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(24)),
              "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]  # fmt: skip
    rows = np.zeros(n, [(f, "<f4") for f in fields])
    for axis, f in enumerate("xyz"):
        rows[f] = start[:, axis]
    rows["opacity"], rows["rot_0"] = opacity, 1.0
    for i in range(3):
        rows[f"scale_{i}"] = np.log(0.02)
    ply = tmp_path / "scenes" / "3_9" / NAME / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    ply.parent.mkdir(parents=True)
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(ply))
    (tmp_path / "scene_configs").mkdir()
    config = {"scene_object_idxs": [7, 11], "translation": [[0, 0, 0.3], [0, 0, -0.5]], "scale": [0.3, 0.4]}
    (tmp_path / "scene_configs" / "3_9.json").write_text(json.dumps({NAME: config}))
    folder = tmp_path / "mpm" / "3_9" / NAME
    folder.mkdir(parents=True)
    keep = np.arange(n) != 7
    with h5py.File(folder / "shs.h5", "w") as file:
        file["shs"] = np.zeros((n - 1, 9, 3), np.float16)
    with h5py.File(folder / "opacity.h5", "w") as file:
        file["opacity"] = (1 / (1 + np.exp(-opacity[keep])))[:, None].astype(np.float16)
    for t in range(FRAMES):
        now = start.copy()
        now[:DUCK, 2] -= 2.5 * (0.02 * t) ** 2
        centre = start[DUCK:].mean(0)
        now[DUCK:] = (start[DUCK:] - centre) @ turn(t).T + centre
        with h5py.File(folder / f"{t:04d}.h5", "w") as file:
            file["pos"] = now[keep].astype(np.float16)
            file["cov3D"] = np.zeros((n - 1, 6), np.float16)
            file["rot"] = np.eye(3, dtype=np.float16)[None].repeat(n - 1, 0)
    return folder


@pytest.fixture
def small(monkeypatch):
    """Replace the published numbers by those of the folder."""
    monkeypatch.setitem(importer.PUBLISHED_COUNTS, "duck", DUCK)
    monkeypatch.setitem(importer.PUBLISHED_COUNTS, "phone", PHONE)


def test_imported_motion_matches_the_frames(published, small, tmp_path):
    done = CliRunner().invoke(lab, ["import", str(published), "-o", str(tmp_path / "t.h5")])
    assert done.exit_code == 0 and "5 frames of duck, phone, 99 Gaussians, 99 keypoints" in done.stdout
    t = read_trajectory(tmp_path / "t.h5")
    assert [(o.id, o.name) for o in t.scene.objects] == [(1, "duck"), (2, "phone")]
    assert t.info.dt == 0.02 and t.info.gravity == (0, 0, -5) and t.scene.floor == -0.94
    assert len(t.scene.gaussians) == 100 and len(t.scene.cameras) == 100
    fallen = t.com[0, 0, 2] - t.com[:, 0, 2]
    # the tolerance is for averages of float16
    torch.testing.assert_close(fallen, 2.5 * (0.02 * torch.arange(FRAMES)) ** 2, rtol=0, atol=2e-4)
    torch.testing.assert_close(t.com[:, 1], t.com[:1, 1].expand(FRAMES, 3), rtol=0, atol=2e-4)
    expected = torch.tensor(np.stack([turn(i) for i in range(FRAMES)]), dtype=torch.float32)
    torch.testing.assert_close(matrix(t.rotation[:, 1]), expected, rtol=0, atol=2e-3)
    torch.testing.assert_close(matrix(t.rotation[:, 0]), torch.eye(3).expand(FRAMES, 3, 3), rtol=0, atol=2e-3)


def test_imported_trajectory_can_be_rendered_and_evaluated(published, small, tmp_path):
    importer.run(published, tmp_path / "t.h5")
    importer.run(published, tmp_path / "few.h5", count=20)
    done = CliRunner().invoke(ngff, ["render", str(tmp_path / "t.h5"), "--view", "input:16", "--resolution", "32", "-o",
                                     str(tmp_path / "t.mp4")])  # fmt: skip
    assert done.exit_code == 0, done.stderr
    done = CliRunner().invoke(ngff, ["evaluate", str(tmp_path / "few.h5"), "--against", str(tmp_path / "t.h5"), "-o",
                                     str(tmp_path / "m.json")])  # fmt: skip
    assert done.exit_code == 0, done.stderr
    assert "RMSE" in done.stdout


def test_generated_frames_round_trip(tmp_path, monkeypatch):
    """Skinning to keypoints reproduces the frames of all particles with about the precision of float16."""
    shrink(monkeypatch.setattr, monkeypatch.setitem)
    generate.run(tmp_path, replace(OPTIONS, parts="scenes,mpm", frames=12, limit=1))
    folder = next((tmp_path / "mpm" / "3_9").iterdir())
    importer.run(folder, tmp_path / "t.h5", count=128)
    t = read_trajectory(tmp_path / "t.h5")
    skinning = Skinning(t.scene.gaussians, t.binding, t.keypoints)
    matter = t.scene.gaussians.opacities > 0.02
    with h5py.File(folder / "0011.h5") as file:
        true = torch.from_numpy(file["pos"][:].astype(np.float32))
    drawn = skinning(t.positions[11]).means[matter]
    assert (true - t.scene.gaussians.means[matter]).norm(dim=1).median() > 0.05  # the objects have moved
    assert (drawn - true).norm(dim=1).quantile(0.99) < 4e-3


def test_wrong_inputs_are_reported(published, small, tmp_path):
    out = tmp_path / "t.h5"
    with pytest.raises(InputError, match="is not a folder"):
        importer.run(tmp_path / "none", out)
    with pytest.raises(InputError, match="contains no frames 0000.h5"):
        importer.run(tmp_path, out)
    (published / "0002.h5").rename(published / "0009.h5")
    with pytest.raises(InputError, match="0002.h5 is missing"):
        importer.run(published, out)
    (published / "0009.h5").rename(published / "0002.h5")
    with h5py.File(published / "0003.h5", "r+") as file:
        first = file["pos"][:]
        del file["pos"]
        file["pos"] = first[:-1]
    with pytest.raises(InputError, match="0003.h5: has 98 rows, but the first frame has 99"):
        importer.run(published, out)
    (published / "0003.h5").write_text("no")
    with pytest.raises(InputError, match="0003.h5: cannot be read"):
        importer.run(published, out)
    with h5py.File(published / "0000.h5", "r+") as file:
        file["pos"][...] = file["pos"][:] + np.float16(0.1)
    with pytest.raises(InputError, match="rows start up to 0.1"):
        importer.run(published, out)
    importer.PUBLISHED_COUNTS["duck"] += 1
    with pytest.raises(InputError, match="its objects together 101 .duck 61, phone 40."):
        importer.run(published, out)
    (tmp_path / "scene_configs" / "3_9.json").unlink()
    with pytest.raises(InputError, match="has no object ids"):
        importer.run(published, out)
    assert not list(tmp_path.glob("*t.h5"))
