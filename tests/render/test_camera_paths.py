"""Camera paths, and the subject that they show."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.cameras import centres, depths, project
from stages.render.animation import Animation, open_animation
from stages.render.camera_paths import camera_path, find_camera
from stages.render.path_file import interpolate_cameras, read_camera_path
from stages.render.subject import Subject, axes_focus, common_view_centre, find_subject, robust_box
from tests.conftest import ring
from tests.render.motions import rising

BOX = Subject(torch.tensor([0.0, 0.0, 0.1]), torch.tensor([0.3, 0.3, 0.2]))


def angles(a, b, about):
    """Angles at `about` between the directions of points a and b [degrees]."""
    u, v = (torch.nn.functional.normalize(x - about, dim=1) for x in (a, b))
    return torch.rad2deg(torch.acos((u @ v.mT).clamp(-1, 1)))


def test_novel_stays_near_the_photos_without_repeating_one():
    cameras = ring(24, target=0.1)
    path = camera_path("novel", cameras, BOX, 50, 640)
    away = angles(centres(path.viewmats), centres(cameras.viewmats), BOX.centre)
    assert away.min() > 2 and away.min(1).values.max() < 12
    steps = angles(centres(path.viewmats), centres(path.viewmats), BOX.centre).diagonal(1)
    assert steps.max() < 2 and 10 < steps.sum() < 31  # a short path
    assert steps[0] < 0.2 * steps[24] and steps[-1] < 0.2 * steps[24]  # slow at both ends


def test_novel_with_a_single_photo():
    cameras = ring(1, target=0.1)
    path = camera_path("novel", cameras, BOX, 10, 640)
    away = angles(centres(path.viewmats), centres(cameras.viewmats), BOX.centre)
    assert away.min() > 2 and away.max() < 7


@pytest.mark.parametrize("view", ["novel", "orbit"])
@pytest.mark.parametrize("cameras", [None, ring(8, target=0.1)], ids=["no photos", "photos"])
def test_subject_fills_the_image_and_stays_within_it(view, cameras):
    path = camera_path(view, cameras, BOX, 12, 640)
    corners, largest = BOX.corners(), 0.0
    for viewmat, K, (w, h) in zip(path.viewmats, path.Ks, path.sizes.tolist(), strict=True):
        assert max(w, h) == 640 and (depths(corners, viewmat) > 0).all()
        offset = (project(corners, viewmat, K) / torch.tensor([w / 2, h / 2]) - 1).abs()
        largest = max(largest, float(offset.max()))
    assert largest == pytest.approx(0.9, abs=1e-4)


def test_orbit_is_a_closed_circle():
    path = camera_path("orbit", None, BOX, 36, 640)
    eyes = centres(path.viewmats)
    assert torch.allclose(angles(eyes, eyes.roll(-1, 0), BOX.centre).diagonal(),
                          torch.tensor(10.0 * 0.906), atol=0.1)  # fmt: skip  # cos 25 degrees: above the horizon
    elevation = torch.asin((eyes - BOX.centre)[:, 2] / (eyes - BOX.centre).norm(dim=1))
    assert torch.allclose(torch.rad2deg(elevation), torch.tensor(25.0), atol=0.01)


def test_stored_camera_keeps_its_rays_at_any_resolution():
    cameras = ring(6, size=65)
    path = camera_path("input:2", cameras, BOX, 3, 200)
    assert len(path) == 3 and path.sizes.tolist() == [[200, 200]] * 3
    point = torch.tensor([[0.2, 0.1, 0.0]])
    before = project(point, cameras.viewmats[2], cameras.Ks[2]) / 65
    after = project(point, path.viewmats[1], path.Ks[1]) / 200
    torch.testing.assert_close(after, before)


def test_find_camera_by_index_and_by_name():
    cameras = ring(6)
    assert find_camera(cameras, "4") == 4
    assert find_camera(cameras, "03.png") == 3 and find_camera(cameras, "03") == 3
    for key in ("6", "-1", "kitchen.jpg"):
        with pytest.raises(InputError, match="from 0 to 5, or a photo such as 00.png"):
            find_camera(cameras, key)
    with pytest.raises(InputError, match="contains no cameras; use --view novel"):
        find_camera(None, "0")


def public(cameras, width=640, height=480):
    c2w = torch.linalg.inv(cameras.viewmats)
    return [{"rotation": m[:3, :3].tolist(), "position": m[:3, 3].tolist(), "width": width, "height": height,
             "fx": 700.0, "fy": 710.0} for m in c2w]  # fmt: skip


def test_both_formats_of_path_files_agree(tmp_path):
    cameras = ring(5)
    rows = public(cameras)
    K = [[700.0, 0, 320], [0, 710, 240], [0, 0, 1]]
    (tmp_path / "a.json").write_text(json.dumps(rows))
    (tmp_path / "b.json").write_text(
        json.dumps([{"viewmat": v.tolist(), "K": K, "size": [640, 480]} for v in cameras.viewmats])
    )
    a, b = read_camera_path(tmp_path / "a.json"), read_camera_path(tmp_path / "b.json")
    torch.testing.assert_close(a.viewmats, b.viewmats, atol=1e-5, rtol=0)
    torch.testing.assert_close(a.viewmats, cameras.viewmats, atol=1e-5, rtol=0)
    assert torch.equal(a.Ks, b.Ks) and torch.equal(a.sizes, b.sizes)


def test_path_passes_through_its_cameras_and_repeats_a_single_one(tmp_path):
    cameras = ring(5)
    through = interpolate_cameras(cameras, 17)
    torch.testing.assert_close(through.viewmats[::4], cameras.viewmats, atol=1e-5, rtol=0)
    R = through.viewmats[:, :3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand(17, 3, 3), atol=1e-5, rtol=0)
    (tmp_path / "one.json").write_text(json.dumps(public(cameras)[:1]))
    still = camera_path(str(tmp_path / "one.json"), None, BOX, 9, 320)
    assert still.sizes.tolist() == [[320, 240]] * 9 and (still.viewmats == still.viewmats[0]).all()
    assert float(still.Ks[0, 0, 0]) == 350


@pytest.mark.parametrize(
    ("text", "message"),
    [("", "is empty"), ("not json", "is not a valid camera path"), ("{}", "is not a valid camera path"),
     ("[]", "is not a valid camera path"),
     ('[{"rotation": [[1,0,0],[0,1,0],[0,0,2]], "position": [0,0,0], "width": 4, "height": 4, "fx": 1, "fy": 1}]',
      "not orthonormal"),
     ('[{"rotation": [[1,0,0],[0,1,0],[0,0,1]], "position": [0,0,0], "width": 0, "height": 4, "fx": 1, "fy": 1}]',
      "width is 0.0, not a number from 1")],
)  # fmt: skip
def test_invalid_path_files(tmp_path, text, message):
    (tmp_path / "p.json").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        read_camera_path(tmp_path / "p.json")
    assert "\n" not in str(caught.value)


def test_robust_box_ignores_outliers():
    points = torch.rand(10_000, 3, generator=torch.Generator().manual_seed(0))
    points[:100] += 1000
    found = robust_box(points)
    assert (found.centre - 0.5).abs().max() < 0.02
    assert found.half.tolist() == pytest.approx([0.5] * 3, rel=0.03)


def test_focus_of_converging_and_of_parallel_cameras(two_balls):
    found = axes_focus(ring(8, target=0.3))
    np.testing.assert_allclose(found.centre.numpy(), [0, 0, 0.3], atol=1e-4)
    assert axes_focus(two_balls.cameras[[0, 0]]) is None  # a single axis has no unique focus
    line = two_balls.cameras[[0, 0, 0]]
    line.viewmats[:, 0, 3] += torch.tensor([-0.1, 0.0, 0.1])  # next to each other, with the same viewing direction
    g = two_balls.gaussians
    assert axes_focus(line) is None
    assert common_view_centre(line, g[g.object_id > 0].means).centre[2] == pytest.approx(0.25, abs=0.15)
    assert (find_subject(Animation(two_balls)).centre - torch.tensor([0.05, 0.0, 0.25])).abs().max() < 0.15


def test_object_far_from_the_focus_is_not_framed(two_balls):
    g = two_balls.gaussians
    means = g.means.clone()
    means[g.object_id == 2] += torch.tensor([3.0, 0.0, 0.0])
    found = find_subject(Animation(replace(two_balls, gaussians=replace(g, means=means))))
    assert (found.centre - torch.tensor([-0.3, 0.0, 0.15])).abs().max() < 0.02
    alone = replace(two_balls, gaussians=replace(g, means=means), cameras=None)
    assert float(find_subject(Animation(alone)).half[0]) > 1.5


def test_aim_shifts_only_slightly_from_the_focus_towards_objects(two_balls):
    found = find_subject(Animation(replace(two_balls, cameras=ring(6, target=-0.4))))
    assert float(found.centre[2]) == pytest.approx(0.26, abs=0.05)
    assert -0.2 < float(found.target[2]) < 0.0  # 0.35 of two thirds of the way from -0.4 to 0.26


def test_lifted_objects_are_in_the_image_from_the_first_frame(tmp_path, two_balls):
    # the balls fall by 0.6 within 1/20 of the animation, to the focus of the cameras
    animation = open_animation(rising(tmp_path / "t.h5", two_balls, 40, 0.0), None, pick_device("auto"))
    positions = animation.trajectory.positions.clone()
    positions[:2, :, 2] += torch.tensor([[0.6], [0.3]])
    animation = replace(animation, trajectory=replace(animation.trajectory, positions=positions))
    path = camera_path("novel", two_balls.cameras, find_subject(animation), 40, 640)
    for i in range(40):
        inside = ((project(positions[i], path.viewmats[i], path.Ks[i]) / path.sizes[i] - 0.5).abs() < 0.5).all(1)
        assert float(inside.float().mean()) > 0.95


@pytest.mark.parametrize("jump", [(0.0, 0.0, 0.9), (0.5, -0.5, 0.0)], ids=["high up", "to the side"])
def test_moving_objects_stay_in_the_image(tmp_path, two_balls, jump):
    """The objects move far above or beside the region of the photos, and back."""
    animation = open_animation(rising(tmp_path / "t.h5", two_balls, 40, 0.0), None, pick_device("auto"))
    positions = animation.trajectory.positions.clone()
    positions += 4 * (torch.linspace(0, 1, 40) - torch.linspace(0, 1, 40) ** 2)[:, None, None] * torch.tensor(jump)
    animation = replace(animation, trajectory=replace(animation.trajectory, positions=positions))
    still = camera_path("novel", two_balls.cameras, find_subject(Animation(two_balls)), 40, 640)
    path = camera_path("novel", two_balls.cameras, find_subject(animation), 40, 640)
    # MIN_FOCAL_FACTOR divided by the largest zoom
    assert float(path.Ks[0, 0, 0]) >= 0.75 * float(still.Ks[0, 0, 0]) / 1.6
    for i in range(40):
        inside = ((project(positions[i], path.viewmats[i], path.Ks[i]) / path.sizes[i] - 0.5).abs() < 0.5).all(1)
        assert bool((depths(positions[i], path.viewmats[i]) > 0).all()) and bool(inside.all())


def test_objects_that_leave_the_scene_are_not_followed(tmp_path, two_balls):
    animation = open_animation(rising(tmp_path / "t.h5", two_balls, 40, 5.0), None, pick_device("auto"))
    path = camera_path("novel", two_balls.cameras, find_subject(animation), 40, 640)
    assert bool((path.viewmats[:, 2, 2] < 0.5).all())  # z of the viewing axis: at most 30 degrees upwards
    extent = (centres(two_balls.cameras.viewmats)[:, :2].norm(dim=1)).max()
    assert float(centres(path.viewmats)[:, :2].norm(dim=1).max()) < 1.6 * float(extent)


def test_motion_within_the_box_does_not_change_the_path(two_balls):
    subject = find_subject(Animation(two_balls))
    inner = subject.centre + 0.3 * (subject.corners() - subject.centre)
    plain, moving = (camera_path("novel", two_balls.cameras, s, 9, 640) for s in
                     (subject, replace(subject, moving=inner.expand(5, 8, 3))))  # fmt: skip
    assert torch.equal(plain.viewmats, moving.viewmats) and torch.equal(plain.Ks, moving.Ks)
