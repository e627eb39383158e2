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

    only: str = option("", "experiments to run, by group or pattern, such as slide,'boxes/0.3m*'; default: all")
    engines: tuple[str, ...] = option(
        ("rigid", "mpm", "ngff"), "engine to measure: auto | rigid | mpm | ngff; repeatable", "--engine"
    )
    quality: str = option("draft", "quality of engine mpm: draft | normal | high")
    keypoints: int = option(256, "number of keypoints per object", min=8)
    weights: Path | None = option(None, "weights of the learned engine; default: the weights in the package")
    contact: str = option(AUTO, "contacts of engine ngff: auto | learned | solved")
    device: str = device_option()

    def __post_init__(self):
        unknown = [name for name in self.engines if name not in (AUTO, *ENGINES)]
        if unknown:
            raise InputError(f"--engine {unknown[0]}: choose from {', '.join((AUTO, *ENGINES))}")
        SimulateOptions(contact=self.contact)  # raises InputError for invalid values


@dataclass(frozen=True)
class DynamicsBenchOptions:
    """Scenes, keypoints and the optional MPM row."""

    keypoints: int = option(256, "number of keypoints per object")
    limit: int = option(0, "number of scenes of each split; 0: all")
    mpm: int = option(
        100, "number of scenes of each split that are simulated for the row mpm-estimated; 0: omit the row"
    )
    batch: int = 100  # scenes evaluated together
    seed: int = 0  # selects the scenes of the temporal split
    device: str = device_option()

    def __post_init__(self):
        if self.keypoints < 1 or self.batch < 1 or min(self.limit, self.mpm) < 0:
            raise InputError(
                "--keypoints, --limit and --mpm: --keypoints must be positive, --limit and --mpm at least 0"
            )


@dataclass(frozen=True)
class AblationBenchOptions:
    """Length and data of each training."""

    steps: int = option(1500, "number of training steps of each ablation", min=1)
    batch: int = option(64, "number of scenes per training step", min=1)
    keypoints: int = option(256, "number of keypoints per object", min=1)
    horizons: str = option("8,20", "rollout length of each training phase [frames]")
    groups: str = option("3_0..3_8", "groups of scenes to train on")
    test: str = option("3_9", "group of scenes to test on")
    compiled: bool = option(False, "compile the training step first (only useful on GPUs)")
    seed: int = seed_option()
    device: str = device_option()


@dataclass(frozen=True)
class TrackBenchOptions:
    """Number and quality of the synthetic sequences that are tracked."""

    sequences: int = option(5, "number of sequences")
    first: int = option(0, "seed of the first sequence", min=0)
    width: int = option(240, "width of the videos [px]")
    frames: int = option(50, "number of frames of motion")
    quality: str = option(
        "",
        "track in scenes that are reconstructed from the videos at this quality and segmented; default: in true scenes",
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
    only: str = option("", "kinds of motion, which alternate: some of slide,bounce,collision,soft; default: all four")
    truth: str = option("", "engine that generates the motions; default: the engine suited to each kind")
    noise: float = option(0.002, "standard deviation of the errors of the tracks [m]", min=0)
    evaluations: int = option(1500, "maximum number of simulations per scene", min=1)
    minutes: float = option(10.0, "maximum time per scene [min]", min=0)
    workers: int = option(2, "number of processes", min=1)
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
    only: str = option("", "kind of motion: slide or throw; default: both, alternating")
    films: int = option(2, "number of films per scene")
    width: int = option(320, "width of the films [px]")
    frames: int = option(25, "number of frames of each film")
    workers: int = option(2, "number of processes", min=1)
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        chosen_names(self.only, FILM_KINDS)
        if not (1 <= self.films <= 16 and 64 <= self.width <= 4096 and self.frames >= 3 and self.scenes >= 1):
            raise InputError("--films must be 1 to 16, --width 64 to 4096, --frames 3 or more, --scenes 1 or more")


@dataclass(frozen=True)
class ReplayOptions:
    """Length and device of the run."""

    frames: int = option(0, "number of frames to simulate; 0: all frames of the recording")
    device: str = device_option()

    def __post_init__(self):
        if self.frames < 0:
            raise InputError("--frames must be 0 (all of the recording) or more")


@dataclass(frozen=True)
class EstimateOptions:
    """Model, frames shown, and number of attempts."""

    objects: str = option(
        "", "names of the objects, such as duck,ball, or a labelled scene.ply; default: chosen by the model"
    )
    model: str = option("", "name of a model that accepts images; default: $OPENAI_MODEL")
    timeout: float = option(120.0, "maximum waiting time for an answer [s]")
    frames: int = 10  # number of frames shown, evenly spaced
    longest: int = 512  # longest side of a frame as sent [px]
    tries: int = 3  # maximum number of replies
