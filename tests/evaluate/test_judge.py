"""Films judged by a model, which a local server replaces that scores films by their brightness."""

import base64
import json
import logging
import math
from statistics import stdev

import cv2
import numpy as np
import pytest
import torch

from ngff_cli.app import app
from stages.core.errors import InputError
from stages.core.models.chat_completions import InvalidReply
from stages.core.scene.images import VideoWriter, write_png
from stages.evaluate.judge import draw_questions, find_films, parse_scores
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.stage import run
from tests.chat_server import KEY
from tests.conftest import CliRunner

BRIGHTNESS = {"cosmos/a": 0.2, "cosmos/b": 0.4, "ours/a": 0.6, "ours/b": 0.8, "ours/c": 0.9}
GOOD = {"A": {"physical_realism": 0.5, "photo_realism": 1}}


@pytest.fixture(scope="module")
def films(tmp_path_factory):
    """Five grey films of 20 frames, in folders of two models."""
    folder = tmp_path_factory.mktemp("films")
    for name, value in BRIGHTNESS.items():
        (folder / name).parent.mkdir(exist_ok=True)
        with VideoWriter(folder / f"{name}.mp4", 20.0) as out:
            for _ in range(20):
                out.append(torch.full((32, 48, 3), value))
    return folder


def by_brightness(body: dict) -> str:
    """Reply of a judge who considers bright films photorealistic and dark films physically realistic."""
    scores, letter = {}, ""
    for part in body["messages"][0]["content"][1:]:
        if part["type"] == "text":
            letter = part["text"].split()[1].strip(",:")
            scores[letter] = []
        else:
            data = np.frombuffer(base64.b64decode(part["image_url"]["url"].split(",")[1]), np.uint8)
            scores[letter].append(cv2.imdecode(data, cv2.IMREAD_COLOR).mean() / 255)
    assert all(len(frames) == 10 for frames in scores.values())
    means = {letter: sum(frames) / 10 for letter, frames in scores.items()}
    return json.dumps({k: {"physical_realism": 1 - v, "photo_realism": v} for k, v in means.items()})


def judged(films, tmp_path, **options):
    return run(films, None, tmp_path / "m.json", EvaluateOptions(judge=True, **options))


def test_scores_return_to_their_films_from_any_order(chat_server, films, tmp_path, capsys):
    chat_server.script = by_brightness
    facts = judged([films / "cosmos", films / "ours"], tmp_path, films_per_question=2)
    for name, value in BRIGHTNESS.items():
        row = facts["objects"][f"{films / name}.mp4"]
        assert row["PhotoR"] == pytest.approx(value, abs=0.01) and row["PhysR"] == pytest.approx(1 - value, abs=0.01)
        assert row["PhotoR_sd"] == pytest.approx(0, abs=1e-9) and row["repeats"] == 3
    ours, values = facts["objects"][f"{films / 'ours'}/"], [0.6, 0.8, 0.9]
    assert ours["PhotoR"] == pytest.approx(sum(values) / 3, abs=0.01) and ours["repeats"] == 9
    assert ours["PhotoR_sd"] == pytest.approx(stdev(values), abs=0.01)
    assert facts["overall"]["PhotoR"] == pytest.approx(sum(BRIGHTNESS.values()) / 5, abs=0.01)
    assert len(chat_server.asked) == 9 and len(json.loads((tmp_path / "m.replies.json").read_text())["replies"]) == 9
    table = capsys.readouterr().out.splitlines()
    assert table[0].split() == ["PhysR", "PhysR_sd", "PhotoR", "PhotoR_sd", "repeats"] and len(table) == 9


def test_nothing_but_frames_and_letters_is_sent(chat_server, films, tmp_path, caplog):
    caplog.set_level(logging.INFO)
    chat_server.script = by_brightness
    judged([films / "cosmos/a.mp4", films / "ours/a.mp4"], tmp_path, repeats=1)
    ((_, body),) = chat_server.asked
    texts = [part["text"] for part in body["messages"][0]["content"] if part["type"] == "text"]
    assert texts[1:] == ["Film A, 10 frames:", "Film B, 10 frames:"]
    assert "sending 20 frames of 2 films, 1 times, to judge" in caplog.text.replace(body["model"], "judge")
    assert not any("fewer than" in note for note in json.loads((tmp_path / "m.json").read_text())["notes"])
    assert body.keys() == {"model", "messages"} and "cosmos" not in json.dumps(body).lower()
    assert KEY not in (tmp_path / "m.json").read_text() + (tmp_path / "m.replies.json").read_text()


def test_every_repeat_has_each_film_once_in_another_order():
    questions = draw_questions(10, EvaluateOptions(repeats=3, films_per_question=4))
    assert [len(q) for q in questions] == [3, 3, 4] * 3
    orders = [[i for q in questions[k : k + 3] for i in q.values()] for k in (0, 3, 6)]
    assert all(sorted(order) == list(range(10)) for order in orders) and len(set(map(tuple, orders))) == 3
    assert questions == draw_questions(10, EvaluateOptions(repeats=3, films_per_question=4))
    assert questions != draw_questions(10, EvaluateOptions(repeats=3, films_per_question=4, seed=1))


def test_mean_and_spread_over_the_repeats(chat_server, films, tmp_path):
    scores = (0.2, 0.5, 0.8)
    chat_server.script = [json.dumps({"A": {"physical_realism": s, "photo_realism": 1}}) for s in scores]
    row = judged([films / "ours/a.mp4"], tmp_path)["overall"]
    # a single film has no standard deviation
    assert row["PhotoR"] == 1 and row["PhysR"] == pytest.approx(0.5) and row["PhysR_sd"] is None
    facts = json.loads((tmp_path / "m.json").read_text())
    assert facts["objects"][f"{films / 'ours/a.mp4'}"]["PhysR_sd"] == pytest.approx(0.3)


@pytest.mark.parametrize(("reply", "says"), [
    ("{}", "they must be A"), ('{"B": {}}', "entries B; they must be A"), (json.dumps({**GOOD, "B": {}}), "A, B"),
    ('{"A": 0.5}', "must have physical_realism and photo_realism"), ('{"A": {"photo_realism": 1}}', "must have"),
    (json.dumps(GOOD).replace("0.5", '"0.5"'), 'is "0.5", not a number from 0 to 1'),
    (json.dumps(GOOD).replace("0.5", "true"), "is true, not"),
    (json.dumps(GOOD).replace("0.5", "null"), "is null, not"),
    (json.dumps(GOOD).replace("0.5", "1.2"), "is 1.2, not"), (json.dumps(GOOD).replace("0.5", "-0.1"), "is -0.1, not"),
    (json.dumps(GOOD).replace("0.5", "9" * 400), "not a number"),
])  # fmt: skip
def test_replies_that_cannot_be_used(reply, says):
    with pytest.raises(InvalidReply, match=says):
        parse_scores(reply, ["A"])


def test_a_question_without_a_usable_reply_is_left_out_and_said(chat_server, films, tmp_path):
    chat_server.script = ["no", json.dumps(GOOD), "no", "about 0.7", json.dumps(GOOD).replace("0.5", "7"),
                          "Gladly:\n" + json.dumps(GOOD)]  # fmt: skip
    facts = judged([films / "ours/a.mp4"], tmp_path)
    assert facts["overall"]["repeats"] == 2 and facts["overall"]["PhysR"] == 0.5
    assert "1 of 3 questions got no usable answer in 3 tries and are left out" in facts["notes"]
    chat_server.script = ["no"] * 9
    (tmp_path / "m.json").unlink()
    with pytest.raises(InputError, match="no answer of the model could be used"):
        judged([films / "ours/a.mp4"], tmp_path)
    assert not (tmp_path / "m.json").exists()


def test_an_interrupted_run_continues(chat_server, films, tmp_path):
    chat_server.script = [json.dumps(GOOD), 400]
    with pytest.raises(InputError, match="400"):
        judged([films / "ours/a.mp4"], tmp_path)
    assert not (tmp_path / "m.json").exists()
    with pytest.raises(InputError, match="m.replies.json: belongs to other films or options"):
        judged([films / "ours/b.mp4"], tmp_path, resume=True)
    chat_server.script, chat_server.asked = [json.dumps(GOOD)] * 2, []
    assert judged([films / "ours/a.mp4"], tmp_path, resume=True)["overall"]["repeats"] == 3
    assert len(chat_server.asked) == 2
    changed = json.loads((tmp_path / "m.replies.json").read_text())
    changed["replies"]["1"] = "seven"
    for text, says in (("{", "is damaged"), ("[]", "belongs to other"), (json.dumps(changed), "reply 1 was changed")):
        (tmp_path / "m.replies.json").write_text(text)
        with pytest.raises(InputError, match=says):
            judged([films / "ours/a.mp4"], tmp_path, resume=True)


def test_wrong_films_and_options_send_nothing(chat_server, films, tmp_path):
    film = films / "ours/a.mp4"
    (tmp_path / "empty").mkdir()
    (tmp_path / "x.mp4").write_bytes(b"no film")
    write_png(tmp_path / "x.png", torch.zeros(16, 16, 3))
    with VideoWriter(tmp_path / "one.mp4", 20.0) as out:
        out.append(torch.zeros(32, 32, 3))
    for given, says in ((tmp_path / "empty", "contains no films"), (tmp_path / "x.mp4", "not a video that can be read"),
                        (tmp_path / "x.png", "is not a film"), (tmp_path / "one.mp4", "only one frame"),
                        (film.parent, "is given twice"), (tmp_path / "no.mp4", "no such file")):  # fmt: skip
        with pytest.raises(InputError, match=says):
            judged([film, given], tmp_path)
    with pytest.raises(InputError, match="there is no folder"):
        run(film, None, tmp_path / "no/m.json", EvaluateOptions(judge=True))
    with pytest.raises(InputError, match="--against .*drop --against or --judge"):
        run(film, film, None, EvaluateOptions(judge=True))
    with pytest.raises(InputError, match="--align: does not apply to files of kind films"):
        run(film, None, None, EvaluateOptions(judge=True, align=True))
    with pytest.raises(InputError, match="--base-url: .*; it belongs to --judge"):
        run(film, film, tmp_path / "m.json", EvaluateOptions(base_url="x"))
    for options, says in (({"repeats": 0}, "--repeats 0"), ({"films_per_question": 27}, "--films-per-question 27")):
        with pytest.raises(InputError, match=says):
            EvaluateOptions(**options)
    assert not chat_server.asked and not (tmp_path / "m.json").exists()


def test_the_command(chat_server, films, tmp_path, monkeypatch):
    chat_server.script = by_brightness
    words = ["evaluate", str(films / "ours"), "--judge", "--model", "other", "-o", str(tmp_path / "m.json"), "--json"]
    done = CliRunner().invoke(app, words)
    facts = json.loads(done.stdout)
    assert done.exit_code == 0 and facts == json.loads((tmp_path / "m.json").read_text()), done.stderr
    assert facts["kind"] == "films" and not math.isnan(facts["overall"]["PhysR_sd"])
    assert chat_server.asked[0][1]["model"] == "other"
    done = CliRunner().invoke(app, ["evaluate", str(films / "ours/a.mp4")])
    assert done.exit_code == 2 and "name it with --against, or score films with --judge" in done.stderr
    monkeypatch.delenv("OPENAI_API_KEY")
    monkeypatch.delenv("OPENAI_BASE_URL")
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2 and done.stderr.count("\n") == 1 and "set OPENAI_API_KEY" in done.stderr


def test_films_of_a_folder_are_in_the_order_of_their_names(tmp_path, monkeypatch):
    for name in ("b.mp4", "a.mp4", ".part-c.mp4", "d.txt"):
        (tmp_path / name).touch()
    listed = sorted(tmp_path.iterdir())
    for order in (listed, listed[::-1]):
        monkeypatch.setattr(type(tmp_path), "iterdir", lambda path, order=order: iter(order))
        assert [p.name for p in find_films([tmp_path])] == ["a.mp4", "b.mp4"]
