"""Objects of several materials: assignment of points to parts, and averages for the whole object."""

import json

import pytest
import torch

from stages.core.errors import InputError
from stages.core.physics.material_parts import averaged, located, part_of_points, segment_files, uneven_moments
from stages.core.physics.materials import MATERIALS, choose_materials
from stages.core.scene.gaussians import Gaussians
from stages.core.scene.scene import Scene, SceneObject
from stages.core.scene.scene_ply import write_scene

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
    assert pytest.approx(0.25 / 1e7 + 0.75 / 1e5) == 1 / m.E  # parts compressed in series
    shift, inertia = uneven_moments(choice, x, volume)
    com = (2000 * (10.5 + 11.5) + 500 * sum(12.5 + k for k in range(6))) / mass
    assert shift.tolist() == pytest.approx([0, 0, com - 14.0])
    weights = [2000, 2000, *[500] * 6]
    about = sum(w * (10.5 + k - com) ** 2 for k, w in enumerate(weights)) / mass
    uniform = sum((10.5 + k - 14) ** 2 for k in range(8)) / 8
    torch.testing.assert_close(inertia, torch.diag(torch.tensor([about - uniform, about - uniform, 0.0])))


def test_a_plastic_part_gives_its_model_to_the_whole(tmp_path):
    for lower, upper in (("sand", LEAF), (LEAF, "sand")):
        choice = choose(tmp_path, [{"below": 2, "material": lower}, {"material": upper}])
        m = averaged(choice, column(), torch.ones(8)).material
        assert (m.model, m.plastic) == ("sand", MATERIALS["sand"].plastic)
    elastic = choose(tmp_path, [{"below": 2, "material": POT}, {"material": LEAF}])
    assert averaged(elastic, column(), torch.ones(8)).material.model == "neo-hookean"


def gaussians_at(x: torch.Tensor, object_id: list[int]) -> Gaussians:
    n = len(x)
    return Gaussians(x, torch.eye(4)[:1].repeat(n, 1), torch.full((n, 3), 0.1), torch.ones(n), torch.zeros(n, 1, 3),
                     torch.tensor(object_id))  # fmt: skip


def write_parts(folder, x: torch.Tensor, object_id: list[int]) -> None:
    """Write the Gaussians of a plant on a table; its pot is object 4 and its leaves are unlabelled."""
    objects = SceneObject(4, "pot"), SceneObject(5, "duck")
    write_scene(folder / "parts.ply", Scene(gaussians_at(x, object_id), objects))


@pytest.mark.parametrize("segment", ["pot", 4])
def test_a_segment_has_what_is_nearest_to_its_gaussians(tmp_path, segment):
    # unlabelled like the leaves, but never nearest to a point of the plant
    table = column()[:1] - torch.tensor([0.0, 0.0, 0.7])
    write_parts(tmp_path, torch.cat([column(), table]), [4, 4, 4, 0, 0, 0, 0, 0, 0])
    pot = {"segment": segment, "in": "parts.ply", "below": 2, "material": POT}
    choice = choose(tmp_path, [pot, {"material": LEAF}])
    scene = gaussians_at(torch.cat([column() + 0.01, table]), [1] * 8 + [0])
    found = located(choice, scene, OBJECTS[0])
    inner = column() + torch.tensor([0.2, 0.0, -0.4])
    # of the three points in the pot, one is too high
    assert part_of_points(found, inner).tolist() == [0, 0, 1, 1, 1, 1, 1, 1]
    assert segment_files({1: choice}) == [tmp_path / "parts.ply"]


def test_a_segment_elsewhere_is_refused(tmp_path):
    write_parts(tmp_path, torch.cat([column(), column() + 100]), [0] * 8 + [4] * 8)
    choice = choose(tmp_path, [{"segment": "pot", "in": "parts.ply", "material": POT}, {"material": LEAF}])
    with pytest.raises(InputError, match=r"parts.ply: no part of object 1 \(plant\) is in its object pot"):
        located(choice, gaussians_at(column(), [1] * 8), OBJECTS[0])


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
    ([{"box": [0, 0, 1, 1, 1, 0], "material": "steel"}, {"material": "soft"}], "part 1: the first corner of its box"),
    ([{"below": 1, "material": "cheese"}, {"material": "soft"}], "part 1: no material called 'cheese'"),
    ([{"segment": "pot", "material": "steel"}, {"material": "soft"}], "part 1: segment .* together"),
    ([{"below": 1, "material": "steel"}, {"in": "parts.ply", "material": "soft"}], "part 2: segment .* together"),
    ([{"segment": "pot", "in": 3, "material": "steel"}, {"material": "soft"}], "part 1: in is 3, not text"),
    ([{"segment": "pot", "in": "absent.ply", "material": "steel"}, {"material": "soft"}], "absent.ply: no such file"),
    ([{"segment": "leaf", "in": "parts.ply", "material": "steel"}, {"material": "soft"}],
     r"part 1: .*parts.ply: 'leaf' is not an object .* 4 \(pot\), 5 \(duck\)"),
    ([{"below": 1, "material": "steel", "pinned": 1}, {"material": "soft"}], "pinned is 1, not true or false"),
])  # fmt: skip
def test_wrong_parts_are_refused(tmp_path, parts, message):
    write_parts(tmp_path, column(), [4] * 8)
    with pytest.raises(InputError, match=message):
        choose(tmp_path, parts)
