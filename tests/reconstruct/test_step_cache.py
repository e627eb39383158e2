"""Results of finished steps that an interrupted run stores."""

import os
import pickle
import resource
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.reconstruct.depth import DepthMap
from stages.reconstruct.options import ReconstructOptions
from stages.reconstruct.stage import _cache_key
from stages.reconstruct.step_cache import StepCache, fingerprint, peak_memory


def test_finished_step_is_not_repeated(tmp_path):
    done = []

    def make():
        done.append(1)
        return [DepthMap(torch.ones(2, 3), torch.zeros(2, 3))]

    first = StepCache.for_output(tmp_path / "scene.ply", "key", resume=False).cached("depth", make, (DepthMap,))
    again = StepCache.for_output(tmp_path / "scene.ply", "key", resume=True)
    second = again.cached("depth", make, (DepthMap,))
    assert len(done) == 1 and again.seconds == {}
    assert torch.equal(first[0].depth, second[0].depth)


@pytest.mark.parametrize(("key", "resume"), [("other", True), ("key", False)])
def test_steps_of_another_key_or_without_resume_are_repeated(tmp_path, key, resume):
    StepCache.for_output(tmp_path / "scene.ply", "key", resume=False).cached("model", lambda: 1)
    assert StepCache.for_output(tmp_path / "scene.ply", key, resume).cached("model", lambda: 2) == 2


def test_failed_step_leaves_no_file(tmp_path):
    steps = StepCache(tmp_path / "steps")

    def fail(path):
        path.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        steps.cached_file("matches.db", fail)
    assert [p.name for p in steps.folder.iterdir()] == ["key"]
    steps.cached_file("matches.db", lambda path: path.write_text("whole"))
    assert steps.cached_file("matches.db", fail).read_text() == "whole"
    steps.remove()
    assert not steps.folder.exists()


def test_cached_pickles_cannot_run_code(tmp_path):
    steps = StepCache(tmp_path / "steps")
    (steps.folder / "model.pt").write_bytes(pickle.dumps(print, protocol=2))
    with pytest.raises(InputError, match="model.pt: is damaged; start again without --resume"):
        steps.cached("model", lambda: 1)


def test_fingerprints_differ_for_different_photos():
    image = torch.zeros(4, 5, 3, dtype=torch.uint8)
    other = image.clone()
    other[1, 2, 0] = 1
    assert fingerprint("a", image) == fingerprint("a", image.clone())
    assert len({fingerprint("a", image), fingerprint("a", other), fingerprint("b", image)}) == 3


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs /proc")
def test_peak_memory_grows_with_an_allocation():
    child = os.fork()  # its peak begins near its current memory, independent of earlier tests
    if child == 0:
        status = 1
        try:
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            held, before = pages * resource.getpagesize() / 1e9, peak_memory()
            block = np.ones(int((before - held + 0.3) * 1e9 / 8))  # 0.3 GB more than the peak so far
            assert before + 0.2 < peak_memory() < before + 0.4
            del block
            assert peak_memory() > before + 0.2
            status = 0
        finally:
            os._exit(status)
    assert os.waitpid(child, 0)[1] == 0


def test_key_of_a_reconstruction_follows_the_photos_and_the_cameras_file(tmp_path):
    """A resumed run must not use results of other photos, or of cameras that were changed in the same file."""
    options = ReconstructOptions(cameras=tmp_path / "transforms.json")
    options.cameras.write_text("{}")
    photos = SimpleNamespace(names=("a.png",), focals=[1.0], images=[torch.zeros(2, 2, 3)])
    key = _cache_key(photos, options)
    assert _cache_key(photos, replace(options, resume=True)) == key
    assert _cache_key(SimpleNamespace(**{**vars(photos), "images": [torch.ones(2, 2, 3)]}), options) != key
    options.cameras.write_text('{"frames": []}')
    assert _cache_key(photos, options) != key
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "cameras.txt").write_text("1")
    of_folder = replace(options, cameras=folder)
    key = _cache_key(photos, of_folder)
    (folder / "cameras.txt").write_text("2")
    assert _cache_key(photos, of_folder) != key
