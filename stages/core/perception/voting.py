"""Multi-view voting: fuse the label images of many views into one label per Gaussian, by majority, without outliers."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.cameras import depths, project
from stages.core.geometry.cameras import resize as resize_K
from stages.core.geometry.neighbours import knn
from stages.core.perception.region_growing import grow_objects
from stages.core.perception.support import find_support
from stages.core.raster.rasterise import visibility
from stages.core.scene.scene import Scene, SceneObject

log = logging.getLogger(__name__)
MAX_VOTING_SIDE = 640  # longest side of the images in which votes are counted [px]
POOLED_NEIGHBOURS = 8  # neighbours whose votes are added to those of a Gaussian
SURFACE_TOLERANCE = 0.02  # distance from the rendered surface up to which a Gaussian is on it [fraction of its depth]
MAX_SPACING = 3.0  # largest distance of neighbours that are used [median spacing]
MAX_SPACING_POINTS = 20_000  # maximum number of Gaussians from which the median spacing is estimated


@dataclass(frozen=True)
class ViewFootprint:
    """Which Gaussians of a scene are visible at which pixels of one view, at the voting resolution."""

    front: Int[Tensor, "h w"]  # the Gaussian with the largest weight in each pixel; -1: none
    on: Int[Tensor, "m"]  # Gaussians whose centres lie on the rendered surface
    pixels: Int[Tensor, "m"]  # their pixels, row-major
    weights: Float[Tensor, "m"]  # their weights, summed over the image [px]
    gaussians: int  # number of Gaussians of the scene
    image: Float[Tensor, "h w 3"]  # the rendered view, 0..1

    @classmethod
    def of(cls, scene: Scene, view: int) -> ViewFootprint:
        """The footprint of view number `view`, rendered on the device of the Gaussians."""
        g, viewmat = scene.gaussians, scene.cameras.viewmats[view]
        width, height, K = voting_intrinsics(scene, view)
        rgb, _, depth, front, weight = visibility(g, viewmat, K, width, height)
        viewmat, K = viewmat.to(g.means), K.to(g.means)
        x, y = project(g.means, viewmat, K).nan_to_num(-1).floor().long().unbind(1)
        z = depths(g.means, viewmat)
        inside = torch.nonzero((z > 0.01) & (x >= 0) & (x < width) & (y >= 0) & (y < height))[:, 0]
        pixels = y[inside] * width + x[inside]
        on = (z[inside] - depth.flatten()[pixels]).abs() < SURFACE_TOLERANCE * z[inside]
        return cls(front, inside[on], pixels[on], weight[inside[on]], len(g), rgb.clamp(0, 1))

    def votes(self, labels: Int[Tensor, "h2 w2"]) -> Float[Tensor, "n k"]:
        """Votes of a label image of any size: for each Gaussian and label, the weight of its pixels.

        Each pixel votes once for the Gaussian with the largest weight in it. A Gaussian on the rendered surface also
        gets a vote from the pixel at its centre, with its weight summed over the image.
        """
        height, width = self.front.shape
        device = self.front.device
        rows = ((torch.arange(height) + 0.5) * labels.shape[0] / height).long()
        columns = ((torch.arange(width) + 0.5) * labels.shape[1] / width).long()
        labels = labels[rows][:, columns].long().to(device)
        votes = torch.zeros(self.gaussians, int(labels.max()) + 1, device=device)
        seen = self.front >= 0
        one = torch.ones((), device=device)
        votes.index_put_((self.front[seen].long(), labels[seen]), one, accumulate=True)
        votes.index_put_((self.on, labels.flatten()[self.pixels]), self.weights + 1e-3, accumulate=True)
        return votes


def voting_intrinsics(scene: Scene, view: int) -> tuple[int, int, Float[Tensor, "3 3"]]:
    """Width, height [px] and K of a view at the voting resolution."""
    width, height = scene.cameras.sizes[view].tolist()
    shrink = min(1.0, MAX_VOTING_SIDE / max(width, height))
    w, h = max(1, round(width * shrink)), max(1, round(height * shrink))
    return w, h, resize_K(scene.cameras.Ks[view], w / width, h / height)


def collect_votes(scene: Scene, images: Iterable[tuple[int, Int[Tensor, "h w"]]]) -> Float[Tensor, "n k"]:
    """Summed votes of all `images`: pairs of a view's index and its labels (0 background, 1... the objects).

    The iterable is consumed one image at a time, so that only one is in memory.
    """
    total = torch.zeros(len(scene.gaussians), 1)
    for view, labels in images:
        total = add_votes(total, damp_votes(ViewFootprint.of(scene, view).votes(labels)))
    return total


def damp_votes(votes: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """One view's votes, scaled so that each Gaussian's total is the square root of its previous value.

    Neighbouring pixels of a mask are not independent. The square root is a compromise between one vote per pixel, where
    a single close view may outvote all others, and one vote per view.
    """
    return votes / votes.sum(1, keepdim=True).clamp_min(1e-12).sqrt()


def pool_votes(means: Float[Tensor, "n 3"], votes: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """Each Gaussian's votes plus those of its nearest neighbours: this reduces noise, since few pixels show a Gaussian.

    Neighbours farther than MAX_SPACING are ignored. `ngff-lab bench segment` measures the effect with wrong masks.
    """
    real = torch.nonzero(means.isfinite().all(1))[:, 0]
    distance, index = knn(means[real], means[real], POOLED_NEIGHBOURS + 1)
    near = distance < MAX_SPACING * distance[:, -1].median()
    out, own = votes.clone(), votes[real]
    for j in range(1, index.shape[1]):
        out[real] += own[index[:, j]] * near[:, j, None]
    return out


def add_votes(a: Float[Tensor, "n j"], b: Float[Tensor, "n k"]) -> Float[Tensor, "n l"]:
    """Sum of votes that may have different numbers of labels."""
    count = max(a.shape[1], b.shape[1])
    return torch.nn.functional.pad(a, (0, count - a.shape[1])) + torch.nn.functional.pad(b, (0, count - b.shape[1]))


def apply_votes(
    scene: Scene, votes: Float[Tensor, "n k"], names: Mapping[int, str], source: str, seed: int = 0,
    numbers: Sequence[int] | None = None,
) -> Scene:  # fmt: skip
    """The scene with its objects, labelled by majority, with labels grown to whole objects.

    `numbers` are the object ids of the columns of `votes`, by default 0, 1, 2 and so on. An object without a name is
    called object_NUMBER. `source` names the origin of the labels in messages. Raises InputError if the labels contain
    no object.
    """
    numbers = range(votes.shape[1]) if numbers is None else numbers
    if votes.shape[1] == 1:
        raise InputError(
            f"{source}: the label images contain no objects, as every pixel is 0 or ignored; give each object a "
            "number from 1"
        )
    means = scene.gaussians.means
    ids = remove_outliers(means, majority_labels(scene, pool_votes(means, votes)))
    present = {numbers[i] for i in ids.unique().tolist()}
    objects = tuple(SceneObject(i, names.get(i, f"object_{i}")) for i in numbers[1:] if i in present)
    if missing := [i for i in numbers[1:] if i not in present]:
        log.warning("%s: no Gaussian was assigned to the labels %s", source, ", ".join(map(str, missing)))
    g = replace(scene.gaussians, object_id=ids)
    grown = grow_objects(g, find_support(scene, seed=seed), _growth_radius(means, ids)) if objects else g
    grown = replace(grown, object_id=torch.tensor(numbers)[grown.object_id])
    return replace(scene, gaussians=grown, objects=objects)


def majority_labels(scene: Scene, votes: Float[Tensor, "n k"]) -> Int[Tensor, "n"]:
    """The label with the most votes; Gaussians with a tie or without votes take the majority of the 5 nearest others.

    Neighbours farther than MAX_SPACING times the median spacing are ignored.
    """
    best, ids = votes.max(1)
    second = votes.scatter(1, ids[:, None], 0).amax(1)
    decided = (best > 0) & (best > second)
    ids = torch.where(decided, ids, 0)
    means = scene.gaussians.means
    undecided = torch.nonzero(~decided & means.isfinite().all(1))[:, 0]
    if not decided.any() or not len(undecided):
        return ids
    distance, index = knn(means[decided], means[undecided], 5)
    some = means[decided][:MAX_SPACING_POINTS]
    near = knn(some, some, 4)[0][:, -1].median() * MAX_SPACING
    ballot = torch.nn.functional.one_hot(ids[decided][index], votes.shape[1]) * (distance < near)[..., None]
    ids[undecided] = torch.where(ballot.sum((1, 2)) > 0, ballot.sum(1).argmax(1), 0)
    return ids


def remove_outliers(means: Float[Tensor, "n 3"], ids: Int[Tensor, "n"], limit: float = 3.5) -> Int[Tensor, "n"]:
    """Labels with each object's outliers set to 0, by the modified z-score of the distance to the median centre.

    Source: Iglewicz and Hoaglin 1993: 0.6745 |d - median| / MAD <= 3.5.
    """
    ids = ids.clone()
    for number in ids.unique().tolist():
        if number == 0:
            continue
        members = torch.nonzero(ids == number)[:, 0]
        distance = (means[members] - means[members].median(0).values).norm(dim=1)
        deviation = (distance - distance.median()).abs()
        ids[members[0.6745 * deviation > limit * deviation.median().clamp_min(1e-12)]] = 0
    return ids


def _growth_radius(means: Float[Tensor, "n 3"], ids: Int[Tensor, "n"]) -> float:
    """Radius of region growing: MAX_SPACING times the median spacing of labelled Gaussians [scene units]."""
    labelled = means[ids > 0]
    if len(labelled) <= 4:
        return 0.0
    return MAX_SPACING * float(knn(labelled, labelled[:MAX_SPACING_POINTS], 4)[0][:, -1].median())
