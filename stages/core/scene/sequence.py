"""Timing of videos of a moving scene, filmed by several fixed cameras."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from stages.core.scene.schema import number, quote, whole

MAX_FRAMES = 10**6
RATES = 1e-3, 1e6  # lowest and highest frame rate [1/s]


@dataclass(frozen=True)
class FilmedSequence:
    """Timing of a motion, filmed by several fixed cameras, whose first frame is a scene."""

    fps: float  # frame rate of all videos [1/s]
    frames: int  # from the release to rest, the first being the release
    starts: dict[str, float]  # camera -> frame number of its video at the release, with a fraction

    def to_json(self) -> dict:
        """As stored in the header of scene.ply."""
        return asdict(self)


def read_sequence_json(value: object) -> FilmedSequence | None:
    """The inverse of `to_json`; None for None. Raises ValueError for wrong types and values."""
    if value is None:
        return None
    if not isinstance(value, dict) or not isinstance(value.get("starts"), dict):
        raise ValueError("sequence is not a JSON object with starts")
    starts = {quote(name, 255): number(start, f"the start of {quote(name, 40)}", -MAX_FRAMES, MAX_FRAMES)
              for name, start in value["starts"].items()}  # fmt: skip
    fps, frames = number(value["fps"], "fps of sequence", *RATES), value["frames"]
    return FilmedSequence(fps, whole(frames, "frames of sequence", 1, MAX_FRAMES), starts)
