"""Segment an object in an image by colour: GrabCut (Rother, Kolmogorov and Blake 2004), in OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from scipy.ndimage import binary_fill_holes

MIN_PIECE_FRACTION = 0.1  # minimum area of a connected piece of a mask, relative to the largest


def grabcut(
    image: UInt8[np.ndarray, "h w 3"], unlikely: Bool[np.ndarray, "h w"], likely: Bool[np.ndarray, "h w"],
    sure: Bool[np.ndarray, "h w"], seed: int,
) -> Bool[np.ndarray, "h w"]:  # fmt: skip
    """The object's pixels by GrabCut; pixels that are neither unlikely, likely nor sure are background."""
    trimap = np.full(likely.shape, cv2.GC_BGD, dtype=np.uint8)
    trimap[unlikely], trimap[likely], trimap[sure] = cv2.GC_PR_BGD, cv2.GC_PR_FGD, cv2.GC_FGD
    if ((trimap == cv2.GC_BGD) | (trimap == cv2.GC_PR_BGD)).any() and (likely | sure).any():
        cv2.setRNGSeed(seed)
        # one iteration: with more, background visible between limbs is added to the colour model of the object
        cv2.grabCut(image, trimap, None, *np.zeros((2, 1, 65)), 1, cv2.GC_INIT_WITH_MASK)
    return clean_mask((trimap == cv2.GC_FGD) | (trimap == cv2.GC_PR_FGD))


def clean_mask(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The mask without small separate pieces and without small holes."""
    _, piece, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    areas = np.where(np.arange(len(stats)) > 0, stats[:, cv2.CC_STAT_AREA], 0)
    kept = (areas >= MIN_PIECE_FRACTION * areas.max())[piece] & mask
    holes = binary_fill_holes(kept) & ~kept
    _, hole, stats, _ = cv2.connectedComponentsWithStats(holes.astype(np.uint8))
    return kept | (holes & (stats[:, cv2.CC_STAT_AREA] < MIN_PIECE_FRACTION**2 * kept.sum())[hole])
