"""Options of the benchmarks of scenes."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from stages.core.backends import pick_device
from stages.core.errors import InputError
from stages.core.options import device_option, option, seed_option
from stages.reconstruct.options import ReconstructOptions


@dataclass(frozen=True)
class ReconstructBenchOptions:
    """Quality and parts of the reconstruction."""

    quality: str = option("normal", "quality of the reconstruction: draft | normal | high")
    holdout: int = option(8, "hold out every N-th photo for evaluation", min=0)
    device: str = device_option()
    matcher: str = option("sift", "features that are matched between photos: sift | aliked-lightglue")
    cameras_only: bool = option(False, "stop after the cameras are estimated, to compare matchers")

    def key(self, folder: Path) -> str:
        """Key of a set's row in the results."""
        matcher = "" if self.matcher == "sift" else f", {self.matcher}"
        cameras = ", cameras" if self.cameras_only else ""
        return f"{folder.resolve().name}, {self.quality}, {pick_device(self.device)}{matcher}{cameras}"


@dataclass(frozen=True)
class AppearanceBenchOptions:
    """Quality of the reconstruction, and its held-out photos."""

    quality: str = option("high", "quality of the reconstruction: draft | normal | high")
    holdout: int = option(8, "hold out every N-th photo for evaluation")
    models: Path | None = option(None, "folder that caches cameras and sparse points between runs")

    def __post_init__(self):
        if self.holdout < 2:
            raise InputError(f"--holdout {self.holdout}: give 2 or more, to hold out every N-th photo")
        self.reconstruction()

    def reconstruction(self) -> ReconstructOptions:
        """The options of `ngff reconstruct`."""
        return ReconstructOptions(quality=self.quality, holdout=self.holdout)


@dataclass(frozen=True)
class SegmentBenchOptions:
    """Scenes and methods; two scenes together show all ten objects."""

    scenes: int = option(4, "number of scenes of each kind (separate objects, and objects in contact)")
    views: int = option(24, "number of cameras per scene")
    weights: Path | None = option(
        None, "weights of network backends; default: searched; backends without weights are skipped"
    )
    device: str = device_option()
    reconstruct: bool = option(
        False, "also segment scenes that are reconstructed from photos, by geometry and by the network"
    )

    def __post_init__(self):
        if not 1 <= self.scenes <= 100 or not 8 <= self.views <= 200:
            raise InputError("--scenes and --views: give 1 to 100 scenes and 8 to 200 views")


@dataclass(frozen=True)
class SegmentPhotosOptions:
    """Locations of label images and of scenes that are already segmented."""

    labels: Path | None = option(
        None,
        "for photo sets: folder of label images, or folder of such folders named like the sets; default: "
        "PHOTOSET/labels",
    )
    labelled: Path | None = option(
        None, "for photo sets: folder of labelled scenes PHOTOSET.ply; missing scenes are generated and kept there"
    )
    device: str = device_option()


@dataclass(frozen=True)
class SegmentAblationOptions:
    """Length and batch size of each training."""

    steps: int = option(1500, "number of training steps of each network", min=1)
    voxels: int = 14_000  # per crop
    batch: int = option(4, "number of crops per step", min=1)
    workers: int = option(0, "number of processes that prepare crops; 0: the training process itself", min=0)
    seed: int = seed_option()
    device: str = device_option()


@dataclass(frozen=True)
class SegmentAblationData:
    """Folders of scenes written by `ngff-lab clutter --reconstruct` and `--exact`; no scene may be in two of them."""

    train: Sequence[Path]  # reconstructions, and the true Gaussians of the same scenes
    scores: Sequence[Path]  # scenes for training the scores of candidates
    judge: Sequence[Path]  # scenes for evaluation


@dataclass(frozen=True)
class RefineBenchOptions:
    """Number of scenes and of cameras of each."""

    scenes: int = option(4, "number of scenes of separate objects")
    views: int = option(24, "number of cameras per scene")

    def __post_init__(self):
        if not 1 <= self.scenes <= 100 or not 8 <= self.views <= 200:
            raise InputError("--scenes and --views: give 1 to 100 scenes and 8 to 200 views")


@dataclass(frozen=True)
class RegisterBenchOptions:
    """Objects, number of trials and the damage to each part."""

    only: str = option("", "names of the objects to register, such as ball,duck; default: all ten")
    trials: int = option(10, "number of partial views of each object", min=1)
    missing: float = 0.4  # fraction of the surface that is removed
    noise: float = 0.01  # standard deviation of the noise of positions [diameters]
    tint: float = 0.02  # standard deviation of the noise of colours [0..1]
    seed: int = seed_option()
    device: str = device_option()


@dataclass(frozen=True)
class CompleteBenchOptions:
    """Scenes, noise and simulation of the benchmark."""

    scenes: tuple[str, ...] = option(
        ("panda,duck", "can,miku", "bowl,phone"),
        "names of the objects of a scene, separated by commas; repeatable",
        "--scene",
    )
    known: str = option("", "names of the objects in the library; default: all ten")
    thin: int = 2  # only every n-th Gaussian of an object is used
    noise: float = 0.003  # standard deviation of positions [object sizes]
    frames: int = 40  # simulated frames
    lift: float = 0.2  # drop height of the objects [m]
    seed: int = seed_option()
