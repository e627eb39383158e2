"""Options of a study."""

from dataclasses import dataclass

from stages.core.errors import InputError
from stages.core.options import option, seed_option


@dataclass(frozen=True)
class StudyOptions:
    """Size of a study; the defaults are those of the paper."""

    participants: int = option(61, "number of participants, each of whom gets one page")
    films: int = option(80, "number of films per page")
    seed: int = seed_option()

    def __post_init__(self):
        if self.participants < 1 or self.films < 1:
            raise InputError("--participants and --films must be 1 or more")
