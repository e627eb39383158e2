"""Ground-truth scenes and the two benchmarks that use them, with blocks as objects and small cameras."""

import json
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from stages.core.errors import InputError
from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity
from stages.core.models.segmenter import segment as network_segmenter
from stages.core.models.segmenter.voxels import SCALES
from stages.core.scene.gaussians import Gaussians, transformed
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import write_scene
from stages.lab.assets import backgrounds, tabletops
from stages.lab.assets.backgrounds import TABLE_HEIGHT
from stages.lab.assets.objects import OBJECTS
from stages.lab.assets.tabletops import CONTACT_GAP, MAX_RADIUS, MIN_GAP, OBJECTS_PER_SCENE, tabletop
from stages.lab.bench import reconstructed_scene
from stages.lab.bench import refine as bench_refine
from stages.lab.bench import segment as bench_segment
from tests.segment.tabletop import block, three_apart

COLOURS = {name: rgb for name, rgb in zip(
    OBJECTS, [(0.8, 0.1, 0.1), (0.2, 0.4, 0.9), (0.7, 0.1, 0.1), (0.9, 0.8, 0.1), (0.9, 0.7, 0.1), (0.1, 0.7, 0.7),
              (0.1, 0.1, 0.1), (0.3, 0.1, 0.4), (0.1, 0.2, 0.6), (0.6, 0.4, 0.2)], strict=True)}  # fmt: skip


def simple_object(name: str) -> Gaussians:
    """A centred block with longest side 1 that replaces the object."""
    g = block((0.0, 0.0), (1.0, 0.8, 0.7), COLOURS[name], 1, spacing=0.05)
    return replace(g, means=g.means - torch.tensor([0, 0, 0.35]))


@pytest.fixture(autouse=True)
def small_scenes(monkeypatch):
    monkeypatch.setattr(tabletops, "make_object", simple_object)
    for name, value in (("WIDTH", 320), ("HEIGHT", 240), ("FOCAL", 320.0)):
        monkeypatch.setattr(tabletops, name, value)
    monkeypatch.setattr(tabletops, "DISTANCE_SAMPLES", 500)
    monkeypatch.setattr(backgrounds, "TABLE_SPACING", 0.047)
    monkeypatch.setattr(backgrounds, "ROOM_SPACING", 0.28)
    tabletops._resting.cache_clear()
    yield
    tabletops._resting.cache_clear()


def gaps(scene) -> np.ndarray:
    """Smallest distances between the objects of a scene (o, o), inf on the diagonal."""
    g = scene.gaussians
    clouds = [g.means[g.object_id == i].numpy() for i in range(1, OBJECTS_PER_SCENE + 1)]
    out = np.full((OBJECTS_PER_SCENE, OBJECTS_PER_SCENE), np.inf)
    for i in range(OBJECTS_PER_SCENE):
        for j in range(i):
            out[i, j] = out[j, i] = cKDTree(clouds[i]).query(clouds[j])[0].min()
    return out


def test_two_scenes_show_all_ten_objects_resting_on_the_table():
    scenes = [tabletop("apart", i) for i in (0, 1)]
    assert sorted(o.name for s in scenes for o in s.objects) == sorted(OBJECTS)
    for scene in scenes:
        g = scene.gaussians
        for i in range(1, OBJECTS_PER_SCENE + 1):
            mine = g.means[g.object_id == i]
            assert float(mine[:, 2].min()) == pytest.approx(TABLE_HEIGHT, abs=0.005)
            assert float(mine[:, :2].norm(dim=1).max()) < 1.5 * MAX_RADIUS
        assert gaps(scene).min() > 0.9 * MIN_GAP


@pytest.mark.parametrize("index", [0, 3])
def test_touching_objects_touch_without_overlap(index):
    between = gaps(tabletop("touching", index))
    assert (between.min(1) < CONTACT_GAP + 0.003).all()  # every object touches another one
    assert between.min() > 0.2 * CONTACT_GAP
    assert between[:3, 3:].min() > 0.9 * MIN_GAP  # the two groups are separate


@pytest.mark.slow
def test_scenes_are_deterministic():
    one, two = (tabletop("touching", 1).gaussians for _ in range(2))
    assert torch.equal(one.means, two.means) and torch.equal(one.object_id, two.object_id)


def test_best_iou_of_each_object():
    truth = torch.tensor([1, 1, 1, 1, 2, 2, 0, 0])
    found = torch.tensor([3, 3, 3, 0, 3, 5, 5, 0])
    # IoUs: object 1 has 3 / (4 + 4 - 3) with label 3; object 2 has 1 / 3 with label 5 and 1 / 5 with label 3
    assert bench_segment.best_ious(found, truth) == pytest.approx({1: 3 / 5, 2: 1 / 3})
    assert bench_segment.best_ious(torch.zeros(8, dtype=torch.int64), truth) == {1: 0.0, 2: 0.0}


@pytest.mark.slow
def test_segment_benchmark_finds_blocks_and_voting_repairs_wrong_masks(tmp_path, monkeypatch):
    monkeypatch.setenv("NGFF_WEIGHTS", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    lines = list(bench_segment.run(tmp_path / "s.json", bench_segment.SegmentBenchOptions(scenes=1, views=8)))
    means = json.loads((tmp_path / "s.json").read_text())["mean_iou"]
    assert set(means) == set(tabletops.ARRANGEMENTS) and "without sam2: " in lines[1]
    for by in means.values():  # Gaussians this large are partly transparent, so no mask is perfect
        assert by["masks"] > 0.7 and by["masks"] > by["masks, 20% wrong"] > by["masks, 40% wrong"]
        assert by["masks, 20% wrong"] > by["masks, 20% wrong, no vote"] + 0.2
        assert by["boxes"] > 0.5
    assert means["apart"]["geometric"] > 0.9


@pytest.mark.slow
def test_reconstruction_is_measured_in_the_registered_photos(monkeypatch):
    pytest.importorskip("pycolmap")
    monkeypatch.setattr(network_segmenter, "SCALES", SCALES[:1])  # one of three
    monkeypatch.setattr(network_segmenter, "REDUCTIONS", ())
    monkeypatch.setattr(network_segmenter, "COPIES", 1)  # one instead of four
    monkeypatch.setattr(bench_segment, "tabletop", cache(tabletop))

    def perfect(photos, out, options):
        """Write the scene itself, transformed, without labels and without the first camera."""
        assert len(list(photos.iterdir())) == 8
        scene = bench_segment.tabletop("apart", 0, 8)
        move = Similarity(
            0.5, matrix(torch.tensor([0.8, 0.0, 0.0, 0.6])), torch.tensor([0.1, 0.2, -0.5 * TABLE_HEIGHT])
        )
        g = transformed(replace(scene.gaussians, object_id=torch.zeros_like(scene.gaussians.object_id)), move)
        write_scene(out, Scene(g, cameras=scene.cameras[list(range(1, 8))].transformed(move), floor=0.0))

    monkeypatch.setattr(reconstructed_scene, "reconstruct", perfect)
    rows = bench_segment.measure_reconstructed("apart", 0, bench_segment.SegmentBenchOptions(views=8))
    assert [row["way"] for row in rows] == ["reconstructed, geometric", "reconstructed, learned"]
    assert all(row["placed"] == 7 and row["mean"] > 0.9 for row in rows)


def test_failed_reconstruction_finds_nothing(monkeypatch):
    def failing(photos, out, options):
        raise InputError(f"{photos}: no two photos overlap")

    monkeypatch.setattr(reconstructed_scene, "reconstruct", failing)
    for row in bench_segment.measure_reconstructed("apart", 0, bench_segment.SegmentBenchOptions(views=8)):
        assert row["placed"] == 0 and row["mean"] == 0.0 and len(row["iou"]) == OBJECTS_PER_SCENE


@pytest.mark.slow
def test_network_backends_with_weights_take_part(tmp_path, monkeypatch):
    pytest.importorskip("transformers")
    from stages.core.models.sam2 import mask_generation, segmenter
    from stages.segment import discovery
    from tests.core.models.sam2.tiny_model import save_tiny_model

    few = mask_generation.MaskGenerationOptions(grid=2, min_iou=-9.0, min_stability=0.0)
    monkeypatch.setattr(segmenter, "propose_masks", partial(mask_generation.propose_masks, options=few))
    monkeypatch.setattr(discovery, "SEARCHED_VIEWS", 1)
    scene, options = three_apart(side=0.7), bench_segment.SegmentBenchOptions(weights=save_tiny_model(tmp_path))
    assert bench_segment.available_networks(options) == (["sam2"], [])
    found = bench_segment.segment_by_network(scene, "sam2", options)
    assert found.shape == scene.gaussians.object_id.shape  # the network is random, so its objects are arbitrary


def test_label_errors_have_the_given_rate():
    rng = np.random.default_rng(0)
    truth = torch.arange(10).repeat_interleave(30).expand(50, 300)  # ten stripes with a width of 30 pixels
    assert torch.equal(bench_segment.corrupt_labels(truth, 0.0, 9, rng), truth)
    right = [float((bench_segment.corrupt_labels(truth, 0.3, 9, rng) == truth).float().mean()) for _ in range(30)]
    # 0.7 of the masks keep their object and 0.7 of their pixels (a tenth of the noise is right); shifts cost the rest
    assert 0.2 < np.mean(right) < 0.7 * 0.73 + 0.1
    assert int(bench_segment.corrupt_labels(truth, 1.0, 9, rng).max()) <= 9


@pytest.mark.slow
def test_filled_hole_is_closer_to_the_truth_than_an_open_one():
    row = bench_refine.measure(0, views=8)
    assert row["pixels"] > 500
    assert row["after_db"] > row["before_db"] + 6
    assert row["elsewhere_db"] > 32  # the difference is the border of the hole


@pytest.mark.parametrize("wrong", [{"scenes": 0}, {"views": 3}])
def test_invalid_options_are_rejected(wrong):
    with pytest.raises(InputError):
        bench_segment.SegmentBenchOptions(**wrong)
