"""What a user can choose about evaluation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError


@dataclass(frozen=True)
class EvaluateOptions:
    align: bool = False  # first bring the prediction into the truth's world, by shared cameras or else by objects
    frames: int | None = None  # compare only the first N frames; by default both must have the same number
    resample: bool = False  # interpolate the predicted motion at the truth's frame times
    objects: str = ""  # compare only these objects of the truth, by name: "duck,ball"; by default all
    report: Path | None = None  # also write an HTML page with curves and pictures

    def __post_init__(self):
        if self.frames is not None and self.frames < 1:
            raise InputError(f"--frames {self.frames}: give the number of frames to compare, 1 or more")
        if self.report is not None and Path(self.report).suffix.lower() not in (".html", ".htm"):
            raise InputError(f"--report {self.report}: the report is an HTML page; name it with .html")

    @property
    def object_names(self) -> list[str]:
        return [name.strip() for name in self.objects.split(",") if name.strip()]
