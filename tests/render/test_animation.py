"""Animation: frames of trajectories and scenes, and force arrows."""

from dataclasses import replace

import h5py
import pytest
import torch

from stages.core.errors import InputError
from stages.render.animation import open_animation
from stages.render.overlay import force_arrows
from tests.render.motions import rising


def test_first_frame_equals_the_scene(tmp_path, two_balls):
    animation = open_animation(rising(tmp_path / "t.h5", two_balls))
    g, rest = animation.gaussians(0.0), two_balls.gaussians
    for name in ("means", "quats", "scales", "sh", "opacities"):
        assert torch.equal(getattr(g, name), getattr(rest, name))


def test_stored_and_interpolated_frames_at_any_rate(tmp_path, two_balls):
    animation = open_animation(rising(tmp_path / "t.h5", two_balls, frames=11))  # the balls rise by 0.01 per frame
    assert animation.frame_times(None) == pytest.approx([0.02 * i for i in range(11)])
    assert animation.frame_times(25.0) == pytest.approx([0.04 * i for i in range(6)])
    assert len(animation.frame_times(60.0)) == 13  # 0.2 s, and the first frame
    balls = two_balls.gaussians.object_id > 0
    for frame in (3, 4.5):
        moved = animation.gaussians(0.02 * frame).means - two_balls.gaussians.means
        torch.testing.assert_close(moved[balls, 2], torch.full((800,), 0.01 * frame), atol=1e-5, rtol=0)
        assert (moved[~balls] == 0).all()


def test_dense_frames_are_used_unchanged(tmp_path, two_balls):
    path = rising(tmp_path / "t.h5", two_balls, frames=3)
    g = two_balls.gaussians
    with h5py.File(path, "a") as file:
        for name in ("means", "quats", "scales"):
            shift = 0 if name == "quats" else 1
            file[f"frames/{name}"] = torch.stack([getattr(g, name) + shift * t for t in range(3)]).numpy()
    assert torch.equal(open_animation(path).gaussians(0.04).means, g.means + 2)


def test_frame_option_selects_one_frame(tmp_path, two_balls):
    path = rising(tmp_path / "t.h5", two_balls, frames=5)
    last = open_animation(path, -1)
    assert not last.is_moving and len(last.frame_times(10.0)) == 40
    assert torch.equal(last.gaussians(0.0).means, open_animation(path).gaussians(0.08).means)
    with pytest.raises(InputError, match="frames 0 to 4"):
        open_animation(path, 5)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [("x.txt", b"hello", "with suffix .txt cannot be rendered"), ("x.h5", b"", "is empty"),
     ("x.h5", b"hello", "not a readable HDF5"), ("x.ply", b"hello", "not a readable PLY"), ("x.h5", None, "no such"),
     ("x.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
               b"end_header\n0 0 0\n", "plain point cloud")],
)  # fmt: skip
def test_wrong_files_give_one_line(tmp_path, name, content, message):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        open_animation(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_arrows_start_at_the_point_of_application_while_the_force_acts(tmp_path, two_balls):
    strong = {"kind": "force", "object_id": 1, "force": [0, 0, 8.0], "start": 0.04, "end": 0.1, "at": None}
    weak = {**strong, "object_id": 2, "force": [4.0, 0, 0], "start": 0.0, "end": None, "at": [0.42, 0.0, 0.4]}
    path = rising(tmp_path / "t.h5", two_balls, frames=11, forces=(strong, weak, {"kind": "pin", "object_id": 2}))
    animation = open_animation(path)
    assert len(force_arrows(animation, 0.02)) == 1 and len(force_arrows(animation, 0.06)) == 2
    assert len(force_arrows(animation, 0.1)) == 1  # the end time is exclusive
    (tail, tip), (tail2, tip2) = force_arrows(animation, 0.06)
    torch.testing.assert_close(tail, animation.interpolate(0.06, animation.trajectory.com)[0])
    up, along = tip - tail, tip2 - tail2
    assert up[2] > 0.1 and up[:2].abs().max() == 0 and along[0] > 0 and along[1:].abs().max() < 1e-6
    torch.testing.assert_close(tail2, torch.tensor([0.42, 0.0, 0.43]), atol=1e-5, rtol=0)  # after rising for 3 frames
    radius_ratio = float(up[2] / along[0])
    assert 2.0 < radius_ratio < 3.2  # half the force, and ball radii of 0.12 and 0.15
    assert force_arrows(replace(animation, trajectory=None), 0.06) == []
