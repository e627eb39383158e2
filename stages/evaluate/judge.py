"""Scores of films by a vision-language model: PhysR and PhotoR of the NGFF paper (ICLR 2026).

Source: the paper's section on video generation; the prompt is our own. The model sees ten evenly spaced frames of each
film and answers with two scores from 0 to 1. In every repeat the films are in another random order, several in one
question, under letters that do not reveal their origin.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import random
import string
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean, stdev

from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.models.chat_completions import ChatEndpoint, InvalidReply, image_part, json_object
from stages.core.scene.files import check_output, replacing, sha256
from stages.core.scene.formats import VIDEO_SUFFIXES
from stages.core.scene.images import sample_frames
from stages.core.scene.schema import parse_json, quote
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import Result

log = logging.getLogger(__name__)
FRAMES, LONGEST = 10, 512  # frames sent of each film, and their longest side [px]
TRIES = 3  # unusable replies after which a question is given up
SCORES = {"PhysR": "physical_realism", "PhotoR": "photo_realism"}  # name in tables: name in replies
PROMPT = """\
You judge short films of objects that fall, collide, deform or come to rest. Some are camera recordings, some are \
computer generated; do not try to tell which. Of each film you see frames that are evenly spaced in time, in order.

Give each film two scores, plain numbers from 0 (worst) to 1 (best):

- "physical_realism": do the objects move as real ones would? Consider gravity, contact and support, bouncing, \
friction, deformation that fits the material, and whether objects keep their number, shape and size. A film in which \
nothing moves although something should scores low.
- "photo_realism": does it look like a real recording? Consider shape, texture, material, light, shadow, sharpness, \
artefacts, and whether looks stay the same from frame to frame.

Judge each film by itself and each score independently of the other. Answer with nothing but one JSON object with one \
entry for each film, here {names}, for example
{example}"""

Rows = dict[str, dict[str, float]]  # letter of a film in a question: its scores


def judge(films: Sequence[Path], out: Path, options: EvaluateOptions) -> Result:
    """Score films; returns mean and standard deviation of the scores of each film over the repeats.

    `out` is the path to which the metrics will be written. Next to it OUT.replies.json keeps every usable reply, from
    which --resume continues. Questions without a usable reply are left out and counted in the notes. Raises InputError
    for films that cannot be read, an endpoint that fails, and if no reply can be used.
    """
    endpoint = ChatEndpoint.from_environment(options.model, options.timeout, options.base_url)
    jpegs = [sample_frames(film, FRAMES, LONGEST) for film in tqdm(films, unit="film")]
    for film, frames in zip(films, jpegs, strict=True):
        if len(frames) < 2:
            raise InputError(f"{film}: has only one frame; give a film of two or more frames")
    log.info("sending %d frames of %d films, %d times, to %s at %s", sum(map(len, jpegs)), len(films),
             options.repeats, endpoint.model, endpoint.url)  # fmt: skip
    questions = draw_questions(len(films), options)
    answers = _ask_all(endpoint, questions, jpegs, _Record(out, films, endpoint, options))
    scores: list[dict[str, list[float]]] = [{name: [] for name in SCORES} for _ in films]
    for question, answer in zip(questions, answers, strict=True):
        for letter, i in question.items():
            for name in SCORES if answer else ():
                scores[i][name].append(answer[letter][name])
    failed = sum(answer is None for answer in answers)
    if failed == len(answers):
        raise InputError(
            f"{endpoint.model} at {endpoint.url}: no answer of the model could be used; try another --model"
        )
    return _result(films, scores, _notes(films, jpegs, questions, failed, endpoint))


def find_films(paths: Sequence[Path]) -> list[Path]:
    """The films among the paths, and in folders among them. Raises InputError for other files and repeated films."""
    films = []
    for path in map(Path, paths):
        inside = sorted(p for p in path.iterdir() if _is_film(p)) if path.is_dir() else [path]
        if not inside:
            raise InputError(f"{path}: contains no films; supported formats: {' '.join(sorted(VIDEO_SUFFIXES))}")
        if not path.is_dir() and path.suffix.lower() not in VIDEO_SUFFIXES:
            raise InputError(f"{path}: is not a film; give {', '.join(sorted(VIDEO_SUFFIXES))} or folders of them "
                             "(render a trajectory with `ngff render` first)")  # fmt: skip
        films += inside
    twice = {film for film in films if films.count(film) > 1}
    if twice:
        raise InputError(f"{min(twice)}: is given twice; give each film once")
    return films


def _is_film(path: Path) -> bool:
    return path.suffix.lower() in VIDEO_SUFFIXES and not path.name.startswith(".")


def draw_questions(count: int, options: EvaluateOptions) -> list[dict[str, int]]:
    """Films of each question, by letter; each repeat has a new random order, split into questions of similar size."""
    rng, questions = random.Random(options.seed), []
    parts = math.ceil(count / options.films_per_question)
    for _ in range(options.repeats):
        order = rng.sample(range(count), count)
        for k in range(parts):
            group = order[count * k // parts : count * (k + 1) // parts]
            questions.append(dict(zip(string.ascii_uppercase, group, strict=False)))
    return questions


def _ask_all(
    endpoint: ChatEndpoint, questions: list[dict[str, int]], jpegs: list[list[bytes]], record: _Record
) -> list[Rows | None]:
    """Answers to all questions; None where no reply could be used."""
    answers = []
    for k, question in enumerate(tqdm(questions, unit="question")):
        parse = partial(parse_scores, letters=list(question))
        answer = record.answer(k, parse)
        if answer is None:
            messages = [{"role": "user", "content": _content(question, jpegs)}]
            try:
                answer, replies = endpoint.ask_until_valid(messages, parse, TRIES)
                record.add(k, replies[-1])
            except InvalidReply as error:
                log.warning("%d answers to one question could not be used, the last because %s", TRIES, error)
        answers.append(answer)
    return answers


def _content(question: dict[str, int], jpegs: list[list[bytes]]) -> list[dict]:
    """Content of the message: instructions, then the letter and the frames of each film."""
    example = {letter: dict.fromkeys(SCORES.values(), 0.5) for letter in question}
    parts = [{"type": "text", "text": PROMPT.format(names=", ".join(question), example=json.dumps(example))}]
    for letter, i in question.items():
        parts += [{"type": "text", "text": f"Film {letter}, {len(jpegs[i])} frames:"}, *map(image_part, jpegs[i])]
    return parts


def parse_scores(reply: str, letters: list[str]) -> Rows:
    """Parse a reply to {letter: {PhysR, PhotoR}}. Raises InvalidReply unless each film has two numbers from 0 to 1."""
    data = json_object(reply)
    if set(data) != set(letters):
        raise InvalidReply(f"it has entries {quote(', '.join(data))}; they must be {', '.join(letters)}")
    return {letter: {name: _score(letter, data[letter], key) for name, key in SCORES.items()} for letter in letters}


def _score(letter: str, row: object, key: str) -> float:
    if not isinstance(row, dict) or key not in row:
        raise InvalidReply(f"the entry of {letter} must have {' and '.join(SCORES.values())}")
    value = row[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 <= value <= 1:
        raise InvalidReply(f"{key} of {letter} is {quote(json.dumps(value), 40)}, not a number from 0 to 1")
    return float(value)


class _Record:
    """OUT.replies.json: the usable reply to each question, by number, and the settings on which questions depend."""

    def __init__(self, out: Path, films: Sequence[Path], endpoint: ChatEndpoint, options: EvaluateOptions):
        check_output(out)  # before any question is sent
        self.path = out.with_suffix(".replies.json")
        settings = {"url": endpoint.url, "model": endpoint.model, "repeats": options.repeats, "seed": options.seed,
                    "films_per_question": options.films_per_question, "frames": FRAMES, "longest": LONGEST,
                    "prompt": hashlib.sha256(PROMPT.encode()).hexdigest()}  # fmt: skip
        self.head = {"settings": settings, "films": [{"name": f.name, "sha256": sha256(f)} for f in films]}
        self.replies: dict[str, str] = self._earlier() if options.resume and self.path.exists() else {}

    def add(self, k: int, reply: str) -> None:
        """Store the reply to question k."""
        self.replies[str(k)] = reply
        with replacing(self.path) as part:
            part.write_text(json.dumps({**self.head, "replies": self.replies}, indent=1) + "\n")

    def answer(self, k: int, parse: Callable[[str], Rows]) -> Rows | None:
        """Scores in the stored reply to question k; None without one. Raises InputError if the reply was changed."""
        try:
            return parse(self.replies[str(k)]) if str(k) in self.replies else None
        except (InvalidReply, AttributeError) as error:
            raise InputError(f"{self.path}: reply {k} was changed; start again without --resume") from error

    def _earlier(self) -> dict[str, str]:
        try:
            data = parse_json(self.path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise InputError(f"{self.path}: is damaged ({quote(error)}); start again without --resume") from error
        if not isinstance(data, dict) or {k: data.get(k) for k in self.head} != self.head or \
                not isinstance(data.get("replies"), dict):  # fmt: skip
            raise InputError(f"{self.path}: belongs to other films or options; start again without --resume")
        return data["replies"]


def _result(films: Sequence[Path], scores: list[dict[str, list[float]]], notes: list[str]) -> Result:
    """The result, with a row for each film and, if there are several folders, for each folder."""
    rows = {str(film): _summary(row) for film, row in zip(films, scores, strict=True)}
    folders = list(dict.fromkeys(film.parent for film in films))
    if len(folders) > 1:
        for folder in folders:
            rows[f"{folder}/"] = _over_films([rows[str(film)] for film in films if film.parent == folder])
    return Result("films", _over_films([rows[str(film)] for film in films]), rows, notes)


def _summary(scores: dict[str, list[float]]) -> dict[str, float | int]:
    """Mean and sample standard deviation of the scores of one film."""
    row: dict[str, float | int] = {}
    for name, values in scores.items():
        row[name] = fmean(values) if values else math.nan
        row[f"{name}_sd"] = stdev(values) if len(values) > 1 else math.nan
    return {**row, "repeats": len(next(iter(scores.values())))}


def _over_films(rows: list[dict[str, float | int]]) -> dict[str, float | int]:
    """Mean and sample standard deviation over several films, of their mean scores over repeats."""
    judged = [row for row in rows if row["repeats"]]
    return {**_summary({name: [row[name] for row in judged] for name in SCORES}),
            "repeats": sum(row["repeats"] for row in rows)}  # fmt: skip


def _notes(
    films: Sequence[Path], jpegs: list[list[bytes]], questions: list, failed: int, endpoint: ChatEndpoint
) -> list[str]:
    """Notes on the model that judged, and on missing frames and answers."""
    notes = [f"judged by {endpoint.model} at {endpoint.url}: {len(questions)} questions about {len(films)} films"]
    short = [f"{film.name} ({len(frames)})" for film, frames in zip(films, jpegs, strict=True) if len(frames) < FRAMES]
    if short:
        notes.append(f"fewer than {FRAMES} frames: {', '.join(short)}")
    if failed:
        notes.append(f"{failed} of {len(questions)} questions got no usable answer in {TRIES} tries and are left out")
    return notes
