"""Reading of the films of a scene's cameras, as undistorted images at the resolution of the renderings."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Int16, UInt8
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.cameras import resize as resize_K
from stages.core.scene.cameras import Cameras
from stages.core.scene.images import resize
from stages.core.scene.lens import Undistortion
from stages.core.scene.recordings import list_recordings, read_recording
from stages.core.scene.scene import Scene
from stages.lab.track.film_masks import find_film_masks

log = logging.getLogger(__name__)
MULTIPLE = 8  # image sizes are multiples of this, so that images can be reduced by whole factors


@dataclass(frozen=True)
class Film:
    """The images of one camera."""

    name: str
    frames: UInt8[Tensor, "t h w 3"]
    start: float  # frame number at the release, with fractions
    labels: Int16[Tensor, "t h w"] | None = None  # object in each pixel, as returned by FilmMasks.read


def list_films(scene: Scene, folder: Path) -> dict[str, Path]:
    """The films in a folder that belong to cameras of the scene, by name. Raises InputError if there are none."""
    recordings, starts = list_recordings(folder), scene.sequence.starts
    timed = [name for name in scene.cameras.names if name in starts]
    if missing := [name for name in timed if name not in recordings]:
        log.warning("%s: contains no film named %s; tracking continues without it", folder, ", ".join(missing))
    if len(missing) == len(timed):
        names = ", ".join(scene.cameras.names[:3])
        raise InputError(
            f"{folder}: contains no film of the scene's cameras ({names}, ...); name films like the cameras"
        )
    return {name: recordings[name] for name in timed if name in recordings}


def read_films(
    scene: Scene, recordings: Mapping[str, Path], frames: int, resolution: int, masks: Path | None = None
) -> tuple[Cameras, list[Film]]:
    """Read recordings; return their cameras, at the resolution of the images, and the films.

    Films are read until `frames` after the release, with their label images from the folder `masks`. Raises InputError
    for a film without frames, or with more frames than label images.
    """
    cameras, starts = scene.cameras, scene.sequence.starts
    rows = [i for i, name in enumerate(cameras.names) if name in recordings]
    reduced = _reduced_cameras(cameras[rows], resolution)
    labelled = None if masks is None else find_film_masks(masks, scene, [cameras.names[row] for row in rows])
    films = []
    for row, size in zip(rows, reduced.sizes.tolist(), strict=True):
        name = cameras.names[row]
        last = math.ceil(starts[name] + frames) + 1
        pictures, labels = [], []
        files = labelled.of_film(name) if labelled else []
        for image, _ in read_recording(recordings[name], 2 * resolution):
            lens = Undistortion.of(cameras, row, (image.shape[1], image.shape[0]))
            view = resize(lens.image(image).float() / 255, *size)
            pictures.append((255 * view).round().to(torch.uint8))
            if files and len(pictures) > len(files):
                raise InputError(f"{files[0].parent}: contains {len(files)} label images, but {recordings[name]} "
                                 "has more "
                                 "frames; give one for each")  # fmt: skip
            if files:
                labels.append(labelled.read(files[len(labels)], cameras, row, size))
            if len(pictures) > last:
                break
        if not pictures:
            raise InputError(f"{recordings[name]}: has no frames; remove it")
        films.append(Film(name, torch.stack(pictures), starts[name], torch.stack(labels) if labels else None))
    return reduced, films


def _reduced_cameras(cameras: Cameras, resolution: int) -> Cameras:
    """The cameras at reduced sizes that are multiples of MULTIPLE."""
    scale = (resolution / cameras.sizes.max(1).values).clamp_max(1.0)
    sizes = (cameras.sizes * scale[:, None] / MULTIPLE).round().long().clamp_min(1) * MULTIPLE
    ratio = sizes / cameras.sizes
    Ks = torch.stack([resize_K(K, float(x), float(y)) for K, (x, y) in zip(cameras.Ks, ratio, strict=True)])
    return replace(cameras, Ks=Ks, sizes=sizes, photos=None)
