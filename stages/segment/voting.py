"""Label images of many views, whatever made them, become one label for each Gaussian: the majority, without strays."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
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
from stages.core.raster.rasterise import rasterise, visibility
from stages.core.scene.scene import Scene, SceneObject

log = logging.getLogger(__name__)
SIDE = 640  # longest side that votes are counted at [px]
POOL = 8  # neighbours whose votes count for a Gaussian as its own do
SURFACE = 0.02  # a Gaussian this near to the drawn surface is on it [share of its depth]


@dataclass(frozen=True)
class ViewFootprint:
    """What one camera sees of a scene's Gaussians, at the size that votes are counted at."""

    front: Int[Tensor, "h w"]  # the Gaussian that weighs most in each pixel; -1: none
    on: Int[Tensor, "m"]  # Gaussians whose centres lie on the drawn surface
    pixels: Int[Tensor, "m"]  # where those are, counted row by row
    weights: Float[Tensor, "m"]  # that they have in the whole image [px]
    gaussians: int  # of the scene
    picture: Float[Tensor, "h w 3"]  # what it sees, 0..1

    @classmethod
    def of(cls, scene: Scene, view: int) -> ViewFootprint:
        g, viewmat = scene.gaussians, scene.cameras.viewmats[view]
        width, height, K = voting_intrinsics(scene, view)
        front, weight = visibility(g, viewmat, K, width, height)
        drawn = rasterise(g, viewmat[None], K[None], width, height)
        x, y = project(g.means, viewmat, K).nan_to_num(-1).floor().long().unbind(1)
        z = depths(g.means, viewmat)
        inside = torch.nonzero((z > 0.01) & (x >= 0) & (x < width) & (y >= 0) & (y < height))[:, 0]
        pixels = y[inside] * width + x[inside]
        on = (z[inside] - drawn.depth[0].flatten()[pixels]).abs() < SURFACE * z[inside]
        return cls(front, inside[on], pixels[on], weight[inside[on]], len(g), drawn.rgb[0].clamp(0, 1))

    def votes(self, labels: Int[Tensor, "h2 w2"]) -> Float[Tensor, "n k"]:
        """For each Gaussian and label, the weight of the pixels it is seen in; `labels` may have any size.

        Pixels vote for the Gaussian that weighs most in them; Gaussians that weigh most nowhere but lie on the
        drawn surface take the label of the pixel at their centre, with the little weight they have.
        """
        height, width = self.front.shape
        rows = ((torch.arange(height) + 0.5) * labels.shape[0] / height).long()
        columns = ((torch.arange(width) + 0.5) * labels.shape[1] / width).long()
        labels = labels[rows][:, columns].long()
        votes = torch.zeros(self.gaussians, int(labels.max()) + 1)
        seen = self.front >= 0
        votes.index_put_((self.front[seen].long(), labels[seen]), torch.ones(int(seen.sum())), accumulate=True)
        votes.index_put_((self.on, labels.flatten()[self.pixels]), self.weights + 1e-3, accumulate=True)
        return votes


def voting_intrinsics(scene: Scene, view: int) -> tuple[int, int, Float[Tensor, "3 3"]]:
    """Width, height [px] and K that a view's votes are counted at."""
    width, height = scene.cameras.sizes[view].tolist()
    shrink = min(1.0, SIDE / max(width, height))
    w, h = max(1, round(width * shrink)), max(1, round(height * shrink))
    return w, h, resize_K(scene.cameras.Ks[view], w / width, h / height)


def collect_votes(scene: Scene, images: Iterable[tuple[int, Int[Tensor, "h w"]]]) -> Float[Tensor, "n k"]:
    """Votes of all `images`, each the number of a camera and its labels (0 background, 1... the objects).

    Images come one at a time, from a folder or from a network, so memory holds one of them.
    """
    total = torch.zeros(len(scene.gaussians), 1)
    for view, labels in images:
        total = add_votes(total, damp_votes(ViewFootprint.of(scene, view).votes(labels)))
    return total


def damp_votes(votes: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """One view's votes with the root of its weight: pixels side by side in one mask are not independent witnesses.

    In between a vote for each pixel, where one near view may overrule all others, and a vote for each view.
    """
    return votes / votes.sum(1, keepdim=True).clamp_min(1e-12).sqrt()


def pool_votes(means: Float[Tensor, "n 3"], votes: Float[Tensor, "n k"]) -> Float[Tensor, "n k"]:
    """Each Gaussian's votes with those of its nearest neighbours: few pixels show one Gaussian, and noise is in each.

    Only neighbours within three times the usual spacing count. Measured with wrong masks by `ngff-lab bench segment`.
    """
    real = torch.nonzero(means.isfinite().all(1))[:, 0]
    distance, index = knn(means[real], means[real], POOL + 1)
    near = distance < 3 * distance[:, -1].median()
    out, mine = votes.clone(), votes[real]
    for j in range(1, index.shape[1]):
        out[real] += mine[index[:, j]] * near[:, j, None]
    return out


def add_votes(a: Float[Tensor, "n j"], b: Float[Tensor, "n k"]) -> Float[Tensor, "n l"]:
    """Sum of votes that may know different numbers of labels."""
    wide = max(a.shape[1], b.shape[1])
    return torch.nn.functional.pad(a, (0, wide - a.shape[1])) + torch.nn.functional.pad(b, (0, wide - b.shape[1]))


def apply_votes(
    scene: Scene, votes: Float[Tensor, "n k"], names: Mapping[int, str], source: str, seed: int = 0
) -> Scene:
    """The scene with the label that won each Gaussian, grown to whole objects, and its objects.

    An object without a name becomes object_NUMBER. `source` is what errors and warnings name: whatever gave labels.
    """
    if votes.shape[1] == 1:
        raise InputError(f"{source}: the label images hold no object: every pixel is 0")
    means = scene.gaussians.means
    ids = remove_outliers(means, majority_labels(scene, pool_votes(means, votes)))
    present = set(ids.unique().tolist())
    objects = tuple(SceneObject(i, names.get(i, f"object_{i}")) for i in range(1, votes.shape[1]) if i in present)
    if missing := [i for i in range(1, votes.shape[1]) if i not in present]:
        log.warning("%s: labels %s won no Gaussian", source, ", ".join(map(str, missing)))
    g = replace(scene.gaussians, object_id=ids)
    grown = grow_objects(g, find_support(scene, seed=seed), _reach(means, ids)) if objects else g
    return replace(scene, gaussians=grown, objects=objects)


def majority_labels(scene: Scene, votes: Float[Tensor, "n k"]) -> Int[Tensor, "n"]:
    """The label with most votes; ties and Gaussians without votes take that of the nearest decided ones.

    Of these the five nearest decide, if they are near: within three times the usual spacing.
    """
    best, ids = votes.max(1)
    second = votes.scatter(1, ids[:, None], 0).amax(1)
    decided = (best > 0) & (best > second)
    ids = torch.where(decided, ids, 0)
    means = scene.gaussians.means
    unsure = torch.nonzero(~decided & means.isfinite().all(1))[:, 0]
    if not decided.any() or not len(unsure):
        return ids
    distance, index = knn(means[decided], means[unsure], 5)
    near = knn(means[decided][:20_000], means[decided][:20_000], 4)[0][:, -1].median() * 3
    ballot = torch.nn.functional.one_hot(ids[decided][index], votes.shape[1]) * (distance < near)[..., None]
    ids[unsure] = torch.where(ballot.sum((1, 2)) > 0, ballot.sum(1).argmax(1), 0)
    return ids


def remove_outliers(means: Float[Tensor, "n 3"], ids: Int[Tensor, "n"], limit: float = 3.5) -> Int[Tensor, "n"]:
    """Labels with each object's strays made background: modified z-score of the distance to the median centre.

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


def _reach(means: Float[Tensor, "n 3"], ids: Int[Tensor, "n"]) -> float:
    """Three times the usual spacing of labelled Gaussians [scene units]."""
    labelled = means[ids > 0]
    return 3 * float(knn(labelled, labelled[:20_000], 4)[0][:, -1].median()) if len(labelled) > 4 else 0.0
