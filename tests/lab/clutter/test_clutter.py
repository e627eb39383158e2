"""Cluttered scenes: at rest, labelled, reproducible by their seed; noisy observations; a short training run."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from stages.core.errors import InputError
from stages.core.models.segmenter.network import CANDIDATE_FEATURES, SCORES
from stages.core.models.segmenter.segment import MAX_SIZE, REDUCTIONS, load_segmenter, object_ids
from stages.core.models.segmenter.voxels import ScenePoints
from stages.core.scene.files import sha256
from stages.core.scene.scene_ply import read_scene
from stages.lab.clutter import scenes
from stages.lab.clutter.composites import make_composite
from stages.lab.clutter.examples import Example, read_example
from stages.lab.clutter.noise_model import Degradation, observed
from stages.lab.clutter.options import ClutterOptions
from stages.lab.clutter.scenes import Shelf, make_scene, run
from stages.lab.training import segmenter_data, train_segmenter
from stages.lab.training.segmenter_data import SCALE_RANGE, augmented, targets
from tests.conftest import random_gaussians

pytest.importorskip("mujoco")
PERFECT = Degradation(bend=0.0, fatten=0.0, drift=0.0, patch=8.0, grain=0.0, plain=0.0, holes=-1.0, merge=0.005)
NUMBER = 26  # number of a small scene


@pytest.fixture(scope="module")
def scene():
    """A scene with few objects, of one part and of several parts."""
    return make_scene(NUMBER, Shelf((), 0), ClutterOptions(views=4))[0]


@pytest.fixture(scope="module")
def exact(scene):
    """An observation without noise: surfels, and the object of each."""
    return observed(scene, np.random.default_rng(0), PERFECT)


def test_things_rest_on_the_furniture_and_do_not_reach_into_each_other(scene):
    g = scene.gaussians
    assert len(scene.objects) >= 2
    assert sorted(g.object_id.unique().tolist()) == [0, *(o.id for o in scene.objects)]
    for o in scene.objects:
        low = float(g.means[g.object_id == o.id, 2].min())
        assert low > -0.01, o.name  # the top of the table is z = 0
    assert min(float(g.means[g.object_id == o.id, 2].min()) for o in scene.objects) < 0.02


def test_objects_of_the_data_set_keep_their_area_when_thinned(monkeypatch):
    g = random_gaussians(4 * scenes.DATA_SET_POINTS)
    monkeypatch.setattr(scenes, "make_object", lambda name: g)
    thinned = Shelf((), 0).pick(SimpleNamespace(uniform=lambda: 0.0, choice=lambda names: "thing")).gaussians
    assert len(thinned) == scenes.DATA_SET_POINTS
    assert float(thinned.scales.square().sum()) == pytest.approx(float(g.scales.square().sum()), rel=0.02)


def test_a_scene_is_the_same_from_one_seed(scene):
    again = make_scene(NUMBER, Shelf((), 0), ClutterOptions(views=4))[0]
    assert torch.equal(again.gaussians.means, scene.gaussians.means)
    assert torch.equal(again.cameras.viewmats, scene.cameras.viewmats)


def test_an_observation_without_noise_lies_on_the_true_surface(scene, exact):
    surfels, labels = exact
    t = targets(surfels, labels)
    assert set(labels.unique().tolist()) <= set(scene.gaussians.object_id.unique().tolist())
    assert (t.classes == 1).any()
    assert (t.classes == 0).any()
    flat = surfels.points[labels == 0]
    level = (flat[:, 2].abs() < 0.006).float().mean()
    noisy, noisy_labels = observed(scene, np.random.default_rng(0), Degradation(2.0, 0.3, 0.01, 8, 0.003, 0, -1, 0.005))
    assert level > 1.2 * (noisy.points[noisy_labels == 0, 2].abs() < 0.006).float().mean()


def test_offsets_lead_to_the_middle_of_the_object(exact):
    t = targets(*exact)
    for label in t.labels.unique().tolist():
        if label > 0:
            own = t.labels == label
            ends = (t.grid.points + t.offsets)[own]
            assert float((ends - ends[0]).abs().max()) < 1e-5


@pytest.mark.slow
def test_files_of_scenes_are_kept_and_trained_on(tmp_path: Path, device: str):
    """Photos and cameras can be reconstructed; observations are written; trained weights can label a scene."""
    options = ClutterOptions(count=1, views=4, size=96, first=6)
    assert len(list(run(tmp_path / "photos", options))) == 1
    assert not list(run(tmp_path / "photos", options))  # finished scenes are not generated again
    folder = tmp_path / "photos" / "0006"
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    assert all((folder / frame["file_path"]).is_file() for frame in frames)
    truth = read_scene(folder / "truth.ply")
    truth = replace(truth, gaussians=truth.gaussians[::10])

    list(run(tmp_path / "noisy", ClutterOptions(count=1, views=4, size=96, first=6, observations=1)))
    example = read_example(tmp_path / "noisy" / "0006" / "observed_0.safetensors")
    assert len(example.surfels) == len(example.labels) > 1000

    list(run(tmp_path / "exact", ClutterOptions(count=1, views=4, size=96, first=6, exact=True)))
    exact = read_example(tmp_path / "exact" / "0006" / "observed_exact.safetensors")
    assert exact.labels.min() == 0 and exact.labels.max() == len(truth.objects)

    weights = tmp_path / "w.safetensors"
    training = train_segmenter.SegmenterTraining(
        steps=2, voxels=2000, widths=(8, 12), blocks=1, score_scenes=2, score_steps=20
    )
    lines = list(train_segmenter.run([tmp_path / "noisy"], weights, training))
    assert "1 files" in lines[0]
    ids = object_ids(truth, load_segmenter(weights, device))
    assert len(ids) == len(truth.gaussians)

    old = _with_fewer_score_features(weights, tmp_path / "old.safetensors")
    with pytest.raises(InputError, match="does not fit the segmentation network"):
        load_segmenter(old)
    again = tmp_path / "again.safetensors"
    list(train_segmenter.run([tmp_path / "noisy"], again, replace(training, minutes=0), start=old))
    before, after = load_file(old), load_file(again)
    network = [name for name in before if not name.startswith(SCORES)]
    assert len(network) > 10 and all(before[name].equal(after[name]) for name in network)
    assert len(load_segmenter(again).feature_mean) == CANDIDATE_FEATURES


def _with_fewer_score_features(weights: Path, out: Path) -> Path:
    """A copy of weights whose candidate scores have ten features."""
    state = load_file(weights)
    for name in ("feature_mean", "feature_scale", "candidate_head.0.weight"):
        state[name] = state[name][..., :10].contiguous()
    save_file(state, out)
    card = json.loads(weights.with_suffix(".json").read_text())
    out.with_suffix(".json").write_text(json.dumps({**card, "sha256": sha256(out)}))
    return out


def test_close_scenes_have_few_large_things(monkeypatch):
    monkeypatch.setattr(scenes, "CLOSE_SHARE", 1.0)
    scene = make_scene(NUMBER, Shelf((), 0), ClutterOptions(views=4))[0]
    g = scene.gaussians
    sides = [(m.amax(0) - m.amin(0)).norm() for m in (g.means[g.object_id == o.id] for o in scene.objects)]
    assert 1 <= len(sides) <= 3 and min(sides) > 0.9 * scenes.CLOSE_SIZES[0]


@pytest.mark.parametrize("length", [0.3, 0.9])
def test_large_objects_are_trained_on_at_reduced_size(monkeypatch, length):
    monkeypatch.setattr(segmenter_data, "_with_holes", lambda s, rng: torch.ones(len(s), dtype=torch.bool))
    n = 400
    along = torch.cat([torch.linspace(0, length, n // 2), torch.linspace(-1.5, 1.5, n // 2)])
    points = torch.stack([along, torch.zeros(n), torch.zeros(n)], 1)
    up = torch.tensor([[0.0, 0, 1]]).expand(n, 3)
    example = Example(
        ScenePoints(points, torch.full((n, 3), 50.0), up, torch.zeros(n), up), (torch.arange(n) < n // 2).long()
    )
    reduced = []
    for seed in range(20):
        s, labels = augmented(example, np.random.default_rng(seed))
        own = s.points[labels == 1]
        reduced.append(float((own[:, None] - own).norm(dim=2).max()) / length)
    expected = np.array(SCALE_RANGE) * ((1, 1) if length < MAX_SIZE else (min(REDUCTIONS), max(REDUCTIONS)))
    assert expected[0] * 0.8 < min(reduced) < max(reduced) < expected[1] * 1.05
    assert max(reduced) > 0.8 * expected[1]


def test_objects_of_several_parts_rest_in_each_others_concavities():
    """A block under the bridge of another object does not touch its posts: parts collide, not the convex hull."""
    from stages.lab.clutter.settle import settle
    from stages.lab.clutter.supports import Furniture, StaticBox

    def block(centre, half):
        signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return np.array(centre) + signs * np.array(half)

    bridge = [block((0, 0, 0.1), (0.2, 0.05, 0.02)), *(block((s * 0.18, 0, 0.04), (0.02, 0.05, 0.04)) for s in (-1, 1))]
    floor = Furniture([StaticBox((0, 0, -0.05), (1, 1, 0.05))], [(-1, 1, -1, 1, 0)], (0, 6.28))
    at, _ = settle(floor, [bridge, [block((0, 0, 0.02), (0.05, 0.05, 0.02))]], np.array([[0, 0, 0.01], [0, 0, 0.01]]))
    assert np.abs(at[:, 2]).max() < 0.005
    assert np.abs(at[1, :2]).max() < 0.01


def test_things_rest_on_a_drape_where_its_gaussians_are():
    """Blocks above the raised and the low quadrant of a rotated and shifted drape."""
    from stages.lab.clutter.drapes import CELLS, Drape
    from stages.lab.clutter.settle import settle
    from stages.lab.clutter.supports import Furniture, StaticBox, painted

    heights = torch.zeros(CELLS, CELLS)
    heights[CELLS // 2 :, CELLS // 2 :] = 0.08  # the quadrant with x and y above the middle
    drape = Drape(heights, (0.4, 0.3), (0.1, -0.05), 0.7)
    floor = Furniture([StaticBox((0, 0, -0.05), (1, 1, 0.05))], [(-1, 1, -1, 1, 0)], (0, 6.28), (drape,))
    c, s = np.cos(0.7), np.sin(0.7)
    spots = np.array([[0.2, 0.15], [-0.2, 0.15]]) @ np.array([[c, s], [-s, c]]) + [0.1, -0.05]
    assert np.allclose(drape.height(torch.from_numpy(spots).float()), [0.08, 0], atol=1e-6)
    half = np.array([0.03, 0.03, 0.02])
    block = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    at, _ = settle(floor, [[block], [block]], np.column_stack([spots, [0.11, 0.11]]))
    np.testing.assert_allclose(at[:, 2] - half[2], [0.08, 0], atol=0.004)
    low, high = spots - 0.03, spots + 0.03
    assert [floor.rise(tuple(a), tuple(b)) for a, b in zip(low, high, strict=True)] == pytest.approx(
        [0.08, 0], abs=1e-6
    )
    g = painted(floor, np.random.default_rng(0))
    raised = g.means[g.means[:, 2] > 0.079]
    assert len(raised) > 500 and not g.object_id.any()
    assert (drape.local(raised[:, :2]) > -0.05).all()


def test_random_drapes_lie_in_a_share_of_the_scenes():
    from stages.lab.clutter.drapes import DRAPE_SHARE, random_drapes

    drapes = [random_drapes((0.5, 0.4), np.random.default_rng(k)) for k in range(60)]
    assert abs(np.mean([bool(d) for d in drapes]) - DRAPE_SHARE) < 0.2
    for d in (d for some in drapes for d in some):
        assert 0.006 < float(d.heights.max()) < 0.2 and float(d.heights.min()) >= 0
        surface = d.surface(0.01)
        np.testing.assert_allclose(surface.points[:, 2], d.height(surface.points[:, :2]), atol=1e-6)
        assert len(surface.points) > 0.2 * 4 * d.half[0] * d.half[1] / 0.01**2


@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (2, 3))])
def test_composites_are_one_normalised_object_of_several_parts(seed):
    prop = make_composite(seed)
    g = prop.gaussians
    low, high = g.means.amin(0), g.means.amax(0)
    assert abs(float((high - low).max()) - 1) < 1e-5
    assert float((low + high).abs().max()) < 1e-5
    assert len(prop.parts) == len(g)
    assert len(prop.parts.unique()) >= 3
    again = make_composite(seed)
    assert torch.equal(again.gaussians.means, g.means) and torch.equal(again.parts, prop.parts)


def test_a_turned_box_is_drawn_where_things_rest_on_it():
    from stages.core.geometry.rotations import matrix
    from stages.lab.clutter.settle import settle
    from stages.lab.clutter.supports import Furniture, StaticBox, painted

    block = StaticBox((0.1, -0.2, 0.3), (0.3, 0.2, 0.1), yaw=0.7, tilt=-0.3)
    R = block.rotation()
    assert torch.allclose(matrix(torch.tensor([block.quaternion()]))[0], R, atol=1e-6)
    furniture = Furniture([block], [(-1, 1, -1, 1, 0)], (0, 6.28))
    g = painted(furniture, np.random.default_rng(0))
    local = (g.means - torch.tensor(block.centre)) @ R
    assert torch.allclose(local.abs().amax(0), torch.tensor(block.half), atol=2e-3)
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.02
    above = torch.tensor(block.centre) + R @ torch.tensor([0, 0, block.half[2] + 0.025])
    at, _ = settle(furniture, [[cube]], above[None].numpy())
    height = float(((torch.from_numpy(at[0]).float() - torch.tensor(block.centre)) @ R)[2])
    assert abs(height - block.half[2] - 0.02) < 2e-3  # friction holds it on a slope of 0.3 rad


def test_seats_have_backs_behind_what_lies_on_them():
    from stages.lab.clutter.supports import _seat

    for seed in range(20):
        seat = _seat(np.random.default_rng(seed))
        _, _, _, y1, z = seat.areas[0]
        high = [b for b in seat.blocks if b.centre[2] + b.half[2] > 0.2]
        assert z == 0 and all(b.centre[1] > 0.99 * y1 or b.centre[1] == 0 for b in high)  # backs and arms
        assert all(b.centre[1] + b.half[1] < seat.back for b in high)
