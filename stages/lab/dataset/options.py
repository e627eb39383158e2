"""What a user can choose about the data set."""

from __future__ import annotations

from dataclasses import dataclass

from stages.core.errors import InputError
from stages.lab.dataset.layout import PARTS, parse_backgrounds, parse_parts, parse_views
from stages.lab.dataset.object_particles import SUBSTEP, Discretisation
from stages.lab.dataset.scene_configs import parse_groups

PREREQUISITES = {  # of a part: what it is made from
    "motions": {"scene_configs"}, "scenes": {"scene_configs", "objects"}, "mpm": {"scene_configs", "objects"},
    "initial": {"scene_configs", "objects", "backgrounds"}, "dynamic": {"scene_configs", "objects", "backgrounds"},
}  # fmt: skip


@dataclass(frozen=True)
class DatasetOptions:
    """What decides the data."""

    groups: str = "3_0..3_9,4,6"
    only: str = "motions"  # parts
    frames: int = 100
    keypoints: int = 2048  # of each object
    dx: float = 0.02
    spacing: float = 0.009
    substep: float = SUBSTEP
    nudge: float = 0.0  # how far every object is put aside at first, to see how predictable the world is [m]
    exact: bool = False  # the same bytes in every run, also on a GPU
    views: str = "all"  # of the videos
    backgrounds: str = "all"
    resolution: int = 448  # of the videos [px]
    shard: str = "1/1"
    limit: int = 0  # scenes of each group; 0: all
    device: str = "auto"

    def __post_init__(self):
        parse_parts(self.only), parse_views(self.views), parse_backgrounds(self.backgrounds), parse_groups(self.groups)
        _shard(self.shard)
        if self.frames < 1 or self.keypoints < 1 or self.limit < 0:
            raise InputError("--frames and --keypoints must be positive, --limit at least 0")
        if not 0 <= self.nudge <= 0.02:
            raise InputError(f"--nudge {self.nudge}: from 0 to 0.02 m; scenes leave 0.05 between objects")
        if not 16 <= self.resolution <= 4096 or self.resolution % 2:
            raise InputError(f"--resolution {self.resolution}: an even number from 16 to 4096 pixels")

    @property
    def fineness(self) -> Discretisation:
        return Discretisation(self.dx, self.spacing, self.substep)

    @property
    def parts(self) -> tuple[str, ...]:
        """What is made, with what it is made from, in an order in which it can be."""
        asked = parse_parts(self.only)
        wanted = {*asked}.union(*(PREREQUISITES.get(part, set()) for part in asked))
        return tuple(p for p in PARTS if p in wanted)

    @property
    def cameras(self) -> tuple[int, ...]:
        return parse_views(self.views)

    @property
    def tables(self) -> tuple[str, ...]:
        return parse_backgrounds(self.backgrounds)

    @property
    def mine(self) -> list[str]:
        """The groups of this shard."""
        part, parts = _shard(self.shard)
        return parse_groups(self.groups)[part::parts]

    @property
    def repeatable(self) -> bool:
        """Scenes that are simulated one by one, whenever they are missing, have to come out the same."""
        return self.exact or bool({"mpm", "dynamic"} & {*self.parts})

    @property
    def settings(self) -> dict:
        """What all of a data set shares."""
        same = ("frames", "keypoints", "dx", "spacing", "substep", "nudge", "resolution")
        return {**{name: getattr(self, name) for name in same}, "exact": self.repeatable}


def _shard(text: str) -> tuple[int, int]:
    """ "2/5" -> (1, 5)."""
    part, slash, parts = text.partition("/")
    if not (slash and part.isdigit() and parts.isdigit() and 1 <= int(part) <= int(parts)):
        raise InputError(f"--shard {text}: write i/n with i from 1 to n, such as 2/5")
    return int(part) - 1, int(parts)
