"""The evaluate stage: a prediction and the truth (trajectories, scenes, videos or label images) -> metrics.json.

With --judge, films are instead scored without a truth by a vision-language model.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from pathlib import Path

from stages.core.backends import load
from stages.core.errors import InputError
from stages.core.scene.files import check_json_output, check_output, must_exist, provenance, replacing
from stages.core.scene.formats import FORMATS
from stages.core.torch_state import standard_torch
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import Result, format_table, to_json

log = logging.getLogger(__name__)

# kind of the data (a folder counts as images) -> "module:function" that takes (prediction, truth, options)
COMPARISONS = {
    "trajectory": "stages.evaluate.trajectories:compare",
    "scene": "stages.evaluate.scenes:compare",
    "image": "stages.evaluate.images:compare",
    "video": "stages.evaluate.images:compare",
    "labels": "stages.evaluate.labels:compare",  # a scene, and a folder of label images of its photos
}
OPTION_KINDS = {  # option -> kinds of data to which it applies; other options apply to all
    "align": ("trajectory", "scene"),
    "frames": ("trajectory", "image", "video"),
    "resample": ("trajectory",),
    "objects": ("trajectory",),
    "undistorted": ("labels",),
    "photos": ("trajectory", "labels"),
    "report": tuple(COMPARISONS),
    **dict.fromkeys(["model", "base_url", "repeats", "films_per_question", "timeout", "resume", "seed"], ("films",)),
}
DEFAULTS = EvaluateOptions()


@standard_torch()
def run(
    prediction: Path | Sequence[Path], truth: Path | None, out: Path | None = None,
    options: EvaluateOptions = DEFAULTS, as_json: bool = False,
) -> dict:  # fmt: skip
    """Compare a prediction with the truth, or judge films; print a table (or JSON), and write and return the metrics.

    Metrics are written to `out`, by default metrics.json next to the (first) prediction. With `options.judge` the
    prediction is one or several films or folders of films, and the truth is None. Raises InputError for files that
    cannot be compared and for options that do not apply to them.
    """
    predictions = [Path(p) for p in ([prediction] if isinstance(prediction, (str, Path)) else prediction)]
    out = Path(out or predictions[0].parent / "metrics.json")
    check_json_output(out)
    if options.report is not None:
        check_output(Path(options.report))
    if options.judge:
        result, inputs = _judge(predictions, truth, out, options)
    else:
        result, inputs = _compare(predictions, truth, options)
    for note in result.notes:
        log.info("%s", note)
    facts = to_json(result) | {"provenance": provenance("evaluate", inputs, options)}
    with replacing(out) as part:
        part.write_text(json.dumps(facts, indent=1) + "\n")
    if options.report:
        from stages.evaluate.report import write_report

        write_report(options.report, result, *inputs)
    print(json.dumps(facts, indent=1) if as_json else format_table(result))
    return facts


def _compare(predictions: list[Path], truth: Path | None, options: EvaluateOptions) -> tuple[Result, list[Path]]:
    """The metrics of a prediction, and the paths of both files."""
    if truth is None:
        raise InputError(
            f"{predictions[0]}: the ground truth is missing; name it with --against, or score films with --judge"
        )
    if len(predictions) > 1:
        raise InputError(f"{predictions[1]}: is a second prediction; give only one with --against")
    (prediction,), truth = predictions, Path(truth)
    kind = _common_kind(prediction, truth)
    _check_options(kind, options)
    return load(COMPARISONS[kind])(prediction, truth, options), [prediction, truth]


def _judge(films: list[Path], truth: Path | None, out: Path, options: EvaluateOptions) -> tuple[Result, list[Path]]:
    """The scores of films, and their paths."""
    from stages.evaluate.judge import find_films, judge

    if truth is not None:
        raise InputError(f"--against {truth}: --judge scores films without a ground truth; drop --against or --judge")
    _check_options("films", options)
    films = find_films(films)
    return judge(films, out, options), films


def _common_kind(prediction: Path, truth: Path) -> str:
    """The common kind of data; "labels" for a scene and a folder. Raises InputError if the kinds differ."""
    kinds = _kind(prediction), _kind(truth)
    if kinds[0] == "scene" and truth.is_dir():
        return "labels"
    if COMPARISONS[kinds[0]] != COMPARISONS[kinds[1]]:
        raise InputError(
            f"{prediction}: is of kind {kinds[0]}, but {truth} is of kind {kinds[1]}; give two files of the same kind"
        )
    return kinds[0]


def _kind(path: Path) -> str:
    """Kind of data of a path, by its suffix. Raises InputError unless it exists and can be compared."""
    if path.is_dir():
        return "image"
    suffix = path.suffix.lower()
    if suffix not in FORMATS or FORMATS[suffix].kind not in COMPARISONS:
        raise InputError(f"{path}: files with {f'suffix {suffix}' if suffix else 'no suffix'} cannot be compared; "
                         "give trajectories (.h5), scenes (.ply), videos (.mp4) or folders of images")  # fmt: skip
    kind = FORMATS[suffix].kind
    must_exist(path, f"a file of kind {kind}")
    return kind


def _check_options(kind: str, options: EvaluateOptions) -> None:
    """Raise InputError for an option that does not apply to this kind of data."""
    for name, kinds in OPTION_KINDS.items():
        if getattr(options, name) != getattr(DEFAULTS, name) and kind not in kinds:
            only = "; it belongs to --judge" if kinds == ("films",) else "; omit it"
            raise InputError(f"--{name.replace('_', '-')}: does not apply to files of kind {kind}{only}")
