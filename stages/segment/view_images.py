"""Images of a scene's cameras: photos, images derived from photos, or renderings of the scene."""

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
from stages.core.scene.lens import Undistortion
from stages.core.scene.scene import Scene

log = logging.getLogger(__name__)
MAX_RENDER_SIDE = 1024  # longest side of a rendered view [px]


@dataclass(frozen=True)
class ViewImages:
    """Images in the order of the cameras, rendered or read one at a time on access."""

    views: list[int]  # camera index of each image
    image: Callable[[int], Float[Tensor, "h w 3"]]  # image of a camera index, RGB in 0..1

    def __len__(self) -> int:
        return len(self.views)


def view_images(scene: Scene, photos: Path | None = None, undistorted: bool = False) -> ViewImages:
    """The photos of the cameras in folder `photos`, undistorted; without a folder, a rendering for each camera.

    `undistorted`: the photos are undistorted already. Only one image is in memory at a time. Raises InputError for a
    folder without such photos and, on access, for a photo whose aspect ratio differs from that of its camera.
    """
    if photos is None:
        return ViewImages(list(range(len(scene.cameras))), lambda view: render_view(scene, view))
    files = match_files(photos, scene.cameras.names, "photo", "--photos")
    return ViewImages(list(files), lambda view: _read(scene, view, files[view], undistorted))


def render_view(scene: Scene, view: int) -> Float[Tensor, "h w 3"]:
    """Render the scene from a camera, on black."""
    width, height = scene.cameras.sizes[view].tolist()
    shrink = min(1.0, MAX_RENDER_SIDE / max(width, height))
    w, h = max(1, round(width * shrink)), max(1, round(height * shrink))
    K = resize_K(scene.cameras.Ks[view], w / width, h / height)
    return rasterise(scene.gaussians, scene.cameras.viewmats[view][None], K[None], w, h).rgb[0].clamp(0, 1)


def _read(scene: Scene, view: int, file: Path, undistorted: bool) -> Float[Tensor, "h w 3"]:
    image = read_image(file)
    try:
        return Undistortion.of(scene.cameras, view, (image.shape[1], image.shape[0]), undistorted).image(image)
    except InputError as error:
        raise InputError(f"--photos: {error}; without --photos the scene is rendered instead") from error


def match_files(folder: Path, names: tuple[str, ...], what: str, option: str) -> dict[int, Path]:
    """The image file of each camera, matched by the name of its photo a.jpg: a.png or a.jpg.png.

    `what` (the kind of image) and `option` (which names the folder) are for error messages. Raises InputError if there
    is no folder or no matching image.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: is not a folder; {option} takes a folder of {what}s named like the photos")
    images = {p.stem: p for p in sorted(folder.iterdir()) if p.suffix.lower() in IMAGE_SUFFIXES}
    named = {i: images.get(Path(name).stem, images.get(name)) for i, name in enumerate(names)}
    found = {i: file for i, file in named.items() if file}
    if not found:
        raise InputError(
            f"{folder}: contains no {what} named like a photo of the scene, such as {Path(names[0]).stem}.png"
            if names else f"{folder}: the scene does not state the names of its photos; give a scene written by "
                          "`ngff reconstruct`"
        )  # fmt: skip
    if len(found) < len(names):
        log.info("%s: %ss for %d of %d photos", folder, what, len(found), len(names))
    return found
