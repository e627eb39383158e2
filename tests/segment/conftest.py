"""A tabletop scene with three objects, and its file without labels."""

from dataclasses import replace

import pytest
import torch

from stages.core.scene.scene_ply import write_scene
from tests.segment.tabletop import three_apart


@pytest.fixture(scope="module")
def truth():
    return three_apart(noise=0.001)


@pytest.fixture
def scene_file(truth, tmp_path):
    path = tmp_path / "scene.ply"
    blank = replace(truth.gaussians, object_id=torch.zeros_like(truth.gaussians.object_id))
    write_scene(path, replace(truth, gaussians=blank))
    return path
