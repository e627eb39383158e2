"""What the user knows about the size of things: photos alone have no scale."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from stages.core.errors import InputError

if TYPE_CHECKING:
    from stages.core.scene.cameras import Cameras

PATTERN = re.compile(r"(?:photos=(?P<first>[^,]+),(?P<second>.+?)\s+)?distance=(?P<distance>[0-9.eE+-]+)")
USAGE = (
    '"photos=FIRST.jpg,LAST.jpg distance=0.5" (from camera to camera) or "distance=0.6" (from the cameras to what they '
    "look at), in metres"
)


@dataclass(frozen=True)
class ScaleReference:
    """A length that was measured: between the cameras of two photos, or from all cameras to what they look at."""

    distance: float  # [m]
    photos: tuple[str, ...]  # two names, or none

    def check(self, names: tuple[str, ...]) -> None:
        """Raises InputError unless the photos are among these."""
        absent = [name for name in self.photos if name not in names]
        if absent:
            raise InputError(f"--scale-reference: no camera found for {', '.join(absent)}; name photos that are used")

    def in_scene_units(self, cameras: Cameras, reach: float) -> float:
        """The same length in the units of the cameras; `reach` is their distance from what they look at."""
        from stages.core.geometry.cameras import centres

        if not self.photos:
            return reach
        self.check(cameras.names)
        first, second = centres(cameras.viewmats)[[cameras.names.index(name) for name in self.photos]]
        length = float((first - second).norm())
        if length < 0.05 * reach:
            raise InputError("--scale-reference: these two photos were taken from nearly the same place; name others")
        return length


def parse_scale(text: str) -> ScaleReference | None:
    """From the form of the command line; None for an empty text."""
    if not text:
        return None
    if "object" in text and "photos" not in text:
        raise InputError(f"--scale-reference {text!r}: objects are known only once segmented, and `ngff segment` has "
                         f"the same option; here give {USAGE}")  # fmt: skip
    found = PATTERN.fullmatch(text.strip())
    try:
        distance = float(found["distance"])
    except (TypeError, ValueError) as error:
        raise InputError(f"--scale-reference {text!r}: give {USAGE}") from error
    if not 0 < distance < 1e5:
        raise InputError(f"--scale-reference {text!r}: the distance must be more than 0 and less than 100,000 m")
    return ScaleReference(distance, (found["first"], found["second"]) if found["first"] else ())
