"""Drawing on top of rendered images: force arrows, captions, and grids of images."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.geometry.cameras import depths, project
from stages.core.geometry.rotations import matrix
from stages.core.scene.cameras import Cameras
from stages.core.scene.images import to_bytes
from stages.render.animation import Animation
from stages.render.subject import robust_box

ARROW_COLOUR, OUTLINE_COLOUR = (255, 122, 20), (40, 20, 0)  # RGB
MAX_ARROW_LENGTH = 1.6  # length of the arrow of the largest force [radius of its object]

Image = Float[Tensor, "h w 3"]


def force_arrows(animation: Animation, time: float) -> list[tuple[Tensor, Tensor]]:
    """Start and end points (world) of the arrow of each force that acts at `time` [s], scaled by the largest force."""
    if animation.trajectory is None:
        return []
    time = animation.frame_index(time) * animation.trajectory.info.dt
    forces = [f for f in animation.trajectory.info.forces if f.get("kind", "force") == "force" and any(f["force"])]
    largest = max((math.hypot(*f["force"]) for f in forces), default=1.0)
    active = [f for f in forces if f["start"] <= time < (math.inf if f["end"] is None else f["end"])]
    return [_arrow(animation, time, f, largest) for f in active]


def _arrow(animation: Animation, time: float, force: dict, largest: float) -> tuple[Tensor, Tensor]:
    """The arrow of a force; it starts at the centre of mass, or at the point of application fixed to the object."""
    trajectory = animation.trajectory
    row = [o.id for o in animation.scene.objects].index(force["object_id"])
    own = trajectory.keypoints.object_id == force["object_id"]
    rest = trajectory.keypoints.rest[own]
    start = com = animation.interpolate(time, trajectory.com)[row]
    if force.get("at") is not None:
        shift = (trajectory.positions[0, own] - rest).mean(0)  # not 0 if the object was lifted before frame 0
        arm = torch.tensor(force["at"]) - (trajectory.com[0, row] - shift)
        start = com + matrix(animation.interpolate(time, trajectory.rotation)[row]) @ arm
    return start, start + MAX_ARROW_LENGTH * robust_box(rest).radius / largest * torch.tensor(force["force"])


def draw_arrows(image: Image, cameras: Cameras, index: int, arrows: list[tuple[Tensor, Tensor]]) -> Image:
    """Draw arrows (start, end) over the image, without occlusion; arrows behind the camera are omitted."""
    pixels = np.ascontiguousarray(to_bytes(image))
    viewmat, K = cameras.viewmats[index].cpu(), cameras.Ks[index].cpu()
    thickness = max(1, round(max(image.shape[:2]) / 160))
    for arrow in arrows:
        points = torch.stack(arrow)
        if (depths(points, viewmat) <= 0).any():
            continue
        start, end = (tuple(round(16 * float(v)) for v in p) for p in project(points, viewmat, K))
        head = min(0.4, 5 * thickness * 16 / max(math.dist(start, end), 1))
        for colour, width in ((OUTLINE_COLOUR, thickness + 2), (ARROW_COLOUR, thickness)):
            cv2.arrowedLine(pixels, start, end, colour, width, cv2.LINE_AA, shift=4, tipLength=head)
    return torch.from_numpy(pixels).float() / 255


def draw_caption(image: Image, text: str, below: bool = False) -> Image:
    """Draw white text on a dark label in the upper left corner, or in the lower left corner if `below`."""
    pixels = np.ascontiguousarray(to_bytes(image))
    font, size = cv2.FONT_HERSHEY_SIMPLEX, max(max(image.shape[:2]) / 800, 0.4)
    (width, height), descent = cv2.getTextSize(text, font, size, 1)
    label_height = height + descent + 8
    top = len(pixels) - label_height if below else 0
    cv2.rectangle(pixels, (0, top), (width + 12, top + label_height), (30, 30, 30), cv2.FILLED)
    cv2.putText(pixels, text, (6, top + height + 6), font, size, (255, 255, 255), 1, cv2.LINE_AA)
    return torch.from_numpy(pixels).float() / 255


def grid_columns(count: int) -> int:
    """Number of columns of an almost square grid of images."""
    return math.ceil(count**0.5)


def tile_images(images: list[Float[Tensor, "_ _ 3"]], columns: int) -> Float[Tensor, "h2 w2 3"]:
    """Arrange images in a grid, row by row on white; smaller images are centred in their cell."""
    height, width = (max(image.shape[i] for image in images) for i in (0, 1))
    rows = math.ceil(len(images) / columns)
    sheet = torch.ones(rows * height, columns * width, 3)
    for i, image in enumerate(images):
        h, w = image.shape[:2]
        y, x = i // columns * height + (height - h) // 2, i % columns * width + (width - w) // 2
        sheet[y : y + h, x : x + w] = image
    return sheet
