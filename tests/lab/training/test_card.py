import json
from pathlib import Path

import cv2
import pytest

from ngff_cli.lab import app
from stages import lab
from stages.core.errors import InputError
from stages.core.models.checkpoints import SHIPPED, build, load, save
from stages.lab.plot import LEGEND_HEIGHT, PANEL_HEIGHT, PANEL_WIDTH
from stages.lab.training.card import run
from tests.conftest import CliRunner

CURVES = {"runs": [{"minutes": 1.0}], "curve": {"minutes": [], "loss": [], "RMSE": [], "R": []}}


def card(path, minutes=(1.0, 2.0), losses=(0.5, 0.25), earlier=()):
    """Write a card of one run after `earlier`."""
    scores = [x and x / 10 for x in losses]
    record = {"minutes": minutes[-1], "scenes": 7, "validation": {"RMSE": scores[-1], "R": 0.5}}
    curve = {"minutes": minutes, "loss": losses, "RMSE": scores, "R": [0.5] * len(losses)}
    facts = {"model": "gcn", "device": "cpu", "sha256": path.stem, "runs": [*earlier, record], "curve": curve}
    path.write_text(json.dumps(facts))
    return path


def test_curves_of_two_cards_in_one_figure(tmp_path):
    cards = [card(tmp_path / "a.json"), card(tmp_path / "b.json", losses=(0.9, None))]
    args = ["card", *map(str, cards), "-o", str(tmp_path / "curves.png")]
    done = CliRunner().invoke(app, args)
    assert done.exit_code == 0, done.stderr
    assert done.stdout.splitlines()[0] == "a: gcn, 7 scenes, 2.0 min on cpu: RMSE 0.0250  R 0.5000"
    image = cv2.imread(str(tmp_path / "curves.png"))
    assert image.shape == (PANEL_HEIGHT + LEGEND_HEIGHT, 3 * PANEL_WIDTH, 3)
    assert (image[:PANEL_HEIGHT, :PANEL_WIDTH] == (40, 40, 200)).all(
        2
    ).sum() > 50  # the curve of card a; card b has only a point


def test_the_minutes_of_earlier_runs_count(tmp_path):
    earlier = [{"minutes": 1.0, "processes": 2, "sha256": "a"}, {"minutes": 2.0, "sha256": "b"}]
    second = card(tmp_path / "b.json", minutes=(1.0, 4.0), earlier=earlier)
    assert run([second], tmp_path / "c.png")[0].startswith("b: gcn, 7 scenes, 8.0 min on cpu")


def test_all_committed_cards_have_curves(tmp_path):
    files = [SHIPPED / "ngff.json", *sorted((Path(lab.__file__).parent / "results" / "training").glob("*.json"))]
    lines = run(files, tmp_path / "c.png")
    assert len(lines) == 7 and lines[0].startswith("ngff: ngff, 3600 scenes, 136.6 min on NVIDIA H200")


def test_half_rewrites_the_weights(tmp_path):
    save(tmp_path / "a.safetensors", "gcn", build("gcn", hidden=32), CURVES)
    before = (tmp_path / "a.safetensors").stat().st_size
    run([tmp_path / "a.json"], tmp_path / "c.png", half=True)
    assert (tmp_path / "a.safetensors").stat().st_size < 0.6 * before
    assert load(tmp_path / "a.safetensors")[1]["runs"] == CURVES["runs"]


@pytest.mark.parametrize("text", [
    "{", "[]", '{"model": "a", "runs": [], "curve": []}', '{"runs": [], "curve": {"minutes": [1]}}',
    '{"model": "a", "runs": [], "curve": {"minutes": [1], "loss": [], "RMSE": [], "R": []}}',
])  # fmt: skip
def test_invalid_cards_are_rejected(tmp_path, text):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(InputError, match="x.json: has no training curve"):
        run([tmp_path / "x.json"], tmp_path / "c.png")
