"""What a user can choose about refinement."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError

# a completer takes (scene, object number, Sight, Support | None, options) and returns Gaussians to add
BACKENDS = {
    "close": "stages.refine.hull_completion:complete",
    "library": "stages.refine.library:complete",
    "diffsplat": "stages.refine.diffsplat:complete",
    "none": "stages.refine.hull_completion:nothing",
}


@dataclass(frozen=True)
class RefineOptions:
    completer: str = "close"  # a library chooses its own
    library: Path | None = None  # folder of whole objects, each a .ply or a folder with one
    photos: Path | None = None  # those the scene was made from, to show DiffSplat; by default drawn from the Gaussians
    weights: Path | None = None  # folder of DiffSplat's; by default looked for
    download: bool = False  # fetch those weights where they are not here
    keep_raw: bool = False  # of K objects, keep those without their completion as K + 1 to 2 K
    outliers: float = 3.0  # robust deviations beyond which a Gaussian is a floater; 0 keeps all
    background: bool = True  # fill the table under and behind objects
    resolution: int = 48  # cells along an object's longest side when its unseen sides are closed
    seed: int = 0
    device: str = "auto"

    def __post_init__(self):
        if self.completer == "library" and self.library is None:
            raise InputError("--completer library: name its folder with --library, such as `ngff-lab objects` writes")
        if self.completer != "diffsplat" and (self.photos or self.weights or self.download):
            raise InputError("--photos, --weights and --download are of --completer diffsplat: add that or leave them")
        if not 0 <= self.outliers < 1000:
            raise InputError(f"--outliers {self.outliers}: give 0 to keep all, or robust deviations such as 3")
        if not 8 <= self.resolution <= 96:
            raise InputError(f"--resolution {self.resolution}: must be 8 to 96 cells")

    @property
    def chosen(self) -> str:
        """The completer that the options ask for."""
        return "library" if self.library is not None and self.completer == "close" else self.completer
