"""Scenes of other objects than the ten: eight that no model learns from, any meshes, or more to learn from.

    OUT/scene_configs/heldout.json     where every object starts, sampled as for the data set
    OUT/motions/heldout.h5             keypoints in every frame, as `ngff-lab dataset` writes
    OUT/particles_heldout.npz          the objects as particles, kept for the next run

To learn from are the groups `varied`, hollow shapes at random as the ten are hollow; `solid`, such shapes filled, as
what is simulated of photos is; and `turned`, the ten each turned at random, which they never are in the data set.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.geometry.rotations import matrix
from stages.core.models.field.solidity import solidity
from stages.core.physics.keypoints import farthest_points
from stages.core.physics.materials import choose_materials
from stages.core.scene.files import provenance, replacing
from stages.core.scene.scene import SceneObject
from stages.lab.assets.heldout_shapes import HELDOUT_SHAPES, ShapeKind, surface_and_interior_points, surface_points
from stages.lab.assets.random_shapes import random_shapes
from stages.lab.assets.shapes import single_threaded
from stages.lab.dataset import object_particles
from stages.lab.dataset.keypoint_motions import KeypointMotionsWriter
from stages.lab.dataset.object_particles import (
    SUBSTEP,
    Asset,
    Discretisation,
    count_for_spacing,
    particle_volumes,
    placement_extents,
)
from stages.lab.dataset.scene_configs import (
    HELDOUT,
    ROTATED,
    SOLID,
    VARIED,
    SceneConfig,
    sample_scene,
    write_scene_configs,
)
from stages.lab.dataset.simulation import simulate

log = logging.getLogger(__name__)
FIRST_SCENE = {
    HELDOUT: 10_000,
    VARIED: 20_000,
    SOLID: 30_000,
    ROTATED: 40_000,
}  # index of the first scene, and its seed
SHAPE_SEEDS = {VARIED: 0, SOLID: 1}  # of shapes at random
FIRST_MESH_ID, FIRST_ROTATED_ID = 100, 2000  # id of the first mesh, and of the first turned object
PARTICLES_PER_CELL_AXIS = 1.5  # particles of solid bodies in a cell, along each axis
SURFACE_POINTS = 30_000  # points of a shape that particles are chosen among
MAX_YOUNG = 2e7  # that the published substep bears, as of the phone [Pa]


@dataclass(frozen=True)
class HeldoutOptions:
    """What decides the data."""

    scenes: int = 100
    objects: int = 3  # in each scene
    frames: int = 100
    keypoints: int = 2048
    dx: float = 0.02
    spacing: float = 0.009
    substep: float = SUBSTEP
    size: float = 0.5  # longest side of a mesh [m]
    shapes: int = 0  # drawn at random, with their materials, instead of the eight
    solid: bool = False  # the shapes are filled
    turned: int = 0  # ways in which the ten objects are turned, instead of the eight
    device: str = "auto"

    def __post_init__(self):
        if self.scenes < 1 or not 1 <= self.objects <= 6:
            raise InputError(f"--scenes {self.scenes} --objects {self.objects}: at least one scene, of 1 to 6 objects")
        if not 0 <= self.shapes <= 1000:
            raise InputError(f"--shapes {self.shapes}: 0 for the eight, or up to 1000 at random")
        if not 0 <= self.turned <= 1000:
            raise InputError(f"--turned {self.turned}: 0 for the eight, or the ten objects turned in up to 1000 ways")
        if self.solid and not self.shapes or self.shapes and self.turned:
            raise InputError("--solid needs --shapes, and --turned goes without")
        if not 0.1 <= self.size <= 1.0:
            raise InputError(f"--size {self.size}: meshes are put into a room of 2 m; give 0.1 to 1 m")

    @property
    def group(self) -> str:
        return SOLID if self.solid else VARIED if self.shapes else ROTATED if self.turned else HELDOUT

    @property
    def fineness(self) -> Discretisation:
        return Discretisation(self.dx, self.spacing, self.substep)


def run(out: Path, options: HeldoutOptions = HeldoutOptions(), meshes: list[Path] | None = None) -> str:
    """Write the group; what is there is left as it is. A line about it."""
    group = options.group
    file, motions = Path(out) / "scene_configs" / f"{group}.json", Path(out) / "motions" / f"{group}.h5"
    if meshes and (options.shapes or options.turned):
        raise InputError("--from and --shapes or --turned: choose one; meshes take the place of other objects")
    if motions.exists():
        return f"{motions}: is there"
    for folder in (file.parent, motions.parent):
        folder.mkdir(parents=True, exist_ok=True)
    device, start = pick_device(options.device), time.perf_counter()
    kept = Path(out) / f"particles_{group}.npz"
    if meshes:
        things = mesh_assets(meshes, options)
    elif options.turned:
        ten = object_particles.load_assets(options.fineness, options.keypoints, kept)
        things = rotated_assets(ten, options.turned, options.fineness)
    else:
        table = random_shapes(options.shapes, SHAPE_SEEDS[group]) if options.shapes else HELDOUT_SHAPES
        things = load_shape_assets(table, options.fineness, options.keypoints, kept, options.solid)
    configs = sample_configs(things, options.scenes, options.objects, FIRST_SCENE[group])
    write_scene_configs(file, configs)
    made, count = provenance("heldout", [file, *(meshes or [])], options), 0
    bar = tqdm(total=len(configs), desc=group, unit="scene")
    with bar, KeypointMotionsWriter(motions, made) as writer:
        for part in simulate(configs, things, options.fineness, options.frames, options.keypoints, device):
            writer.append(part)
            count += len(part)
            bar.update(len(part))
    return f"{motions}: {count} scenes of {len(things)} objects in {time.perf_counter() - start:.0f} s"


def sample_configs(
    things: Mapping[int, Asset], scenes: int, objects: int, first: int = FIRST_SCENE[HELDOUT]
) -> dict[str, SceneConfig]:
    """Scenes by the sampling of the data set, with seeds of their own."""
    room = placement_extents(things)
    made = (sample_scene(first + i, objects, room) for i in tqdm(range(scenes), desc="placing", unit="scene"))
    return {c.name: c for c in made}


def rotated_assets(things: Mapping[int, Asset], count: int, fineness: Discretisation) -> dict[int, Asset]:
    """Objects in turn, each turned at random, by new ids."""
    made = {}
    for i in range(count):
        thing = list(things.values())[i % len(things)]
        turn = matrix(torch.from_numpy(np.random.default_rng([FIRST_ROTATED_ID, i]).normal(size=4)).float())
        points = thing.points @ turn.T
        points = points - (points.amin(0) + points.amax(0)) / 2
        made[FIRST_ROTATED_ID + i] = replace(
            thing, id=FIRST_ROTATED_ID + i, points=points, volume=particle_volumes(points, fineness.dx)
        )
    return made


def load_shape_assets(
    table: Mapping[str, ShapeKind], fineness: Discretisation, least: int, kept: Path | None = None, solid: bool = False
) -> dict[int, Asset]:
    """Objects by id; `kept` is a file (.npz) to read their particles from, or to write them to."""
    key = f"spacing {fineness.spacing} least {least}" + f" dx {fineness.dx}" * solid
    points = _read(kept, key, table) if kept is not None and kept.exists() else None
    if points is None:
        bar = tqdm(table.items(), desc="objects", unit="object")
        points = {name: _particles(kind, fineness, least, solid) for name, kind in bar}
        if kept is not None:
            with replacing(kept) as part:
                np.savez(part, key=key, **{name: p.numpy() for name, p in points.items()})
    made = {kind.id: _asset(kind.id, kind.scale, points[name], kind.E, kind.density, fineness)
            for name, kind in table.items()}  # fmt: skip
    if not solid:
        return made
    return {i: replace(a, solidity=solidity(a.points[:least], float(a.volume.sum()))) for i, a in made.items()}


def _read(kept: Path, key: str, table: Mapping[str, ShapeKind]) -> dict[str, Tensor] | None:
    """What was kept, if it was chosen in the same way."""
    try:
        with np.load(kept) as file:
            there = str(file["key"]) == key and table.keys() <= set(file.files)
            return {name: torch.from_numpy(file[name]) for name in table} if there else None
    except (KeyError, OSError, ValueError) as error:
        raise InputError(f"{kept}: cannot be read ({error}); remove it and it is made again") from error


def mesh_assets(meshes: list[Path], options: HeldoutOptions) -> dict[int, Asset]:
    """Meshes as objects 100, 101, ...; the names of file and folder tell what each is made of."""
    from stages.lab.assets.meshes import read_mesh  # noqa: PLC0415 -- needs an optional extra

    things = {}
    for id, path in enumerate(tqdm(meshes, desc="meshes", unit="mesh"), start=FIRST_MESH_ID):
        name = f"{Path(path).resolve().parent.name} {Path(path).stem}"
        choice = choose_materials([SceneObject(id, name)])[id]
        E = min(choice.material.E, MAX_YOUNG)
        log.info("%s: %s%s, E %.3g Pa", name, choice.name, " (a guess)" * choice.guessed, E)
        points = options.size * read_mesh(path, SURFACE_POINTS).means
        points = _chosen(points, options.fineness, options.keypoints)
        things[id] = _asset(id, options.size, points, E, choice.material.density, options.fineness)
    return things


def _particles(kind: ShapeKind, fineness: Discretisation, least: int, solid: bool) -> Float[Tensor, "p 3"]:
    """Of the surface, and after those of the inside."""
    if not solid:
        return _chosen(kind.scale * surface_points(kind, SURFACE_POINTS), fineness, least)
    around, inside = surface_and_interior_points(
        kind, SURFACE_POINTS, fineness.dx / PARTICLES_PER_CELL_AXIS / kind.scale
    )
    return torch.cat([_chosen(kind.scale * around, fineness, least), kind.scale * inside])


def _chosen(points: Float[Tensor, "n 3"], fineness: Discretisation, least: int) -> Float[Tensor, "p 3"]:
    """Some of the points, each the farthest from those before it."""
    if len(points) < least:
        raise InputError(f"--keypoints {least}: there are only {len(points)} points of an object")
    count = min(len(points), max(least, count_for_spacing(points, fineness.spacing)))
    with single_threaded():
        return points[farthest_points(points, count)]


def _asset(id: int, scale: float, points: Tensor, E: float, density: float, fineness: Discretisation) -> Asset:
    return Asset(id, scale, points, particle_volumes(points, fineness.dx), E, density)
