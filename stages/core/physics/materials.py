"""Material models, named materials, and the choice of a material for each object.

Handbook values hold for the solid substance; many real objects are hollow, so give measured values where they matter.
Friction is Coulomb's coefficient against the floor. `loss` is the loss factor tan(delta) of the slowest elastic
vibration of a whole body: the energy lost per cycle divided by 2 pi times the stored energy. In an impact, plastic
deformation at the contact and waves dissipate far more than the loss factor of a stiff solid's substance accounts for.
Their `loss` is therefore the value for which half an oscillation leaves the measured fraction of the speed
(restitution).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from stages.core.errors import InputError
from stages.core.kernels.mpm.constitutive import COROTATED, NEO_HOOKEAN, SAND, SNOW, VON_MISES, sand_slope
from stages.core.physics.material_segments import Segment
from stages.core.scene.files import read_json_file
from stages.core.scene.scene import SceneObject
from stages.core.scene.scene_ply import read_scene
from stages.core.scene.schema import flag, number, numbers, quote, reason, text

MATERIALS_FILE = "a JSON file {object name or id: material name or {E, nu, density, friction}}"
Triple = tuple[float | int, float | int, float | int]


@dataclass(frozen=True)
class Material:
    """An elastic or plastic solid."""

    E: float  # Young's modulus [Pa]
    density: float  # [kg/m^3]
    nu: float = 0.3  # Poisson's ratio
    friction: float = 0.5  # Coulomb coefficient
    loss: float = 0.1  # loss factor, see the module docstring
    model: str = "neo-hookean"  # key of MODELS
    plastic: Triple = (0.0, 0.0, 0.0)  # parameters of the model, see MODELS
    source: str = "given by the user"


@dataclass(frozen=True)
class MaterialModel:
    """A constitutive law of the MPM solver; sources in stages/core/kernels/mpm/constitutive.py."""

    kernel: int  # number of the model in the kernels
    parameters: str  # meaning of Material.plastic
    plastic: bool = False  # whether it yields or flows; the first parameter must then be positive
    # Material.plastic and the factor by which E is reduced -> kernel parameters with the same yield strain
    solver_parameters: Callable[[Triple, float], Triple] = lambda plastic, factor: plastic


MODELS: Mapping[str, MaterialModel] = {
    "neo-hookean": MaterialModel(NEO_HOOKEAN, "elastic; none"),
    "corotated": MaterialModel(COROTATED, "elastic; none"),
    "von-mises": MaterialModel(
        VON_MISES, "metal, plasticine, dough; yield stress [Pa], hardening (softening below 0) [Pa], viscosity [Pa s]",
        True, lambda plastic, factor: (factor * plastic[0], factor * plastic[1], plastic[2]),
    ),
    "sand": MaterialModel(
        SAND, "granular; angle of friction [degrees], 0, 0",
        True, lambda plastic, factor: (sand_slope(plastic[0]), 0.0, 0.0),
    ),
    "snow": MaterialModel(SNOW, "critical compression, critical stretch, hardening", True),
}  # fmt: skip

BOUNCE = "; loss: The Physics Factbook, Coefficients of restitution"
ASHBY = "Ashby 2011, Materials Selection in Mechanical Design, appendix A"
GIBSON = "Gibson and Ashby 1997, Cellular Solids, ch. 5"
PAPER = "GSCollision, E and density as published (Poisson 0.3); friction and loss are ours"

MATERIALS: Mapping[str, Material] = {
    # rubber: Poisson's ratio is 0.49 in the handbook; 0.45 limits the speed of pressure waves, which bounds the substep
    "rubber": Material(2e6, 930.0, 0.45, 0.8, 0.15, source=ASHBY + ": natural rubber 1.5-2.5 MPa"),
    "common": Material(1e7, 540.0, 0.3, 0.5, 0.4, source="a guess: keeps its shape as hard rubber or thin plastic, and "
                       "half of the speed of an impact as household objects on a table; "
                       "density is the geometric mean of the ten objects of GSCollision"),
    "soft": Material(3e4, 120.0, 0.2, 0.6, 0.3, source=GIBSON + ": stuffing as a very open soft foam"),
    "foam": Material(1e5, 50.0, 0.2, 0.7, 0.3, source=ASHBY + ": flexible polymer foam 0.04-1 MPa, 38-70 kg/m3"),
    "cloth": Material(3e3, 100.0, 0.3, 0.5, 0.4, source=PAPER + ": cloth"),
    "rope": Material(5e3, 500.0, 0.3, 0.6, 0.4, source=PAPER + ": rope"),
    "paper": Material(5e6, 200.0, 0.2, 0.4, 0.4,
                      source="a carton of 3 GPa paper, 0.5 mm walls, spread over its volume; loss as common"),
    "plastic": Material(2e9, 1050.0, 0.38, 0.35, 0.24, source=ASHBY + ": ABS 1.1-2.9 GPa" + BOUNCE),
    "wood": Material(1e10, 600.0, 0.35, 0.45, 0.32, source=ASHBY + ": along the grain 6-20 GPa" + BOUNCE),
    "metal": Material(7e10, 2700.0, 0.33, 0.4, 0.33, source=ASHBY + ": aluminium alloys 68-82 GPa" + BOUNCE),
    "steel": Material(2.1e11, 7850.0, 0.29, 0.4, 0.33, source=ASHBY + ": low-carbon steel 200-215 GPa" + BOUNCE),
    "ceramic": Material(7e10, 2400.0, 0.22, 0.4, 0.27,
                        source=ASHBY + ": brick and pottery to porcelain 15-110 GPa; loss as glass"),
    "glass": Material(7e10, 2450.0, 0.22, 0.35, 0.27, source=ASHBY + ": soda-lime glass 68-72 GPa" + BOUNCE),
    "stone": Material(5e10, 2600.0, 0.25, 0.6, 0.27, source=ASHBY + ": granite, marble, slate; loss as glass"),
    "fruit": Material(2e6, 900.0, 0.35, 0.4, 0.3,
                      source="Mohsenin 1986, Physical Properties of Plant and Animal Materials"),
    "jelly": Material(1e4, 1000.0, 0.45, 0.3, 0.2, source="gelatine gels of 5-10 percent, about 10 kPa"),
    "ball": Material(8e5, 600.0, 0.3, 0.6, 0.15, source=PAPER),
    "bowl": Material(1e7, 800.0, 0.3, 0.4, 0.05, source=PAPER),
    "can": Material(1e6, 800.0, 0.3, 0.4, 0.1, source=PAPER),
    "duck": Material(3e5, 300.0, 0.3, 0.6, 0.15, source=PAPER),
    "miku": Material(1e5, 400.0, 0.3, 0.5, 0.2, source=PAPER),
    "panda": Material(1e5, 700.0, 0.3, 0.6, 0.3, source=PAPER),
    "phone": Material(2e7, 2600.0, 0.3, 0.4, 0.05, source=PAPER),
    "pillow": Material(1e4, 500.0, 0.3, 0.6, 0.4, source=PAPER),
    "plasticine": Material(2e6, 1800.0, 0.4, 0.6, 0.3, "von-mises", (1e5, -1e5, 0.0),
                           "Sofuoglu and Rasty 2000, flow stress about 0.1 MPa; E and softening are ours"),
    "dough": Material(1e5, 1100.0, 0.4, 0.7, 0.4, "von-mises", (1e3, 0.0, 1e3),
                      "Dobraszczyk and Morgenstern 2003, yield 0.1-1 kPa, E 10-100 kPa; viscosity is ours"),
    "sand": Material(3.5e5, 1600.0, 0.3, 0.5, 0.01, "sand", (33.0, 0.0, 0.0),
                     "dry quartz sand, angle of repose 30-35 degrees; E as in Klar et al. 2016"),
    "snow": Material(1.4e5, 400.0, 0.2, 0.5, 0.01, "snow", (0.025, 0.0075, 10.0), "Stomakhin et al. 2013, table 2"),
}  # fmt: skip
ELASTIC = tuple(name for name, m in MATERIALS.items() if not MODELS[m.model].plastic)
ALIASES = {  # material of objects whose name contains one of these words
    "soft": ["plush", "teddy", "bear", "doll", "toy", "frog", "kermit", "bunny"],
    "cloth": ["shirt", "t-shirt", "towel", "sock", "scarf", "glove"],
    "paper": ["book", "box", "carton", "tape", "magazine", "globe"],
    "plastic": ["bottle", "pen", "keyboard", "mouse", "brick", "lego", "bulldozer", "telephone", "remote"],
    "metal": ["pan", "frypan", "pot", "spoon", "fork", "knife", "key"],
    "ceramic": ["cup", "mug", "plate", "vase", "ramekin"],
    "stone": ["statue", "buddha", "rock"],
    "wood": ["table", "chair", "guitar", "block"],
    "fruit": ["apple", "banana", "orange", "lemon", "pear"],
    "ball": ["soccer", "football", "basketball"],
}
MAX_PARTS = 100  # maximum number of parts of an object
REGION = ("below", "box", "segment")  # keys that give the region of a part
DEFAULT_MATERIAL = "common"  # for objects whose name suggests no material


@dataclass(frozen=True)
class MaterialPart:
    """A part of an object and its material. Where parts overlap, the first one applies."""

    name: str
    material: Material
    below: float | None = None  # the part is below this height above the object's lowest point [scene units]
    box: tuple[float, ...] | None = None  # lower and upper corner, in scene coordinates at rest [scene units]
    pinned: bool = False  # held at its position
    segment: Segment | None = None  # an object of another labelling of the scene


@dataclass(frozen=True)
class MaterialChoice:
    """The material of an object: that of all its parts, or one that represents them (see material_parts.py)."""

    name: str
    material: Material
    guessed: bool = False  # neither given nor inferred from the object's name
    several: tuple[MaterialPart, ...] = ()  # parts of different materials, the last without a region

    @property
    def parts(self) -> tuple[MaterialPart, ...]:
        """The parts of the object; a single one if it is uniform."""
        return self.several or (MaterialPart(self.name, self.material),)


def choose_materials(
    objects: Sequence[SceneObject], prompts: Sequence[str] = (), file: Path | None = None
) -> dict[int, MaterialChoice]:
    """Material of each object id: --material over --materials over the scene file over the object's name.

    `file` is JSON {object name or id: material name, or {E, density, ...}, or {parts: [...]}}. Raises InputError for
    unknown objects and materials and for values out of range.
    """
    given: dict[int, MaterialChoice] = {}
    for key, value in (read_json_file(file, MATERIALS_FILE) if file else {}).items():
        o, where = find_object(key, objects, f"{file}"), f"{file}: {quote(key)}"
        if o.id in given:
            raise InputError(f"{where}: object {o.id} ({quote(o.name)}) occurs twice; give it one material")
        several = isinstance(value, dict) and "parts" in value
        given[o.id] = _parts(value, where, Path(file).parent) if several else _material(value, where)
    asked: dict[int, MaterialChoice] = {}
    for prompt in prompts:
        key, equals, value = prompt.partition("=")
        if not equals or not value.strip():
            raise InputError(f"--material {quote(repr(prompt))}: write OBJECT=MATERIAL, such as duck=rubber")
        where = f"--material {quote(repr(prompt))}"
        o = find_object(key, objects, where)
        check_new(o, asked, where)
        asked[o.id] = _material(value.strip(), where)
    given |= asked
    return {o.id: given.get(o.id) or _by_name(o) for o in objects}


def find_object(key: str | int, objects: Sequence[SceneObject], where: str) -> SceneObject:
    """The object with id or name `key`, or the only one whose name contains it.

    Raises InputError, prefixed with `where`, if there is none or several.
    """
    text = str(key).strip().lower()
    exact = [o for o in objects if text in (str(o.id), o.name.lower())]
    near = exact or [o for o in objects if text and text in o.name.lower()]
    if len(near) == 1:
        return near[0]
    have = quote(", ".join(f"{o.id} ({o.name})" for o in objects) or "none", 300)
    problem = f"matches {len(near)} objects" if near else "is not an object of this scene"
    raise InputError(f"{where}: {quote(repr(text))} {problem}; the scene has: {have}")


def check_new(o: SceneObject, given: Collection[int], where: str) -> None:
    """Raise InputError, prefixed with `where`, if the option was already given for this object."""
    if o.id in given:
        raise InputError(f"{where}: object {o.id} ({quote(o.name)}) occurs twice; give the option once for each object")


def _by_name(o: SceneObject) -> MaterialChoice:
    """The material that the scene gives for an object, or the one that its name suggests."""
    if o.material:
        return _material(o.material, f"object {o.id} ({quote(o.name)}) of the scene")
    words = set(re.findall(r"[a-z]+(?:-[a-z]+)?", o.name.lower()))
    words |= {word.removesuffix("s") for word in words}
    # the paper's objects take precedence over substances: a "rubber duck" is a duck
    for name in sorted(words & MATERIALS.keys(), key=lambda name: not MATERIALS[name].source.startswith(PAPER)):
        return MaterialChoice(name, MATERIALS[name])
    for name, others in ALIASES.items():
        if words & set(others):
            return MaterialChoice(name, MATERIALS[name])
    return MaterialChoice(DEFAULT_MATERIAL, MATERIALS[DEFAULT_MATERIAL], guessed=True)


def _material(value: object, where: str) -> MaterialChoice:
    """A material by name or from a dict of values; InputError for an unknown name or a value out of range."""
    if isinstance(value, str):
        if value.lower() not in MATERIALS:
            raise InputError(f"{where}: no material called {quote(repr(value))}; choose from {', '.join(MATERIALS)}")
        return MaterialChoice(value.lower(), MATERIALS[value.lower()])
    known = [f.name for f in fields(Material) if f.name != "source"]
    model, plastic = Material.model, Material.plastic
    if not isinstance(value, dict) or not {"E", "density"} <= value.keys() or value.keys() - set(known):
        raise InputError(f"{where}: give a material's name or {{E, density}} with any of {', '.join(known)}")
    if not isinstance(value.get("model", model), str) or value.get("model", model) not in MODELS:
        given = quote(repr(value["model"]), 40)
        raise InputError(f"{where}: no material model called {given}; choose from {', '.join(MODELS)}")
    try:
        plastic = numbers(value.get("plastic", plastic), 3, "plastic", -1e13, 1e13)
        values = {k: number(v, k, -1e13, 1e13) for k, v in value.items() if k not in ("model", "plastic")}
        material = Material(**values, model=value.get("model", model), plastic=plastic)
    except (TypeError, ValueError) as error:
        problem = f"{reason(error)}; E [Pa], density [kg/m^3] and the rest are numbers, plastic three of them"
        raise InputError(f"{where}: {problem}") from error
    if MODELS[material.model].plastic and material.plastic[0] <= 0:
        raise InputError(f"{where}: the first number of plastic must be positive for {material.model}; the "
                         f"parameters are: {MODELS[material.model].parameters}")  # fmt: skip
    if not (1e-3 <= material.E < 1e13 and 1e-3 <= material.density < 1e5 and -0.5 < material.nu < 0.49):
        raise InputError(f"{where}: E must be positive and below 1e13 Pa, density positive and below 1e5 kg/m^3, nu "
                         "between -0.5 and 0.49")  # fmt: skip
    if not (0 <= material.friction < 100 and 0 <= material.loss <= 2):
        raise InputError(f"{where}: friction must be 0 or more and below 100, and loss between 0 and 2")
    return MaterialChoice("custom", material)


def _parts(value: dict, where: str, folder: Path) -> MaterialChoice:
    """An object of several parts: {"parts": [{below, box, segment and in, material, pinned}, ..., {material, pinned}]}.

    The PLY files of segments are relative to `folder`.
    """
    rows = value["parts"]
    if value.keys() != {"parts"} or not isinstance(rows, list) or not 2 <= len(rows) <= MAX_PARTS:
        raise InputError(f"{where}: give {{parts: [...]}} with 2 to {MAX_PARTS} parts")
    parts = []
    for k, row in enumerate(rows, 1):
        at = f"{where}: part {k}"
        if not isinstance(row, dict) or row.keys() - {*REGION, "in", "material", "pinned"} or "material" not in row:
            raise InputError(f"{at}: give a material, its region as below (a height), box (two corners) or segment (an "
                             "object in a labelled PLY), and pinned if the part is held fixed")  # fmt: skip
        if (k < len(rows)) != bool(row.keys() & set(REGION)):
            raise InputError(f"{at}: every part but the last needs {' or '.join(REGION)}; the last part is what "
                             "the other parts "
                             "leave")  # fmt: skip
        choice = _material(row["material"], at)
        try:
            below = number(row["below"], "below", 0) if "below" in row else None
            box = numbers(row["box"], 6, "box") if "box" in row else None
            if box is not None and not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
                raise ValueError("the first corner of its box must be below the second in x, y and z")
            pinned = flag(row.get("pinned", False), "pinned")
            segment = _segment(row, at, folder)
        except ValueError as error:
            raise InputError(f"{at}: {reason(error)}") from error
        parts.append(MaterialPart(choice.name, choice.material, below, box, pinned, segment))
    return MaterialChoice(" and ".join(dict.fromkeys(p.name for p in parts)), parts[-1].material, several=tuple(parts))


def _segment(row: dict, where: str, folder: Path) -> Segment | None:
    """The segment of a part, if it has one. Raises ValueError or InputError for a malformed or unknown one."""
    if ("segment" in row) != ("in" in row):
        raise ValueError("segment (a name or id) and in (the labelled PLY that has it) belong together")
    if "segment" not in row:
        return None
    path = folder / text(row["in"], "in")
    scene = read_scene(path)
    o = find_object(text(str(row["segment"]), "segment"), scene.objects, f"{where}: {path}")
    return Segment(path, o.name, scene.gaussians.means, scene.gaussians.object_id == o.id)
