from dataclasses import replace

import h5py
import pytest
import torch

from stages.core.errors import InputError
from stages.render.animation import open_animation
from stages.render.overlay import force_arrows
from tests.render.motions import rising


def test_the_first_frame_is_the_scene_itself(tmp_path, two_balls):
    footage = open_animation(rising(tmp_path / "t.h5", two_balls))
    g, rest = footage.gaussians(0.0), two_balls.gaussians
    for name in ("means", "quats", "scales", "sh", "opacities"):
        assert torch.equal(getattr(g, name), getattr(rest, name))


def test_frames_lie_where_the_file_says_and_between_them_at_any_rate(tmp_path, two_balls):
    footage = open_animation(rising(tmp_path / "t.h5", two_balls, frames=11))  # the balls rise 0.01 a frame
    assert footage.times(None) == pytest.approx([0.02 * i for i in range(11)])
    assert footage.times(25.0) == pytest.approx([0.04 * i for i in range(6)])
    assert len(footage.times(60.0)) == 13  # 0.2 s and the first frame
    balls = two_balls.gaussians.object_id > 0
    for frame in (3, 4.5):
        moved = footage.gaussians(0.02 * frame).means - two_balls.gaussians.means
        torch.testing.assert_close(moved[balls, 2], torch.full((800,), 0.01 * frame), atol=1e-5, rtol=0)
        assert (moved[~balls] == 0).all()


def test_dense_frames_are_taken_as_they_are(tmp_path, two_balls):
    path = rising(tmp_path / "t.h5", two_balls, frames=3)
    g = two_balls.gaussians
    with h5py.File(path, "a") as file:
        for name in ("means", "quats", "scales"):
            file[f"frames/{name}"] = torch.stack([getattr(g, name) + t for t in range(3)]).numpy()
    assert torch.equal(open_animation(path).gaussians(0.04).means, g.means + 2)


def test_time_can_be_stopped(tmp_path, two_balls):
    path = rising(tmp_path / "t.h5", two_balls, frames=5)
    last = open_animation(path, -1)
    assert not last.moves and len(last.times(10.0)) == 40
    assert torch.equal(last.gaussians(0.0).means, open_animation(path).gaussians(0.08).means)
    with pytest.raises(InputError, match="frames 0 to 4"):
        open_animation(path, 5)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [("x.txt", b"hello", "not a kind of file that can be rendered"), ("x.h5", b"", "is empty"),
     ("x.h5", b"hello", "not a readable HDF5"), ("x.ply", b"hello", "not a readable PLY"), ("x.h5", None, "no such"),
     ("x.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
               b"end_header\n0 0 0\n", "plain point cloud")],
)  # fmt: skip
def test_wrong_files_get_one_sentence(tmp_path, name, content, says):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=says) as caught:
        open_animation(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_arrows_start_where_the_push_acts_and_last_as_long(tmp_path, two_balls):
    push = {"kind": "force", "object_id": 1, "force": [0, 0, 8.0], "start": 0.04, "end": 0.1, "at": None}
    weak = {**push, "object_id": 2, "force": [4.0, 0, 0], "start": 0.0, "end": None, "at": [0.42, 0.0, 0.4]}
    path = rising(tmp_path / "t.h5", two_balls, frames=11, forces=(push, weak, {"kind": "pin", "object_id": 2}))
    footage = open_animation(path)
    assert len(force_arrows(footage, 0.02)) == 1 and len(force_arrows(footage, 0.06)) == 2
    assert len(force_arrows(footage, 0.1)) == 1  # the end is no longer in it
    (tail, tip), (tail2, tip2) = force_arrows(footage, 0.06)
    torch.testing.assert_close(tail, footage.at(0.06, footage.trajectory.com)[0])
    up, along = tip - tail, tip2 - tail2
    assert up[2] > 0.1 and up[:2].abs().max() == 0 and along[0] > 0 and along[1:].abs().max() < 1e-6
    torch.testing.assert_close(tail2, torch.tensor([0.42, 0.0, 0.43]), atol=1e-5, rtol=0)  # risen by three frames
    radius_ratio = float(up[2] / along[0])
    assert 2.0 < radius_ratio < 3.2  # half the force, on a ball of 0.12 against 0.15
    assert force_arrows(replace(footage, trajectory=None), 0.06) == []
