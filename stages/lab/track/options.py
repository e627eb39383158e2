"""Options of `ngff-lab track`."""

from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError


@dataclass(frozen=True)
class TrackOptions:
    """How films are read and what is written."""

    resolution: int = 320  # longest side at which pictures are compared [px]
    frames: int = 0  # to track; 0: up to where the scene file says that everything rests
    masks: Path | None = None  # folder with a folder of label images for each film
    soft: str = ""  # names of objects that deform, separated by commas
    keypoints: int = 256  # per object, in the trajectory
    seed: int = 0  # of the keypoints
    device: str = "auto"

    def __post_init__(self):
        if not 64 <= self.resolution <= 4096:
            raise InputError(f"--resolution {self.resolution}: the longest side must be 64 to 4096 pixels")
        if self.frames < 0 or not 8 <= self.keypoints <= 100_000:
            raise InputError("--frames must be 0 or more and --keypoints 8 to 100000")
