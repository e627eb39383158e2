"""Training of the mask scorer."""

import json
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from stages.core.errors import InputError
from stages.core.models.segmenter.crops import Boxes, Surroundings, corrected
from stages.core.models.segmenter.mask_scorer import KNOWN
from stages.core.models.segmenter.network import Segmenter
from stages.core.models.segmenter.segment import WEIGHTS, load_segmenter
from stages.core.models.segmenter.voxels import VOXEL, ScenePoints
from stages.lab.clutter import scenes
from stages.lab.clutter.examples import Example, write_example
from stages.lab.training.train_mask_scorer import (
    MaskExamples,
    MaskTraining,
    held_out_losses,
    mask_examples,
    run,
    train_masks,
    turned,
)


def cubes_and_halves(count: int) -> MaskExamples:
    """Candidates that are a whole cube (IoU 1) or half of it (IoU .5), of which nothing else is known."""
    cube = torch.cartesian_prod(*[torch.arange(6)] * 3)
    points = torch.cat([VOXEL * (cube + torch.tensor([40 * k, 0, 0])) for k in range(count)])
    n, m = len(cube), len(points)
    nothing = torch.zeros(m, 3)
    seen = Surroundings(points, nothing, nothing, torch.zeros(m, 5), nothing, torch.zeros(m, 24), torch.arange(m))
    first, whole = n * torch.arange(count), torch.arange(count) % 2 == 0
    last = torch.where(whole, first + n, first + n // 2)
    middle = torch.stack([points[a:b].mean(0) for a, b in zip(first, last, strict=True)])
    zeros = torch.zeros(count, 3)
    spans = torch.stack([first, last], 1)
    boxes = Boxes(middle, torch.full((count,), 6 * VOXEL), middle, zeros, torch.zeros(count, 24), spans, spans,
                  torch.zeros(count, KNOWN), torch.zeros(count))  # fmt: skip
    return MaskExamples(seen, boxes, torch.where(whole, 1.0, 0.5), torch.ones(count))


def ball_on_table() -> Example:
    """A ball of 1,500 surfels above a table of 3,000."""
    generator = torch.Generator().manual_seed(0)
    ball = torch.nn.functional.normalize(torch.randn(1500, 3, generator=generator), dim=1)
    table = (torch.rand(3000, 3, generator=generator) - 0.5) * torch.tensor([1.0, 1, 0])
    points = torch.cat([0.05 * ball + torch.tensor([0.0, 0, 0.05]), table])
    normals = torch.cat([ball, torch.tensor([0.0, 0, 1]).expand(3000, 3)])
    surfels = ScenePoints(points, torch.full((4500, 3), 50.0), normals, torch.ones(4500), normals)
    return Example(surfels, (torch.arange(4500) < 1500).long())


@pytest.mark.slow
def test_training_learns_what_only_the_mask_shows(device):
    model, examples = Segmenter((8, 8)).to(device), cubes_and_halves(8).to(device)
    model.add_mask_scorer()
    before = held_out_losses(model, [examples])
    assert before["masks"] == before["before"]  # untrained
    list(train_masks(model, [examples], MaskTraining(steps=100, batch=(1, 4))))
    found = corrected(examples.seen, examples.boxes, model).sigmoid()
    np.testing.assert_allclose(found, examples.ious.cpu(), atol=0.15)
    after = held_out_losses(model, [examples])
    assert after["least"] <= after["masks"] < after["before"] == before["before"]


def test_turned_scenes_are_similar():
    example = ball_on_table()
    moved = turned(example, np.random.default_rng(0))
    before, after = (e.surfels.points[:1000] for e in (example, moved))
    ratio = torch.pdist(after) / torch.pdist(before).clamp_min(1e-6)
    scale = ratio.median()
    assert 0.8 <= scale <= 1.25
    np.testing.assert_allclose(ratio[torch.pdist(before) > 1e-2], scale, rtol=1e-3)
    np.testing.assert_allclose(moved.surfels.points[:, 2], scale * example.surfels.points[:, 2], atol=1e-5)


def test_the_ball_is_a_candidate_with_a_large_iou():
    found = [mask_examples(load_segmenter(WEIGHTS), ball_on_table(), scale) for scale in (1.0, 1.5)]
    assert max(float(item.ious.max()) for item in found) > 0.8
    for item in found:
        assert len(item.ious) == len(item.boxes) == len(item.weights)
        best = item.boxes[item.ious.argmax()[None]]
        assert ((item.seen.place >= best.span[:, 0]) & (item.seen.place < best.span[:, 1])).any()


def test_scenes_are_made_in_the_time_given_and_failed_ones_left_out(tmp_path: Path, monkeypatch):
    def made(folder, options, meshes):
        time.sleep(0.3)
        if options.first % 2 == 0:
            raise InputError("too few photos")
        (folder / f"{options.first:04d}").mkdir(parents=True)
        write_example(folder / f"{options.first:04d}" / "observed_reconstruction.safetensors", ball_on_table())
        yield "made"

    monkeypatch.setattr(scenes, "run", made)
    options = MaskTraining(scene_minutes=0.15, steps=1, copies=0, batch=(1, 4), device="cpu")
    list(run([tmp_path / "s"], tmp_path / "w.safetensors", options))
    found = {p.parent.name for p in (tmp_path / "s").glob("*/masks_observed_reconstruction_0.pt")}
    assert "0001" in found and "0000" not in found


def test_weights_keep_the_network_and_load_with_the_scorer(tmp_path: Path):
    for k in range(2):
        (tmp_path / f"s/{k:04d}").mkdir(parents=True)
        write_example(tmp_path / f"s/{k:04d}/observed_0.safetensors", ball_on_table())
    options = MaskTraining(steps=2, copies=0, batch=(1, 4), device="cpu")
    lines = list(run([tmp_path / "s"], tmp_path / "w.safetensors", options))
    assert lines[0].startswith("2 scenes, 0 held out")
    model, shipped = load_segmenter(tmp_path / "w.safetensors"), load_file(WEIGHTS)
    assert model.mask_scorer is not None and load_segmenter(WEIGHTS).mask_scorer is None
    for name, value in load_file(tmp_path / "w.safetensors").items():
        assert name.startswith("mask_scorer.") or value.equal(shipped[name].half())
    assert json.loads((tmp_path / "w.json").read_text())["scenes"] == 2
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="no candidates to train on"):
        list(run([tmp_path / "none"], tmp_path / "w.safetensors", options))
