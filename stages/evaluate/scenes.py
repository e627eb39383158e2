"""Comparison of two static scenes: geometry, colour and object labels."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.harmonics import C0
from stages.core.geometry.neighbours import knn
from stages.core.scene.gaussians import SURFACE_OPACITY, Gaussians
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.evaluate.align import ReferenceFrame, check_same_reference_frame, find_alignment
from stages.evaluate.matching import object_labels
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import Result


@dataclass(frozen=True)
class NearestNeighbours:
    """The nearest point in another cloud for each point of a cloud."""

    distance: Float[Tensor, "n"]
    index: Int[Tensor, "n"]


def nearest_neighbours(points: Float[Tensor, "n 3"], others: Float[Tensor, "m 3"]) -> NearestNeighbours:
    """Find the nearest of `others` for each of `points`."""
    distance, index = knn(others, points, 1)
    return NearestNeighbours(distance[:, 0], index[:, 0])


def chamfer(to_truth: NearestNeighbours, to_prediction: NearestNeighbours) -> dict[str, float]:
    """Chamfer distance: mean distance to the nearest point in each direction, and the mean of both [scene units].

    "to_truth" is large for surfaces that do not exist, "to_prediction" for missing surfaces.
    """
    forward, backward = float(to_truth.distance.mean()), float(to_prediction.distance.mean())
    return {"chamfer": (forward + backward) / 2, "to_truth": forward, "to_prediction": backward}


def base_colours(g: Gaussians) -> Float[Tensor, "n 3"]:
    """View-independent RGB (0..1) of each Gaussian: the harmonics of degree 0."""
    return (g.sh[:, 0] * C0 + 0.5).clamp(0, 1)


def colour_error(
    predicted: Gaussians, true: Gaussians, to_truth: NearestNeighbours, to_prediction: NearestNeighbours
) -> float:
    """Mean absolute RGB difference (0..1) between nearest neighbours, averaged over both directions."""
    a, b = base_colours(predicted), base_colours(true)
    return float(((a - b[to_truth.index]).abs().mean() + (b - a[to_prediction.index]).abs().mean()) / 2)


def label_iou(predicted: Int[Tensor, "n"], true: Int[Tensor, "n"]) -> dict[int, tuple[int, float]]:
    """Intersection over union (IoU) of each true object and the predicted object matched to it; 0 without a match.

    Both tensors label the same points; 0 is the background. Objects are matched one to one with the largest sum of IoU.
    Returns {true id: (predicted id, IoU)}.
    """
    from scipy.optimize import linear_sum_assignment

    ids = [int(i) for i in true.unique() if i > 0]
    others = [int(i) for i in predicted.unique() if i > 0]
    table = torch.zeros(len(ids), len(others), dtype=torch.float64)
    for r, i in enumerate(ids):
        for c, j in enumerate(others):
            union = ((true == i) | (predicted == j)).sum()
            table[r, c] = ((true == i) & (predicted == j)).sum() / union
    matched = dict.fromkeys(ids, (0, 0.0))
    for r, c in zip(*linear_sum_assignment(table.numpy(), maximize=True), strict=True):
        if table[r, c] > 0:
            matched[ids[r]] = (others[c], float(table[r, c]))
    return matched


def compare(prediction: Path, truth: Path, options: EvaluateOptions) -> Result:
    """Chamfer distance, colour error and, if both scenes have objects, the IoU of their labels."""
    scenes = [read_scene(prediction), read_scene(truth)]
    frames = [scene_reference_frame(path, scene) for path, scene in zip((prediction, truth), scenes, strict=True)]
    predicted, true = (_surfaces(path, s) for path, s in zip((prediction, truth), scenes, strict=True))
    notes = [f"only Gaussians of opacity above {SURFACE_OPACITY} are compared"]
    means = predicted.means
    if options.align:
        similarity, how = find_alignment(*frames)
        means = similarity(means)
        notes.append(how)
    else:
        check_same_reference_frame(*frames, [])
    to_truth, to_prediction = nearest_neighbours(means, true.means), nearest_neighbours(true.means, means)
    colour = colour_error(predicted, true, to_truth, to_prediction)
    overall = {**chamfer(to_truth, to_prediction), "colour": colour, "Gaussians": len(predicted)}
    parts: dict[str, dict[str, float]] = {}
    if (predicted.object_id > 0).any() and (true.object_id > 0).any():
        parts = _label_rows(scenes, predicted.object_id[to_prediction.index], true.object_id, notes)
        overall["IoU"] = sum(row["IoU"] for row in parts.values()) / len(parts)
    return Result("scenes", overall, parts, notes)


def _label_rows(scenes: list[Scene], predicted: Tensor, true: Tensor, notes: list[str]) -> dict[str, dict[str, float]]:
    """IoU of each true object; appends a note on which objects were matched."""
    matched = label_iou(predicted, true)
    predicted_names, names = (
        {o.id: n for o, n in zip(s.objects, object_labels(list(s.objects)), strict=True)} for s in scenes
    )
    listed = ", ".join(f"{names[i]} = {predicted_names.get(j, 'nothing')}" for i, (j, _) in matched.items())
    notes.append(f"each true Gaussian takes the label of the nearest predicted one; matched {listed}")
    return {names[i]: {"IoU": iou} for i, (_, iou) in matched.items()}


def scene_reference_frame(path: Path, scene: Scene) -> ReferenceFrame:
    """Cameras and objects of a scene; objects without Gaussians are left out."""
    g = scene.gaussians
    points = {o.id: g.means[g.object_id == o.id] for o in scene.objects}
    return ReferenceFrame(str(path), scene.cameras, tuple(o for o in scene.objects if len(points[o.id])), points)


def _surfaces(path: Path, scene: Scene) -> Gaussians:
    """The Gaussians with an opacity above SURFACE_OPACITY. Raises InputError if there are none."""
    g = scene.gaussians[scene.gaussians.opacities > SURFACE_OPACITY]
    if not len(g):
        raise InputError(f"{path}: no Gaussian has an opacity above {SURFACE_OPACITY}, so there is no surface to "
                         "compare")  # fmt: skip
    return g
