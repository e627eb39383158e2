"""Realistic photo sets: cameras are found, or the error states what to change."""

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres, intrinsics, orbit
from stages.core.geometry.similarity import umeyama
from stages.core.scene.cameras import Cameras
from stages.reconstruct import sfm
from stages.reconstruct.colmap import colmap_process
from stages.reconstruct.photos import Photos
from tests.reconstruct.raycast import arc, photograph, rays_of, texture, with_mirror


@pytest.fixture(scope="module", autouse=True)
def one_process() -> Iterator[None]:
    """A common COLMAP process for all tests, each of which would otherwise start one."""
    with colmap_process():
        yield


def as_photos(images: list[torch.Tensor], names: tuple[str, ...], folder) -> Photos:
    images = tuple((image * 255).round().to(torch.uint8) for image in images)
    return Photos(images, names, (0.0,) * len(images), folder)


def noisy(image: torch.Tensor, seed: int) -> torch.Tensor:
    return (image + 0.01 * torch.randn(image.shape, generator=torch.Generator().manual_seed(seed))).clamp(0, 1)


def with_person(image: torch.Tensor, seed: int) -> torch.Tensor:
    """Cover a fifth of the photo, at a random position, by a pattern that is in no other photo."""
    height, width = image.shape[:2]
    h, w = height // 2, width * 2 // 5
    generator = torch.Generator().manual_seed(seed)
    top, left = (int(torch.randint(0, n, (), generator=generator)) for n in (height - h, width - w))
    v, u = torch.meshgrid(torch.linspace(-1, 1, h), torch.linspace(-1, 1, w), indexing="ij")
    out = image.clone()
    out[top : top + h, left : left + w] = texture(u, v, seed=100 + seed)
    return out


def max_position_error(model: sfm.SparseModel, true) -> float:
    """Largest distance of a camera from its true position after alignment [scene units]."""
    rows = [true.names.index(name) for name in model.cameras.names]
    found, there = centres(model.cameras.viewmats), centres(true.viewmats)[rows]
    return float((umeyama(found, there)(found) - there).norm(dim=1).max())


def test_two_photos_are_enough_for_cameras(tmp_path):
    true = arc(2, (320, 240), sweep=30.0)
    model = sfm.estimate_cameras(as_photos([photograph(true, i)[0] for i in range(2)], true.names, tmp_path))
    assert len(model.cameras) == 2 and len(model.points) >= 50


def test_a_focal_length_that_starts_far_off_is_found_from_another_start(tmp_path, monkeypatch):
    true = arc(6, (320, 240))
    photos = as_photos([photograph(true, i)[0] for i in range(6)], true.names, tmp_path)

    def focal_error(*starts: float) -> float:
        monkeypatch.setattr(sfm, "FOCAL_STARTS", starts)
        Ks = sfm.estimate_cameras(photos).cameras.Ks
        return float((Ks[:, 0, 0] / true.Ks[: len(Ks), 0, 0] - 1).abs().max())

    assert focal_error(10.0) > 1
    assert focal_error(10.0, 1.2) < 0.03 and focal_error(1.2, 10.0) < 0.03


def test_many_photos_and_those_with_a_known_focal_length_are_mapped_once(tmp_path, monkeypatch):
    true, runs, mapped = arc(4, (320, 240), sweep=40.0), [], sfm._mapped
    monkeypatch.setattr(sfm, "_mapped", lambda *given: runs.append(0) or mapped(*given))
    photos = as_photos([photograph(true, i)[0] for i in range(4)], true.names, tmp_path)
    sfm.estimate_cameras(photos)
    sfm.estimate_cameras(replace(photos, focals=(float(true.Ks[0, 0, 0]),) * 4))
    assert len(runs) == 2 + 1
    monkeypatch.setattr(sfm, "MAX_MAPPED_TWICE", 3)
    sfm.estimate_cameras(photos)
    assert len(runs) == 2 + 1 + 1


def test_photos_with_few_points_are_added_where_most_would_be_left_out(tmp_path, monkeypatch):
    true = arc(5, (320, 240), sweep=60.0)
    photos = as_photos([photograph(true, i)[0] for i in range(5)], true.names, tmp_path)
    monkeypatch.setattr(sfm, "MIN_POINTS", (10_000,))  # more than there are
    with pytest.raises(InputError):
        sfm.estimate_cameras(photos)
    monkeypatch.setattr(sfm, "MIN_POINTS", (10_000, 15))
    model = sfm.estimate_cameras(photos)
    assert len(model.cameras) == 5
    assert max_position_error(model, true) < 0.03


def test_of_models_with_as_many_photos_that_of_the_smaller_error_is_better():
    def model(photos: int, error: float) -> SimpleNamespace:
        return SimpleNamespace(num_reg_images=lambda: photos, compute_mean_reprojection_error=lambda: error)

    assert sfm._quality(model(20, 0.8)) > sfm._quality(model(20, 1.27)) > sfm._quality(model(12, 0.5))


def test_people_walking_through(tmp_path):
    true = arc(6, (320, 240))
    images = [photograph(true, i)[0] for i in range(6)]
    crowded = [with_person(image, i) if i % 2 else image for i, image in enumerate(images)]
    model = sfm.estimate_cameras(as_photos(crowded, true.names, tmp_path))
    assert len(model.cameras) == 6
    assert max_position_error(model, true) < 0.03  # the cameras are 1.6 away


def test_blank_and_unrelated_photos_are_dropped_with_reason(tmp_path):
    true = arc(4, (320, 240), sweep=40.0)
    images = [photograph(true, i)[0] for i in range(4)]
    v, u = torch.meshgrid(torch.linspace(-1, 1, 240), torch.linspace(-1.3, 1.3, 320), indexing="ij")
    others = [torch.full((240, 320, 3), 0.5), texture(u, v, seed=9)]
    names = (*true.names, "blank.png", "elsewhere.png")
    model = sfm.estimate_cameras(as_photos([*images, *others], names, tmp_path))
    assert model.cameras.names == true.names
    assert set(model.dropped) == {"blank.png", "elsewhere.png"}
    assert "blurred, dark or plain" in model.dropped["blank.png"]


def test_stationary_camera_is_refused(tmp_path):
    # as on a turntable in front of a patterned wall, whose matches do not move
    true = arc(1, (320, 240))
    still = photograph(true, 0)[0]
    images = [with_person(noisy(still, i), i) for i in range(5)]
    with pytest.raises(InputError, match="camera hardly moved between the photos; walk around.*plain backdrop"):
        sfm.estimate_cameras(as_photos(images, tuple("abcde"), tmp_path))


def arc_around(count: int, sweep: float, distance: float = 1.4) -> Cameras:
    """Cameras on a horizontal arc around the block, centred at the direction of the x axis."""
    size = torch.tensor((400, 300)).expand(count, 2).clone()
    viewmats = orbit(count, torch.tensor([0.0, 0.0, 0.1]), distance, elevation=30.0, azimuth=-sweep / 2, sweep=sweep)
    return Cameras(viewmats, intrinsics(400, 300, 480.0).expand(count, 3, 3).clone(), size, tuple("abcdefgh"[:count]))


def test_turntable_before_a_plain_backdrop(tmp_path):
    true = arc_around(6, sweep=60.0, distance=0.9)
    images = []
    for i in range(6):
        image, depth = photograph(true, i)
        eye, rays = rays_of(true, i)
        on_block = (eye + depth[..., None] * rays)[..., 2] > 1e-4
        images.append(torch.where(on_block[..., None], image, torch.tensor(0.8)))
    model = sfm.estimate_cameras(as_photos(images, true.names, tmp_path))
    assert model.cameras.names == true.names and max_position_error(model, true) < 0.05


def test_mirror_in_the_scene(tmp_path):
    # a fifth of each photo is a sharp mirror image of the block
    true = arc_around(6, sweep=75.0)
    model = sfm.estimate_cameras(as_photos([with_mirror(true, i) for i in range(6)], true.names, tmp_path))
    assert model.cameras.names == true.names and max_position_error(model, true) < 0.03
    align = umeyama(centres(model.cameras.viewmats), centres(true.viewmats))
    assert (align(model.points)[:, 0] < -0.6).sum() > 20  # points behind the mirror


def test_duplicate_photos(tmp_path):
    true = arc(4, (320, 240), sweep=40.0)
    images = [image for i in range(4) for image in [photograph(true, i)[0]] * 2]
    model = sfm.estimate_cameras(as_photos(images, tuple("abcdefgh"), tmp_path))
    twice = Cameras(*(t.repeat_interleave(2, 0) for t in (true.viewmats, true.Ks, true.sizes)), tuple("abcdefgh"))
    assert len(model.cameras) == 8 and max_position_error(model, twice) < 0.03


def test_photos_of_different_objects_are_refused(tmp_path):
    v, u = torch.meshgrid(torch.linspace(-1, 1, 120), torch.linspace(-1.3, 1.3, 160), indexing="ij")
    images = [texture(u, v, seed=20 + i) for i in range(4)]
    with pytest.raises(InputError, match="no two photos show the same|overlap too little"):
        sfm.estimate_cameras(as_photos(images, tuple("abcd"), tmp_path))


def test_photos_of_two_places_give_the_larger_set(tmp_path):
    # as in a video with a cut: four photos of one place, three of another
    first, second = arc(4, (320, 240), sweep=40.0), arc(3, (320, 240), sweep=30.0)
    images = [photograph(first, i)[0] for i in range(4)]
    images += [1 - photograph(second, i)[0].flip(0, 1) for i in range(3)]  # rotated negatives, which have no matches
    names = tuple(f"{i}.png" for i in range(7))
    model = sfm.estimate_cameras(as_photos(images, names, tmp_path))
    assert model.cameras.names == names[:4]
    assert set(model.dropped) == set(names[4:])
    assert all("match each other" in why or "nothing that matches" in why for why in model.dropped.values())
