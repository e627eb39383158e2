import torch

from stages.core.geometry.cameras import depths, intrinsics, look_at, project
from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity, umeyama

ROTATION = matrix(torch.tensor([0.8, 0.1, -0.3, 0.5], dtype=torch.float64))
TRANSFORM = Similarity(2.5, ROTATION, torch.tensor([1.0, -2, 3]).double())


def test_umeyama_recovers_a_known_similarity():
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = umeyama(points, TRANSFORM(points))
    assert abs(found.scale - TRANSFORM.scale) < 1e-12
    torch.testing.assert_close(found.rotation, TRANSFORM.rotation)
    torch.testing.assert_close(found.translation, TRANSFORM.translation)


def test_transformed_cameras_project_the_transformed_world_to_the_same_pixels():
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    viewmat, K = look_at(torch.tensor([6.0, 1, 2]), torch.zeros(3)).double(), intrinsics(64, 64, 80.0).double()
    transformed = TRANSFORM.viewmats(viewmat[None])[0]
    torch.testing.assert_close(project(TRANSFORM(points), transformed, K), project(points, viewmat, K))


def test_a_rigid_motion_has_no_scale():
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = umeyama(points, TRANSFORM(points), scaled=False)
    assert found.scale == 1
    torch.testing.assert_close(found.rotation, ROTATION)
    # least squares: centroid onto centroid
    torch.testing.assert_close(found(points).mean(0), TRANSFORM(points).mean(0))


def test_points_in_one_place_are_moved_there():
    found = umeyama(torch.ones(4, 3).double(), torch.full((4, 3), 3.0).double())
    torch.testing.assert_close(found(torch.ones(1, 3).double()), torch.full((1, 3), 3.0).double())


def test_inverse_undoes_a_similarity():
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    inverse = TRANSFORM.inverse()
    torch.testing.assert_close(inverse(TRANSFORM(points)), points)
    assert inverse.scale == 0.4


def test_depths_grow_with_the_world():
    points = torch.randn(5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    viewmat = look_at(torch.tensor([6.0, 1, 2]), torch.zeros(3)).double()
    transformed = TRANSFORM.viewmats(viewmat[None])[0]
    torch.testing.assert_close(depths(TRANSFORM(points), transformed), 2.5 * depths(points, viewmat))
