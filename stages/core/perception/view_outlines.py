"""Outlines of objects by their colours in the views, where a reconstruction spreads them over what is beside them."""

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

MAX_VIEWS = 16  # evenly chosen among the cameras
BAND = 0.01  # distance from the outline so far within which the new one is looked for [camera distance]
MIN_VOTES = 1.0  # of a Gaussian that changes its object; those hidden under something have less
CONTEXT = 3.0  # width of the surroundings whose colours are compared with those of an object [BAND]
REACH = 0.03  # of the Gaussians that an object may gain from those that it had [camera distance]
MIN_PIXELS = 40  # of an object in a view
MIN_KEPT = 0.4  # share of an object's pixels; where less is left, its colours are those of its surroundings


def refine_outlines(
    scene: Scene, ids: Int[Tensor, "n"], seed: int = 0, device: torch.device | str = "cpu"
) -> Int[Tensor, "n"]:
    """The objects `ids` of the Gaussians, with their outlines cut in each view by colour and voted over the views.

    The pixels within BAND of an object's outline are assigned anew by GrabCut; those farther inside and outside are
    the examples of its colours and of those around it. Gaussians that hardly any view shows keep their object, and
    without cameras all do. The views are drawn on `device`.
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
    for number in numbers:  # not what is far behind an object, where its surface is missing
        gained = torch.nonzero((voted == number) & (ids != number))[:, 0]
        far = knn(means[ids == number], means[gained], 1)[0][:, 0] > REACH * radius
        voted[gained[far]] = ids[gained[far]]
    return voted


def _label_image(scene: Scene, view: int, own: Float[Tensor, "n k"], numbers: list[int]) -> Int[np.ndarray, "h w"]:
    """The object with the largest weight in each pixel at the resolution of voting; 0: the background.

    `own` is 1 for the Gaussians of each of the objects `numbers`.
    """
    width, height, K = voting_intrinsics(scene, view)
    weight = rasterise_features(scene.gaussians, own, scene.cameras.viewmats[[view]], K[None], width, height)[0]
    most, which = weight.max(-1)
    return torch.where(most > 1 - weight.sum(-1), torch.tensor(numbers, device=most.device)[which], 0).cpu().numpy()


def _bands(scene: Scene, view: int, middles: Float[Tensor, "k 3"]) -> list[float]:
    """BAND in pixels at the depth of each object's middle."""
    radius, focal = view_extent(scene).radius, voting_intrinsics(scene, view)[2][0, 0]
    return (BAND * radius * focal / depths(middles, scene.cameras.viewmats[view]).clamp_min(0.1 * radius)).tolist()


def cut_outlines(
    image: UInt8[np.ndarray, "h w 3"], labels: Int[np.ndarray, "h w"], bands: dict[int, float], seed: int
) -> Int[np.ndarray, "h w"]:
    """The label image with new outlines of the objects of `bands`, each within that many pixels of the one before.

    Holes are filled: what is behind an object is seen beside it in other views, which outvote this one; the dark
    screen of a monitor is not. No object takes pixels of another. Objects whose colours do not tell them from what is
    around them stay as they are.
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
