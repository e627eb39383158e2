"""Benchmark of `segment` on real photos: recall, IoU and panoptic quality against label images.

Each photo set is reconstructed and segmented with default options, and its objects are compared with the label images
of some of its photos. The reference is the same scene labelled by those label images, with the voting of `segment
--masks`: no segmentation of this reconstruction can be expected to be much better.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.perception.voting import apply_votes, collect_votes
from stages.core.scene.files import replacing
from stages.core.scene.images import IGNORE_LABEL, list_photos
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.evaluate.labels import compare, label_files, read_truth
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import Result
from stages.lab.bench import common as bench
from stages.lab.bench.reconstruct import photo_folder
from stages.lab.bench.scene_options import SegmentPhotosOptions

METRICS = {"recall": "recall", "PQ": "PQ", "SQ": "SQ", "RQ": "RQ", "IoU": "mean IoU"}  # key in the results: heading
HEADINGS = ["set", "photos placed", "labelled", "objects", "found", *METRICS.values(), "false share", "PQ by labels",
            "reconstruct", "segment"]  # fmt: skip


def run(sets: list[Path], out: Path | None, options: SegmentPhotosOptions) -> Iterator[str]:
    """Yield a line for each set; `out` receives all results as JSON, and a Markdown file next to it the table.

    The row of a set that cannot be reconstructed holds the error message.
    """
    folders = {folder.resolve().name: (photo_folder(folder), labels_of(folder, options)) for folder in map(Path, sets)}
    device = pick_device(options.device)
    yield bench.machine(device)
    yield _text_row(HEADINGS)
    facts = {"options": {"device": device}, "sets": {}}
    for name, (photos, labels) in folders.items():
        facts["sets"][name] = measure(name, photos, labels, options)
        yield _text_row(_cells(name, facts["sets"][name]))
        bench.write_results(out, "segment PHOTOSET...", device, facts)
    if out is not None:
        with replacing(Path(out).with_suffix(".md")) as part:
            part.write_text("\n".join(markdown(facts, bench.machine(device))) + "\n")


def labels_of(folder: Path, options: SegmentPhotosOptions) -> Path:
    """The folder of label images of a photo set. Raises InputError if there is none."""
    given = options.labels
    places = [folder / "labels"] if given is None else [Path(given) / folder.resolve().name, Path(given)]
    found = next((place for place in places if (place / "names.json").exists()), None)
    if found is None:
        raise InputError(f"{places[0]}: contains no names.json; give the folder of the label images with --labels")
    return found


def measure(name: str, photos: Path, labels: Path, options: SegmentPhotosOptions) -> dict:
    """The row of one set; only the error message if its photos or labels cannot be used."""
    with tempfile.TemporaryDirectory() as temporary:
        path, by_labels = Path(options.labelled or temporary) / f"{name}.ply", Path(temporary) / "by_labels.ply"
        try:
            seconds = {} if path.exists() else _make(photos, path, options)
            found, scene = compare(path, labels, EvaluateOptions()), read_scene(path)
            write_scene(by_labels, label_by_truth(scene, path, labels))
            best = compare(by_labels, labels, EvaluateOptions())
        except InputError as error:
            return {"failed": str(error).removeprefix(f"{photos}: ")}
    counts = {"photos": len(list_photos(photos)), "placed": len(scene.cameras)}
    return {**counts, **_scores(found), "by_labels": _scores(best), "seconds": seconds}


def _make(photos: Path, path: Path, options: SegmentPhotosOptions) -> dict[str, float]:
    """Reconstruct and segment a photo set with default options; return the time of each stage [s]."""
    from stages.reconstruct.options import ReconstructOptions
    from stages.reconstruct.stage import run as reconstruct
    from stages.segment.stage import run as segment

    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        reconstruct(photos, Path(folder) / "scene.ply", ReconstructOptions(device=options.device))
        middle = time.perf_counter()
        segment(Path(folder) / "scene.ply", path)
    return {"reconstruct": round(middle - start, 1), "segment": round(time.perf_counter() - middle, 1)}


def label_by_truth(scene: Scene, path: Path, labels: Path) -> Scene:
    """The scene of the file `path`, labelled by voting of the label images; ignored pixels count as background."""
    blank = replace(scene.gaussians, object_id=torch.zeros_like(scene.gaussians.object_id))
    blank = replace(scene, gaussians=blank, objects=())
    images = ((view, read_truth(file, scene.cameras, view)) for view, file in
              label_files(labels, path, scene.cameras).items())  # fmt: skip
    votes = collect_votes(blank, ((view, torch.where(image == IGNORE_LABEL, 0, image)) for view, image in images))
    return apply_votes(blank, votes, {}, str(labels))


def _scores(result: Result) -> dict:
    scores = {key: round(value, 4) for key, value in result.overall.items()}
    scores["labelled_photos"] = scores.pop("photos")
    return {**scores, "objects_iou": {name: round(row["IoU"], 3) for name, row in result.parts.items()}}


def _cells(name: str, row: dict) -> list[str]:
    """One row of the table, as text."""
    if "failed" in row:
        return [name, row["failed"]]
    seconds = [f"{row['seconds'][stage]:.0f} s" if row["seconds"] else "ready" for stage in ("reconstruct", "segment")]
    counts = [str(row[key]) for key in ("labelled_photos", "objects", "found")]
    scores = [*(f"{row[key]:.2f}" for key in METRICS), f"{row['false_share']:.3f}", f"{row['by_labels']['PQ']:.2f}"]
    return [name, f"{row['placed']} of {row['photos']}", *counts, *scores, *seconds]


def _text_row(cells: list[str]) -> str:
    widths = [max(8, len(heading) + 2) for heading in HEADINGS]
    return f"{cells[0]:14s}" + "".join(f"{cell:>{width}}" for cell, width in zip(cells[1:], widths[1:], strict=False))


def markdown(facts: dict, machine: str) -> Iterator[str]:
    """The results as a Markdown page."""
    yield "# Segmentation of real photos"
    yield ""
    yield (
        f"`ngff-lab bench segment PHOTOSET...`, {machine}. Each set reconstructed and segmented with default options "
        "and compared with hand-made label images (definitions: `stages/evaluate/README.md`). PQ by labels: the same "
        "scene labelled by a vote of these label images."
    )
    yield ""
    yield f"| {' | '.join(HEADINGS)} |"
    yield f"|{' --- |' * len(HEADINGS)}"
    for name, row in facts["sets"].items():
        yield f"| {' | '.join(_cells(name, row))} |"
