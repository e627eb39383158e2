"""A scene: Gaussians, their objects, and the cameras of the photos."""

from __future__ import annotations

from dataclasses import dataclass, field

from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians

UNKNOWN_SCALE = ("assumed", "not stated")  # beginnings of `source` where the scale is not known


@dataclass(frozen=True)
class SceneObject:
    """A movable object; its Gaussians have its id."""

    id: int  # 1 or more
    name: str
    material: str = ""  # empty: decided from the name


@dataclass(frozen=True)
class Scene:
    """Gaussians, objects and cameras in the world frame: z up, right-handed, lengths in scene units."""

    gaussians: Gaussians
    objects: tuple[SceneObject, ...] = ()
    cameras: Cameras | None = None
    floor: float | None = None  # height z of the supporting plane
    scale: dict = field(default_factory=lambda: {"metres_per_unit": 1.0, "source": "not stated"})
    provenance: dict = field(default_factory=dict)
    background: tuple[float, float, float] | None = None  # RGB 0..1 where there is no Gaussian

    @property
    def metres_per_unit(self) -> float:
        """Length of a scene unit [m]."""
        return float(self.scale.get("metres_per_unit", 1.0))

    @property
    def has_known_scale(self) -> bool:
        """Whether `metres_per_unit` was measured or given; otherwise a unit is only taken as 1 m."""
        return not str(self.scale.get("source", "not stated")).startswith(UNKNOWN_SCALE)

    def mass_text(self, mass: float) -> str:
        """A mass [kg] for messages; it holds for a unit of 1 m where the scale is not known."""
        return f"{mass:.3g} kg" + ("" if self.has_known_scale else " if one unit is 1 m")

    def name_of(self, object_id: int) -> str:
        """The name of an object, object_ID where it has none."""
        return next((o.name for o in self.objects if o.id == object_id), f"object_{object_id}")
