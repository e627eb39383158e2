"""The boxes backend: objects in bounding boxes of the first view, segmented by colour in each view.

Each segmented view adds votes to the Gaussians. The votes so far initialise the segmentation of the next view; views
are visited by their distance from the first. Views are segmented by GrabCut in OpenCV (Rother, Kolmogorov and Blake
2004, "GrabCut").
"""

from __future__ import annotations

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from scipy.ndimage import distance_transform_edt, gaussian_filter
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.geometry.cameras import centres
from stages.core.perception.grabcut import grabcut
from stages.core.perception.voting import ViewFootprint, add_votes, apply_votes, damp_votes
from stages.core.scene.lens import photo_of
from stages.core.scene.scene import Scene
from stages.segment.options import NETWORKS, SegmentOptions
from stages.segment.prompts import read_prompts

MAX_VIEWS = 32  # most views that are segmented; more are redundant
COLOUR_BINS = 32  # bins per channel of a colour histogram
MIN_LIKELIHOOD_RATIO = 2.5  # smallest ratio of the frequencies of an object's colour in the box and around it
CONTEXT_WIDTH = 0.5  # width of the frame around a box with which the box is compared [longer side of the box]
MAX_SHIFT_KNOWN = 0.1  # largest distance of an object's pixel from its predicted mask [square root of the mask's area]
MAX_SHIFT_UNSEEN = 0.5  # largest distance for surfaces that no earlier view showed [square root of the mask's area]
MIN_LABELLED_PIXELS = 20  # fewest predicted pixels of an object that is segmented in a further view


def segment(scene: Scene, options: SegmentOptions) -> Scene:
    """Label the object in each box; everything else is background. Only one view is in memory at a time.

    Raises InputError for a scene without cameras, prompts without boxes, and boxes outside the first view.
    """
    if scene.cameras is None or not len(scene.cameras):
        raise InputError("--boxes: the scene has no cameras; give a scene written by `ngff reconstruct`")
    size = scene.cameras.sizes[0].tolist()
    prompts = read_prompts(options.boxes, scene.cameras, options.undistorted)
    if prompts.boxes is None:
        raise InputError(f"{options.boxes}: has points but no bbox; points only work with --backend {NETWORKS}")
    boxes_fraction = prompts.boxes / torch.tensor([*size, *size])
    for box, name in zip(boxes_fraction, prompts.names, strict=True):
        if not bool((box[2:] > box[:2]).all()):
            width, height = photo_of(scene.cameras, 0, options.undistorted)[1]
            raise InputError(f"{options.boxes}: the box of {name} is outside the first view, which has "
                             f'{width}x{height} pixels; if the box is given for another image size, add "size": '
                             '[w, h]')  # fmt: skip
    votes = torch.zeros(len(scene.gaussians), 1 + len(boxes_fraction))
    for view in tqdm(nearest_first(scene), desc="segmenting", unit="view", leave=False):
        footprint = ViewFootprint.of(scene, view)
        image = (255 * footprint.image.numpy()).astype(np.uint8)
        labels = (
            segment_prompted_view(image, boxes_fraction, options.seed)
            if view == 0
            else segment_next_view(image, footprint, votes, options.seed)
        )
        votes = add_votes(votes, damp_votes(footprint.votes(torch.from_numpy(labels))))
    return apply_votes(scene, votes, dict(enumerate(prompts.names, start=1)), str(options.boxes), options.seed)


def nearest_first(scene: Scene) -> list[int]:
    """The first view and at most MAX_VIEWS - 1 evenly chosen others, sorted by distance from the first."""
    eyes = centres(scene.cameras.viewmats)
    order = (eyes - eyes[0]).norm(dim=1)
    order[0] = -1
    pick = torch.linspace(0, len(eyes) - 1, min(MAX_VIEWS, len(eyes))).round().long()
    return order.argsort(stable=True)[pick].tolist()


def segment_prompted_view(
    image: UInt8[np.ndarray, "h w 3"], boxes_fraction: Float[Tensor, "o 4"], seed: int
) -> Int[np.ndarray, "h w"]:
    """Labels of the view to which the boxes refer. Smaller boxes are segmented first and win where boxes overlap."""
    height, width = image.shape[:2]
    labels = np.zeros((height, width), dtype=np.int64)
    boxes = (boxes_fraction * torch.tensor([width, height, width, height])).round().long()
    for i in (boxes_fraction[:, 2:] - boxes_fraction[:, :2]).prod(1).argsort(stable=True).tolist():
        x0, y0, x1, y1 = boxes[i].tolist()
        inside, near = np.zeros((2, height, width), dtype=bool)
        side = round(CONTEXT_WIDTH * max(x1 - x0, y1 - y0))
        near[max(0, y0 - side) : y1 + side, max(0, x0 - side) : x1 + side] = True
        inside[y0:y1, x0:x1] = True
        inside &= labels == 0
        likely = inside & (colour_likelihood_ratio(image, inside, near & ~inside) > MIN_LIKELIHOOD_RATIO)
        if not likely.any():  # same colours inside and outside: start from the whole box
            likely = inside
        labels[grabcut(image, inside & ~likely, likely, np.zeros_like(inside), seed)] = i + 1
    return labels


def colour_likelihood_ratio(
    image: UInt8[np.ndarray, "h w 3"], inside: Bool[np.ndarray, "h w"], around: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w"]:
    """Ratio of the frequencies of each pixel's colour in both masks, from smoothed CIELAB histograms."""
    lab = cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 1), cv2.COLOR_RGB2LAB).astype(np.int64) * COLOUR_BINS // 256
    key = (lab * (COLOUR_BINS**2, COLOUR_BINS, 1)).sum(-1)
    frequencies = []
    for part in (inside, around):
        count = np.bincount(key[part], minlength=COLOUR_BINS**3).reshape(COLOUR_BINS, COLOUR_BINS, COLOUR_BINS)
        frequencies.append(gaussian_filter(count / max(1, part.sum()), 1.0).ravel())
    return (frequencies[0] / (frequencies[1] + 1e-6))[key]


def segment_next_view(
    image: UInt8[np.ndarray, "h w 3"], footprint: ViewFootprint, votes: Float[Tensor, "n k"], seed: int
) -> Int[np.ndarray, "h w"]:
    """Labels of a further view, initialised from the votes of the Gaussians that are visible in it."""
    front = footprint.front.long().clamp_min(0)
    known = ((footprint.front >= 0) & (votes.sum(1) > 0)[front]).numpy()
    label = votes.argmax(1)[front].numpy()
    labels, depth = np.zeros(known.shape, dtype=np.int64), np.zeros(known.shape)
    for i in range(1, votes.shape[1]):
        own = known & (label == i)
        if own.sum() < MIN_LABELLED_PIXELS:
            continue
        other = known & ~own
        outside, within = distance_transform_edt(~own), distance_transform_edt(~other) if other.any() else np.inf
        size = own.sum() ** 0.5
        sure = own & (within > MAX_SHIFT_KNOWN / 2 * size)
        close = outside < np.where(known, MAX_SHIFT_KNOWN, MAX_SHIFT_UNSEEN) * size
        found = grabcut(image, close & (outside > within), close & (outside <= within), sure, seed)
        own_depth = np.where(found, within - outside, -np.inf)  # signed distance into the predicted mask
        labels = np.where(found & ((labels == 0) | (own_depth > depth)), i, labels)
        depth = np.where(labels == i, own_depth, depth)
    return labels
