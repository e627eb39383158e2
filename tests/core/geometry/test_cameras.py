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
