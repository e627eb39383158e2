"""The fit of films: the motion for given parameters as their cameras would see it, and how far their pictures differ.

Objects are first followed through the films, as `ngff-lab track` does: this is the track on which the search starts.
Then pictures are compared, in the pixels around where the moving objects were followed to, by Geman and McClure's
function, so that what the scene does not explain (a shadow, a hand) has little effect.
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
PICTURES = 24  # of each film that are compared, evenly spread over the motion
REDUCTIONS = (4, 2)  # of the pictures that are compared, coarse to fine: those at which poses were fitted
MARGIN = 2  # of the pixels compared around an object [reduced px]: poses were fitted to a fraction of a pixel
# pixels, before they are reduced, that count as one observation: residuals of true motions are correlated over 50 to 75
# of them (`ngff-lab bench fit-films`, seeds 100 to 102)
BLOCK = 64
CLEARLY = 0.5  # difference of pictures to renderings with an object, of that without it, up to which they show it
FOLLOWED = 0.5  # error of the track up to which the search goes on [px]: pictures tell what is nearer


@dataclass(frozen=True)
class Picture:
    """A picture of a film, and the pixels of it that are compared."""

    film: int  # its number
    time: float  # since the first frame [frames]
    image: Float[Tensor, "h w 3"]  # at the brightness of the scene
    window: Bool[Tensor, "h w"]


@dataclass(frozen=True)
class FilmProblem(Problem):
    """A scene and films of it; `track` is its motion as it was followed through them."""

    cameras: tuple[Camera, ...]  # of the films
    skinning: Skinning  # of the Gaussians of the objects
    pictures: tuple[Picture, ...]
    scale: float  # of the residuals of pixels, above which they have less and less weight [colours from 0 to 1]
    reduction: int  # of the pictures

    unit = "colours from 0 to 1"  # of `rmse`
    noise_margin = 1.02  # mean squares of true motions were at most 1.008 of those of tracks (bench, seeds 100 to 102)

    @property
    def tracked(self) -> Problem:
        """The fit of the track."""
        return Problem(**{f.name: getattr(self, f.name) for f in fields(Problem)})

    @property
    def levels(self) -> list[FilmProblem]:
        """The problem with coarse to fine pictures; the last is this one."""
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
        """Root mean square of the residuals of the track, whose poses are free of any engine."""
        return self.mean_square(self.residuals(self.track)) ** 0.5

    def residuals(self, motion: Float[Tensor, "t k 3"]) -> np.ndarray:
        """Robust differences of all pixels [scales], nan where the motion diverges.

        They are scaled so that a block of pixels has the weight of one: those of neighbours are not independent.
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
        """Of the robust difference of a channel [scales^2]."""
        return float(np.square(residuals).sum()) / self.observations

    def cost(self, residuals: np.ndarray) -> float:
        """Mean of Geman and McClure's function over the pictures."""
        cost = self.mean_square(residuals)
        return cost if np.isfinite(cost) else FAILED

    def rmse(self, residuals: np.ndarray) -> float:
        """Root mean square of the robust differences of colours, of 0 to 1."""
        return self.scale * self.mean_square(residuals) ** 0.5

    def first_frames(self, frames: int) -> FilmProblem:
        """The same problem for the first frames only."""
        part = super().first_frames(frames)
        return replace(part, pictures=tuple(p for p in self.pictures if p.time <= frames - 1))

    def coarser(self, factor: int) -> FilmProblem:
        """The same problem with pictures that are further reduced by a whole factor."""
        coarse = [replace(p, image=reduced(p.image, factor), window=_shrunk(p.window, factor)) for p in self.pictures]
        return replace(self, pictures=tuple(coarse), reduction=factor * self.reduction)


def _shrunk(window: Bool[Tensor, "h w"], factor: int) -> Bool[Tensor, "h2 w2"]:
    return F.max_pool2d(window[None, None].float(), factor)[0, 0] > 0


def robust(difference: Float[Tensor, "p 3"]) -> Float[Tensor, "p 3"]:
    """Differences [scales] whose squares are Geman and McClure's function of them."""
    return difference / (1 + difference.square().mean(1, keepdim=True)).sqrt()


def read_film_problem(scene: Path, films: Sequence[Path], options: MaterialFitOptions) -> FilmProblem:
    """Follow the objects of a scene through films of its cameras, and pose the problem of these films.

    Films are named as their cameras. Those of a scene that `ngff reconstruct --sequence` made start when it says,
    others with the scene. Raises InputError for films that do not fit the scene or each other.
    """
    world = read_scene(scene)
    check_objects(world, scene)
    options = replace(options, rest=False)  # films begin as objects are released
    recordings = by_camera(world, scene, films)
    timed = world.sequence is None  # otherwise starts are estimates, which are corrected
    world = replace(world, sequence=timing(world, scene, recordings, options.frames))
    cameras, read = read_films(world, recordings, world.sequence.frames, options.resolution)
    frames = min(world.sequence.frames, max(int(len(film.frames) - film.start) for film in read))
    if frames < 3:
        raise InputError(f"{films[0]}: has {max(frames, 0)} frames from the start of the motion on; motion is seen in "
                         "three or more")  # fmt: skip
    tracker = Tracker(world, cameras, read, pick_device(options.device))
    if not shown(tracker).any():
        raise InputError(f"{films[0]}: shows no object where {scene} has it in the first frame; the film must be of a "
                         "camera of the scene, and start with it")  # fmt: skip
    fall = torch.tensor([0.0, 0.0, -GRAVITY / world.metres_per_unit])
    track = follow(tracker, frames, fall.to(tracker.device) / world.sequence.fps**2, timed)
    for line in report(world, track):
        log.info(line)
    return film_problem(world, tracker, track, SimulationInfo(1 / world.sequence.fps, tuple(fall.tolist()), "track"),
                        options, str(films[0]))  # fmt: skip


def shown(tracker: Tracker) -> Bool[Tensor, "o"]:
    """Which objects the first pictures show where the scene has them: clearly nearer to its renderings than without."""
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
    """The films by the camera of the scene whose name they have, but for the suffix.

    Raises InputError for films of no camera, and of one that has another film.
    """
    if world.cameras is None:
        raise InputError(f"{scene}: has no cameras, so that films of it cannot be compared; fit a track of its motion")
    known, found = {Path(name).stem: name for name in world.cameras.names}, {}
    for film in films:
        name = known.get(film.stem)
        if name is None:
            raise InputError(f"{film}: {scene} has no camera of this name; name the film as its camera, one of "
                             f"{', '.join(list(known)[:3])}, ...")  # fmt: skip
        if name in found:
            raise InputError(f"{film}: {found[name]} is of the same camera; give one film of each")
        found[name] = film
    return found


def timing(world: Scene, scene: Path, recordings: dict[str, Path], frames: int) -> FilmedSequence:
    """When the films start, their frame rate, and the number of frames to compare (0: all).

    Raises InputError for other frame rates than that of the scene's films, and for films that start at unknown times.
    """
    for path in recordings.values():
        must_exist(path, "a video")
    rate, known = common_frame_rate(recordings, 0.0), world.sequence
    film = next(iter(recordings.values()))
    if known is None:
        return FilmedSequence(rate, frames or MAX_FRAMES, dict.fromkeys(recordings, 0.0))
    if abs(rate - known.fps) > 1e-3 * known.fps:
        raise InputError(
            f"{film}: has {rate:g} frames a second, but the films of {scene} have {known.fps:g}; give these"
        )
    if untimed := [path for name, path in recordings.items() if name not in known.starts]:
        raise InputError(f"{untimed[0]}: {scene} does not say when this camera started to film; leave this film out")
    return replace(known, frames=frames or known.frames)


def film_problem(
    world: Scene, tracker: Tracker, track: TrackedMotion, info: SimulationInfo, options: MaterialFitOptions, where: str
) -> FilmProblem:
    """The problem of films through which the objects of a scene were followed.

    Raises InputError where nothing moves.
    """
    keypoints = choose_keypoints(world, options.keypoints, options.seed)
    row, poses = rows_of(world, keypoints), track.poses.to("cpu")
    positions = poses.place(keypoints.rest - tracker.rest.centre.cpu()[row], row)
    motion = Trajectory(world, info, keypoints, bind_gaussians(world, keypoints), positions, poses.centre,
                        poses.quaternions(), Path(where))  # fmt: skip
    posed = pose_problem(world, motion, ForcePrompts(), options, where)
    synthesiser = Synthesiser(world, "cpu")  # for processes of which each draws its own pictures
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
    """The smallest size of a pixel at the middle of one of the objects in its first place [scene units]."""
    middle = tracker.rest.centre[rows]
    return min(float((depths(middle, c.viewmat) / c.K[0, 0]).abs().min()) for c in tracker.cameras)


def pictures(tracker: Tracker, track: TrackedMotion, moving: Sequence[int]) -> Iterable[Picture]:
    """Some pictures of each film that show moving objects which were followed."""
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
