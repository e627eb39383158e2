"""Objects of a scene by the trained network: voxels -> classes, offsets and affinities -> clusters -> Gaussians."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from safetensors.torch import load_file
from torch import Tensor

from stages.core.errors import InputError
from stages.core.models.segmenter.clustering import agglomerate
from stages.core.models.segmenter.network import Prediction, Segmenter, pyramid
from stages.core.models.segmenter.outlines import cut_outlines
from stages.core.models.segmenter.surfels import scene_surfels
from stages.core.models.segmenter.voxels import VOXEL, VoxelGrid, voxelise
from stages.core.perception.support import Support
from stages.core.scene.scene import Scene

WEIGHTS = Path(__file__).parent / "segmenter.safetensors"
MAX_VOXELS = 80_000  # nearest to the focus
MAX_BASE_HEIGHT = 0.4  # of an object's lowest points above the surface [camera distance]
MIN_VOXELS = 6  # of an object
MIN_GAUSSIANS = 30  # of an object


@dataclass(frozen=True)
class SegmenterOptions:
    """What counts as an object."""

    max_objects: int = 64
    min_size: float = 0.03  # along its longest side [camera distance]


def find(given: Path | None = None) -> Path:
    """The weights: `given`, else in $NGFF_WEIGHTS, else those in the package; InputError if there are none."""
    folder = os.environ.get("NGFF_WEIGHTS")
    places = [given] if given is not None else [*([Path(folder) / WEIGHTS.name] if folder else []), WEIGHTS]
    found = next((Path(p) for p in places if Path(p).is_file()), None)
    if found is None:
        raise InputError(f"{places[-1]}: no such weights of the segmentation network; train them with "
                         "`ngff-lab train-segmenter`")  # fmt: skip
    return found


def load_segmenter(path: Path) -> Segmenter:
    """The network with its trained weights, in single precision, on the CPU."""
    config = json.loads(path.with_suffix(".json").read_text())["config"]
    model = Segmenter(tuple(config["widths"]), config["blocks"])
    model.load_state_dict({k: v.float() for k, v in load_file(path).items()})
    return model.eval()


@torch.no_grad()
def object_ids(
    scene: Scene,
    model: Segmenter,
    support: Support | None,
    options: SegmenterOptions = SegmenterOptions(),  # noqa: B008
) -> Int[Tensor, "n"]:
    """Object number of each Gaussian; 0 for the rest.

    With a supporting surface, objects are those over it; they may stand on something that stands on it.
    """
    ids = torch.zeros(len(scene.gaussians), dtype=torch.int64)
    surfels, index, _ = scene_surfels(scene)
    if len(surfels) < 20:
        return ids
    grid = voxelise(surfels)
    if len(grid) > MAX_VOXELS:
        near = (grid.points.norm(dim=1) <= grid.points.norm(dim=1).kthvalue(MAX_VOXELS).values)[grid.owner]
        surfels, index = surfels[near], index[near]
        grid = voxelise(surfels)
    found, labels = cluster(grid, model, options)
    ids[index] = cut_outlines(surfels, grid, labels, found.logits.softmax(1))
    means = scene.gaussians.means
    for number in range(1, int(ids.max()) + 1):
        own = means[ids == number]
        if len(own) < MIN_GAUSSIANS or (support is not None and not _is_over(own, support)):
            ids[ids == number] = 0
    return ids


def _is_over(points: Float[Tensor, "m 3"], support: Support) -> bool:
    """Whether an object is mostly over the surface, and its lowest points are not far above it."""
    low = float(support.heights(points).quantile(0.05))
    return float(support.inside(points).float().mean()) > 0.5 and low < MAX_BASE_HEIGHT * support.view.radius


@torch.no_grad()
def cluster(grid: VoxelGrid, model: Segmenter, options: SegmenterOptions) -> tuple[Prediction, Int[Tensor, "v"]]:
    """The network's output, and the object of each voxel: 1 for the largest, 0 for none."""
    levels = pyramid(grid.cells, len(model.config["widths"]))
    found = model(grid.features, levels)
    chance = found.logits.softmax(1)
    loose = torch.nonzero(chance[:, 0] < 0.5)[:, 0]
    labels = torch.zeros(len(grid), dtype=torch.int64)
    if len(loose) < MIN_VOXELS:
        return found, labels
    pairs = adjacent_pairs(levels[0].neighbours, loose)
    if not len(pairs):
        return found, labels
    odds = model.affinity(found, grid.points, pairs)
    number = torch.full((len(grid),), -1)
    number[loose] = torch.arange(len(loose))
    clusters = torch.from_numpy(agglomerate(len(loose), number[pairs].numpy(), odds.double().numpy()))
    sizes = []
    for c in range(int(clusters.max()) + 1):
        own = loose[clusters == c]
        low, high = grid.points[own].amin(0), grid.points[own].amax(0)
        mean = chance[own].mean(0)
        if len(own) >= MIN_VOXELS and float((high - low).max()) + VOXEL >= options.min_size and int(mean.argmax()) == 1:
            sizes.append((len(own), c))
    for i, (_, c) in enumerate(sorted(sizes, reverse=True)[: options.max_objects], start=1):
        labels[loose[clusters == c]] = i
    return found, labels


def adjacent_pairs(neighbours: Int[Tensor, "v 27"], loose: Int[Tensor, "m"]) -> Int[Tensor, "e 2"]:
    """All pairs of adjacent voxels among `loose`, each once."""
    count = len(neighbours)
    inside = torch.zeros(count + 1, dtype=torch.bool)
    inside[loose] = True
    i, k = torch.nonzero(neighbours[:, :13] < count, as_tuple=True)
    pairs = torch.stack([i, neighbours[i, k]], 1)
    return pairs[inside[pairs].all(1)]
