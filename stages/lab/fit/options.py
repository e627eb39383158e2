"""Options of `ngff-lab fit`."""

import math
from dataclasses import dataclass

from stages.core.errors import InputError
from stages.core.options import device_option, option, seed_option


@dataclass(frozen=True)
class MaterialFitOptions:
    """What is fitted, through which engine, and for how long."""

    engine: str = option("auto", "engine that simulates the candidates: auto | rigid | mpm | ngff")
    quality: str = option("draft", "of --engine mpm: draft | normal | high")
    material: tuple[str, ...] = option(
        (), "OBJECT=MATERIAL: initial values, kept where the motion does not determine them; repeatable"
    )
    align: bool = option(False, "the track has another frame of reference: align it by shared cameras or objects")
    rest: bool = option(True, "objects of a scene of photos are at rest until something disturbs them")
    keypoints: int = option(48, "keypoints compared per object")
    frames: int = option(0, "frames of the motion; 0: all")
    resolution: int = option(320, "longest side to which films are reduced [px]")
    noise: float = option(0.0, "standard deviation of the track's errors [scene units]; 0: estimated from it")
    evaluations: int = option(1500, "largest number of simulations")
    minutes: float = option(10.0, "longest time [min]; intervals that it is too short for are not determined")
    workers: int = option(2, "processes")
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        if self.keypoints < 8 or self.evaluations < 1 or self.workers < 1 or self.frames < 0:
            raise InputError("--keypoints must be 8 or more, --evaluations and --workers 1 or more, --frames 0 or more")
        if not 64 <= self.resolution <= 4096:
            raise InputError(f"--resolution {self.resolution}: the longest side must be 64 to 4096 pixels")
        if not (0 <= self.noise < math.inf and self.minutes > 0):
            raise InputError("--noise must be 0 or more and --minutes positive")
