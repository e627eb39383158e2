"""Options of `ngff-lab train`, `train-splatter` and `train-segmenter`."""

import math
from dataclasses import dataclass

from stages.core.errors import InputError
from stages.core.options import device_option, option, seed_option

LOSSES = ("square", "scene", "axes", "relative")
OPTIMIZERS = ("adamw", "soap")
HORIZON_FRACTIONS = (0.35, 0.35, 0.3)  # fractions of the budget for three horizons; other numbers share it equally


@dataclass(frozen=True)
class TrainOptions:
    """Budget, batches, loss and optimizer of a training run."""

    minutes: float = option(20.0, "training time [min]")
    steps: int = option(0, "number of optimizer steps, instead of --minutes; 0: use --minutes")
    batch: int = option(32, "number of scenes per step")
    keypoints: int = option(256, "number of keypoints per object")
    sparse_keypoints: int = option(
        0, "number of keypoints per object in every fourth step; 0: --keypoints in all steps"
    )
    lr: float = option(1e-3, "maximum learning rate")
    horizons: str = option("8,20,40", "rollout length of each phase [frames]")
    width: int = option(
        0, "width of the network, which may exceed the width of the weights of --from; 0: the model's default"
    )
    loss: str = option(
        "scene",
        "loss: square: squared error | scene: RMSE per scene | axes: RMSE per object and axis | relative: "
        "as axes, divided by the amount of motion",
    )
    optimizer: str = option("adamw", "optimizer: adamw | soap (soap needs the extra train)")
    velocity_weight: float = option(
        0.0, "weight of velocity errors relative to position errors [s]; 0: ignore velocity errors"
    )
    gradient_discount: float = option(0.9, "factor by which the gradient is multiplied per frame of backpropagation")
    groups: str = option(
        "3_0..3_8",
        "groups to train on, also varied, solid, turned, meshes; the last 100 scenes are used for validation",
    )
    compiled: bool = option(False, "compile the training step first (only useful on GPUs)")
    seed: int = seed_option()
    device: str = device_option()
    checks: int = 24  # number of validations and checkpoints in the whole run

    def __post_init__(self):
        if self.minutes <= 0 or self.steps < 0 or min(self.batch, self.keypoints) < 1 or self.lr <= 0:
            raise InputError("--minutes, --batch, --keypoints and --lr must be positive, --steps at least 0")
        if not 0 <= self.sparse_keypoints <= self.keypoints:
            raise InputError(f"--sparse-keypoints {self.sparse_keypoints}: must be between 0 and --keypoints")
        if self.width < 0:
            raise InputError(f"--width {self.width}: must be 0 or more")
        if self.velocity_weight < 0:
            raise InputError(f"--velocity-weight {self.velocity_weight}: give a time in seconds, or 0")
        if not 0 <= self.gradient_discount <= 1:
            raise InputError(f"--gradient-discount {self.gradient_discount}: must be between 0 and 1")
        if self.loss not in LOSSES:
            raise InputError(f"--loss {self.loss}: choose from {', '.join(LOSSES)}")
        if self.optimizer not in OPTIMIZERS:
            raise InputError(f"--optimizer {self.optimizer}: choose from {', '.join(OPTIMIZERS)}")
        if min(self.frames) < 1:
            raise InputError(f"--horizons {self.horizons}: give numbers of frames, such as 8,20,40")

    @property
    def frames(self) -> tuple[int, ...]:
        """The horizons as numbers. Raises InputError if they cannot be parsed."""
        try:
            return tuple(int(word) for word in self.horizons.split(","))
        except ValueError as error:
            raise InputError(f"--horizons {self.horizons}: give numbers of frames, such as 8,20,40") from error

    def horizon(self, progress: float) -> int:
        """Rollout length at a fraction of the budget [frames]."""
        n = len(self.frames)
        fractions = HORIZON_FRACTIONS
        ends = [sum(fractions[: i + 1]) if n == len(fractions) else (i + 1) / n for i in range(n)]
        return self.frames[min(sum(progress >= e for e in ends), n - 1)]

    def rate(self, progress: float) -> float:
        """Learning rate at a fraction of the budget: cosine decay to a hundredth."""
        return self.lr * (0.01 + 0.99 * (1 + math.cos(math.pi * min(progress, 1.0))) / 2)


@dataclass(frozen=True)
class SplatterOptions:
    """Length, views, depth and optimizer of a training run of the splat head."""

    steps: int = option(20_000, "number of optimizer steps")
    views: int = option(4, "number of input views per step; one more view is rendered for the loss")
    side: int = option(448, "longest side of the images [px]")
    depth: str = option("network", "source of the Gaussians' depth: network | given (true depth, for scenes only)")
    width: int = option(
        0, "width of a small random network that is used instead of the weights, for tests; 0: use the weights"
    )
    lr: float = option(1e-4, "maximum learning rate")
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        if min(self.steps, self.views) < 1 or self.side < 14 or self.lr <= 0:
            raise InputError("--steps, --views and --lr must be positive, --side at least 14")
        if self.depth not in ("network", "given"):
            raise InputError(f"--depth {self.depth}: choose from network, given")
        if self.width < 0 or self.width % 16:
            raise InputError(f"--width {self.width}: must be a multiple of 16, or 0")


@dataclass(frozen=True)
class SegmenterTraining:
    """Settings of a training run of the segmentation network."""

    minutes: float = option(30.0, "training time of the network [min]; 0: train only the candidate scores")
    steps: int = option(0, "number of optimizer steps, instead of --minutes; 0: use --minutes")
    rate: float = option(2e-3, "maximum learning rate")
    voxels: int = option(14_000, "maximum number of voxels of a training crop")
    batch: int = option(1, "number of crops per step")
    workers: int = option(0, "number of processes that prepare crops; 0: the training process itself")
    seed: int = seed_option()
    device: str = device_option()
    widths: tuple[int, ...] = (32, 48, 64, 96)
    blocks: int = option(2, "number of residual blocks per level, in the encoder and in the decoder")
    score_scenes: int = option(200, "number of augmented scenes whose candidates train the scores")
    score_steps: int = 3000

    def __post_init__(self):
        if not (self.minutes >= 0 and self.rate > 0 and self.voxels >= 1000 and self.batch >= 1):
            raise InputError("--rate must be above 0, --minutes 0 or more, --voxels at least 1000, --batch at least 1")
        if min(self.steps, self.workers) < 0 or min(self.blocks, self.score_scenes) < 1:
            raise InputError("--steps and --workers must be 0 or more, --blocks and --score-scenes at least 1")
