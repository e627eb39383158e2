"""A study from films to table: actions of participants in a browser, and the resulting table."""

import json
import random
from collections import Counter

import numpy as np
import pytest
import torch

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.scene.images import VideoWriter
from stages.lab.questionnaire.answers import read_answers
from stages.lab.questionnaire.answers import run as tabulate
from stages.lab.questionnaire.assignment import assign_films
from stages.lab.questionnaire.options import StudyOptions
from stages.lab.questionnaire.study import run
from tests.browser import until
from tests.conftest import CliRunner

# physical and photo realism of each model, in the opinion of all participants
OPINIONS = {"ours": (5, 4), "theirs": (2, 4)}


def write_film(path, brightness):
    path.parent.mkdir(parents=True, exist_ok=True)
    with VideoWriter(path, 25.0) as video:
        for k in range(4):
            video.append(torch.full((32, 48, 3), brightness + 0.02 * k))


@pytest.fixture(scope="module")
def films(tmp_path_factory):
    """Films of two models and two splits, two each, and a fifth film of one model."""
    folder = tmp_path_factory.mktemp("films")
    for model in OPINIONS:
        for split in ("new view", "new background"):
            for k in range(2):
                write_film(folder / model / split / f"film{k}.mp4", 0.2 + 0.1 * k)
    write_film(folder / "ours" / "new view" / "film2.mp4", 0.5)
    return folder


@pytest.fixture(scope="module")
def study(films, tmp_path_factory):
    out = tmp_path_factory.mktemp("study") / "study"
    run(films, out, StudyOptions(participants=2, films=4))
    return out


def answer(study, participant, opinion):
    """Answers of a participant as saved by the page; `opinion` of a model is two answers, or None for no answer."""
    key = json.loads((study / "key.json").read_text())
    rows = []
    for film in key["participants"][participant]:
        values = opinion(key["films"][film]["model"])
        rows += [{"film": film, "PhysR": values[0], "PhotoR": values[1], "seconds": 1.0}] if values else []
    return {"study": key["study"], "participant": participant, "answers": rows}


def write_answers(study, folder, opinion):
    for participant in json.loads((study / "key.json").read_text())["participants"]:
        (folder / f"{participant}.json").write_text(json.dumps(answer(study, participant, opinion)))
    return folder


def test_films_are_balanced_over_groups_and_over_films():
    cells = [*"aaaaaaaaaa", *"bbbbbbbbbb", *"cccccccccc", "d"]
    orders = assign_films(cells, participants=30, films=10, seed=0)
    for order in orders:
        assert len(set(order)) == 10
        per_cell = Counter(cells[i] for i in order)
        assert per_cell["d"] == 1 and all(per_cell[c] == 3 for c in "abc")
    shown = Counter(i for order in orders for i in order)
    assert [shown[i] for i in range(30)] == [9] * 30  # 30 participants, 3 of 10 films per group
    assert orders == assign_films(cells, 30, 10, 0) != assign_films(cells, 30, 10, 1)
    places = [order.index(30) for order in orders]
    assert len(set(places)) > 5  # the only film of group d is not always at the same position


def test_all_films_are_shown_where_there_are_few():
    assert sorted(assign_films(["a", "b"], 1, 80, 0)[0]) == [0, 1]


def test_pages_say_nothing_of_the_origin(study, films):
    key = json.loads((study / "key.json").read_text())
    assert {(row["model"], row["split"]) for row in key["films"].values()} == {
        (model, split) for model in OPINIONS for split in ("new view", "new background")
    }
    assert {p.stem for p in (study / "pages" / "films").iterdir()} == set(key["films"])
    for page in (study / "pages").glob("*.html"):
        text = page.read_text()
        assert not any(word in text for word in ("ours", "theirs", "new view", "film0"))


def test_a_study_with_answers_is_not_overwritten(study, films):
    with pytest.raises(InputError, match="already contains a study"):
        run(films, study, StudyOptions())


@pytest.mark.parametrize("arrange", [lambda folder: None, lambda folder: (folder / "ours").mkdir()])
def test_folders_without_films_are_refused(tmp_path, arrange):
    arrange(tmp_path)
    done = CliRunner().invoke(app, ["questionnaire", str(tmp_path), "-o", str(tmp_path / "study")])
    assert done.exit_code == 2 and "films" in done.stderr


def judge_in_browser(page, participant, study):
    """Judge all films as a participant of known opinion, using keys for odd films and the mouse for even ones."""
    key = json.loads((study / "key.json").read_text())
    page.click("#start")
    for k, film in enumerate(key["participants"][participant]):
        until(page, f"document.querySelector('video').src.includes('{film}')")
        until(page, "!document.querySelector('fieldset').disabled")
        assert page.is_disabled("#next")
        values = OPINIONS[key["films"][film]["model"]]
        if k % 2:
            for digit in values:
                page.keyboard.press(str(digit))
            page.keyboard.press("Enter")
        else:
            for scale, value in zip(key["scales"], values, strict=True):
                page.check(f"input[name={scale}][value='{value}']")
            page.click("#next")
    until(page, "!document.querySelector('#end').hidden")


def download(page, folder):
    with page.expect_download() as waiting:
        page.click("#download")
    path = folder / waiting.value.suggested_filename
    waiting.value.save_as(path)
    return path


def open_study(open_page, study, participant):
    return open_page(study / "pages" / f"{participant}.html", "document.readyState === 'complete'",
                     study / "pages" / "films")  # fmt: skip


def test_participants_of_known_opinion_in_a_browser(study, open_page, tmp_path):
    for participant in ("1", "2"):
        page = open_study(open_page, study, participant)
        judge_in_browser(page, participant, study)
        path = download(page, tmp_path)
        assert path.name == f"answers-{participant}.json"
        saved = json.loads(path.read_text())
        assert all(row.pop("seconds") >= 0.1 for row in saved["answers"])  # a film lasts 0.16 s
        expected = answer(study, participant, OPINIONS.get)
        assert saved == {**expected, "answers": [{k: v for k, v in row.items() if k != "seconds"}
                                                 for row in expected["answers"]]}  # fmt: skip
    tabulate(study, [tmp_path], tmp_path / "table.out")
    table = json.loads((tmp_path / "table.out").read_text())
    for model, (physical, photo) in OPINIONS.items():
        assert table["groups"][model]["PhysR"]["mean"] == (physical - 1) / 4
        assert table["groups"][model]["PhotoR"]["mean"] == (photo - 1) / 4
    assert table["groups"]["all"]["PhysR"]["counts"][1] + table["groups"]["all"]["PhysR"]["counts"][4] == 8


def test_a_page_goes_on_where_it_was_left_and_takes_answers_back(films, open_page, tmp_path):
    study = tmp_path / "study"  # a separate study, because the browser keeps the answers to a study between tests
    run(films, study, StudyOptions(participants=1, films=4, seed=7))
    key = json.loads((study / "key.json").read_text())
    page = open_study(open_page, study, "1")
    page.click("#start")
    until(page, "!document.querySelector('fieldset').disabled")
    for press in ("4", "3", "Backspace", "1", "Enter"):
        page.keyboard.press(press)
    until(page, f"document.querySelector('video').src.includes('{key['participants']['1'][1]}')")
    page.reload()
    until(page, "document.querySelector('#count').textContent === 'film 2 of 4'")
    page.keyboard.press("PageUp")
    assert page.text_content("#count") == "film 1 of 4"
    assert page.is_checked("input[name=PhysR][value='4']") and page.is_checked("input[name=PhotoR][value='1']")
    assert page.evaluate("document.querySelector('progress').value") == 1


def test_a_film_that_cannot_be_played_is_passed_over(films, open_page, tmp_path):
    run(films, tmp_path / "study", StudyOptions(participants=1, films=2, seed=5))
    study = tmp_path / "study"
    key = json.loads((study / "key.json").read_text())
    first, second = key["participants"]["1"]
    (study / "pages" / "films" / f"{first}.mp4").write_bytes(b"not a film")
    page = open_study(open_page, study, "1")
    page.click("#start")
    until(page, "!document.querySelector('#next').disabled")
    assert "cannot be played" in page.text_content("#message")
    page.click("#next")
    until(page, "!document.querySelector('fieldset').disabled")
    for press in ("3", "3", "Enter"):
        page.keyboard.press(press)
    until(page, "!document.querySelector('#end').hidden")
    path = download(page, tmp_path)
    answers = read_answers(study, [path])
    assert (answers.unplayable, answers.missing) == (1, 0)
    assert answers.ratings["PhysR"].sum() == 3


def test_intervals_and_agreement_of_noisy_participants(films, tmp_path):
    """Answers of 40 participants scatter by one point; means are near their opinion, and intervals contain it."""
    run(films, tmp_path / "study", StudyOptions(participants=40, films=9))
    rng = random.Random(0)
    (tmp_path / "answers").mkdir()
    write_answers(tmp_path / "study", tmp_path / "answers",
                  lambda model: (3 + (model == "ours") + rng.choice([-1, 0, 1]), rng.randint(1, 5)))  # fmt: skip
    tabulate(tmp_path / "study", [tmp_path / "answers"], tmp_path / "table.json")
    table = json.loads((tmp_path / "table.json").read_text())
    for model, expected in (("ours", 0.75), ("theirs", 0.5)):
        row = table["groups"][model]["PhysR"]
        assert row["low"] < expected < row["high"]
        # Answers are independent, with a standard deviation of sqrt(2/3) points; sampling of both participants and
        # films results in up to three times their variance (Owen 2007, section 4).
        width = 2 * 1.96 * (2 / 3) ** 0.5 / 4 / sum(row["counts"]) ** 0.5
        assert 0.9 * width < row["high"] - row["low"] < 1.1 * 3**0.5 * width
    phys, photo = table["alpha"]["PhysR"]["interval"], table["alpha"]["PhotoR"]["interval"]
    # the variance is 0.25 between films (5 and 4 of 9, one point apart) and 2/3 within: alpha = 0.247 / (0.247 + 0.667)
    assert phys["alpha"] == pytest.approx(0.27, abs=0.08) and phys["low"] < 0.27 < phys["high"]
    assert abs(photo["alpha"]) < 0.05


def test_the_interval_of_the_mean_covers_participants_as_well_as_films(films, tmp_path):
    """Half of the participants like everything, half nothing, so the mean depends on who participates."""
    run(films, tmp_path / "study", StudyOptions(participants=10, films=9))
    (tmp_path / "answers").mkdir()
    likes = {f"{p:02d}": 5 if p % 2 else 1 for p in range(1, 11)}
    for participant, value in likes.items():
        row = answer(tmp_path / "study", participant, lambda model, value=value: (value, value))
        (tmp_path / "answers" / f"{participant}.json").write_text(json.dumps(row))
    tabulate(tmp_path / "study", [tmp_path / "answers"], tmp_path / "table.json")
    row = json.loads((tmp_path / "table.json").read_text())["groups"]["all"]["PhysR"]
    # 10 independent opinions of 0 or 1 have a standard error of 0.5 / sqrt(10) = 0.158
    assert row["mean"] == 0.5
    np.testing.assert_allclose([row["low"], row["high"]], [0.5 - 1.96 * 0.158, 0.5 + 1.96 * 0.158], atol=0.1)


@pytest.mark.parametrize(("change", "message"), [
    (lambda data: data | {"study": "another"}, "does not belong to the study"),
    (lambda data: data | {"participant": "9"}, "does not belong to the study"),
    (lambda data: data | {"answers": data["answers"] + data["answers"][:1]}, "is damaged"),
    (lambda data: data | {"answers": [data["answers"][0] | {"PhysR": 6}]}, "is damaged"),
    (lambda data: data | {"answers": [{"film": "x"}]}, "is damaged"),
    (lambda data: [], "is not the answers"),
])  # fmt: skip
def test_wrong_answers_are_refused(study, tmp_path, change, message):
    path = tmp_path / "answers.json"
    path.write_text(json.dumps(change(answer(study, "1", OPINIONS.get))))
    done = CliRunner().invoke(app, ["questionnaire", str(study), "--answers", str(path)])
    assert done.exit_code == 2 and message in done.stderr and str(path) in done.stderr


def test_two_files_of_one_participant_are_refused_and_unfinished_ones_count(study, tmp_path):
    data = answer(study, "1", lambda model: OPINIONS[model] if model == "ours" else None)
    for name in ("a.json", "b.json"):
        (tmp_path / name).write_text(json.dumps(data))
    with pytest.raises(InputError, match="leave one of the two out"):
        read_answers(study, [tmp_path / "a.json", tmp_path / "b.json"])
    done = CliRunner().invoke(app, ["questionnaire", str(study), "--answers", str(tmp_path / "a.json")])
    assert done.exit_code == 0
    assert f"1 participants; {4 - len(data['answers'])} films not judged" in done.stdout
