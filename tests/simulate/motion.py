"""Motions of scenes in memory; data that an engine computes from a scene are cached for all tests that use it."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor, stack

from stages.core.backends import load
from stages.core.physics import forces
from stages.core.physics.keypoints import choose_keypoints
from stages.core.scene.field_start import FieldStart
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Keypoints
from stages.simulate.options import ENGINES, SimulateOptions


@dataclass(frozen=True)
class Motion:
    """Frames of a rollout in scene units; fields are named as in `Trajectory`."""

    keypoints: Keypoints
    positions: Float[Tensor, "t k 3"]
    com: Float[Tensor, "t o 3"]
    rotation: Float[Tensor, "t o 4"]
    field: FieldStart | None


def roll_out(scene: Scene, options: SimulateOptions) -> Motion:
    """The motion of a labelled scene that `ngff simulate` would write, with the engine given in the options."""
    keypoints = choose_keypoints(scene, options.keypoint_count, options.seed)
    prompts = forces.parse(scene.objects, options.force, options.pin, options.velocity, options.lift)
    rollout = load(ENGINES[options.engine].rollout)
    states = list(rollout(scene, keypoints, prompts, options))
    frames = (stack([getattr(s, name) for s in states]).cpu() for name in ("positions", "com", "rotation"))
    return Motion(keypoints, *frames, states[0].start)
