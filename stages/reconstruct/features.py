"""SIFT features, selection of photo pairs, and descriptor matching."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from tqdm import tqdm

from stages.core.errors import InputError
from stages.core.scene.schema import reason
from stages.reconstruct.colmap import colmap_process, import_pycolmap, run_colmap
from stages.reconstruct.photos import Photos

MAX_SIDE = 1024  # longest side of the images in which features are found [px]
# Most features per photo, largest first; matching time grows with the square.
MAX_FEATURES, MAX_FEATURES_MANY_PHOTOS = 6000, 3000
MAX_FOLDER_PATH = 440  # longest folder path of a COLMAP database [bytes]; SQLite limits the whole path to 512 bytes
DATABASE_BYTES = 1_500_000  # size of the features of a photo in a COLMAP database
MAX_EXHAUSTIVE = 60  # number of photos up to which all pairs are matched
MAX_RATIO = 0.8  # largest ratio of the distances of best and second best match (Lowe 2004)
MAX_DESCRIPTOR_DISTANCE = 0.7  # largest distance of matching descriptors of unit length

# Keypoints (k, 4): x, y [px of the photo, centres at +0.5], scale, orientation; descriptors (k, 128), bytes.
Feature = tuple[Tensor, Tensor]


@colmap_process()
def extract(photos: Photos, device: str = "cpu") -> list[Feature]:
    """SIFT keypoints and root-SIFT descriptors of every photo, largest first; always computed on the CPU."""
    limit = MAX_FEATURES if len(photos) <= MAX_EXHAUSTIVE else MAX_FEATURES_MANY_PHOTOS
    at_once = 4 * torch.get_num_threads()
    out = []
    with tqdm(total=len(photos), desc="finding features", unit="photo", leave=False) as bar:
        for first in range(0, len(photos), at_once):
            images = [_grey(image) for image in photos.images[first : first + at_once]]
            for (shrink, _), (keypoints, descriptors) in zip(images, _sift([grey for _, grey in images]), strict=True):
                x, y, a, b, c, d = keypoints.T  # position and affine shape [[a, b], [c, d]], as COLMAP stores them
                scale = (np.sqrt(a * a + c * c) + np.sqrt(b * b + d * d)) / 2
                table = np.stack([x, y, scale, np.arctan2(c, a)], 1) / np.array([shrink, shrink, shrink, 1], np.float32)
                largest = np.argsort(-scale, kind="stable")[:limit]
                out.append((torch.from_numpy(table[largest]), torch.from_numpy(descriptors[largest])))
            bar.update(len(images))
    return out


def _grey(image: UInt8[Tensor, "h w 3"]) -> tuple[float, np.ndarray]:
    """The scale factor and the grey image, which is at most MAX_SIDE wide or high."""
    grey = cv2.cvtColor(image.numpy(), cv2.COLOR_RGB2GRAY)
    shrink = min(1.0, MAX_SIDE / max(grey.shape))
    if shrink < 1:
        grey = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    return shrink, grey


@contextmanager
def writing_database(folder: Path) -> Iterator[None]:
    """Context manager that converts COLMAP's errors in writing a database, for example on a full disk, to InputError.

    Also raises InputError for a folder whose path is too long.
    """
    length = len(os.fsencode(folder.absolute()))
    if length > MAX_FOLDER_PATH:
        raise InputError(
            f"the path of the folder {folder.name} has {length} bytes, but COLMAP's database needs a path of "
            f"at most {MAX_FOLDER_PATH}; write to a folder with a shorter path, or set TMPDIR to one"
        )
    try:
        yield
    except RuntimeError as error:
        raise InputError(
            f"{folder}: COLMAP cannot write its files ({reason(error)}); free some space, or check "
            "the folder's permissions"
        ) from error


def _check_space(folder: Path, needed: int) -> None:
    """Raise InputError unless the folder has this many bytes free, since COLMAP aborts the process on a full disk."""
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise InputError(f"{folder}: has {free / 1e6:.0f} MB free, but the features of these photos need "
                         f"{needed / 1e6:.0f} "
                         "MB; free some space, or set TMPDIR to a folder on another disk")  # fmt: skip


def _sift(images: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Keypoints (k, 6: x, y and a 2 x 2 matrix) and descriptors (k, 128) of each image.

    Images are passed as files, since only COLMAP's own loop over files uses several threads.
    """
    pycolmap = import_pycolmap()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        _check_space(folder, sum(image.nbytes + DATABASE_BYTES for image in images))
        names = [f"{i}.pgm" for i in range(len(images))]
        for name, image in zip(names, images, strict=True):
            (folder / name).write_bytes(b"P5 %d %d 255\n" % image.shape[::-1] + image.tobytes())
        with writing_database(folder):
            run_colmap("extract", folder, names=names, threads=torch.get_num_threads())
        with pycolmap.Database.open(folder / "features.db") as database:
            ids = {image.name: image.image_id for image in database.read_all_images()}
            return [(database.read_keypoints(ids[name]), database.read_descriptors(ids[name]).data) for name in names]


def normalise(descriptors: UInt8[Tensor, "k d"]) -> Float[Tensor, "k d"]:
    """Descriptors scaled to unit length."""
    return F.normalize(descriptors.float(), dim=1)


def select_pairs(vectors: list[Float[Tensor, "_ d"]], neighbours: int = 8, similar: int = 20) -> list[tuple[int, int]]:
    """Select pairs of photos to match: all pairs of up to MAX_EXHAUSTIVE photos, else neighbours and similar photos.

    Similarity is the number of matches among the 200 largest features of each photo (preemptive matching).
    Source: Wu 2013, "Towards linear-time incremental structure from motion".
    """
    n = len(vectors)
    if n <= MAX_EXHAUSTIVE:
        return [(i, j) for i in range(n) for j in range(i + 1, n)]
    chosen = {(i, i + step) for step in range(1, neighbours + 1) for i in range(n - step)}
    similarity = torch.zeros(n, n)
    for i in tqdm(range(n), desc="choosing pairs", unit="photo", leave=False):
        for j in range(i + 1, n):
            similarity[i, j] = similarity[j, i] = len(match_descriptors(vectors[i][:200], vectors[j][:200]))
    best = similarity.topk(min(similar, n - 1), dim=1)
    for i in range(n):
        alike = best.indices[i][best.values[i] >= 4].tolist()
        chosen |= {(min(i, j), max(i, j)) for j in alike}
    return sorted(chosen)


def match_descriptors(
    a: Float[Tensor, "n d"], b: Float[Tensor, "m d"], allowed: Bool[Tensor, "n m"] | None = None
) -> Int[Tensor, "k 2"]:
    """Mutual nearest neighbours that pass the ratio and distance tests, as rows (index in a, index in b).

    Only pairs that are `allowed` are compared.
    """
    if len(a) < 2 or len(b) < 2:
        return torch.zeros(0, 2, dtype=torch.int64)
    similarity = a @ b.mT
    if allowed is not None:
        similarity.masked_fill_(~allowed.to(similarity.device), -1.0)  # the smallest possible similarity
    best, to_b = similarity.topk(2, dim=1)
    distance = (2 - 2 * best).clamp_min(0).sqrt()
    keep = ((distance[:, 0] < MAX_DESCRIPTOR_DISTANCE) & (distance[:, 0] < MAX_RATIO * distance[:, 1])).nonzero()[:, 0]
    to_b = to_b[keep, 0]
    mutual = similarity[:, to_b].argmax(0) == keep  # only in these columns, as a search along columns is slow
    return torch.stack([keep[mutual], to_b[mutual]], 1).cpu()


def make_matcher(found: list[Feature], sizes: list[tuple[int, int]], device: str) -> Callable[..., Tensor]:
    """Make a function (i, j, allowed) -> matches of photos i and j by `match_descriptors`; `sizes` is not used."""
    vectors = [normalise(descriptors).to(device) for _, descriptors in found]
    return lambda i, j, allowed=None: match_descriptors(vectors[i], vectors[j], allowed)
