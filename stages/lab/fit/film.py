"""Fitting to films: render the motion for given parameters from the film cameras and compare it with the images.

The objects are first tracked through the films, as `ngff-lab track` does; the search starts by fitting this track. Then
images are compared in the pixels around the tracked positions of the moving objects. Residuals use the Geman-McClure
function, so that image content that the scene does not explain (a shadow, a hand) has little effect.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.cameras import depths
from stages.core.physics.forces import ForcePrompts
from stages.core.physics.keypoints import bind_gaussians, choose_keypoints
from stages.core.physics.skinning import Skinning
from stages.core.raster.rasterise import rasterise
from stages.core.scene.files import must_exist
from stages.core.scene.recordings import common_frame_rate
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.sequence import MAX_FRAMES, FilmedSequence
from stages.core.scene.trajectory import SimulationInfo, Trajectory
from stages.lab.fit.options import MaterialFitOptions
from stages.lab.fit.problem import FAILED, Problem, pose_problem
from stages.lab.track.confidence import MIN_PIXELS
from stages.lab.track.films import read_films
from stages.lab.track.follow import TrackedMotion, Tracker, follow, motions
from stages.lab.track.search import without
from stages.lab.track.synthesis import Camera, Synthesiser, reduced
from stages.lab.track.track import GRAVITY, check_objects, report, rows_of

log = logging.getLogger(__name__)
PICTURES = 24  # images of each film that are compared, evenly spread over the motion
REDUCTIONS = (4, 2)  # reductions of the compared images, coarse to fine; poses were tracked at the same ones
MARGIN = 2  # width of the compared border around an object [reduced px]; tracked poses are accurate to less than 1 px
# Pixels, before reduction, that count as one independent observation: residuals of the true motion are correlated over
# 50 to 75 pixels (`ngff-lab bench fit-films`, seeds 100 to 102).
BLOCK = 64
CLEARLY = 0.5  # an image shows an object if it differs from a rendering with it by less than this times that without it
FOLLOWED = 0.5  # error below which the track is not fitted any closer [px]; images decide what is nearer


@dataclass(frozen=True)
class Picture:
    """An image of a film, and the mask of the pixels that are compared."""

    film: int  # index of the film
    time: float  # since the first frame [frames]
    image: Float[Tensor, "h w 3"]  # scaled to the brightness of the scene
    window: Bool[Tensor, "h w"]


@dataclass(frozen=True)
class FilmProblem(Problem):
    """A scene and films of it; `track` is the motion that was tracked through the films."""

    cameras: tuple[Camera, ...]  # cameras of the films, in the same order
    skinning: Skinning  # moves the Gaussians of the objects with the keypoints
    pictures: tuple[Picture, ...]
    scale: float  # scale of the Geman-McClure function: larger residuals lose weight [colours from 0 to 1]
    reduction: int  # factor by which the images are reduced

    unit = "colours from 0 to 1"  # unit of `rmse`
    # the mean square of true motions was at most 1.008 times that of tracks (bench, seeds 100 to 102)
    noise_margin = 1.02

    @property
    def tracked(self) -> Problem:
        """The problem of fitting the track alone."""
        return Problem(**{f.name: getattr(self, f.name) for f in fields(Problem)})

    @property
    def levels(self) -> list[FilmProblem]:
        """The same problem with coarse to fine images; the last is this one."""
        return [*(self.coarser(r // self.reduction) for r in REDUCTIONS[:-1]), self]

    @property
    def observations(self) -> float:
        """Number of observations with independent noise: blocks of pixels."""
        return sum(int(p.window.sum()) for p in self.pictures) / self._block

    @property
    def _block(self) -> float:
        return BLOCK / self.reduction**2

    @property
    def noise_level(self) -> float:
        """Root mean square of the residuals at the tracked poses, which do not depend on an engine."""
        return self.mean_square(self.residuals(self.track)) ** 0.5

    def residuals(self, motion: Float[Tensor, "t k 3"]) -> np.ndarray:
        """Geman-McClure residuals of all pixels [scales], nan where the motion diverges.

        They are scaled such that a block of pixels has the weight of one, since neighbouring pixels are correlated.
        """
        if not motion.isfinite().all():
            return np.full(3 * sum(int(p.window.sum()) for p in self.pictures), np.nan)
        rows = torch.cat([self._differences(motion, p) for p in self.pictures])
        return (robust(rows).flatten() / (3 * self._block) ** 0.5).double().numpy()

    def _differences(self, motion: Float[Tensor, "t k 3"], picture: Picture) -> Float[Tensor, "p 3"]:
        camera, first = self.cameras[picture.film], min(int(picture.time), len(motion) - 2)
        g = self.skinning(torch.lerp(motion[first], motion[first + 1], picture.time - first))
        drawn = rasterise(g, camera.viewmat[None], camera.K[None], *camera.size)
        image, _ = camera.in_front(drawn.rgb[0], drawn.alpha[0], drawn.depth[0])
        return (reduced(image, self.reduction) - picture.image)[picture.window] / self.scale

    def mean_square(self, residuals: np.ndarray) -> float:
        """Mean square of the robust residual of a colour channel [scales^2]."""
        return float(np.square(residuals).sum()) / self.observations

    def cost(self, residuals: np.ndarray) -> float:
        """Mean of the Geman-McClure function over all images."""
        cost = self.mean_square(residuals)
        return cost if np.isfinite(cost) else FAILED

    def rmse(self, residuals: np.ndarray) -> float:
        """Root mean square of the robust colour residuals [colours from 0 to 1]."""
        return self.scale * self.mean_square(residuals) ** 0.5

    def first_frames(self, frames: int) -> FilmProblem:
        """The same problem for the first frames only."""
        part = super().first_frames(frames)
        return replace(part, pictures=tuple(p for p in self.pictures if p.time <= frames - 1))

    def coarser(self, factor: int) -> FilmProblem:
        """The same problem with images reduced further by an integer factor."""
        coarse = [replace(p, image=reduced(p.image, factor), window=_shrunk(p.window, factor)) for p in self.pictures]
        return replace(self, pictures=tuple(coarse), reduction=factor * self.reduction)


def _shrunk(window: Bool[Tensor, "h w"], factor: int) -> Bool[Tensor, "h2 w2"]:
    return F.max_pool2d(window[None, None].float(), factor)[0, 0] > 0


def robust(difference: Float[Tensor, "p 3"]) -> Float[Tensor, "p 3"]:
    """Differences [scales] rescaled such that their squares equal the Geman-McClure function of the original."""
    return difference / (1 + difference.square().mean(1, keepdim=True)).sqrt()


def read_film_problem(scene: Path, films: Sequence[Path], options: MaterialFitOptions) -> FilmProblem:
    """Track the objects of a scene through films of its cameras, and set up the problem of fitting these films.

    Each film is named after its camera. For a scene made by `ngff reconstruct --sequence`, films start at the times
    recorded in the scene; otherwise at the state of the scene. Raises InputError for films that do not match the scene
    or each other.
    """
    world = read_scene(scene)
    check_objects(world, scene)
    options = replace(options, rest=False)  # films start when the objects are released
    recordings = by_camera(world, scene, films)
    timed = world.sequence is None  # recorded starts are estimates, which tracking corrects
    world = replace(world, sequence=timing(world, scene, recordings, options.frames))
    cameras, read = read_films(world, recordings, world.sequence.frames, options.resolution)
    frames = min(world.sequence.frames, max(int(len(film.frames) - film.start) for film in read))
    if frames < 3:
        raise InputError(f"{films[0]}: has {max(frames, 0)} frames from the start of the motion on; give a film of "
                         "three or more")  # fmt: skip
    tracker = Tracker(world, cameras, read, pick_device(options.device))
    if not shown(tracker).any():
        raise InputError(f"{films[0]}: its first frame shows no object where {scene} has one; the film must be of a "
                         "camera of the scene, and start with the state of the scene")  # fmt: skip
    fall = torch.tensor([0.0, 0.0, -GRAVITY / world.metres_per_unit])
    track = follow(tracker, frames, fall.to(tracker.device) / world.sequence.fps**2, timed)
    for line in report(world, track):
        log.info(line)
    return film_problem(world, tracker, track, SimulationInfo(1 / world.sequence.fps, tuple(fall.tolist()), "track"),
                        options, str(films[0]))  # fmt: skip


def shown(tracker: Tracker) -> Bool[Tensor, "o"]:
    """Which objects are visible at their positions in the scene: rendering them fits the first images much better."""
    with_it, without_it = [], []
    gone = without(tracker.rest, torch.ones(len(tracker.rest.centre), dtype=torch.bool, device=tracker.device))
    for o in tracker.observe(0, REDUCTIONS[-1], tracker.still, tracker.still):
        drawn, bare = o.draw(tracker.synthesiser, tracker.rest), o.draw(tracker.synthesiser, gone)
        for found, picture in ((with_it, drawn), (without_it, bare)):
            off = o.difference(picture).square().mean(-1).sqrt()
            found.append([off[drawn.label == i] for i in range(len(gone.centre))])
    pairs = zip(zip(*with_it, strict=True), zip(*without_it, strict=True), strict=True)
    return torch.stack([torch.cat(near).median() < CLEARLY * torch.cat(far).median() for near, far in pairs])


def by_camera(world: Scene, scene: Path, films: Sequence[Path]) -> dict[str, Path]:
    """The films by the name of the scene camera that they are named after, ignoring suffixes.

    Raises InputError for a film that matches no camera, and for two films of one camera.
    """
    if world.cameras is None:
        raise InputError(
            f"{scene}: has no cameras, so that it cannot be compared with films; fit a track of its motion"
        )
    known, found = {Path(name).stem: name for name in world.cameras.names}, {}
    for film in films:
        name = known.get(film.stem)
        if name is None:
            raise InputError(f"{film}: {scene} has no camera of this name; name the film as its camera, one of "
                             f"{', '.join(list(known)[:3])}, ...")  # fmt: skip
        if name in found:
            raise InputError(f"{film}: {found[name]} is of the same camera; give one film per camera")
        found[name] = film
    return found


def timing(world: Scene, scene: Path, recordings: dict[str, Path], frames: int) -> FilmedSequence:
    """When the films start, their frame rate, and the number of frames to compare (0: all).

    Raises InputError if the frame rate differs from that of the scene's films, or if the start of a film is unknown.
    """
    for path in recordings.values():
        must_exist(path, "a video")
    rate, known = common_frame_rate(recordings, 0.0), world.sequence
    film = next(iter(recordings.values()))
    if known is None:
        return FilmedSequence(rate, frames or MAX_FRAMES, dict.fromkeys(recordings, 0.0))
    if abs(rate - known.fps) > 1e-3 * known.fps:
        raise InputError(
            f"{film}: has {rate:g} frames per second, but the films of {scene} have {known.fps:g}; give the latter"
        )
    if untimed := [path for name, path in recordings.items() if name not in known.starts]:
        raise InputError(f"{untimed[0]}: {scene} does not state when this camera started to film; leave this film out")
    return replace(known, frames=frames or known.frames)


def film_problem(
    world: Scene, tracker: Tracker, track: TrackedMotion, info: SimulationInfo, options: MaterialFitOptions, where: str
) -> FilmProblem:
    """Set up the problem for films through which the objects of a scene were tracked.

    Raises InputError if nothing moves.
    """
    keypoints = choose_keypoints(world, options.keypoints, options.seed)
    row, poses = rows_of(world, keypoints), track.poses.to("cpu")
    positions = poses.place(keypoints.rest - tracker.rest.centre.cpu()[row], row)
    motion = Trajectory(world, info, keypoints, bind_gaussians(world, keypoints), positions, poses.centre,
                        poses.quaternions(), Path(where))  # fmt: skip
    posed = pose_problem(world, motion, ForcePrompts(), options, where)
    synthesiser = Synthesiser(world, "cpu")  # on the CPU, since each worker process renders its own images
    objects = replace(world, gaussians=synthesiser.rest_gaussians)
    moving = [i for i, o in enumerate(world.objects) if o.id in posed.moving]
    posed = replace(posed, noise=max(posed.noise, FOLLOWED * pixel(tracker, moving)))
    return FilmProblem(
        **{f.name: getattr(posed, f.name) for f in fields(Problem)},
        cameras=tuple(synthesiser.camera(c.viewmat.cpu(), c.K.cpu(), *c.size) for c in tracker.cameras),
        skinning=Skinning(objects.gaussians, bind_gaussians(objects, posed.keypoints), posed.keypoints),
        pictures=tuple(pictures(tracker, track, moving)), scale=max(tracker.scale[i] for i in moving),
        reduction=REDUCTIONS[-1],
    )  # fmt: skip


def pixel(tracker: Tracker, rows: Sequence[int]) -> float:
    """The smallest size of a pixel at the centre of any of the objects in its initial position [scene units]."""
    middle = tracker.rest.centre[rows]
    return min(float((depths(middle, c.viewmat) / c.K[0, 0]).abs().min()) for c in tracker.cameras)


def pictures(tracker: Tracker, track: TrackedMotion, moving: Sequence[int]) -> Iterable[Picture]:
    """PICTURES evenly spread images of each film that show moving objects which were not lost."""
    every = list(_all_pictures(tracker, track, moving))
    for film in range(len(tracker.films)):
        shown = [p for p in every if p.film == film]
        chosen = np.unique(np.linspace(0, len(shown) - 1, min(PICTURES, len(shown))).round().astype(int))
        yield from (shown[i] for i in chosen)


def _all_pictures(tracker: Tracker, track: TrackedMotion, moving: Sequence[int]) -> Iterable[Picture]:
    last = len(track.confidence) - 1
    for frame in range(last + 1):
        rows = [i for i in moving if track.confidence[frame, i] > 0]
        for o in tracker.observe(frame, REDUCTIONS[-1], *motions(track, frame)):
            label = o.draw(tracker.synthesiser, track.poses[frame]).label
            shows = torch.isin(label, torch.tensor(rows, device=label.device))
            if 0 <= frame + o.late <= last and int(shows.sum()) >= MIN_PIXELS:
                window = F.max_pool2d(shows[None, None].float(), 2 * MARGIN + 1, 1, MARGIN)[0, 0] > 0
                yield Picture(o.film, frame + o.late, o.image[..., :3].cpu(), window.cpu())
