"""Structure from motion: its parts, and its errors."""

import sys
from collections.abc import Iterator

import pytest
import torch

from stages.core.errors import InputError, MissingPackage
from stages.core.geometry.cameras import centres
from stages.core.geometry.similarity import umeyama
from stages.core.scene.cameras import LensDistortion
from stages.reconstruct import features, sfm
from stages.reconstruct.colmap import colmap_process
from stages.reconstruct.matching import MatchingOptions
from stages.reconstruct.photo_reader import read_photos
from stages.reconstruct.photos import Photos, undistort
from tests.reconstruct import raycast
from tests.reconstruct.raycast import arc, photograph, write_set


@pytest.fixture(scope="module", autouse=True)
def one_process() -> Iterator[None]:
    """A common COLMAP process for all tests, each of which would otherwise start one."""
    with colmap_process():
        yield


def as_photos(cameras, folder) -> Photos:
    images = tuple((photograph(cameras, i)[0] * 255).round().to(torch.uint8) for i in range(len(cameras)))
    return Photos(images, cameras.names, (0.0,) * len(images), folder)


def test_blank_photos_are_refused(tmp_path):
    blank = Photos(
        tuple(torch.full((120, 160, 3), 128, dtype=torch.uint8) for _ in range(4)),
        tuple("abcd"), (0.0,) * 4, tmp_path / "photos",
    )  # fmt: skip
    with pytest.raises(InputError, match=r"photos: no two photos show the same objects.*take 10 or more"):
        sfm.estimate_cameras(blank)


def test_absent_pycolmap_is_reported(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(MissingPackage, match="`pip install pycolmap`, or use --backend pi3"):
        sfm.estimate_cameras(as_photos(arc(2, (64, 48)), tmp_path))


def test_photos_are_read_without_pycolmap(tmp_path, monkeypatch):
    write_set(tmp_path, arc(2, (64, 48)))
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert read_photos(tmp_path / "images").focals == (0.0, 0.0)


def test_cameras_of_a_ray_cast_scene(tmp_path):
    true = arc(6, (320, 240))
    model = sfm.estimate_cameras(as_photos(true, tmp_path))
    assert model.cameras.names == true.names
    move = umeyama(centres(model.cameras.viewmats), centres(true.viewmats))
    found = move.viewmats(model.cameras.viewmats)
    steps = [v[1:, :3, :3] @ v[:-1, :3, :3].mT for v in (found, true.viewmats)]  # relative rotations of neighbours
    turn = steps[0] @ steps[1].mT
    angle = torch.rad2deg(torch.acos(((turn.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1)))
    assert angle.median() < 0.3
    assert (centres(found) - centres(true.viewmats)).norm(dim=1).max() < 0.02  # 1.2 % of the distance
    assert abs(float(model.cameras.Ks[0, 0, 0] / true.Ks[0, 0, 0]) - 1) < 0.03


def test_the_same_seed_gives_the_same_cameras(tmp_path):
    photos = as_photos(arc(3, (240, 180), sweep=30.0), tmp_path)
    first, second = (sfm.estimate_cameras(photos, MatchingOptions(seed=4)) for _ in range(2))
    assert torch.equal(first.cameras.viewmats, second.cameras.viewmats)
    assert torch.equal(first.points, second.points)


def test_known_cameras_are_kept_and_give_points_on_the_surfaces(tmp_path):
    cameras = arc(4, (240, 180), sweep=40.0)
    model = sfm.triangulate(as_photos(cameras, tmp_path), cameras, LensDistortion(torch.zeros(4, 5)))
    assert torch.equal(model.cameras.viewmats, cameras.viewmats)
    outside = (model.points[:, :2].abs() > 0.3).any(1)
    assert outside.sum() > 30
    assert model.points[outside, 2].abs().median() < 0.003


def test_cameras_that_do_not_fit_the_photos_are_refused(tmp_path):
    cameras = arc(4, (240, 180), sweep=40.0)
    photos = as_photos(cameras, tmp_path)
    with pytest.raises(InputError, match="median reprojection error of the given cameras is .* px"):
        sfm.triangulate(photos, cameras[[3, 2, 1, 0]], LensDistortion(torch.zeros(4, 5)))


def test_known_cameras_work_above_a_table_whose_pattern_repeats(tmp_path, monkeypatch):
    """Most matches are between different tiles, and geometry fitted to them is wrong."""
    plain = raycast.texture

    def tiles(u, v, seed):
        return plain(torch.remainder(u, 0.12), torch.remainder(v, 0.12), seed) if seed == 0 else plain(u, v, seed)

    monkeypatch.setattr(raycast, "texture", tiles)
    cameras = arc(5, (320, 240), sweep=60.0)
    model = sfm.triangulate(as_photos(cameras, tmp_path), cameras, LensDistortion(torch.zeros(5, 5)))
    beside = (model.points[:, :2].abs() > 0.3).any(1)
    assert len(model.points) > 100
    assert model.points[beside, 2].abs().median() < 0.01
    assert (model.points[:, 2] > 0.05).sum() > 20  # points of the block, whose texture does not repeat


def test_failure_reason_by_number_of_pairs():
    assert "overlap too little" in sfm._failure_reason(photos=24, pairs=30, matches=100)  # neighbours only
    assert "a pattern repeats" in sfm._failure_reason(photos=24, pairs=162, matches=100)  # checked tablecloth
    assert "more light" in sfm._failure_reason(photos=16, pairs=36, matches=21)  # a plain bear on a dark table
    assert "overlap too little" in sfm._failure_reason(photos=3, pairs=3, matches=100)


def test_mutual_matches():
    a = torch.nn.functional.normalize(torch.tensor([[1.0, 0, 0], [0, 1, 0], [1, 1, 0.01]]), dim=1)
    b = torch.nn.functional.normalize(torch.tensor([[0.02, 1, 0], [1, 0.01, 0], [0, 0, 1.0]]), dim=1)
    # the third descriptor of a is between two of b, so the ratio test rejects it
    assert features.match_descriptors(a, b).tolist() == [[0, 1], [1, 0]]


def test_matches_are_mutual_nearest_neighbours_one_by_one(device):
    generator = torch.Generator().manual_seed(0)
    a = torch.nn.functional.normalize(torch.randn(60, 8, generator=generator), dim=1)
    b = torch.nn.functional.normalize(a[torch.randperm(60, generator=generator)[:50]] + 0.1, dim=1)
    similarity = a @ b.mT
    expected = []
    for i, row in enumerate(similarity):
        second, best = (2 - 2 * row.topk(2).values).clamp_min(0).sqrt().flip(0).tolist()
        near = best < features.MAX_DESCRIPTOR_DISTANCE and best < features.MAX_RATIO * second
        if near and int(similarity[:, row.argmax()].argmax()) == i:
            expected.append([i, int(row.argmax())])
    assert features.match_descriptors(a.to(device), b.to(device)).tolist() == expected and len(expected) > 10


def test_pairs_of_many_photos_are_neighbours_and_similar_photos(monkeypatch):
    monkeypatch.setattr(features, "MAX_EXHAUSTIVE", 10)
    generator = torch.Generator().manual_seed(0)
    found = [torch.nn.functional.normalize(torch.randn(30, 16, generator=generator), dim=1) for _ in range(40)]
    found[39] = found[0]  # the photos form a closed loop
    chosen = features.select_pairs(found, neighbours=3, similar=2)
    assert (0, 39) in chosen
    assert all((i, i + 1) in chosen for i in range(39))
    assert len(chosen) < 40 * 39 / 4


def test_number_of_pairs_is_linear_even_if_all_photos_are_similar(monkeypatch):
    monkeypatch.setattr(features, "MAX_EXHAUSTIVE", 20)
    n, generator = 60, torch.Generator().manual_seed(0)
    same = torch.nn.functional.normalize(torch.randn(30, 16, generator=generator), dim=1)
    chosen = features.select_pairs([same] * n)
    assert len(set(chosen)) == len(chosen) <= (8 + 20) * n < n * (n - 1) / 2
    assert len(features.select_pairs([same] * 20)) == 20 * 19 / 2


def test_undistortion_straightens_lines(tmp_path):
    # an edge distorted by k1 = -0.2 becomes straight
    size, K = (200, 150), torch.tensor([[180.0, 0, 100], [0, 180, 75], [0, 0, 1]])
    y, x = torch.meshgrid(torch.arange(150) + 0.5, torch.arange(200) + 0.5, indexing="ij")
    u, v = (x - 100) / 180, (y - 75) / 180
    du, dv = u.clone(), v.clone()
    for _ in range(20):  # computes undistorted coordinates of each distorted pixel
        r2 = du**2 + dv**2
        du, dv = u / (1 - 0.2 * r2), v / (1 - 0.2 * r2)
    image = (torch.sigmoid((du - 0.3) * 60)[..., None].expand(-1, -1, 3) * 255).to(torch.uint8)
    cameras = arc(1, size)
    cameras.Ks[0] = K
    photos = Photos((image,), cameras.names, (0.0,), tmp_path)
    views = undistort(photos, cameras, LensDistortion(torch.tensor([[-0.2, 0, 0, 0, 0]])), side=200)
    edge = (views.images[0][..., 0].float() / 255 > 0.5).float().argmax(1) + 0.0
    at = (edge - views.cameras.Ks[0][0, 2]) / views.cameras.Ks[0][0, 0]
    assert (at - 0.3).abs().max() < 1.5 / 180
