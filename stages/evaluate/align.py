"""Bringing a prediction into the truth's world, and noticing when that is needed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.geometry.similarity import Similarity, umeyama
from stages.core.scene.cameras import Cameras
from stages.core.scene.scene import SceneObject

DRIFT = 0.1  # of the cameras' spread, or APART of the objects' size: farther apart means another world
APART = 2.0

Pairs = list[tuple[SceneObject, SceneObject]]  # predicted, true


@dataclass(frozen=True)
class ReferenceFrame:
    """What a file says about its frame of reference: cameras, and the points of each object at rest."""

    file: str
    cameras: Cameras | None
    objects: tuple[SceneObject, ...]
    points: dict[int, Float[Tensor, "_ 3"]]  # by object id

    def centre(self, object: SceneObject) -> Float[Tensor, "3"]:
        return self.points[object.id].mean(0)

    def moved(self, similarity: Similarity) -> ReferenceFrame:
        cameras = None if self.cameras is None else self.cameras.transformed(similarity)
        return replace(self, cameras=cameras, points={i: similarity(p) for i, p in self.points.items()})


def find_alignment(prediction: ReferenceFrame, truth: ReferenceFrame) -> tuple[Similarity, str]:
    """The similarity that takes the prediction into the truth's world, and how it was found."""
    mine, true = _shared_cameras(prediction, truth)
    if mine is not None and len(mine) >= 2:
        return _from_cameras(mine, true), f"aligned by {len(mine)} cameras with the same names"
    by_name = {o.name: o for o in prediction.objects}
    shared = [o for o in truth.objects if o.name in by_name]
    if len(shared) >= 2:
        source = torch.stack([prediction.centre(by_name[o.name]) for o in shared])
        target = torch.stack([truth.centre(o) for o in shared])
        names = ", ".join(o.name for o in shared)
        return _upright(source, target), f"aligned by the centres of {names}, keeping the vertical"
    raise InputError(
        f"--align: {prediction.file} and {truth.file} share fewer than two camera names and fewer than two object "
        "names; name the photos, or the objects, alike in both"
    )


def check_same_reference_frame(prediction: ReferenceFrame, truth: ReferenceFrame, pairs: Pairs) -> None:
    """Refuses files whose cameras or, without any, matched objects are clearly somewhere else."""
    mine, true = _shared_cameras(prediction, truth)
    if mine is not None and len(mine) >= 2:
        a, b = centres(mine.viewmats), centres(true.viewmats)
        apart, unit, what = (a - b).norm(dim=1).median(), DRIFT * _spread(b), "cameras with the same names"
    elif pairs:
        a = torch.stack([prediction.centre(o) for o, _ in pairs])
        b = torch.stack([truth.centre(o) for _, o in pairs])
        unit = APART * torch.stack([_spread(truth.points[o.id]) for _, o in pairs]).median()
        apart, what = (a - b).norm(dim=1).median(), "matching objects"
    else:
        return
    if apart > unit:
        raise InputError(
            f"{prediction.file}: lies in another frame of reference than {truth.file} ({what} are {float(apart):.3g} "
            "units apart); give --align to bring them together first"
        )


def _shared_cameras(prediction: ReferenceFrame, truth: ReferenceFrame) -> tuple[Cameras, Cameras] | tuple[None, None]:
    """Cameras of both with the same photo names (file endings aside), in the same order."""
    if prediction.cameras is None or truth.cameras is None:
        return None, None
    mine, true = ({name.rsplit(".", 1)[0]: i for i, name in enumerate(w.cameras.names)} for w in (prediction, truth))
    shared = [name for name in true if name in mine]
    if not shared:
        return None, None
    return prediction.cameras[[mine[n] for n in shared]], truth.cameras[[true[n] for n in shared]]


def _spread(points: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Root mean square distance from the mean."""
    return (points - points.mean(0)).square().sum(1).mean().sqrt()


def _from_cameras(mine: Cameras, true: Cameras) -> Similarity:
    """Least squares over camera centres and the tips of their axes.

    The axes are as long as the centres are spread: they fix the turn about a straight path of cameras,
    which centres alone leave open.
    """
    points = []
    for cameras in (mine, true):
        c = centres(cameras.viewmats).double()
        axes = cameras.viewmats[:, :3, :3].double()  # row k is axis k in the world
        tips = c[:, None] + _spread(c) * axes
        points.append(torch.cat([c, tips.flatten(0, 1)]))
    if not float(_spread(centres(mine.viewmats))) > 0:
        raise InputError("--align: the shared cameras all stand in one place, which leaves the scale open")
    return _single(umeyama(*points))


def _upright(source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Similarity:
    """Least-squares scale, shift and turn about the vertical; z is up in both worlds."""
    mean_s, mean_t = source.mean(0).double(), target.mean(0).double()
    S, T = source.double() - mean_s, target.double() - mean_t
    turn = math.atan2(float((S[:, 0] * T[:, 1] - S[:, 1] * T[:, 0]).sum()), float((S[:, :2] * T[:, :2]).sum()))
    c, s = math.cos(turn), math.sin(turn)
    R = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    scale = float((S @ R.mT * T).sum() / S.square().sum())
    if not scale > 0:
        raise InputError("--align: the objects' centres in the two files do not correspond; check their names")
    return _single(Similarity(scale, R, mean_t - scale * R @ mean_s))


def _single(s: Similarity) -> Similarity:
    return Similarity(s.scale, s.rotation.float(), s.translation.float())
