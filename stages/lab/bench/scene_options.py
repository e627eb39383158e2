"""Options of the benchmarks of scenes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.reconstruct.options import ReconstructOptions


@dataclass(frozen=True)
class ReconstructBenchOptions:
    """Options of the reconstruction."""

    quality: str = "normal"
    holdout: int = 8
    device: str = "auto"
    matcher: str = "sift"
    cameras_only: bool = False  # stop after the cameras, to compare matchers

    def key(self, folder: Path) -> str:
        """Name of a set's row in the results."""
        matcher = "" if self.matcher == "sift" else f", {self.matcher}"
        cameras = ", cameras" if self.cameras_only else ""
        return f"{folder.resolve().name}, {self.quality}, {pick_device(self.device)}{matcher}{cameras}"


@dataclass(frozen=True)
class AppearanceBenchOptions:
    """Options of the reconstruction."""

    quality: str = "high"
    holdout: int = 8
    models: Path | None = None  # cache of each set's cameras and sparse points; None: estimate them

    def __post_init__(self):
        if self.holdout < 2:
            raise InputError(f"--holdout {self.holdout}: give 2 or more, to hold out every N-th photo")
        self.reconstruction()

    def reconstruction(self) -> ReconstructOptions:
        """Options of `ngff reconstruct`."""
        return ReconstructOptions(quality=self.quality, holdout=self.holdout)


@dataclass(frozen=True)
class SegmentBenchOptions:
    """Scenes and methods; two scenes show all ten objects."""

    scenes: int = 4  # of each arrangement
    views: int = 24  # cameras of a scene
    weights: Path | None = None  # of SAM 2.1; None: the default locations
    device: str = "auto"  # of SAM 2.1
    reconstruct: bool = False  # also from rendered photos: minutes per scene

    def __post_init__(self):
        if not 1 <= self.scenes <= 100 or not 8 <= self.views <= 200:
            raise InputError("--scenes 1 to 100, --views 8 to 200")


@dataclass(frozen=True)
class SegmentPhotosOptions:
    """Where labels and ready scenes are."""

    labels: Path | None = None  # folder of label images, or of such folders named as the sets; default: SET/labels
    labelled: Path | None = None  # folder of labelled scenes SET.ply: used where present, otherwise made and kept there
    device: str = "auto"  # of the reconstruction


@dataclass(frozen=True)
class SegmentAblationOptions:
    """Length of the trainings."""

    steps: int = 1500
    voxels: int = 14_000
    batch: int = 4
    workers: int = 0
    seed: int = 0
    device: str = "auto"


@dataclass(frozen=True)
class SegmentAblationData:
    """Folders of scenes as `ngff-lab clutter --reconstruct` and `--exact` write; no scene may be in two of them."""

    train: Sequence[Path]  # with reconstructions, and the true Gaussians of the same scenes
    scores: Sequence[Path]
    judge: Sequence[Path]


@dataclass(frozen=True)
class RefineBenchOptions:
    """Number of scenes and of cameras of each."""

    scenes: int = 4
    views: int = 24

    def __post_init__(self):
        if not 1 <= self.scenes <= 100 or not 8 <= self.views <= 200:
            raise InputError("--scenes 1 to 100, --views 8 to 200")


@dataclass(frozen=True)
class RegisterBenchOptions:
    """Objects, number of trials and the damage to each part."""

    only: str = ""  # names separated by commas; empty: all ten objects
    trials: int = 10  # parts of each object
    missing: float = 0.4  # fraction of the surface
    noise: float = 0.01  # standard deviation of positions [diameters]
    tint: float = 0.02  # standard deviation of colours [0..1]
    seed: int = 0
    device: str = "auto"  # of the Gaussians


@dataclass(frozen=True)
class CompleteBenchOptions:
    """Scenes, noise and simulation of the benchmark."""

    scenes: tuple[str, ...] = ("panda,duck", "can,miku", "bowl,phone")  # objects of each scene
    known: str = ""  # objects of the library; empty: all ten
    thin: int = 2  # every n-th Gaussian of an object is used
    noise: float = 0.003  # standard deviation of positions [longest sides]
    frames: int = 40  # frames of motion
    lift: float = 0.2  # height that the objects are dropped from [m]
    seed: int = 0
