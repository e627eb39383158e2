import json

import cv2
import pytest
from typer.testing import CliRunner

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.models.checkpoints import SHIPPED, build, load, save
from stages.lab.plot import LEGEND_HEIGHT, PANEL_HEIGHT, PANEL_WIDTH
from stages.lab.training.card import run


def card(path, minutes=(1.0, 2.0), losses=(0.5, 0.25)):
    rows = [{"minutes": m, "loss": x, "RMSE": x and x / 10, "R": 0.5} for m, x in zip(minutes, losses, strict=True)]
    facts = {"model": "gcn", "minutes": minutes[-1], "scenes": 7, "device": "cpu", "validation": rows[-1]}
    path.write_text(json.dumps({**facts, "curve": rows}))
    return path


def test_two_trainings_in_one_picture(tmp_path):
    cards = [card(tmp_path / "a.json"), card(tmp_path / "b.json", losses=(0.9, None))]
    args = ["card", *map(str, cards), "-o", str(tmp_path / "curves.png")]
    done = CliRunner().invoke(app, args)
    assert done.exit_code == 0, done.stderr
    assert done.stdout.splitlines()[0] == "a: gcn, 7 scenes, 2.0 min on cpu: RMSE 0.0250  R 0.5000"
    image = cv2.imread(str(tmp_path / "curves.png"))
    assert image.shape == (PANEL_HEIGHT + LEGEND_HEIGHT, 3 * PANEL_WIDTH, 3)
    assert (image[:PANEL_HEIGHT, :PANEL_WIDTH] == (40, 40, 200)).all(
        2
    ).sum() > 50  # the curve of a; of b there is a point


def test_the_minutes_of_the_weights_begun_with_count(tmp_path):
    first, second = json.loads(card(tmp_path / "a.json").read_text()), card(tmp_path / "b.json", minutes=(1.0, 4.0))
    second.write_text(json.dumps({**json.loads(second.read_text()), "before": {**first, "before": first}}))
    assert run([second], tmp_path / "c.png")[0].startswith("b: gcn, 7 scenes, 8.0 min on cpu")


def test_the_cards_that_ship_have_curves(tmp_path):
    lines = run(sorted(SHIPPED.glob("*.json")), tmp_path / "c.png")
    assert any(line.startswith("ngff: ngff, ") for line in lines)


def test_weights_are_made_ready_to_ship(tmp_path):
    save(tmp_path / "a.safetensors", "gcn", build("gcn", hidden=32), {"minutes": 1.0, "curve": []})
    before = (tmp_path / "a.safetensors").stat().st_size
    run([tmp_path / "a.json"], tmp_path / "c.png", half=True)
    assert (tmp_path / "a.safetensors").stat().st_size < 0.6 * before
    assert load(tmp_path / "a.safetensors")[1]["minutes"] == 1.0


@pytest.mark.parametrize("text", ["{", "[]", '{"minutes": 1, "curve": []}', '{"model": "a", "minutes": 1, "curve": 1}'])
def test_what_is_no_card(tmp_path, text):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(InputError, match="x.json: has no curve of training"):
        run([tmp_path / "x.json"], tmp_path / "c.png")
