"""Objects from boxes drawn in the first view: cut out of it by colour, then out of other views, and voted.

What is cut out of one view says of Gaussians whose they are, those say in the next view where to look, and so on, from
near views to far ones. Source of the cut: Rother, Kolmogorov and Blake 2004, "GrabCut", as in OpenCV.
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import binary_fill_holes, distance_transform_edt, gaussian_filter
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.scene.scene import Scene
from stages.segment.options import SegmentOptions
from stages.segment.prompts import read_prompts
from stages.segment.voting import ViewFootprint, add_votes, apply_votes, damp_votes

MAX_VIEWS = 32  # at most that are cut: more say the same again
BINS = 32  # of a colour's channels
OWN = 2.5  # times as often in the box as around it is a colour that speaks for the object
AROUND = 0.5  # width of what is around a box [its longer side]
REACH = 0.1  # how far from where an object is thought to be it may be found [root of its area]
UNSEEN = 0.5  # the same, of what no earlier view showed
PIECE = 0.1  # a separate piece of a cut smaller than this share of the largest is none


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """The object in each box; the rest is background. Memory holds one view at a time."""
    if scene.cameras is None or not len(scene.cameras):
        raise InputError("--boxes: the scene has no cameras; use one that `ngff reconstruct` wrote")
    size = scene.cameras.sizes[0].tolist()
    prompts = read_prompts(options.boxes, size)
    if prompts.boxes is None:
        raise InputError(f"{options.boxes}: has points and no bbox; points are for --backend sam2")
    shares = prompts.boxes.clamp_min(0) / torch.tensor([*size, *size])
    for share, name in zip(shares, prompts.names, strict=True):
        if bool((share[:2] >= 1).any()) or not bool((share[2:] > share[:2]).all()):
            raise InputError(f"{options.boxes}: the box of {name} lies outside of the first view, which has "
                             f'{size[0]}x{size[1]} pixels; drawn in a larger picture, add "size": [w, h]')  # fmt: skip
    votes = torch.zeros(len(scene.gaussians), 1 + len(shares))
    for view in tqdm(nearest_first(scene), desc="cutting", unit="view", leave=False):
        sight = ViewFootprint.of(scene, view)
        picture = (255 * sight.picture.numpy()).astype(np.uint8)
        labels = (
            segment_prompted_view(picture, shares, options.seed)
            if view == 0
            else segment_next_view(picture, sight, votes, options.seed)
        )
        votes = add_votes(votes, damp_votes(sight.votes(torch.from_numpy(labels))))
    return apply_votes(scene, votes, dict(enumerate(prompts.names, start=1)), str(options.boxes), options.seed)


def nearest_first(scene: Scene) -> list[int]:
    """The first view and at most VIEWS - 1 others, evenly chosen, by distance from it."""
    eyes = centres(scene.cameras.viewmats)
    order = (eyes - eyes[0]).norm(dim=1)
    order[0] = -1
    pick = torch.linspace(0, len(eyes) - 1, min(MAX_VIEWS, len(eyes))).round().long()
    return order.argsort(stable=True)[pick].tolist()


def segment_prompted_view(
    picture: UInt8[np.ndarray, "h w 3"], shares: Float[Tensor, "o 4"], seed: int
) -> Int[np.ndarray, "h w"]:
    """Labels of the view that the boxes are about. Where they overlap, the smallest has the first choice."""
    height, width = picture.shape[:2]
    labels = np.zeros((height, width), dtype=np.int64)
    boxes = (shares * torch.tensor([width, height, width, height])).round().long()
    for i in (shares[:, 2:] - shares[:, :2]).prod(1).argsort(stable=True).tolist():
        x0, y0, x1, y1 = boxes[i].tolist()
        inside, near = np.zeros((2, height, width), dtype=bool)
        side = round(AROUND * max(x1 - x0, y1 - y0))
        near[max(0, y0 - side) : y1 + side, max(0, x0 - side) : x1 + side] = True
        inside[y0:y1, x0:x1] = True
        inside &= labels == 0
        likely = inside & (colour_likelihood_ratio(picture, inside, near & ~inside) > OWN)
        if not likely.any():  # looks like what is around it: the cut has to begin with all of the box
            likely = inside
        labels[grabcut(picture, inside & ~likely, likely, np.zeros_like(inside), seed)] = i + 1
    return labels


def colour_likelihood_ratio(
    picture: UInt8[np.ndarray, "h w 3"], inside: Bool[np.ndarray, "h w"], around: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """How much oftener the colour of each pixel is inside than around."""
    lab = cv2.cvtColor(cv2.GaussianBlur(picture, (0, 0), 1), cv2.COLOR_RGB2LAB).astype(np.int64) * BINS // 256
    key = (lab * (BINS**2, BINS, 1)).sum(-1)
    shares = []
    for part in (inside, around):
        count = np.bincount(key[part], minlength=BINS**3).reshape(BINS, BINS, BINS)
        shares.append(gaussian_filter(count / max(1, part.sum()), 1.0).ravel())
    return (shares[0] / (shares[1] + 1e-6))[key]


def segment_next_view(
    picture: UInt8[np.ndarray, "h w 3"], sight: ViewFootprint, votes: Float[Tensor, "n k"], seed: int
) -> Int[np.ndarray, "h w"]:
    """Labels of another view, from what the Gaussians in it are known to be."""
    front = sight.front.long().clamp_min(0)
    known = ((sight.front >= 0) & (votes.sum(1) > 0)[front]).numpy()
    label = votes.argmax(1)[front].numpy()
    labels, likeliness = np.zeros(known.shape, dtype=np.int64), np.zeros(known.shape)
    for i in range(1, votes.shape[1]):
        own = known & (label == i)
        if own.sum() < 20:
            continue
        other = known & ~own
        outside, within = distance_transform_edt(~own), distance_transform_edt(~other) if other.any() else np.inf
        size = own.sum() ** 0.5
        sure, close = own & (within > REACH / 2 * size), outside < np.where(known, REACH, UNSEEN) * size
        found = grabcut(picture, close & (outside > within), close & (outside <= within), sure, seed)
        mine = np.where(found, within - outside, -np.inf)  # the deeper a pixel is in what is known, the surer
        labels = np.where(found & ((labels == 0) | (mine > likeliness)), i, labels)
        likeliness = np.where(labels == i, mine, likeliness)
    return labels


def grabcut(
    picture: UInt8[np.ndarray, "h w 3"], unlikely: Bool[np.ndarray, "h w"], likely: Bool[np.ndarray, "h w"],
    sure: Bool[np.ndarray, "h w"], seed: int,
) -> Bool[np.ndarray, "h w"]:  # fmt: skip
    """The object's pixels; what is neither likely, unlikely nor sure is something else."""
    trimap = np.full(likely.shape, cv2.GC_BGD, dtype=np.uint8)
    trimap[unlikely], trimap[likely], trimap[sure] = cv2.GC_PR_BGD, cv2.GC_PR_FGD, cv2.GC_FGD
    if ((trimap == cv2.GC_BGD) | (trimap == cv2.GC_PR_BGD)).any() and (likely | sure).any():
        cv2.setRNGSeed(seed)
        # once: learning colours again from the cut, what shows between limbs becomes the object's
        cv2.grabCut(picture, trimap, None, *np.zeros((2, 1, 65)), 1, cv2.GC_INIT_WITH_MASK)
    return clean_mask((trimap == cv2.GC_FGD) | (trimap == cv2.GC_PR_FGD))


def clean_mask(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Without small pieces and small holes."""
    _, piece, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    areas = np.where(np.arange(len(stats)) > 0, stats[:, cv2.CC_STAT_AREA], 0)
    kept = (areas >= PIECE * areas.max())[piece] & mask
    holes = binary_fill_holes(kept) & ~kept
    _, hole, stats, _ = cv2.connectedComponentsWithStats(holes.astype(np.uint8))
    return kept | (holes & (stats[:, cv2.CC_STAT_AREA] < PIECE**2 * kept.sum())[hole])
