"""What a user can choose about rendering."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError

VIEWS = "novel | orbit | input:K | all | path.json"


@dataclass(frozen=True)
class RenderOptions:
    view: str = "novel"  # one of VIEWS; K counts from 0, or is a photo's name
    resolution: int = 640  # longest side of a view [px]; pictures of many views are about twice as wide
    fps: float | None = None  # frames per second; motion keeps its speed. By default the trajectory's
    background: str | None = None  # scene.ply, #rrggbb or a photo, in place of the scene's own
    depth: bool = False  # draw depth: colours in a video, 16 bit in a PNG
    ids: bool = False  # draw each object in its own flat colour
    show_forces: bool = False  # arrows where force prompts act
    frame: int | None = None  # stop the motion at this frame; -1 is the last
    side_by_side: bool = False  # several files in one picture, under the same camera
    device: str = "auto"

    def __post_init__(self):
        kind = self.view.partition(":")[0]
        if kind not in ("novel", "orbit", "all", "input") and not self.view.lower().endswith(".json"):
            raise InputError(f"--view {self.view}: choose from {VIEWS}")
        if kind == "input" and not self.view[6:]:
            raise InputError("--view input: say which camera, as in --view input:0 or --view input:IMG_12.jpg")
        if not 16 <= self.resolution <= 8192:
            raise InputError(f"--resolution {self.resolution}: the longest side must be 16 to 8192 pixels")
        if self.fps is not None and not 0 < self.fps <= 1000:
            raise InputError(f"--fps {self.fps}: give frames per second, above 0 and up to 1000")
        if self.depth and self.ids:
            raise InputError("--depth and --ids: choose one; a picture shows one or the other")
        if self.background is not None and self.background.startswith("#"):
            hex_colour(self.background)

    @property
    def label(self) -> str:
        """For the name of the file when the user gives none: novel, input_3, novel_depth."""
        view = Path(self.view).stem if self.view.lower().endswith(".json") else re.sub(r"\W+", "_", self.view)
        return view + "_depth" * self.depth + "_ids" * self.ids


def hex_colour(text: str) -> tuple[float, float, float]:
    """#rrggbb as RGB in 0..1."""
    if not re.fullmatch("#[0-9a-fA-F]{6}", text):
        raise InputError(f"--background {text}: a colour is written #rrggbb, such as #ffffff for white")
    red, green, blue = (int(text[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue
