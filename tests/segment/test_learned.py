"""The learned backend with the weights that the package contains."""

from dataclasses import replace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.models.segmenter.segment import find, load_segmenter
from stages.core.scene.scene import Scene
from stages.segment.learned import segment
from stages.segment.options import SegmentOptions
from tests.segment.tabletop import best_overlap, egg, scene_of, table_gaussians, three_apart


def without_labels(scene: Scene) -> Scene:
    """The scene with all Gaussians labelled as background."""
    return replace(scene, gaussians=replace(scene.gaussians, object_id=torch.zeros_like(scene.gaussians.object_id)))


def test_objects_apart_on_a_table_are_found():
    scene = three_apart(side=0.56)
    found = segment(without_labels(scene), SegmentOptions(backend="learned")).gaussians.object_id
    overlaps = best_overlap(found, scene.gaussians.object_id)
    assert min(overlaps.values()) > 0.85, overlaps


@pytest.mark.slow
def test_an_object_that_fills_the_photos_is_one():
    """The object has a height of 0.8; cameras are at a distance of one unit."""
    r = 0.4
    body = [egg((0, 0, r), (0.5 * r, 0.4 * r, r), (0.8, 0.1, 0.1), 1, 3000),
            egg((0.5 * r, 0, 1.2 * r), (0.5 * r, 0.2 * r, 0.2 * r), (0.8, 0.1, 0.1), 1)]  # fmt: skip
    scene = scene_of(table_gaussians(side=0.65, spacing=0.025), *body)
    found = segment(without_labels(scene), SegmentOptions(backend="learned")).gaussians.object_id
    assert best_overlap(found, scene.gaussians.object_id)[1] > 0.9


def test_a_bare_table_has_no_objects():
    assert not segment(scene_of(table_gaussians(side=0.5)), SegmentOptions(backend="learned")).objects


def test_weights_that_do_not_exist_are_named(tmp_path):
    with pytest.raises(InputError, match="train-segmenter"):
        find(tmp_path / "nothing.safetensors")


def test_weights_in_the_package_are_small_and_have_a_card():
    path = find()
    assert path.stat().st_size < 8e6
    assert load_segmenter(path).config["widths"]


def test_weights_are_refused_for_other_backends(tmp_path):
    with pytest.raises(InputError, match="--weights only works"):
        SegmentOptions(backend="geometric", weights=tmp_path / "w.safetensors")
