"""Options of the benchmarks of time and memory."""

from dataclasses import dataclass
from pathlib import Path

from stages.core.errors import InputError
from stages.core.options import device_option, option


@dataclass(frozen=True)
class MpmBenchOptions:
    """Problem sizes; a batch is `scenes` copies of one scene."""

    device: str = device_option()
    particles: tuple[int, ...] = option((6_144, 20_000, 250_000), "number of particles per scene; repeatable")
    scenes: int = option(0, "number of scenes per batch; 0: chosen for the device")
    frames: int = option(10, "number of frames to time, of 200 substeps each")

    def __post_init__(self):
        if self.frames < 1 or self.scenes < 0 or not all(100 <= p <= 2_000_000 for p in self.particles):
            raise InputError(
                "--frames, --scenes and --particles: --frames must be at least 1, --scenes at least "
                "0, --particles 100 to 2,000,000"
            )


@dataclass(frozen=True)
class RasterBenchOptions:
    """Repetitions and problem size."""

    repeat: int = option(15, "number of timed calls of each kernel; the fastest is reported")
    shrink: int = option(1, "factor by which the numbers of Gaussians and pixels are reduced")

    def __post_init__(self):
        if not 1 <= self.repeat <= 1000 or not 1 <= self.shrink <= 100:
            raise InputError("--repeat and --shrink: --repeat must be 1 to 1000, --shrink 1 to 100")


@dataclass(frozen=True)
class Pi3BenchOptions:
    """Numbers of views, image size and repetitions."""

    device: str = device_option()
    views: tuple[int, ...] = option((1, 8, 20, 50), "number of photos per pass; repeatable")
    size: int = option(448, "side of the photos, a multiple of 14 [px]")
    repeat: int = option(3, "number of timed passes of each variant")
    splats: bool = option(False, "include the Gaussian head")

    def __post_init__(self):
        from stages.core.models.pi3.dinov2 import PATCH  # imports PyTorch, which would slow down --help

        if self.size < PATCH or self.size % PATCH or self.repeat < 1 or min(self.views, default=0) < 1:
            raise InputError(f"--size must be a multiple of {PATCH}, --views and --repeat at least 1")


@dataclass(frozen=True)
class RolloutBenchOptions:
    """Model and size of the rollouts."""

    weights: Path | None = option(
        None, "weights of the force field (.safetensors); default: the weights in the package"
    )
    objects: int = option(3, "number of objects of a scene, in piles of three")
    keypoints: int = option(2048, "number of keypoints of each object")
    steps: int = option(100, "number of 0.02 s steps")
    scenes: tuple[int, ...] = option((), "number of scenes per batch; repeatable; default: 1, on a GPU also 64")
    repeat: int = option(5, "number of timed rollouts; the median is reported")
    device: str = device_option()

    def __post_init__(self):
        if min((self.objects, self.keypoints, self.steps, self.repeat, *self.scenes)) < 1:
            raise InputError("--objects, --keypoints, --steps, --scenes and --repeat must be at least 1")


@dataclass(frozen=True)
class ChainBenchOptions:
    """Which stages are run, how, and how often."""

    quality: str = option("normal", "quality of the reconstruction: draft | normal | high")
    device: str = device_option()
    steps: int = option(100, "number of frames of the video", min=1)
    refine: bool = option(True, "complete the objects before they are simulated")
    repeat: int = option(2, "number of runs in one process; the first run also loads the kernels")
    commands: bool = option(True, "also run each stage as a command of its own")

    def __post_init__(self):
        if not 1 <= self.repeat <= 100:
            raise InputError(f"--repeat {self.repeat}: must be 1 to 100")


@dataclass(frozen=True)
class ChainTableOptions:
    """Which scenes are photographed, and how often each is run."""

    objects: tuple[int, ...] = (3, 6)
    photos: int = 20
    width: int = 448  # width of the photos [px]
    quality: str = option("normal", "quality of the reconstruction: draft | normal | high")
    steps: int = option(100, "number of frames of the video", min=1)
    repeat: int = option(2, "number of runs in one process; the first run also loads the kernels")
    device: str = device_option()

    def __post_init__(self):
        if not 1 <= self.repeat <= 100 or self.photos < 4 or not 64 <= self.width <= 4096:
            raise InputError("--repeat must be 1 to 100; the number of photos 4 or more, their size 64 to 4096 px")
