"""Python blocks of the documentation run without changes.

The stages read and write real files; only the backend of `reconstruct` and the engine of `simulate` are replaced.
"""

import re
from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch

from stages.core.physics.state import FrameState
from stages.core.scene.images import write_jpeg
from stages.core.scene.trajectory import read_trajectory
from stages.reconstruct.options import BACKENDS
from stages.reconstruct.photos import Reconstruction, Views
from stages.simulate.options import ENGINES, Engine
from tests.conftest import two_balls_scene
from tests.pipeline.test_commands import ROOT
from tests.pipeline.test_documentation import PAGES
from tests.render.motions import rising

BLOCKS = {str(page.relative_to(ROOT)): block for page in PAGES
          for block in re.findall(r"^```python\n(.*?)^```", page.read_text(), re.M | re.S)}  # fmt: skip


def reconstruct_two_balls(photos, options, steps) -> Reconstruction:
    """Replaces the backend `classic` of `reconstruct`."""
    scene = replace(two_balls_scene(), background=(0.0, 0.0, 0.0))
    cameras = scene.cameras[list(range(len(photos)))]
    return Reconstruction(scene, Views(photos.images, cameras), list(range(len(photos))), [], {}, [])


def hold_still(scene, keypoints, prompts, options) -> Iterator[FrameState]:
    """Replaces the engine `rigid` of `simulate`; yields two frames without motion."""
    centres = torch.stack([keypoints.rest[keypoints.object_id == o.id].mean(0) for o in scene.objects])
    for _ in range(2):
        yield FrameState(keypoints.rest, centres, torch.tensor([[1.0, 0, 0, 0]]).repeat(len(scene.objects), 1))


@pytest.fixture
def folder(tmp_path, monkeypatch, two_balls):
    """The current folder, with the files that the blocks use."""
    monkeypatch.setitem(BACKENDS, "classic", f"{__name__}:reconstruct_two_balls")
    monkeypatch.setitem(ENGINES, "rigid", Engine(f"{__name__}:hold_still", ""))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    for name in ("a.jpg", "b.jpg"):
        write_jpeg(tmp_path / "photos" / name, torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0)))
    return rising(tmp_path / "traj.h5", two_balls, frames=2).parent


def test_readme_goes_from_photos_to_a_video(folder):
    exec(BLOCKS["README.md"], {})
    trajectory = read_trajectory(folder / "traj.h5")
    assert len(trajectory) == 2 and trajectory.info.engine == "rigid"
    assert (folder / "scene.ply").exists() and (folder / "traj_novel.mp4").exists()


@pytest.mark.parametrize("page", sorted(BLOCKS.keys() - {"README.md"}))
def test_other_blocks_run(page, folder):
    exec(BLOCKS[page], {})
