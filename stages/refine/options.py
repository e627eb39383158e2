"""What a user can choose about refinement."""

from __future__ import annotations

from dataclasses import dataclass

from stages.errors import InputError

# a completer takes (scene, object number, Sight, Support | None, options) and returns Gaussians to add
BACKENDS = {
    "close": "stages.refine.close:complete",
    "none": "stages.refine.close:nothing",
}


@dataclass(frozen=True)
class RefineOptions:
    completer: str = "close"
    outliers: float = 3.5  # robust deviations beyond which a Gaussian is a floater; 0 keeps all
    background: bool = True  # fill the table under and behind objects
    resolution: int = 48  # cells along an object's longest side when its unseen sides are closed
    seed: int = 0
    device: str = "auto"

    def __post_init__(self):
        if not 0 <= self.outliers < 1000:
            raise InputError(f"--outliers {self.outliers}: give 0 to keep all, or robust deviations such as 3.5")
        if not 8 <= self.resolution <= 96:
            raise InputError(f"--resolution {self.resolution}: must be 8 to 96 cells")
