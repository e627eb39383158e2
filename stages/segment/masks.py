"""Objects from label images of the photos, whatever tool made them: each Gaussian takes the majority of its views."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor
from tqdm import tqdm

from stages.errors import InputError
from stages.geometry.cameras import depths, project
from stages.geometry.cameras import resize as resize_K
from stages.geometry.neighbours import knn
from stages.physics.growing import complete
from stages.physics.support import find_support
from stages.raster.rasterise import rasterise, visibility
from stages.scene.images import PHOTOS, read_labels
from stages.scene.scene import Scene, SceneObject
from stages.segment.options import SegmentOptions

log = logging.getLogger(__name__)
SIDE = 640  # longest side that votes are counted at [px]
SURFACE = 0.02  # a Gaussian this near to the drawn surface is on it [share of its depth]


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """Labels of the images in the folder `options.masks`, projected with visibility and voted over all views."""
    if scene.cameras is None:
        raise InputError("--masks: the scene has no cameras; use one that `ngff reconstruct` wrote")
    files = match(options.masks, scene.cameras.names)
    votes = torch.zeros(len(scene.gaussians), 1)
    for view, path in tqdm(files.items(), unit="mask"):
        votes = _add(votes, _votes(scene, view, read_labels(path)))
    if votes.shape[1] == 1:
        raise InputError(f"{options.masks}: the label images hold no object: every pixel is 0")
    ids = elect(scene, votes)
    ids = without_outliers(scene.gaussians.means, ids)
    objects = _objects(options.masks, votes.shape[1] - 1, ids)
    support = find_support(scene, seed=options.seed)
    g = replace(scene.gaussians, object_id=ids)
    return replace(scene, gaussians=complete(g, support, _reach(g.means, ids)) if objects else g, objects=objects)


def match(folder: Path, names: tuple[str, ...]) -> dict[int, Path]:
    """Label image of each camera, found by the photo's name up to its suffix."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; --masks takes a folder of label images named as the photos")
    images = {p.stem: p for p in sorted(folder.iterdir()) if p.suffix.lower() in PHOTOS}
    found = {i: images[Path(name).stem] for i, name in enumerate(names) if Path(name).stem in images}
    if not found:
        raise InputError(
            f"{folder}: no label image is named as a photo of the scene, such as {Path(names[0]).stem}.png"
            if names else f"{folder}: the scene remembers no photos"
        )  # fmt: skip
    if len(found) < len(names):
        log.info("%s: label images for %d of %d photos", folder, len(found), len(names))
    return found


def _votes(scene: Scene, view: int, labels: Int[Tensor, "h w"]) -> Float[Tensor, "n k"]:
    """For each Gaussian and label, the weight of the pixels it is seen in.

    Pixels vote for the Gaussian that weighs most in them; Gaussians that weigh most nowhere but lie on the
    drawn surface take the label of the pixel at their centre, with the little weight they have.
    """
    width, height, K = _small(scene, view, labels)
    viewmat, g = scene.cameras.viewmats[view], scene.gaussians
    rows = (torch.arange(height) + 0.5) * labels.shape[0] / height
    columns = (torch.arange(width) + 0.5) * labels.shape[1] / width
    labels = labels[rows.long()][:, columns.long()]
    index, weight = visibility(g, viewmat, K, width, height)
    votes = torch.zeros(len(g), int(labels.max()) + 1)
    seen = index >= 0
    votes.index_put_((index[seen], labels[seen]), torch.ones(int(seen.sum())), accumulate=True)
    depth = rasterise(g, viewmat[None], K[None], width, height).depth[0]
    pixel = project(g.means, viewmat, K).nan_to_num(-1).floor().long()
    z = depths(g.means, viewmat)
    inside = (z > 0.01) & ((pixel >= 0) & (pixel < torch.tensor([width, height]))).all(1)
    x, y = pixel[inside].T
    on = torch.zeros_like(inside)
    on[inside] = (z[inside] - depth[y, x]).abs() < SURFACE * z[inside]
    x, y = pixel[on].T
    votes.index_put_((torch.nonzero(on)[:, 0], labels[y, x]), weight[on] + 1e-3, accumulate=True)
    return votes


def _small(scene: Scene, view: int, labels: Tensor) -> tuple[int, int, Tensor]:
    """Size and K that a view is counted at; the label image may have any size of the photo's proportions."""
    width, height = scene.cameras.sizes[view].tolist()
    have = labels.shape[1] / labels.shape[0]
    if abs(have / (width / height) - 1) > 0.03:
        raise InputError(
            f"--masks: the label image of {scene.cameras.names[view]} is {labels.shape[1]}x{labels.shape[0]}, "
            f"the photo {width}x{height}; they must have the same proportions"
        )
    shrink = min(1.0, SIDE / max(width, height))
    w, h = max(1, round(width * shrink)), max(1, round(height * shrink))
    return w, h, resize_K(scene.cameras.Ks[view], w / width, h / height)


def _add(a: Float[Tensor, "n j"], b: Float[Tensor, "n k"]) -> Float[Tensor, "n l"]:
    wide = max(a.shape[1], b.shape[1])
    return torch.nn.functional.pad(a, (0, wide - a.shape[1])) + torch.nn.functional.pad(b, (0, wide - b.shape[1]))


def elect(scene: Scene, votes: Float[Tensor, "n k"]) -> Int[Tensor, "n"]:
    """The label with most votes; ties and Gaussians without votes take that of the nearest decided ones.

    Of these the five nearest decide, if they are near: within three times the usual spacing.
    """
    best, ids = votes.max(1)
    second = votes.scatter(1, ids[:, None], 0).amax(1)
    decided = (best > 0) & (best > second)
    if not decided.any() or decided.all():
        return torch.where(decided, ids, 0)
    means = scene.gaussians.means
    distance, index = knn(means[decided], means[~decided], 5)
    near = knn(means[decided][:20_000], means[decided][:20_000], 4)[0][:, -1].median() * 3
    ballot = torch.nn.functional.one_hot(ids[decided][index], votes.shape[1]) * (distance < near)[..., None]
    ids[~decided] = torch.where(ballot.sum((1, 2)) > 0, ballot.sum(1).argmax(1), 0)
    return ids


def without_outliers(means: Float[Tensor, "n 3"], ids: Int[Tensor, "n"], limit: float = 3.5) -> Int[Tensor, "n"]:
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
    """Twice the usual spacing of labelled Gaussians [scene units]."""
    labelled = means[ids > 0]
    return 3 * float(knn(labelled, labelled[:20_000], 4)[0][:, -1].median()) if len(labelled) > 4 else 0.0


def _objects(folder: Path, count: int, ids: Int[Tensor, "n"]) -> tuple[SceneObject, ...]:
    """Those labels that won Gaussians, named by names.json ({"1": "duck"} or ["duck", ...]) where there is one."""
    path, names = Path(folder) / "names.json", {}
    if path.exists():
        try:
            data = json.loads(path.read_text())
            rows = enumerate(data, start=1) if isinstance(data, list) else data.items()
            names = {int(number): str(name) for number, name in rows}
        except (ValueError, AttributeError) as error:
            raise InputError(f'{path}: is not readable ({error}); write {{"1": "duck", "2": "bowl"}}') from error
    present = set(ids.unique().tolist())
    missing = [i for i in range(1, count + 1) if i not in present]
    if missing:
        log.warning("%s: labels %s won no Gaussian", folder, ", ".join(map(str, missing)))
    return tuple(SceneObject(i, names.get(i, f"object_{i}")) for i in range(1, count + 1) if i in present)
