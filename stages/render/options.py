"""Options of the stage render, and the table of its output formats."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError
from stages.core.options import check_types, device_option, option
from stages.core.scene.formats import suffixes

VIEWS = "novel | orbit | input:K | all | path.json"

# suffix of the output -> "module:function" (path, Renderer) that writes it and returns the facts to be recorded next to
# the file. Image and video formats are those that stages/core/scene/formats.py can write.
OUTPUT_FORMATS = {
    **dict.fromkeys(suffixes("video", writable=True), "stages.render.video:write_video"),
    **dict.fromkeys(suffixes("image", writable=True), "stages.render.image:write_image"),
    ".html": "stages.render.page:write_page",
    ".glb": "stages.render.splat_files:write_glb",
    ".spz": "stages.render.splat_files:write_spz",
    ".ply": "stages.render.ply_frames:write_ply_frames",
    **dict.fromkeys([".usdc", ".usda"], "stages.render.usd_file:write_usd"),
}


@dataclass(frozen=True)
class RenderOptions:
    """Options of the render stage."""

    view: str = option(
        "novel",
        f"camera: {VIEWS} (input:K: of photo K; all: of every photo)",
    )
    resolution: int = option(640, "longest side of the output [px]")
    fps: float | None = option(
        None, "frames per second, at unchanged speed of motion; default: as in the trajectory, 30 for a scene"
    )
    background: str | None = option(None, "scene.ply, colour #rrggbb or photo that replaces the scene's own background")
    depth: bool = option(False, "render depth instead of colour: colour-coded in MP4, 16 bits in PNG")
    ids: bool = option(False, "render each object in a flat colour, with its number and a legend")
    shadows: str = option("on", "soft shadows cast by objects that moved: on | off")
    show_forces: bool = option(False, "draw an arrow for each active force prompt")
    playable: bool = option(
        False,
        "with -o film.html: objects can be dragged, pushed and lifted in the page, which computes "
        "their motion (only for trajectories of --engine ngff --contact learned)",
    )
    frame: int | None = option(None, "render only this frame, counted from 0 (-1: the last); default: all frames")
    side_by_side: bool = option(False, "render several files next to each other in one image, with the same camera")
    device: str = device_option()

    def __post_init__(self):
        check_types(self)
        kind = self.view.partition(":")[0]
        if kind not in ("novel", "orbit", "all", "input") and not self.view.lower().endswith(".json"):
            raise InputError(f"--view {self.view}: choose from {VIEWS}")
        if kind == "input" and not self.view[6:]:
            raise InputError(
                "--view input: the camera is missing; write --view input:0 or --view input:IMG_12.jpg, for example"
            )
        if not 16 <= self.resolution <= 8192:
            raise InputError(f"--resolution {self.resolution}: the longest side must be 16 to 8192 pixels")
        if self.fps is not None and not 0 < self.fps <= 1000:
            raise InputError(f"--fps {self.fps}: must be above 0 and at most 1000 frames per second")
        if self.depth and self.ids:
            raise InputError("--depth and --ids: cannot be combined; give only one of them")
        if self.shadows not in ("on", "off"):
            raise InputError(f"--shadows {self.shadows}: choose from on | off")
        if self.background is not None and self.background.startswith("#"):
            hex_colour(self.background)

    @property
    def label(self) -> str:
        """Part of the default output name: novel, input_3, novel_depth."""
        view = Path(self.view).stem if self.view.lower().endswith(".json") else re.sub(r"\W+", "_", self.view)
        return view + "_depth" * self.depth + "_ids" * self.ids


def hex_colour(text: str) -> tuple[float, float, float]:
    """Parse #rrggbb to RGB in 0..1. Raises InputError for other texts."""
    if not re.fullmatch("#[0-9a-fA-F]{6}", text):
        raise InputError(f"--background {text}: a colour is written #rrggbb, such as #ffffff for white")
    red, green, blue = (int(text[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue
