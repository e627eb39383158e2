"""Labels of objects: numbers drawn at their positions in an image, and a legend of numbers and names."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from stages.core.raster.rasterise import visibility
from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.images import to_bytes
from stages.core.scene.scene import SceneObject
from stages.render.draw import object_colours

FONT = cv2.FONT_HERSHEY_SIMPLEX
LEGEND_TEXT_SIZE = 0.45  # scale of FONT in the legend
ROW_HEIGHT, MARGIN = 20, 6  # height of a row of the legend, and its margin [px]

Image = Float[Tensor, "h w 3"]


def visible_ids(gaussians: Gaussians, cameras: Cameras, index: int) -> Int[Tensor, "h w"]:
    """Object id of the Gaussian with the largest weight in each pixel; 0 for the background."""
    width, height = cameras.sizes[index].tolist()
    front = visibility(gaussians, cameras.viewmats[index], cameras.Ks[index], width, height).index
    ids = gaussians.object_id.to(front.device)[front.clamp_min(0).long()]
    return torch.where(front >= 0, ids, 0).cpu()


def label_position(mask: np.ndarray) -> tuple[int, int]:
    """Column and row of the pixel of a mask (h, w), not empty, that is nearest to its weighted centre.

    The weight of a pixel is its squared distance from the border, so that thin parts count little and the centre moves
    smoothly with the object.
    """
    border = cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    rows, columns = np.nonzero(mask)
    weight = border[rows, columns] ** 2
    y, x = np.average(rows, weights=weight), np.average(columns, weights=weight)
    nearest = int(np.argmin((rows - y) ** 2 + (columns - x) ** 2))
    return int(columns[nearest]), int(rows[nearest])


def draw_labels(image: Image, ids: Int[Tensor, "h w"], objects: Sequence[SceneObject]) -> Image:
    """Draw the number of each visible object at its position, with its name if that fits into the object's width."""
    pixels = np.ascontiguousarray(to_bytes(image))
    size = max(max(pixels.shape[:2]) / 800, 0.45)
    thickness = max(2, round(1.5 * size))
    for o in objects:
        mask = (ids == o.id).numpy()
        if not mask.any():
            continue
        text = f"{o.id} {o.name}"
        if cv2.getTextSize(text, FONT, size, thickness)[0][0] > np.ptp(np.nonzero(mask.any(0))[0]):
            text = str(o.id)
        _draw_text(pixels, text, label_position(mask), size, thickness)
    return torch.from_numpy(pixels).float() / 255


def _draw_text(pixels: np.ndarray, text: str, centre: tuple[int, int], size: float, thickness: int) -> None:
    """Draw white text with a black outline, which is readable on any colour; it is shifted to be inside the image."""
    (width, height), _ = cv2.getTextSize(text, FONT, size, thickness)
    left = min(max(centre[0] - width // 2, 2), max(pixels.shape[1] - width - 2, 0))
    bottom = min(max(centre[1] + height // 2, height + 2), len(pixels) - 3)
    letters = np.zeros(pixels.shape[:2], np.uint8)
    cv2.putText(letters, text, (left, bottom), FONT, size, 255, thickness, cv2.LINE_AA)
    outline = cv2.dilate(letters, np.ones((3, 3), np.uint8), iterations=max(1, round(2 * size)))
    for layer, value in ((outline, 0), (letters, 255)):
        pixels[:] = np.rint(pixels + (value - pixels.astype(np.float32)) * (layer[..., None] / 255))


def add_legend(image: Image, objects: Sequence[SceneObject]) -> Image:
    """Add a legend on the right of an image: colour, number and name of each object, in as many columns as needed."""
    if not objects:
        return image
    rows = max(1, (len(image) - MARGIN) // ROW_HEIGHT)
    texts = [f"{o.id} {o.name}" for o in objects]
    column = max(cv2.getTextSize(t, FONT, LEGEND_TEXT_SIZE, 1)[0][0] for t in texts) + 16 + 3 * MARGIN
    panel = np.full((len(image), -(-len(objects) // rows) * column, 3), 255, np.uint8)
    colours = to_bytes(object_colours(torch.tensor([o.id for o in objects]))[None])[0].tolist()
    for i, (text, colour) in enumerate(zip(texts, colours, strict=True)):
        left, top = i // rows * column + MARGIN, i % rows * ROW_HEIGHT + MARGIN
        cv2.rectangle(panel, (left, top), (left + 16, top + 14), colour, cv2.FILLED)
        cv2.putText(panel, text, (left + 16 + MARGIN, top + 12), FONT, LEGEND_TEXT_SIZE, (0, 0, 0), 1, cv2.LINE_AA)
    return torch.cat([image.cpu(), torch.from_numpy(panel).float() / 255], 1)
