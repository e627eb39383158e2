"""Options of the evaluate stage."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError
from stages.core.options import check_types, option

MAX_FILMS_PER_QUESTION = 26  # most films in one question, as they are named by letters


@dataclass(frozen=True)
class EvaluateOptions:
    """Options of the evaluate stage."""

    align: bool = option(
        False, "first align the prediction with the ground truth, by cameras or objects that both share"
    )
    frames: int | None = option(
        None, "compare only the first N frames; default: all frames, whose numbers must be equal"
    )
    resample: bool = option(False, "interpolate the predicted motion at the frame times of the ground truth")
    objects: str = option("", "names of the objects to compare, such as duck,ball; default: all")
    undistorted: bool = option(False, "label images belong to undistorted views; default: to the photos as taken")
    photos: Path | None = option(
        None, "folder of the photos shown in the report (--report) of a trajectory or of label images"
    )
    report: Path | None = option(None, "report with curves and images to write (.html)")
    judge: bool = option(
        False,
        "let a vision-language model score films from 0 to 1 (PhysR and PhotoR). Sends ten frames of "
        "each film (JPEG, at most 512 px) but no names or other data to $OPENAI_BASE_URL, with "
        "$OPENAI_API_KEY; without --judge nothing is sent",
    )
    model: str = option("", "with --judge: name of a model that accepts images; default: $OPENAI_MODEL")
    base_url: str = option(
        "", "with --judge: address of a server with OpenAI's protocol; default: $OPENAI_BASE_URL, else OpenAI's server"
    )
    repeats: int = option(
        3, "with --judge: number of times each film is scored; mean and standard deviation are reported"
    )
    films_per_question: int = option(
        4, "with --judge: maximum number of films in one request, in random order and named by letters"
    )
    timeout: float = option(120.0, "with --judge: maximum waiting time for an answer [s]")
    resume: bool = option(False, "with --judge: continue an interrupted run from its stored answers")
    seed: int = option(0, "with --judge: random seed of the order of the films", min=0)

    def __post_init__(self):
        check_types(self)
        if self.frames is not None and self.frames < 1:
            raise InputError(f"--frames {self.frames}: give the number of frames to compare, 1 or more")
        if self.report is not None and Path(self.report).suffix.lower() not in (".html", ".htm"):
            raise InputError(f"--report {self.report}: the report is an HTML file; use the suffix .html")
        if self.repeats < 1:
            raise InputError(f"--repeats {self.repeats}: give 1 or more")
        if not 1 <= self.films_per_question <= MAX_FILMS_PER_QUESTION:
            raise InputError(f"--films-per-question {self.films_per_question}: give 1 to {MAX_FILMS_PER_QUESTION}")
        if self.photos is not None and self.report is None:
            raise InputError(f"--photos {self.photos}: photos are only shown in a report; add --report FILE.html")

    @property
    def object_names(self) -> list[str]:
        """The names in `objects`."""
        return [name.strip() for name in self.objects.split(",") if name.strip()]
