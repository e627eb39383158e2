"""Training scenes of the segmentation network: reconstructed clutter, labelled from the true scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.neighbours import knn
from stages.core.models.segmenter.segment import MAX_SIZE, REDUCTIONS
from stages.core.models.segmenter.voxels import VOXEL, ScenePoints, VoxelGrid, neighbour_table, voxelise
from stages.core.scene.scene_ply import read_scene
from stages.lab.clutter.examples import Example, labelled, write_example
from stages.lab.clutter.reconstruction import FLOATER
from stages.lab.clutter.scenes import OBSERVED, RECONSTRUCTED, TRUTH

RECONSTRUCTION = "scene.ply"  # file name of a reconstruction in a scene folder
MIN_OBJECT = 8  # smallest number of voxels of an object
MAX_PAIRS = 60_000  # largest number of voxel pairs per scene
MAX_FLOATERS = 25  # largest number of clouds of floaters
APART = 2048  # distance between the scenes of a batch [voxels], a multiple of the coarsest voxel
SCALE_RANGE = 0.8, 2.4  # scales of augmented examples; includes voxels.SCALES
MAX_RELIEF = 0.012  # largest height of waves added to surfaces [camera distances]
LONG_REACH = 0.12  # length scale of distant pairs of voxels [camera distances]


def find_examples(folders: Sequence[Path]) -> list[Path]:
    """Files of labelled observations in scene folders; reconstructions without labels are labelled first.

    Raises InputError if there are none.
    """
    scenes = [p for folder in folders for p in sorted(Path(folder).glob("*")) if p.is_dir()]
    for scene in scenes:
        done = scene / OBSERVED.format(RECONSTRUCTED)
        if (scene / RECONSTRUCTION).is_file() and (scene / TRUTH).is_file() and not done.exists():
            write_example(done, labelled(read_scene(scene / RECONSTRUCTION), read_scene(scene / TRUTH)))
    found = [p for scene in scenes for p in sorted(scene.glob(OBSERVED.format("*")))]
    if not found:
        raise InputError(f"{folders[0]}: no scene in it has observations, or {RECONSTRUCTION} and {TRUTH}; make them "
                         "with `ngff-lab clutter`")  # fmt: skip
    return found


@dataclass(frozen=True)
class Targets:
    """Training targets for the voxels of an example."""

    grid: VoxelGrid
    labels: Int[Tensor, "v"]  # majority label of the surfels: -1 floater or clutter, 0 surface, 1... objects
    classes: Int[Tensor, "v"]  # index in CLASSES
    offsets: Float[Tensor, "v 3"]  # vectors to the centre of the object; 0 elsewhere
    pairs: Int[Tensor, "e 2"]  # pairs of voxels, none of them surface and at least one of an object


def augmented(example: Example, rng: np.random.Generator) -> tuple[ScenePoints, Int[Tensor, "n"]]:
    """The example rotated, mirrored, scaled, tilted, thinned, with noise and in other colours."""
    s, labels = _repainted(example.surfels, example.labels, rng), example.labels
    keep = _with_holes(s, rng)
    s, labels = _with_floaters(s[keep], labels[keep], rng)
    angle, tilt = rng.uniform(0, 2 * np.pi), rng.normal(0, 0.015, 2)
    c, sn = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -sn, 0], [sn, c, 0], [0, 0, 1]]) @ np.diag([rng.choice([-1, 1]), 1, 1])
    lean = np.array([[1, 0, tilt[0]], [0, 1, tilt[1]], [-tilt[0], -tilt[1], 1]])
    R = torch.from_numpy(lean @ turn).float()
    scale = float(np.exp(rng.uniform(*np.log(SCALE_RANGE))))
    if _longest(s.points, labels) > MAX_SIZE:  # such scenes are also segmented at a reduced size
        scale *= float(rng.choice(REDUCTIONS))
    points = scale * s.points @ R.mT + torch.tensor([0, 0, float(rng.normal(0, 0.004))])
    points = points + 0.004 * float(rng.uniform()) ** 2 * torch.from_numpy(rng.normal(size=points.shape)).float()
    points = torch.cat([points[:, :2], points[:, 2:] + _relief(points[:, :2], rng)], 1)
    lab = s.lab * torch.tensor([float(rng.uniform(0.7, 1.2)), 1, 1]) + torch.tensor([float(rng.normal(0, 8)), 0, 0])
    hue, chroma = rng.uniform(0, 2 * np.pi), float(rng.choice([0.0, 0.5, 1.0, 1.0, 1.3]))
    spin = torch.tensor([[np.cos(hue), -np.sin(hue)], [np.sin(hue), np.cos(hue)]]).float()
    lab = torch.cat([lab[:, :1], chroma * lab[:, 1:] @ spin.mT + torch.from_numpy(rng.normal(0, 4, 2)).float()], 1)
    lab = lab + 8 * float(rng.uniform()) ** 2 * torch.from_numpy(rng.normal(size=lab.shape)).float()
    normals = s.normals @ R.mT + 0.5 * float(rng.uniform()) ** 2 * torch.from_numpy(rng.normal(size=lab.shape)).float()
    normals = torch.nn.functional.normalize(normals, dim=1)
    moved = replace(s, points=points, lab=lab, normals=normals, toward=s.toward @ R.mT)
    return moved, labels


def _longest(points: Float[Tensor, "n 3"], labels: Int[Tensor, "n"]) -> float:
    """Longest axis-aligned side of the largest object [camera distances], without the outermost 2 % of its points."""
    count = torch.bincount(labels.clamp_min(0))
    parts = [points[labels == k] for k in torch.nonzero(count >= 20)[:, 0].tolist() if k]
    return max((float((p.quantile(0.99, 0) - p.quantile(0.01, 0)).max()) for p in parts), default=0.0)


def _repainted(s: ScenePoints, labels: Int[Tensor, "n"], rng: np.random.Generator) -> ScenePoints:
    """Recolour parts of some objects, divided by planes, since a colour edge need not separate two objects."""
    if rng.uniform() < 0.4:
        return s
    lab, share = s.lab.clone(), rng.uniform(0, 0.8)
    for k in range(1, int(labels.max()) + 1 if len(labels) else 1):
        own = torch.nonzero(labels == k)[:, 0]
        if len(own) and rng.uniform() < share:
            part = torch.zeros(len(own), dtype=torch.int64)
            for _ in range(int(rng.integers(1, 4))):
                along = s.points[own] @ torch.from_numpy(rng.normal(size=3)).float()
                part = 2 * part + (along > along.quantile(float(rng.uniform(0.1, 0.9))))
            lab[own] += torch.from_numpy(rng.normal(0, [25, 20, 20], (8, 3))).float()[part]
    lab[:, 0].clamp_(2, 98)
    return replace(s, lab=lab)


def _with_holes(s: ScenePoints, rng: np.random.Generator) -> Bool[Tensor, "n"]:
    """Mask of the surfels that remain after removing round patches and a random fraction of the rest."""
    keep = torch.from_numpy(rng.uniform(size=len(s)) < rng.choice([1.0, 1.0, 0.8, 0.5]))
    for middle in s.points[torch.from_numpy(rng.integers(0, len(s), rng.integers(0, 12)))]:
        keep &= (s.points - middle).norm(dim=1) > float(rng.uniform(0.01, 0.12))
    return keep


def _with_floaters(
    s: ScenePoints, labels: Int[Tensor, "n"], rng: np.random.Generator
) -> tuple[ScenePoints, Int[Tensor, "n"]]:
    """The surfels with up to MAX_FLOATERS clouds of floaters of random colour."""
    clouds, parts = int(rng.integers(0, MAX_FLOATERS + 1)), []
    for _ in range(clouds):
        n = int(np.exp(rng.uniform(3, 6.5)))
        middle = rng.uniform(-1.2, 1.2, 3) * [1, 1, 0.5] + [0, 0, 0.2]
        spread = np.exp(rng.uniform(-4.2, -1.8, 3))
        points = torch.from_numpy(middle + spread * rng.normal(size=(n, 3))).float()
        colour = torch.from_numpy(rng.uniform([10, -40, -40], [95, 40, 40]) + rng.normal(0, 8, (n, 3))).float()
        normals = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(n, 3))).float(), dim=1)
        flatness = torch.from_numpy(rng.uniform(0.1, 0.8, n)).float()
        parts.append(ScenePoints(points, colour, normals, flatness, normals))
    joined = [torch.cat([getattr(p, name) for p in (s, *parts)]) for name in ScenePoints.__dataclass_fields__]
    extra = sum(len(p) for p in parts)
    return ScenePoints(*joined), torch.cat([labels, torch.full((extra,), FLOATER)])


def _relief(xy: Float[Tensor, "n 2"], rng: np.random.Generator) -> Float[Tensor, "n 1"]:
    """Height of waves as reconstructions add to surfaces, up to MAX_RELIEF."""
    waves = torch.from_numpy(rng.normal(size=(2, 4)) * rng.uniform(4, 40, 4)).float()
    phase = torch.from_numpy(rng.uniform(0, 6.3, 4)).float()
    return MAX_RELIEF * float(rng.uniform()) ** 2 * torch.sin(xy @ waves + phase).mean(1, keepdim=True)


def targets(surfels: ScenePoints, labels: Int[Tensor, "n"], shift: Float[Tensor, "3"] | None = None) -> Targets:
    """The voxels and their targets; tiny objects count as clutter."""
    grid = voxelise(surfels, shift)
    numbers = labels + 1
    count = torch.zeros(len(grid), int(numbers.max()) + 1 if len(numbers) else 1)
    count.view(-1).index_add_(0, grid.owner * count.shape[1] + numbers, torch.ones(len(numbers)))
    own = count.argmax(1) - 1
    size = torch.bincount(own.clamp_min(0), minlength=count.shape[1])
    own = torch.where((own > 0) & (size[own.clamp_min(0)] < MIN_OBJECT), FLOATER, own)
    classes = torch.where(own > 0, 1, torch.where(own == 0, 0, 2))
    middle = torch.zeros(count.shape[1], 3).index_add_(0, own.clamp_min(0), grid.points)
    middle = middle / size[: len(middle), None].clamp_min(1)
    offsets = torch.where((own > 0)[:, None], middle[own.clamp_min(0)] - grid.points, torch.zeros(3))
    return Targets(grid, own, classes, offsets, torch.zeros(0, 2, dtype=torch.int64))


def joined(parts: Sequence[Targets]) -> Targets:
    """Several scenes as one, placed far apart, with distinct object numbers."""
    if len(parts) == 1:
        return parts[0]
    shifts = [torch.tensor([APART * k, 0, 0]) for k in range(len(parts))]
    highest = max(int(p.labels.max()) for p in parts) + 1
    grid = VoxelGrid(
        torch.cat([p.grid.cells + shift for p, shift in zip(parts, shifts, strict=True)]),
        torch.cat([p.grid.points + VOXEL * shift for p, shift in zip(parts, shifts, strict=True)]),
        torch.cat([p.grid.features for p in parts]),
        torch.zeros(0, dtype=torch.int64),
    )
    labels = [torch.where(p.labels > 0, p.labels + k * highest, p.labels) for k, p in enumerate(parts)]
    first = np.cumsum([0, *(len(p.grid) for p in parts)])
    pairs = [p.pairs + int(n) for p, n in zip(parts, first, strict=False)]
    classes, offsets = (torch.cat([getattr(p, name) for p in parts]) for name in ("classes", "offsets"))
    return Targets(grid, torch.cat(labels), classes, offsets, torch.cat(pairs))


def with_pairs(t: Targets, rng: np.random.Generator) -> Targets:
    """The targets with at most MAX_PAIRS random pairs of voxels for the affinity loss."""
    kept = t.classes != 0
    pairs = voxel_pairs(neighbour_table(t.grid.cells), t.grid.points, rng, 1)
    pairs = pairs[kept[pairs[:, 0]] & kept[pairs[:, 1]]]
    pairs = pairs[(t.labels[pairs[:, 0]] > 0) | (t.labels[pairs[:, 1]] > 0)]
    return replace(t, pairs=pairs[torch.from_numpy(rng.permutation(len(pairs))[:MAX_PAIRS])])


def voxel_pairs(
    neighbours: Int[Tensor, "v 27"], points: Float[Tensor, "v 3"], rng: np.random.Generator, distant: int
) -> Int[Tensor, "e 2"]:
    """All pairs of adjacent voxels, and about `distant` random pairs per voxel up to twice LONG_REACH apart."""
    i, k = torch.nonzero(neighbours[:, :13] < len(points), as_tuple=True)
    near = torch.stack([i, neighbours[i, k]], 1)
    if not distant or len(points) < 2:
        return near
    order = torch.from_numpy(rng.integers(0, len(points), distant * len(points)))
    step = torch.from_numpy(rng.normal(0, LONG_REACH / 2, (len(order), 3))).float()
    _, other = knn(points, points[order] + step, 1)
    far = torch.stack([order, other[:, 0]], 1)
    apart = (points[far[:, 0]] - points[far[:, 1]]).norm(dim=1)
    return torch.cat([near, far[(apart > 1.5 * VOXEL) & (apart < 2 * LONG_REACH)]])
