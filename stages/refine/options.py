"""Options of refinement, and the table of its completers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.core.backends import Backend, describe, with_weights
from stages.core.errors import InputError
from stages.core.options import check_types, device_option, download_option, option, photos_option, seed_option

# a completer takes (scene, object id, ObservedSpace, Support | None, RefineOptions) and returns Gaussians to add
BACKENDS = {
    "close": Backend("stages.refine.hull_completion:complete", "fill the unseen part of the object's convex hull"),
    "library": Backend("stages.refine.library:complete", "add unseen sides of the best match in --library"),
    "diffsplat": Backend(
        "stages.refine.diffsplat:complete", "generate the object with DiffSplat and register it to its visible part",
        find_weights="stages.refine.diffsplat:weights_file", package="diffusers", extra="diffsplat",
    ),
    "none": Backend("stages.refine.hull_completion:no_completion", "add nothing to objects"),
}  # fmt: skip
GENERATORS = with_weights(BACKENDS)
# an upscaler takes RefineOptions and returns a network whose `restore(image, prompt, seed)` adds detail, or None
UPSCALERS = {
    "none": Backend("stages.refine.upscale:no_upscaler", "use the photo's pixels"),
    "osediff": Backend(
        "stages.refine.upscale:osediff", "add detail with OSEDiff at 768 pixels",
        find_weights="stages.refine.upscale:weights_file", package="diffusers", extra="diffsplat",
    ),
}  # fmt: skip
MATCHERS = ("none", "aliked-lightglue")
WHOLE_OBJECTS = ("library", "diffsplat")  # completers that register a whole object
CONCURRENT = {"close", "none"}  # completers that run for several objects at once, since they only use the CPU


@dataclass(frozen=True)
class RefineOptions:
    """Parameters of refinement; raises InputError for values outside their range and for conflicting ones."""

    completer: str = option("close", describe(BACKENDS))
    library: Path | None = option(None, "folder of complete objects (.ply); the best match completes a partial object")
    photos: Path | None = photos_option(GENERATORS)
    weights: Path | None = option(None, f"for {GENERATORS}: folder of the weights; default: searched in $NGFF_WEIGHTS")
    download: bool = download_option(GENERATORS)
    upscale: str = option("none", f"for {GENERATORS}: super-resolution of the object's image; {describe(UPSCALERS)}")
    matcher: str = option("none", f"feature matcher to register complete objects with photos: {' | '.join(MATCHERS)}")
    keep_raw: bool = option(False, "also keep the K unrefined objects, with ids K+1 to 2K")
    outliers: float = option(
        3.0, "threshold for removing outlying Gaussians [robust standard deviations]; 0: keep all Gaussians"
    )
    background: bool = option(True, "fill the gaps in the table under and behind objects")
    resolution: int = option(48, "for completer close: number of voxels along an object's longest side")
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        check_types(self)
        if self.completer == "library" and self.library is None:
            raise InputError(
                "--completer library: needs --library, a folder of complete objects as written by `ngff-lab objects`"
            )
        if self.library is not None and self.chosen != "library":
            raise InputError(
                f"--library {self.library}: does not work with --completer {self.completer}; drop one of them"
            )
        if not self._is_generator and (self.photos or self.weights or self.download):
            raise InputError(
                f"--photos, --weights and --download only work with --completer {GENERATORS}; add it or drop them"
            )
        if self.upscale not in UPSCALERS:
            raise InputError(f"--upscale {self.upscale}: choose from {', '.join(UPSCALERS)}")
        if self.upscale != "none" and not self._is_generator:
            raise InputError(f"--upscale: only works with --completer {GENERATORS}; add it or drop it")
        if self.matcher not in MATCHERS:
            raise InputError(f"--matcher {self.matcher}: choose from {', '.join(MATCHERS)}")
        if self.matcher != "none" and self.chosen not in WHOLE_OBJECTS:
            raise InputError(f"--matcher: only works with --library or --completer {GENERATORS}; add it or drop it")
        if not 0 <= self.outliers < 1000:
            raise InputError(
                f"--outliers {self.outliers}: give 0 to keep all Gaussians, or a number of robust "
                "standard deviations below 1000, such as 3"
            )
        if not 8 <= self.resolution <= 96:
            raise InputError(f"--resolution {self.resolution}: must be 8 to 96 voxels")

    @property
    def _is_generator(self) -> bool:
        return self.completer in BACKENDS and bool(BACKENDS[self.completer].find_weights)

    @property
    def chosen(self) -> str:
        """Name of the completer that the options select."""
        return "library" if self.library is not None and self.completer == "close" else self.completer
