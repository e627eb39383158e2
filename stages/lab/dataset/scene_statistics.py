"""Statistics of simulated scenes: falls, contacts, containment, tipping, spread, deformation, rest.

All are measured on keypoints, in scene units:

    falls       the object's centre ends FALL_HEIGHT or more below its start
    touch       points of two objects come within CONTACT_DISTANCE; scenes start with at least 0.05 m between objects
    stacked     at the end the object rests in contact with another one, above the floor
    contained   at the end the lowest quarter of the object is below the rim of an upright bowl and its
                centre within the radius of the bowl
    tipped      at the end the object's own vertical axis is more than TIP_ANGLE from its initial direction
    spread      mean horizontal distance of the objects' centres from their mean, at the end [m]
    deformation RMS distance of the points from the best rigid fit, divided by the RMS radius; maximum over time
    at rest     the points move slower than REST_SPEED, averaged over the last five frames
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
from stages.lab.dataset.keypoint_motions import KeypointMotions, motions_folder, read_motions
from stages.lab.dataset.layout import object_kind

FALL_HEIGHT, CONTACT_DISTANCE, REST_SPEED = 0.05, 0.04, 0.05  # thresholds, see above [m], [m], [m/s]
TIP_ANGLE = 30.0  # threshold of `tipped` [deg]
FLOOR_CLEARANCE = (
    0.04  # largest height of the lowest point of an object that lies on the floor [m]: bodies stop a cell above it
)
BOWL = "bowl"
CONTACT_STRIDE = 2  # frames between contact tests
SCENE_BATCH = 20  # scenes measured together


@dataclass(frozen=True)
class SceneStatistics:
    """One value per scene (s), object (s, o) or pair of objects (s, q); nan where there is no object."""

    falls: Float[Tensor, "s o"]
    touch: Float[Tensor, "s q"]
    stacked: Float[Tensor, "s o"]
    contained: Float[Tensor, "s o"]
    tipped: Float[Tensor, "s o"]
    spread: Float[Tensor, "s"]
    deformation: Float[Tensor, "s o"]
    at_rest: Float[Tensor, "s o"]


def compute_statistics(m: KeypointMotions) -> SceneStatistics:
    """All statistics of a batch of scenes, which must fit into memory."""
    p, present = m.points, m.present
    centre = p.mean(3)
    R, deformation = _rigid_fit(p, centre)
    tilt = torch.rad2deg(R[..., 2, 2].clamp(-1, 1).acos())  # (s, t, o)
    speed = (p[:, 1:] - p[:, :-1]).norm(dim=-1).mean(-1)[:, -5:].mean(1) / m.dt
    lowest = p[:, -1, :, :, 2].amin(-1)
    still = speed < REST_SPEED
    touching = _pair_distances(p) < CONTACT_DISTANCE  # (s, t, q)
    pairs = torch.tensor(list(combinations(range(p.shape[2]), 2)), dtype=torch.int64).reshape(-1, 2)
    q = pairs.to(p.device)
    both = present[:, q[:, 0]] & present[:, q[:, 1]]
    touching_last = torch.zeros_like(present)
    for k, (i, j) in enumerate(pairs.tolist()):
        touching_last[:, i] |= touching[:, -1, k]
        touching_last[:, j] |= touching[:, -1, k]
    flat = (centre[:, -1, :, :2] - _mean(centre[:, -1, :, :2], present)[:, None]).norm(dim=-1)
    nan = lambda x, mask: torch.where(mask, x.float(), torch.nan)  # noqa: E731
    return SceneStatistics(
        falls=nan(centre[:, 0, :, 2] - centre[:, -1, :, 2] > FALL_HEIGHT, present),
        touch=nan(touching.any(1), both),
        stacked=nan(still & touching_last & (lowest - m.box[0][2] > FLOOR_CLEARANCE), present),
        contained=nan(_contained(m, tilt[:, -1]), present),
        tipped=nan(tilt[:, -1] > TIP_ANGLE, present),
        spread=_mean(flat[..., None], present)[:, 0],
        deformation=nan(deformation.amax(1), present),
        at_rest=nan(still, present),
    )


def _mean(x: Float[Tensor, "s o d"], present: Bool[Tensor, "s o"]) -> Float[Tensor, "s d"]:
    return torch.where(present[..., None], x, 0.0).sum(1) / present.sum(1, keepdim=True)


def _rigid_fit(
    p: Float[Tensor, "s t o n 3"], centre: Float[Tensor, "s t o 3"]
) -> tuple[Float[Tensor, "s t o 3 3"], Float[Tensor, "s t o"]]:
    """Rotation of each object since the start (Kabsch 1976), and the relative RMS residual of its points."""
    now = p - centre[..., None, :]
    rest = now[:, :1]
    H = (now.mT @ rest).cpu().double()  # decompositions of small matrices are faster on the CPU
    R = nearest_rotation(H + 1e-9 * torch.eye(3, dtype=H.dtype)).to(p)
    residual = (now - rest @ R.mT).square().sum(-1).mean(-1).sqrt()
    return R, residual / rest.square().sum(-1).mean(-1).sqrt().clamp_min(1e-9)


def _pair_distances(p: Float[Tensor, "s t o n 3"]) -> Float[Tensor, "s t2 q"]:
    """Smallest distance between points of each pair of objects [m], in every CONTACT_STRIDE-th frame and the last."""
    frames = sorted({*range(0, p.shape[1], CONTACT_STRIDE), p.shape[1] - 1})
    p = p[:, frames]
    found = [torch.cdist(p[:, :, i], p[:, :, j]).amin((-1, -2)) for i, j in combinations(range(p.shape[2]), 2)]
    return torch.stack(found, -1) if found else p.new_zeros(*p.shape[:2], 0)


def _contained(m: KeypointMotions, tilt: Float[Tensor, "s o"]) -> Bool[Tensor, "s o"]:
    """Objects that lie in an upright bowl in the last frame."""
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
    """Measure the statistics of each group and kind of object, write JSON to `out`, and return the lines of two tables.

    Only the first `keypoints` of each object are used. Raises InputError if the data set has none of the groups.
    """
    device, table, kinds = pick_device(device), {}, {}
    for group in groups:
        path = motions_folder(data) / f"{group}.h5"
        if not path.is_file():
            continue
        motions = read_motions(path)
        parts = []
        for first in tqdm(range(0, len(motions), SCENE_BATCH), desc=group, unit="batch", leave=False):
            some = motions[slice(first, first + SCENE_BATCH)]
            parts.append(compute_statistics(_first_keypoints(some, keypoints).to(device)))
        measured = SceneStatistics(
            *(torch.cat([getattr(f, n).cpu() for f in parts]) for n in SceneStatistics.__dataclass_fields__)
        )
        table[group] = {"scenes": len(motions), **group_summary(measured)}
        for i in motions.objects.unique().tolist():
            if i >= 0:
                kinds.setdefault(object_kind(i).name, []).append((measured, motions.objects == i))
    if not table:
        folder = motions_folder(data)
        raise InputError(f"{folder}: contains none of {', '.join(groups)} (.h5); generate them with `ngff-lab dataset`")
    objects = {name: _object_summary(parts) for name, parts in sorted(kinds.items())}
    if out is not None:
        with replacing(Path(out)) as part:
            part.write_text(
                json.dumps({"thresholds": THRESHOLDS, "groups": table, "objects": objects}, indent=1) + "\n"
            )
    return markdown_table(table, "group") + [""] + markdown_table(objects, "object")


THRESHOLDS = {
    "fallen": FALL_HEIGHT,
    "touch": CONTACT_DISTANCE,
    "still": REST_SPEED,
    "tipped": TIP_ANGLE,
    "on floor": FLOOR_CLEARANCE,
}  # thresholds as written to the JSON file
OBJECT_FRACTIONS = ("falls", "tipped", "stacked", "contained", "at_rest")  # reported as fractions of objects


def _first_keypoints(m: KeypointMotions, keypoints: int) -> KeypointMotions:
    return replace(m, points=m.points[:, :, :, :keypoints])


def group_summary(f: SceneStatistics) -> dict[str, float]:
    """Fractions of objects and of scenes with each property, and means of the other values."""
    out = {name: _round(getattr(f, name).nanmean()) for name in OBJECT_FRACTIONS}
    out["contacts a scene"] = _round(f.touch.nansum(1).mean())
    for name in ("touch", "tipped", "stacked", "contained"):
        out[f"scenes with {name}"] = _round((getattr(f, name).nan_to_num() > 0).any(1).float().mean())
    out["scenes at rest"] = _round((f.at_rest.nan_to_num(1.0) > 0).all(1).float().mean())
    out["spread"] = _round(f.spread.mean())
    out["spread deviation"] = _round(f.spread.std(correction=0))
    out["deformation"] = _round(f.deformation.nanmean())
    return out


def _object_summary(parts: list[tuple[SceneStatistics, Tensor]]) -> dict[str, float]:
    """The statistics of all objects of one kind."""
    out: dict[str, float] = {"count": int(sum(int(mask.sum()) for _, mask in parts))}
    for name in (*OBJECT_FRACTIONS, "deformation"):
        out[name] = _round(torch.cat([getattr(f, name)[mask] for f, mask in parts]).nanmean())
    return out


def _round(x: Tensor) -> float:
    return round(float(x), 4)


def markdown_table(table: dict[str, dict[str, float]], label: str) -> list[str]:
    """Lines of a Markdown table; `label` is the heading of the first column."""
    heads = list(next(iter(table.values())))
    rows = [[label, *heads], ["---"] * (len(heads) + 1)]
    rows += [[name, *(f"{row[h]:.3g}" for h in heads)] for name, row in table.items()]
    return ["| " + " | ".join(row) + " |" for row in rows]
