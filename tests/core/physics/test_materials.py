"""Material tables and the choice of a material for an object."""

import itertools
import json
import math
from pathlib import Path

import pytest

from stages.core.errors import InputError
from stages.core.physics.materials import (
    ALIASES,
    DEFAULT_MATERIAL,
    ELASTIC,
    MATERIALS,
    MODELS,
    choose_materials,
    find_object,
)
from stages.core.scene.scene import SceneObject

README = Path(__file__).parents[3] / "stages/simulate/README.md"
OBJECTS = (SceneObject(1, "rubber duck"), SceneObject(2, "object_2"), SceneObject(3, "green mug", "plastic"))


def test_every_material_is_plausible_and_has_a_source():
    for name, m in MATERIALS.items():
        assert 1e2 < m.E < 1e12 and 10 < m.density < 1e4 and 0 < m.nu < 0.49, name
        assert 0 < m.friction < 1.5 and 0 < m.loss < 1 and len(m.source) > 20, name
    assert ALIASES.keys() <= MATERIALS.keys()


def test_the_table_of_the_documentation_is_that_of_the_code():
    lines = README.read_text().splitlines()
    first = next(n for n, line in enumerate(lines) if line.startswith("| name | E "))
    table = itertools.takewhile(lambda line: line.startswith("|"), lines[first + 2 :])
    rows = [line.strip("| ").split(" | ") for line in table]
    values = {row[0]: [float(v) for v in row[1:]] for row in rows}
    assert values == {n: [m.E, m.density, m.nu, m.friction, m.loss] for n, m in MATERIALS.items()}


@pytest.mark.parametrize("name, E, density", [("ball", 8e5, 600), ("phone", 2e7, 2600), ("rope", 5e3, 500)])
def test_materials_of_the_paper(name, E, density):
    assert (MATERIALS[name].E, MATERIALS[name].density, MATERIALS[name].nu) == (E, density, 0.3)


@pytest.mark.parametrize("name, material", [
    ("duck", "duck"), ("rubber duck", "duck"), ("red ball", "ball"), ("wooden_box", "paper"),
    ("candle", DEFAULT_MATERIAL), ("Teddy bear", "soft"), ("two cans", "can"), ("mug 2", "ceramic"),
    ("object_7", DEFAULT_MATERIAL), ("", DEFAULT_MATERIAL),
])  # fmt: skip
def test_material_from_the_name(name, material):
    assert choose_materials([SceneObject(1, name)])[1].name == material


def test_options_override_the_scene_and_the_scene_overrides_the_name(tmp_path):
    file = tmp_path / "m.json"
    file.write_text(json.dumps({"2": "wood", "duck": {"E": 5e4, "density": 200, "friction": 0.9}}))
    chosen = choose_materials(OBJECTS, ["object_2=foam"], file)
    assert chosen[1].material.E == 5e4 and chosen[1].material.friction == 0.9 and chosen[1].material.nu == 0.3
    assert [chosen[i].name for i in (1, 2, 3)] == ["custom", "foam", "plastic"]
    assert choose_materials(OBJECTS)[2].guessed and not choose_materials(OBJECTS)[1].guessed


@pytest.mark.parametrize("prompt, message", [
    ("duck", "OBJECT=MATERIAL"), ("duck=", "OBJECT=MATERIAL"), ("duck=cheese", "choose from rubber"),
    ("cow=rubber", "the scene has: 1 \\(rubber duck\\)"), ("e=rubber", "matches 3 objects"),
])  # fmt: skip
def test_invalid_prompts(prompt, message):
    with pytest.raises(InputError, match=message):
        choose_materials(OBJECTS, [prompt])


def test_an_object_has_one_material_of_the_command_line():
    with pytest.raises(InputError, match=r"--material '1=steel': object 1 \(rubber duck\) occurs twice"):
        choose_materials(OBJECTS, ["duck=rubber", "1=steel"])


@pytest.mark.parametrize("text, message", [
    ("{", "not JSON"), ("[]", "object name or id"), ('{"duck": 3}', "material's name"),
    ('{"duck": {"E": 1e5}}', "E, density"), ('{"duck": {"E": -1, "density": 1}}', "positive"),
    ('{"duck": {"E": 1e5, "density": 1e6}}', "density positive and below 1e5"),
    ('{"duck": "wood", "1": "steel"}', r"m.json: 1: object 1 \(.*duck.*\) occurs twice; give it one material"),
    ('{"duck": {"E": 1e5, "density": 100, "nu": 0.5}}', "nu"), ('{"duck": {"E": "x", "density": 1}}', "numbers"),
    ('{"duck": {"E": 1e5, "density": 1, "colour": 1}}', "friction"),
    ('{"duck": {"E": 1e5, "density": 1, "friction": -1}}', "friction must be"),
    ('{"duck": {"E": 1e5, "density": 1, "loss": 2.1}}', "loss between"),
])  # fmt: skip
def test_invalid_files(tmp_path, text, message):
    file = tmp_path / "m.json"
    file.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        choose_materials(OBJECTS, file=file)
    assert str(file) in str(error.value)


def test_objects_are_found_by_id_name_or_part_of_the_name():
    assert [find_object(key, OBJECTS, "").id for key in (2, "2", "Rubber Duck", "mug")] == [1 + 1, 2, 1, 3]


def custom(tmp_path, **values):
    file = tmp_path / "m.json"
    file.write_text(json.dumps({"duck": {"E": 1e5, "density": 100, **values}}))
    return choose_materials(OBJECTS, file=file)[1].material


LIMITS = [("E", 1e-3, 9.9e12), ("density", 1e-3, 99_999), ("nu", -0.499, 0.489), ("friction", 0, 99.9), ("loss", 0, 2)]
BEYOND = {
    "E": (9e-4, 1e13),
    "density": (9e-4, 1e5),
    "nu": (-0.5, 0.49),
    "friction": (-1e-3, 100),
    "loss": (-1e-3, 2.001),
}


@pytest.mark.parametrize(("name", "low", "high"), LIMITS)
def test_values_of_materials_up_to_their_limits(tmp_path, name, low, high):
    for value in (low, high):
        assert getattr(custom(tmp_path, **{name: value}), name) == value
    for value in BEYOND[name]:
        with pytest.raises(InputError, match="m.json: duck: .*(must be positive|friction must)"):
            custom(tmp_path, **{name: value})


def test_models_of_materials(tmp_path):
    m = custom(tmp_path, model="von-mises", plastic=[1e3, -5, 2])
    assert (m.model, m.plastic, m.source) == ("von-mises", (1e3, -5.0, 2.0), "given by the user")
    usual, plain = MATERIALS[DEFAULT_MATERIAL], custom(tmp_path)
    assert (plain.model, plain.nu, plain.friction) == ("neo-hookean", usual.nu, usual.friction)
    assert custom(tmp_path, model="corotated").plastic == (0, 0, 0)
    wrong = [
        ({"model": "jello"}, "no material model called 'jello'; choose from neo-hookean"),
        ({"model": 3}, "no material model called 3"), ({"plastic": [1, 2]}, "plastic three of them"),
        ({"model": "sand"}, "the first number of plastic must be positive for sand; .*angle of friction"),
        ({"model": "snow", "plastic": [0, 1, 1]}, "must be positive for snow"), ({"source": "me"}, "with any of E"),
    ]  # fmt: skip
    for values, message in wrong:
        with pytest.raises(InputError, match=message):
            custom(tmp_path, **values)


def test_a_softened_material_yields_at_the_same_strain():
    """Stresses are reduced with E; strains, angles and viscosities are not."""
    of = {name: model.solver_parameters((8.0, 4.0, 2.0), 0.25) for name, model in MODELS.items()}
    assert of["von-mises"] == (2.0, 1.0, 2.0) and of["snow"] == of["corotated"] == (8.0, 4.0, 2.0)
    slope = math.sqrt(2) * math.sin(math.radians(30)) / 3  # |dev tau| = sqrt(2) shear in plane strain
    assert MODELS["sand"].solver_parameters((30.0, 1.0, 1.0), 0.25) == pytest.approx((slope, 0, 0))
    assert {name for name, model in MODELS.items() if model.plastic} == {"von-mises", "sand", "snow"}
    assert {"sand", "dough", "snow"}.isdisjoint(ELASTIC) and {"rubber", "steel"} < set(ELASTIC)


def test_a_file_that_names_an_object_twice_or_by_part_of_its_name():
    with pytest.raises(InputError, match="'' is not an object of this scene; the scene has: none"):
        find_object(" ", [], "x")
    assert find_object("3", (*OBJECTS, SceneObject(4, "cup 3")), "").id == 3  # ids have priority over parts of names
    with pytest.raises(InputError, match="'cup' matches 2 objects"):
        find_object("cup", (SceneObject(1, "cup a"), SceneObject(2, "cup b")), "x")
