"""Correspondence between the objects of a prediction and of the truth."""

from __future__ import annotations

import shlex

import torch

from stages.core.errors import InputError
from stages.core.scene.scene import SceneObject
from stages.evaluate.align import Pairs, ReferenceFrame


def match_objects(prediction: ReferenceFrame, truth: ReferenceFrame, names: list[str]) -> tuple[Pairs, str]:
    """Match objects by name, by id or by centre; returns pairs (predicted, true) and a sentence on how they were found.

    With `names` only these objects of the truth are matched, and the prediction may have more. Ids are used only if
    they agree with the nearest centres, since the numbering of segmented objects is arbitrary. Raises InputError if
    the numbers of objects differ or a name does not exist.
    """
    predicted, true = list(prediction.objects), _select(truth, names)
    if len(predicted) < len(true) or (len(predicted) > len(true) and not names):
        raise InputError(
            f"{prediction.file}: has {len(predicted)} objects ({_names(predicted)}), but {truth.file} has {len(true)} "
            f"({_names(true)}); name the objects to compare, as in --objects {shlex.quote(true[0].name)}"
            if true else f"{truth.file}: has no objects to compare"
        )  # fmt: skip
    by_name = {o.name: o for o in predicted}
    unique = len(by_name) == len(predicted) and len({o.name for o in true}) == len(true)
    if unique and all(o.name in by_name for o in true):
        return [(by_name[o.name], o) for o in true], "objects were matched by name"
    pairs = _nearest_pairs(predicted, true, prediction, truth)
    by_id = {o.id: o for o in predicted}
    if all(o.id in by_id for o in true) and all(a.id == b.id for a, b in pairs):
        return pairs, "objects were matched by id, since their names differ"
    listed = ", ".join(f"{a.name} = {b.name}" for a, b in pairs)
    return pairs, f"objects were matched by nearest centre, since names and ids differ ({listed})"


def _nearest_pairs(
    predicted: list[SceneObject], true: list[SceneObject], prediction: ReferenceFrame, truth: ReferenceFrame
) -> Pairs:
    """One-to-one assignment with the smallest sum of distances between centres."""
    from scipy.optimize import linear_sum_assignment

    a = torch.stack([prediction.centre(o) for o in predicted])
    b = torch.stack([truth.centre(o) for o in true])
    rows, columns = linear_sum_assignment(torch.cdist(b.double(), a.double()).numpy())
    return [(predicted[j], true[i]) for i, j in zip(rows, columns, strict=True)]


def object_labels(objects: list[SceneObject]) -> list[str]:
    """Names for tables; the id is appended to names that occur more than once."""
    names = [o.name for o in objects]
    return [o.name if names.count(o.name) == 1 else f"{o.name} {o.id}" for o in objects]


def _names(objects: list[SceneObject]) -> str:
    return ", ".join(o.name for o in objects) or "none"


def _select(truth: ReferenceFrame, names: list[str]) -> list[SceneObject]:
    """The objects of the truth with these names; without names, all. Raises InputError for an unknown name."""
    missing = [name for name in names if name not in {o.name for o in truth.objects}]
    if missing:
        raise InputError(f"--objects {','.join(missing)}: {truth.file} has {_names(list(truth.objects))}")
    return [o for o in truth.objects if not names or o.name in names]
