import cv2
import numpy as np
import torch

from stages.core.geometry.cameras import centres, depths, intrinsics, look_at, orbit, project, resize


def test_projection_agrees_with_opencv():
    rng = torch.Generator().manual_seed(0)
    points = torch.randn(30, 3, generator=rng, dtype=torch.float64)
    viewmat = look_at(torch.tensor([3.0, 2, 1]), torch.zeros(3)).double()
    K = intrinsics(640, 480, 500.0).double()
    rvec, _ = cv2.Rodrigues(viewmat[:3, :3].numpy())
    theirs, _ = cv2.projectPoints(points.numpy(), rvec, viewmat[:3, 3].numpy(), K.numpy(), None)
    np.testing.assert_allclose(project(points, viewmat, K).numpy(), theirs[:, 0], rtol=0, atol=1e-4)


def test_look_at_centres_the_target_with_up_upwards():
    viewmat = look_at(torch.tensor([2.0, 0, 1]), torch.tensor([0.0, 0, 1]))
    torch.testing.assert_close(depths(torch.tensor([[0.0, 0, 1]]), viewmat), torch.tensor([2.0]))
    above = project(torch.tensor([[0.0, 0, 1.5]]), viewmat, intrinsics(100, 100, 100.0))
    torch.testing.assert_close(above, torch.tensor([[50.0, 25.0]]))
    torch.testing.assert_close(centres(viewmat[None]), torch.tensor([[2.0, 0, 1]]))


def test_resized_intrinsics():
    # all of K scales with the image
    K = resize(intrinsics(200, 100, 150.0), 0.5, 0.5)
    torch.testing.assert_close(K, intrinsics(100, 50, 75.0))


def test_orbit_equals_the_public_code(shared):
    data = np.load(shared / "facts/ngff_parity/orbit_cameras.npz")
    viewmats = orbit(100, torch.tensor([0.0, 0, -0.3]), 4.0, 20.0)
    np.testing.assert_allclose(centres(viewmats).numpy(), data["dynamic/position"], atol=1e-4)
    np.testing.assert_allclose(viewmats[:, :3, :3].mT.numpy(), data["dynamic/rotation_c2w"], atol=1e-4)


def test_depth_is_the_distance_along_the_viewing_axis_and_negative_behind():
    viewmat = look_at(torch.tensor([3.0, 0, 1]), torch.tensor([0.0, 0, 1]))
    points = torch.tensor([[1.0, 5, 2], [4.0, -2, 0]])
    torch.testing.assert_close(depths(points, viewmat), torch.tensor([2.0, -1.0]))


def test_images_may_be_resized_by_two_factors():
    K = resize(intrinsics(200, 100, 150.0), 0.5, 2.0)
    torch.testing.assert_close(K, torch.tensor([[75.0, 0, 50], [0, 300, 100], [0, 0, 1]]))


def test_an_arc_of_cameras_looks_at_its_centre_from_one_height():
    centre = torch.tensor([1.0, 2, 3])
    viewmats = orbit(4, centre, 2.0, 30.0, sweep=180.0)
    offsets = centres(viewmats) - centre
    torch.testing.assert_close(offsets.norm(dim=1), torch.full((4,), 2.0))
    torch.testing.assert_close(offsets[:, 2], torch.full((4,), 1.0))  # 2 sin 30
    torch.testing.assert_close(-offsets / 2, viewmats[:, 2, :3])
    steps = torch.nn.functional.cosine_similarity(offsets[1:, :2], offsets[:-1, :2])
    torch.testing.assert_close(steps, torch.full((3,), 0.5**0.5))  # 45 degrees apart
    # azimuth 0 is (1, 1, 0) / sqrt 2, azimuth 90 is (1, -1, 0) / sqrt 2
    ends = centres(orbit(4, centre, 2.0, 0.0, azimuth=0.0)) - centre
    torch.testing.assert_close(ends[:2], torch.tensor([[2**0.5, 2**0.5, 0], [2**0.5, -(2**0.5), 0]]), atol=1e-6, rtol=0)
