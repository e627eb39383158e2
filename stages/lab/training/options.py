"""Options of `ngff-lab train`, `train-splatter` and `train-segmenter`."""

import math
from dataclasses import dataclass

from stages.core.errors import InputError

LOSSES = ("square", "scene", "axes", "relative")
OPTIMIZERS = ("adamw", "soap")
HORIZON_FRACTIONS = (0.35, 0.35, 0.3)  # of the budget, for three horizons


@dataclass(frozen=True)
class TrainOptions:
    """Budget, batches, loss and optimizer of a training run."""

    minutes: float = 20.0  # budget, validation included
    steps: int = 0  # budget in optimizer steps instead, when not 0: the same on every machine
    batch: int = 32  # scenes a step
    keypoints: int = 256  # of an object
    sparse_keypoints: int = 0  # keypoints of an object in every fourth step, for robustness to their number; 0: never
    lr: float = 1e-3  # peak learning rate
    horizons: str = "8,20,40"  # frames of a rollout, one phase each
    width: int = 0  # width of the network; 0: the model's own
    loss: str = "scene"  # one of rollout_loss.LOSSES
    optimizer: str = "adamw"  # one of state.OPTIMIZERS
    velocity_weight: float = 0.0  # time over which a velocity error counts as a position error [s]; 0: none
    gradient_discount: float = 0.9  # factor on a gradient per frame of backpropagation
    groups: str = "3_0..3_8"  # training files; the last scenes of the last are for validation
    compiled: bool = False  # compile a step first: takes minutes, then faster; for GPUs
    seed: int = 0
    device: str = "auto"
    checks: int = 24  # validations and checkpoints in the whole run

    def __post_init__(self):
        if self.minutes <= 0 or self.steps < 0 or min(self.batch, self.keypoints) < 1 or self.lr <= 0:
            raise InputError("--minutes, --batch, --keypoints and --lr must be positive, --steps at least 0")
        if not 0 <= self.sparse_keypoints <= self.keypoints:
            raise InputError(f"--sparse-keypoints {self.sparse_keypoints}: must be between 0 and --keypoints")
        if self.velocity_weight < 0:
            raise InputError(f"--velocity-weight {self.velocity_weight}: a time in seconds, or 0")
        if not 0 <= self.gradient_discount <= 1:
            raise InputError(f"--gradient-discount {self.gradient_discount}: must be between 0 and 1")
        if self.loss not in LOSSES:
            raise InputError(f"--loss {self.loss}: choose from {', '.join(LOSSES)}")
        if self.optimizer not in OPTIMIZERS:
            raise InputError(f"--optimizer {self.optimizer}: choose from {', '.join(OPTIMIZERS)}")
        if min(self.frames) < 1:
            raise InputError(f"--horizons takes frames, such as 8,20,40, not {self.horizons!r}")

    @property
    def frames(self) -> tuple[int, ...]:
        """The horizons as numbers. Raises InputError where they are none."""
        try:
            return tuple(int(word) for word in self.horizons.split(","))
        except ValueError as error:
            raise InputError(f"--horizons takes frames, such as 8,20,40, not {self.horizons!r}") from error

    def horizon(self, progress: float) -> int:
        """Frames of a rollout at this fraction of the budget."""
        n = len(self.frames)
        fractions = HORIZON_FRACTIONS
        ends = [sum(fractions[: i + 1]) if n == len(fractions) else (i + 1) / n for i in range(n)]
        return self.frames[min(sum(progress >= e for e in ends), n - 1)]

    def rate(self, progress: float) -> float:
        """Learning rate at this fraction of the budget: half a cosine down to a hundredth."""
        return self.lr * (0.01 + 0.99 * (1 + math.cos(math.pi * min(progress, 1.0))) / 2)


@dataclass(frozen=True)
class SplatterOptions:
    """Length, views, depth and optimizer of a training run."""

    steps: int = 20_000  # of the optimizer
    views: int = 4  # from which Gaussians are predicted in a step; one more is rendered
    side: int = 448  # longest side of an image [px]
    depth: str = "network"  # of the Gaussians: predicted by the network, or the true depth of rendered scenes ("given")
    width: int = 0  # 0: start from weights; else a small random network of this width, for trials
    lr: float = 1e-4  # peak learning rate
    seed: int = 0
    device: str = "auto"

    def __post_init__(self):
        if min(self.steps, self.views) < 1 or self.side < 14 or self.lr <= 0:
            raise InputError("--steps, --views and --lr must be positive, --side at least 14")
        if self.depth not in ("network", "given"):
            raise InputError(f"--depth {self.depth}: choose from network, given")
        if self.width % 16:
            raise InputError(f"--width {self.width}: must be a multiple of 16")


@dataclass(frozen=True)
class SegmenterTraining:
    """Settings of the training."""

    minutes: float = 30.0  # of the network; 0: its weights stay as they are
    steps: int = 0  # 0: as many as fit in `minutes`
    rate: float = 2e-3
    voxels: int = 14_000  # of a training crop
    batch: int = 1  # crops per step, of each process
    workers: int = 0  # processes that prepare crops; 0: the training process
    seed: int = 0
    device: str = "auto"
    widths: tuple[int, ...] = (32, 48, 64, 96)
    blocks: int = 2  # residual blocks of each level, down and up
    score_scenes: int = 200  # augmented examples whose candidates train the scores
    score_steps: int = 3000

    def __post_init__(self):
        if not (self.minutes >= 0 and self.rate > 0 and self.voxels >= 1000 and self.batch >= 1):
            raise InputError("--rate must be above 0, --minutes 0 or more, --voxels at least 1000, --batch at least 1")
