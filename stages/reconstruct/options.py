"""Options of the reconstruct stage, its backends and quality presets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError
from stages.core.options import check_types, device_option, option, seed_option
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
UP_SIDES = ("top", "right", "bottom", "left")  # sides of photos that may be up
SYNCHRONISATIONS = ("motion", "audio")
SINGLE_PHOTO_BACKENDS = {"pi3", "pi3-splat"}  # backends that accept a single photo
MAX_ITERATIONS = 1_000_000  # other trainers take 7,000 to 30,000


@dataclass(frozen=True)
class QualityPreset:
    """Sizes and counts of a quality level."""

    max_side: int  # longest side of the views [px]
    gaussians: int  # initial number
    iterations: int  # of the photometric fit on a CPU, each on one photo; up to twice as many for many photos
    iterations_cuda: int  # of the photometric fit on a GPU
    degree: int  # of the spherical harmonics


QUALITY_PRESETS = {
    "draft": QualityPreset(max_side=512, gaussians=50_000, iterations=300, iterations_cuda=1000, degree=0),
    "normal": QualityPreset(max_side=640, gaussians=90_000, iterations=800, iterations_cuda=2000, degree=2),
    "high": QualityPreset(max_side=1024, gaussians=300_000, iterations=3000, iterations_cuda=3500, degree=3),
}


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """Options of `ngff reconstruct`; raises InputError for values out of range."""

    sequence: bool = option(
        False,
        "PHOTOS contains a video, or a folder of frames, of each of several fixed cameras: reconstruct "
        "the scene at the moment of release",
    )
    sync: str = option(
        "motion", "with --sequence: method that aligns the films in time: " + " | ".join(SYNCHRONISATIONS)
    )
    offsets: str = option(
        "", 'with --sequence, instead of --sync: frame number of one common moment in each film: "A.mp4=0,B.mp4=3.33"'
    )
    fps: float = option(50.0, "with --sequence: frame rate of folders of frames [frames/s]")
    backend: str = option("classic", "method of reconstruction: " + " | ".join(BACKENDS))
    matcher: str = option(
        "sift",
        "features that are matched between photos: "
        + " | ".join(FEATURE_EXTRACTORS)
        + "; aliked-lightglue also matches photos with little overlap",
    )
    cameras: Path | None = option(None, "known cameras: transforms.json or a COLMAP model folder; default: estimated")
    holdout: int = option(0, "hold out every N-th photo from the fit and report PSNR and SSIM on these photos; 0: none")
    quality: str = option("normal", "sizes and iterations of the reconstruction: " + " | ".join(QUALITY_PRESETS))
    resolution: int | None = option(None, "longest side to which photos are resized [px]; default: set by --quality")
    up: str = option(
        "auto", "side of the photos that is up: auto (detected from the table or floor) | top | right | bottom | left"
    )
    scale_reference: str = option(
        "",
        'known distance that sets the scale [m]: "photos=A.jpg,B.jpg distance=0.5" between two cameras, or '
        '"distance=0.6" from the cameras to the point that they look at',
    )
    resume: bool = option(
        False, "continue an interrupted run with the same photos and options after its last finished step"
    )
    weights: Path | None = option(
        None, "weights of pi3 or pi3-splat (.safetensors or .pth); default: searched in $NGFF_WEIGHTS and ~/.cache/ngff"
    )
    download: bool = option(
        False, "download missing weights of pi3 or pi3-splat (licence CC BY-NC; needs the extra hub)"
    )
    iterations: int | None = option(None, "steps of the photometric optimisation; 0: none; default: set by --quality")
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        check_types(self)
        if self.matcher not in FEATURE_EXTRACTORS:
            raise InputError(f"--matcher {self.matcher}: choose from {', '.join(FEATURE_EXTRACTORS)}")
        if self.backend == "classic" and (self.weights or self.download):
            raise InputError("--weights and --download: only work with --backend pi3 or pi3-splat; add it or drop them")
        if self.backend != "classic" and self.matcher != "sift":
            raise InputError(
                f"--matcher {self.matcher}: only works with --backend classic, not {self.backend}; drop one of the two"
            )
        if self.quality not in QUALITY_PRESETS:
            raise InputError(f"--quality {self.quality}: choose from {', '.join(QUALITY_PRESETS)}")
        if self.up not in ("auto", *UP_SIDES):
            raise InputError(
                f"--up {self.up}: choose auto, or the side of the photos that is up: {', '.join(UP_SIDES)}"
            )
        if self.holdout < 0 or self.holdout == 1:
            raise InputError(f"--holdout {self.holdout}: give 0 for none, or 2 or more for every N-th photo")
        if self.resolution is not None and not 64 <= self.resolution <= 4096:
            raise InputError(f"--resolution {self.resolution}: the longest side must be 64 to 4096 pixels")
        if self.sync not in SYNCHRONISATIONS:
            raise InputError(f"--sync {self.sync}: choose from {', '.join(SYNCHRONISATIONS)}")
        if not 0.1 <= self.fps <= 100_000:
            raise InputError(f"--fps {self.fps:g}: give a frame rate from 0.1 to 100000 frames per second")
        if not self.sequence and (self.offsets or self.sync != "motion" or self.fps != type(self).fps):
            raise InputError("--sync, --offsets and --fps: only work with --sequence; add it or drop them")
        parse_scale(self.scale_reference)
        if self.iterations is not None and not 0 <= self.iterations <= MAX_ITERATIONS:
            raise InputError(f"--iterations {self.iterations}: give 0 for none, or up to {MAX_ITERATIONS}")

    @property
    def preset(self) -> QualityPreset:
        """The preset of the chosen quality."""
        return QUALITY_PRESETS[self.quality]

    @property
    def max_side(self) -> int:
        """Longest side of the views [px]."""
        return self.resolution or self.preset.max_side

    def iteration_count(self, photos: int, device: str) -> int:
        """Iterations of the photometric fit; for reproducibility a function of quality, device and number of photos."""
        if self.iterations is not None:
            return self.iterations
        base = self.preset.iterations_cuda if device == "cuda" else self.preset.iterations
        return base * min(max(photos, 20), 40) // 20
