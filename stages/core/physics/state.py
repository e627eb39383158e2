"""Output of a simulation engine for each frame."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from stages.core.scene.field_start import FieldStart


@dataclass(frozen=True)
class FrameState:
    """One frame of a rollout, in scene units."""

    positions: Float[Tensor, "p 3"]  # of the keypoints
    com: Float[Tensor, "o 3"]  # centre of mass of each object, in the order of scene.objects
    rotation: Float[Tensor, "o 4"]  # w x y z, relative to the rest pose
    mass: Float[Tensor, "o"] | None = None  # of each object [kg]; live sessions need it
    start: FieldStart | None = None  # initial state of the learned engine, in the first frame only
