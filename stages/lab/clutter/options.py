"""Options of `ngff-lab clutter`."""

from dataclasses import dataclass

from stages.core.errors import InputError
from stages.core.options import device_option, option, seed_option


@dataclass(frozen=True)
class ClutterOptions:
    """How many scenes, and what they are made of."""

    count: int = option(20, "number of scenes")
    first: int = option(0, "number of the first scene", min=0)
    views: int = option(12, "photos of each scene")
    size: int = option(512, "longest side of a photo [px]")
    observations: int = option(
        0, "write this many samples of a reconstruction-noise model per scene instead of photos; 0: write photos"
    )
    reconstruct: bool = option(
        False, "reconstruct the photos with their true cameras, and write the labelled result instead"
    )
    exact: bool = option(False, "write the true Gaussians, labelled, not photos")
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        if self.count < 1 or not 4 <= self.views <= 200 or not 64 <= self.size <= 4096 or self.observations < 0:
            raise InputError("--count 1 or more, --views 4 to 200, --size 64 to 4096, --observations 0 or more")
