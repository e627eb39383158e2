"""Multi-view depth of a ray-cast scene with known depth."""

import pytest
import torch

from stages.core.geometry.planes import Plane
from stages.core.scene.cameras import LensDistortion
from stages.reconstruct import depth as stereo
from stages.reconstruct.photos import Views
from stages.reconstruct.sfm import SparseModel
from tests.reconstruct.raycast import arc, photograph


def sparse(cameras, truth, step: int = 12) -> SparseModel:
    """True points on a grid in every view, observed by the views in which they are visible."""
    points = []
    for i in range(len(cameras)):
        _, world = stereo.unproject(truth[i], cameras.Ks[i], cameras.viewmats[i])
        points.append(world[::step, ::step].reshape(-1, 3))
    points = torch.cat(points)
    poses = zip(truth, cameras.Ks, cameras.viewmats, strict=True)
    seen = torch.stack([stereo.look_up_points(depth, points, K, viewmat)[1] for depth, K, viewmat in poses])
    view, point = seen.nonzero().T
    return SparseModel(cameras, LensDistortion(torch.zeros(len(cameras), 5)), points, point, view)


@pytest.fixture(scope="module")
def block():
    cameras = arc(5)
    photos, truth = zip(*(photograph(cameras, i) for i in range(len(cameras))), strict=True)
    views = Views(tuple((p * 255).round().to(torch.uint8) for p in photos), cameras)
    return views, truth, sparse(cameras, truth)


def test_consistent_depth_is_accurate(block, device):
    views, truth, model = block
    maps = stereo.estimate_depth_maps(views, model, Plane(torch.tensor([0.0, 0, 1]), 0.0), device)
    for found, true in zip(maps, truth, strict=True):
        consistent = found.support >= 2
        error = ((found.depth - true).abs() / true)[consistent]
        assert consistent.float().mean() > 0.6
        # an error of 0.1 px between neighbours (12 degrees apart) is 0.25 % of the depth
        assert error.median() < 0.0025
        assert (error < 0.02).float().mean() > 0.97


def test_depth_does_not_depend_on_the_number_of_threads(block, with_threads):
    views, _, model = block
    plane = Plane(torch.tensor([0.0, 0, 1]), 0.0)
    first, second = (with_threads(n, stereo._match_view, views, model, 2, [1, 3], plane, "cpu") for n in (1, 2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_sources_are_the_neighbours(block):
    _, _, model = block
    sources = stereo.select_sources(model, 2)
    assert set(sources[2]) == {1, 3}
    assert all(i not in chosen for i, chosen in enumerate(sources))


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_better_half_of_the_sources(count, device):
    scores = torch.rand(count, 5, 7, generator=torch.Generator().manual_seed(0)).to(device)
    scores[:, 0] = 0.5  # equal scores occur too
    expected = scores.topk((count + 1) // 2, dim=0).values.mean(0)
    torch.testing.assert_close(stereo._mean_of_better_half(list(scores)), expected, rtol=0, atol=1e-6)


def test_semi_global_matching_fills_gaps_and_keeps_edges():
    # The left half has label 3 and the right half label 8; in a band of columns, all labels have the same cost.
    cost = torch.full((12, 20, 40), 0.6)
    cost[3, :, :20] = 0
    cost[8, :, 20:] = 0
    cost[:, :, 5:12] = 0.3
    label = stereo.semi_global_matching(cost)
    assert (label[:, :18] - 3).abs().max() < 0.6
    assert (label[:, 22:] - 8).abs().max() < 0.6


def test_wrong_depth_is_not_consistent(block):
    views, truth, _ = block
    wrong = [t.clone() for t in truth]
    wrong[0] = truth[0] * 1.1
    assert (stereo.check_consistency(wrong, views, 0, [1, 2]).support >= 2).float().mean() < 0.02
    assert (stereo.check_consistency(list(truth), views, 0, [1, 2]).support >= 2).float().mean() > 0.7


def test_unprojected_pixels_project_back(block):
    views, truth, _ = block
    pixels, points = stereo.unproject(truth[1], views.cameras.Ks[1], views.cameras.viewmats[1])
    camera = points @ views.cameras.viewmats[1][:3, :3].T + views.cameras.viewmats[1][:3, 3]
    torch.testing.assert_close(camera[..., 2], truth[1], rtol=1e-5, atol=1e-5)
    there, inside = stereo.look_up_points(truth[1], points, views.cameras.Ks[1], views.cameras.viewmats[1])
    assert inside.float().mean() > 0.99
    torch.testing.assert_close(there[inside], points[inside], rtol=1e-4, atol=1e-3)
    assert pixels[0, 0].tolist() == [0.5, 0.5]


def test_speckles_lose_their_support():
    depth, support = torch.full((40, 60), 2.0), torch.zeros(40, 60)
    support[5:15, 5:15] = 3  # a surface
    support[20:24, 20:24] = 2  # agreement by chance
    support[:, 50:] = -1  # a backdrop
    support[30:36, 30:36], depth[30:36, 30:33] = 2, 1.0  # two neighbours at different depth
    found = stereo.without_speckles(stereo.DepthMap(depth, support))
    assert torch.equal(found.support[5:15, 5:15], support[5:15, 5:15])
    assert int((found.support > 0).sum()) == 100 and (found.support[:, 50:] == -1).all()
    assert torch.equal(found.depth, depth)


def test_a_plain_backdrop_gets_no_depth():
    """Areas without matches that reach the border of the image, however objects and the table bound them."""
    score = torch.full((60, 80), 0.8)
    score[:30] = 0.1  # the backdrop above a table
    score[15:40, 30:50] = 0.8  # an object in front of both
    score[22:30, 36:44] = 0.1  # a plain patch of it
    score[24, 28:36] = 0.2  # a gap in its outline
    backdrop = stereo._backdrop(score)
    assert backdrop[:15].all() and backdrop[:30, :28].all()
    assert not backdrop[30:].any() and not backdrop[20:, 34:46].any()


def test_depth_on_the_plane_is_that_of_a_plain_table(block):
    views, truth, _ = block
    table = stereo._on_plane(truth[0], views, 0, Plane(torch.tensor([0.0, 0, 1]), 0.0))
    _, points = stereo.unproject(truth[0], views.cameras.Ks[0], views.cameras.viewmats[0])
    assert table[points[..., 2] < 0.01].all() and not table[points[..., 2] > 0.1].any()
    assert not stereo._on_plane(truth[0], views, 0, None).any()
