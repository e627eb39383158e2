"""The images that belong to a scene's cameras: its photos or what was made of them, or the scene drawn."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.cameras import resize as resize_K
from stages.core.raster.rasterise import rasterise
from stages.core.scene.formats import IMAGE_SUFFIXES
from stages.core.scene.images import read_image
from stages.core.scene.scene import Scene

log = logging.getLogger(__name__)
SIDE = 1024  # longest side that a scene is drawn at [px]
PROPORTIONS = 0.03  # by which those of a photo and of what belongs to it may differ


@dataclass(frozen=True)
class ViewImages:
    """Pictures in the order of the cameras, made or read one at a time when they are asked for."""

    views: list[int]  # the camera of each
    image: Callable[[int], Float[Tensor, "h w 3"]]  # the picture of a camera, RGB in 0..1

    def __len__(self) -> int:
        return len(self.views)


def view_images(scene: Scene, photos: Path | None = None) -> ViewImages:
    """Those of the folder `photos` that the scene's cameras name, or one drawing for each camera.

    Memory holds one at a time. Raises InputError for a folder without them, and, when its turn comes, for a photo of
    other proportions than its camera.
    """
    if photos is None:
        return ViewImages(list(range(len(scene.cameras))), lambda view: render_view(scene, view))
    files = match_files(photos, scene.cameras.names, "photo", "--photos")
    return ViewImages(list(files), lambda view: _read(scene, view, files[view]))


def render_view(scene: Scene, view: int) -> Float[Tensor, "h w 3"]:
    """The scene as a camera sees it, before black."""
    width, height = scene.cameras.sizes[view].tolist()
    shrink = min(1.0, SIDE / max(width, height))
    w, h = max(1, round(width * shrink)), max(1, round(height * shrink))
    K = resize_K(scene.cameras.Ks[view], w / width, h / height)
    return rasterise(scene.gaussians, scene.cameras.viewmats[view][None], K[None], w, h).rgb[0].clamp(0, 1)


def _read(scene: Scene, view: int, file: Path) -> Float[Tensor, "h w 3"]:
    image = read_image(file)
    try:
        check_proportions(scene, view, image.shape[1], image.shape[0])
    except InputError as error:
        raise InputError(f"--photos: {error}; without --photos the scene is drawn instead") from error
    return image


def match_files(folder: Path, names: tuple[str, ...], what: str, option: str) -> dict[int, Path]:
    """The image that belongs to each camera, found by the photo's name up to its suffix.

    `what` the images are and the `option` that named the folder are for the error's sentence.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: is no folder; {option} takes a folder of {what}s named as the photos")
    images = {p.stem: p for p in sorted(folder.iterdir()) if p.suffix.lower() in IMAGE_SUFFIXES}
    found = {i: images[Path(name).stem] for i, name in enumerate(names) if Path(name).stem in images}
    if not found:
        raise InputError(
            f"{folder}: no {what} is named as a photo of the scene, such as {Path(names[0]).stem}.png"
            if names else f"{folder}: the scene remembers no photos"
        )  # fmt: skip
    if len(found) < len(names):
        log.info("%s: %ss for %d of %d photos", folder, what, len(found), len(names))
    return found


def check_proportions(scene: Scene, view: int, width: int, height: int) -> None:
    """Raises InputError where an image cannot be what a camera saw, at another size."""
    wide, high = scene.cameras.sizes[view].tolist()
    if abs(width / height / (wide / high) - 1) > PROPORTIONS:
        raise InputError(f"{scene.cameras.names[view]} is {width}x{height}, in the scene {wide}x{high}; they must "
                         "have the same proportions")  # fmt: skip
