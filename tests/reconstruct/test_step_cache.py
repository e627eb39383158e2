"""What a run that was cut off leaves behind, and what it does not."""

import pickle

import pytest
import torch

from stages.core.errors import InputError
from stages.reconstruct.depth import DepthMap
from stages.reconstruct.step_cache import StepCache, fingerprint, peak_memory


def test_a_finished_step_is_not_done_again(tmp_path):
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
def test_steps_of_other_photos_or_without_resume_are_done_again(tmp_path, key, resume):
    StepCache.for_output(tmp_path / "scene.ply", "key", resume=False).cached("model", lambda: 1)
    assert StepCache.for_output(tmp_path / "scene.ply", key, resume).cached("model", lambda: 2) == 2


def test_a_step_that_fails_leaves_nothing(tmp_path):
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


def test_results_are_read_as_data_never_as_code(tmp_path):
    steps = StepCache(tmp_path / "steps")
    (steps.folder / "model.pt").write_bytes(pickle.dumps(print, protocol=2))
    with pytest.raises(pickle.UnpicklingError):
        steps.cached("model", lambda: 1)


def test_a_folder_that_is_not_there_is_noticed_before_any_work(tmp_path):
    with pytest.raises(InputError, match="there is no folder"):
        StepCache.for_output(tmp_path / "nowhere" / "scene.ply", "key", resume=False)


def test_fingerprints_tell_photos_apart():
    image = torch.zeros(4, 5, 3, dtype=torch.uint8)
    other = image.clone()
    other[1, 2, 0] = 1
    assert fingerprint("a", image) == fingerprint("a", image.clone())
    assert len({fingerprint("a", image), fingerprint("a", other), fingerprint("b", image)}) == 3


def test_peak_memory_counts_what_was_held():
    block = torch.ones(2**26)  # 0.27 GB
    with_it = peak_memory()
    assert with_it > 0.27 and block.sum() > 0
    del block
    assert peak_memory() >= with_it
