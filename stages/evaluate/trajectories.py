"""Two trajectories: the metrics of dynamics.py at points that both of them move."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.similarity import Similarity
from stages.core.physics.keypoints import bind_gaussians
from stages.core.physics.skinning import Skinning
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Keypoints, Trajectory, read_trajectory
from stages.evaluate.align import Pairs, ReferenceFrame, check_same_reference_frame, find_alignment
from stages.evaluate.dynamics import STILL, all_metrics, error_over_time
from stages.evaluate.matching import match_objects, object_labels
from stages.evaluate.options import EvaluateOptions
from stages.evaluate.result import Curve, Result

SAME = 1e-3  # keypoints within this share of an object's size at rest are the same keypoints


@dataclass(frozen=True)
class Track:
    """What of a trajectory is compared: its keypoints in every frame."""

    world: ReferenceFrame
    dt: float  # [s]
    object_id: Int[Tensor, "p"]
    rest: Float[Tensor, "p 3"]
    positions: Float[Tensor, "t p 3"]

    def __len__(self) -> int:
        return len(self.positions)

    def of(self, id: int) -> tuple[Tensor, Tensor]:
        """One object's keypoints at rest and in motion."""
        mine = self.object_id == id
        return self.rest[mine], self.positions[:, mine]

    def moved(self, similarity: Similarity) -> Track:
        """The same in another world."""
        rest = similarity(self.rest)
        return replace(self, world=self.world.moved(similarity), rest=rest, positions=similarity(self.positions))


@dataclass(frozen=True)
class MatchedMotion:
    """Both motions at the same points; objects with fewer points than others are padded."""

    names: list[str]
    predicted: Float[Tensor, "t o p 3"]
    truth: Float[Tensor, "t o p 3"]
    mask: Bool[Tensor, "o p"]


def compare(prediction: Path, truth: Path, options: EvaluateOptions) -> Result:
    """Objects and points are matched, then every metric is taken per object and over all of them."""
    true_scene = read_trajectory(truth)
    mine, true = _track(read_trajectory(prediction)), _track(true_scene)
    notes: list[str] = []
    if options.align:
        similarity, how = find_alignment(mine.world, true.world)
        mine = mine.moved(similarity)
        notes.append(f"{how}; scale {similarity.scale:.4g}")
    pairs, how = match_objects(mine.world, true.world, options.object_names)
    notes.append(how)
    if not options.align:
        check_same_reference_frame(mine.world, true.world, pairs)
    mine, true = _same_frames(mine, true, options, notes)
    both = _same_points(mine, true, pairs, notes)
    return _result(both, 1 / true.dt, STILL / true_scene.scene.metres_per_unit, notes)


def _track(trajectory: Trajectory) -> Track:
    """Objects that have keypoints; without any, nothing of them can be compared."""
    keypoints = trajectory.keypoints
    points = {o.id: keypoints.rest[keypoints.object_id == o.id] for o in trajectory.scene.objects}
    objects = tuple(o for o in trajectory.scene.objects if len(points[o.id]))
    world = ReferenceFrame(str(trajectory.path), trajectory.scene.cameras, objects, points)
    return Track(world, trajectory.info.dt, keypoints.object_id, keypoints.rest, trajectory.positions)


def _result(both: MatchedMotion, fps: float, still: float, notes: list[str]) -> Result:
    overall = _floats(all_metrics(both.predicted, both.truth, both.mask, still))
    parts = {
        name: _floats(all_metrics(both.predicted[:, [i]], both.truth[:, [i]], both.mask[[i]], still))
        for i, name in enumerate(both.names)
    }
    errors = error_over_time(both.predicted, both.truth, both.mask)
    curves = [Curve(name, errors[:, i].tolist()) for i, name in enumerate(both.names)]
    title = "mean distance from the truth [scene units]"
    return Result("trajectories", {**overall, "frames": len(both.truth)}, parts, notes, curves, title, fps)


def _floats(metrics: dict[str, Tensor]) -> dict[str, float]:
    return {name: float(value) for name, value in metrics.items()}


def _same_frames(mine: Track, true: Track, options: EvaluateOptions, notes: list[str]) -> tuple[Track, Track]:
    """Both at the same times; whatever is left out was asked for."""
    files = mine.world.file, true.world.file
    if options.resample:
        mine = _resampled(mine, true)
        notes.append(f"the prediction was interpolated to {1 / true.dt:g} frames a second, by --resample")
    if abs(mine.dt - true.dt) > 1e-4 * true.dt:
        raise InputError(
            f"{files[0]}: {1 / mine.dt:g} frames a second, but {files[1]} has {1 / true.dt:g}; "
            "give --resample to interpolate the prediction at the truth's times"
        )
    shorter = min(len(mine), len(true))
    if options.frames is None:
        if len(mine) != len(true):
            raise InputError(
                f"{files[0]}: {len(mine)} frames, but {files[1]} has {len(true)}; "
                f"give --frames {shorter} to compare the first {shorter}"
            )
        return mine, true
    if options.frames > shorter:
        raise InputError(
            f"--frames {options.frames}: {files[0]} has {len(mine)} frames and {files[1]} {len(true)}; "
            f"give {shorter} or fewer"
        )
    notes.append(f"only the first {options.frames} frames were compared, as asked by --frames")
    return tuple(replace(track, positions=track.positions[: options.frames]) for track in (mine, true))


def _resampled(mine: Track, true: Track) -> Track:
    """Keypoints at the truth's frame times, straight between the prediction's; times past its end are left out."""
    count = min(len(true), int((len(mine) - 1) * mine.dt / true.dt + 1e-6) + 1)
    at = torch.arange(count, dtype=torch.float64) * true.dt / mine.dt
    first = at.floor().long().clamp(max=max(len(mine) - 2, 0))
    after = (first + 1).clamp(max=len(mine) - 1)
    positions = torch.lerp(mine.positions[first], mine.positions[after], (at - first).float()[:, None, None])
    return replace(mine, positions=positions, dt=true.dt)


def _same_points(mine: Track, true: Track, pairs: Pairs, notes: list[str]) -> MatchedMotion:
    """The truth's keypoints, and where the prediction takes them."""
    predicted, truths, carried = [], [], []
    for a, b in pairs:
        (rest, moving), (true_rest, true_moving) = mine.of(a.id), true.of(b.id)
        if not _alike(rest, true_rest):
            carried.append(b.name)
            moving = transfer_motion(true_rest, rest, moving)
        predicted.append(moving)
        truths.append(true_moving)
    if carried:
        notes.append(
            f"the files have different keypoints for {', '.join(carried)}: the truth's were carried along by "
            "the predicted motion around them, so motion is compared and not shape"
        )
    counts = torch.tensor([t.shape[1] for t in truths])
    mask = torch.arange(int(counts.max()))[None] < counts[:, None]
    return MatchedMotion(object_labels([b for _, b in pairs]), _padded(predicted), _padded(truths), mask)


def _alike(a: Float[Tensor, "p 3"], b: Float[Tensor, "q 3"]) -> bool:
    """The same points in the same order."""
    if a.shape != b.shape:
        return False
    size = (b.max(0).values - b.min(0).values).norm()
    return bool((a - b).norm(dim=1).max() <= SAME * size)


def _padded(series: list[Float[Tensor, "t _ 3"]]) -> Float[Tensor, "t o p 3"]:
    most = max(s.shape[1] for s in series)
    return torch.stack([torch.nn.functional.pad(s, (0, 0, 0, most - s.shape[1])) for s in series], 1)


def transfer_motion(
    points: Float[Tensor, "q 3"], rest: Float[Tensor, "p 3"], positions: Float[Tensor, "t p 3"]
) -> Float[Tensor, "t q 3"]:
    """Where points near an object go when its keypoints move: the skinning that also moves Gaussians.

    Their offset from the keypoints at rest is kept, turned and stretched with the surroundings.
    """
    q = len(points)
    ones = torch.ones(q, dtype=torch.int64)
    turns = torch.tensor([[1.0, 0, 0, 0]]).repeat(q, 1)
    beads = Gaussians(points, turns, torch.ones(q, 3), torch.ones(q), torch.zeros(q, 1, 3), ones)
    keypoints = Keypoints(rest, torch.ones(len(rest), dtype=torch.int64))
    skinning = Skinning(beads, bind_gaussians(Scene(beads), keypoints), keypoints)
    return torch.stack([skinning(frame).means for frame in positions])
