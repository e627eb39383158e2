"""SIFT features, plus ALIKED features matched by LightGlue for pairs with few SIFT matches.

SIFT is fast, and accurate enough to estimate the focal length from a short camera path; learned features also match
under large changes of viewpoint. A pair of photos with ENOUGH_SIFT_MATCHES uses only these, other pairs use both kinds.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor
from tqdm import tqdm

from stages.core.models.matching.aliked import ALIKED
from stages.core.models.matching.weights import load_network
from stages.reconstruct import features
from stages.reconstruct.photos import Photos

MAX_FEATURES = 1024  # most learned features per photo, by score; matching time grows with the square
MIN_SCORE = 0.02  # smallest score of a feature; LightGlue rejects unreliable ones
ENOUGH_SIFT_MATCHES = 100  # SIFT matches from which a pair needs no others; photos without common content have up to 50

# Keypoints (s + a, 4), SIFT before ALIKED; SIFT descriptors (s, 128); ALIKED descriptors (a, 128).
HybridFeatures = tuple[Tensor, Tensor, Tensor]


def extract(photos: Photos, device: str = "cpu") -> list[HybridFeatures]:
    """SIFT and ALIKED keypoints and descriptors of every photo; ALIKED keypoints are (x, y, 1, 0)."""
    network = load_network("aliked").to(device)
    sift = features.extract(photos, device)
    out = []
    bar = tqdm(photos.images, desc="finding learned features", unit="photo", leave=False)
    for image, (table, descriptors) in zip(bar, sift, strict=True):
        keypoints, learned = _learned(network, image.numpy(), device)
        out.append((torch.cat([table, F.pad(F.pad(keypoints, (0, 1), value=1.0), (0, 1))]), descriptors, learned))
    return out


def _learned(network: ALIKED, pixels: np.ndarray, device: str) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k 128"]]:
    """ALIKED keypoints in pixels of the photo, centres at +0.5, and unit descriptors."""
    shrink = min(1.0, features.MAX_SIDE / max(pixels.shape[:2]))
    if shrink < 1:
        pixels = cv2.resize(pixels, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    image = torch.from_numpy(pixels).to(device).float() / 255
    keypoints, descriptors = network.keypoints_of(image, MAX_FEATURES, MIN_SCORE)
    return keypoints.cpu() / shrink, descriptors.cpu()


def make_matcher(
    found: list[HybridFeatures], sizes: list[tuple[int, int]], device: str
) -> Callable[..., Int[Tensor, "k 2"]]:
    """Make a function (i, j, allowed) -> matches of photos i and j as rows (index in i, index in j).

    `sizes` of the photos in pixels. The mask `allowed` (n, m), if given, restricts matches of SIFT features.
    """
    network = load_network("lightglue").to(device)
    sift = features.make_matcher([(table, descriptors) for table, descriptors, _ in found], sizes, device)
    first = [len(descriptors) for _, descriptors, _ in found]  # row of the first learned keypoint
    keypoints = [table[k:, :2].to(device) for k, (table, _, _) in zip(first, found, strict=True)]
    learned = [descriptors.to(device) for _, _, descriptors in found]

    def match(i: int, j: int, allowed: Bool[Tensor, "n m"] | None = None) -> Int[Tensor, "k 2"]:
        rows = sift(i, j, None if allowed is None else allowed[: first[i], : first[j]])
        if len(rows) >= ENOUGH_SIFT_MATCHES:
            return rows
        more = network.match((keypoints[i], keypoints[j]), (learned[i], learned[j]), (sizes[i], sizes[j])).cpu()
        return torch.cat([rows, more + torch.tensor([first[i], first[j]])])

    return match
