"""Object crops: the warped photo equals the view of a rotated camera that has the pose of the network's camera."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres, intrinsics, look_at, orbit, project
from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity
from stages.core.models.diffsplat.maps import FOCAL, cameras
from stages.core.raster.rasterise import rasterise
from stages.core.scene.cameras import Cameras, PhotoIntrinsics
from stages.core.scene.images import read_image, write_png
from stages.core.scene.scene import Scene, SceneObject
from stages.refine.library import opaque_gaussians, transformed
from stages.refine.object_crop import CROP_FILL, crop_object
from stages.refine.upscale import upscaled
from tests.refine.sample_objects import asymmetric_object
from tests.segment.tabletop import scene_of, table_gaussians

SIDE = 96
PLACE = Similarity(0.3, matrix(torch.tensor([0.9, 0.0, 0.0, 0.4])), torch.tensor([0.08, -0.05, 0.04]))


@pytest.fixture(scope="module")
def scene() -> Scene:
    """An object on a table, off-centre in all views; one view has an elevation of 85 degrees, the others 25."""
    viewmats = orbit(6, torch.tensor([0.0, 0, 0.1]), 1.0, 25.0)
    steep = orbit(1, torch.tensor([0.0, 0, 0.1]), 0.8, 85.0)
    K = intrinsics(320, 240, 340.0)
    many = Cameras(torch.cat([viewmats, steep]), K.expand(7, 3, 3).clone(), torch.tensor([[320, 240]] * 7),
                   tuple(f"{i}.jpg" for i in range(7)))  # fmt: skip
    made = scene_of(table_gaussians(0.02), transformed(asymmetric_object(0.02), PLACE))
    return replace(made, objects=(SceneObject(1, "thing"),), cameras=many)


@pytest.fixture(scope="module")
def photos(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    c = scene.cameras
    for viewmat, K, name in zip(c.viewmats, c.Ks, c.names, strict=True):
        drawn = rasterise(scene.gaussians, viewmat[None], K[None], 320, 240).rgb[0]
        write_png(folder / name.replace("jpg", "png"), drawn)
    return folder


@pytest.fixture(scope="module")
def shown(scene, photos):
    return crop_object(scene, opaque_gaussians(scene, 1), SIDE, photos)


def outline(image) -> tuple[float, float, float, float]:
    rows, columns = torch.nonzero((image < 0.9).any(2), as_tuple=True)
    return float(columns.min()), float(rows.min()), float(columns.max() + 1), float(rows.max() + 1)


def test_object_is_alone_centred_and_fills_the_crop(shown):
    left, top, right, bottom = outline(shown.image)
    assert max(right - left, bottom - top) == pytest.approx(CROP_FILL * SIDE, abs=3)
    assert (left + right) / 2 == pytest.approx(SIDE / 2, abs=2) and (top + bottom) / 2 == pytest.approx(SIDE / 2, abs=2)
    assert bool((shown.image[[0, 0, -1, -1], [0, -1, 0, -1]] == 1).all())


def test_rotated_photo_equals_the_view_of_a_rotated_camera(scene, shown):
    """It is compared with a rendering of the object alone, by a camera rotated towards place(0)."""
    eye = centres(scene.cameras.viewmats[int(shown.name[0])][None])[0]
    viewmat, distance = look_at(eye, shown.place.translation), float((eye - shown.place.translation).norm())
    focal = FOCAL * SIDE * distance / (1.4 * shown.place.scale)
    own = scene.gaussians[scene.gaussians.object_id == 1]
    K = intrinsics(4 * SIDE, 4 * SIDE, 4 * focal)
    white = torch.ones(3)
    fine = rasterise(own, viewmat[None], K[None], 4 * SIDE, 4 * SIDE, white).rgb[0]
    direct = torch.nn.functional.avg_pool2d(fine.permute(2, 0, 1), 4).permute(1, 2, 0)
    error = (direct - shown.image).square().mean()
    assert -10 * math.log10(error) > 27  # the photo has a lower resolution than the crop


def test_photos_as_taken_are_mapped_to_the_views(scene, photos, shown, tmp_path):
    """The photos have a border around the view, which their stored intrinsics describe."""
    border = 40
    for file in photos.iterdir():
        image = read_image(file)
        padded = torch.zeros(image.shape[0] + 2 * border, image.shape[1] + 2 * border, 3)
        padded[border:-border, border:-border] = image
        write_png(tmp_path / file.name, padded)
    c = scene.cameras
    Ks = c.Ks + border * torch.tensor([[0.0, 0, 1], [0, 0, 1], [0, 0, 0]])
    taken = PhotoIntrinsics(Ks, c.sizes + 2 * border, torch.zeros(len(c), 5))
    bordered = replace(scene, cameras=replace(c, photos=taken))
    crop = crop_object(bordered, opaque_gaussians(scene, 1), SIDE, tmp_path)
    assert crop.name == shown.name and (crop.image - shown.image).abs().mean() < 2e-3


def test_crop_without_photos_is_rendered(scene, shown):
    drawn = crop_object(scene, opaque_gaussians(scene, 1), SIDE)
    assert -10 * math.log10((drawn.image - shown.image).square().mean()) > 25
    assert drawn.elevation == pytest.approx(shown.elevation)


def test_crop_camera_is_the_first_camera_of_the_network(scene, shown):
    """Points near the object's centre have the same pixels in the scene's camera and in DiffSplat's first camera."""
    eye = centres(scene.cameras.viewmats[int(shown.name[0])][None])[0]
    middle = shown.place.translation
    up = (eye - middle)[2] / (eye - middle).norm()
    assert shown.elevation == pytest.approx(math.degrees(math.asin(up)), abs=1e-3)
    near = 0.01 * torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    focal = FOCAL * SIDE * float((eye - middle).norm()) / (1.4 * shown.place.scale)
    theirs = project(near, cameras(shown.elevation)[0], intrinsics(SIDE, SIDE, FOCAL * SIDE))
    ours = project(shown.place(near), look_at(eye, middle), intrinsics(SIDE, SIDE, focal))
    assert (theirs - SIDE / 2).norm(dim=1).max() > 1
    torch.testing.assert_close(theirs, ours, rtol=0, atol=0.03)


def test_steep_and_cropped_views_are_not_chosen(scene, photos):
    cut = scene.cameras.viewmats.clone()
    others = [i for i in range(6) if i != 2]
    cut[others, 0, 3] += 0.55  # the object is cropped in all views but one
    off, own = replace(scene, cameras=replace(scene.cameras, viewmats=cut)), opaque_gaussians(scene, 1)
    assert crop_object(off, own, SIDE, photos).name == "2.jpg"
    for few in (scene.cameras[[6]], None):
        assert crop_object(replace(scene, cameras=few), own, SIDE) is None


def test_photos_of_another_scene_are_refused(scene, tmp_path):
    write_png(tmp_path / "other.png", torch.zeros(4, 4, 3))
    with pytest.raises(InputError, match="contains no photo of the scene, such as 0.jpg"):
        crop_object(scene, opaque_gaussians(scene, 1), SIDE, tmp_path)


def test_upscaled_crop_is_the_restored_image_at_the_generators_size(scene, photos, shown):
    """It is restored at three times the size and averaged; its camera and pose are those of the plain crop."""
    large, calls = crop_object(scene, opaque_gaussians(scene, 1), 3 * SIDE, photos), []
    tint = torch.tensor([0.0, 0.1, 0.2])

    def restore(image, prompt, seed):
        calls.append((image, prompt, seed))
        return (image - tint).clamp(0, 1)

    made = upscaled(large, SimpleNamespace(restore=restore), SIDE, "thing", 5)
    assert [call[1:] for call in calls] == [("thing", 5)] and torch.equal(calls[0][0], large.image)
    assert made.image.shape == (SIDE, SIDE, 3) and made.coverage.shape == (SIDE, SIDE)
    outside, inside = made.coverage == 0, made.coverage > 0.99
    assert bool((made.image[outside] == 1).all()) and int(outside.sum()) > 1000
    expected = (large.image - tint).clamp(0, 1).reshape(SIDE, 3, SIDE, 3, 3).mean((1, 3))
    torch.testing.assert_close(made.image[inside], expected[inside])
    torch.testing.assert_close(made.K, shown.K, rtol=0.02, atol=0)
    assert (made.image[inside] + tint - shown.image[inside]).abs().mean() < 0.03
    assert made.place.scale == pytest.approx(shown.place.scale, rel=0.02)
