"""Pairs of MP4, H5 or PLY -> metrics.json"""

from __future__ import annotations

import json
import logging
from pathlib import Path

from stages.core.backends import choose
from stages.core.errors import InputError
from stages.core.scene.files import must_exist, provenance, replacing
from stages.core.scene.formats import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.report import write_report
from stages.evaluate.result import format_table, to_json

log = logging.getLogger(__name__)

COMPARISONS = {
    "trajectory": "stages.evaluate.trajectories:compare",
    "scene": "stages.evaluate.scenes:compare",
    "pictures": "stages.evaluate.images:compare",
}


def run(
    prediction: Path, truth: Path, out: Path | None, options: EvaluateOptions, as_json: bool = False
) -> dict:
    """Compares a prediction with the truth; the table goes to stdout, everything to `out` (metrics.json beside it)."""
    prediction, truth = Path(prediction), Path(truth)
    kinds = [_kind(prediction), _kind(truth)]
    if kinds[0] != kinds[1]:
        raise InputError(f"{prediction}: is a {kinds[0]} file and {truth} a {kinds[1]} file; compare two of a kind")
    _check_options(kinds[0], options)
    result = choose(COMPARISONS, kinds[0])(prediction, truth, options)
    for note in result.notes:
        log.info("%s", note)
    facts = to_json(result) | {"provenance": provenance("evaluate", [prediction, truth], options)}
    with replacing(out or prediction.parent / "metrics.json") as part:
        part.write_text(json.dumps(facts, indent=1) + "\n")
    if options.report:
        write_report(options.report, result, prediction, truth)
    print(json.dumps(facts, indent=1) if as_json else format_table(result))
    return facts


def _kind(path: Path) -> str:
    """What a path holds, by its ending."""
    if path.is_dir():
        return "pictures"
    suffix = path.suffix.lower()
    if suffix in (".h5", ".hdf5"):
        kind = "trajectory"
    elif suffix == ".ply":
        kind = "scene"
    elif suffix in VIDEO_SUFFIXES | IMAGE_SUFFIXES:
        kind = "pictures"
    else:
        raise InputError(f"{path}: {suffix or 'no ending'} is not a kind of file that can be compared; "
                         "give trajectories (.h5), scenes (.ply), videos (.mp4) or folders of pictures")  # fmt: skip
    must_exist(path, f"a {kind} file" if kind != "pictures" else "a video or picture")
    return kind


def _check_options(kind: str, options: EvaluateOptions) -> None:
    """An option that could not act is a mistake, not a wish to ignore."""
    only = {
        "--align": (options.align, ("trajectory", "scene")),
        "--frames": (options.frames is not None, ("trajectory", "pictures")),
        "--resample": (options.resample, ("trajectory",)),
        "--objects": (bool(options.objects), ("trajectory",)),
    }
    for name, (given, kinds) in only.items():
        if given and kind not in kinds:
            raise InputError(f"{name}: has no meaning for {kind} files; leave it out")
