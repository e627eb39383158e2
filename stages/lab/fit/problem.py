"""Fitting to a track: simulate the motion for given parameters and measure its distance from the track."""

from __future__ import annotations

import json
import logging
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.backends import load
from stages.core.errors import InputError
from stages.core.physics.forces import ForcePrompts
from stages.core.physics.keypoints import choose_keypoints, farthest_points
from stages.core.physics.materials import Material, choose_materials
from stages.core.physics.recording import read_prompts_file
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.trajectory import Keypoints, Trajectory, read_trajectory
from stages.lab.fit.alignment import aligned
from stages.lab.fit.options import MaterialFitOptions
from stages.lab.fit.parameters import (
    AXES,
    QUANTITIES,
    RIGID,
    Parameter,
    as_json,
    fitted,
    material_parameters,
    velocity_parameters,
)
from stages.simulate.engine_choice import with_engine
from stages.simulate.options import AUTO, ENGINES, SimulateOptions

log = logging.getLogger(__name__)
TOLERANCE = 0.03  # error above which the cost of a frame grows only logarithmically [object sizes]
FAILED = 50.0  # cost of a motion that diverges; larger than any other
FIRST_FRAMES = 4  # frames from which initial velocities are guessed
STILL = 0.01  # largest displacement of an object that counts as not moving [object sizes]
MISPLACED = 0.1  # error in the first frame above which a track does not belong to the scene [object sizes]


@dataclass(frozen=True)
class Problem:
    """A scene, a track of keypoints on its objects, and the known conditions of the motion."""

    scene: Scene
    keypoints: Keypoints
    track: Float[Tensor, "t k 3"]
    prompts: ForcePrompts
    options: SimulateOptions
    materials: dict[int, Material]  # initial values, by object id
    parameters: tuple[Parameter, ...]
    noise: float  # standard deviation of a coordinate of the track [scene units]

    unit = "scene units"  # unit of `rmse`
    noise_margin = 1.1  # factor on the noise variance of the track, which is estimated to within 10 %

    @property
    def tracked(self) -> Problem:
        """The problem to be solved first."""
        return self

    @property
    def levels(self) -> Sequence[Problem]:
        """Problems to be solved after it, each starting from the previous solution."""
        return ()

    @property
    def observations(self) -> float:
        """Number of observations with independent noise: the frames."""
        return len(self.track)

    @property
    def moving(self) -> list[int]:
        """Ids of the objects that are compared, which are those with parameters."""
        return list(dict.fromkeys(p.object_id for p in self.parameters))

    def motion(self, x: Sequence[float]) -> Float[Tensor, "t k 3"]:
        """The keypoint trajectories simulated by the engine; nan if the motion diverges."""
        materials, velocity = fitted(self.parameters, x, self.materials)
        names = {o.id: o.name for o in self.scene.objects}
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "materials.json"
            file.write_text(json.dumps({str(i): as_json(m) for i, m in materials.items() if i in names}))
            options = replace(self.options, material=(), materials=file)
            prompts = replace(self.prompts, velocity={**self.prompts.velocity, **velocity})
            logging.disable(logging.WARNING)  # every simulation would repeat the same messages
            try:
                states = load(ENGINES[options.engine].rollout)(self.scene, self.keypoints, prompts, options)
                return torch.stack([state.positions for state in states])
            except InputError:
                return torch.full_like(self.track, torch.nan)
            finally:
                logging.disable(logging.NOTSET)

    @property
    def tolerance(self) -> Float[Tensor, "o"]:
        """Error that counts as one, for each moving object [scene units]."""
        return TOLERANCE * torch.stack([_size(self.keypoints, i) for i in self.moving])

    def residuals(self, motion: Float[Tensor, "t k 3"]) -> np.ndarray:
        """Differences between the coordinates of the moving objects and the track [tolerances]; nan if it diverges.

        They are scaled such that an object has the weight of a single point in each frame.
        """
        parts = [(motion - self.track)[:, self.keypoints.object_id == i] for i in self.moving]
        return torch.cat([(part / t / part.shape[1] ** 0.5).flatten()
                          for part, t in zip(parts, self.tolerance, strict=True)]).double().numpy()  # fmt: skip

    def errors(self, residuals: np.ndarray) -> Float[Tensor, "t o"]:
        """Mean squared distance of each moving object's keypoints from the track [tolerances^2]."""
        counts = [3 * len(self.track) * int((self.keypoints.object_id == i).sum()) for i in self.moving]
        parts = torch.from_numpy(residuals).split(counts)
        return torch.stack([part.reshape(len(self.track), -1).square().sum(1) for part in parts], 1)

    def mean_square(self, residuals: np.ndarray) -> float:
        """Mean square of the difference between a keypoint coordinate and the track [tolerances^2]."""
        return float(self.errors(residuals).mean()) / 3

    def rmse(self, residuals: np.ndarray) -> float:
        """Root mean square distance of the keypoints from the track [scene units]."""
        return float((self.errors(residuals) * self.tolerance**2).mean()) ** 0.5

    @property
    def noise_level(self) -> float:
        """Standard deviation of the noise of a track coordinate [tolerances]."""
        return self.noise * float(self.tolerance.pow(-2).mean()) ** 0.5

    @property
    def noise_cost(self) -> float:
        """The cost that the noise of the track alone causes."""
        return float(torch.log1p(3 * (self.noise / self.tolerance) ** 2).mean())

    def error(self, residuals: np.ndarray) -> float:
        """Standard deviation of a residual for computing intervals [tolerances], from the residuals of the best fit.

        Noise is independent from frame to frame. Residuals beyond the noise are assumed to be fully correlated and
        therefore count as one observation.
        """
        noise = self.noise_level**2
        excess = max(0.0, self.mean_square(residuals) - self.noise_margin * noise)
        return (noise + self.observations * excess) ** 0.5

    def cost(self, residuals: np.ndarray) -> float:
        """Mean of log(1 + squared error / tolerance^2) over frames and objects.

        After a collision, trajectories diverge; the logarithm keeps such frames from dominating the cost.
        """
        cost = float(torch.log1p(self.errors(residuals)).mean())
        return cost if math.isfinite(cost) else FAILED

    def first_frames(self, frames: int) -> Problem:
        """The same problem for the first frames of the track only."""
        options = replace(self.options, steps=min(frames, len(self.track)))
        return replace(self, track=self.track[:frames], options=options)


def read_problem(scene: Path, track: Path, options: MaterialFitOptions) -> Problem:
    """Set up the problem of a scene file and a trajectory file. Raises InputError if they do not match."""
    truth, world = read_trajectory(track), read_scene(scene)
    if options.align:
        truth = aligned(truth, world, scene)
        return pose_problem(world, truth, ForcePrompts(()), options, str(track))
    return pose_problem(world, truth, read_prompts_file(track, scene.stem, world.objects), options, str(track))


def pose_problem(
    scene: Scene, truth: Trajectory, prompts: ForcePrompts, options: MaterialFitOptions, where: str = "the track"
) -> Problem:
    """The problem of a scene and a track of its objects; `prompts` holds its forces, pins and lifts, but no velocities.

    Raises InputError if the track has none of the scene's objects, or does not start at their positions in the scene.
    """
    tracked = set(truth.keypoints.object_id.tolist())
    scene = replace(scene, objects=tuple(o for o in scene.objects if o.id in tracked))
    if not scene.objects:
        raise InputError(f"{where}: contains no object of this scene; give a motion with the same object ids")
    rows = torch.cat([_spread(truth.keypoints, o.id, options) for o in scene.objects])
    keypoints = Keypoints(truth.keypoints.rest[rows], truth.keypoints.object_id[rows])
    frames = truth.positions[: options.frames or None, rows]
    if len(frames) < 3:
        raise InputError(f"{where}: has {len(frames)} frames; give three or more")
    prompts = replace(prompts, velocity={}, lift=_lifts(scene, keypoints, frames, prompts, where))
    simulate = SimulateOptions(
        steps=len(frames), dt=truth.info.dt, engine=options.engine, quality=options.quality, seed=options.seed,
        gravity=-truth.info.gravity[2] * scene.metres_per_unit, material=options.material, device=options.device,
        keypoints=options.keypoints, rest=options.rest,
    )  # fmt: skip
    if simulate.engine not in (AUTO, *ENGINES):
        raise InputError(f"--engine {simulate.engine}: choose from {', '.join((AUTO, *ENGINES))}")
    simulate = with_engine(simulate, scene, choose_keypoints(scene, options.keypoints, options.seed))
    if simulate.engine == "ngff":  # its solved contacts depend on the same material properties as the rigid engine
        simulate = replace(simulate, contact="learned")
    choices = choose_materials(scene.objects, options.material)
    materials = {i: choice.material for i, choice in choices.items()}
    noise = options.noise or estimate_noise(frames)
    posed = Problem(scene, keypoints, frames, prompts, simulate, materials, (), noise)
    parameters = _parameters(posed)
    if not parameters:
        raise InputError(f"{where}: no object moves; give a motion in which objects move")
    return replace(posed, parameters=tuple(parameters))


def estimate_noise(track: Float[Tensor, "t k 3"]) -> float:
    """Standard deviation of a track's errors, from the median magnitude of its third differences in time.

    Third differences of a smooth motion are nearly zero, and collisions are rare. For independent errors of variance 1
    the third difference has the variance 1 + 9 + 9 + 1.
    """
    if len(track) < 8:
        return 0.0
    third = track.diff(n=3, dim=0).abs()
    moving = third.flatten(1).amax(0) > 0  # keypoints at rest without noise carry no information
    return float(third.flatten(1)[:, moving].median()) / 0.6745 / 20**0.5 if bool(moving.any()) else 0.0


def _spread(keypoints: Keypoints, object_id: int, options: MaterialFitOptions) -> Tensor:
    """Rows of at most `options.keypoints` keypoints of an object, selected by farthest-point sampling."""
    rows = (keypoints.object_id == object_id).nonzero()[:, 0]
    return rows[farthest_points(keypoints.rest[rows], options.keypoints, options.seed)].sort().values


def _size(keypoints: Keypoints, object_id: int) -> Tensor:
    rest = keypoints.rest[keypoints.object_id == object_id]
    return (rest.amax(0) - rest.amin(0)).max().clamp_min(1e-9)


def _lifts(
    scene: Scene, keypoints: Keypoints, frames: Float[Tensor, "t k 3"], prompts: ForcePrompts, where: str
) -> dict[int, float]:
    """Height of each object's start above its position in the scene. Raises InputError for other displacements."""
    lifts = dict(prompts.lift)
    for o in scene.objects:
        mine = keypoints.object_id == o.id
        moved = frames[0, mine] - keypoints.rest[mine]
        if o.id not in lifts and float(moved[:, 2].mean()) > STILL * float(_size(keypoints, o.id)):
            lifts[o.id] = float(moved[:, 2].mean())
        moved = moved - torch.tensor([0.0, 0.0, lifts.get(o.id, 0.0)])
        if float(moved.square().sum(1).mean().sqrt()) > MISPLACED * float(_size(keypoints, o.id)):
            raise InputError(f"{where}: object {o.id} ({o.name}) starts at another position than in the scene; "
                             "the scene must be "
                             "the state in the first frame")  # fmt: skip
    return lifts


def _parameters(problem: Problem) -> list[Parameter]:
    """Material quantities of the objects that move, and initial velocities of those that move from the start.

    Without forces, scaling all densities by a common factor has no effect, so the first object's density stays fixed.
    """
    parameters: list[Parameter] = []
    names = RIGID if problem.options.engine == "rigid" else tuple(QUANTITIES)
    weighed = bool(problem.prompts.forces)
    released = problem.first_frames(FIRST_FRAMES + 1).motion(())
    for o in problem.scene.objects:
        mine = problem.keypoints.object_id == o.id
        size = float(_size(problem.keypoints, o.id))
        centre, still = problem.track[:, mine].mean(1), STILL * size
        if float((centre - centre[0]).norm(dim=1).max()) < still or o.id in problem.prompts.pinned:
            log.info("object %d (%s) does not move; its material is not fitted", o.id, o.name)
            continue
        chosen = [name for name in names if name != "density" or weighed]
        weighed = True
        parameters += material_parameters(o.id, problem.materials[o.id], chosen)
        fall = released[:, mine].mean(1)
        stands = bool((fall - fall[0])[:, 2].abs().max() < still)
        parameters += velocity_parameters(o.id, _first_velocity(problem, centre, still, stands))
    return parameters


def _first_velocity(problem: Problem, centre: Float[Tensor, "t 3"], still: float, stands: bool) -> dict[str, float]:
    """Guess the initial velocity of an object by axis [scene units/s] from its centre in the first frames.

    Empty for an object released from rest. No vertical velocity for a supported object, that is one whose height is
    constant or closer to constant than to free flight (as when it settles), or one that `stands` when released from
    rest and does not hop higher than `still`: in tracks from a single camera, depth errors look like vertical motion.
    """
    unit = problem.scene.metres_per_unit
    first = centre[: FIRST_FRAMES + 1]
    t = problem.options.dt * torch.arange(len(first))
    gravity = problem.options.gravity / unit
    path = first - first[0]
    flight = path + gravity * (t**2 / 2)[:, None] * torch.tensor([0.0, 0.0, 1.0])  # displacement without free fall
    velocity = (t[:, None] * flight).sum(0) / t.square().sum()
    off = (flight[:, 2] - velocity[2] * t).norm()
    supported = bool((path[:, 2].abs() < still).all() or path[:, 2].norm() < off)
    supported |= stands and bool(velocity[2] < (2 * gravity * still) ** 0.5)
    if float((path[:, :2] if supported else flight).norm(dim=1).max()) < still:
        return {}
    return dict(zip(AXES[: 2 if supported else 3], velocity.tolist(), strict=False))
