"""The scene to render as a function of time: a trajectory or a scene at rest."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.physics.skinning import Skinning
from stages.core.scene.files import must_exist
from stages.core.scene.formats import FORMATS, suffixes
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.core.scene.trajectory import Trajectory

EXPECTED = "a trajectory (.h5) or a scene (.ply)"
STATIC_DURATION, STATIC_FPS = 4.0, 30.0  # duration [s] and frame rate [1/s] of a video in which only the camera moves


@dataclass(frozen=True)
class Animation:
    """Gaussians at any time from 0 to `duration` [s]."""

    scene: Scene
    trajectory: Trajectory | None = None
    frozen: int | None = None  # index of the only frame to render
    device: str = "cpu"  # on which the Gaussians of a trajectory are computed

    @property
    def is_moving(self) -> bool:
        """Whether the Gaussians change over time."""
        t = self.trajectory
        return t is not None and self.frozen is None and len(t) > 1 and (t.dense or bool(len(t.keypoints.rest)))

    @property
    def fps(self) -> float:
        """Stored frames per second; STATIC_FPS for a scene at rest."""
        return 1 / self.trajectory.info.dt if self.is_moving else STATIC_FPS

    @property
    def duration(self) -> float:
        """Time from the first stored frame to the last [s]."""
        return (len(self.trajectory) - 1) / self.fps if self.is_moving else 0.0

    def frame_times(self, fps: float | None) -> list[float]:
        """Times of the frames of a video [s]; without `fps`, those of the stored frames."""
        fps = fps or self.fps
        duration = self.duration if self.is_moving else STATIC_DURATION - 1 / fps
        return [i / fps for i in range(int(duration * fps + 1e-6) + 1)]

    def frame_index(self, time: float) -> float:
        """Fractional index of a time among the stored frames, rounded if it is a frame within rounding errors."""
        if not self.is_moving:
            return float(self.frozen or 0)
        index = min(time * self.fps, len(self.trajectory) - 1.0)
        return float(round(index)) if abs(index - round(index)) < 1e-4 else index

    def gaussians(self, time: float) -> Gaussians:
        """The Gaussians at `time` [s]: the nearest frame of a dense trajectory, else from interpolated keypoints."""
        if self.trajectory is None:
            return self.scene.gaussians
        if self.trajectory.dense:
            return self.trajectory.frame(round(self.frame_index(time)))
        return self._skinning(self.interpolate(time, self.trajectory.positions))

    @cached_property
    def _skinning(self) -> Skinning:
        return Skinning(self.scene.gaussians.to(self.device), self.trajectory.binding, self.trajectory.keypoints)

    def interpolate(self, time: float, values: Float[Tensor, "t *b"]) -> Float[Tensor, "*b"]:
        """Interpolate a stored series linearly at `time` [s]."""
        index = self.frame_index(time)
        first = int(index)
        last = min(first + 1, len(values) - 1)
        return values[first] if index == first else torch.lerp(values[first], values[last], index - first)


def open_animation(source: Path, frame: int | None = None, device: str = "cpu") -> Animation:
    """Read a trajectory or a scene, by its suffix; `frame` selects one frame of a trajectory (-1 is the last).

    Raises InputError for other suffixes and for a frame that does not exist.
    """
    source = Path(source)
    suffix = source.suffix.lower()
    if suffix not in suffixes("trajectory", "scene"):
        must_exist(source, EXPECTED)
        raise InputError(f"{source}: files with {f'suffix {suffix}' if suffix else 'no suffix'} cannot be rendered; "
                         f"give {EXPECTED}")  # fmt: skip
    if FORMATS[suffix].kind == "scene":
        if frame is not None:
            raise InputError(f"--frame {frame}: {source} is a scene, which has no frames; omit --frame")
        return Animation(FORMATS[suffix].read(source))
    trajectory = FORMATS[suffix].read(source)
    count = len(trajectory)
    if frame is not None and not -count <= frame < count:
        raise InputError(f"--frame {frame}: {source} has frames 0 to {count - 1} (or -1 for the last)")
    return Animation(trajectory.scene, trajectory, None if frame is None else frame % count, device)
