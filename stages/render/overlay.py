"""Drawn over pictures: arrows where forces act, times, and many pictures in one."""

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

INK, EDGE = (255, 122, 20), (40, 20, 0)  # of arrows, RGB
LENGTH = 1.6  # of the arrow of the largest force, in radii of its object

Image = Float[Tensor, "h w 3"]


def force_arrows(footage: Animation, time: float) -> list[tuple[Tensor, Tensor]]:
    """Tail and tip in the world of every push that acts at a time, longest for the strongest push of all."""
    if footage.trajectory is None:
        return []
    time = footage.index(time) * footage.trajectory.info.dt
    pushes = [f for f in footage.trajectory.info.forces if f.get("kind", "force") == "force" and any(f["force"])]
    strongest = max((math.hypot(*f["force"]) for f in pushes), default=1.0)
    acting = [f for f in pushes if f["start"] <= time < (math.inf if f["end"] is None else f["end"])]
    return [_arrow(footage, time, f, strongest) for f in acting]


def _arrow(footage: Animation, time: float, push: dict, strongest: float) -> tuple[Tensor, Tensor]:
    """From where the push acts: the centre of mass, or a point of the object at rest that has moved along."""
    trajectory = footage.trajectory
    row = [o.id for o in footage.scene.objects].index(push["object_id"])
    mine = trajectory.keypoints.object_id == push["object_id"]
    rest = trajectory.keypoints.rest[mine]
    tail = com = footage.at(time, trajectory.com)[row]
    if push.get("at") is not None:
        shift = (trajectory.positions[0, mine] - rest).mean(0)  # a lift: where the film starts is not where it rested
        arm = torch.tensor(push["at"]) - (trajectory.com[0, row] - shift)
        tail = com + matrix(footage.at(time, trajectory.rotation)[row]) @ arm
    return tail, tail + LENGTH * robust_box(rest).radius / strongest * torch.tensor(push["force"])


def draw_arrows(image: Image, cameras: Cameras, index: int, arrows: list[tuple[Tensor, Tensor]]) -> Image:
    """Over everything, since the point pushed is inside an object; those behind the camera are left out."""
    pixels = np.ascontiguousarray(to_bytes(image))
    viewmat, K = cameras.viewmats[index].cpu(), cameras.Ks[index].cpu()
    thick = max(1, round(max(image.shape[:2]) / 160))
    for arrow in arrows:
        points = torch.stack(arrow)
        if (depths(points, viewmat) <= 0).any():
            continue
        tail, tip = (tuple(round(16 * float(v)) for v in p) for p in project(points, viewmat, K))
        head = min(0.4, 5 * thick * 16 / max(math.dist(tail, tip), 1))
        for ink, width in ((EDGE, thick + 2), (INK, thick)):
            cv2.arrowedLine(pixels, tail, tip, ink, width, cv2.LINE_AA, shift=4, tipLength=head)
    return torch.from_numpy(pixels).float() / 255


def draw_caption(image: Image, text: str, below: bool = False) -> Image:
    """White on a dark label in the upper left corner, or in the lower left one."""
    pixels = np.ascontiguousarray(to_bytes(image))
    font, size = cv2.FONT_HERSHEY_SIMPLEX, max(max(image.shape[:2]) / 800, 0.4)
    (width, height), descent = cv2.getTextSize(text, font, size, 1)
    tall = height + descent + 8
    top = len(pixels) - tall if below else 0
    cv2.rectangle(pixels, (0, top), (width + 12, top + tall), (30, 30, 30), cv2.FILLED)
    cv2.putText(pixels, text, (6, top + height + 6), font, size, (255, 255, 255), 1, cv2.LINE_AA)
    return torch.from_numpy(pixels).float() / 255


def grid_columns(count: int) -> int:
    """How many pictures to put side by side."""
    return math.ceil(count**0.5)


def tile_images(images: list[Float[Tensor, "_ _ 3"]], columns: int) -> Float[Tensor, "h2 w2 3"]:
    """Row by row on white; smaller pictures stand in the middle of their cell."""
    height, width = (max(image.shape[i] for image in images) for i in (0, 1))
    rows = math.ceil(len(images) / columns)
    sheet = torch.ones(rows * height, columns * width, 3)
    for i, image in enumerate(images):
        h, w = image.shape[:2]
        y, x = i // columns * height + (height - h) // 2, i % columns * width + (width - w) // 2
        sheet[y : y + h, x : x + w] = image
    return sheet
