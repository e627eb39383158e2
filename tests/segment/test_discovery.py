"""Objects that nobody pointed at, with true masks, and wrong ones among them, in the place of the network's."""

from dataclasses import dataclass, replace

import pytest
import torch

from stages.core.perception.support import find_support
from stages.core.scene.scene import Scene
from stages.segment.options import SegmentOptions
from stages.segment.view_images import ViewImages, view_images
from stages.segment.voting import ViewFootprint, apply_votes, collect_votes
from tests.segment.tabletop import best_overlap, three_apart

pytest.importorskip("transformers")
from stages.core.models.sam2.mask_generation import MaskProposals  # noqa: E402
from stages.segment import discovery  # noqa: E402
from stages.segment.discovery import is_on_support, match_labels, remove_nested_masks  # noqa: E402

SIDE = 64  # of the network's masks [px]


@pytest.fixture(scope="module")
def truth():
    return three_apart(noise=0.001)


def seen(scene: Scene, view: int) -> torch.Tensor:
    """The object in each pixel of a view."""
    front = ViewFootprint.of(scene, view).front
    return torch.where(front >= 0, scene.gaussians.object_id[front.clamp_min(0).long()], 0)


def small(mask: torch.Tensor) -> torch.Tensor:
    return torch.nn.functional.interpolate(mask[None, None].float(), (SIDE, SIDE), mode="area")[0, 0] > 0.5


@dataclass
class Oracle:
    """Follows the object that most of a mask lies on, in true label images, but only through `reach` photos."""

    scene: Scene
    shown: ViewImages
    images: list[torch.Tensor]
    reach: int = 100
    model: None = None

    def pixels(self, row: int) -> int:
        return row

    def labels(self, prompts: torch.Tensor, start: int):
        objects = [int(small_ids(self.images[start])[mask].mode().values) for mask in prompts]
        for row, image in enumerate(self.images):
            out = torch.zeros_like(image)
            for number, i in enumerate(objects, start=1):
                if abs(row - start) <= self.reach:
                    out[image == i] = number
            yield row, out


def small_ids(image: torch.Tensor) -> torch.Tensor:
    return torch.stack([small(image == i) for i in range(4)]).float().argmax(0)


@pytest.fixture
def oracle(truth, monkeypatch):
    images = [seen(truth, view) for view in range(len(truth.cameras))]

    def propose(_, row: int) -> MaskProposals:
        """Every object, the upper half of each, the table, everything, and a speck of table."""
        ids = small_ids(images[row])
        wanted = [ids == i for i in range(4)]
        upper = torch.arange(SIDE)[:, None] < SIDE // 2
        speck = torch.zeros(SIDE, SIDE, dtype=torch.bool)
        speck[10:20, 30:40] = ids[10:20, 30:40] == 0
        masks = torch.stack([speck, ids >= 0, *(mask & upper for mask in wanted[1:]), *wanted])
        masks = masks[masks.flatten(1).any(1)]
        return MaskProposals(masks, torch.ones(len(masks)))

    monkeypatch.setattr(discovery, "propose_masks", propose)
    return Oracle(truth, view_images(truth), images)


def overlaps(truth, found) -> dict[int, float]:
    blank = replace(truth, gaussians=replace(truth.gaussians, object_id=torch.zeros_like(truth.gaussians.object_id)))
    ids = apply_votes(blank, collect_votes(blank, found.items()), {}, "test").gaussians.object_id
    return best_overlap(ids, truth.gaussians.object_id)


def test_of_all_masks_those_of_things_on_the_table_stay(oracle, truth):
    found = discovery.discover_objects(oracle, find_support(truth), SegmentOptions())
    assert max(int(labels.max()) for labels in found.values()) == 3
    assert min(overlaps(truth, found).values()) > 0.9


def test_an_object_lost_on_the_way_is_found_again_under_its_number(oracle, truth):
    oracle.reach = 2  # so that each photo searched finds all three anew
    found = discovery.discover_objects(oracle, find_support(truth), SegmentOptions())
    assert max(int(labels.max()) for labels in found.values()) == 3
    assert min(overlaps(truth, found).values()) > 0.9


def test_an_object_hidden_at_first_is_found_later(oracle, truth):
    shown = oracle.images[0]
    oracle.images[0] = torch.where(shown == 2, 0, shown)
    found = discovery.discover_objects(oracle, find_support(truth), SegmentOptions())
    assert max(int(labels.max()) for labels in found.values()) == 3
    assert min(overlaps(truth, found).values()) > 0.9


def test_no_more_objects_than_asked_for_and_the_largest_first(oracle, truth):
    found = discovery.discover_objects(oracle, find_support(truth), SegmentOptions(max_objects=1))
    assert max(int(labels.max()) for labels in found.values()) == 1
    areas = [int((oracle.images[0] == i).sum()) for i in (1, 2, 3)]
    mine = oracle.images[0] == 1 + areas.index(max(areas))
    assert torch.equal(found[0] > 0, mine)


def test_what_stands_by_hand(truth):
    support, ids = find_support(truth), truth.gaussians.object_id
    for i in (1, 2, 3):
        assert is_on_support(truth, torch.nonzero(ids == i)[:, 0], support, SegmentOptions())
        assert is_on_support(truth, torch.nonzero(ids == i)[:, 0], None, SegmentOptions())
    assert not is_on_support(truth, torch.nonzero(ids == 0)[:, 0], support, SegmentOptions())  # the table
    assert not is_on_support(truth, torch.nonzero(ids == 1)[:5, 0], support, SegmentOptions())  # a few pixels
    assert not is_on_support(truth, torch.nonzero(ids == 1)[:, 0], support, SegmentOptions(min_size=0.5))
    assert not is_on_support(truth, torch.full((100,), -1), support, SegmentOptions())  # nothing is drawn there
    lifted = truth.gaussians.means + torch.tensor([0, 0, 0.6]) * (ids == 1)[:, None]
    high = replace(truth, gaussians=replace(truth.gaussians, means=lifted))
    assert not is_on_support(high, torch.nonzero(ids == 1)[:, 0], support, SegmentOptions())


def test_parts_go_wholes_stay():
    masks = torch.zeros(4, 1, 20, dtype=torch.bool)
    masks[0, 0, :3] = True  # within the next
    masks[1, 0, :10] = True
    masks[2, 0, 8:12] = True  # half of it
    masks[3, 0, 8:13] = True  # two fifths, and the one above lies in it
    assert torch.equal(remove_nested_masks(masks), masks[[1, 3]])
    assert remove_nested_masks(masks[:0]).shape == (0, 1, 20)


def test_numbers_of_new_labels_by_hand():
    old = {0: torch.tensor([[1, 1, 2, 2, 0, 0]]), 1: torch.tensor([[0, 0, 0, 0, 0, 0]])}
    fresh = {0: torch.tensor([[2, 2, 0, 0, 1, 1]]), 1: torch.tensor([[2, 2, 2, 2, 2, 3]])}
    # the second lies on object 1 in the one photo that shows both; the others are new
    assert match_labels(fresh, old, new=3, count=2).tolist() == [0, 3, 1, 4]
    assert match_labels(fresh, {}, new=3, count=0).tolist() == [0, 1, 2, 3]
