"""The user's scale reference, since photos alone have no absolute scale."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from stages.core.errors import InputError

if TYPE_CHECKING:
    from stages.core.scene.cameras import Cameras

PATTERN = re.compile(r"(?:photos=(?P<first>[^,]+),(?P<second>.+?)\s+)?distance=(?P<distance>[0-9.eE+-]+)")
USAGE = (
    '"photos=FIRST.jpg,LAST.jpg distance=0.5" (from camera to camera) or "distance=0.6" (from the cameras to the '
    "objects), in metres"
)


@dataclass(frozen=True)
class ScaleReference:
    """A measured length: distance between the cameras of two photos, or median distance of cameras from the focus."""

    distance: float  # [m]
    photos: tuple[str, ...]  # two names, or empty

    def check(self, names: tuple[str, ...]) -> None:
        """Raise InputError unless its photos are in `names`."""
        absent = [name for name in self.photos if name not in names]
        if absent:
            raise InputError(
                f"--scale-reference: the scene has no camera of {', '.join(absent)}; name photos that were placed"
            )

    def in_scene_units(self, cameras: Cameras, camera_distance: float) -> float:
        """The same length in the units of the cameras; `camera_distance` is their median distance from the focus.

        Raises InputError if a photo has no camera or both were taken from nearly the same position.
        """
        from stages.core.geometry.cameras import centres

        if not self.photos:
            return camera_distance
        self.check(cameras.names)
        first, second = centres(cameras.viewmats)[[cameras.names.index(name) for name in self.photos]]
        length = float((first - second).norm())
        if length < 0.05 * camera_distance:
            raise InputError("--scale-reference: both photos were taken from nearly the same position; name two others")
        return length


def parse_scale(text: str) -> ScaleReference | None:
    """Parse the value of --scale-reference; None for an empty text, InputError for other forms."""
    if not text:
        return None
    if "object" in text and "photos" not in text:
        raise InputError(f"--scale-reference {text!r}: objects are not known before segmentation, and `ngff "
                         "segment` has "
                         f"the same option; here give {USAGE}")  # fmt: skip
    found = PATTERN.fullmatch(text.strip())
    try:
        distance = float(found["distance"])
    except (TypeError, ValueError) as error:
        raise InputError(f"--scale-reference {text!r}: give {USAGE}") from error
    if not 0 < distance < 1e5:
        raise InputError(f"--scale-reference {text!r}: the distance must be more than 0 and less than 100,000 m")
    return ScaleReference(distance, (found["first"], found["second"]) if found["first"] else ())
