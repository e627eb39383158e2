"""Exchange of files with an independent program: `npm install -g @playcanvas/splat-transform`."""

import shutil
import subprocess

import numpy as np
import pytest
import torch

from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene, write_scene
from tests.conftest import random_gaussians

TOOL = shutil.which("splat-transform")
pytestmark = pytest.mark.skipif(TOOL is None, reason="splat-transform is not installed")


@pytest.mark.parametrize("degree", [0, 2])
def test_splat_transform_reads_our_files(tmp_path, degree):
    g = random_gaussians(50, degree=degree)
    write_scene(tmp_path / "scene.ply", Scene(g))
    subprocess.run([TOOL, tmp_path / "scene.ply", tmp_path / "out.csv"], check=True, capture_output=True)
    table = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True)
    assert np.allclose(np.stack([table[n] for n in "xyz"], 1), g.means.numpy(), atol=1e-6)
    assert np.allclose(np.exp(np.stack([table[f"scale_{a}"] for a in range(3)], 1)), g.scales.numpy(), rtol=1e-5)
    assert np.allclose(1 / (1 + np.exp(-table["opacity"])), g.opacities.numpy(), atol=1e-5)
    quats = np.stack([table[f"rot_{a}"] for a in range(4)], 1)
    assert np.allclose(np.abs((quats * g.quats.numpy()).sum(1)), np.linalg.norm(quats, axis=1), rtol=1e-5)
    rest = [n for n in table.dtype.names if n.startswith("f_rest")]
    assert len(rest) == 3 * ((degree + 1) ** 2 - 1)
    if rest:  # the file has all coefficients of red, then of green, then of blue
        ours = g.sh[:, 1:].permute(0, 2, 1).reshape(len(g), -1).numpy()
        assert np.allclose(np.stack([table[f"f_rest_{i}"] for i in range(len(rest))], 1), ours, atol=1e-6)


def test_packed_file_of_splat_transform_is_read(tmp_path):
    g = random_gaussians(300)
    write_scene(tmp_path / "scene.ply", Scene(g))
    packed = tmp_path / "scene.compressed.ply"
    subprocess.run([TOOL, tmp_path / "scene.ply", packed], check=True, capture_output=True)
    back = read_scene(packed).gaussians
    nearest = torch.cdist(back.means, g.means).min(1)
    assert len(back) == len(g) and nearest.values.max() < 0.01 * float(g.means.std())
    assert nearest.indices.unique().numel() == len(g)
    assert torch.allclose(back.opacities, g.opacities[nearest.indices], atol=0.01)
