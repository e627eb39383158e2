"""Conversion of a network's point maps to cameras and supported depth."""

import numpy as np
import pytest
import torch

from stages.core.geometry.cameras import intrinsics
from stages.core.models.pi3.network import Geometry
from stages.core.scene.cameras import Cameras
from stages.reconstruct import network_input, pointmaps
from stages.reconstruct.photos import Photos
from tests.reconstruct.oracle import truth
from tests.reconstruct.raycast import arc


def recorded(shared, name: str) -> dict[str, torch.Tensor]:
    data = np.load(shared / "facts/pi3_parity" / f"{name}.npz")
    return {key: torch.from_numpy(np.array(data[key])) for key in data}


def test_intrinsics_equal_the_published_code(shared):
    d = recorded(shared, "solve_intrinsics")
    K = pointmaps.solve_intrinsics(d["in/local_points"][0], centre=0.0)
    torch.testing.assert_close(K, d["out/K"][0], rtol=1e-4, atol=1e-5)


def test_depth_edges_equal_the_published_code(shared):
    d = recorded(shared, "depth_edge")
    assert torch.equal(pointmaps.depth_edges(d["in/depth"][0]), d["out/edge"][0])


def test_intrinsics_of_true_points_with_masked_outliers():
    cameras = arc(2, (56, 42))
    geometry = truth(cameras, 3.0)
    torch.testing.assert_close(pointmaps.solve_intrinsics(geometry.points[0]), cameras.Ks[0], rtol=1e-4, atol=1e-3)
    wrong = geometry.points[0].clone()
    wrong[:10, :, 0] *= 3
    mask = torch.ones(42, 56, dtype=torch.bool)
    assert (pointmaps.solve_intrinsics(wrong) - cameras.Ks[0]).abs().max() > 5
    mask[:10] = False
    torch.testing.assert_close(pointmaps.solve_intrinsics(wrong, mask), cameras.Ks[0], rtol=1e-4, atol=1e-3)


def test_view_without_confident_pixels_gets_median_intrinsics():
    cameras = arc(3, (56, 42))
    geometry = truth(cameras, 1.0)
    confident = pointmaps.confident_pixels(geometry)
    confident[1] = False
    Ks = pointmaps.cameras_from_pointmaps(geometry, confident, cameras.names).Ks
    torch.testing.assert_close(Ks, intrinsics(56, 42, 1.2 * 56).expand(3, 3, 3), rtol=1e-3, atol=0.05)


def test_only_true_depth_is_supported():
    cameras = arc(4, (84, 56), sweep=30.0)
    geometry = truth(cameras, 2.0)
    found = pointmaps.cameras_from_pointmaps(geometry, pointmaps.confident_pixels(geometry), cameras.names)
    depths = geometry.points[..., 2].clone()
    depths[3] *= 1.2
    maps = pointmaps.depth_maps(depths, pointmaps.confident_pixels(geometry), found)
    seen = maps[0].support > 0
    assert maps[0].support[seen].mean() > 2.3  # itself, and the two other correct views where they overlap
    assert maps[3].support[maps[3].support > 0].mean() < 1.3
    assert (maps[0].support[~pointmaps.confident_pixels(geometry)[0]] == 0).all()


def test_unconfident_pixels_and_edges_are_excluded():
    depth = torch.ones(1, 20, 20)
    depth[:, :, 10:] = 2.0
    confidence = torch.full((1, 20, 20), 0.9)
    confidence[:, :5] = 0.05
    local = torch.stack([torch.zeros_like(depth), torch.zeros_like(depth), depth], -1)
    confident = pointmaps.confident_pixels(Geometry(local, confidence, torch.eye(4)[None]))[0]
    assert not confident[:5].any() and not confident[:, 9:11].any()
    assert confident[5:, :9].all() and confident[5:, 11:].all()


@pytest.mark.parametrize(
    ("photo", "expected"),
    [((448, 448), (448, 448)), ((4000, 4000), (448, 448)), ((100, 60), (98, 56)), ((3, 3), (14, 14))],
)
def test_network_sizes(photo, expected):
    assert network_input.network_size(*photo) == expected


@pytest.mark.parametrize("photo", [(640, 480), (1024, 683), (576, 1024), (1500, 200)])
def test_network_sizes_are_patch_multiples_near_the_limit(photo):
    width, height = network_input.network_size(*photo)
    assert width % 14 == height % 14 == 0
    assert 0.9 * 201_000 < width * height <= 201_000
    assert abs(width / height / (photo[0] / photo[1]) - 1) < 0.07
    assert max(network_input.network_size(*photo, longest=300)) <= 300


def test_crops_keep_the_image_centre(tmp_path):
    wide, tall = torch.zeros(60, 100, 3, dtype=torch.uint8), torch.zeros(100, 60, 3, dtype=torch.uint8)
    wide[29:31, 49:51] = 255
    tall[49:51, 29:31] = 255
    photos = Photos((wide, tall, wide), ("a", "b", "c"), (0.0,) * 3, tmp_path)
    cut = network_input.crop_photos(photos)
    size = network_input.common_size(photos)
    for image in cut:
        assert abs(image.shape[1] / image.shape[0] - size[0] / size[1]) < 0.04
        middle = image.float().mean(2)
        centre = (middle > 128).nonzero().float().mean(0) + 0.5
        assert (centre - torch.tensor(middle.shape) / 2).abs().max() <= 0.6
    assert network_input.make_batch(cut, size).shape == (3, 3, size[1], size[0])


def test_photo_intrinsics_undo_the_crop(tmp_path):
    # A 100x60 photo (200x120 in the file) at network size 56x56 is cropped to columns 20 to 80, centre 100 in the file.
    photos = Photos((torch.zeros(60, 100, 3, dtype=torch.uint8),), ("a",), (0.0,), tmp_path, ((200, 120),))
    K = torch.tensor([[[56.0, 0, 28], [0, 56, 28], [0, 0, 1]]])
    cameras = Cameras(torch.eye(4)[None], K, torch.tensor([[56, 56]]), ("a",))
    taken = network_input.photo_intrinsics(photos, cameras)
    torch.testing.assert_close(taken.Ks[0], torch.tensor([[120.0, 0, 100], [0, 120, 60], [0, 0, 1]]))
    assert taken.sizes.tolist() == [[200, 120]] and not taken.distortion.any()
