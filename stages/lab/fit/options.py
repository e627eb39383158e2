"""Options of `ngff-lab fit`."""

import math
from dataclasses import dataclass

from stages.core.errors import InputError
from stages.core.options import device_option, option, seed_option


@dataclass(frozen=True)
class MaterialFitOptions:
    """What is fitted, through which engine, and for how long."""

    engine: str = option("auto", "engine that simulates candidate materials: auto | rigid | mpm | ngff")
    quality: str = option("draft", "quality of engine mpm: draft | normal | high")
    material: tuple[str, ...] = option(
        (), "OBJECT=MATERIAL: initial material, whose values are kept if the motion does not determine them; repeatable"
    )
    align: bool = option(
        False, "align a track with a different frame of reference, by cameras or objects that it shares with the scene"
    )
    rest: bool = option(True, "objects of a scene of photos stay at rest until something acts on them")
    keypoints: int = option(48, "number of keypoints per object that are compared")
    frames: int = option(0, "number of frames of the motion to fit; 0: all")
    resolution: int = option(320, "longest side to which films are downscaled [px]")
    noise: float = option(0.0, "standard deviation of the track's errors [scene units]; 0: estimated from the track")
    evaluations: int = option(1500, "maximum number of simulations")
    minutes: float = option(
        10.0, "maximum time [min]; confidence intervals that would take longer are left undetermined"
    )
    workers: int = option(2, "number of processes")
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        if self.keypoints < 8 or self.evaluations < 1 or self.workers < 1 or self.frames < 0:
            raise InputError(
                "--keypoints must be 8 or more, --evaluations and --workers 1 or more, and --frames 0 or more"
            )
        if not 64 <= self.resolution <= 4096:
            raise InputError(f"--resolution {self.resolution}: the longest side must be 64 to 4096 pixels")
        if not (0 <= self.noise < math.inf and self.minutes > 0):
            raise InputError("--noise must be 0 or more and --minutes positive")
