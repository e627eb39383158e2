"""Options of `ngff-lab clutter`."""

from dataclasses import dataclass

from stages.core.errors import InputError
from stages.core.options import device_option, option, seed_option


@dataclass(frozen=True)
class ClutterOptions:
    """How many scenes, and what they are made of."""

    count: int = option(20, "number of scenes to generate")
    first: int = option(0, "number of the first scene", min=0)
    views: int = option(12, "number of photos of each scene")
    size: int = option(512, "longest side of a photo [px]")
    observations: int = option(
        0, "number of samples of a model of reconstruction noise to write per scene instead of photos; 0: write photos"
    )
    reconstruct: bool = option(
        False, "write labelled scenes, reconstructed from the photos with their true cameras, instead of photos"
    )
    exact: bool = option(False, "write the true Gaussians with labels instead of photos")
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        if self.count < 1 or not 4 <= self.views <= 200 or not 64 <= self.size <= 4096 or self.observations < 0:
            raise InputError(
                "--count must be 1 or more, --views 4 to 200, --size 64 to 4096 and --observations 0 or more"
            )
