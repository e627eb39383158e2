"""Stage evaluate: a prediction and the truth (trajectories, scenes, videos, or label images) -> metrics.json."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from stages.core.backends import choose
from stages.core.errors import InputError
from stages.core.scene.files import must_exist, provenance, replacing
from stages.core.scene.formats import FORMATS
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import format_table, to_json

log = logging.getLogger(__name__)

# kind of the truth (a folder counts as images) -> "module:function" that takes (prediction, truth, options)
COMPARISONS = {
    "trajectory": "stages.evaluate.trajectories:compare",
    "scene": "stages.evaluate.scenes:compare",
    "image": "stages.evaluate.images:compare",
    "video": "stages.evaluate.images:compare",
    "labels": "stages.evaluate.labels:compare",  # of a scene: a folder of label images of its photos
}
OPTION_KINDS = {  # options that apply to some kinds of data only
    "align": ("trajectory", "scene"),
    "frames": ("trajectory", "image", "video"),
    "resample": ("trajectory",),
    "objects": ("trajectory",),
    "undistorted": ("labels",),
    "photos": ("labels",),
}


def run(
    prediction: Path, truth: Path, out: Path | None = None, options: EvaluateOptions = EvaluateOptions(),  # noqa: B008
    as_json: bool = False,
) -> dict:
    """Compare a prediction with the truth; print a table (or JSON) and return the metrics written to `out`.

    `out` is metrics.json next to the prediction by default. Raises InputError for files that cannot be compared and for
    options that do not apply to them.
    """
    prediction, truth = Path(prediction), Path(truth)
    kind = _common_kind(prediction, truth)
    _check_options(kind, options)
    result = choose(COMPARISONS, kind)(prediction, truth, options)
    for note in result.notes:
        log.info("%s", note)
    facts = to_json(result) | {"provenance": provenance("evaluate", [prediction, truth], options)}
    with replacing(out or prediction.parent / "metrics.json") as part:
        part.write_text(json.dumps(facts, indent=1) + "\n")
    if options.report:
        from stages.evaluate.report import write_report

        write_report(options.report, result, prediction, truth)
    print(json.dumps(facts, indent=1) if as_json else format_table(result))
    return facts


def _common_kind(prediction: Path, truth: Path) -> str:
    """Kind of data of both, which is "labels" for a scene and a folder; InputError where they differ."""
    kinds = _kind(prediction), _kind(truth)
    if kinds[0] == "scene" and truth.is_dir():
        return "labels"
    if COMPARISONS[kinds[0]] != COMPARISONS[kinds[1]]:
        raise InputError(
            f"{prediction}: is of kind {kinds[0]}, but {truth} is of kind {kinds[1]}; give two files of one kind"
        )
    return kinds[0]


def _kind(path: Path) -> str:
    """Kind of data of a path, by its suffix; InputError unless it can be compared and exists."""
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
    """InputError for an option that has no effect on this kind of data."""
    for name, kinds in OPTION_KINDS.items():
        if getattr(options, name) not in (None, False, "") and kind not in kinds:
            raise InputError(f"--{name}: does not apply to files of kind {kind}; omit it")
