"""What happens in the scenes of a data set: falls, contacts, containment, tipping, spread, deformation, rest.

All of it is measured on keypoints, in scene units, by thresholds that are stated here:

    falls       an object's centre ends FALLEN lower than it began
    touch       points of two objects come within TOUCH; scenes begin with at least 0.05
    stacked     at the end an object lies still, on another one and not on the floor
    contained   at the end the lowest quarter of an object is below the rim of an upright bowl that it lies over
    tipped      an object's own vertical ends TIPPED away from where it began
    spread      mean horizontal distance of the objects' centres from their mean, at the end
    deformation RMS distance of the points from the nearest rigid motion, over the RMS radius; the largest over time
    at rest     points move slower than STILL on average over the last five frames
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.rotations import nearest_rotation
from stages.core.scene.files import replacing
from stages.lab.dataset.keypoint_motions import KeypointMotions, read_motions
from stages.lab.dataset.layout import object_kind
from stages.lab.training.data import motions_folder

FALL_HEIGHT, CONTACT_DISTANCE, REST_SPEED = 0.05, 0.04, 0.05  # [m], [m], [m/s]
TIP_ANGLE = 30.0  # [deg]
FLOOR_CLEARANCE = 0.04  # lowest point above the floor at most [m]: bodies keep about a cell from it
BOWL = "bowl"
CONTACT_STRIDE = 2  # frames between looks at contacts
SCENE_BATCH = 20  # scenes


@dataclass(frozen=True)
class SceneStatistics:
    """A number for each scene (s), each object (s, o) or each pair of them (s, pairs); nan where there is no object."""

    falls: Float[Tensor, "s o"]
    touch: Float[Tensor, "s q"]
    stacked: Float[Tensor, "s o"]
    contained: Float[Tensor, "s o"]
    tipped: Float[Tensor, "s o"]
    spread: Float[Tensor, "s"]
    deformation: Float[Tensor, "s o"]
    at_rest: Float[Tensor, "s o"]


def compute_statistics(m: KeypointMotions) -> SceneStatistics:
    """All of the above, for scenes that fit into memory together."""
    p, there = m.points, m.present
    centre = p.mean(3)
    turn, deformation = _rigid(p, centre)
    tilt = torch.rad2deg(turn[..., 2, 2].clamp(-1, 1).acos())  # (s, t, o)
    speed = (p[:, 1:] - p[:, :-1]).norm(dim=-1).mean(-1)[:, -5:].mean(1) / m.dt
    lowest = p[:, -1, :, :, 2].amin(-1)
    still = speed < REST_SPEED
    touching = _nearest_pairs(p) < CONTACT_DISTANCE  # (s, t, q)
    pairs = torch.tensor(list(combinations(range(p.shape[2]), 2)), dtype=torch.int64).reshape(-1, 2)
    q = pairs.to(p.device)
    both = there[:, q[:, 0]] & there[:, q[:, 1]]
    last = torch.zeros_like(there)
    for k, (i, j) in enumerate(pairs.tolist()):
        last[:, i] |= touching[:, -1, k]
        last[:, j] |= touching[:, -1, k]
    flat = (centre[:, -1, :, :2] - _mean(centre[:, -1, :, :2], there)[:, None]).norm(dim=-1)
    nan = lambda x, mask: torch.where(mask, x.float(), torch.nan)  # noqa: E731
    return SceneStatistics(
        nan(centre[:, 0, :, 2] - centre[:, -1, :, 2] > FALL_HEIGHT, there), nan(touching.any(1), both),
        nan(still & last & (lowest - m.box[0][2] > FLOOR_CLEARANCE), there), nan(_contained(m, tilt[:, -1]), there),
        nan(tilt[:, -1] > TIP_ANGLE, there), _mean(flat[..., None], there)[:, 0],
        nan(deformation.amax(1), there), nan(still, there),
    )  # fmt: skip


def _mean(x: Float[Tensor, "s o d"], there: Bool[Tensor, "s o"]) -> Float[Tensor, "s d"]:
    return torch.where(there[..., None], x, 0.0).sum(1) / there.sum(1, keepdim=True)


def _rigid(
    p: Float[Tensor, "s t o n 3"], centre: Float[Tensor, "s t o 3"]
) -> tuple[Float[Tensor, "s t o 3 3"], Float[Tensor, "s t o"]]:
    """Rotation of each object since the start (Kabsch 1976), and how far its points are from turned so."""
    now = p - centre[..., None, :]
    rest = now[:, :1]
    H = (now.mT @ rest).cpu().double()  # small matrices are turned faster there
    R = nearest_rotation(H + 1e-9 * torch.eye(3, dtype=H.dtype)).to(p)
    off = (now - rest @ R.mT).square().sum(-1).mean(-1).sqrt()
    return R, off / rest.square().sum(-1).mean(-1).sqrt().clamp_min(1e-9)


def _nearest_pairs(p: Float[Tensor, "s t o n 3"]) -> Float[Tensor, "s t2 q"]:
    """Least distance between points of two objects, in every second frame and the last."""
    frames = sorted({*range(0, p.shape[1], CONTACT_STRIDE), p.shape[1] - 1})
    p = p[:, frames]
    found = [torch.cdist(p[:, :, i], p[:, :, j]).amin((-1, -2)) for i, j in combinations(range(p.shape[2]), 2)]
    return torch.stack(found, -1) if found else p.new_zeros(*p.shape[:2], 0)


def _contained(m: KeypointMotions, tilt: Float[Tensor, "s o"]) -> Bool[Tensor, "s o"]:
    """Objects that lie in a bowl in the last frame."""
    end, kind = m.points[:, -1], m.objects
    low, high, centre = end.amin(2), end.amax(2), end.mean(2)
    bowl = torch.tensor([i >= 0 and object_kind(i).name == BOWL for i in kind.flatten().tolist()]).reshape(kind.shape)
    upright = bowl.to(tilt.device) & (tilt < TIP_ANGLE)
    quarter = end[..., 2].quantile(0.25, dim=2)
    inside = torch.zeros_like(upright)
    for b in range(kind.shape[1]):
        radius = (high - low)[:, b, :2].amin(-1) / 2
        over = (centre[..., :2] - centre[:, b : b + 1, :2]).norm(dim=-1) < radius[:, None]
        deep = (quarter < high[:, b : b + 1, 2]) & (low[..., 2] > low[:, b : b + 1, 2])
        other = torch.arange(kind.shape[1], device=tilt.device) != b
        inside |= upright[:, b : b + 1] & over & deep & other
    return inside


def run(data: Path, out: Path | None, groups: Sequence[str], keypoints: int, device: str) -> list[str]:
    """Statistics of each group and each kind of object, as JSON and as lines of a table."""
    device, table, kinds = pick_device(device), {}, {}
    for group in groups:
        path = motions_folder(data) / f"{group}.h5"
        if not path.is_file():
            continue
        motions = read_motions(path)
        parts = []
        for first in tqdm(range(0, len(motions), SCENE_BATCH), desc=group, unit="batch", leave=False):
            some = motions[slice(first, first + SCENE_BATCH)]
            parts.append(compute_statistics(_thinned(some, keypoints).to(device)))
        facts = SceneStatistics(
            *(torch.cat([getattr(f, n).cpu() for f in parts]) for n in SceneStatistics.__dataclass_fields__)
        )
        table[group] = {"scenes": len(motions), **group_summary(facts)}
        for i in motions.objects.unique().tolist():
            if i >= 0:
                kinds.setdefault(object_kind(i).name, []).append((facts, motions.objects == i))
    if not table:
        folder = motions_folder(data)
        raise InputError(f"{folder}: has none of {', '.join(groups)} (.h5); make them with `ngff-lab dataset`")
    of = {name: _of_kind(parts) for name, parts in sorted(kinds.items())}
    if out is not None:
        with replacing(Path(out)) as part:
            part.write_text(json.dumps({"thresholds": THRESHOLDS, "groups": table, "objects": of}, indent=1) + "\n")
    return markdown_table(table, "group") + [""] + markdown_table(of, "object")


THRESHOLDS = {
    "fallen": FALL_HEIGHT,
    "touch": CONTACT_DISTANCE,
    "still": REST_SPEED,
    "tipped": TIP_ANGLE,
    "on floor": FLOOR_CLEARANCE,
}
OBJECT_FRACTIONS = ("falls", "tipped", "stacked", "contained", "at_rest")  # of objects


def _thinned(m: KeypointMotions, keypoints: int) -> KeypointMotions:
    return replace(m, points=m.points[:, :, :, :keypoints])


def group_summary(f: SceneStatistics) -> dict[str, float]:
    """Shares of objects, and of scenes in which it happens to any; means of the others."""
    out = {name: _round(getattr(f, name).nanmean()) for name in OBJECT_FRACTIONS}
    out["contacts a scene"] = _round(f.touch.nansum(1).mean())
    for name in ("touch", "tipped", "stacked", "contained"):
        out[f"scenes with {name}"] = _round((getattr(f, name).nan_to_num() > 0).any(1).float().mean())
    out["scenes at rest"] = _round((f.at_rest.nan_to_num(1.0) > 0).all(1).float().mean())
    out["spread"] = _round(f.spread.mean())
    out["spread deviation"] = _round(f.spread.std(correction=0))
    out["deformation"] = _round(f.deformation.nanmean())
    return out


def _of_kind(parts: list[tuple[SceneStatistics, Tensor]]) -> dict[str, float]:
    """The same for the objects of one kind."""
    out: dict[str, float] = {"count": int(sum(int(mask.sum()) for _, mask in parts))}
    for name in (*OBJECT_FRACTIONS, "deformation"):
        out[name] = _round(torch.cat([getattr(f, name)[mask] for f, mask in parts]).nanmean())
    return out


def _round(x: Tensor) -> float:
    return round(float(x), 4)


def markdown_table(table: dict[str, dict[str, float]], label: str) -> list[str]:
    """A Markdown table."""
    heads = list(next(iter(table.values())))
    rows = [[label, *heads], ["---"] * (len(heads) + 1)]
    rows += [[name, *(f"{row[h]:.3g}" for h in heads)] for name, row in table.items()]
    return ["| " + " | ".join(row) + " |" for row in rows]
