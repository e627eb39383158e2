"""Segmentation of a scene by the trained network.

The network predicts classes, offsets and affinities of voxels at several scales; these give a merge tree of candidate
objects at each scale, from which the best disjoint ones are chosen and transferred to the Gaussians.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from stages.core.errors import InputError
from stages.core.kernels.threads import parallel_map
from stages.core.models.checkpoints import MAX_CONFIG, read_card, read_state, unfit
from stages.core.models.segmenter.candidates import MIN_VOXELS, Candidates, find_candidates
from stages.core.models.segmenter.network import SCORES, Level, Prediction, Segmenter, pyramid
from stages.core.models.segmenter.outlines import cut_outlines
from stages.core.models.segmenter.surfels import scene_surfels
from stages.core.models.segmenter.voxels import SCALES, VOXEL, ScenePoints, VoxelGrid, voxelise
from stages.core.perception.grouping import name_objects
from stages.core.perception.object_limits import ObjectLimits
from stages.core.perception.support import find_support, view_extent
from stages.core.perception.view_outlines import refine_outlines
from stages.core.scene.files import must_exist
from stages.core.scene.scene import Scene
from stages.core.scene.schema import whole

WEIGHTS = Path(__file__).parent / "segmenter.safetensors"
MAX_BLOCKS, MAX_LEVELS = 100, 12  # largest numbers of blocks and levels of a network
MAX_VOXELS = 80_000  # largest number of voxels; those nearest to the focus are kept
OBJECT_COST = 0.45  # smallest expected IoU of a candidate to be chosen; tuned on simulated scenes
REDUCTIONS = (0.667, 0.444)  # scale factors at which objects that fill the photos are as large as in training
# Smallest length [camera distance] and expected IoU of objects found in a reduced scene; the pile of `kermit` has .72.
LONG, MIN_LONG_IOU = 0.4, 0.8
MAX_SIZE = 0.6  # longest side of an object, that of the largest in training [camera distance]
MIN_GAUSSIANS = 30  # smallest number of Gaussians of an object
MAX_OVERLAP = 0.25  # largest overlap of two objects, as a fraction of the smaller one
TURNS = (((1, 0, 0), (0, 1, 0), (0, 0, 1)), ((0, 1, 0), (1, 0, 0), (0, 0, 1)),
         ((-1, 0, 0), (0, -1, 0), (0, 0, 1)), ((0, -1, 0), (-1, 0, 0), (0, 0, 1)))  # fmt: skip
COPIES = len(TURNS)  # copies of the scene whose predictions are averaged


def find(given: Path | None = None) -> Path:
    """Find the weights: `given`, else in $NGFF_WEIGHTS, else in the package; InputError if there are none."""
    folder = os.environ.get("NGFF_WEIGHTS")
    places = [given] if given is not None else [*([Path(folder) / WEIGHTS.name] if folder else []), WEIGHTS]
    found = next((Path(p) for p in places if Path(p).is_file()), None)
    if found is None:
        raise InputError(f"{places[-1]}: there are no such weights of the segmentation network; train them with "
                         "`ngff-lab train-segmenter`")  # fmt: skip
    return found


def load_segmenter(path: Path, device: torch.device | str = "cpu", new_scores: bool = False) -> Segmenter:
    """Load the network with its trained weights, in single precision.

    With `new_scores`, which is for training, the part that scores candidates is reinitialised if its weights are for
    other features than the current ones. Raises InputError for weights that are missing, damaged or do not fit their
    card.
    """
    must_exist(path, "weights (.safetensors) such as `ngff-lab train-segmenter` writes")
    card = read_card(path, ("segmenter",))
    state = read_state(path, card)
    try:
        blocks, widths = whole(card["config"]["blocks"], "blocks", 1, MAX_BLOCKS), card["config"]["widths"]
        widths = tuple(whole(width, "widths", 1, MAX_CONFIG) for width in widths[:MAX_LEVELS])
        if blocks * sum(w * w for w in widths) > sum(v.numel() for v in state.values()):  # before memory is allocated
            raise ValueError("the card is of a larger network")
        model = Segmenter(widths, blocks)
        own = {name: value for name, value in model.state_dict().items() if name.startswith(SCORES)}
        if new_scores and any(name not in state or state[name].shape != own[name].shape for name in own):
            state = {name: value for name, value in state.items() if not name.startswith(SCORES)} | own
        model.load_state_dict(state)
    except (KeyError, IndexError, TypeError, ValueError, RuntimeError) as error:
        raise unfit(path, "the segmentation network of its card", error) from error
    return model.to(device).eval()


def segment_by_network(
    scene: Scene,
    limits: ObjectLimits = ObjectLimits(),  # noqa: B008 -- frozen
    weights: Path | None = None,
    seed: int = 0,
    device: torch.device | str = "cpu",
) -> Scene:
    """Return the scene with an object_id for every Gaussian (0 for the background) and its objects, largest first.

    `seed` is for the search for the supporting surface; the network and the rendering of views run on `device`. Raises
    InputError if there are no weights at `weights`.
    """
    support = find_support(scene, view_extent(scene), seed)
    ids = object_ids(scene, load_segmenter(find(weights), device), limits)
    return name_objects(replace(scene, gaussians=replace(scene.gaussians, object_id=ids)), support)


@torch.no_grad()
def object_ids(
    scene: Scene,
    model: Segmenter,
    limits: ObjectLimits = ObjectLimits(),  # noqa: B008
) -> Int[Tensor, "n"]:
    """Return the object number of each Gaussian; 0 for Gaussians of no object."""
    ids = torch.zeros(len(scene.gaussians), dtype=torch.int64)
    surfels, index, _ = scene_surfels(scene)
    if len(surfels) < 20:
        return ids
    scored = [score_at(surfels, scale, model) for scale in (*SCALES, *REDUCTIONS)]
    found = [s.best(limits) for s in scored]
    labels = best_objects([f if s.scale >= 1 else confirmed(f, scored[0]) for s, f in zip(scored, found, strict=True)])
    labels = torch.where(labels <= limits.max_objects, labels, 0)
    ids[index] = outlined(surfels, labels, scored[: len(SCALES)])
    ids = refine_outlines(scene, ids, device=model.input_projection.weight.device)
    few = ids.bincount() < MIN_GAUSSIANS
    return torch.where(few[ids], 0, ids)


@dataclass(frozen=True)
class Segmentation:
    """The objects chosen at one scale."""

    labels: Int[Tensor, "n"]  # object (row of `gains`) of each surfel; -1 for none
    gains: Float[Tensor, "k"]  # (expected IoU - OBJECT_COST) x number of surfels
    sizes: Int[Tensor, "k"]  # number of surfels


@dataclass(frozen=True)
class ScoredCandidates:
    """Candidate objects at one scale, and the expected IoU of each with an object."""

    candidates: Candidates
    ious: Float[Tensor, "k"]  # expected IoU
    extents: Float[Tensor, "k"]  # longest side along the axes [camera distance]
    scale: float
    owner: Int[Tensor, "n"]  # voxel of each surfel; -1 beyond MAX_VOXELS
    chance: Float[Tensor, "n 3"]  # class probabilities of each surfel; NaN beyond MAX_VOXELS

    def usable(self, min_size: float) -> Bool[Tensor, "k"]:
        """Mask of candidates that are neither too small nor too large; in reduced scenes also MIN_LONG_IOU applies."""
        many = self.candidates.sizes > MIN_VOXELS - 0.5
        if self.scale >= 1:
            return many & (self.extents >= min_size) & (self.extents <= MAX_SIZE)
        long = (self.extents >= max(min_size, LONG)) & (self.extents <= MAX_SIZE / self.scale)
        return many & long & (self.ious >= MIN_LONG_IOU)

    def labels(self, nodes: np.ndarray) -> Int[Tensor, "n"]:
        """Return for each surfel the position in `nodes` (disjoint) of the node that contains it; -1 for none."""
        own = torch.full((int(self.owner.max()) + 2,), -1)  # the last entry is for surfels without a voxel
        own[self.candidates.voxels] = torch.from_numpy(self.candidates.tree.labels(nodes))[self.candidates.leaf]
        return own[self.owner]

    def expected_ious(self, objects: Segmentation) -> Float[Tensor, "k"]:
        """Return the expected IoU of given objects according to the candidates of this scale.

        It is the largest product, over all candidates, of the IoU with the candidate and the candidate's expected IoU.
        """
        count, inside = int(self.owner.max()) + 1, self.owner >= 0
        both = inside & (objects.labels >= 0)
        shared = torch.zeros(count, len(objects.gains)).double()
        shared.index_put_((self.owner[both], objects.labels[both]), torch.ones(()).double(), accumulate=True)
        common = torch.from_numpy(self.candidates.sums(shared))
        surfels = self.candidates.sums(torch.bincount(self.owner[inside], minlength=count)[:, None])
        iou = common / (torch.from_numpy(surfels) + objects.sizes - common)
        expected = torch.cat([iou * self.ious[:, None], torch.zeros(1, len(objects.gains))])
        return expected.amax(0).float()

    def best(self, limits: ObjectLimits) -> Segmentation:
        """Choose disjoint candidates with the largest sum of (expected IoU - OBJECT_COST) x number of surfels.

        This corresponds to the segmentation covering of Arbelaez et al. 2011, "Contour detection and hierarchical image
        segmentation". Without the weights, two parts of an object, each half as good, would score as much as the
        object.
        """
        count = int(self.owner.max()) + 1
        surfels = torch.bincount(self.owner[self.owner >= 0], minlength=count)
        weight = torch.from_numpy(self.candidates.sums(surfels[:, None])[:, 0])
        gain = weight * (self.ious - OBJECT_COST)
        nodes = self.candidates.tree.best(torch.where(self.usable(limits.min_size), gain, -1.0).double().numpy())
        labels = self.labels(nodes)
        return Segmentation(labels, gain[nodes], torch.bincount(labels[labels >= 0], minlength=len(nodes)))


def score_at(surfels: ScenePoints, scale: float, model: Segmenter) -> ScoredCandidates:
    """Find and score candidate objects among the surfels enlarged by `scale`.

    Only the MAX_VOXELS voxels nearest to the focus are used.
    """
    scaled = surfels.enlarged(scale).to(model.input_projection.weight.device)
    near = torch.ones(len(surfels), dtype=torch.bool)
    grid = voxelise(scaled)
    if len(grid) > MAX_VOXELS:
        distance = grid.points.norm(dim=1)
        within = (distance <= distance.kthvalue(MAX_VOXELS).values)[grid.owner]
        scaled, near = scaled[within], within.cpu()
        grid = voxelise(scaled)
    # one copy of a reduced scene is enough: the same objects were found as with all copies, see lab/results/segment.md
    levels, found = averaged_prediction(scaled, grid, model, COPIES if scale >= 1 else 1)
    candidates = find_candidates(grid, levels, found, model)
    ious = model.score(candidates.features.to(grid.points.device)).sigmoid().cpu()
    owner, chance = torch.full((len(surfels),), -1), torch.full((len(surfels), 3), torch.nan)
    owner[near] = grid.owner.cpu()
    chance[near] = found.logits.softmax(1).cpu()[owner[near]]
    return ScoredCandidates(candidates, ious, candidates.extents / scale, scale, owner, chance)


def averaged_prediction(
    surfels: ScenePoints, grid: VoxelGrid, model: Segmenter, copies: int = COPIES
) -> tuple[list[Level], Prediction]:
    """Return the levels of the voxels `grid`, and the predictions averaged over `copies` of the scene.

    Copies are mirrored in the diagonals or rotated by a half turn, and shifted by fractions of a voxel. The network is
    trained with such transformations, but neither the network nor the voxel grid is symmetric.
    """
    count, device = len(model.config["widths"]), grid.points.device
    levels = pyramid(grid.cells, count)

    def predict(k: int) -> Prediction:
        if k == 0:
            return model(grid.features, levels)
        R = torch.tensor(TURNS[k], dtype=torch.float32, device=device)
        copy = voxelise(surfels.turned(R), torch.full((3,), VOXEL * k / COPIES, device=device))
        p = model(copy.features, pyramid(copy.cells, count))
        return Prediction(*(grid.means(x[copy.owner]) for x in (p.logits, p.offsets @ R, p.embedding)))

    parts = [predict(k) for k in range(copies)] if device.type == "cuda" else parallel_map(predict, range(copies))
    return levels, Prediction(*(torch.stack([getattr(p, f.name) for p in parts]).mean(0) for f in fields(Prediction)))


def confirmed(objects: Segmentation, scored: ScoredCandidates) -> Segmentation:
    """Select the objects of a reduced scene that the candidates at the scale of `scored` confirm.

    The mean of the expected IoU in the reduced scene and at that scale must be at least MIN_LONG_IOU, since in a
    reduced scene objects near each other look like a single one.
    """
    iou = (objects.gains / objects.sizes + OBJECT_COST + scored.expected_ious(objects)) / 2
    kept = torch.nonzero(iou >= MIN_LONG_IOU)[:, 0]
    row = torch.full((len(iou) + 1,), -1)  # the last entry is for surfels of no object
    row[kept] = torch.arange(len(kept))
    return Segmentation(row[objects.labels], objects.gains[kept], objects.sizes[kept])


def outlined(surfels: ScenePoints, labels: Int[Tensor, "n"], scored: Sequence[ScoredCandidates]) -> Int[Tensor, "n"]:
    """Return the object of each surfel, 0 for none, after refining the outlines of the objects `labels`."""
    chance = torch.stack([s.chance for s in scored]).nanmean(0)
    fine = surfels.enlarged(SCALES[-1])
    grid = voxelise(fine, features=False)
    return cut_outlines(fine, grid, *_by_voxel(grid, labels, chance))


def best_objects(found: Sequence[Segmentation]) -> Int[Tensor, "n"]:
    """Choose among the objects of all scales; return the object of each surfel, 1 for the largest and 0 for none.

    Maximises the sum of gains, such that no two objects overlap by more than MAX_OVERLAP of the smaller one, by integer
    linear programming.
    """
    first = [0, *itertools.accumulate(len(f.gains) for f in found)]
    gains, sizes = torch.cat([f.gains for f in found]), torch.cat([f.sizes for f in found])
    labels = torch.zeros(len(found[0].labels), dtype=torch.int64)
    conflicts = [
        (first[i] + x, first[j] + y)
        for (i, a), (j, b) in itertools.combinations(enumerate(found), 2)
        for x, y in torch.nonzero(_shared(a, b) > MAX_OVERLAP * torch.minimum(a.sizes[:, None], b.sizes)).tolist()
    ]
    chosen = np.ones(len(gains)) if not conflicts else _best_without(conflicts, gains.double().numpy())
    for number, k in enumerate(sorted(np.nonzero(chosen > 0.5)[0], key=lambda k: -int(sizes[k])), start=1):
        scale = int(np.searchsorted(first, k, side="right")) - 1
        labels[(found[scale].labels == k - first[scale]) & (labels == 0)] = number
    return labels


def _shared(a: Segmentation, b: Segmentation) -> Int[Tensor, "x y"]:
    """Number of surfels that each object of `a` shares with each object of `b`."""
    both = (a.labels >= 0) & (b.labels >= 0)
    number = a.labels[both] * len(b.gains) + b.labels[both]
    return torch.bincount(number, minlength=len(a.gains) * len(b.gains)).view(len(a.gains), len(b.gains))


def _best_without(conflicts: list[tuple[int, int]], gains: np.ndarray) -> np.ndarray:
    """Return 1 for chosen and 0 for other objects; of two objects in conflict at most one is chosen."""
    from scipy.optimize import Bounds, LinearConstraint, milp

    rows = np.zeros((len(conflicts), len(gains)))
    np.put_along_axis(rows, np.array(conflicts), 1.0, axis=1)
    at_most_one = LinearConstraint(rows, ub=1)
    return milp(-gains, integrality=np.ones(len(gains)), bounds=Bounds(0, 1), constraints=at_most_one).x


def _by_voxel(
    grid: VoxelGrid, labels: Int[Tensor, "n"], chance: Float[Tensor, "n 3"]
) -> tuple[Int[Tensor, "v"], Float[Tensor, "v 3"]]:
    """Return the most frequent label of the surfels in each voxel, and their mean class probabilities."""
    count, kinds = len(grid), int(labels.max()) + 1
    most = torch.bincount(grid.owner * kinds + labels, minlength=count * kinds).view(count, kinds).argmax(1)
    known = chance.nan_to_num(1 / 3)
    number = torch.bincount(grid.owner, minlength=count)[:, None]
    return most, torch.zeros(count, 3).index_add_(0, grid.owner, known) / number
