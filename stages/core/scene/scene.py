"""A scene: Gaussians, what the objects among them are, and the cameras that saw them."""

from __future__ import annotations

from dataclasses import dataclass, field

from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians


@dataclass(frozen=True)
class SceneObject:
    """One thing that can move; its Gaussians carry its id."""

    id: int  # 1 or more
    name: str
    material: str = ""  # empty: decided by name


@dataclass(frozen=True)
class Scene:
    """World frame: z up, right-handed, lengths in scene units."""

    gaussians: Gaussians
    objects: tuple[SceneObject, ...] = ()
    cameras: Cameras | None = None
    floor: float | None = None  # height z of the supporting plane
    scale: dict = field(default_factory=lambda: {"metres_per_unit": 1.0, "source": "not stated"})
    provenance: dict = field(default_factory=dict)
    background: tuple[float, float, float] | None = None  # RGB 0..1 seen where there is nothing

    @property
    def metres_per_unit(self) -> float:
        return float(self.scale.get("metres_per_unit", 1.0))

    def name_of(self, object_id: int) -> str:
        """The object's name, or object_ID where none was given."""
        return next((o.name for o in self.objects if o.id == object_id), f"object_{object_id}")
