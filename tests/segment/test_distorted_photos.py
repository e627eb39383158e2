"""Label images, boxes and photos in pixels of photos taken with a strongly distorting lens."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import intrinsics, orbit, project
from stages.core.raster.rasterise import rasterise, visibility
from stages.core.scene.cameras import Cameras, PhotoIntrinsics
from stages.core.scene.images import resize, write_labels, write_png
from stages.segment.boxes import segment as segment_by_boxes
from stages.segment.masks import segment as segment_by_masks
from stages.segment.options import SegmentOptions
from stages.segment.view_images import view_images
from tests.segment.tabletop import best_overlap, block, egg, scene_of, table_gaussians

SIDE, PHOTO_SIDE = 160, 200
LENS = [-0.25, 0.0, 0.0, 0.0, 0.0]


@pytest.fixture(scope="module")
def truth():
    """Three objects at a short distance, near the borders of the images."""
    scene = scene_of(
        table_gaussians(), block((-0.25, -0.15), (0.12, 0.1, 0.08), (0.8, 0.1, 0.1), 1),
        egg((0.25, -0.15, 0.07), (0.06, 0.06, 0.07), (0.1, 0.2, 0.8), 2),
        block((0.02, 0.28), (0.08, 0.08, 0.16), (0.1, 0.6, 0.2), 3),
    )  # fmt: skip
    count = 8
    viewmats = orbit(count, torch.tensor([0.0, 0.0, 0.02]), 0.75, 40.0)
    photos = PhotoIntrinsics(
        intrinsics(PHOTO_SIDE, PHOTO_SIDE, 170.0).expand(count, 3, 3).clone(),
        torch.full((count, 2), PHOTO_SIDE), torch.tensor([LENS]).expand(count, 5).clone(),
    )  # fmt: skip
    K, names = intrinsics(SIDE, SIDE, 125.0), tuple(f"{i:02d}.jpg" for i in range(count))
    return replace(scene, cameras=Cameras(viewmats, K.expand(count, 3, 3).clone(), torch.full((count, 2), SIDE), names,
                                          photos))  # fmt: skip


def blank(scene):
    return replace(scene, gaussians=replace(scene.gaussians, object_id=torch.zeros_like(scene.gaussians.object_id)))


def without_lens(scene):
    photos = replace(scene.cameras.photos, distortion=torch.zeros_like(scene.cameras.photos.distortion))
    return replace(scene, cameras=replace(scene.cameras, photos=photos))


def photographed(scene, view: int, draw) -> torch.Tensor:
    """The image rendered by `draw(viewmat, K, side)`, distorted by the lens of the photo, by nearest neighbour."""
    K = scene.cameras.photos.Ks[view].double().numpy()
    at = np.stack(np.meshgrid(*[np.arange(PHOTO_SIDE) + 0.5] * 2), -1).reshape(-1, 2)
    rays = (at - K[:2, 2]) / K[[0, 1], [0, 1]]
    x = rays
    for _ in range(60):
        x = rays / (1 + LENS[0] * (x**2).sum(1, keepdims=True))
    side, focal = 600, 350.0
    index = np.clip(np.floor(x * focal + side / 2), 0, side - 1).astype(int)
    wide = draw(scene.cameras.viewmats[view], intrinsics(side, side, focal), side)
    return wide[index[:, 1], index[:, 0]].reshape(PHOTO_SIDE, PHOTO_SIDE, *wide.shape[2:])


def label_image(scene, view: int) -> torch.Tensor:
    def draw(viewmat, K, side):
        front = visibility(scene.gaussians, viewmat, K, side, side).index
        return torch.where(front >= 0, scene.gaussians.object_id[front.clamp_min(0).long()], 0)

    return photographed(scene, view, draw)


def photo(scene, view: int) -> torch.Tensor:
    return photographed(
        scene, view, lambda V, K, side: rasterise(scene.gaussians, V[None], K[None], side, side).rgb[0].clamp(0, 1)
    )


def mask_overlaps(scene, folder, **options) -> list[float]:
    found = segment_by_masks(blank(scene), SegmentOptions(masks=folder, **options))
    return list(best_overlap(found.gaussians.object_id, scene.gaussians.object_id).values())


def test_label_images_of_photos_are_undistorted(truth, tmp_path):
    for i in range(len(truth.cameras)):
        write_labels(tmp_path / f"{i:02d}.png", label_image(truth, i))
    with_lens, without = mask_overlaps(truth, tmp_path), mask_overlaps(without_lens(truth), tmp_path)
    assert min(with_lens) > 0.92 > min(without) and sum(with_lens) > sum(without) + 0.1


def test_label_images_of_undistorted_views_are_used_as_they_are(truth, tmp_path):
    for i in range(3):
        front = visibility(truth.gaussians, truth.cameras.viewmats[i], truth.cameras.Ks[i], SIDE, SIDE).index
        write_labels(tmp_path / f"{i:02d}.png", truth.gaussians.object_id[front.clamp_min(0).long()] * (front >= 0))
    as_they_are, warped = mask_overlaps(truth, tmp_path, undistorted=True), mask_overlaps(truth, tmp_path)
    assert sum(as_they_are) > sum(warped) + 0.1


def test_photos_are_undistorted(truth, tmp_path):
    write_png(tmp_path / "01.png", photo(truth, 1))
    rendered = view_images(truth).image(1)
    read = view_images(truth, tmp_path).image(1)  # the photo has more pixels than the view
    assert read.shape == (PHOTO_SIDE, PHOTO_SIDE, 3)
    bent = view_images(truth, tmp_path, undistorted=True).image(1)
    error, bent_error = ((resize(x, SIDE, SIDE) - rendered).square().mean() for x in (read, bent))
    assert error < 0.4 * bent_error


def test_boxes_in_pixels_of_the_photo(truth, tmp_path):
    rows, views = [], truth.cameras
    for i in (1, 2, 3):
        means = truth.gaussians.means[truth.gaussians.object_id == i]
        x = project(means, views.viewmats[0], torch.eye(3))
        bent = x * (1 + LENS[0] * x.square().sum(1, keepdim=True))
        pixels = bent * views.photos.Ks[0, 0, 0] + views.photos.Ks[0, :2, 2]
        rows.append([*(pixels.amin(0) - 2).tolist(), *(pixels.amax(0) + 2).tolist()])
    (tmp_path / "p.json").write_text(json.dumps({"bbox": rows}))
    found = segment_by_boxes(blank(truth), SegmentOptions(boxes=tmp_path / "p.json")).gaussians.object_id
    assert min(best_overlap(found, truth.gaussians.object_id).values()) > 0.85
    twice = {"bbox": [[2 * x for x in row] for row in rows], "size": [2 * PHOTO_SIDE, 2 * PHOTO_SIDE]}
    (tmp_path / "p.json").write_text(json.dumps(twice))
    same = segment_by_boxes(blank(truth), SegmentOptions(boxes=tmp_path / "p.json")).gaussians.object_id
    assert (same != found).float().mean() < 1e-3


def test_opencv_bends_the_same_way():
    """The formula used above is that of k1 in OpenCV."""
    x = np.array([[0.3, -0.4, 1.0]])
    pixel, _ = cv2.projectPoints(x, np.zeros(3), np.zeros(3), np.eye(3), np.array(LENS))
    np.testing.assert_allclose(pixel[0, 0], x[0, :2] * (1 + LENS[0] * 0.25))


def test_undistorted_without_images_is_refused():
    with pytest.raises(InputError, match="--undistorted: only applies to --masks, --boxes, --points, --photos"):
        SegmentOptions(undistorted=True)
