"""Options of `ngff-lab fit`."""

import math
from dataclasses import dataclass

from stages.core.errors import InputError


@dataclass(frozen=True)
class MaterialFitOptions:
    """What is fitted, through which engine, and for how long."""

    engine: str = "auto"
    quality: str = "draft"  # of the MPM engine
    material: tuple[str, ...] = ()  # OBJECT=MATERIAL: initial values, kept where not identifiable
    align: bool = False  # the track is in another frame of reference than the scene
    rest: bool = True  # as that of `ngff simulate`: objects of photos are held until something disturbs them
    keypoints: int = 48  # of the track that are compared, for each object
    frames: int = 0  # of the motion; 0: all
    resolution: int = 320  # longest side to which films are reduced [px]
    noise: float = 0.0  # standard deviation of the track's errors [scene units]; 0: the residual of the fit
    evaluations: int = 1500  # largest number of simulations of the search
    minutes: float = 10.0  # longest time of the search [min]
    workers: int = 2  # processes
    seed: int = 0
    device: str = "auto"

    def __post_init__(self):
        if self.keypoints < 8 or self.evaluations < 1 or self.workers < 1 or self.frames < 0:
            raise InputError("--keypoints must be 8 or more, --evaluations and --workers 1 or more, --frames 0 or more")
        if not 64 <= self.resolution <= 4096:
            raise InputError(f"--resolution {self.resolution}: the longest side must be 64 to 4096 pixels")
        if not (0 <= self.noise < math.inf and self.minutes > 0):
            raise InputError("--noise must be 0 or more and --minutes positive")
