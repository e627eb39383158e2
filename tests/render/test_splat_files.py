"""GLB and SPZ files contain the scene when read by other programs, and animations move objects as skinning does."""

import gzip
import json
import shutil
import struct
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.core.errors import InputError, MissingPackage
from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity
from stages.core.scene.gaussians import transformed
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.core.scene.trajectory import SimulationInfo, TrajectoryWriter
from stages.render.splat_files import _y_up
from stages.render.stage import run
from tests.conftest import deform
from tests.core.player.test_player import motion_of, world
from tests.render.conftest import render_options

pytestmark = pytest.mark.usefixtures("device")


@pytest.fixture
def scene(tmp_path):
    scene = world()
    write_scene(tmp_path / "scene.ply", scene)
    return scene


def write_motion(path, scene, frames=3):
    """The motion of the player's tests, also written to a file: the red ball is rigid, the green one is not."""
    motion = motion_of(scene, frames)
    info = SimulationInfo(motion.dt, (0.0, 0.0, 0.0), "test")
    with TrajectoryWriter(path, scene, info, motion.keypoints, motion.binding) as out:
        for frame in zip(motion.positions, motion.com, motion.rotation, strict=True):
            out.append(*frame)
    return motion, path


def read_glb(path):
    """The JSON of a GLB, and a function that returns the rows of an accessor by its number."""
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack("<IIIII", data[:20])
    assert (magic, version, size, kind) == (0x46546C67, 2, len(data), 0x4E4F534A)
    document, start = json.loads(data[20 : 20 + length]), 28 + length

    def rows(number):
        accessor = document["accessors"][number]
        view = document["bufferViews"][accessor["bufferView"]]
        values = np.frombuffer(data, "<f4", view["byteLength"] // 4, start + view["byteOffset"])
        return torch.from_numpy(values.reshape(accessor["count"], -1).copy())

    return document, rows


def test_glb_holds_the_scene(scene, tmp_path):
    run(tmp_path / "scene.ply", tmp_path / "scene.glb", render_options())
    document, rows = read_glb(tmp_path / "scene.glb")
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["extensions"]["KHR_gaussian_splatting"]["kernel"] == "ellipse" and primitive["mode"] == 0
    a, truth = primitive["attributes"], _y_up(scene.gaussians)
    torch.testing.assert_close(rows(a["POSITION"]), truth.means)
    torch.testing.assert_close(truth.means[:, 1], scene.gaussians.means[:, 2])  # y is up
    found = matrix(rows(a["KHR_gaussian_splatting:ROTATION"])[:, [3, 0, 1, 2]])
    torch.testing.assert_close(found, matrix(truth.quats), rtol=0, atol=1e-5)
    torch.testing.assert_close(rows(a["KHR_gaussian_splatting:SCALE"]), truth.scales, rtol=1e-5, atol=0)
    torch.testing.assert_close(rows(a["KHR_gaussian_splatting:OPACITY"])[:, 0], truth.opacities, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(rows(a["KHR_gaussian_splatting:SH_DEGREE_3_COEF_5"]), truth.sh[:, 14], rtol=0, atol=1e-5)


def test_trimesh_reads_the_points_of_a_glb(scene, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    run(tmp_path / "scene.ply", tmp_path / "scene.glb", render_options())
    (points,) = trimesh.load(tmp_path / "scene.glb").geometry.values()
    np.testing.assert_allclose(points.vertices, _y_up(scene.gaussians).means.numpy(), rtol=0, atol=1e-6)


def test_glb_moves_rigid_objects_and_stores_the_frames_of_the_others(scene, tmp_path, caplog):
    motion, path = write_motion(tmp_path / "traj.h5", scene, frames=4)
    run(path, tmp_path / "traj.glb", render_options())
    assert "green ball deform" in caplog.text
    document, rows = read_glb(tmp_path / "traj.glb")
    names = [node["name"] for node in document["nodes"]]
    assert names == ["background", "red ball", *(f"green ball {i}" for i in range(4))]
    animation, t = document["animations"][0], 3
    samplers = {(names[c["target"]["node"]], c["target"]["path"]): animation["samplers"][c["sampler"]]
                for c in animation["channels"]}  # fmt: skip
    turn, shift = (rows(samplers["red ball", path]["output"])[t] for path in ("rotation", "translation"))
    local = rows(document["meshes"][1]["primitives"][0]["attributes"]["POSITION"])
    moved = deform(scene.gaussians, motion.binding, motion.keypoints, motion.positions[t])
    truth = _y_up(moved[moved.object_id == 1])
    torch.testing.assert_close(local @ matrix(turn[[3, 0, 1, 2]]).T + shift, truth.means, rtol=0, atol=1e-4)
    for time in (0.5, 1.5, 2.5, 3.5):  # times in frames
        shown = []
        for name in names[2:]:
            sampler = samplers[name, "scale"]
            times = rows(sampler["input"])[:, 0]
            before = max(int((times <= time * motion.dt).sum()) - 1, 0)
            shown.append(float(rows(sampler["output"])[before, 0]))
        assert shown == [float(i == int(time)) for i in range(4)]


def test_spz_holds_the_scene_within_its_precision(scene, tmp_path):
    run(tmp_path / "scene.ply", tmp_path / "scene.spz", render_options())
    data = gzip.decompress((tmp_path / "scene.spz").read_bytes())
    magic, version, n, degree, fraction, flags, _ = struct.unpack("<IIIBBBB", data[:16])
    assert (magic, version, n, degree, fraction, flags) == (0x5053474E, 3, len(scene.gaussians), 3, 12, 0)
    assert len(data) == 16 + n * (9 + 1 + 3 + 3 + 4 + 45)
    truth = _y_up(scene.gaussians)
    low, middle, high = np.frombuffer(data, np.uint8, 9 * n, 16).reshape(n, 3, 3).transpose(2, 0, 1).astype(np.int64)
    position = ((low | middle << 8 | high << 16) ^ 1 << 23) - (1 << 23)  # signed integers of 24 bits
    np.testing.assert_allclose(position / 4096, truth.means.numpy(), rtol=0, atol=1 / 8192 + 1e-6)


@pytest.fixture
def splat_transform():
    """Function that converts a file with splat-transform, for which y is down in PLY files and up in others."""
    program = shutil.which("splat-transform")
    if program is None:
        pytest.skip("no splat-transform on this machine (npm install -g @playcanvas/splat-transform)")
    return lambda source, out: subprocess.run([program, "-w", source, out], check=True, capture_output=True)


def y_down(g, x):
    """Gaussians of a scene with z up, converted to y down; the x axis is kept (x = 1) or reversed (x = -1)."""
    return transformed(_y_up(g), Similarity(1.0, torch.diag(torch.tensor([x, -1.0, -x])), torch.zeros(3)))


def test_splat_transform_reads_spz(scene, tmp_path, splat_transform):
    run(tmp_path / "scene.ply", tmp_path / "scene.spz", render_options())
    splat_transform(tmp_path / "scene.spz", tmp_path / "back.ply")
    back, truth = read_scene(tmp_path / "back.ply").gaussians, y_down(scene.gaussians, 1.0)
    torch.testing.assert_close(back.means, truth.means, rtol=0, atol=2e-4)
    torch.testing.assert_close(back.scales.log(), truth.scales.log(), rtol=0, atol=0.04)
    torch.testing.assert_close(axes_like(back.quats, truth.quats), matrix(truth.quats), rtol=0, atol=5e-3)
    torch.testing.assert_close(back.opacities, truth.opacities, rtol=0, atol=3e-3)
    torch.testing.assert_close(back.sh[:, :4].clamp(-0.9, 0.9), truth.sh[:, :4].clamp(-0.9, 0.9), rtol=0, atol=0.04)


def test_splat_transform_writes_the_same_glb(scene, tmp_path, splat_transform):
    """splat-transform can write but not read GLB with KHR_gaussian_splatting."""
    run(tmp_path / "scene.ply", tmp_path / "ours.glb", render_options())
    write_scene(tmp_path / "turned.ply", replace(scene, gaussians=y_down(scene.gaussians, -1.0)))
    splat_transform(tmp_path / "turned.ply", tmp_path / "theirs.glb")
    ours, theirs = (attributes(tmp_path / name) for name in ("ours.glb", "theirs.glb"))
    assert theirs.keys() <= ours.keys() and len(theirs) > 15
    for name in theirs.keys() - {"COLOR_0"}:  # their colours are bytes
        values, found = theirs[name], ours[name]
        if name.endswith("ROTATION"):
            values, found = values[:, [3, 0, 1, 2]], found[:, [3, 0, 1, 2]]
            values, found = axes_like(values, found), matrix(found)
        torch.testing.assert_close(found, values, rtol=1e-4, atol=1e-4, msg=lambda text, name=name: f"{name}: {text}")


def axes_like(quats, others):
    """The axes of ellipsoids as columns, with signs so that they are closest to those of `others`."""
    R = matrix(quats)
    return R * (R * matrix(others)).sum(1, keepdim=True).sign()


def attributes(path):
    """The attributes of the only primitive of a GLB."""
    document, rows = read_glb(path)
    (primitive,) = document["meshes"][0]["primitives"]
    return {name: rows(number) for name, number in primitive["attributes"].items()}


def test_what_a_file_cannot_hold_is_said(scene, tmp_path):
    _, path = write_motion(tmp_path / "traj.h5", scene)
    with pytest.raises(InputError, match="one frame"):
        run(path, tmp_path / "x.spz", render_options())
    with pytest.raises(InputError, match="cannot hold arrows; omit --show-forces"):
        run(path, tmp_path / "x.glb", render_options(show_forces=True))
    run(path, tmp_path / "x.spz", render_options(frame=1))
    far = replace(scene.gaussians, means=3000 * scene.gaussians.means)
    write_scene(tmp_path / "far.ply", replace(scene, gaussians=far))
    with pytest.raises(InputError, match="scene is larger"):
        run(tmp_path / "far.ply", tmp_path / "x.spz", render_options())


def test_missing_usd_core_names_the_extra(scene, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    _, path = write_motion(tmp_path / "traj.h5", scene)
    with pytest.raises(MissingPackage, match=r"traj.usdc: needs usd-core .*pip install -U 'ngff\[usd\]'"):
        run(path, tmp_path / "traj.usdc", render_options())


def test_usd_core_reads_the_motion(scene, tmp_path):
    pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom

    motion, path = write_motion(tmp_path / "traj.h5", scene)
    run(path, tmp_path / "traj.usdc", render_options())
    stage = Usd.Stage.Open(str(tmp_path / "traj.usdc"))
    assert (stage.GetTimeCodesPerSecond(), stage.GetEndTimeCode()) == (50, 2)
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    moved = deform(scene.gaussians, motion.binding, motion.keypoints, motion.positions[2])
    for id, name in ((0, "background"), (1, "object_1_red_ball"), (2, "object_2_green_ball")):
        prim, truth = stage.GetPrimAtPath(f"/scene/{name}"), moved[moved.object_id == id]
        assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
        world = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(2))  # the matrix is for row vectors
        local = np.array(prim.GetAttribute("positions").Get(2))
        np.testing.assert_allclose(local @ world[:3, :3] + world[3, :3], truth.means.numpy(), rtol=0, atol=1e-4)
        quats = torch.tensor([[q.real, *q.imaginary] for q in prim.GetAttribute("orientations").Get(2)])
        turn = torch.from_numpy(world[:3, :3].T.copy()).float()
        found = turn @ matrix(quats) * torch.tensor(np.array(prim.GetAttribute("scales").Get(2)))[:, None]
        expected = matrix(truth.quats) * truth.scales[:, None]
        torch.testing.assert_close(found @ found.mT, expected @ expected.mT, rtol=0, atol=1e-4)
        assert len(prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").Get(2)) == 16 * len(truth)


def test_a_folder_gets_a_ply_file_for_each_frame(scene, tmp_path):
    motion, path = write_motion(tmp_path / "traj.h5", scene)
    folder = tmp_path / "frames"
    with pytest.raises(InputError, match="or an existing folder"):
        run(path, folder, render_options())
    folder.mkdir()
    run(path, folder, render_options())
    names = sorted(file.name for file in folder.iterdir())
    assert names == ["frame.ply.json", "frame_0000.ply", "frame_0001.ply", "frame_0002.ply"]
    for frame in range(3):
        found = read_scene(folder / f"frame_{frame:04}.ply")
        truth = deform(scene.gaussians, motion.binding, motion.keypoints, motion.positions[frame])
        torch.testing.assert_close(found.gaussians.means, truth.means, rtol=0, atol=1e-5)
        assert found.objects == scene.objects
    run(path, tmp_path / "last.ply", render_options(frame=-1, shadows="on"))
    last = read_scene(tmp_path / "last.ply").gaussians
    torch.testing.assert_close(last.means, truth.means, rtol=0, atol=1e-5)
    assert not torch.equal(last.sh, truth.sh)  # it contains shadows
