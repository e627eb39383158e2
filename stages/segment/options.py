"""Options of segmentation, and the table of its backends."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from stages.core.backends import Backend, describe, with_weights
from stages.core.errors import InputError
from stages.core.options import check_types, device_option, download_option, option, photos_option, seed_option
from stages.core.perception.object_limits import GroupingOptions
from stages.segment.object_scale import parse_object_scale

# a backend takes (scene, SegmentOptions) and returns the scene with labels and objects
BACKENDS = {
    "learned": Backend("stages.segment.learned:segment", "find objects with a network trained on simulated clutter"),
    "geometric": Backend(
        "stages.segment.geometric:segment", "group the Gaussians on the supporting plane by position, colour and shape"
    ),
    "masks": Backend("stages.segment.masks:segment", "vote over label images of the photos (--masks)"),
    "points": Backend("stages.segment.points:segment", "find the objects at points in photos (--points)"),
    "boxes": Backend("stages.segment.boxes:segment", "cut out objects in boxes in the first view (--boxes)"),
    "sam2": Backend(
        "stages.segment.prompted:segment", "propagate boxes, points or automatic masks through the photos with SAM 2.1",
        find_weights="stages.core.models.sam2.weights:find", network="stages.core.models.sam2.weights:load_segmenter",
        package="transformers", extra="sam2",
    ),
}  # fmt: skip
NETWORKS = with_weights(BACKENDS)


@dataclass(frozen=True)
class SegmentOptions:
    """Parameters of segmentation; raises InputError for values outside their range and for conflicting ones."""

    backend: str = option("learned", describe(BACKENDS))
    masks: Path | None = option(
        None,
        "folder of label images named like the photos: 0 background, 1... objects; 255 is ignored "
        "unless its names.json gives it a name",
    )
    boxes: Path | None = option(
        None, f"prompts.json with names and boxes of objects in the first photo [px]; for {NETWORKS} also points"
    )
    points: tuple[str, ...] = option(
        (),
        'point on an object in a photo [px]: "view=IMG.jpg xy=310,220 name=duck"; repeatable; '
        "points with the same name mark one object",
    )
    photos: Path | None = photos_option(NETWORKS)
    undistorted: bool = option(
        False, "masks, boxes, points and photos belong to undistorted views; default: to the photos as taken"
    )
    weights: Path | None = option(
        None,
        f"for {NETWORKS}: file or folder of the network's weights, by default its folder in "
        "$NGFF_WEIGHTS or ~/.cache/ngff; for learned: segmenter.safetensors, by default the one in the package",
    )
    download: bool = download_option(NETWORKS)
    names: str = option("", 'names of the objects by number: "1=duck,2=bowl"')
    max_objects: int = option(GroupingOptions.max_objects, "maximum number of objects")
    min_size: float = option(
        GroupingOptions.min_size,
        "ignore objects whose longest side is shorter than this fraction of the camera distance",
    )
    detail: float = option(
        GroupingOptions.detail,
        "for backend geometric: threshold for merging regions, 0 to 2; lower values give more objects",
    )
    scale_reference: str = option(
        "",
        'measured height or length of an object that sets the scale [m]: "object=1 height=0.12" or "object=1 '
        'length=0.2"',
    )
    seed: int = seed_option()
    device: str = device_option()

    def __post_init__(self):
        check_types(self)
        if (self.masks is not None) + (self.boxes is not None) + bool(self.points) > 1:
            raise InputError("--masks, --boxes and --points: cannot be combined; give only one of them")
        if self._is_network and (self.masks is not None or self.points):
            raise InputError(f"--backend {self.backend} generates masks itself; drop --masks or --points, or drop "
                             "--backend")  # fmt: skip
        if not self._is_network and (self.photos or self.download):
            raise InputError(f"--photos and --download only work with --backend {NETWORKS}; add it or drop them")
        if not self._is_network and self.weights and self.backend != "learned":
            raise InputError(f"--weights only works with --backend {NETWORKS} or learned; add it or drop --weights")
        if self.chosen != self.backend != type(self).backend:
            raise InputError(f"--{self.chosen} selects its own backend; drop it or --backend {self.backend}")
        if self.detail != type(self).detail and self.chosen != "geometric":
            raise InputError("--detail: only works with --backend geometric; add it or drop --detail")
        if self.undistorted and not (self.masks or self.boxes or self.points or self.photos):
            raise InputError("--undistorted: only applies to --masks, --boxes, --points, --photos; add one or drop it")
        if self.max_objects < 1:
            raise InputError(f"--max-objects {self.max_objects}: must be 1 or more")
        if not 0 < self.min_size < 1:
            raise InputError(f"--min-size {self.min_size}: must be between 0 and 1, such as 0.03")
        if not 0 < self.detail < 2:
            raise InputError(f"--detail {self.detail}: must be between 0 and 2, such as 0.4")
        self.renamed, parse_object_scale(self.scale_reference)  # noqa: B018 -- raises errors before work starts

    @property
    def _is_network(self) -> bool:
        return self.backend in BACKENDS and bool(BACKENDS[self.backend].find_weights)

    @property
    def chosen(self) -> str:
        """Name of the backend that the options select."""
        if self._is_network:
            return self.backend
        given = {"masks": self.masks is not None, "boxes": self.boxes is not None, "points": bool(self.points)}
        return next((name for name, is_given in given.items() if is_given), self.backend)

    @property
    def renamed(self) -> dict[int, str]:
        """Names given by the user, by object number. Raises InputError if they cannot be parsed."""
        names = {}
        for part in filter(None, (p.strip() for p in self.names.split(","))):
            number, sign, name = part.partition("=")
            if not sign or not re.fullmatch(r"0*[1-9][0-9]{0,4}", number.strip()) or not name.strip():
                raise InputError(f'--names: {part[:80]!r} is not NUMBER=NAME; write "1=duck,2=bowl"')
            if int(number) in names:
                raise InputError(f"--names: object {int(number)} occurs twice; give it one name")
            names[int(number)] = name.strip()
        return names
