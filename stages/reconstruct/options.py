"""What a user can choose about reconstruction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError
from stages.reconstruct.scale import parse_scale

BACKENDS = {
    "classic": "stages.reconstruct.classic:reconstruct",
    "pi3": "stages.reconstruct.learned:pi3",
    "pi3-splat": "stages.reconstruct.learned:pi3_splat",
}
FEATURE_EXTRACTORS = {
    "sift": "stages.reconstruct.features:extract",
    "aliked-lightglue": "stages.reconstruct.features_learned:extract",
}
FEATURE_MATCHERS = {
    "sift": "stages.reconstruct.features:make_matcher",
    "aliked-lightglue": "stages.reconstruct.features_learned:make_matcher",
}
SINGLE_PHOTO_BACKENDS = {"pi3", "pi3-splat"}  # backends that one photo is enough for


@dataclass(frozen=True)
class QualityPreset:
    """What a word like "normal" stands for."""

    max_side: int  # longest side the photos are worked at [px]
    gaussians: int  # how many to start from
    iterations: int  # photometric steps on a CPU, each on one photo; many photos get up to twice as many
    iterations_cuda: int  # the same on a GPU
    degree: int  # of the spherical harmonics


QUALITY_PRESETS = {
    "draft": QualityPreset(max_side=512, gaussians=50_000, iterations=300, iterations_cuda=1000, degree=0),
    "normal": QualityPreset(max_side=640, gaussians=90_000, iterations=800, iterations_cuda=3000, degree=2),
    "high": QualityPreset(max_side=1024, gaussians=300_000, iterations=3000, iterations_cuda=3500, degree=3),
}


@dataclass(frozen=True)
class ReconstructOptions:
    backend: str = "classic"
    matcher: str = "sift"  # of photos, for the classic backend
    cameras: Path | None = None  # known cameras: a nerfstudio transforms.json or a COLMAP model folder
    holdout: int = 0  # keep every N-th photo out of the Gaussians and report on it; 0 keeps none out
    quality: str = "normal"
    resolution: int | None = None  # longest side the photos are worked at [px]; by default the quality's
    scale_reference: str = ""  # a measured length, as scale.parse_scale reads it; empty: the scale is chosen
    resume: bool = False  # go on from the finished steps of a run that was cut off
    weights: Path | None = None  # of pi3 and pi3-splat: a file, or a folder with one; by default looked for
    download: bool = False  # fetch those weights where they are not here
    iterations: int | None = None  # photometric steps; by default the quality's; 0 for none
    seed: int = 0
    device: str = "auto"

    def __post_init__(self):
        if self.matcher not in FEATURE_EXTRACTORS:
            raise InputError(f"--matcher {self.matcher}: choose from {', '.join(FEATURE_EXTRACTORS)}")
        if self.quality not in QUALITY_PRESETS:
            raise InputError(f"--quality {self.quality}: choose from {', '.join(QUALITY_PRESETS)}")
        if self.holdout < 0 or self.holdout == 1:
            raise InputError(f"--holdout {self.holdout}: give 0 for none, or 2 or more for every N-th photo")
        if self.resolution is not None and not 64 <= self.resolution <= 4096:
            raise InputError(f"--resolution {self.resolution}: the longest side must be 64 to 4096 pixels")
        parse_scale(self.scale_reference)
        if self.iterations is not None and self.iterations < 0:
            raise InputError(f"--iterations {self.iterations}: give 0 for none, or more")

    @property
    def preset(self) -> QualityPreset:
        return QUALITY_PRESETS[self.quality]

    @property
    def max_side(self) -> int:
        return self.resolution or self.preset.max_side

    def iteration_count(self, photos: int, device: str) -> int:
        """Photometric steps: fixed by quality, device and photo count, so that a seed gives the same scene again."""
        if self.iterations is not None:
            return self.iterations
        base = self.preset.iterations_cuda if device == "cuda" else self.preset.iterations
        return base * min(max(photos, 20), 40) // 20
