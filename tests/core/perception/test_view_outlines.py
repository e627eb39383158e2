"""Outlines of objects, refined by colour in the views."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.core.geometry.cameras import intrinsics, look_at, orbit
from stages.core.geometry.harmonics import C0
from stages.core.geometry.neighbours import knn
from stages.core.perception.view_outlines import MIN_PIXELS, cut_outlines, refine_outlines
from stages.core.raster.rasterise import visibility
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.toys import falling_toys


def disc(shape, middle, radius):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    return np.hypot(rows - middle[0], columns - middle[1]) < radius


def test_an_outline_within_the_band_moves_to_the_edge_of_colour():
    rng = np.random.default_rng(0)
    true = disc((120, 160), (60, 80), 25)
    colours = np.where(true[..., None], [200, 40, 30], [180, 180, 175])
    image = (colours + rng.normal(0, 4, (120, 160, 3))).astype(np.uint8)
    spread = np.where(disc((120, 160), (60, 80), 31), 3, 0)
    found = cut_outlines(image, spread, {3: 8.0}, 0)
    assert (found == 3)[true].mean() > 0.99
    assert (found == 3)[~true].sum() < 0.02 * true.sum()


def test_nothing_moves_farther_than_the_band_or_into_another_object():
    true = disc((120, 160), (60, 80), 40)
    image = np.where(true[..., None], [200, 40, 30], [180, 180, 175]).astype(np.uint8)
    labels = np.where(disc((120, 160), (60, 80), 20), 1, 0)
    labels[55:65, 102:118] = 2
    found = cut_outlines(image, labels, {1: 3.0, 2: 3.0}, 0)
    assert not (found == 1)[~disc((120, 160), (60, 80), 24.5)].any()
    assert (found == 2)[labels == 2].all()


def test_where_colours_say_nothing_the_outline_stays_within_the_band():
    image = np.full((80, 80, 3), 128, np.uint8)
    found = cut_outlines(image, np.where(disc((80, 80), (40, 40), 15), 1, 0), {1: 4.0}, 0)
    assert (found == 1)[disc((80, 80), (40, 40), 10)].all()
    assert not (found == 1)[~disc((80, 80), (40, 40), 20)].any()


def test_holes_are_filled_but_for_other_objects():
    true = disc((120, 160), (60, 80), 40)
    image = np.where(true[..., None], [200, 40, 30], [180, 180, 175]).astype(np.uint8)
    labels = np.where(true, 1, 0)
    labels[disc((120, 160), (60, 70), 12)] = 0
    labels[50:70, 90:100] = 2
    found = cut_outlines(image, labels, {1: 3.0, 2: 3.0}, 0)
    assert (found == 1)[disc((120, 160), (60, 70), 12)].all()
    assert (found == 2)[labels == 2].all()


def test_an_object_of_few_pixels_keeps_them():
    labels = np.zeros((40, 40), np.int64)
    labels[10:16, 10:16] = 1  # fewer than MIN_PIXELS
    assert (labels > 0).sum() < MIN_PIXELS
    assert (cut_outlines(np.zeros((40, 40, 3), np.uint8), labels, {1: 3.0}, 0) == labels).all()


@pytest.fixture(scope="module")
def scene():
    """Toys on a table and six cameras at a distance of 1 m."""
    eyes = orbit(6, torch.tensor([0.0, 0.0, 0.11]), 1.0, 30.0)
    Ks, sizes = intrinsics(400, 300, 475.0).expand(6, 3, 3), torch.tensor([[400, 300]] * 6)
    return replace(falling_toys(), cameras=Cameras(eyes, Ks, sizes, tuple("abcdef")))


def test_a_ring_of_table_around_each_object_is_given_back(scene):
    g, ids = scene.gaussians, scene.gaussians.object_id.clone()
    table = torch.nonzero(ids == 0)[:, 0]
    for number in range(1, 5):
        near = knn(g.means[g.object_id == number], g.means[table], 1)[0][:, 0] < 0.01
        ids[table[near]] = number
    cameras = scene.cameras
    seen = sum(visibility(g, V, K, 400, 300).weight for V, K in zip(cameras.viewmats, cameras.Ks, strict=True)) > 5
    found, wrong = refine_outlines(scene, ids), (ids > 0) & (g.object_id == 0) & seen
    assert wrong.sum() > 100
    assert (found == 0)[wrong].float().mean() > 0.95
    assert (found == g.object_id)[g.object_id > 0].float().mean() > 0.99


def panel(x, z, y, rgb, number):
    """Gaussians 0.03 m apart in a plane perpendicular to the viewing direction."""
    means = torch.stack([x.flatten(), torch.full((x.numel(),), y), z.flatten()], 1)
    n = len(means)
    quats, scales = torch.tensor([1.0, 0, 0, 0]).expand(n, 4), torch.tensor([0.02, 0.002, 0.02]).expand(n, 3)
    sh = ((torch.tensor(rgb) - 0.5) / C0).expand(n, 1, 3)
    return Gaussians(means, quats, scales, torch.full((n,), 0.95), sh, torch.full((n,), number))


def test_what_is_far_behind_a_hole_stays_there():
    x, z = torch.meshgrid(torch.arange(-2, 2, 0.03), torch.arange(-2, 2, 0.03), indexing="xy")
    wall = panel(x, z, 1.5, [0.7, 0.7, 0.7], 0)
    ring = (x.abs() < 0.5) & (z.abs() < 0.5) & ((x.abs() > 0.2) | (z.abs() > 0.2))
    thing = panel(x[ring], z[ring], 0.0, [0.8, 0.1, 0.1], 1)
    eyes = torch.tensor([[-0.05, -3.0, 0.0], [0.0, -3.0, 0.05], [0.05, -3.0, 0.0]])
    Ks = intrinsics(320, 240, 300.0).expand(3, 3, 3)
    cameras = Cameras(look_at(eyes, torch.zeros(3, 3)), Ks, torch.tensor([[320, 240]] * 3), ("a", "b", "c"))
    scene = Scene(concatenate([wall, thing]), (SceneObject(1, "ring"),), cameras)
    found, ids = refine_outlines(scene, scene.gaussians.object_id), scene.gaussians.object_id
    assert (found == 1)[ids == 1].float().mean() > 0.9
    assert not (found == 1)[ids == 0].any()


def test_without_cameras_or_objects_nothing_changes(scene):
    ids = scene.gaussians.object_id
    assert refine_outlines(replace(scene, cameras=None), ids) is ids
    nothing = torch.zeros_like(ids)
    assert refine_outlines(scene, nothing) is nothing
