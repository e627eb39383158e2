"""Options of the benchmarks of motion, and of `ngff-lab replay` and `estimate-materials`."""

from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError
from stages.lab.names import chosen_names
from stages.reconstruct.options import QUALITY_PRESETS
from stages.simulate.options import AUTO, ENGINES, SimulateOptions

FIT_KINDS = ("slide", "bounce", "collision", "soft")
FILM_KINDS = ("slide", "throw")


@dataclass(frozen=True)
class PhysicsBenchOptions:
    """What is measured, with which engines."""

    only: str = ""  # groups or patterns of names, such as "slide,tower/3*"; empty: all
    engines: tuple[str, ...] = ("rigid", "mpm", "ngff")
    quality: str = "draft"  # of MPM
    keypoints: int = 256
    weights: Path | None = None  # of the learned engine
    contact: str = AUTO  # of the engine ngff
    device: str = "auto"

    def __post_init__(self):
        unknown = [name for name in self.engines if name not in (AUTO, *ENGINES)]
        if unknown:
            raise InputError(f"--engine {unknown[0]}: choose from {', '.join((AUTO, *ENGINES))}")
        SimulateOptions(contact=self.contact)  # raises for another


@dataclass(frozen=True)
class DynamicsBenchOptions:
    """Scenes, keypoints and the optional MPM row."""

    keypoints: int = 256  # of an object; a model gets no more than it was trained with
    limit: int = 0  # scenes of each split; 0: all
    mpm: int = 100  # scenes of each split for mpm-estimated, which simulates them; 0: no such row
    batch: int = 100  # scenes at once
    seed: int = 0  # of the temporal sample
    device: str = "auto"

    def __post_init__(self):
        if self.keypoints < 1 or self.batch < 1 or min(self.limit, self.mpm) < 0:
            raise InputError("--keypoints must be positive, --limit and --mpm at least 0")


@dataclass(frozen=True)
class AblationBenchOptions:
    """Length and data of each training."""

    steps: int = 1500
    batch: int = 64
    keypoints: int = 256
    horizons: str = "8,20"
    groups: str = "3_0..3_8"  # to train on; the last 100 scenes are for validation
    test: str = "3_9"  # group to score on
    compiled: bool = False
    seed: int = 0
    device: str = "auto"


@dataclass(frozen=True)
class TrackBenchOptions:
    """Which stand-ins are filmed and tracked."""

    sequences: int = 5
    first: int = 0  # seed of the first sequence
    width: int = 240  # of the films [px]
    frames: int = 50
    quality: str = ""  # at which scenes are reconstructed from their films; empty: the true scene is tracked
    device: str = "auto"

    def __post_init__(self):
        if self.sequences < 1 or self.frames < 20 or not 64 <= self.width <= 4096:
            raise InputError("--sequences must be 1 or more, --frames 20 or more and --width 64 to 4096")
        if self.quality and self.quality not in QUALITY_PRESETS:
            raise InputError(f"--reconstructed {self.quality}: choose from {', '.join(QUALITY_PRESETS)}")


@dataclass(frozen=True)
class FitBenchOptions:
    """Scenes, and how each is fitted."""

    scenes: int = 20  # of the kinds in turn
    only: str = ""  # some of FIT_KINDS, separated by commas; empty: all
    truth: str = ""  # engine of the motions; empty: that which fits them
    noise: float = 0.002  # of the track [m]
    evaluations: int = 1500
    minutes: float = 10.0  # for a scene
    workers: int = 2
    seed: int = 0
    device: str = "auto"

    def __post_init__(self):
        chosen_names(self.only, FIT_KINDS)
        if self.truth and self.truth not in ENGINES:
            raise InputError(f"--truth {self.truth}: choose from {', '.join(ENGINES)}")


@dataclass(frozen=True)
class FilmBenchOptions:
    """What is filmed, and how it is fitted."""

    scenes: int = 6  # of the kinds in turn
    only: str = ""  # some of FILM_KINDS; empty: both
    films: int = 2  # of each scene
    width: int = 320  # of the films [px]
    frames: int = 25
    workers: int = 2
    seed: int = 0  # of the first scene
    device: str = "auto"

    def __post_init__(self):
        chosen_names(self.only, FILM_KINDS)
        if not (1 <= self.films <= 16 and 64 <= self.width <= 4096 and self.frames >= 3 and self.scenes >= 1):
            raise InputError("--films must be 1 to 16, --width 64 to 4096, --frames 3 or more, --scenes 1 or more")


@dataclass(frozen=True)
class ReplayOptions:
    """Length and device of the run."""

    frames: int = 0  # of the recording, the first counted; 0: all
    device: str = "auto"

    def __post_init__(self):
        if self.frames < 0:
            raise InputError("--frames must be 0 (all of the recording) or more")


@dataclass(frozen=True)
class EstimateOptions:
    """Model, frames shown, and number of attempts."""

    objects: str = ""  # names separated by commas, or a scene.ply that holds them; empty: the model names the objects
    model: str = ""  # empty: OPENAI_MODEL
    timeout: float = 120.0  # of one request [s]
    frames: int = 10  # evenly spaced
    longest: int = 512  # longest side of a frame as sent [px]
    tries: int = 3  # replies, before giving up
