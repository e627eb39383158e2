"""Generation of clutter scenes: photos, their cameras, and the true Gaussians with labels."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor
from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.cameras import intrinsics, look_at
from stages.core.geometry.rotations import matrix
from stages.core.raster.rasterise import rasterise
from stages.core.scene.cameras import Cameras
from stages.core.scene.files import make_folder, provenance
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.images import write_jpeg
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import write_scene
from stages.lab.assets.mesh_files import find_objects, object_name
from stages.lab.assets.objects import OBJECTS, make_object
from stages.lab.clutter.composites import make_composite
from stages.lab.clutter.drapes import random_drapes
from stages.lab.clutter.examples import Example, labelled, write_example
from stages.lab.clutter.noise_model import observed
from stages.lab.clutter.options import ClutterOptions
from stages.lab.clutter.props import Prop, make_prop, mesh_prop, placed, random_turn, recoloured
from stages.lab.clutter.reconstruction import reconstructed
from stages.lab.clutter.settle import hull_corners, settle
from stages.lab.clutter.supports import Furniture, painted, random_furniture

log = logging.getLogger(__name__)
Rng = np.random.Generator
PROPS = 160  # number of different procedural shapes, and of composites
TRUTH, PHOTOS, TRANSFORMS, OBSERVED = "truth.ply", "photos", "transforms.json", "observed_{}.safetensors"
RECONSTRUCTED, EXACT = "reconstruction", "exact"  # take the place of the number in OBSERVED
DATA_SET_POINTS = 15_000  # Gaussians kept of each of the data set's ten objects
SHADOW_CELL = 0.01  # cell size of the shadow map [camera distances]
COMPOSITE_SHARE = 0.45  # fraction of procedural objects that have several parts
ROW_SHARE = 0.35  # fraction of scenes with a row of books on edge
MESH_SHARE = 0.4  # fraction of the objects that are meshes, if there are any
CLOSE_SHARE = 0.15  # fraction of scenes that are close-ups of one to three objects
CLOSE_SIZES = 0.5, 1.2  # range of the longest side of objects in close-ups [camera distances]


class Shelf:
    """The supply of props for scenes; each prop is made when first needed."""

    def __init__(self, meshes: Sequence[Path], seed: int):
        self.meshes, self.seed = find_objects(meshes) if meshes else [], seed

    def pick(self, rng: Rng) -> Prop:
        """A random prop: a mesh, one of the data set's ten objects, or a procedural shape."""
        while self.meshes and rng.uniform() < MESH_SHARE:
            files = self.meshes[rng.integers(len(self.meshes))]
            try:
                return _mesh(files)
            except InputError as error:
                log.warning("%s", error)
                self.meshes.remove(files)
        if rng.uniform() < 0.12:
            return _data_set_object(str(rng.choice(list(OBJECTS))))
        if rng.uniform() < COMPOSITE_SHARE:
            return _composite(1000 * self.seed + int(rng.integers(PROPS)))
        return _shape(1000 * self.seed + int(rng.integers(PROPS)))


@cache
def _mesh(files: tuple[Path, ...]) -> Prop:
    return mesh_prop(files, object_name(files))


@cache
def _shape(seed: int) -> Prop:
    return make_prop(seed)


@cache
def _composite(seed: int) -> Prop:
    return make_composite(seed)


@cache
def _data_set_object(name: str) -> Prop:
    g = make_object(name)
    keep = torch.randperm(len(g), generator=torch.Generator().manual_seed(0))[:DATA_SET_POINTS]
    thinned = g[keep]
    return Prop(name, replace(thinned, scales=thinned.scales * (len(g) / len(keep)) ** 0.5), (0.1, 0.4))


def run(out: Path, options: ClutterOptions, meshes: Sequence[Path] = ()) -> Iterator[str]:
    """Write OUT/NNNN/ for each scene, skipping finished scenes. Yields a line per scene.

    Each folder has photos/, transforms.json and truth.ply, ready to be reconstructed. With `options.observations` it
    instead has that many files observed_K.safetensors from the noise model, with `options.reconstruct`
    observed_reconstruction.safetensors from a real reconstruction, and with `options.exact` observed_exact.safetensors
    from the true Gaussians.
    """
    make_folder(Path(out))
    shelf = Shelf(meshes, options.seed)
    inputs = [f for files in shelf.meshes for f in files]
    for index in tqdm(range(options.first, options.first + options.count), desc="scenes", unit="scene"):
        folder = Path(out) / f"{index:04d}"
        if all((folder / name).exists() for name in _outputs(options)):
            continue
        scene, things = make_scene(index, shelf, options)
        folder.mkdir(parents=True, exist_ok=True)
        rng = np.random.default_rng([options.seed, index, 2])
        for k in range(options.observations):
            write_example(folder / OBSERVED.format(k), Example(*observed(scene, rng)))
        if options.reconstruct:
            photos = [(255 * photo).round().byte() for photo in _photos(scene, rng)]
            made = reconstructed(scene, photos, rng, pick_device(options.device))
            write_example(folder / OBSERVED.format(RECONSTRUCTED), labelled(made, scene))
        if options.exact:
            write_example(folder / OBSERVED.format(EXACT), labelled(scene, scene))
        if TRUTH in _outputs(options):
            _write_photos(scene, folder, rng)
            facts = provenance("clutter", inputs, options)
            write_scene(folder / TRUTH, replace(scene, provenance=facts))  # written last: marks the scene as finished
        yield f"{folder}: {things} things, {len(scene.cameras)} photos"


def _outputs(options: ClutterOptions) -> list[str]:
    """Names of the files that a finished scene has."""
    names = [OBSERVED.format(k) for k in range(options.observations)]
    names += [OBSERVED.format(RECONSTRUCTED)] if options.reconstruct else []
    names += [OBSERVED.format(EXACT)] if options.exact else []
    return names or [TRUTH]


def make_scene(index: int, shelf: Shelf, options: ClutterOptions) -> tuple[Scene, int]:
    """A scene with true labels, and the number of its objects, including those labelled as background."""
    rng = np.random.default_rng([options.seed, index])
    furniture = random_furniture(rng)
    _, x1, _, y1, _ = furniture.areas[0]
    drapes = random_drapes((x1, y1), np.random.default_rng([options.seed, index, 4]))
    furniture = replace(furniture, drapes=tuple(drapes))
    wanted = int(round(math.exp(rng.uniform(math.log(2), math.log(40)))))
    props = [shelf.pick(rng) for _ in range(wanted)]
    size = [math.exp(rng.uniform(*np.log(prop.sizes))) for prop in props]
    if rng.uniform() < 0.3:  # larger objects
        size = [min(0.6, 1.6 * s) for s in size]
    row = _row_of_books(shelf, furniture, rng) if rng.uniform() < ROW_SHARE else []
    nearby = np.random.default_rng([options.seed, index, 5])
    if nearby.uniform() < CLOSE_SHARE:
        few = int(nearby.integers(1, 4))
        size = np.exp(nearby.uniform(*np.log(CLOSE_SIZES), min(few, wanted))).tolist()
        props, row = props[:few], []
    things = _arranged(furniture, props, size, row, rng)
    objects, parts = [], [painted(furniture, rng)]
    for prop, g in things:
        number = 0 if prop.clutter else len(objects) + 1
        if number:
            objects.append(SceneObject(number, prop.name))
        parts.append(replace(g, object_id=torch.full((len(g),), number)))
    parts[0] = _shaded(parts[0], parts[1:], rng)
    cameras = _cameras(furniture, concatenate(parts[1:]).means if things else torch.zeros(1, 3), rng, options)
    return Scene(concatenate(parts), tuple(objects), cameras, 0.0), len(things)


@dataclass(frozen=True)
class _Start:
    """An object before it falls: its Gaussians about its origin, and the position of the origin."""

    prop: Prop
    gaussians: Gaussians
    at: tuple[float, float, float]


def _row_of_books(shelf: Shelf, furniture: Furniture, rng: Rng) -> list[_Start]:
    """Up to seven flat objects on edge, side by side: some stay upright, others lean or fall over."""
    picked = [shelf.pick(rng) for _ in range(int(rng.integers(6, 30)))]
    books = [p for p in picked if p.flat and not p.clutter][:7]
    x0, x1, y0, y1, z = furniture.areas[rng.integers(len(furniture.areas))]
    yaw, size = rng.uniform(0, 2 * math.pi), math.exp(rng.uniform(math.log(0.1), math.log(0.3)))
    along, across = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
    at, out = np.array([rng.uniform(x0, x1), rng.uniform(y0, y1)]) * 0.7, []
    for prop in books:
        columns = [across, (0, 0), along] if rng.uniform() < 0.5 else [(0, 0), -across, along]  # which side points up
        R = np.array([[*c, 0] for c in columns]).T
        R[2] = [0, 1, 0] if columns[0] is across else [1, 0, 0]
        g = placed(recoloured(prop.gaussians, rng), size * rng.uniform(0.8, 1.1), torch.from_numpy(R).float(),
                   torch.zeros(3))  # fmt: skip
        reach = g.means[:, :2] @ torch.from_numpy(along).float()
        at = at - along * float(reach.min())
        low, high = g.means.amin(0), g.means.amax(0)
        rise = furniture.rise(*((at + end[:2].numpy()).tolist() for end in (low, high)))
        out.append(_Start(prop, g, (*at, z + rise + 0.004 - float(low[2]))))
        at = at + along * (float(reach.max()) + 0.015 * rng.uniform() ** 2 + 0.001)
    return out


def _arranged(
    furniture: Furniture, props: list[Prop], size: list[float], row: list[_Start], rng: Rng
) -> list[tuple[Prop, Gaussians]]:
    """The objects and `row` at rest on the furniture, without those that fell off."""
    order = sorted(range(len(props)), key=lambda i: (not props[i].flat, -size[i]))  # flat objects lie at the bottom
    centre = rng.uniform(-0.3, 0.3, 2)
    close = rng.uniform(0.3, 1.0)  # fraction of the area over which objects are spread
    falling, height = [*row], {}
    for i in order:
        area = furniture.areas[rng.integers(len(furniture.areas))] if rng.uniform() < 0.35 else furniture.areas[0]
        g = placed(recoloured(props[i].gaussians, rng), size[i], random_turn(rng, props[i].flat), torch.zeros(3))
        low, high = g.means.amin(0).numpy(), g.means.amax(0).numpy()
        x0, x1, y0, y1, z = area
        x, y = (
            rng.uniform(x0, x1) * close + centre[0] * (x1 - x0) / 2,
            rng.uniform(y0, y1) * close + centre[1] * (y1 - y0) / 2,
        )
        if area is not furniture.areas[0]:
            x, y = rng.uniform(x0, x1), rng.uniform(y0, y1)
            if high[2] - low[2] > 0.2 or len(furniture.areas) == 1:
                continue
        cell = (round(x / 0.2), round(y / 0.2), area is furniture.areas[0])
        around = [height.get((cell[0] + a, cell[1] + b, cell[2]), z) for a in (-1, 0, 1) for b in (-1, 0, 1)]
        base = max(around) if rng.uniform() < 0.75 or area is not furniture.areas[0] else z
        if area is furniture.areas[0]:
            base = max(base, z + furniture.rise((x + low[0], y + low[1]), (x + high[0], y + high[1])))
        height[cell] = base + high[2] - low[2]
        falling.append(_Start(props[i], g, (x, y, base + 0.012 - low[2])))
    if not falling:
        return []
    hulls = [_hulls(f.prop, f.gaussians) for f in falling]
    at, quats = settle(furniture, hulls, np.array([f.at for f in falling]))
    floor = min(area[4] for area in furniture.areas) - 0.03
    out = []
    for f, t, q in zip(falling, at, quats, strict=True):
        if np.isfinite(t).all() and t[2] > floor and np.abs(t[:2]).max() < 1.4:
            R = matrix(torch.from_numpy(q)[None].float())[0]
            out.append((f.prop, placed(f.gaussians, 1.0, R, torch.from_numpy(t).float())))
    return out


def _hulls(prop: Prop, g: Gaussians) -> list[np.ndarray]:
    """Hull vertices of the convex parts of a placed prop; parts with few Gaussians are left out."""
    if prop.parts is None:
        return [hull_corners(g.means, 0.002)]
    count = torch.bincount(prop.parts)
    return [hull_corners(g.means[prop.parts == k], 0.002) for k in torch.nonzero(count >= 20)[:, 0].tolist()]


def _shaded(furniture: Gaussians, things: list[Gaussians], rng: Rng) -> Gaussians:
    """The furniture, darkened where objects cast soft shadows or touch it."""
    if not things:
        return furniture
    points = concatenate(things).means
    toward = torch.tensor([rng.uniform(-0.8, 0.8), rng.uniform(-0.8, 0.8)]).float()
    level = furniture.means[:, 2].round(decimals=2)
    light = torch.ones(len(furniture))
    for z in (0.0,):
        on = (level - z).abs() < 0.02
        above = points[points[:, 2] > z - 0.01]
        fallen = above[:, :2] + toward * (above[:, 2:] - z)
        near = above[above[:, 2] < z + 0.05][:, :2]
        shade = 0.45 * rng.uniform() * _density(fallen, furniture.means[on, :2], rng.uniform(1, 4))
        shade = shade + 0.35 * rng.uniform() * _density(near, furniture.means[on, :2], 2.0)
        light[on] = 1 - shade.clamp(0, 0.8)
    sh = furniture.sh.clone()
    sh[:, 0] = (sh[:, 0] + 0.5 / 0.28209479) * light[:, None] - 0.5 / 0.28209479
    return replace(furniture, sh=sh)


def _density(points: Float[Tensor, "n 2"], at: Float[Tensor, "m 2"], blur: float) -> Float[Tensor, "m"]:
    """Fraction from 0 to 1 to which points cover each location, blurred by `blur` cells."""
    half = 150
    grid = np.zeros((2 * half, 2 * half))
    cell = (points / SHADOW_CELL + half).floor().long().clamp(0, 2 * half - 1).numpy()
    grid[cell[:, 0], cell[:, 1]] = 1
    soft = ndimage.gaussian_filter(grid, blur)
    place = (at / SHADOW_CELL + half).floor().long().clamp(0, 2 * half - 1).numpy()
    return torch.from_numpy(soft[place[:, 0], place[:, 1]]).float()


def _cameras(furniture: Furniture, points: Float[Tensor, "n 3"], rng: Rng, options: ClutterOptions) -> Cameras:
    """A full orbit, an arc of 60 to 140 degrees, or a hand-held path, looking at the objects from about distance 1."""
    start, stop = furniture.open_sides
    orbit = stop - start > 6 and rng.uniform() < 0.5
    if not orbit:
        sweep = min(math.radians(rng.uniform(60, 140)), stop - start)
        start = rng.uniform(start, stop - sweep)
        stop = start + sweep
    n = options.views
    t = np.linspace(0, 1, n, endpoint=not orbit)
    shake = rng.uniform(0.0, 0.12)
    azimuth = start + t * (stop - start) + shake * 0.3 * rng.normal(size=n)
    high = math.radians(rng.uniform(18, 50)) + math.radians(rng.uniform(0, 12)) * np.sin(
        2 * math.pi * t * rng.uniform(0.5, 2)
    )
    high = np.clip(high + shake * 0.4 * rng.normal(size=n), math.radians(8), math.radians(75))
    focus = points.median(0).values.numpy() * 0.7 + rng.normal(size=3) * [0.05, 0.05, 0.02]
    distance = rng.uniform(0.85, 1.3) * (1 + shake * rng.normal(size=n))
    eye = focus + distance[:, None] * np.stack(
        [np.cos(high) * np.cos(azimuth), np.cos(high) * np.sin(azimuth), np.sin(high)], 1
    )
    target = focus + 0.06 * rng.normal(size=(n, 3))
    viewmats = look_at(torch.from_numpy(eye).float(), torch.from_numpy(target).float())
    wide, tall = options.size, int(options.size * 0.75)
    if rng.uniform() < 0.25:
        wide, tall = tall, wide
    K = intrinsics(wide, tall, options.size * rng.uniform(0.85, 1.3)).expand(n, 3, 3).clone()
    names = tuple(f"{i:03d}.jpg" for i in range(n))
    return Cameras(viewmats, K, torch.tensor([[wide, tall]] * n), names)


def _photos(scene: Scene, rng: Rng) -> Iterator[Float[Tensor, "h w 3"]]:
    """Photos with noise, blur and varying exposure."""
    cameras, sky = scene.cameras, torch.from_numpy(rng.uniform(0.2, 0.9, 3)).float()
    blur, grain, sway = rng.uniform(0, 0.7), rng.uniform(0.0, 0.015), rng.uniform(0, 0.06)
    for i in range(len(cameras)):
        width, height = cameras.sizes[i].tolist()
        drawn = rasterise(scene.gaussians, cameras.viewmats[[i]], cameras.Ks[[i]], width, height, sky).rgb[0].numpy()
        drawn = ndimage.gaussian_filter(drawn, (blur, blur, 0)) * (1 + sway * rng.normal())
        yield torch.from_numpy((drawn + grain * rng.normal(size=drawn.shape)).clip(0, 1)).float()


def _write_photos(scene: Scene, folder: Path, rng: Rng) -> None:
    """Write the photos, and their cameras as a transforms.json."""
    cameras, frames = scene.cameras, []
    (folder / PHOTOS).mkdir(exist_ok=True)
    for i, (name, photo) in enumerate(zip(cameras.names, _photos(scene, rng), strict=True)):
        write_jpeg(folder / PHOTOS / name, photo)
        pose = np.linalg.inv(cameras.viewmats[i].double().numpy()) @ np.diag([1.0, -1, -1, 1])  # y up, looking along -z
        frames.append({"file_path": f"{PHOTOS}/{name}", "transform_matrix": pose.tolist()})
    K = cameras.Ks[0]
    width, height = cameras.sizes[0].tolist()
    lens = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    table = {**lens, "w": width, "h": height, "frames": frames}
    (folder / TRANSFORMS).write_text(json.dumps(table))
