"""Creation of a study: pages for participants, their films, and the key that maps each film to its model."""

from __future__ import annotations

import hashlib
import json
import logging
import random
from html import escape
from pathlib import Path

from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.player.film import fill_template
from stages.core.scene.files import provenance, replacing, sha256
from stages.core.scene.images import VideoWriter, read_video, video_info
from stages.evaluate.judge import find_films
from stages.lab.questionnaire.assignment import assign_films
from stages.lab.questionnaire.options import StudyOptions

log = logging.getLogger(__name__)
WEB = Path(__file__).parent / "web"
POINTS = 5  # number of points of both scales
SCALES = {  # name in tables: question, explanation, and meaning of the lowest and the highest answer
    "PhysR": ("Do the objects move as real ones would?",
              "Think of falling, support, collisions, bouncing, sliding and bending, and of whether objects keep their "
              "number, shape and size.", "not at all", "exactly"),
    "PhotoR": ("Does it look like a real recording?",
               "Think of shapes, textures, light, shadows, sharpness and flaws of the picture, not of how things move.",
               "not at all", "exactly"),
}  # fmt: skip


def run(folder: Path, out: Path, options: StudyOptions) -> list[str]:
    """FOLDER/MODEL/SPLIT/*.mp4 or FOLDER/MODEL/*.mp4 -> OUT/key.json and OUT/pages/; returns lines about the result.

    Films are re-encoded without sound and metadata, under names that do not reveal their origin. Raises InputError for
    a folder without films, unreadable films, and an output folder that already has a study.
    """
    folder, out = Path(folder), Path(out)
    if (out / "key.json").exists():
        raise InputError(
            f"{out}: already contains a study, whose answers need its key.json; name another folder with -o"
        )
    films = find_cells(folder)
    pages = out / "pages"
    (pages / "films").mkdir(parents=True, exist_ok=True)
    rng, ids = random.Random(options.seed), []
    while len(ids) < len(films):
        name = f"{rng.getrandbits(32):08x}"
        ids += [name] if name not in ids else []
    rows, unusual = {}, []
    for name, (film, model, split) in tqdm(zip(ids, films.values(), strict=True), total=len(ids), unit="film"):
        if not 1 <= _encode(film, pages / "films" / f"{name}.mp4") <= 10:
            unusual.append(str(film.relative_to(folder)))
        rows[name] = {"model": model, "split": split, "file": str(film.relative_to(folder)), "sha256": sha256(film)}
    if unusual:
        log.warning(
            "%d films last less than 1 s or more than 10 s, such as %s; 2 to 3 s are usual", len(unusual), unusual[0]
        )
    cells = [f"{row['model']}/{row['split']}" for row in rows.values()]
    orders = assign_films(cells, options.participants, options.films, options.seed)
    width = len(str(options.participants))
    participants = {f"{p:0{width}d}": [ids[i] for i in order] for p, order in enumerate(orders, 1)}
    content = {"films": rows, "participants": participants, "points": POINTS, "scales": list(SCALES)}
    study = hashlib.sha256(json.dumps(content).encode()).hexdigest()[:12]
    for participant, shown in participants.items():
        with replacing(pages / f"{participant}.html") as part:
            part.write_text(_page(study, participant, shown), encoding="utf-8")
    with replacing(out / "key.json") as part:  # written last: a study with a key is complete
        info = {"study": study, **content, "provenance": provenance("questionnaire", [folder], options)}
        part.write_text(json.dumps(info, indent=1) + "\n")
    shown = min(options.films, len(ids))
    return [f"{pages}: {options.participants} pages of {shown} films each, of {len(ids)} films in {len(set(cells))} "
            "groups; give each participant one page, together with films/",
            f"{out / 'key.json'}: says which film is whose; keep it from participants"]  # fmt: skip


def find_cells(folder: Path) -> dict[Path, tuple[Path, str, str]]:
    """The films below FOLDER/MODEL/SPLIT or FOLDER/MODEL as (film, model, split); split is "" if there is none."""
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder; give a folder that contains a folder of films for each model")
    films = {}
    for model in sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")):
        splits = sorted(p for p in model.iterdir() if p.is_dir() and not p.name.startswith("."))
        for home in splits or [model]:
            split = home.name if splits else ""
            films |= {film: (film, model.name, split) for film in find_films([home])}
    if not films:
        raise InputError(
            f"{folder}: contains no folders; put the films of each model into a folder named after the model"
        )
    return films


def _encode(film: Path, out: Path) -> float:
    """Re-encode a film for browsers, without metadata that reveals its origin; return its duration [s]."""
    fps = video_info(film)[1] or 25.0
    frames = 0
    with VideoWriter(out, fps) as video:
        for frames, image in enumerate(read_video(film), 1):  # noqa: B007 -- counted
            video.append(image)
    if frames < 2:
        raise InputError(f"{film}: has {frames} frames; give a film of two or more")
    return frames / fps


def _page(study: str, participant: str, films: list[str]) -> str:
    """The HTML file of one participant."""
    data = {"study": study, "participant": participant, "films": films, "scales": list(SCALES), "points": POINTS}
    explanations = "".join(f"<p><b>{escape(question)}</b> {escape(text)} 1: {low}, {POINTS}: {high}.</p>"
                           for question, text, low, high in SCALES.values())  # fmt: skip
    questions = "".join(
        f'<fieldset disabled><legend>{escape(question)}</legend><small class="low">{low}</small>'
        + "".join(f'<label><input type="radio" name="{name}" value="{k}"> {k}</label>' for k in range(1, POINTS + 1))
        + f"<small>{high}</small></fieldset>"
        for name, (question, _, low, high) in SCALES.items()
    )
    return fill_template((WEB / "page.html").read_text(encoding="utf-8"), {
        "PARTICIPANT": participant, "COUNT": str(len(films)), "EXPLANATIONS": explanations, "QUESTIONS": questions,
        "STUDY": json.dumps(data), "STYLE": (WEB / "page.css").read_text(encoding="utf-8"),
        "SCRIPT": (WEB / "page.js").read_text(encoding="utf-8"),
    })  # fmt: skip
