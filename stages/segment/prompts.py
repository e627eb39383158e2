"""The user's prompts: a box or a point for each object in the first view."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.scene.cameras import MAX_SIDE, Cameras
from stages.core.scene.files import must_exist
from stages.core.scene.lens import Undistortion, photo_of
from stages.core.scene.schema import MAX_OBJECT_ID, numbers, read_json, reason, rows, texts, whole


@dataclass(frozen=True)
class ObjectPrompts:
    """Prompts with one row per object; boxes or points may be None, but not both."""

    boxes: Float[Tensor, "o 4"] | None  # x0 y0 x1 y1 [px] of the undistorted view 0
    points: Float[Tensor, "o 2"] | None  # x y inside the object [px] of the undistorted view 0
    names: tuple[str, ...]


def read_prompts(path: Path, cameras: Cameras, undistorted: bool = False) -> ObjectPrompts:
    """Read a prompts.json: {"bbox": [[x0, y0, x1, y1]..], "center_point": [[u, v]..], "text": [..]}.

    This is the public format; "bbox" or "center_point" may be absent or empty. Coordinates refer to the first photo as
    taken, or to its undistorted view with `undistorted`. If that image was resized, "size": [width, height] is its
    size. Raises InputError for an invalid file.
    """
    must_exist(path, "a prompts.json with bbox or center_point, and text")
    try:
        data = read_json(path)
        boxes, points = _table(data, "bbox", 4), _table(data, "center_point", 2)
        count = len(boxes) or len(points)
        size = numbers(data.get("size") or photo_of(cameras, 0, undistorted)[1], 2, "size", 1, MAX_SIDE)
        width, height = (whole(side, "size", 1, MAX_SIDE) for side in size)
        names = texts(data.get("text") or [f"object_{i + 1}" for i in range(count)], "text")
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RuntimeError, IndexError) as error:
        raise _wrong(path, reason(error)) from error
    if not count:
        raise _wrong(path, "neither a bbox nor a center_point")
    if {len(boxes), len(points), len(names)} - {0, count}:
        raise InputError(f"{path}: {len(boxes)} boxes, {len(points)} points and {len(names)} names; give as many of "
                         "each, or of boxes or points none")  # fmt: skip
    if not bool((boxes[:, 2:] > boxes[:, :2]).all()):
        raise InputError(f"{path}: a box has no area; the order is x0, y0, x1, y1 in pixels of the first photo")
    try:
        lens = Undistortion.of(cameras, 0, (width, height), undistorted)
    except InputError as error:
        raise InputError(f"{path}: size of {error}") from error
    boxes, points = lens.boxes(boxes), lens.points(points)
    if not points.isfinite().all():
        raise InputError(f"{path}: a center_point is where the lens of {cameras.names[0]} shows nothing")
    return ObjectPrompts(boxes if len(boxes) else None, points if len(points) else None, names)


def _table(data: dict, name: str, width: int) -> Float[Tensor, "n w"]:
    """Rows of pixel coordinates; empty if the key is absent."""
    found = rows(data.get(name) or [], name)
    if len(found) > MAX_OBJECT_ID:
        raise ValueError(f"{name} has {len(found)} rows; at most {MAX_OBJECT_ID} are read")
    found = [found] if found and not isinstance(found[0], list) else found  # a single row without its brackets
    return torch.tensor([numbers(row, width, name, -1e6, 1e6) for row in found]).reshape(-1, width)


def _wrong(path: Path, what: str) -> InputError:
    return InputError(f'{path}: is not a prompts file ({what}); write {{"bbox": [[x0, y0, x1, y1]], "text": ["duck"]}}')
