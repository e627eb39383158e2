"""Options of `ngff-lab clutter`."""

from dataclasses import dataclass

from stages.core.errors import InputError


@dataclass(frozen=True)
class ClutterOptions:
    """How many scenes, and what they are made of."""

    count: int = 20
    first: int = 0  # number of the first scene, which decides its content together with the seed
    views: int = 12  # photos of each scene
    size: int = 512  # longest side of the photos [px]
    observations: int = 0  # by the noise model, in place of photos and the true scene; 0: photos to reconstruct
    reconstruct: bool = False  # write an observation of the reconstructed photos, in place of them and the true scene
    exact: bool = False  # write an observation of the true Gaussians, in place of photos
    seed: int = 0
    device: str = "auto"  # of the reconstruction

    def __post_init__(self):
        if self.count < 1 or not 4 <= self.views <= 200 or not 64 <= self.size <= 4096 or self.observations < 0:
            raise InputError("--count 1 or more, --views 4 to 200, --size 64 to 4096, --observations 0 or more")
