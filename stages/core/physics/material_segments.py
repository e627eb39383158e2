"""Parts of an object given by a second segmentation of its scene: an object of another labelled PLY."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Bool, Float
from torch import Tensor

from stages.core.errors import InputError
from stages.core.geometry.neighbours import knn
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import SceneObject


@dataclass(frozen=True, eq=False)
class Segment:
    """An object of a labelled PLY, in the coordinates of the scene at rest [scene units]."""

    path: Path
    name: str
    means: Float[Tensor, "n 3"]  # centres of the Gaussians, in the segment or not
    inside: Bool[Tensor, "n"]  # whether a Gaussian is in the segment

    def contains(self, x: Float[Tensor, "p 3"]) -> Bool[Tensor, "p"]:
        """Whether the Gaussian nearest to each point is in the segment."""
        return self.inside[knn(self.means, x, 1)[1][:, 0]]

    def of_object(self, gaussians: Gaussians, o: SceneObject) -> Segment:
        """The segment restricted to the Gaussians of an object of the scene, each labelled as its nearest in the PLY.

        A point in the object is then never assigned to a neighbouring object. Raises InputError if none of the
        object's Gaussians is in the segment.
        """
        means = gaussians.means[gaussians.object_id == o.id]
        inside = self.contains(means)
        if not bool(inside.any()):
            raise InputError(f"{self.path}: no part of object {o.id} ({o.name}) is in its object {self.name}; "
                             "give the same "
                             "scene, with the parts labelled as objects")  # fmt: skip
        return Segment(self.path, self.name, means, inside)
