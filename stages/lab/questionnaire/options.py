"""Options of a study."""

from dataclasses import dataclass

from stages.core.errors import InputError


@dataclass(frozen=True)
class StudyOptions:
    """Size of a study; the defaults are those of the paper."""

    participants: int = 61
    films: int = 80  # shown to each participant
    seed: int = 0

    def __post_init__(self):
        if self.participants < 1 or self.films < 1:
            raise InputError("--participants and --films must be 1 or more")
