"""Conversion of photos to undistorted views: images, label images, points and boxes, compared with OpenCV."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import intrinsics
from stages.core.scene.cameras import Cameras, PhotoIntrinsics
from stages.core.scene.lens import Undistortion

SIZE = (320, 240)
LENSES = {"barrel": [-0.25, 0, 0, 0, 0], "all": [-0.2, 0.05, 0.01, -0.008, 0.002]}


def camera(distortion: list[float], size: tuple[int, int] = SIZE) -> Cameras:
    """One camera with a distorted photo of `size` and an off-centre principal point; its view is smaller."""
    K = torch.tensor([[260.0, 0, 165], [0, 255, 118], [0, 0, 1]])
    K = K * torch.tensor([[size[0] / SIZE[0]], [size[1] / SIZE[1]], [1.0]])
    view_K = intrinsics(160, 120, 125.0)
    photos = PhotoIntrinsics(K[None], torch.tensor([size]), torch.tensor([distortion]))
    return Cameras(torch.eye(4)[None], view_K[None], torch.tensor([[160, 120]]), ("a.jpg",), photos)


def scene_labels(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Labels of a wall at z = 1 with a disc in the centre, a box in a corner and a bar along the bottom."""
    out = np.zeros(x.shape, np.int64)
    out[(x - 0.05) ** 2 + y**2 < 0.15**2] = 1
    out[(x > 0.35) & (x < 0.55) & (y < -0.2) & (y > -0.42)] = 2
    out[(y > 0.36) & (y < 0.44) & (abs(x) < 0.5)] = 3
    return out


def grid(width: int, height: int) -> np.ndarray:
    """Pixel centres (h, w, 2), which have an offset of 0.5."""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)


def photographed(cameras: Cameras, size: tuple[int, int]) -> torch.Tensor:
    """The label image of the distorted photo at any size, with directions computed by OpenCV."""
    factor = torch.tensor(size) / cameras.photos.sizes[0]
    K = (cameras.photos.Ks[0] * torch.cat([factor, torch.ones(1)])[:, None]).double().numpy()
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    at = grid(*size).reshape(-1, 1, 2)  # pixel centres and K both have the offset of 0.5
    invert = getattr(cv2, "undistortPointsIter", None)  # exists in OpenCV 4
    lens = cameras.photos.distortion[0].double().numpy()
    xy = invert(at, K, lens, None, None, criteria) if invert else cv2.undistortPoints(at, K, lens, criteria=criteria)
    xy = xy.reshape(size[1], size[0], 2)
    return torch.from_numpy(scene_labels(xy[..., 0], xy[..., 1]))


def viewed(cameras: Cameras) -> torch.Tensor:
    """The true label image of the undistorted view."""
    K = cameras.Ks[0].numpy()
    xy = (grid(*cameras.sizes[0].tolist()) - K[:2, 2]) / K[[0, 1], [0, 1]]
    return torch.from_numpy(scene_labels(xy[..., 0], xy[..., 1]))


def iou(a: torch.Tensor, b: torch.Tensor) -> list[float]:
    return [float(((a == i) & (b == i)).sum() / ((a == i) | (b == i)).sum()) for i in (1, 2, 3)]


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
@pytest.mark.parametrize("size", [(640, 480), (1280, 960)])
def test_label_image_through_a_lens_fits_after_warping_only(lens, size):
    cameras = camera(lens)
    given, truth = photographed(cameras, size), viewed(cameras)
    assert min(iou(Undistortion.of(cameras, 0, size).labels(given), truth)) > 0.97
    plain = replace(cameras, photos=replace(cameras.photos, distortion=torch.zeros(1, 5)))
    assert min(iou(Undistortion.of(plain, 0, size).labels(given), truth)) < 0.9


def test_image_and_labels_agree():
    cameras = camera(LENSES["all"])
    given = photographed(cameras, (160, 120))
    lens = Undistortion.of(cameras, 0, (160, 120))
    image = lens.image((given == 1).float()[..., None].expand(-1, -1, 3).contiguous())
    assert image.shape == (120, 160, 3)
    assert ((image[..., 0] > 0.5) == (lens.labels(given) == 1)).float().mean() > 0.998
    assert lens.image(torch.full((120, 160, 3), 7, dtype=torch.uint8)).unique().tolist() == [7]


def test_beyond_the_edges_of_a_photo_its_outermost_pixels_continue():
    """The lens bends the edges inwards, so that the corners of the view are outside the photo."""
    image = torch.full((240, 320, 3), 0.75)
    image[:, :160] = 0.25
    lens = Undistortion.of(camera([0.25, 0, 0, 0, 0]), 0, SIZE)
    x, y = lens._map(lens.view_K, lens.view_size)
    assert (x < -1).any() and (y < -1).any() and (x > 321).any()
    seen = lens.image(image)
    assert (seen[:, :40] == 0.25).all() and (seen[:, -40:] == 0.75).all()


def test_photos_larger_than_the_view_keep_their_resolution():
    cameras = camera(LENSES["barrel"])
    assert Undistortion.of(cameras, 0, (640, 480)).image(torch.zeros(480, 640, 3)).shape == (480, 640, 3)
    assert Undistortion.of(cameras, 0, (80, 60)).image(torch.zeros(60, 80, 3)).shape == (120, 160, 3)


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_points_agree_with_opencv(lens):
    cameras = camera(lens)
    seen = torch.tensor([[20.0, 15], [80, 60], [150.5, 100.25]])  # points in the view [px]
    K, view_K = cameras.photos.Ks[0].double().numpy(), cameras.Ks[0].double().numpy()
    rays = np.pad((seen.numpy() - view_K[:2, 2]) / view_K[[0, 1], [0, 1]], ((0, 0), (0, 1)), constant_values=1.0)
    taken, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(lens))
    back = Undistortion.of(cameras, 0, SIZE).points(torch.from_numpy(taken[:, 0]).float())
    torch.testing.assert_close(back, seen, rtol=0, atol=1e-3)


def test_points_beyond_what_the_lens_shows_are_nan():
    # r (1 - r^2 / 4) is at most 0.77, so no direction is seen 1.2 focal lengths from the centre
    lens = Undistortion.of(camera(LENSES["barrel"]), 0, SIZE)
    beyond = torch.tensor([[165 + 1.2 * 260, 118.0], [165 - 1.2 * 260, 118.0], [165, 118 + 1.2 * 255]])
    assert lens.points(beyond).isnan().all()


def test_a_box_beyond_what_the_lens_shows_is_that_of_the_rest():
    cameras = camera([-1.0, 0, 0, 0, 0])  # r (1 - r^2) is at most 0.385
    lens = Undistortion.of(cameras, 0, SIZE)
    box = lens.boxes(torch.tensor([[165.0, 118.0, 320.0, 119.0]]))[0]
    # the principal point of the view
    torch.testing.assert_close(box[:2], torch.tensor([80.0, 60.0]), rtol=0, atol=1e-3)
    assert 100 < box[2] < 80 + 0.58 * 125 and box.isfinite().all()  # r is less than 1 / sqrt 3


def test_the_map_of_a_photo_without_distortion_is_that_of_its_pinhole():
    lens = Undistortion.of(camera([0.0] * 5), 0, SIZE)
    x, y = lens._map(lens.view_K, lens.view_size)
    u, v = (grid(160, 120) - (80, 60)).transpose(2, 0, 1)
    np.testing.assert_allclose(x, 260 * u / 125 + 165 - 0.5, atol=1e-3)
    np.testing.assert_allclose(y, 255 * v / 125 + 118 - 0.5, atol=1e-3)


def test_box_contains_the_edges_that_the_lens_bends():
    cameras = camera([-0.25, 0, 0, 0, 0])
    lens = Undistortion.of(cameras, 0, SIZE)
    box, corners = torch.tensor([[60.0, 40, 270, 200]]), torch.tensor([[60.0, 40], [60, 200], [270, 40], [270, 200]])
    middle = torch.tensor([[60.0, 118], [270, 118]])
    # the correction of a barrel lens moves points outwards, the corners most, so they determine the box
    found, ends = lens.boxes(box)[0], lens.points(corners)
    torch.testing.assert_close(found, torch.cat([ends.amin(0), ends.amax(0)]))
    assert found[0] < lens.points(middle)[0, 0] - 1
    # the correction of a pincushion lens moves them inwards, so the middles of the edges determine the box
    lens = Undistortion.of(camera([0.25, 0, 0, 0, 0]), 0, SIZE)
    found = lens.boxes(box)[0]
    torch.testing.assert_close(found[[0, 2]], lens.points(middle)[:, 0], rtol=0, atol=0.1)
    assert found[0] < lens.points(corners)[:, 0].min() - 0.5


def test_boxes_without_a_lens_are_scaled_exactly():
    cameras = replace(camera([0.0] * 5), photos=None)
    boxes = Undistortion.of(cameras, 0, (1600, 1200)).boxes(torch.tensor([[100.0, 50, 300, 200], [1700, 10, 1800, 20]]))
    assert boxes[0].tolist() == [10, 5, 30, 20] and boxes[1, 2] <= boxes[1, 0]  # the second box is outside


def test_image_of_the_undistorted_view_is_not_warped():
    cameras = camera(LENSES["barrel"])
    labels = viewed(cameras)
    assert torch.equal(Undistortion.of(cameras, 0, (160, 120), undistorted=True).labels(labels), labels)
    image = torch.rand(120, 160, 3)
    assert Undistortion.of(cameras, 0, (160, 120), undistorted=True).image(image) is image


def test_cropped_photo_without_distortion():
    # the view is the right half of the photo
    K = intrinsics(100, 100, 100.0)
    whole = K.clone()
    whole[0, 2] += 100
    photos = PhotoIntrinsics(whole[None], torch.tensor([[200, 100]]), torch.zeros(1, 5))
    cameras = Cameras(torch.eye(4)[None], K[None], torch.tensor([[100, 100]]), ("a.jpg",), photos)
    labels = torch.arange(200).expand(100, 200).contiguous()
    assert torch.equal(Undistortion.of(cameras, 0, (200, 100)).labels(labels), labels[:, 100:])
    assert Undistortion.of(cameras, 0, (200, 100)).points(torch.tensor([[120.0, 50]])).tolist() == [[20, 50]]


def test_another_aspect_ratio_is_refused():
    cameras = camera(LENSES["barrel"], (320, 200))  # the view is 160x120
    with pytest.raises(
        InputError, match="a.jpg is 160x120 pixels, but 320x200 in the scene; both must have the same aspect"
    ):
        Undistortion.of(cameras, 0, (160, 120))
    assert Undistortion.of(cameras, 0, (160, 120), undistorted=True).size == (160, 120)
