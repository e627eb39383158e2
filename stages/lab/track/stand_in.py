"""Synthetic substitute for real recordings: toys that fall onto a table, filmed by fixed cameras, with known motion.

The films have noise and motion blur and start at different times, in thirds of a frame. One film ends early, and an
occluder covers one of the objects for some frames.
"""

from __future__ import annotations

import json
import random
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.backends import load
from stages.core.geometry.cameras import intrinsics, look_at, project
from stages.core.geometry.rotations import matrix
from stages.core.geometry.similarity import Similarity
from stages.core.physics.forces import ForcePrompts
from stages.core.physics.keypoints import bind_gaussians, choose_keypoints
from stages.core.physics.state import FrameState
from stages.core.raster.rasterise import rasterise
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians, concatenate, transformed
from stages.core.scene.images import VideoWriter, write_jpeg
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.trajectory import Keypoints, SimulationInfo, TrajectoryWriter
from stages.lab.assets.toys import falling_toys
from stages.simulate.options import ENGINES, SimulateOptions

SUBSTEPS = 6  # simulated steps per frame
EXPOSURE = (-1, 0, 1)  # simulated steps averaged in an image, relative to the middle of its frame
BEFORE = (6, 12)  # minimum and maximum number of film frames before the release
AFTER = 6  # number of film frames after the motion
STIFF_TOYS = (1, 2, 3)  # indices in `falling_toys`, counted from 1
THINNED = 5  # only every n-th Gaussian of a toy is kept
KEYPOINTS = 64  # per object


@dataclass(frozen=True)
class StandInOptions:
    """Content and quality of the films."""

    objects: int = 3
    cameras: int = 10
    width: int = 240  # width of the films [px]; the height is three quarters of it
    frames: int = 50  # number of frames from the release on
    fps: float = 50.0
    noise: float = 0.02  # standard deviation of a colour channel (0..1)
    broken: bool = True  # the last film ends half way
    hidden: int = 10  # number of frames in which the first object is covered; 0: none
    seed: int = 0


@dataclass(frozen=True)
class StandIn:
    """A scene at the release, its true motion, and the start of each film."""

    scene: Scene
    starts: dict[str, float]  # frame number of each film at the release, with fractions
    keypoints: Keypoints
    states: list[FrameState]  # SUBSTEPS per frame
    hidden: range  # frames in which the first object is covered
    options: StandInOptions


def make_stand_in(options: StandInOptions) -> StandIn:
    """A random scene of stiff toys in the air, with their motion simulated by the rigid engine."""
    rng = random.Random(options.seed)
    scene = _scene(options, rng)
    keypoints = choose_keypoints(scene, KEYPOINTS, options.seed)
    simulate = SimulateOptions(
        steps=options.frames * SUBSTEPS, dt=1 / options.fps / SUBSTEPS, engine="rigid", seed=options.seed, device="cpu"
    )
    free = replace(scene, cameras=None)  # objects of photographed scenes are assumed to be at rest
    states = list(load(ENGINES["rigid"].rollout)(free, keypoints, ForcePrompts(), simulate))
    starts = {name: rng.randint(*BEFORE) + rng.randrange(3) / 3 for name in scene.cameras.names}
    first = rng.randint(5, max(5, options.frames // 2 - options.hidden))
    return StandIn(scene, starts, keypoints, states, range(first, first + options.hidden), options)


def _scene(options: StandInOptions, rng: random.Random) -> Scene:
    """Random toys with random rotations, stacked in columns in the air."""
    toys = falling_toys()
    parts, objects = [thinned(toys.gaussians[toys.gaussians.object_id == 0])], []
    kinds = rng.sample(STIFF_TOYS, min(options.objects, len(STIFF_TOYS)))
    generator = torch.Generator().manual_seed(options.seed)
    for id in range(1, options.objects + 1):
        kind = toys.objects[kinds[(id - 1) % len(kinds)] - 1]
        toy = thinned(toys.gaussians[toys.gaussians.object_id == kind.id])
        centre = (toy.means.amin(0) + toy.means.amax(0)) / 2
        turn = matrix(torch.nn.functional.normalize(torch.randn(4, generator=generator), dim=0))
        # columns of two toys, so that objects collide in the air and on the table
        column, row = divmod(id - 1, 2)
        at = torch.tensor([0.2 * column - 0.08 + rng.uniform(-0.03, 0.03), rng.uniform(-0.06, 0.06),
                           0.16 + 0.2 * row + rng.uniform(0, 0.04)])  # fmt: skip
        placed = transformed(toy, Similarity(1.0, turn, at - turn @ centre))
        parts.append(replace(placed, object_id=torch.full((len(placed),), id)))
        objects.append(SceneObject(id, kind.name, "wood"))
    scale = {"metres_per_unit": 1.0, "source": "made in code"}
    return Scene(
        concatenate(parts),
        tuple(objects),
        cameras_around(options.cameras, options.width, rng),
        0.0,
        scale,
        background=(0.5, 0.5, 0.5),
    )


def thinned(g: Gaussians) -> Gaussians:
    """Every THINNED-th Gaussian, enlarged to cover the same area."""
    part = g[torch.arange(0, len(g), THINNED)]
    return replace(part, scales=part.scales * torch.tensor([THINNED**0.5, THINNED**0.5, 1.0]))


def cameras_around(count: int, width: int, rng: random.Random) -> Cameras:
    """Cameras around the table at different heights, with images of width [px] by three quarters of it."""
    azimuth = torch.tensor([2 * torch.pi * (i + rng.uniform(-0.2, 0.2)) / count for i in range(count)])
    height = torch.tensor([rng.uniform(0.25, 0.75) for _ in range(count)])
    eyes = torch.stack([1.1 * azimuth.cos(), 1.1 * azimuth.sin(), height], 1)
    viewmats = look_at(eyes, torch.tensor([0.0, 0.0, 0.12]).expand_as(eyes))
    sizes = torch.tensor([[width, width * 3 // 4]] * count)
    K = intrinsics(width, width * 3 // 4, 1.25 * width).expand(count, 3, 3).clone()
    return Cameras(viewmats, K, sizes, tuple(f"camera{i:02d}.mp4" for i in range(count)))


def write_photos(options: StandInOptions, folder: Path) -> None:
    """Write a noisy photo from each camera at the release."""
    scene, generator = _scene(options, random.Random(options.seed)), torch.Generator().manual_seed(options.seed)
    folder.mkdir(parents=True, exist_ok=True)
    views = zip(scene.cameras.viewmats, scene.cameras.Ks, scene.cameras.sizes.tolist(), strict=True)
    for i, (V, K, size) in enumerate(views):
        image = rasterise(scene.gaussians, V[None], K[None], *size, torch.tensor(scene.background)).rgb[0]
        noisy = image + options.noise * torch.randn(image.shape, generator=generator)
        write_jpeg(folder / f"{i:02d}.jpg", noisy.clamp(0, 1))


def write_truth(stand_in: StandIn, out: Path) -> None:
    """Write the true motion from the release on, at the frame rate of the films."""
    o, scene = stand_in.options, stand_in.scene
    info = SimulationInfo(1 / o.fps, (0.0, 0.0, -9.81), "rigid")
    binding = bind_gaussians(scene, stand_in.keypoints)
    with TrajectoryWriter(out, scene, info, stand_in.keypoints, binding) as writer:
        for state in stand_in.states[::SUBSTEPS]:
            writer.append(state.positions, state.com, state.rotation)


def film(stand_in: StandIn, camera: int) -> Iterator[Float[Tensor, "h w 3"]]:
    """The frames of a camera's film, with noise and motion blur."""
    o, cameras = stand_in.options, stand_in.scene.cameras
    start = stand_in.starts[cameras.names[camera]]
    generator = torch.Generator().manual_seed(1000 * o.seed + camera)
    count = round(start) + o.frames + AFTER
    if o.broken and camera == len(cameras) - 1:
        count = round(start) + o.frames // 2
    for k in range(count):
        middle = round((k - start) * SUBSTEPS)
        pictures = [_picture(stand_in, camera, middle + step) for step in EXPOSURE]
        image = torch.stack(pictures).mean(0)
        image = image + o.noise * torch.randn(image.shape, generator=generator)
        yield image.clamp(0, 1)


def _picture(stand_in: StandIn, camera: int, step: int) -> Float[Tensor, "h w 3"]:
    """A noise-free rendering of the scene at one simulated step."""
    scene, states = stand_in.scene, stand_in.states
    state, g = states[min(max(step, 0), len(states) - 1)], scene.gaussians
    parts = [g[g.object_id == 0]]
    for row, thing in enumerate(scene.objects):
        R = matrix(state.rotation[row])
        motion = Similarity(1.0, R, state.com[row] - R @ states[0].com[row])
        parts.append(transformed(g[g.object_id == thing.id], motion))
    cameras = scene.cameras
    width, height = cameras.sizes[camera].tolist()
    V, K = cameras.viewmats[[camera]], cameras.Ks[[camera]]
    image = rasterise(concatenate(parts), V, K, width, height, torch.tensor(scene.background)).rgb[0]
    if step // SUBSTEPS in stand_in.hidden:
        image = _covered(image, parts[1], V[0], K[0])
    return image


def _covered(image: Tensor, thing: Gaussians, V: Tensor, K: Tensor) -> Float[Tensor, "h w 3"]:
    """The image with a grey disc in front of the object."""
    xy = project(thing.means, V, K)
    centre = xy.mean(0)
    radius = (xy - centre).norm(dim=1).max() + 2
    y, x = torch.meshgrid(torch.arange(image.shape[0]) + 0.5, torch.arange(image.shape[1]) + 0.5, indexing="ij")
    inside = (torch.stack([x, y], -1) - centre).norm(dim=-1) < radius
    return torch.where(inside[..., None], torch.tensor([0.35, 0.37, 0.4]), image)


def write_films(stand_in: StandIn, folder: Path) -> None:
    """Write one video per camera."""
    folder.mkdir(parents=True, exist_ok=True)
    for camera, name in enumerate(stand_in.scene.cameras.names):
        with VideoWriter(folder / name, stand_in.options.fps) as video:
            for image in film(stand_in, camera):
                video.append(image)


def write_cameras(stand_in: StandIn, path: Path) -> None:
    """Write the true cameras as a nerfstudio transforms.json."""
    cameras, flip = stand_in.scene.cameras, torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    frames = [{"file_path": name, "transform_matrix": (torch.linalg.inv(V.double()) @ flip).tolist()}
              for V, name in zip(cameras.viewmats, cameras.names, strict=True)]  # fmt: skip
    K, (width, height) = cameras.Ks[0].tolist(), cameras.sizes[0].tolist()
    lens = {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2], "w": width, "h": height}
    path.write_text(json.dumps({**lens, "frames": frames}))
