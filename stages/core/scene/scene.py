"""Data model of a scene: Gaussians, their objects, and the cameras of the photos."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from stages.core.scene.cameras import Cameras
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.schema import number, numbers, rows, text, texts, whole
from stages.core.scene.sequence import FilmedSequence

UNKNOWN_SCALE = ("assumed", "not stated")  # prefixes of the scale's `source` that mean an unknown scale


@dataclass(frozen=True)
class SceneObject:
    """A movable object; its Gaussians have its id as object_id."""

    id: int  # 1 or more
    name: str
    material: str = ""  # name of the material; empty: inferred from the object's name


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
    sequence: FilmedSequence | None = None  # timing of the videos whose first frame is the scene

    @property
    def metres_per_unit(self) -> float:
        """Length of a scene unit [m]."""
        return float(self.scale.get("metres_per_unit", 1.0))

    @property
    def has_known_scale(self) -> bool:
        """Whether `metres_per_unit` was measured or given; otherwise a unit is assumed to be 1 m."""
        return not str(self.scale.get("source", "not stated")).startswith(UNKNOWN_SCALE)

    @property
    def commands(self) -> set[str]:
        """The commands that made the scene, such as "reconstruct" and "refine", from its provenance."""
        found, made = set(), self.provenance
        while isinstance(made, dict):
            found.add(str(made.get("command", "")))
            made = made.get("scene")
        return found - {""}

    def mass_text(self, mass: float) -> str:
        """A mass [kg] for messages, with the condition that a unit is 1 m if the scale is not known."""
        return f"{mass:.3g} kg" + ("" if self.has_known_scale else " if one unit is 1 m")

    def name_of(self, object_id: int) -> str:
        """The name of an object; object_ID if it has none."""
        return next((o.name for o in self.objects if o.id == object_id), f"object_{object_id}")


def read_objects(rows: Iterable[Sequence]) -> tuple[SceneObject, ...]:
    """Objects from a file's rows of id, name and material. Raises ValueError for wrong values and duplicate ids."""
    objects = tuple(_read_object(*row) for row in rows)
    if twice := [id for id, count in Counter(o.id for o in objects).items() if count > 1]:
        raise ValueError(f"object {twice[0]} occurs twice")
    return objects


def _read_object(id: object, name: object, material: object) -> SceneObject:
    """An object. Raises ValueError unless the id is a whole number from 1 to MAX_OBJECT_ID and the rest is text."""
    id = whole(id, "an object's id", 1)
    return SceneObject(id, text(name, f"the name of object {id}"), text(material, f"the material of object {id}"))


def read_metadata(floor: object, scale: object, provenance: object, background: object) -> dict:
    """Check a file's metadata, and return it as arguments of Scene. Raises ValueError for wrong types and values."""
    if not isinstance(scale, dict) or not isinstance(provenance, dict):
        raise ValueError("scale or provenance is not a JSON object")
    if not isinstance(provenance.get("options", {}), dict):
        raise ValueError("the options in provenance are not a JSON object")
    inputs = rows(provenance.get("inputs", []), "inputs in provenance")
    texts([isinstance(row, dict) and row.get("name") for row in inputs], "the names of inputs in provenance")
    if "metres_per_unit" in scale:
        number(scale["metres_per_unit"], "metres_per_unit", 1e-6, 1e6)
    colour = None if background is None else [min(max(x, 0.0), 1.0) for x in numbers(background, 3, "background")]
    return {
        "floor": None if floor is None else number(floor, "floor"), "scale": scale, "provenance": provenance,
        "background": None if colour is None else tuple(colour),
    }  # fmt: skip
