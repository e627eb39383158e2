"""Options of the stage evaluate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError

MAX_FILMS_PER_QUESTION = 26  # films in one question, which have letters as names


@dataclass(frozen=True)
class EvaluateOptions:
    """Options of the evaluate stage."""

    align: bool = False  # first align the prediction with the truth, by shared cameras or else by objects
    frames: int | None = None  # compare the first N frames only; by default both must have the same number
    resample: bool = False  # interpolate the predicted motion at the frame times of the truth
    objects: str = ""  # names of the objects of the truth to compare: "duck,ball"; default: all
    undistorted: bool = False  # label images are of the undistorted views, not of the photos as taken
    photos: Path | None = None  # folder of the photos, for the report; without, those that are labelled are rendered
    report: Path | None = None  # HTML report with curves and images to write
    judge: bool = False  # have films scored by a vision-language model, to which frames of them are sent
    model: str = ""  # that scores; empty: OPENAI_MODEL
    base_url: str = ""  # of a server with OpenAI's protocol; empty: OPENAI_BASE_URL, or OpenAI's own
    repeats: int = 3  # scores of each film, each with the films in another random order
    films_per_question: int = 4  # most films in one question
    timeout: float = 120.0  # of one question [s]
    resume: bool = False  # continue an interrupted judgement
    seed: int = 0  # of the order of the films

    def __post_init__(self):
        if self.frames is not None and self.frames < 1:
            raise InputError(f"--frames {self.frames}: give the number of frames to compare, 1 or more")
        if self.report is not None and Path(self.report).suffix.lower() not in (".html", ".htm"):
            raise InputError(f"--report {self.report}: the report is an HTML file; use the suffix .html")
        if self.repeats < 1:
            raise InputError(f"--repeats {self.repeats}: give 1 or more")
        if not 1 <= self.films_per_question <= MAX_FILMS_PER_QUESTION:
            raise InputError(f"--films-per-question {self.films_per_question}: give 1 to {MAX_FILMS_PER_QUESTION}")
        if self.photos is not None and self.report is None:
            raise InputError(f"--photos {self.photos}: are shown in the report; add --report FILE.html")

    @property
    def object_names(self) -> list[str]:
        """The names in `objects`."""
        return [name.strip() for name in self.objects.split(",") if name.strip()]
