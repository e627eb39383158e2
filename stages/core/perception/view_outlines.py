"""Refine the outlines of objects by colour in the views: reconstructions spread objects over their surroundings."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import binary_fill_holes
from torch import Tensor

from stages.core.geometry.cameras import depths
from stages.core.geometry.neighbours import knn
from stages.core.perception.grabcut import grabcut
from stages.core.perception.support import view_extent
from stages.core.perception.voting import ViewFootprint, add_votes, damp_votes, voting_intrinsics
from stages.core.raster.rasterise import rasterise_features
from stages.core.scene.scene import Scene

MAX_VIEWS = 16  # maximum number of views used, evenly spaced among the cameras
BAND = 0.01  # distance from the current outline within which the new one is searched [camera distance]
MIN_VOTES = 1.0  # minimum votes of a Gaussian that changes its object; hidden Gaussians have fewer
CONTEXT = 3.0  # width of the surroundings with which an object's colours are compared [BAND]
REACH = 0.03  # largest distance of a Gaussian that an object gains from its previous Gaussians [camera distance]
MIN_PIXELS = 40  # minimum number of pixels of an object in a view for its outline to be refined
MIN_KEPT = 0.4  # minimum fraction of its pixels that an object keeps; if fewer remain, colour does not separate it


def refine_outlines(
    scene: Scene, ids: Int[Tensor, "n"], seed: int = 0, device: torch.device | str = "cpu"
) -> Int[Tensor, "n"]:
    """Refine the object ids of the Gaussians: segment the outlines by colour in each view, and vote over the views.

    GrabCut reassigns the pixels within BAND of an object's outline; pixels farther inside and outside are the samples
    of the object's colours and of its surroundings. Gaussians that hardly any view shows keep their object; without
    cameras all of them do. The views are rendered on `device`.
    """
    if scene.cameras is None or not len(scene.cameras) or not bool((ids > 0).any()):
        return ids
    count, means, radius = len(scene.cameras), scene.gaussians.means, view_extent(scene).radius
    views = torch.linspace(0, count - 1, min(MAX_VIEWS, count)).round().long().tolist()
    numbers = ids[ids > 0].unique().tolist()
    middles = torch.stack([means[ids == number].nanmedian(0).values for number in numbers])
    own = (ids[:, None] == torch.tensor(numbers)).float().to(device)
    drawn, votes = replace(scene, gaussians=scene.gaussians.to(device)), torch.zeros(len(ids), 1, device=device)
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        found = []
        for view in views:
            footprint, labels = ViewFootprint.of(drawn, view), _label_image(drawn, view, own, numbers)
            image = (255 * footprint.image.cpu().numpy()).round().astype(np.uint8)
            bands = dict(zip(numbers, _bands(scene, view, middles), strict=True))
            found.append((footprint, pool.submit(cut_outlines, image, labels, bands, seed)))
        for footprint, labels in found:
            votes = add_votes(votes, damp_votes(footprint.votes(torch.from_numpy(labels.result()))))
    voted = torch.where((votes.sum(1) >= MIN_VOTES).cpu(), votes.argmax(1).cpu(), ids)
    for number in numbers:  # undo gains far behind an object, seen where its surface is missing
        gained = torch.nonzero((voted == number) & (ids != number))[:, 0]
        far = knn(means[ids == number], means[gained], 1)[0][:, 0] > REACH * radius
        voted[gained[far]] = ids[gained[far]]
    return voted


def _label_image(scene: Scene, view: int, own: Float[Tensor, "n k"], numbers: list[int]) -> Int[np.ndarray, "h w"]:
    """The object with the largest weight in each pixel at the voting resolution; 0: the background.

    Column k of `own` is 1 for the Gaussians of object `numbers[k]`, else 0.
    """
    width, height, K = voting_intrinsics(scene, view)
    weight = rasterise_features(scene.gaussians, own, scene.cameras.viewmats[[view]], K[None], width, height)[0]
    most, which = weight.max(-1)
    return torch.where(most > 1 - weight.sum(-1), torch.tensor(numbers, device=most.device)[which], 0).cpu().numpy()


def _bands(scene: Scene, view: int, middles: Float[Tensor, "k 3"]) -> list[float]:
    """BAND at the depth of each object's middle [px]."""
    radius, focal = view_extent(scene).radius, voting_intrinsics(scene, view)[2][0, 0]
    return (BAND * radius * focal / depths(middles, scene.cameras.viewmats[view]).clamp_min(0.1 * radius)).tolist()


def cut_outlines(
    image: UInt8[np.ndarray, "h w 3"], labels: Int[np.ndarray, "h w"], bands: dict[int, float], seed: int
) -> Int[np.ndarray, "h w"]:
    """The label image with new outlines of the objects in `bands`, each within that many pixels of its old outline.

    Holes are filled. If a hole shows the background, other views see that background beside the object and outvote this
    one; a dark part of the object, such as the screen of a monitor, stays. No object takes pixels of another. An object
    whose colours do not differ from its surroundings keeps its outline.
    """
    out = np.zeros_like(labels)
    for number, band in bands.items():
        own = labels == number
        if own.sum() < MIN_PIXELS:
            out[own] = number
            continue
        rows, columns = (np.nonzero(own.any(axis))[0] for axis in (1, 0))
        margin, reach = 2 + round(CONTEXT * band), max(1, round(band))
        window = tuple(slice(max(0, x[0] - margin), x[-1] + 1 + margin) for x in (rows, columns))
        mine, free = own[window], (labels[window] == 0) & (out[window] == 0)
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        inner, outer = (f(mine.astype(np.uint8), disc) > 0 for f in (cv2.erode, cv2.dilate))
        found = grabcut(image[window], outer & free, mine & ~inner, inner, seed)
        kept = found if found.sum() >= MIN_KEPT * mine.sum() else mine
        out[window][binary_fill_holes(kept) & (free | mine)] = number
    return out
