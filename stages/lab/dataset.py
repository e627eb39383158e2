"""GSCollision again: scenes of falling objects, simulated in batches.

    OUT/scene_configs/<group>.json     where every object starts
    OUT/motions/<group>.h5             keypoints in every frame (see motions.py)
    OUT/particles.npz                  the objects as particles, kept for the next run

Physics as published: fixed corotated bodies, transfer damping 0.9, walls that keep 0.9 of the tangential speed every
substep of 1e-4 s, gravity 5 m/s^2, frames of 0.02 s; Gaussians of the surface are the particles, and bodies are
hollow. The grid may be coarser than the published one, and then fewer Gaussians are particles: see
stages/lab/results/dataset.md.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from tqdm import tqdm

from stages.backends import pick_device
from stages.errors import InputError
from stages.geometry.neighbours import knn
from stages.lab.motions import Motions, joined, write_motions
from stages.lab.objects import OBJECTS, ObjectKind, make_object
from stages.lab.scenes import Config, Extent, configs_of, groups_of, read_configs, write_configs
from stages.physics import mpm
from stages.physics.keypoints import farthest_points
from stages.physics.mpm_batch import Batch
from stages.scene.files import provenance, replacing

log = logging.getLogger(__name__)
GRAVITY = (0.0, 0.0, -5.0)  # [m/s^2]
BOX = ((-1.94, -1.94, -0.94), (1.94, 1.94, 2.94))  # [m]
DAMPING, KEEP = 0.9, 0.9  # of the transfer; of the tangential speed at walls, every published substep
FRAME, SUBSTEP = 0.02, 1e-4  # [s]
NU, FRICTION = 0.3, 1.0  # walls that keep 0.9 a substep hold like a friction of 1 or more
LEAST_OPACITY = 0.02


@dataclass(frozen=True)
class Fineness:
    """How finely the world is cut."""

    dx: float = 0.02  # grid spacing [m]
    spacing: float = 0.009  # between particles on a surface [m]
    substep: float = SUBSTEP  # [s]

    @property
    def substeps(self) -> int:
        return round(FRAME / self.substep)


@dataclass(frozen=True)
class DatasetOptions:
    """What decides the data."""

    groups: str = "3_0..3_9,4,6"
    frames: int = 100
    keypoints: int = 2048
    dx: float = 0.02
    spacing: float = 0.009
    substep: float = SUBSTEP
    shard: str = "1/1"
    limit: int = 0  # scenes of each group; 0: all
    device: str = "auto"

    @property
    def fineness(self) -> Fineness:
        return Fineness(self.dx, self.spacing, self.substep)


@dataclass(frozen=True)
class Asset:
    """An object as particles, at its scale prior, about the centre of its bounding box."""

    id: int
    scale: float
    points: Float[Tensor, "p 3"]  # [m], each the farthest from those before it
    volume: Float[Tensor, "p"]  # [m^3]
    E: float  # [Pa]
    density: float  # [kg/m^3]

    @cached_property
    def mass(self) -> float:
        return self.density * float(self.volume.sum())

    def particles(self, at: Float[Tensor, "3"]) -> mpm.Particles:
        """The object at rest somewhere."""
        n = torch.ones(len(self.points))
        return mpm.at_rest(self.points + at, self.volume, self.density * n, self.E * n, NU * n, 0 * n, FRICTION * n,
                           mpm.MODELS["corotated"])  # fmt: skip


def assets(fineness: Fineness, least: int, kept: Path | None = None) -> dict[int, Asset]:
    """All objects by id, each with `least` particles or as many as the spacing asks for (or all its Gaussians).

    Choosing them takes a minute or two; `kept` is a file (.npz) to read them from, or to write them to.
    """
    key = f"spacing {fineness.spacing} least {least}"
    points = _read_points(kept, key) if kept is not None and kept.exists() else None
    if points is None:
        bar = tqdm(OBJECTS.values(), desc="objects", unit="object")
        points = {kind.name: _particles(kind, fineness, least) for kind in bar}
        if kept is not None:
            with replacing(kept) as part:
                np.savez(part, key=key, **{name: p.numpy() for name, p in points.items()})
    return {
        kind.id: Asset(kind.id, kind.scale, points[kind.name], volumes(points[kind.name], fineness.dx), kind.E,
                       kind.density)
        for kind in OBJECTS.values()
    }  # fmt: skip


def _read_points(kept: Path, key: str) -> dict[str, Float[Tensor, "p 3"]] | None:
    """What was kept, if it was chosen in the same way."""
    try:
        with np.load(kept) as file:
            same = str(file["key"]) == key
            return {name: torch.from_numpy(file[name]) for name in OBJECTS} if same else None
    except (KeyError, OSError, ValueError) as error:
        raise InputError(f"{kept}: cannot be read ({error}); remove it and it is made again") from error


def _particles(kind: ObjectKind, fineness: Fineness, least: int) -> Float[Tensor, "p 3"]:
    """Some of its Gaussians at its scale prior [m], each the farthest from those before it."""
    g = make_object(kind.name)
    means = g.means[g.opacities > LEAST_OPACITY] * kind.scale
    means = means - (means.amax(0) + means.amin(0)) / 2
    if len(means) < least:
        raise InputError(f"--keypoints {least}: {kind.name} has only {len(means)} Gaussians")
    return means[farthest_points(means, max(least, count_at(means, fineness.spacing)))]


def count_at(means: Float[Tensor, "n 3"], spacing: float) -> int:
    """How many points of such a spacing cover the surface: from the spacing that all of them have."""
    sample = means[:: max(1, len(means) // 4000)]
    own = float(knn(means, sample, 5)[0][:, 1:].mean())
    return int(len(means) * (own / spacing) ** 2)


def volumes(means: Float[Tensor, "n 3"], dx: float) -> Float[Tensor, "n"]:
    """The volume of a cell, shared by the particles in it (as published)."""
    cell = (means / dx).floor().long()
    _, owner, count = cell.unique(dim=0, return_inverse=True, return_counts=True)
    return dx**3 / count[owner].float()


def extents(things: Mapping[int, Asset]) -> dict[int, Extent]:
    """What placing them needs."""
    return {i: Extent(a.points[:2048].numpy().astype(float), a.scale) for i, a in things.items()}


def simulate(
    configs: Mapping[str, Config], things: Mapping[int, Asset], fineness: Fineness, frames: int, keypoints: int,
    device: str,
) -> Iterator[Motions]:  # fmt: skip
    """The motion of all scenes, as many at a time as fit; scenes that went wrong are told of and left out."""
    low, high = BOX
    box = mpm.Box(low, high, keep=KEEP ** (fineness.substep / SUBSTEP))
    largest = max(sum(len(things[i].points) for i in c.ids) for c in configs.values())
    size = Batch.fits(box, fineness.dx, largest, device) if device != "cpu" else 4
    todo = list(configs.values())
    for start in range(0, len(todo), size):
        yield _run(todo[start : start + size], things, box, fineness, frames, keypoints, device)


def _run(
    scenes: list[Config], things: Mapping[int, Asset], box: mpm.Box, fineness: Fineness, frames: int, keypoints: int,
    device: str,
) -> Motions:  # fmt: skip
    bodies = {
        c.name: mpm.together([things[i].particles(torch.tensor(p)) for i, p in zip(c.ids, c.translation, strict=True)])
        for c in scenes
    }
    batch = Batch(bodies, box, fineness.dx, device, damping=DAMPING)
    rows = _rows(scenes, things, keypoints).to(device)
    points = torch.empty(len(scenes), frames, *rows.shape[1:], 3, device=device)
    steps = batch.frames(frames, FRAME, fineness.substeps, GRAVITY)
    for t, frame in enumerate(tqdm(steps, total=frames, desc=f"{len(scenes)} scenes", unit="frame", leave=False)):
        points[:, t] = frame.x[rows]
    bad = batch.failures()
    for name, problem in bad.items():
        log.warning("%s: %s; left out", name, problem)
    good = [k for k, c in enumerate(scenes) if c.name not in bad]
    return _motions([scenes[k] for k in good], things, points[torch.tensor(good, device=device)].cpu(), box)


def _rows(scenes: list[Config], things: Mapping[int, Asset], keypoints: int) -> Int[Tensor, "s o n"]:
    """The row of every keypoint among the particles of the batch; objects that are not there repeat the first."""
    most, start, out = max(len(c.ids) for c in scenes), 0, []
    for c in scenes:
        rows = []
        for i in c.ids:
            rows.append(torch.arange(start, start + keypoints))
            start += len(things[i].points)
        out.append(torch.stack(rows + [rows[0]] * (most - len(rows))))
    return torch.stack(out)


def _motions(
    scenes: list[Config], things: Mapping[int, Asset], points: Float[Tensor, "s t o n 3"], box: mpm.Box
) -> Motions:
    most = points.shape[2]
    ids = torch.tensor([[*c.ids, *[-1] * (most - len(c.ids))] for c in scenes])
    told = {i: torch.tensor([a.mass, a.E]) for i, a in things.items()}
    table = torch.stack([torch.stack([told.get(i, torch.ones(2)) for i in row]) for row in ids.tolist()])
    same = torch.ones(ids.shape)
    points = torch.where((ids >= 0)[:, None, :, None, None], points, 0.0)
    return Motions(tuple(c.name for c in scenes), ids, points, table[..., 0], table[..., 1], NU * same, FRICTION * same,
                   FRAME, GRAVITY, (box.low, box.high))  # fmt: skip


def run(out: Path, options: DatasetOptions) -> None:
    """Write what is missing of the data set; what is there is left as it is."""
    device, groups = pick_device(options.device), groups_of(options.groups)
    part, parts = _shard(options.shard)
    todo = [g for n, g in enumerate(groups) if n % parts == part]
    for folder in ("scene_configs", "motions"):
        (out / folder).mkdir(parents=True, exist_ok=True)
    todo = [g for g in todo if not (out / "motions" / f"{g}.h5").exists()]
    if not todo:
        print(f"{out}: complete")
        return
    things = assets(options.fineness, options.keypoints, out / "particles.npz")
    for group in todo:
        file = out / "scene_configs" / f"{group}.json"
        if not file.exists():
            write_configs(file, configs_of(group, extents(things)))
        configs = read_configs(file)
        if options.limit:
            configs = dict(list(configs.items())[: options.limit])
        start = time.perf_counter()
        made = joined(list(simulate(configs, things, options.fineness, options.frames, options.keypoints, device)))
        took = time.perf_counter() - start
        write_motions(out / "motions" / f"{group}.h5", made, provenance("dataset", [file], options))
        print(f"{group}: {len(made)} scenes in {took:.1f} s, {60 * len(made) / took:.0f} a minute")


def _shard(text: str) -> tuple[int, int]:
    """ "2/5" -> (1, 5)."""
    part, slash, parts = text.partition("/")
    if not (slash and part.isdigit() and parts.isdigit() and 1 <= int(part) <= int(parts)):
        raise InputError(f"--shard {text}: write i/n with i from 1 to n, such as 2/5")
    return int(part) - 1, int(parts)
