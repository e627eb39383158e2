"""Tracking of objects frame by frame through the images of several cameras."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.scene.cameras import Cameras
from stages.core.scene.scene import Scene
from stages.lab.track.alignment import Observation, align, change_of, robust_weights
from stages.lab.track.colours import LaterColours
from stages.lab.track.confidence import confidences, differences, scales, tolerances
from stages.lab.track.film_masks import UNKNOWN
from stages.lab.track.films import Film
from stages.lab.track.poses import Poses
from stages.lab.track.search import search, spread_rotations, without
from stages.lab.track.synthesis import Camera, Synthesiser, reduced

log = logging.getLogger(__name__)
FIRST = {8: 4, 4: 4}  # maximum number of Gauss-Newton steps by image reduction, in the first pass
REFINING = {4: 2, 2: 2}  # maximum number of steps by image reduction, in later passes, with both neighbours known
JUDGING = 2  # image reduction at which confidences are computed
RETIMING = (4, 2)  # image reduction at which film starts are corrected, before each later pass
RETIMING_STEPS = 2  # Gauss-Newton steps of each correction of the film starts
CERTAIN = 0.85  # confidence, relative to the object's usual one, from which a lost object counts as found
FOUND = 0.75  # confidence relative to the usual one from which an object found by a search with a distinct pose counts
LASTING = 3  # number of frames for which an object found again must stay visible
WRONG_TURNS, WRONG_VIEWS = 8, 3  # number of wrong rotations and of images from which tolerances are computed
FALLING = 6  # number of frames of free fall to which the release time is fitted
MAX_MISFIT = 0.1  # largest deviation from free fall in the fit of the release time [frames]


@dataclass(frozen=True)
class TrackedMotion:
    """Poses of all objects in all frames, with confidences."""

    poses: Poses  # batch of t frames
    confidence: Float[Tensor, "t o"]  # 0: lost
    pixels: Float[Tensor, "t o"]  # number of pixels in which each object is expected to be visible
    starts: dict[str, float]  # corrected start of each film [frames]


class Tracker:
    """A scene and its films, with the operations on single frames at several resolutions."""

    def __init__(self, scene: Scene, cameras: Cameras, films: list[Film], device: str):
        labelled = any(film.labels is not None for film in films)
        self.synthesiser, self.films, self.device = Synthesiser(scene, device, labelled), films, device
        views = zip(cameras.viewmats, cameras.Ks, cameras.sizes.tolist(), strict=True)
        self.cameras: list[Camera] = [self.synthesiser.camera(V, K, *size) for V, K, size in views]
        self.rest = self.synthesiser.at_rest()
        self.still = torch.zeros(len(self.rest.centre), 6, device=device)
        self.gains = [self._gain(i) for i in range(len(films))]
        first = self.observe(0, JUDGING, self.still, self.still)
        self.scale = scales(differences(self.synthesiser, first, self.rest))
        self.tolerance = tolerances(self._wrong(first[:: math.ceil(len(first) / WRONG_VIEWS)]), self.scale)
        self.colours = LaterColours(self.synthesiser, self.observe(0, 1, self.still, self.still), self.tolerance)

    def _wrong(self, first: list[Observation]) -> list[list[Tensor]]:
        """Differences to images of the release with all objects rotated wrongly."""
        turns = spread_rotations(WRONG_TURNS).to(self.device)
        turned = [Poses(turn.expand_as(self.rest.rotation), self.rest.centre) for turn in turns]
        return [row for poses in turned for row in differences(self.synthesiser, first, poses)]

    def _gain(self, i: int) -> Float[Tensor, "3"]:
        """Brightness of a film relative to the scene, per channel, at the release."""
        film = self.films[i]
        drawn = self.synthesiser.draw(self.cameras[i], self.rest).image[..., :3]
        first = film.frames[min(max(int(film.start), 0), len(film.frames) - 1)].to(self.device).float() / 255
        return ((first * drawn).sum((0, 1)) / drawn.square().sum((0, 1)).clamp_min(1e-6)).clamp(0.5, 2.0)

    def observe(self, frame: int, reduction: int, before: Tensor, after: Tensor) -> list[Observation]:
        """The image of each film closest in time to a frame, without films that have ended.

        `before` and `after` are the motions of the objects from the previous frame and to the next one.
        """
        seen = []
        for i, film in enumerate(self.films):
            time = film.start + frame
            k = round(time)
            if 0 <= k < len(film.frames):
                late = k - time
                image = reduced(self._picture(i, k), reduction)
                moved = late * (after if late > 0 else before)
                seen.append(Observation(i, late, self.cameras[i], reduction, image, moved))
        return seen

    def _picture(self, i: int, k: int) -> Float[Tensor, "h w c"]:
        """Frame k of film i at the brightness of the scene, with painted labels if any film has label images."""
        film = self.films[i]
        image = film.frames[k].to(self.device).float() / 255 / self.gains[i]
        if self.synthesiser.paint is None:
            return image
        label = image.new_full(image.shape[:2], UNKNOWN) if film.labels is None else film.labels[k].to(self.device)
        return torch.cat([image, self.synthesiser.painted(label - 1)], -1)

    def fit(
        self, frame: int, steps: dict[int, int], poses: Poses, motion: tuple[Tensor, Tensor],
        fixed: Tensor | None = None,
    ) -> Poses:  # fmt: skip
        """The poses in a frame, starting from nearby poses; `fixed` objects keep theirs."""
        levels = [(self.observe(frame, reduction, *motion), count) for reduction, count in steps.items()]
        return align(self.synthesiser, levels, poses, self.scale, fixed)

    def judge(self, frame: int, poses: Poses, motion: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
        """Confidence and number of expected pixels of each object in a frame."""
        found = differences(self.synthesiser, self.observe(frame, JUDGING, *motion), poses)
        return confidences(found, self.tolerance)

    def learn(self, frame: int, poses: Poses, motion: tuple[Tensor, Tensor], followed: Tensor) -> None:
        """Learn the colours of previously unseen sides of the objects that were `followed` up to this frame."""
        self.colours.learn(self.observe(frame, 1, *motion), poses, followed)


def follow(tracker: Tracker, frames: int, gravity: Float[Tensor, "3"], timed: bool = False) -> TrackedMotion:
    """Track all objects from their positions in the scene.

    `gravity` is in scene units / frame^2. If the starts of the films are not exactly known (not `timed`), they are
    corrected using the fact that the objects are released from rest.
    """
    track = first_pass(tracker, frames, gravity)
    if timed:
        track = refined(tracker, replace(track, poses=interpolated(track)))
    else:
        for reduction in RETIMING:
            track = from_release(tracker, track)
            tracker.films = retimed(tracker, track, reduction)
            track = refined(tracker, track)
        track = from_release(tracker, track)
    return replace(track, starts={film.name: film.start for film in tracker.films})


def first_pass(tracker: Tracker, frames: int, gravity: Float[Tensor, "3"]) -> TrackedMotion:
    """Track frame by frame from poses extrapolated at constant velocity, searching for lost objects in each frame."""
    rest, velocity = tracker.rest, tracker.still
    share, number = tracker.judge(0, rest, (velocity, velocity))
    poses, shares, pixels = [rest], [share], [number]
    last, missing = rest, torch.zeros_like(velocity[:, 0])  # pose when last seen, and number of frames since then
    streak = missing  # number of consecutive frames in which each object has been seen
    for frame in tqdm(range(1, frames), desc="tracking", unit="frame", leave=False):
        away, motion, usual = missing.cpu() > 0, (velocity, velocity), _usual(torch.stack(shares))
        n = (missing + 1)[:, None]
        fall = n * missing[:, None] / 2 * torch.cat([torch.zeros_like(gravity), gravity])
        predicted = last.moved(n * velocity + fall)
        found, share, number = fitted_seen(tracker, frame, FIRST, without(predicted, away), motion)
        for i in away.nonzero()[:, 0].tolist():
            mine = torch.arange(len(away), device=tracker.device) == i
            again = tracker.fit(frame, FIRST, _choose(mine, predicted, found), motion, ~mine)
            now, seen = tracker.judge(frame, again, motion)
            certain = bool(now[i] >= CERTAIN * usual[i])
            if not certain:
                sighting = search(tracker, frame, i, _choose(mine, last, found), velocity, int(missing[i]))
                if sighting is not None:
                    again, (now, seen) = sighting.poses, tracker.judge(frame, sighting.poses, motion)
                    certain = sighting.distinct and bool(now[i] >= FOUND * usual[i])
            number[i] = seen[i]
            if certain:
                found, share = again, now
        lost = (share == 0).to(tracker.device)
        step = last.step_to(found) / n
        step[missing > 0, :3] = 0  # the number of turns made while lost is unknown
        velocity = torch.where(lost[:, None], velocity, step)
        poses.append(_choose(lost, last, found))
        shares.append(share)
        pixels.append(number)
        last, missing, streak = poses[-1], torch.where(lost, missing + 1, 0.0), torch.where(lost, 0.0, streak + 1)
        tracker.learn(frame, last, (velocity, velocity), streak >= LASTING)
    return TrackedMotion(Poses.stack(poses), lasting(torch.stack(shares)), torch.stack(pixels), {})


def fitted_seen(
    tracker: Tracker, frame: int, steps: dict[int, int], start: Poses, motion: tuple[Tensor, Tensor]
) -> tuple[Poses, Tensor, Tensor]:
    """The poses of visible objects in a frame, starting from nearby poses, with confidences and numbers of pixels.

    Objects that the images do not confirm are hidden and the others fitted again, since objects rendered at wrong
    places would occlude them.
    """
    found = tracker.fit(frame, steps, start, motion)
    share, number = tracker.judge(frame, found, motion)
    hiding = (share == 0) & (number > 0)
    if hiding.any():
        found = tracker.fit(frame, steps, without(start, hiding), motion)
        share, seen = tracker.judge(frame, found, motion)
        number = torch.where(hiding, number, seen)
    return found, share, number


def from_release(tracker: Tracker, track: TrackedMotion) -> TrackedMotion:
    """The track without gaps, shifted to begin at the release detected in it; film starts are shifted accordingly."""
    late = release_time(track)
    log.debug("released %.2f frames later than assumed", late)
    tracker.films = [replace(film, start=film.start + late) for film in tracker.films]
    return replace(track, poses=_shifted(interpolated(track), late))


def release_time(track: TrackedMotion) -> float:
    """Release time of the objects that fall at the start [frames]: the square root of their drop grows linearly."""
    times = []
    drop = track.poses.centre[0, :, 2] - track.poses.centre[..., 2]
    for i in range(drop.shape[1]):
        first = next((t for t in range(1, len(drop)) if drop[t, i] < drop[t - 1, i] or not track.confidence[t, i]),
                     len(drop))  # fmt: skip
        fallen = drop[:first, i].clamp_min(0).sqrt().cpu()
        used = torch.arange(2, max(2, min(first, 2 + FALLING)))
        if len(used) < FALLING:
            continue
        design = torch.stack([used.float(), torch.ones(len(used))], 1)
        slope, offset = torch.linalg.lstsq(design, fallen[used][:, None]).solution[:, 0].tolist()
        misfit = float((design @ torch.tensor([slope, offset]) - fallen[used]).abs().max())
        if slope > 0 and misfit < MAX_MISFIT * slope:  # free fall
            times.append(-offset / slope)
    return float(torch.tensor(times).median().clamp(-1, 1)) if times else 0.0


def _shifted(poses: Poses, late: float) -> Poses:
    """The poses `late` frames later, interpolated linearly; times before the first frame give its poses."""
    last = len(poses.centre) - 1
    time = (torch.arange(last + 1) + late).clamp(0, last)
    time[0] = 0  # the objects are at rest in the first frame
    at = time.floor().long().clamp(max=max(last - 1, 0))
    part = (time - at)[:, None, None].to(poses.centre)
    return poses[at].moved(part * poses[at].step_to(poses[(at + 1).clamp(max=last)]))


def _usual(shares: Float[Tensor, "t o"]) -> Float[Tensor, "o"]:
    """The mean confidence of each object over the frames in which it was seen; 1 if it was never seen."""
    seen = shares > 0
    return torch.where(seen.any(0), shares.sum(0) / seen.sum(0).clamp_min(1), 1.0)


def lasting(shares: Float[Tensor, "t o"]) -> Float[Tensor, "t o"]:
    """The confidences, set to 0 where an object was seen for fewer than LASTING frames between lost frames."""
    kept = shares.clone()
    for i in range(shares.shape[1]):
        seen = (shares[:, i] > 0).tolist()
        start = 0
        for t in range(1, len(seen) + 1):
            if t == len(seen) or seen[t] != seen[start]:
                if seen[start] and start > 0 and t < len(seen) and t - start < LASTING:
                    kept[start:t, i] = 0
                start = t
    return kept


def _choose(mask: Tensor, yes: Poses, no: Poses) -> Poses:
    """`yes` for the objects in the mask, `no` for the others."""
    return Poses(torch.where(mask[:, None, None], yes.rotation, no.rotation),
                 torch.where(mask[:, None], yes.centre, no.centre))  # fmt: skip


def motions(track: TrackedMotion, frame: int) -> tuple[Tensor, Tensor]:
    """The motions from the previous frame and to the next frame; at both ends of the track, the same motion twice."""
    p, last = track.poses, len(track.poses.centre) - 1
    before = p[frame - 1].step_to(p[frame]) if frame > 0 else None
    after = p[frame].step_to(p[frame + 1]) if frame < last else before
    return (after if before is None else before), after


def refined(tracker: Tracker, track: TrackedMotion) -> TrackedMotion:
    """Fit every pose of the track again, using the now known motions between frames."""
    rotation, centre = track.poses.rotation.clone(), track.poses.centre.clone()
    shares, pixels = track.confidence.clone(), track.pixels.clone()
    now, usual = replace(track, poses=Poses(rotation, centre)), _usual(track.confidence)
    for frame in tqdm(range(1, len(centre)), desc="refining", unit="frame", leave=False):
        motion = motions(now, frame)
        found, share, pixels[frame] = fitted_seen(tracker, frame, REFINING, now.poses[frame], motion)
        doubtful = (shares[frame] == 0) & (share < CERTAIN * usual)  # its rotation may be wrong
        shares[frame] = torch.where(doubtful, 0.0, share)
        found = _choose((shares[frame] == 0).to(tracker.device), now.poses[frame], found)
        rotation[frame], centre[frame] = found.rotation, found.centre
    return replace(now, confidence=lasting(shares), pixels=pixels)


def retimed(tracker: Tracker, track: TrackedMotion, reduction: int) -> list[Film]:
    """Correct the film starts such that they explain the differences along the motion best; their mean is unchanged."""
    films = tracker.films
    for _ in range(RETIMING_STEPS):
        late = _lateness(tracker, track, reduction)
        late -= late.mean()
        log.debug("starts moved by %s frames", [round(-float(x), 3) for x in late])
        tracker.films = [replace(f, start=f.start - float(x)) for f, x in zip(tracker.films, late, strict=True)]
    found, tracker.films = tracker.films, films
    return found


def _lateness(tracker: Tracker, track: TrackedMotion, reduction: int) -> Float[Tensor, "c"]:
    """How much later than assumed each film's images were taken [frames], by one Gauss-Newton step."""
    along, square = torch.zeros(len(tracker.films)), torch.full((len(tracker.films),), 1e-9)
    for frame in range(1, len(track.confidence)):
        motion = motions(track, frame)
        seen = track.confidence[frame].to(tracker.device) > 0
        poses = without(track.poses[frame], ~seen)
        for o in tracker.observe(frame, reduction, *motion):
            change = change_of(o, o.draw(tracker.synthesiser, poses), poses.centre)
            keep = seen[change.row]
            speed = (motion[1] if o.late > 0 else motion[0])[change.row[keep]]
            r, by_time = change.residual[keep], torch.einsum("pci,pi->pc", change.jacobian[keep], speed)
            w = robust_weights(r, max(tracker.scale))[:, None]
            along[o.film] += float((w * by_time * r).sum())
            square[o.film] += float((w * by_time.square()).sum())
    return along / square


def interpolated(track: TrackedMotion) -> Poses:
    """The poses, with those of lost frames interpolated between the neighbouring known frames."""
    seen = track.confidence > 0
    t = torch.arange(len(seen))[:, None].expand_as(seen)
    before = torch.where(seen, t, -1).cummax(0).values
    after = torch.where(seen, t, len(seen)).flip(0).cummin(0).values.flip(0)
    before, after = torch.where(before < 0, after, before), torch.where(after == len(seen), before, after)
    before, after = before.clamp(0, len(seen) - 1), after.clamp(0, len(seen) - 1)
    part = (t - before) / (after - before).clamp_min(1)
    column = torch.arange(seen.shape[1])
    first, last = track.poses[before, column], track.poses[after, column]
    return first.moved(part[..., None].to(first.centre) * first.step_to(last))
