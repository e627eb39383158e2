"""Options of `ngff-lab dataset` and `heldout`."""

from __future__ import annotations

from dataclasses import dataclass

from stages.core.errors import InputError
from stages.core.options import device_option, option
from stages.lab.dataset.selection import (
    HELDOUT,
    MESHES,
    PARTS,
    ROTATED,
    SOLID,
    VARIED,
    parse_backgrounds,
    parse_groups,
    parse_parts,
    parse_views,
)

FRAME_INTERVAL, SUBSTEP = 0.02, 1e-4  # time steps as published [s]
PREREQUISITES = {  # parts from which each part is generated
    "motions": {"scene_configs"}, "scenes": {"scene_configs", "objects"}, "mpm": {"scene_configs", "objects"},
    "initial": {"scene_configs", "objects", "backgrounds"}, "dynamic": {"scene_configs", "objects", "backgrounds"},
}  # fmt: skip
MIN_DX = 0.011  # smallest grid spacing, at which the grid of a scene has about 50 million nodes [m]
MAX_NUDGE = 0.02  # largest shift of an object [m]; scenes leave 0.05 m between objects


@dataclass(frozen=True)
class Discretisation:
    """Resolution of the simulation in space and time. Raises InputError for values out of range."""

    dx: float = option(0.02, "grid spacing of the simulation [m]; published: 0.02")
    spacing: float = option(0.009, "spacing of particles on surfaces [m]")
    substep: float = option(
        SUBSTEP, "longest simulation time step [s], which is shortened for stiff, light objects; published: 1e-4"
    )

    def __post_init__(self):
        for name, low, high, unit in (
            ("dx", MIN_DX, 0.2, "m"), ("spacing", 1e-6, 0.2, "m"), ("substep", 1e-7, FRAME_INTERVAL, "s")
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise InputError(f"--{name} {getattr(self, name):g}: must be from {low:g} to {high:g} {unit}")

    @property
    def substeps(self) -> int:
        """Substeps per frame."""
        return round(FRAME_INTERVAL / self.substep)


@dataclass(frozen=True)
class DatasetOptions(Discretisation):
    """Groups to generate, and the settings that determine their content."""

    groups: str = option(
        "3_0..3_9,4,6", "groups of scenes to generate; more_0..more_9 are additional scenes of three objects"
    )
    parts: str = option(
        "motions",
        "what to generate, separated by commas: motions, scenes, mpm, initial, dynamic, objects, "
        "backgrounds, scene_configs",
    )
    frames: int = option(100, "number of frames per scene, of 0.02 s each")
    keypoints: int = option(2048, "number of keypoints per object in motions")
    nudge: float = option(
        0.0, "distance by which each object's initial position is shifted [m]; see `statistics --against`"
    )
    exact: bool = option(
        False, "make results on a GPU bitwise reproducible, in twice the time; always on for mpm and dynamic"
    )
    views: str = option("all", "views to render as videos: some of 0,4,...,96, or all")
    backgrounds: str = option("all", "backgrounds to render in videos: some of table0,...,table7, or all")
    resolution: int = option(448, "side of the videos [px]")
    shard: str = option("1/1", "i/n: generate only the i-th of n equal parts of the list of groups")
    limit: int = option(0, "number of scenes of each group; 0: all")
    device: str = device_option()

    def __post_init__(self):
        super().__post_init__()
        parse_parts(self.parts), parse_views(self.views), parse_backgrounds(self.backgrounds), parse_groups(self.groups)
        _parse_shard(self.shard)
        if self.frames < 1 or self.keypoints < 1 or self.limit < 0:
            raise InputError("--frames and --keypoints must be positive, --limit at least 0")
        if not 0 <= self.nudge <= MAX_NUDGE:
            raise InputError(
                f"--nudge {self.nudge}: must be from 0 to {MAX_NUDGE} m, as scenes leave 0.05 m between objects"
            )
        if not 16 <= self.resolution <= 4096 or self.resolution % 2:
            raise InputError(f"--resolution {self.resolution}: must be an even number from 16 to 4096 pixels")

    @property
    def needed_parts(self) -> tuple[str, ...]:
        """The requested parts and their prerequisites, prerequisites first."""
        requested = parse_parts(self.parts)
        needed = {*requested}.union(*(PREREQUISITES.get(part, set()) for part in requested))
        return tuple(p for p in PARTS if p in needed)

    @property
    def view_indices(self) -> tuple[int, ...]:
        """Indices of the orbit cameras used for the dynamic videos and the depth maps."""
        return parse_views(self.views)

    @property
    def background_names(self) -> tuple[str, ...]:
        """Backgrounds of the videos."""
        return parse_backgrounds(self.backgrounds)

    @property
    def shard_groups(self) -> list[str]:
        """The groups of this shard."""
        part, parts = _parse_shard(self.shard)
        return parse_groups(self.groups)[part::parts]

    @property
    def deterministic(self) -> bool:
        """Whether the simulation must be bitwise reproducible.

        Always so for mpm and dynamic, because their missing scenes are simulated again separately.
        """
        return self.exact or bool({"mpm", "dynamic"} & {*self.needed_parts})

    @property
    def settings(self) -> dict:
        """The settings shared by all files of a data set, as stored in manifest.json."""
        shared = ("frames", "keypoints", "dx", "spacing", "substep", "nudge", "resolution")
        return {**{name: getattr(self, name) for name in shared}, "exact": self.deterministic}


@dataclass(frozen=True)
class HeldoutOptions(Discretisation):
    """Which objects and scenes to make, and the settings of their simulation."""

    scenes: int = option(100, "number of scenes")
    objects: int = option(3, "number of objects per scene")
    frames: int = option(100, "number of frames per scene, of 0.02 s each")
    keypoints: int = option(2048, "number of keypoints per object")
    size: float = option(0.5, "length to which the longest side of a mesh is scaled [m]")
    shapes: int = option(
        0,
        "number of random objects for training, written as the group varied (with --from: made of the given "
        "meshes and written as the group meshes); 0: none",
    )
    solid: bool = option(False, "fill the random objects; they are written as the group solid")
    rotations: int = option(
        0, "number of randomly rotated copies of the ten objects for training, written as the group turned; 0: none"
    )
    seed: int = option(
        0, "random seed of scenes and random objects; a seed other than 0 is appended to the group's name", min=0
    )
    device: str = device_option()

    def __post_init__(self):
        super().__post_init__()
        if self.frames < 1 or self.keypoints < 1:
            raise InputError("--frames and --keypoints must be positive")
        if self.scenes < 1 or not 1 <= self.objects <= 6:
            raise InputError(
                f"--scenes {self.scenes} --objects {self.objects}: give at least one scene, of 1 to 6 objects"
            )
        if not 0 <= self.shapes <= 1000:
            raise InputError(f"--shapes {self.shapes}: give 0 for the eight objects, or up to 1000 random objects")
        if not 0 <= self.rotations <= 1000:
            raise InputError(
                f"--rotations {self.rotations}: give 0 for the eight objects, or up to 1000 rotated objects"
            )
        if self.solid and not self.shapes or self.shapes and self.rotations:
            raise InputError("--solid needs --shapes, and --rotations cannot be combined with them")
        if not 0.1 <= self.size <= 1.0:
            raise InputError(f"--size {self.size}: must be from 0.1 to 1 m, as objects are placed in a cube of 1.8 m")

    def group(self, meshes: bool) -> str:
        """Name of the group of scenes, depending on whether meshes are given."""
        random = MESHES if meshes else SOLID if self.solid else VARIED
        return random if self.shapes else ROTATED if self.rotations else HELDOUT


def _parse_shard(text: str) -> tuple[int, int]:
    """ "2/5" -> (1, 5)."""
    part, slash, parts = text.partition("/")
    if not (slash and part.isdigit() and parts.isdigit() and 1 <= int(part) <= int(parts)):
        raise InputError(f"--shard {text}: write i/n with i from 1 to n, such as 2/5")
    return int(part) - 1, int(parts)
