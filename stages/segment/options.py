"""What a user can choose about segmentation."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError
from stages.segment.object_scale import parse_object_scale

BACKENDS = {
    "geometric": "stages.segment.geometric:segment",
    "masks": "stages.segment.masks:segment",
    "boxes": "stages.segment.boxes:segment",
    "sam2": "stages.segment.sam2:segment",
}


@dataclass(frozen=True)
class SegmentOptions:
    backend: str = "geometric"  # --masks chooses its own, and --boxes too, unless this is sam2
    masks: Path | None = None  # folder of label images, named as the photos: 0 background, 1... the objects
    boxes: Path | None = None  # prompts.json in the public format: boxes (for sam2 also points) in the first view
    photos: Path | None = None  # folder of those the scene was made from, to show sam2; by default the scene is drawn
    weights: Path | None = None  # of sam2: model.safetensors, its config.json beside it, or the folder of both
    download: bool = False  # fetch those weights where they are not here
    names: str = ""  # "1=duck,2=bowl" in place of the names found
    max_objects: int = 24
    min_size: float = 0.03  # of an object, along its longest side [distance of the cameras from what they look at]
    detail: float = 0.41  # how unlike two regions may be and still be one object; smaller gives more objects
    scale_reference: str = ""  # "object=1 height=0.12": a length that was measured [m]
    seed: int = 0
    device: str = "auto"

    def __post_init__(self):
        if self.masks is not None and self.boxes is not None:
            raise InputError("--masks and --boxes: give one of them")
        if self.backend == "sam2" and self.masks is not None:
            raise InputError("--backend sam2 makes masks itself; give no --masks, or leave --backend out")
        if self.backend != "sam2" and (self.photos or self.weights or self.download):
            raise InputError("--photos, --weights and --download are of --backend sam2: add that or leave them")
        if self.max_objects < 1:
            raise InputError(f"--max-objects {self.max_objects}: must be 1 or more")
        if not 0 < self.min_size < 1:
            raise InputError(f"--min-size {self.min_size}: must be between 0 and 1, such as 0.03")
        if not 0 < self.detail < 2:
            raise InputError(f"--detail {self.detail}: must be between 0 and 2, such as 0.4")
        self.renamed, parse_object_scale(self.scale_reference)  # noqa: B018 -- what is bad is found before work starts

    @property
    def chosen(self) -> str:
        """The backend that the options ask for."""
        if self.backend == "sam2":
            return "sam2"
        return "masks" if self.masks is not None else "boxes" if self.boxes is not None else self.backend

    @property
    def renamed(self) -> dict[int, str]:
        """Names by object number."""
        names = {}
        for part in filter(None, (p.strip() for p in self.names.split(","))):
            number, sign, name = part.partition("=")
            if not sign or not number.strip().isdecimal() or int(number) < 1 or not name.strip():
                raise InputError(f'--names {self.names}: {part!r} is not NUMBER=NAME; write "1=duck,2=bowl"')
            names[int(number)] = name.strip()
        return names
