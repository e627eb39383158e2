"""Comparison of two trajectories by the metrics of dynamics.py at corresponding points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.similarity import Similarity
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Keypoints, Trajectory, read_trajectory
from stages.evaluate.align import Pairs, ReferenceFrame, check_same_reference_frame, find_alignment
from stages.evaluate.dynamics import MIN_MOTION, all_metrics, error_over_time
from stages.evaluate.matching import match_objects, object_labels
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import Curve, Result

SAME_POINT = 1e-3  # largest distance at rest between identical keypoints [size of the object]


@dataclass(frozen=True)
class Track:
    """The keypoints of a trajectory in all frames, with their reference frame."""

    frame: ReferenceFrame
    dt: float  # [s]
    object_id: Int[Tensor, "p"]
    rest: Float[Tensor, "p 3"]
    positions: Float[Tensor, "t p 3"]

    def __len__(self) -> int:
        return len(self.positions)

    def of(self, id: int) -> tuple[Tensor, Tensor]:
        """Keypoints of an object at rest (p, 3) and in all frames (t, p, 3)."""
        own = self.object_id == id
        return self.rest[own], self.positions[:, own]

    def transformed(self, similarity: Similarity) -> Track:
        """Apply a similarity transform."""
        rest = similarity(self.rest)
        frame = self.frame.transformed(similarity)
        return replace(self, frame=frame, rest=rest, positions=similarity(self.positions))


@dataclass(frozen=True)
class MatchedMotion:
    """Predicted and true motion of the same points, padded to the largest number of points per object."""

    names: list[str]
    predicted: Float[Tensor, "t o p 3"]
    truth: Float[Tensor, "t o p 3"]
    mask: Bool[Tensor, "o p"]
    seen: Bool[Tensor, "t o"] | None = None  # mask of the frames in which the truth has each object; None: all


def compare(prediction: Path, truth: Path, options: EvaluateOptions) -> Result:
    """Match objects and points, and compute all metrics per object and over all objects.

    Raises InputError if the files cannot be matched with these options.
    """
    mine, true_scene = read_trajectory(prediction), read_trajectory(truth)
    predicted, true = _track(mine), _track(true_scene)
    notes: list[str] = []
    if options.align:
        similarity, how = find_alignment(predicted.frame, true.frame)
        predicted = predicted.transformed(similarity)
        notes.append(f"{how}; scale {similarity.scale:.4g}")
    pairs, how = match_objects(predicted.frame, true.frame, options.object_names)
    notes.append(how)
    if not options.align:
        check_same_reference_frame(predicted.frame, true.frame, pairs)
    predicted, true = _same_frames(predicted, true, options, notes)
    seen = _seen(true_scene, pairs, len(true), notes)
    motion = replace(_same_points(predicted, true, pairs, notes), seen=seen)
    result = _result(motion, 1 / true.dt, MIN_MOTION / true_scene.scene.metres_per_unit, notes)
    result = _with_plausibility(result, mine.plausibility or {}, [a.id for a, _ in pairs])
    if not options.report:
        return result
    from stages.evaluate.label_pictures import draw_objects  # imports Warp

    return draw_objects(result, mine.scene, options)


def _seen(truth: Trajectory, pairs: Pairs, frames: int, notes: list[str]) -> Bool[Tensor, "t o"] | None:
    """Mask of the frames in which a tracked truth has each object of the pairs; None if it has all of them."""
    if truth.confidence is None:
        return None
    column = {o.id: i for i, o in enumerate(truth.scene.objects)}
    seen = truth.confidence[:frames, [column[b.id] for _, b in pairs]] > 0
    for (_, b), lost in zip(pairs, (~seen).sum(0).tolist(), strict=True):
        if lost:
            notes.append(f"the truth lost {b.name} in {lost} of {frames} frames, which do not count")
    return None if seen.all() else seen


def _with_plausibility(result: Result, measures: dict, ids: list[int]) -> Result:
    """Add the plausibility measures of `ngff simulate`, if the prediction has them; overall values are the largest."""
    found = [measures.get("objects", {}).get(str(id), {}) for id in ids]
    parts = {name: {**metrics, **more} for (name, metrics), more in zip(result.parts.items(), found, strict=True)}
    largest = {name: max(f[name] for f in found if name in f) for name in dict.fromkeys(k for f in found for k in f)}
    scene = {name: value for name, value in measures.items() if name != "objects"}
    return replace(result, overall={**result.overall, **largest, **scene}, parts=parts)


def _track(trajectory: Trajectory) -> Track:
    keypoints = trajectory.keypoints
    frame = trajectory_reference_frame(trajectory)
    return Track(frame, trajectory.info.dt, keypoints.object_id, keypoints.rest, trajectory.positions)


def trajectory_reference_frame(trajectory: Trajectory) -> ReferenceFrame:
    """Cameras of a trajectory and keypoints of its objects; objects without keypoints are left out."""
    keypoints = trajectory.keypoints
    points = {o.id: keypoints.rest[keypoints.object_id == o.id] for o in trajectory.scene.objects}
    objects = tuple(o for o in trajectory.scene.objects if len(points[o.id]))
    return ReferenceFrame(str(trajectory.path), trajectory.scene.cameras, objects, points)


def _result(motion: MatchedMotion, fps: float, min_motion: float, notes: list[str]) -> Result:
    overall = _floats(all_metrics(motion.predicted, motion.truth, motion.mask, min_motion, motion.seen))
    parts = {
        name: _floats(
            all_metrics(
                motion.predicted[:, [i]],
                motion.truth[:, [i]],
                motion.mask[[i]],
                min_motion,
                None if motion.seen is None else motion.seen[:, [i]],
            )
        )  # fmt: skip
        for i, name in enumerate(motion.names)
    }
    errors = error_over_time(motion.predicted, motion.truth, motion.mask)
    curves = [Curve(name, errors[:, i].tolist()) for i, name in enumerate(motion.names)]
    title = "mean distance from the truth [scene units]"
    return Result("trajectories", {**overall, "frames": len(motion.truth)}, parts, notes, curves, title, fps)


def _floats(metrics: dict[str, Tensor]) -> dict[str, float]:
    return {name: float(value) for name, value in metrics.items()}


def _same_frames(predicted: Track, true: Track, options: EvaluateOptions, notes: list[str]) -> tuple[Track, Track]:
    """Both tracks at the same times, as the options ask. Raises InputError if frames or rates still differ."""
    files = predicted.frame.file, true.frame.file
    if options.resample:
        predicted = _resampled(predicted, true)
        notes.append(f"the prediction was interpolated to {1 / true.dt:g} frames a second, as given by --resample")
    if abs(predicted.dt - true.dt) > 1e-4 * true.dt:
        raise InputError(
            f"{files[0]}: has {1 / predicted.dt:g} frames per second, but {files[1]} has {1 / true.dt:g}; "
            "give --resample to interpolate the prediction at the times of the ground truth"
        )
    shorter = min(len(predicted), len(true))
    if options.frames is None:
        if len(predicted) != len(true):
            raise InputError(
                f"{files[0]}: has {len(predicted)} frames, but {files[1]} has {len(true)}; "
                f"give --frames {shorter} to compare the first {shorter}"
            )
        return predicted, true
    if options.frames > shorter:
        raise InputError(
            f"--frames {options.frames}: {files[0]} has {len(predicted)} frames and {files[1]} {len(true)}; "
            f"give {shorter} or fewer"
        )
    notes.append(f"only the first {options.frames} frames were compared, as given by --frames")
    return tuple(replace(track, positions=track.positions[: options.frames]) for track in (predicted, true))


def _resampled(predicted: Track, true: Track) -> Track:
    """Interpolate the prediction linearly at the frame times of the truth, up to the end of the prediction."""
    count = min(len(true), int((len(predicted) - 1) * predicted.dt / true.dt + 1e-6) + 1)
    index = torch.arange(count, dtype=torch.float64) * true.dt / predicted.dt
    first = index.floor().long().clamp(max=max(len(predicted) - 2, 0))
    last = (first + 1).clamp(max=len(predicted) - 1)
    weight = (index - first).float()[:, None, None]
    positions = torch.lerp(predicted.positions[first], predicted.positions[last], weight)
    return replace(predicted, positions=positions, dt=true.dt)


def _same_points(predicted: Track, true: Track, pairs: Pairs, notes: list[str]) -> MatchedMotion:
    """Motion at the keypoints of the truth; the prediction is transferred to them if its keypoints are different."""
    motions, truths, transferred = [], [], []
    for a, b in pairs:
        (rest, moving), (true_rest, true_moving) = predicted.of(a.id), true.of(b.id)
        if not _same_keypoints(rest, true_rest):
            transferred.append(b.name)
            moving = transfer_motion(true_rest, rest, moving)
        motions.append(moving)
        truths.append(true_moving)
    if transferred:
        notes.append(
            f"the files have different keypoints for {', '.join(transferred)}: the predicted motion was transferred to "
            "those of the truth, so motion is compared and not shape"
        )
    counts = torch.tensor([t.shape[1] for t in truths])
    mask = torch.arange(int(counts.max()))[None] < counts[:, None]
    return MatchedMotion(object_labels([b for _, b in pairs]), _padded(motions), _padded(truths), mask)


def _same_keypoints(a: Float[Tensor, "p 3"], b: Float[Tensor, "q 3"]) -> bool:
    """Whether both are the same points in the same order."""
    if a.shape != b.shape:
        return False
    size = (b.max(0).values - b.min(0).values).norm()
    return bool((a - b).norm(dim=1).max() <= SAME_POINT * size)


def _padded(series: list[Float[Tensor, "t _ 3"]]) -> Float[Tensor, "t o p 3"]:
    """Stack series, padded with zeros to the largest number of points."""
    count = max(s.shape[1] for s in series)
    return torch.stack([torch.nn.functional.pad(s, (0, 0, 0, count - s.shape[1])) for s in series], 1)


def transfer_motion(
    points: Float[Tensor, "q 3"], rest: Float[Tensor, "p 3"], positions: Float[Tensor, "t p 3"]
) -> Float[Tensor, "t q 3"]:
    """Positions of `points` of an object in every frame of its keypoints, by the skinning that moves Gaussians.

    The offset of each point from the keypoints is rotated and stretched with their local deformation.
    """
    from stages.core.physics.keypoints import bind_gaussians  # imports Warp and SciPy
    from stages.core.physics.skinning import Skinning

    q = len(points)
    ones = torch.ones(q, dtype=torch.int64)
    identity = torch.tensor([[1.0, 0, 0, 0]]).repeat(q, 1)
    g = Gaussians(points, identity, torch.ones(q, 3), torch.ones(q), torch.zeros(q, 1, 3), ones)
    keypoints = Keypoints(rest, torch.ones(len(rest), dtype=torch.int64))
    skinning = Skinning(g, bind_gaussians(Scene(g), keypoints), keypoints)
    return torch.stack([skinning(frame).means for frame in positions])
