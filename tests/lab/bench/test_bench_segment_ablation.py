"""The ablation benchmark of the segmentation network."""

import json
from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from ngff_cli.lab import app
from stages.core.models.segmenter.network import pyramid
from stages.core.models.segmenter.voxels import ScenePoints, voxelise
from stages.lab.bench import segment_ablation as bench
from stages.lab.clutter.examples import Example, write_example
from stages.lab.clutter.scenes import EXACT, OBSERVED, RECONSTRUCTED
from stages.lab.training.segmenter_data import targets
from tests.conftest import CliRunner


def two_balls(seed: int) -> Example:
    """A red and a blue ball on a floor."""
    rng = torch.Generator().manual_seed(seed)
    ball = torch.nn.functional.normalize(torch.randn(400, 3, generator=rng), dim=1)
    up = torch.tensor([[0.0, 0, 1]]).expand(900, 3)
    floor = torch.rand(900, 3, generator=rng) * torch.tensor([0.6, 0.6, 0]) - torch.tensor([0.3, 0.3, 0])
    balls = [0.06 * ball + torch.tensor([x, 0, 0.06]) for x in (-0.12, 0.12)]
    normals = torch.cat([up, ball, ball])
    lab = torch.tensor([[70.0, 0, 0], [50, 60, 40], [40, 10, -50]])
    labels = torch.tensor([0] * 900 + [1] * 400 + [2] * 400)
    surfels = ScenePoints(torch.cat([floor, *balls]), lab[labels], normals, torch.full((1700,), 0.8), normals)
    return Example(surfels, labels)


@pytest.fixture
def scenes(tmp_path):
    for folder, seed in (("train", 0), ("scores", 1), ("judge", 2)):
        (tmp_path / folder / "0000").mkdir(parents=True)
        for name in (RECONSTRUCTED, EXACT):
            write_example(tmp_path / folder / "0000" / OBSERVED.format(name), two_balls(seed))
    return tmp_path


@pytest.mark.slow
def test_ablations_are_trained_and_judged(scenes, monkeypatch, device):
    monkeypatch.setattr(bench, "TRAINING", {"score_scenes": 1, "score_steps": 2, "widths": (4, 8), "blocks": 1})
    out = scenes / "rows.json"
    command = ["bench", "segment-ablation", scenes / "train", "--scores", scenes / "scores", "--judge",
               scenes / "judge", "--steps", "2", "--batch", "1", "--device", device, "-o", out]  # fmt: skip
    names = ["colour", "noise", "clutter"]
    result = CliRunner().invoke(app, [*map(str, command), "--only", ",".join(names)])
    assert result.exit_code == 0, result.output
    rows = json.loads(out.read_text())["rows"]
    assert list(rows) == names
    assert all(row["objects"] == 2 and 0 <= row["PQ"] <= 1 and row["files"] == 1 for row in rows.values())
    assert "colour" in out.with_suffix(".md").read_text()

    wrong = CliRunner().invoke(app, [*map(str, command), "--only", "smell"])
    assert wrong.exit_code == 2 and "choose from full" in wrong.output


def test_masked_networks_do_not_see_what_they_are_trained_without():
    example = two_balls(0)
    grey = replace(example.surfels, lab=0 * example.surfels.lab + 50)
    for name, same in (("full", False), ("colour", True)):
        torch.manual_seed(0)
        choice = bench.ABLATIONS[name]
        model = bench._MaskedSegmenter(choice.inputs, choice.features, (8, 12), 1).eval()
        found = [model(grid.features, pyramid(grid.cells, 2)) for grid in (voxelise(example.surfels), voxelise(grey))]
        assert bool((found[0].logits - found[1].logits).abs().max() < 1e-6) == same

    grid = voxelise(example.surfels)
    inputs = bench._without(grid.features, bench.SHAPE_INPUTS)
    assert_close(inputs[:, list(bench.COLOUR_INPUTS)], grid.lab)
    assert_close(inputs.abs().sum(), grid.lab.abs().sum())


def test_clutter_counts_as_surface():
    example = two_balls(0)
    t = targets(example.surfels, torch.where(example.labels == 2, -1, example.labels))
    assert (t.classes == 2).sum() > 30
    changed = bench.ABLATIONS["clutter"].change(t)
    assert (changed.classes == 2).sum() == 0 and ((changed.classes == 0) == (t.classes != 1)).all()


def test_colour_contrasts_are_the_features_that_colours_change():
    from stages.core.models.segmenter.candidates import find_candidates
    from stages.core.models.segmenter.network import Segmenter

    torch.manual_seed(0)
    model, example = Segmenter((8, 12), 1).eval(), two_balls(0)
    grid = voxelise(example.surfels)
    levels = pyramid(grid.cells, 2)
    with torch.no_grad():
        found = model(grid.features, levels)
        colours = torch.cat([grid.features[:, :6], 3 * grid.features[:, 6:9], grid.features[:, 9:]], 1)
        a, b = (find_candidates(replace(grid, features=f), levels, found, model) for f in (grid.features, colours))
    changed = (a.features != b.features).any(0).nonzero()[:, 0].tolist()
    assert changed == list(bench.COLOUR_CONTRASTS)
