"""Render --ids: numbers of objects at their positions, and the legend."""

import numpy as np
import pytest
import torch

from stages.core.scene.images import read_image
from stages.core.scene.scene import SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.render.draw import object_colours
from stages.render.object_labels import add_legend, draw_labels, label_position, visible_ids
from stages.render.stage import run
from tests.render.conftest import render_options


def disc(x: float, y: float, radius: float, size: int = 100) -> np.ndarray:
    rows, columns = np.mgrid[:size, :size]
    return (columns - x) ** 2 + (rows - y) ** 2 <= radius**2


def test_label_of_a_disc_is_at_its_centre():
    assert label_position(disc(30, 60, 20)) == (30, 60)
    assert label_position(disc(0, 50, 1)) == (0, 50)


def test_label_ignores_thin_parts_and_is_inside_the_object():
    handle = disc(30, 60, 20)
    handle[60, 30:] = True
    x, y = label_position(handle)
    assert abs(x - 30) <= 1 and abs(y - 60) <= 1
    ring = disc(50, 50, 40) & ~disc(50, 50, 20)
    x, y = label_position(ring)
    assert ring[y, x]


def test_ids_are_those_of_the_front_most_objects(two_balls, device):
    ids = visible_ids(two_balls.gaussians.to(device), two_balls.cameras, 0)
    assert ids.shape == (64, 64) and ids.unique().tolist() == [0, 1, 2]
    behind = two_balls.gaussians[two_balls.gaussians.object_id != 1].to(device)
    assert 1 not in visible_ids(behind, two_balls.cameras, 0)


@pytest.mark.parametrize("colour", [(1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.8, 0.6, 0.2)])
def test_number_is_readable_on_any_colour_and_inside_its_object(colour):
    mask = torch.from_numpy(disc(50, 50, 30))
    image = torch.tensor(colour).expand(100, 100, 3)
    drawn = draw_labels(image, mask.long(), [SceneObject(1, "flat_black_object"), SceneObject(2, "hidden")])
    assert (drawn[mask] > 0.9).all(1).sum() > 10 and (drawn[mask] < 0.1).all(1).sum() > 10
    assert torch.equal(drawn[~mask], image[~mask])


def test_name_is_drawn_where_it_fits():
    def changed_columns(name: str) -> int:
        drawn = draw_labels(torch.zeros(100, 100, 3), torch.ones(100, 100).long(), [SceneObject(1, name)])
        return int((drawn > 0).any(2).any(0).sum())

    assert changed_columns("cup") > 2 * changed_columns("a name that is longer than the object")


def test_each_number_is_drawn_at_its_object(tmp_path, two_balls):
    write_scene(tmp_path / "scene.ply", two_balls)
    image = read_image(run(tmp_path / "scene.ply", tmp_path / "ids.png", render_options(view="input:0", ids=True)))
    ids = visible_ids(two_balls.gaussians, two_balls.cameras, 0)
    for number in (1, 2):
        x, y = label_position((ids == number).numpy())
        x, y = round(1.5 * x), round(1.5 * y)  # the image has 96 px instead of the camera's 64
        assert (image[y - 6 : y + 7, x - 6 : x + 7] > 0.9).all(2).any()


@pytest.mark.parametrize("count, columns", [(0, 0), (2, 1), (5, 2)])
def test_legend_has_a_swatch_for_each_object(count, columns):
    objects = [SceneObject(i, "cup") for i in range(1, count + 1)]
    image = add_legend(torch.zeros(70, 50, 3), objects)
    assert image.shape[0] == 70 and torch.equal(image[:, :50], torch.zeros(70, 50, 3))
    panel = image[:, 50:].reshape(-1, 3)
    for colour in object_colours(torch.arange(1, count + 1)):
        assert ((panel - colour).abs() < 0.01).all(1).sum() > 100
    assert (image.shape[1] - 50) % max(columns, 1) == 0 and (image.shape[1] > 50) == (count > 0)
