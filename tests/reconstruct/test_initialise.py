"""Conversion of depth maps to initial Gaussians."""

import pytest
import torch

from stages.core.geometry.rotations import matrix
from stages.reconstruct import initialise
from stages.reconstruct.depth import DepthMap
from stages.reconstruct.initialise import DepthViews, OrientedPoints
from stages.reconstruct.photos import Views
from tests.reconstruct.raycast import arc, photograph


def flat_cloud(n: int = 400, spacing: float = 0.1) -> OrientedPoints:
    """A square grid of points in the plane z = 0."""
    side = round(n**0.5)
    grid = spacing * torch.cartesian_prod(torch.arange(side), torch.arange(side)).float()
    points = torch.cat([grid, torch.zeros(n, 1)], 1)
    up = torch.tensor([[0.0, 0, 1]]).repeat(n, 1)
    return OrientedPoints(points, up, torch.full((n, 3), 0.25), torch.full((n,), spacing), torch.full((n,), 2.0))


@pytest.fixture(scope="module")
def block():
    """Three views with their true, consistent depth."""
    cameras = arc(3, (80, 60))
    photos, truth = zip(*(photograph(cameras, i) for i in range(3)), strict=True)
    views = Views(tuple((p * 255).round().to(torch.uint8) for p in photos), cameras)
    return DepthViews(views, [DepthMap(d, torch.full_like(d, 2.0)) for d in truth], 1)


def test_gaussians_are_flat_and_as_wide_as_the_point_spacing():
    gaussians = initialise.to_gaussians(flat_cloud(), torch.full((400,), 0.8), degree=1)
    inner = (gaussians.means[:, :2] > 0.15).all(1) & (gaussians.means[:, :2] < 1.75).all(1)
    torch.testing.assert_close(gaussians.scales[inner, 0], torch.full((int(inner.sum()),), 0.06))
    assert (gaussians.scales[:, 2] < 0.25 * gaussians.scales[:, 0]).all()
    torch.testing.assert_close(gaussians.sh[:, 0] * 0.28209479 + 0.5, torch.full((400, 3), 0.25))
    assert gaussians.sh.shape == (400, 4, 3) and not gaussians.sh[:, 1:].any()


def test_quaternions_rotate_z_to_the_normal():
    normals = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    normals[0], normals[1] = torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 0, -1])
    torch.testing.assert_close(matrix(initialise.quats_from_normals(normals))[:, :, 2], normals, rtol=0, atol=1e-5)


def test_unprojected_normals_point_up_on_the_table(block):
    first = block.maps[0]
    cloud = initialise.unproject_view(block.views, 0, first.depth, first.support)
    table = (cloud.points[:, 2].abs() < 1e-3) & (cloud.points[:, :2].abs() > 0.4).any(1)
    assert table.sum() > 500
    assert (cloud.normals[table, 2] > 0.99).float().mean() > 0.9


def test_downsampling_reaches_the_target_and_keeps_colours():
    cloud = flat_cloud(10_000, 0.01)
    few = initialise.downsample(cloud, 1000, torch.zeros(3), radius=100.0)
    assert 250 < len(few) <= 1100  # the number of voxels in a plane changes by factors of four
    torch.testing.assert_close(few.colours, torch.full((len(few), 3), 0.25))
    torch.testing.assert_close(few.points[:, 2], torch.zeros(len(few)))


def test_downsampling_is_finer_in_focus():
    cloud = flat_cloud(10_000, 0.01)  # a square of side 1 with a corner at the origin
    few = initialise.downsample(cloud, 2000, torch.zeros(3), radius=0.6)
    near, far = few.points.norm(dim=1) < 0.2, few.points.norm(dim=1) > 0.8
    before = cloud.points.norm(dim=1)
    assert near.sum() / (before < 0.2).sum() > 2 * far.sum() / (before > 0.8).sum()


def test_different_voxels_are_not_mixed():
    """The mean of points on two sides of the scene would be a point in front of the cameras."""
    index = torch.arange(-20.0, 20)
    points = torch.cartesian_prod(index, index, index) + 0.5
    cells = torch.cat([initialise._cells(points, torch.full((1,), side)) for side in (1.0, 2.0)])
    assert len(cells.unique()) == 40**3 + 20**3


def test_point_before_a_surface_violates_free_space(block):
    viewmat = block.views.cameras.viewmats[0]
    eye = -viewmat[:3, :3].T @ viewmat[:3, 3]
    floater = torch.lerp(eye, torch.tensor([0.0, 0, 0.2]), 0.7)
    points = torch.stack([floater, torch.tensor([0.0, 0, 0.2])])
    count = initialise.free_space_violations(points, block, 1)
    assert count[0] >= 1 and count[1] == 0


def test_interpolated_depth_continues_known_depth():
    depth = torch.full((32, 48), 2.0)
    known = torch.ones(32, 48, dtype=torch.bool)
    known[8:20, 10:30] = False
    depth[~known] = 77.0
    torch.testing.assert_close(initialise.interpolate_depth(depth, known), torch.full((32, 48), 2.0), rtol=1e-3, atol=0)


def test_only_uncovered_pixels_are_filled(block, device):
    known = torch.arange(80) < 40
    maps = [DepthMap(m.depth, m.support.where(known, torch.zeros_like(m.support))) for m in block.maps]
    half = DepthViews(block.views, maps, 1)
    cloud = initialise.fuse(half.to(device)).to("cpu")
    more = initialise.fill_unmatched(half.to(device), cloud, None, far=5.0).to("cpu")
    assert len(more) > 50
    for i in range(3):
        before, after = (
            initialise.covered_pixels(block.views, i, initialise.to_gaussians(c, torch.full((len(c),), 0.8), 0))
            .float()
            .mean()
            for c in (cloud, initialise.concatenate_points([cloud, more]))
        )
        assert after > max(0.95, float(before))
