"""The background behind the objects: that of the scene, of another scene, a colour or a photo."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.scene.formats import IMAGE_SUFFIXES
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.images import read_image, resize
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.render.options import hex_colour

log = logging.getLogger(__name__)
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class RenderBackground:
    """The scene's own background Gaussians (`keep_scene`), or their replacement: `gaussians`, `photo` or `colour`."""

    keep_scene: bool = True
    gaussians: Gaussians | None = None
    photo: Float[Tensor, "h w 3"] | None = None
    colour: tuple[float, float, float] = WHITE

    def compose(self, g: Gaussians) -> Gaussians:
        """The Gaussians to render for the scene `g`; all of `g` if none of it belongs to an object."""
        objects = g if self.keep_scene or not (g.object_id > 0).any() else g[g.object_id > 0]
        return objects if self.gaussians is None else concatenate([self.gaussians.to(g.means.device), objects])

    def image(self, width: int, height: int) -> Float[Tensor, "h w 3"]:
        """Image behind all Gaussians: the colour, or the photo scaled to cover the image and centred."""
        if self.photo is None:
            return torch.tensor(self.colour).expand(height, width, 3)
        h, w = self.photo.shape[:2]
        factor = max(width / w, height / h)
        scaled = resize(self.photo, max(width, round(w * factor)), max(height, round(h * factor)))
        top, left = (scaled.shape[0] - height) // 2, (scaled.shape[1] - width) // 2
        return scaled[top : top + height, left : left + width]


def open_background(choice: str | None, scene: Scene) -> RenderBackground:
    """Open the background of --background; from another scene only Gaussians without an object are used.

    Raises InputError for other values.
    """
    if choice is None:
        return RenderBackground(colour=scene.background or WHITE)
    if choice.startswith("#"):
        return RenderBackground(keep_scene=False, colour=hex_colour(choice))
    suffix = Path(choice).suffix.lower()
    if suffix == ".ply":
        g = read_scene(Path(choice)).gaussians
        if (g.object_id == 0).any():
            g = g[g.object_id == 0]
        else:
            log.info("%s: all Gaussians belong to objects; the objects are used as background too", choice)
        return RenderBackground(keep_scene=False, gaussians=g)
    if suffix in IMAGE_SUFFIXES:
        return RenderBackground(keep_scene=False, photo=read_image(Path(choice)))
    raise InputError(f"--background {choice}: give a scene.ply, a colour such as #336699, or a photo")
