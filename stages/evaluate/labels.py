"""Comparison of a scene's objects with label images of its photos: IoU of each object, recall and panoptic quality.

The objects of the Gaussians are alpha composited in the view of each labelled photo; a pixel belongs to the object with
the largest share. Labelled and found objects are compared over all labelled photos together.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.scene.cameras import Cameras
from stages.core.scene.files import must_exist
from stages.core.scene.images import IGNORE_LABEL, read_labels
from stages.core.scene.lens import Undistortion, photo_of
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.schema import flag, numbered, read_json, reason, text
from stages.evaluate.label_pictures import LabelColours, LabelledView, draw_pictures, found_objects
from stages.evaluate.matching import object_labels
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import Result

MIN_FOUND_PIXELS = 60  # fewest pixels of a found object in all views; smaller ones are ignored
NAMES_EXAMPLE = '{"1": {"name": "duck", "core": true}}'
MATCHING_IOU = 0.5  # IoU above which a found object counts as the labelled object (Kirillov et al. 2019)


@dataclass(frozen=True)
class LabelledObject:
    """An object of names.json."""

    name: str
    core: bool  # must be found; other objects count neither as missed nor as false


@dataclass(frozen=True)
class PanopticScores:
    """Labelled and found objects and their overlap, by object number."""

    iou: dict[int, float]  # IoU of each labelled object and the found object matched to it; 0 without a match
    matched: dict[int, int]  # labelled -> found object, for any IoU above 0
    truth_pixels: dict[int, int]  # number of pixels of each labelled object
    found_pixels: dict[int, int]  # number of pixels of each found object with at least MIN_FOUND_PIXELS
    pixels: int  # number of compared pixels, including the background

    @property
    def hits(self) -> dict[int, int]:
        """Matched objects (labelled -> found) with an IoU above MATCHING_IOU."""
        return {t: p for t, p in self.matched.items() if self.iou[t] > MATCHING_IOU}

    @property
    def false(self) -> list[int]:
        """Found objects that match no labelled object."""
        return [p for p in self.found_pixels if p not in self.hits.values()]

    def summary(self) -> dict[str, float | int]:
        """Metrics over all objects, by their names in tables; SQ, RQ and PQ as in Kirillov et al. 2019."""
        hits, asked, found = len(self.hits), len(self.iou), len(self.found_pixels)
        sq = sum(self.iou[t] for t in self.hits) / hits if hits else 0.0
        rq = hits / ((asked + found) / 2) if asked + found else 0.0
        return {
            "IoU": sum(self.iou.values()) / asked if asked else 0.0,
            "pixels": self.pixels,
            "recall": hits / asked if asked else 0.0,
            "SQ": sq,
            "RQ": rq,
            "PQ": sq * rq,
            "objects": asked,
            "found": found,
            "false": len(self.false),
            "false_share": sum(self.found_pixels[p] for p in self.false) / max(1, self.pixels),
        }


@dataclass
class LabelOverlap:
    """Number of pixels of each pair (labelled, found) of objects, summed over images; 0 is the background."""

    table: Counter[tuple[int, int]] = field(default_factory=Counter)

    def add(self, truth: Int[Tensor, "h w"], found: Int[Tensor, "h w"], judged: Bool[Tensor, "h w"]) -> None:
        """Count the judged pixels of one image."""
        base = 1 + max(found.flatten().tolist(), default=0)
        pairs, counts = (truth[judged] * base + found[judged]).unique(return_counts=True)
        for pair, n in zip(pairs.tolist(), counts.tolist(), strict=True):
            self.table[divmod(pair, base)] += n

    def scores(self) -> PanopticScores:
        """Match objects one to one with the largest sum of IoU."""
        truth, found = Counter(), Counter()
        for (t, p), n in self.table.items():
            truth[t] += n
            found[p] += n
        ts = sorted(t for t in truth if t)
        ps = sorted(p for p in found if p and found[p] >= MIN_FOUND_PIXELS)
        iou = np.zeros((len(ts), len(ps)))
        for (r, t), (c, p) in ((a, b) for a in enumerate(ts) for b in enumerate(ps)):
            iou[r, c] = self.table[t, p] / (truth[t] + found[p] - self.table[t, p])
        pairs = [(r, c) for r, c in zip(*linear_sum_assignment(iou, maximize=True), strict=True) if iou[r, c] > 0]
        best = {ts[r]: float(iou[r, c]) for r, c in pairs}
        return PanopticScores(
            {t: best.get(t, 0.0) for t in ts}, {ts[r]: ps[c] for r, c in pairs}, {t: truth[t] for t in ts},
            {p: found[p] for p in ps}, sum(self.table.values()),
        )  # fmt: skip


def compare(prediction: Path, truth: Path, options: EvaluateOptions) -> Result:
    """Compare a scene with the folder `truth` of label images; with a report, pictures of photos are included.

    Raises InputError for a scene without cameras, a folder without names.json or without a label image of any photo of
    the scene, and label images that are not 8-bit with one channel or that differ in size from their photo.
    """
    scene, names = read_scene(prediction), read_label_names(truth)
    files = label_files(truth, prediction, scene.cameras)
    spare = torch.tensor([i for i, o in names.items() if not o.core], dtype=torch.int64)
    overlap, views = LabelOverlap(), []
    for view, file in tqdm(files.items(), unit="photo", leave=False):
        labels, found = read_truth(file, scene.cameras, view, options.undistorted), found_objects(scene, view)
        judged = (labels != IGNORE_LABEL) & ~torch.isin(labels, spare)
        overlap.add(labels, found, judged)
        views += [LabelledView(view, labels, found, judged)] if options.report else []
    scores = overlap.scores()
    if not scores.pixels:
        raise InputError(f"{truth}: no pixel of the label images is compared: all are {IGNORE_LABEL}, or of objects "
                         "that are not core in names.json")  # fmt: skip
    asked = [SceneObject(t, names[t].name if t in names else f"object_{t}") for t in scores.iou]
    rows = dict(zip(scores.iou, object_labels(asked), strict=True))
    parts = {rows[t]: {"IoU": iou, "pixels": scores.truth_pixels[t]} for t, iou in scores.iou.items()}
    notes = _notes(scene, scores, rows)
    if len(spare):
        notes.append("neither asked for nor held against the result: " + ", ".join(names[int(i)].name for i in spare))
    if unnamed := sorted(scores.iou.keys() - names.keys()):
        notes.append(f"labels that names.json does not name, counted as objects: {', '.join(map(str, unnamed))}")
    if absent := sorted({file.name for file in _label_images(truth)} - {file.name for file in files.values()}):
        notes.append(f"label images of photos that the scene has no camera for: {', '.join(absent)}")
    result = Result("labels", {**scores.summary(), "photos": len(files)}, parts, notes)
    colours = LabelColours.of(scores.iou, scores.hits)
    return draw_pictures(result, scene, views, colours, rows, options) if views else result


def read_label_names(folder: Path) -> dict[int, LabelledObject]:
    """Read the objects of names.json by number: {"1": {"name": "duck", "core": true}} or {"1": "duck"}.

    Objects are core by default. Raises InputError for an invalid or absent file.
    """
    path = must_exist(folder / "names.json", f"the names of the labelled objects, {NAMES_EXAMPLE},")
    try:
        rows = numbered(read_json(path), "a label").items()
        named = {i: row if isinstance(row, dict) else {"name": row} for i, row in rows}
        return {i: LabelledObject(text(row["name"], "a name"), flag(row.get("core", True), "core"))
                for i, row in named.items()}  # fmt: skip
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RuntimeError, IndexError) as error:
        raise InputError(f"{path}: is not readable ({reason(error)}); write {NAMES_EXAMPLE}") from error


def label_files(folder: Path, prediction: Path, cameras: Cameras | None) -> dict[int, Path]:
    """Label images a.png or a.jpg.png of photos a.jpg, by camera index. Raises InputError if there are none."""
    if cameras is None or not len(cameras):
        raise InputError(
            f"{prediction}: has no cameras; to compare with label images, give a scene written by `ngff reconstruct`"
        )
    images = {path.stem: path for path in _label_images(folder)}
    stems = [Path(name).stem for name in cameras.names]
    named = {i: images.get(stem, images.get(cameras.names[i])) for i, stem in enumerate(stems)}
    files = {i: file for i, file in named.items() if file}
    if not files:
        raise InputError(
            f"{folder}: contains no label image named like a photo of {prediction}, such as {stems[0]}.png"
        )
    return files


def _label_images(folder: Path) -> list[Path]:
    """The PNG files of a folder, sorted by name, without hidden files."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() == ".png" and not p.name.startswith("."))


def read_truth(file: Path, cameras: Cameras, view: int, undistorted: bool = False) -> Int[Tensor, "h w"]:
    """Read a label image in the view of its photo's camera: undistorted, and at the size of the view.

    Raises InputError unless it is 8-bit with one channel and has the size of the photo (of the view, if `undistorted`).
    """
    labels = read_labels(file, max_bits=8)
    height, width = labels.shape
    (w, h), known = photo_of(cameras, view, undistorted)[1], cameras.photos is not None and not undistorted
    # a view may be smaller than its labels, and its sides are rounded to whole pixels
    same = (width, height) == (w, h) if known else abs(width / height * h - w) <= 0.5 * (1 + width / height)
    if not same:
        raise InputError(
            f"{file}: has {width}x{height} pixels, but the {'photo' if known else 'view'} {cameras.names[view]} has "
            f"{w}x{h}; label the photos as they were given to `ngff reconstruct`, or add --undistorted for labels of "
            "undistorted views"
        )
    return Undistortion.of(cameras, view, (width, height), undistorted).labels(labels)


def _notes(scene: Scene, scores: PanopticScores, rows: dict[int, str]) -> list[str]:
    """Sentences on which objects correspond."""
    listed = ", ".join(
        f"{name} = {scene.name_of(scores.matched[t]) if t in scores.matched else 'nothing'}" for t, name in rows.items()
    )
    notes = [f"objects are compared in the pixels of all labelled photos; matched {listed or 'nothing'}"]
    if scores.false:
        sizes = ", ".join(f"{scene.name_of(p)} ({scores.found_pixels[p]} px)" for p in scores.false)
        notes.append(f"false objects, with an IoU of {MATCHING_IOU} or less: {sizes}")
    return notes
