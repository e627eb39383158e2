"""Which object of a prediction is which object of the truth."""

from __future__ import annotations

import torch
from scipy.optimize import linear_sum_assignment

from stages.core.errors import InputError
from stages.core.scene.scene import SceneObject
from stages.evaluate.align import Pairs, ReferenceFrame


def match_objects(prediction: ReferenceFrame, truth: ReferenceFrame, names: list[str]) -> tuple[Pairs, str]:
    """Pairs (predicted, true) of objects and how they were found: by name, else by id, else by nearest centre.

    With `names` only those of the truth count, and the prediction may have more. Ids count only where they
    agree with the centres, since two segmentations number objects as they like.
    """
    mine, true = list(prediction.objects), _chosen(truth, names)
    if len(mine) < len(true) or (len(mine) > len(true) and not names):
        raise InputError(
            f"{prediction.file}: has {len(mine)} objects ({_names(mine)}), but {truth.file} has {len(true)} "
            f"({_names(true)}); name those to compare with --objects, as in --objects {true[0].name}"
            if true else f"{truth.file}: has no objects to compare"
        )  # fmt: skip
    by_name = {o.name: o for o in mine}
    if len(by_name) == len(mine) and len({o.name for o in true}) == len(true) and all(o.name in by_name for o in true):
        return [(by_name[o.name], o) for o in true], "objects were matched by name"
    nearest = _nearest(mine, true, prediction, truth)
    by_id = {o.id: o for o in mine}
    if all(o.id in by_id for o in true) and all(a.id == b.id for a, b in nearest):
        return nearest, "objects were matched by id, since their names differ"
    told = ", ".join(f"{a.name} = {b.name}" for a, b in nearest)
    return nearest, f"objects were matched by nearest centre, since names and ids differ ({told})"


def _nearest(
    mine: list[SceneObject], true: list[SceneObject], prediction: ReferenceFrame, truth: ReferenceFrame
) -> Pairs:
    """One to one, with the least sum of distances between centres."""
    a = torch.stack([prediction.centre(o) for o in mine])
    b = torch.stack([truth.centre(o) for o in true])
    rows, columns = linear_sum_assignment(torch.cdist(b.double(), a.double()).numpy())
    return [(mine[j], true[i]) for i, j in zip(rows, columns, strict=True)]


def object_labels(objects: list[SceneObject]) -> list[str]:
    """Names for tables: those that several objects share get the id as well."""
    names = [o.name for o in objects]
    return [o.name if names.count(o.name) == 1 else f"{o.name} {o.id}" for o in objects]


def _names(objects: list[SceneObject]) -> str:
    return ", ".join(o.name for o in objects) or "none"


def _chosen(truth: ReferenceFrame, names: list[str]) -> list[SceneObject]:
    """The truth's objects to compare: all, or those that --objects names."""
    missing = [name for name in names if name not in {o.name for o in truth.objects}]
    if missing:
        raise InputError(f"--objects {','.join(missing)}: {truth.file} has {_names(list(truth.objects))}")
    return [o for o in truth.objects if not names or o.name in names]
