"""Options of the benchmarks of time and memory."""

from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError


@dataclass(frozen=True)
class MpmBenchOptions:
    """Problem sizes; a batch is `scenes` copies of one scene."""

    device: str = "auto"
    particles: tuple[int, ...] = (6_144, 20_000, 250_000)
    scenes: int = 0  # 0: as many as suit the device
    frames: int = 10  # timed, after three of warm-up

    def __post_init__(self):
        if self.frames < 1 or self.scenes < 0 or not all(100 <= p <= 2_000_000 for p in self.particles):
            raise InputError("--frames at least 1, --scenes at least 0, --particles 100 to 2,000,000")


@dataclass(frozen=True)
class RasterBenchOptions:
    """Repetitions and problem size."""

    repeat: int = 15  # timed calls of each, of which the fastest counts
    shrink: int = 1  # divides the numbers of Gaussians and pixels

    def __post_init__(self):
        if not 1 <= self.repeat <= 1000 or not 1 <= self.shrink <= 100:
            raise InputError("--repeat 1 to 1000, --shrink 1 to 100")


@dataclass(frozen=True)
class Pi3BenchOptions:
    """Numbers of views, image size and repetitions."""

    device: str = "auto"
    views: tuple[int, ...] = (1, 8, 20, 50)
    size: int = 448  # side of the square photos [px]
    repeat: int = 3  # timed forward passes of each
    splats: bool = False  # with the Gaussian head

    def __post_init__(self):
        from stages.core.models.pi3.dinov2 import PATCH  # imports PyTorch, which --help does not wait for

        if self.size < PATCH or self.size % PATCH or self.repeat < 1 or min(self.views, default=0) < 1:
            raise InputError(f"--size must be a multiple of {PATCH}, --views and --repeat at least 1")


@dataclass(frozen=True)
class RolloutBenchOptions:
    """Model and size of the rollouts."""

    weights: Path | None = None  # of our force field; None: the shipped ones
    objects: int = 3  # of a scene
    keypoints: int = 2048  # of an object
    steps: int = 100
    scenes: tuple[int, ...] = ()  # batch sizes; empty: 1 and, on a GPU, 64
    repeat: int = 5  # timed rollouts, of which the median counts
    device: str = "auto"

    def __post_init__(self):
        if min((self.objects, self.keypoints, self.steps, self.repeat, *self.scenes)) < 1:
            raise InputError("--objects, --keypoints, --steps, --scenes and --repeat must be at least 1")


@dataclass(frozen=True)
class ChainBenchOptions:
    """What is run."""

    quality: str = "normal"
    device: str = "auto"
    steps: int = 100  # frames of the film
    refine: bool = True
    repeat: int = 2  # runs in this process; the first one loads kernels
    commands: bool = True  # also run each stage as a command

    def __post_init__(self):
        if not 1 <= self.repeat <= 100:
            raise InputError(f"--repeat {self.repeat}: 1 to 100")


@dataclass(frozen=True)
class ChainTableOptions:
    """Which scenes are photographed, and how often each is run."""

    objects: tuple[int, ...] = (3, 6)
    photos: int = 20
    width: int = 448  # of the photos [px]
    quality: str = "normal"
    steps: int = 100  # frames of the film
    repeat: int = 2  # of which the last one counts: the first one loads kernels
    device: str = "auto"

    def __post_init__(self):
        if not 1 <= self.repeat <= 100 or self.photos < 4 or not 64 <= self.width <= 4096:
            raise InputError("--repeat must be 1 to 100; photos 4 or more, of 64 to 4096 px")
