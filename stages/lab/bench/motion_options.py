"""Options of the benchmarks of motion, and of `ngff-lab replay` and `estimate-materials`."""

from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError
from stages.core.options import device_option, option, seed_option
from stages.lab.names import chosen_names
from stages.reconstruct.options import QUALITY_PRESETS
from stages.simulate.options import AUTO, ENGINES, SimulateOptions

FIT_KINDS = ("slide", "bounce", "collision", "soft")
FILM_KINDS = ("slide", "throw")


@dataclass(frozen=True)
class PhysicsBenchOptions:
    """Which experiments are run, with which engines."""

    only: str = option("", "experiments by group or pattern, such as slide,'boxes/0.3m*'; default: all")
    engines: tuple[str, ...] = option(("rigid", "mpm", "ngff"), "auto | rigid | mpm | ngff; repeatable", "--engine")
    quality: str = option("draft", "quality of MPM: draft | normal | high")
    keypoints: int = option(256, "keypoints per object", min=8)
    weights: Path | None = option(None, "weights of the learned engine; default: those in the package")
    contact: str = option(AUTO, "contacts of the engine ngff: auto | learned | solved")
    device: str = device_option()

    def __post_init__(self):
        unknown = [name for name in self.engines if name not in (AUTO, *ENGINES)]
        if unknown:
            raise InputError(f"--engine {unknown[0]}: choose from {', '.join((AUTO, *ENGINES))}")
        SimulateOptions(contact=self.contact)  # raises InputError for invalid values


@dataclass(frozen=True)
class DynamicsBenchOptions:
    """Scenes, keypoints and the optional MPM row."""

    keypoints: int = option(256, "keypoints per object")
    limit: int = option(0, "scenes of each split; 0: all")
    mpm: int = option(100, "scenes of each split to simulate for the row mpm-estimated; 0: omit that row")
    batch: int = 100  # scenes evaluated together
    seed: int = 0  # selects the scenes of the temporal split
    device: str = device_option()

    def __post_init__(self):
        if self.keypoints < 1 or self.batch < 1 or min(self.limit, self.mpm) < 0:
            raise InputError("--keypoints must be positive, --limit and --mpm at least 0")


@dataclass(frozen=True)
class AblationBenchOptions:
    """Length and data of each training."""

    steps: int = option(1500, "training steps of each ablation", min=1)
    batch: int = option(64, "scenes per training step", min=1)
    keypoints: int = option(256, "keypoints per object", min=1)
    horizons: str = option("8,20", "rollout length of each training phase [frames]")
    groups: str = option("3_0..3_8", "groups of scenes to train on")
    test: str = option("3_9", "group of scenes to test on")
    compiled: bool = option(False, "compile the training step first; for GPUs")
    seed: int = seed_option()
    device: str = device_option()


@dataclass(frozen=True)
class TrackBenchOptions:
    """Number and quality of the synthetic sequences that are tracked."""

    sequences: int = option(5, "number of sequences")
    first: int = option(0, "seed of the first sequence", min=0)
    width: int = option(240, "width of the videos [px]")
    frames: int = option(50, "frames of motion")
    quality: str = option(
        "",
        "track scenes reconstructed from the videos at this quality and segmented; default: true scenes",
        "--reconstructed",
    )
    device: str = device_option()

    def __post_init__(self):
        if self.sequences < 1 or self.frames < 20 or not 64 <= self.width <= 4096:
            raise InputError("--sequences must be 1 or more, --frames 20 or more and --width 64 to 4096")
        if self.quality and self.quality not in QUALITY_PRESETS:
            raise InputError(f"--reconstructed {self.quality}: choose from {', '.join(QUALITY_PRESETS)}")


@dataclass(frozen=True)
class FitBenchOptions:
    """Scenes, and how each is fitted."""

    scenes: int = option(20, "number of scenes", min=1)
    only: str = option("", "some of slide,bounce,collision,soft, alternating; default: all four")
    truth: str = option("", "engine of the motions; default: that which fits them")
    noise: float = option(0.002, "standard deviation of the tracks' errors [m]", min=0)
    evaluations: int = option(1500, "largest number of simulations of a scene", min=1)
    minutes: float = option(10.0, "longest time of a scene [min]", min=0)
    workers: int = option(2, "processes", min=1)
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        chosen_names(self.only, FIT_KINDS)
        if self.truth and self.truth not in ENGINES:
            raise InputError(f"--truth {self.truth}: choose from {', '.join(ENGINES)}")


@dataclass(frozen=True)
class FilmBenchOptions:
    """What is filmed, and how it is fitted."""

    scenes: int = option(6, "number of scenes")
    only: str = option("", "slide or throw; default: both, alternating")
    films: int = option(2, "films per scene")
    width: int = option(320, "width of the films [px]")
    frames: int = option(25, "frames of each film")
    workers: int = option(2, "processes", min=1)
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        chosen_names(self.only, FILM_KINDS)
        if not (1 <= self.films <= 16 and 64 <= self.width <= 4096 and self.frames >= 3 and self.scenes >= 1):
            raise InputError("--films must be 1 to 16, --width 64 to 4096, --frames 3 or more, --scenes 1 or more")


@dataclass(frozen=True)
class ReplayOptions:
    """Length and device of the run."""

    frames: int = option(0, "number of frames; 0: all of the recording")
    device: str = device_option()

    def __post_init__(self):
        if self.frames < 0:
            raise InputError("--frames must be 0 (all of the recording) or more")


@dataclass(frozen=True)
class EstimateOptions:
    """Model, frames shown, and number of attempts."""

    objects: str = option("", "names, such as duck,ball, or a scene.ply that has them; default: chosen by the model")
    model: str = option("", "name of a model that accepts images; default: $OPENAI_MODEL")
    timeout: float = option(120.0, "maximum waiting time for a reply [s]")
    frames: int = 10  # number of frames shown, evenly spaced
    longest: int = 512  # longest side of a frame as sent [px]
    tries: int = 3  # maximum number of replies
