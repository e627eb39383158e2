"""Evaluation of the answers of participants: distributions, means with intervals, and agreement."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stages.core.errors import InputError
from stages.core.scene.files import provenance, read_json_file, replacing
from stages.core.scene.schema import quote, reason, text, texts, whole
from stages.evaluate.result import format_number
from stages.lab.questionnaire.agreement import coincidences, krippendorff_alpha

DRAWS, LEVEL = 2000, 95  # number of bootstrap samples, and level of the intervals [%]


class Answers(NamedTuple):
    """The ratings of a study."""

    ratings: dict[str, np.ndarray]  # for each scale: array (participants, films) of 1 to `points`, 0 for none
    films: dict[str, dict]  # model, split and file of each film, in column order
    points: int
    missing: int  # number of films shown on the pages of these participants but not answered
    unplayable: int  # number of films that could not be played


def run(study: Path, files: Sequence[Path], out: Path | None, seed: int = 0) -> list[str]:
    """Evaluate answers; return a table as lines of text and write JSON to `out`. `files` may contain folders."""
    paths = find_answers(files)
    answers = read_answers(Path(study), paths)
    rows = {group: {scale: _summary(answers, scale, columns, seed) for scale in answers.ratings}
            for group, columns in _groups(answers.films).items()}  # fmt: skip
    agreement = {scale: _agreement(ratings, answers.points, seed) for scale, ratings in answers.ratings.items()}
    if out is not None:
        with replacing(out) as part:
            data = {"participants": len(paths), "missing": answers.missing, "unplayable": answers.unplayable,
                    "groups": rows, "alpha": agreement,
                    "provenance": provenance("questionnaire", [study, *paths], {"seed": seed})}  # fmt: skip
            part.write_text(json.dumps(data, indent=1) + "\n")
    return _table(rows, agreement, answers, len(paths))


def find_answers(paths: Sequence[Path]) -> list[Path]:
    """The given files, and the JSON files in the given folders. Raises InputError for a folder without any."""
    found = []
    for path in map(Path, paths):
        inside = sorted(path.glob("*.json")) if path.is_dir() else [path]
        if not inside:
            raise InputError(f"{path}: contains no answers (.json); give the files that participants returned")
        found += inside
    return found


def read_answers(study: Path, paths: Sequence[Path]) -> Answers:
    """Read answer files. Raises InputError for files of another study, and for two files of one participant."""
    key = _read_key(study / "key.json")
    films, participants, points, scales = (key[name] for name in ("films", "participants", "points", "scales"))
    column = {film: i for i, film in enumerate(films)}
    ratings = {scale: np.zeros((len(paths), len(films)), dtype=np.int8) for scale in scales}
    seen: dict[str, Path] = {}
    missing = unplayable = 0
    for row, path in enumerate(paths):
        data = read_json_file(path, "the answers of a participant")
        if data.get("study") != key["study"] or str(data.get("participant")) not in participants:
            raise InputError(f"{path}: does not belong to the study {study}; leave it out")
        who = str(data["participant"])
        if who in seen:
            raise InputError(f"{path}: is from participant {who}, as is {seen[who]}; leave one of the two out")
        seen[who] = path
        try:
            rated, skipped = _checked(data, participants[who], scales, points)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: is damaged ({reason(error)}); ask participant {who} for it again") from error
        for film, values in rated.items():
            for scale, value in zip(scales, values, strict=True):
                ratings[scale][row, column[film]] = value
        unplayable += skipped
        missing += len(participants[who]) - len(rated) - skipped
    return Answers(ratings, films, points, missing, unplayable)


def _read_key(path: Path) -> dict:
    """The key of a study: its name, films, the films shown to each participant, and the scales with their points."""
    what = "the key of a study, as `ngff-lab questionnaire FILMS/ -o STUDY/` writes"
    key = read_json_file(path, what)
    try:
        films = {name: {k: text(film[k], k) for k in ("model", "split", "file")} for name, film in key["films"].items()}
        shown = {who: texts(row, "the films of a participant") for who, row in key["participants"].items()}
        points, scales = whole(key["points"], "points", 2, 100), texts(key["scales"], "scales")
        if not films or not set().union(*shown.values()) <= films.keys():
            raise ValueError("a participant is shown a film that is not listed")
        return {"study": text(key["study"], "study"), "films": films, "participants": shown, "points": points,
                "scales": scales}  # fmt: skip
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: is damaged ({reason(error)}); {what} is expected") from error


def _checked(data: dict, shown: list[str], scales: list[str], points: int) -> tuple[dict[str, list[int]], int]:
    """The ratings of each film, and the number of films that could not be played. Raises ValueError if invalid."""
    rated, skipped = {}, set()
    for answer in data["answers"]:
        film = answer["film"]
        if film not in shown or film in rated or film in skipped:
            raise ValueError(f"film {quote(repr(film), 40)} was not shown, or occurs twice")
        if answer.get("unplayable"):
            skipped.add(film)
        else:
            rated[film] = [whole(answer[scale], f"{scale} of film {film}", 1, points) for scale in scales]
    return rated, len(skipped)


def _groups(films: dict[str, dict]) -> dict[str, np.ndarray]:
    """Column masks of each model and split, of each model with several splits, and of all films."""
    names = [(film["model"], film["split"]) for film in films.values()]
    groups: dict[str, list[bool]] = {}
    for model in dict.fromkeys(model for model, _ in names):
        splits = list(dict.fromkeys(split for m, split in names if m == model))
        for split in splits if splits != [""] else []:
            groups[f"{model}/{split}"] = [name == (model, split) for name in names]
        if len(splits) != 1 or splits == [""]:
            groups[model] = [m == model for m, _ in names]
    return {name: np.array(columns) for name, columns in {**groups, "all": [True] * len(names)}.items()}


def _summary(answers: Answers, scale: str, columns: np.ndarray, seed: int) -> dict:
    """Counts of each answer, and the mean score in 0..1 with its bootstrap interval, over some films.

    Participants and films are resampled independently (Owen 2007, "The pigeonhole bootstrap"): both are samples of
    larger populations, and ratings by one participant or of one film are not independent.
    """
    ratings = answers.ratings[scale][:, columns]
    given = ratings > 0
    counts = [int((ratings == k).sum()) for k in range(1, answers.points + 1)]
    scores = np.where(given, (ratings - 1.0) / (answers.points - 1), 0.0)
    rng = np.random.default_rng(seed)
    people, films = (rng.multinomial(n, np.full(n, 1 / n), DRAWS) for n in ratings.shape)
    total, weight = (((people @ x.astype(float)) * films).sum(1) for x in (scores, given))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = float(np.float64(scores.sum()) / given.sum())
        low, high = _interval(total / weight)
    return {"mean": mean, "low": low, "high": high, "counts": counts, "films": int(given.any(0).sum())}


def _agreement(ratings: np.ndarray, points: int, seed: int) -> dict:
    """Krippendorff's alpha with its bootstrap interval, for which films are resampled (Zapf et al. 2016)."""
    pairs = coincidences(ratings, points)
    units = len(pairs)
    draws = np.random.default_rng(seed).multinomial(units, np.full(units, 1 / units), DRAWS)
    drawn = np.einsum("du,ukl->dkl", draws.astype(float), pairs)
    row = {"films": int((pairs.sum((1, 2)) > 0).sum())}
    for name, ordinal in (("ordinal", True), ("interval", False)):
        low, high = _interval(krippendorff_alpha(drawn, ordinal))
        row[name] = {"alpha": float(krippendorff_alpha(pairs.sum(0), ordinal)), "low": low, "high": high}
    return row


def _interval(values: np.ndarray) -> tuple[float, float]:
    """Percentiles of the finite bootstrap values; nan if there are none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return float("nan"), float("nan")
    tail = (100 - LEVEL) / 2
    low, high = np.percentile(finite, [tail, 100 - tail])
    return float(low), float(high)


def _table(rows: dict, agreement: dict, answers: Answers, participants: int) -> list[str]:
    """The results as lines of text."""
    lines, width = [], max(map(len, rows))
    head = " ".join(f"{k:>5}" for k in range(1, answers.points + 1))
    for scale in agreement:
        lines += [f"{scale:<{width}}   mean  {LEVEL} % interval  films  {head}"]
        for group, by_scale in rows.items():
            row = by_scale[scale]
            numbers = " ".join(f"{count:>5}" for count in row["counts"])
            mean, low, high = (format_number(round(row[name], 3)) for name in ("mean", "low", "high"))
            lines.append(f"{group:<{width}}  {mean:>5}  {low:>5} to {high:<5}  {row['films']:>5}  {numbers}")
        lines.append("")
    for scale, row in agreement.items():
        texts = [f"{row[kind]['alpha']:.3f} ({kind}, {row[kind]['low']:.3f} to {row[kind]['high']:.3f})"
                 for kind in ("ordinal", "interval")]  # fmt: skip
        lines.append(f"Krippendorff's alpha of {scale}: {', '.join(texts)}; {row['films']} films rated twice or more")
    lines.append(f"{participants} participants; {answers.missing} films not judged, {answers.unplayable} not playable")
    return lines
