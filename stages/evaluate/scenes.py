"""Two static scenes: how far apart their surfaces are, in place, in colour and in what belongs to which object."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.harmonics import C0
from stages.core.geometry.neighbours import knn
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.evaluate.align import ReferenceFrame, check_same_reference_frame, find_alignment
from stages.evaluate.matching import object_labels
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import Result

SOLID = 0.1  # opacity above which a Gaussian is part of a surface


@dataclass(frozen=True)
class NearestNeighbours:
    """For each point of one cloud, the nearest of the other."""

    distance: Float[Tensor, "n"]
    index: Int[Tensor, "n"]


def nearest_neighbours(points: Float[Tensor, "n 3"], others: Float[Tensor, "m 3"]) -> NearestNeighbours:
    distance, index = knn(others, points, 1)
    return NearestNeighbours(distance[:, 0], index[:, 0])


def chamfer(there: NearestNeighbours, back: NearestNeighbours) -> dict[str, float]:
    """Mean distance to the nearest point in each direction, and the mean of the two [units].

    Prediction to truth is large where something was invented, truth to prediction where something is missing.
    """
    forth, home = float(there.distance.mean()), float(back.distance.mean())
    return {"chamfer": (forth + home) / 2, "to_truth": forth, "to_prediction": home}


def base_colours(g: Gaussians) -> Float[Tensor, "n 3"]:
    """Colour of each Gaussian without its dependence on the direction of view."""
    return (g.sh[:, 0] * C0 + 0.5).clamp(0, 1)


def colour_error(mine: Gaussians, true: Gaussians, there: NearestNeighbours, back: NearestNeighbours) -> float:
    """Mean absolute difference of RGB (0..1) between nearest neighbours, both directions alike."""
    a, b = base_colours(mine), base_colours(true)
    return float(((a - b[there.index]).abs().mean() + (b - a[back.index]).abs().mean()) / 2)


def label_iou(predicted: Int[Tensor, "n"], true: Int[Tensor, "n"]) -> dict[int, tuple[int, float]]:
    """Intersection over union of each true object with the predicted one it is matched to (0 when with none).

    Labels are of the same points; background (0) is no object. Objects are matched one to one with the largest
    sum of IoU. Returns {true id: (predicted id, IoU)}.
    """
    ids = [int(i) for i in true.unique() if i > 0]
    others = [int(i) for i in predicted.unique() if i > 0]
    table = torch.zeros(len(ids), len(others), dtype=torch.float64)
    for r, i in enumerate(ids):
        for c, j in enumerate(others):
            either = ((true == i) | (predicted == j)).sum()
            table[r, c] = ((true == i) & (predicted == j)).sum() / either
    matched = dict.fromkeys(ids, (0, 0.0))
    for r, c in zip(*linear_sum_assignment(table.numpy(), maximize=True), strict=True):
        if table[r, c] > 0:
            matched[ids[r]] = (others[c], float(table[r, c]))
    return matched


def compare(prediction: Path, truth: Path, options: EvaluateOptions) -> Result:
    """Chamfer, colour and, where both have objects, labels."""
    scenes = [read_scene(prediction), read_scene(truth)]
    worlds = [scene_reference_frame(path, scene) for path, scene in zip((prediction, truth), scenes, strict=True)]
    mine, true = (_solid(path, s) for path, s in zip((prediction, truth), scenes, strict=True))
    notes = [f"only Gaussians of opacity above {SOLID} count"]
    means = mine.means
    if options.align:
        similarity, how = find_alignment(*worlds)
        means = similarity(means)
        notes.append(how)
    else:
        check_same_reference_frame(*worlds, [])
    there, back = nearest_neighbours(means, true.means), nearest_neighbours(true.means, means)
    overall = {**chamfer(there, back), "colour": colour_error(mine, true, there, back), "Gaussians": len(mine)}
    parts: dict[str, dict[str, float]] = {}
    if (mine.object_id > 0).any() and (true.object_id > 0).any():
        parts = _labels(scenes, mine.object_id[back.index], true.object_id, notes)
        overall["IoU"] = sum(row["IoU"] for row in parts.values()) / len(parts)
    return Result("scenes", overall, parts, notes)


def _labels(scenes: list[Scene], predicted: Tensor, true: Tensor, notes: list[str]) -> dict[str, dict[str, float]]:
    """One row a true object, and a note of what each was matched to."""
    matched = label_iou(predicted, true)
    mine, names = ({o.id: n for o, n in zip(s.objects, object_labels(list(s.objects)), strict=True)} for s in scenes)
    found = ", ".join(f"{names[i]} = {mine.get(j, 'nothing')}" for i, (j, _) in matched.items())
    notes.append(f"each true Gaussian takes the label of the nearest predicted one; matched {found}")
    return {names[i]: {"IoU": iou} for i, (_, iou) in matched.items()}


def scene_reference_frame(path: Path, scene: Scene) -> ReferenceFrame:
    g = scene.gaussians
    points = {o.id: g.means[g.object_id == o.id] for o in scene.objects}
    return ReferenceFrame(str(path), scene.cameras, tuple(o for o in scene.objects if len(points[o.id])), points)


def _solid(path: Path, scene: Scene) -> Gaussians:
    g = scene.gaussians[scene.gaussians.opacities > SOLID]
    if not len(g):
        raise InputError(f"{path}: no Gaussian is more opaque than {SOLID}, so there is no surface to compare")
    return g
