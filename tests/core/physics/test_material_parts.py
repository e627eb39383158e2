"""Objects of several materials: which points are of which part, and the averages that stand for the whole."""

import json

import pytest
import torch

from stages.core.errors import InputError
from stages.core.physics.material_parts import averaged, part_of_points, uneven_moments
from stages.core.physics.materials import choose_materials
from stages.core.scene.scene import SceneObject

OBJECTS = (SceneObject(1, "plant"), SceneObject(2, "duck"))
POT, LEAF = {"E": 1e7, "density": 2000.0, "friction": 0.4}, {"E": 1e5, "density": 500.0, "friction": 0.8}


def choose(tmp_path, parts):
    (tmp_path / "m.json").write_text(json.dumps({"plant": {"parts": parts}}))
    return choose_materials(OBJECTS, file=tmp_path / "m.json")[1]


def column() -> torch.Tensor:
    """Centres of eight cubes of edge 1 that stand on each other on z = 10."""
    return torch.tensor([[0.0, 0.0, 10.5 + k] for k in range(8)])


def test_the_first_part_that_holds_a_point_has_it(tmp_path):
    choice = choose(tmp_path, [
        {"box": [-1, -1, 10, 1, 1, 11], "material": "steel", "pinned": True}, {"below": 2, "material": POT},
        {"below": 6, "box": [-1, -1, 14, 1, 1, 99], "material": "rubber"}, {"material": LEAF},
    ])  # fmt: skip
    # heights are from the lowest point, 10.5, so that 2 holds the centres 10.5, 11.5 but not 12.5
    assert part_of_points(choice, column()).tolist() == [0, 1, 3, 3, 2, 2, 3, 3]
    assert choice.name == "steel and custom and rubber" and [p.pinned for p in choice.parts] == [True] + [False] * 3


def test_averages_and_moments_of_a_column(tmp_path):
    choice = choose(tmp_path, [{"below": 2, "material": POT}, {"material": LEAF}])
    x, volume = column(), torch.ones(8)
    m = averaged(choice, x, volume).material
    mass = 2 * 2000 + 6 * 500  # [kg]
    assert m.density * 8 == pytest.approx(mass)
    assert m.friction == pytest.approx((4000 * 0.4 + 3000 * 0.8) / mass)
    assert pytest.approx(0.25 / 1e7 + 0.75 / 1e5) == 1 / m.E  # compressed in series
    shift, inertia = uneven_moments(choice, x, volume)
    com = (2000 * (10.5 + 11.5) + 500 * sum(12.5 + k for k in range(6))) / mass
    assert shift.tolist() == pytest.approx([0, 0, com - 14.0])
    weights = [2000, 2000, *[500] * 6]
    about = sum(w * (10.5 + k - com) ** 2 for k, w in enumerate(weights)) / mass
    uniform = sum((10.5 + k - 14) ** 2 for k in range(8)) / 8
    torch.testing.assert_close(inertia, torch.diag(torch.tensor([about - uniform, about - uniform, 0.0])))


def test_a_uniform_object_stays_as_it_is():
    choice = choose_materials(OBJECTS)[2]
    assert len(choice.parts) == 1 and averaged(choice, column(), torch.ones(8)) is choice
    assert not any(t.any() for t in uneven_moments(choice, column(), torch.ones(8)))


@pytest.mark.parametrize(("parts", "message"), [
    ([{"material": "steel"}], "2 to 100 parts"), ("steel", "2 to 100 parts"),
    ([{"material": "steel"}, {"material": "soft"}], "part 1: every part but the last needs"),
    ([{"below": 1, "material": "steel"}, {"below": 2, "material": "soft"}], "part 2: every part but the last"),
    ([{"below": 1}, {"material": "soft"}], "part 1: give a material"),
    ([{"below": -1, "material": "steel"}, {"material": "soft"}], "part 1: below is -1"),
    ([{"box": [0, 1], "material": "steel"}, {"material": "soft"}], "part 1: box"),
    ([{"below": 1, "material": "cheese"}, {"material": "soft"}], "part 1: no material called 'cheese'"),
    ([{"below": 1, "material": "steel", "pinned": 1}, {"material": "soft"}], "pinned is 1, not true or false"),
])  # fmt: skip
def test_wrong_parts_are_refused(tmp_path, parts, message):
    with pytest.raises(InputError, match=message):
        choose(tmp_path, parts)
