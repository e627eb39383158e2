"""Discovery of objects without prompts; mask proposals are computed from true labels instead of by a network."""

from dataclasses import dataclass, replace

import pytest
import torch

from stages.core.perception.support import find_support
from stages.core.perception.voting import ViewFootprint, apply_votes, collect_votes
from stages.core.scene.scene import Scene
from stages.segment.discovery import discover_objects, is_on_support, match_labels, remove_nested_masks
from stages.segment.options import SegmentOptions
from stages.segment.view_images import ViewImages, view_images
from tests.segment.tabletop import best_overlap, three_apart

SIDE = 64  # side of the proposed masks [px]


@pytest.fixture(scope="module")
def truth():
    return three_apart(noise=0.001)


@pytest.fixture(scope="module")
def support(truth):
    return find_support(truth)


@pytest.fixture(scope="module")
def true_labels(truth):
    return [visible_objects(truth, view) for view in range(len(truth.cameras))]


def visible_objects(scene: Scene, view: int) -> torch.Tensor:
    """The object in each pixel of a view."""
    front = ViewFootprint.of(scene, view).front
    return torch.where(front >= 0, scene.gaussians.object_id[front.clamp_min(0).long()], 0)


def downsample(image: torch.Tensor) -> torch.Tensor:
    """Reduce labels 0 to 3 to SIDE x SIDE pixels."""
    masks = torch.stack([image == i for i in range(4)]).float()
    small = torch.nn.functional.interpolate(masks[None], (SIDE, SIDE), mode="area")[0] > 0.5
    return small.float().argmax(0)


@dataclass
class OracleTracker:
    """Proposes true and wrong masks, and tracks the true object of a mask through at most `max_distance` photos."""

    scene: Scene
    images: ViewImages
    label_images: list[torch.Tensor]
    max_distance: int = 100

    def proposals(self, row: int) -> torch.Tensor:
        """All objects, the upper half of each, the table, the whole image, and a small piece of the table."""
        ids = downsample(self.label_images[row])
        whole = [ids == i for i in range(4)]
        upper = torch.arange(SIDE)[:, None] < SIDE // 2
        piece = torch.zeros(SIDE, SIDE, dtype=torch.bool)
        piece[10:20, 30:40] = ids[10:20, 30:40] == 0
        masks = torch.stack([piece, ids >= 0, *(mask & upper for mask in whole[1:]), *whole])
        return masks[masks.flatten(1).any(1)]

    def labels(self, prompts: torch.Tensor, start: int):
        objects = [int(downsample(self.label_images[start])[mask].mode().values) for mask in prompts]
        for row, image in enumerate(self.label_images):
            out = torch.zeros_like(image)
            for number, i in enumerate(objects, start=1):
                if abs(row - start) <= self.max_distance:
                    out[image == i] = number
            yield row, out


@pytest.fixture
def oracle(truth, true_labels):
    return OracleTracker(truth, view_images(truth), list(true_labels))


def overlaps(truth, found) -> dict[int, float]:
    blank = replace(truth, gaussians=replace(truth.gaussians, object_id=torch.zeros_like(truth.gaussians.object_id)))
    ids = apply_votes(blank, collect_votes(blank, found.items()), {}, "test").gaussians.object_id
    return best_overlap(ids, truth.gaussians.object_id)


def test_only_masks_of_whole_objects_on_the_table_are_kept(oracle, truth, support):
    found = discover_objects(oracle, support, SegmentOptions())
    assert max(int(labels.max()) for labels in found.values()) == 3
    assert min(overlaps(truth, found).values()) > 0.9


def test_lost_object_is_found_again_under_its_number(oracle, truth, support):
    oracle.max_distance = 2  # each searched photo then proposes all three objects again
    found = discover_objects(oracle, support, SegmentOptions())
    assert max(int(labels.max()) for labels in found.values()) == 3
    assert min(overlaps(truth, found).values()) > 0.9


def test_object_hidden_in_the_first_view_is_found_later(oracle, truth, support):
    first = oracle.label_images[0]
    oracle.label_images[0] = torch.where(first == 2, 0, first)
    found = discover_objects(oracle, support, SegmentOptions())
    assert max(int(labels.max()) for labels in found.values()) == 3
    assert min(overlaps(truth, found).values()) > 0.9


def test_max_objects_keeps_the_largest(oracle, support):
    found = discover_objects(oracle, support, SegmentOptions(max_objects=1))
    assert max(int(labels.max()) for labels in found.values()) == 1
    areas = [int((oracle.label_images[0] == i).sum()) for i in (1, 2, 3)]
    largest = oracle.label_images[0] == 1 + areas.index(max(areas))
    assert torch.equal(found[0] > 0, largest)


def test_is_on_support(truth, support):
    ids = truth.gaussians.object_id
    for i in (1, 2, 3):
        assert is_on_support(truth, torch.nonzero(ids == i)[:, 0], support, SegmentOptions())
        assert is_on_support(truth, torch.nonzero(ids == i)[:, 0], None, SegmentOptions())
    assert not is_on_support(truth, torch.nonzero(ids == 0)[:, 0], support, SegmentOptions())  # the table
    assert not is_on_support(truth, torch.nonzero(ids == 1)[:5, 0], support, SegmentOptions())  # too few pixels
    assert not is_on_support(truth, torch.nonzero(ids == 1)[:, 0], support, SegmentOptions(min_size=0.5))
    assert not is_on_support(truth, torch.full((100,), -1), support, SegmentOptions())  # empty pixels
    for distance, near in ((0.75, True), (0.85, False)):  # without a table, the limit is 0.8 of the cameras' distance
        moved = replace(truth.gaussians, means=truth.gaussians.means.clone())
        rows = torch.nonzero(ids == 1)[:, 0]
        side = moved.means[rows] - moved.means[rows].median(0).values
        moved.means[rows] = support.view.focus + torch.tensor([distance * support.view.radius, 0, 0]) + 0.1 * side
        assert is_on_support(replace(truth, gaussians=moved), rows, None, SegmentOptions(min_size=1e-3)) == near
    lifted = truth.gaussians.means + torch.tensor([0, 0, 0.6]) * (ids == 1)[:, None]
    high = replace(truth, gaussians=replace(truth.gaussians, means=lifted))
    assert not is_on_support(high, torch.nonzero(ids == 1)[:, 0], support, SegmentOptions())


def test_masks_inside_larger_ones_are_removed():
    masks = torch.zeros(4, 1, 20, dtype=torch.bool)
    masks[0, 0, :3] = True  # inside the next mask
    masks[1, 0, :10] = True
    masks[2, 0, 8:12] = True  # half of it is inside the second mask
    masks[3, 0, 8:13] = True  # 2/5 of it are inside the second mask, and the third one is inside this one
    assert torch.equal(remove_nested_masks(masks), masks[[1, 3]])
    assert remove_nested_masks(masks[:0]).shape == (0, 1, 20)


def test_masks_of_one_size_keep_their_order():
    """Sorting is not stable by default; for hundreds of values, its order depends on the processor."""
    masks = torch.eye(300, dtype=torch.bool).flip(0)[:, None]
    assert torch.equal(remove_nested_masks(masks), masks)


def test_numbers_of_new_labels():
    old = {0: torch.tensor([[1, 1, 2, 2, 0, 0]]), 1: torch.tensor([[0, 0, 0, 0, 0, 0]])}
    fresh = {0: torch.tensor([[2, 2, 0, 0, 1, 1]]), 1: torch.tensor([[2, 2, 2, 2, 2, 3]])}
    # the second label covers object 1 in the only photo that contains both; the others are new
    assert match_labels(fresh, old, new=3, count=2).tolist() == [0, 3, 1, 4]
    assert match_labels(fresh, {}, new=3, count=0).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("covered", "known"), [(3, True), (2, False), (1, False)])
def test_a_label_is_an_object_of_which_it_covers_more_than_half(covered, known):
    """The object has four pixels; views in which the object is not visible are ignored."""
    labels = torch.ones(2, 2, dtype=torch.int64)
    old = torch.zeros(4, dtype=torch.int64)
    old[:covered] = 2
    unseen = torch.zeros(2, 2, dtype=torch.int64)
    found = match_labels({0: labels, 1: labels, 2: labels}, {0: old.reshape(2, 2), 1: unseen}, new=1, count=2)
    assert found.tolist() == [0, 2 if known else 3]
    one = torch.ones(1, 1, dtype=torch.int64)
    assert match_labels({0: one}, {0: 2 * one}, new=1, count=2).tolist() == [0, 2]
