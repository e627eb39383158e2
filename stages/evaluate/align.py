"""Alignment of a prediction with the truth, and detection of differing reference frames."""

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

# Two files have different reference frames if the median distance between corresponding items is larger.
MAX_CAMERA_DISTANCE = 0.1  # between cameras [RMS distance of the cameras from their mean]
MAX_OBJECT_DISTANCE = 2.0  # between object centres, if no cameras are shared [RMS radius of the objects]

Pairs = list[tuple[SceneObject, SceneObject]]  # predicted, true


@dataclass(frozen=True)
class ReferenceFrame:
    """Data that locate the reference frame of a file: its cameras, and the points of each object at rest."""

    file: str
    cameras: Cameras | None
    objects: tuple[SceneObject, ...]
    points: dict[int, Float[Tensor, "_ 3"]]  # by object id

    def centre(self, object: SceneObject) -> Float[Tensor, "3"]:
        """Mean of an object's points."""
        return self.points[object.id].mean(0)

    def transformed(self, similarity: Similarity) -> ReferenceFrame:
        """Apply a similarity transform."""
        cameras = None if self.cameras is None else self.cameras.transformed(similarity)
        return replace(self, cameras=cameras, points={i: similarity(p) for i, p in self.points.items()})


def find_alignment(prediction: ReferenceFrame, truth: ReferenceFrame) -> tuple[Similarity, str]:
    """Find the similarity from the frame of the prediction to that of the truth; also returns a sentence on the method.

    Uses two or more cameras with the same names, or otherwise the centres of two or more objects with the same names.
    Raises InputError if there are neither.
    """
    predicted, true = _shared_cameras(prediction, truth)
    if predicted is not None and len(predicted) >= 2:
        return _from_cameras(predicted, true), f"aligned by {len(predicted)} cameras with the same names"
    by_name = {o.name: o for o in prediction.objects}
    shared = [o for o in truth.objects if o.name in by_name]
    if len(shared) >= 2:
        source = torch.stack([prediction.centre(by_name[o.name]) for o in shared])
        target = torch.stack([truth.centre(o) for o in shared])
        names = ", ".join(o.name for o in shared)
        return _upright(source, target), f"aligned by the centres of {names}, keeping the vertical"
    raise InputError(
        f"--align: {prediction.file} and {truth.file} have fewer than two camera names and fewer than two object names "
        "in common; use the same names of photos, or of objects, in both"
    )


def check_same_reference_frame(prediction: ReferenceFrame, truth: ReferenceFrame, pairs: Pairs) -> None:
    """Raise InputError if shared cameras or, without shared cameras, matched objects are far apart."""
    predicted, true = _shared_cameras(prediction, truth)
    if predicted is not None and len(predicted) >= 2:
        a, b = centres(predicted.viewmats), centres(true.viewmats)
        distance, limit = (a - b).norm(dim=1).median(), MAX_CAMERA_DISTANCE * _rms_radius(b)
        what = "cameras with the same names"
    elif pairs:
        a = torch.stack([prediction.centre(o) for o, _ in pairs])
        b = torch.stack([truth.centre(o) for _, o in pairs])
        limit = MAX_OBJECT_DISTANCE * torch.stack([_rms_radius(truth.points[o.id]) for _, o in pairs]).median()
        distance, what = (a - b).norm(dim=1).median(), "matching objects"
    else:
        return
    if distance > limit:
        raise InputError(
            f"{prediction.file}: has a different frame of reference than {truth.file} ({what} are "
            f"{float(distance):.3g} "
            "units apart); add --align to align them first"
        )


def _shared_cameras(prediction: ReferenceFrame, truth: ReferenceFrame) -> tuple[Cameras, Cameras] | tuple[None, None]:
    """Cameras of both files with equal photo names (without suffix), in the same order; (None, None) without any."""
    if prediction.cameras is None or truth.cameras is None:
        return None, None
    predicted, true = (
        {name.rsplit(".", 1)[0]: i for i, name in enumerate(frame.cameras.names)} for frame in (prediction, truth)
    )
    shared = [name for name in true if name in predicted]
    if not shared:
        return None, None
    return prediction.cameras[[predicted[n] for n in shared]], truth.cameras[[true[n] for n in shared]]


def _rms_radius(points: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Root mean square distance from the mean."""
    return (points - points.mean(0)).square().sum(1).mean().sqrt()


def _from_cameras(predicted: Cameras, true: Cameras) -> Similarity:
    """Least-squares similarity between the camera centres and the end points of the camera axes.

    The length of the axes is the RMS radius of the centres. The axes determine the rotation about a straight path of
    cameras, which the centres alone do not.
    """
    points = []
    for cameras in (predicted, true):
        c = centres(cameras.viewmats).double()
        axes = cameras.viewmats[:, :3, :3].double()  # row k is camera axis k in the world
        ends = c[:, None] + _rms_radius(c) * axes
        points.append(torch.cat([c, ends.flatten(0, 1)]))
    if not float(_rms_radius(centres(predicted.viewmats))) > 0:
        raise InputError(
            "--align: all shared cameras have the same position, so that the scale is undetermined; share more photos"
        )
    return _single(umeyama(*points))


def _upright(source: Float[Tensor, "n 3"], target: Float[Tensor, "n 3"]) -> Similarity:
    """Least-squares scale, translation and rotation about the z axis, which is up in both frames."""
    mean_s, mean_t = source.mean(0).double(), target.mean(0).double()
    S, T = source.double() - mean_s, target.double() - mean_t
    angle = math.atan2(float((S[:, 0] * T[:, 1] - S[:, 1] * T[:, 0]).sum()), float((S[:, :2] * T[:, :2]).sum()))
    c, s = math.cos(angle), math.sin(angle)
    R = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    scale = float((S @ R.mT * T).sum() / S.square().sum())
    if not scale > 0:
        raise InputError("--align: the centres of the objects in the two files do not correspond; check their names")
    return _single(Similarity(scale, R, mean_t - scale * R @ mean_s))


def _single(s: Similarity) -> Similarity:
    """Convert to single precision."""
    return Similarity(s.scale, s.rotation.float(), s.translation.float())
