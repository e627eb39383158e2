"""Label images of film frames, made by any tool: which object each pixel shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Int16
from torch import Tensor

from stages.core.errors import InputError
from stages.core.scene.cameras import Cameras
from stages.core.scene.images import IGNORE_LABEL, list_photos, read_labels
from stages.core.scene.lens import Undistortion
from stages.core.scene.scene import Scene
from stages.segment.masks import read_names

UNKNOWN = -1  # label of pixels that the label images leave undefined


@dataclass(frozen=True)
class FilmMasks:
    """A folder with one folder of label images per film, with one image per frame, in the order of their names."""

    folder: Path
    rows: Mapping[int, int]  # object row for each number in the images
    ignored: frozenset[int]  # numbers that mark undefined pixels

    def of_film(self, name: str) -> list[Path]:
        """The label images of a film, from a folder named like it, with or without suffix; empty if there is none."""
        found = [self.folder / stem for stem in (name, Path(name).stem) if (self.folder / stem).is_dir()]
        return list_photos(found[0]) if found else []

    def read(self, file: Path, cameras: Cameras, view: int, size: tuple[int, int]) -> Int16[Tensor, "h w"]:
        """1 + object row in each pixel of a reduced view, 0 for other pixels, UNKNOWN where ignored.

        Raises InputError if the aspect ratio differs from that of the film, or if the image has none of the objects.
        """
        labels = read_labels(file)
        try:
            labels = Undistortion.of(cameras, view, (labels.shape[1], labels.shape[0])).labels(labels)
        except InputError as error:
            raise InputError(f"{file}: the label image of {error}") from error
        width, height = size
        y = ((torch.arange(height) + 0.5) * labels.shape[0] / height).long()
        x = ((torch.arange(width) + 0.5) * labels.shape[1] / width).long()
        numbers, index = labels[y[:, None], x].unique(return_inverse=True)
        values = [UNKNOWN if n in self.ignored else 1 + self.rows.get(n, -1) for n in numbers.tolist()]
        return torch.tensor(values, dtype=torch.int16)[index]


def find_film_masks(folder: Path, scene: Scene, films: list[str]) -> FilmMasks:
    """The label images of films. Numbers in the images are object ids of the scene, or map to names by names.json.

    Pixels of IGNORE_LABEL are unknown, unless an object has this number. Raises InputError if the folder has no label
    images for any of the films.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(
            f"{folder}: is not a folder; --masks takes a folder that contains a folder of label images for each film"
        )
    by_name, names = {o.name: row for row, o in enumerate(scene.objects)}, read_names(folder)
    rows = {o.id: row for row, o in enumerate(scene.objects)}
    rows |= {number: by_name[name] for number, name in names.items() if name in by_name}
    masks = FilmMasks(folder, rows, frozenset({IGNORE_LABEL} - rows.keys()))
    if not any(masks.of_film(name) for name in films):
        raise InputError(
            f"{folder}: contains no folder of label images named like a film, such as {Path(films[0]).stem}"
        )
    return masks
