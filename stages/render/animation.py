"""What there is to film: a trajectory or a scene at rest, asked for by time."""

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
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.trajectory import Trajectory, read_trajectory

WHAT = "a trajectory (.h5) or a scene (.ply)"
SECONDS, FPS = 4.0, 30.0  # of a film in which only the camera moves


@dataclass(frozen=True)
class Animation:
    """Gaussians at any time from 0 to `duration` [s]."""

    scene: Scene
    trajectory: Trajectory | None = None
    frozen: int | None = None  # the frame at which time stands still
    device: str = "cpu"  # where the Gaussians of a trajectory are moved

    @property
    def moves(self) -> bool:
        return self.trajectory is not None and self.frozen is None and len(self.trajectory) > 1

    @property
    def fps(self) -> float:
        return 1 / self.trajectory.info.dt if self.moves else FPS

    @property
    def duration(self) -> float:
        """From the first stored frame to the last [s]."""
        return (len(self.trajectory) - 1) / self.fps if self.moves else 0.0

    def times(self, fps: float | None) -> list[float]:
        """When the frames of a film are taken [s]; the trajectory's own frames at its own rate."""
        fps = fps or self.fps
        duration = self.duration if self.moves else SECONDS - 1 / fps
        return [i / fps for i in range(int(duration * fps + 1e-6) + 1)]

    def index(self, time: float) -> float:
        """Place among the stored frames; whole where it is one of them up to rounding."""
        if not self.moves:
            return float(self.frozen or 0)
        at = min(time * self.fps, len(self.trajectory) - 1.0)
        return float(round(at)) if abs(at - round(at)) < 1e-4 else at

    def gaussians(self, time: float) -> Gaussians:
        """Between two stored frames keypoints move straight; dense frames are taken as stored, the nearer one."""
        if self.trajectory is None:
            return self.scene.gaussians
        if self.trajectory.dense:
            return self.trajectory.frame(round(self.index(time)))
        return self._skinning(self.at(time, self.trajectory.positions))

    @cached_property
    def _skinning(self) -> Skinning:
        return Skinning(self.scene.gaussians.to(self.device), self.trajectory.binding, self.trajectory.keypoints)

    def at(self, time: float, values: Float[Tensor, "t *b"]) -> Float[Tensor, "*b"]:
        """Any stored series at a time, linear between frames."""
        index = self.index(time)
        first = int(index)
        last = min(first + 1, len(values) - 1)
        return values[first] if index == first else torch.lerp(values[first], values[last], index - first)


def open_animation(source: Path, frame: int | None = None, device: str = "cpu") -> Animation:
    """A trajectory or a scene, by the file's ending; `frame` stops a trajectory there (negative: from the end)."""
    source = Path(source)
    suffix = source.suffix.lower()
    if suffix not in (".h5", ".hdf5", ".ply"):
        must_exist(source, WHAT)
        raise InputError(f"{source}: {suffix or 'no ending'} is not a kind of file that can be rendered; give {WHAT}")
    if suffix == ".ply":
        if frame is not None:
            raise InputError(f"--frame {frame}: {source} is a scene at rest and has no frames; leave it out")
        return Animation(read_scene(source))
    trajectory = read_trajectory(source)
    count = len(trajectory)
    if frame is not None and not -count <= frame < count:
        raise InputError(f"--frame {frame}: {source} has frames 0 to {count - 1} (or -1 for the last)")
    return Animation(trajectory.scene, trajectory, None if frame is None else frame % count, device)
