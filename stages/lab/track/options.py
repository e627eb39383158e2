"""Options of `ngff-lab track`."""

from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError
from stages.core.options import device_option, option, seed_option


@dataclass(frozen=True)
class TrackOptions:
    """How films are read and what is written."""

    resolution: int = option(320, "longest side at which frames and renderings are compared [px]")
    frames: int = option(0, "number of frames to track from the release on; 0: until all objects are at rest")
    masks: Path | None = option(
        None, "folder that contains a folder of label images for each film, with one image per frame"
    )
    soft: str = option("", "names of the objects that deform, separated by commas; all others are tracked as rigid")
    keypoints: int = option(256, "number of keypoints per object in the trajectory")
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        if not 64 <= self.resolution <= 4096:
            raise InputError(f"--resolution {self.resolution}: the longest side must be 64 to 4096 pixels")
        if self.frames < 0 or not 8 <= self.keypoints <= 100_000:
            raise InputError("--frames must be 0 or more and --keypoints 8 to 100000")
