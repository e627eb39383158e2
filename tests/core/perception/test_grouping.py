"""Grouping of Gaussians into objects on a table."""

from dataclasses import replace

import pytest
import torch

from stages.core.perception.grouping import group_objects
from stages.core.perception.object_limits import GroupingOptions
from stages.core.perception.region_growing import grow_objects
from stages.core.perception.support import find_support, view_extent
from stages.core.scene.gaussians import Gaussians, concatenate
from stages.core.scene.scene import Scene
from stages.lab.assets.shapes import ellipsoid
from tests.conftest import random_gaussians
from tests.segment.tabletop import best_overlap, block, coloured_gaussians, egg, scene_of, table_gaussians, three_apart


def unlabelled(scene: Scene) -> Scene:
    return replace(scene, gaussians=replace(scene.gaussians, object_id=torch.zeros_like(scene.gaussians.object_id)))


def overlaps(scene: Scene, **how) -> dict[int, float]:
    found = group_objects(unlabelled(scene), GroupingOptions(**how))
    return best_overlap(found.gaussians.object_id, scene.gaussians.object_id)


@pytest.mark.parametrize("how", [{}, {"noise": 0.002}, {"noise": 0.002, "tilt": 0.03}, {"cameras": False}], ids=str)
def test_separate_objects_are_found(how):
    scene = three_apart(**how)
    found = group_objects(unlabelled(scene))
    assert len(found.objects) == 3
    assert min(best_overlap(found.gaussians.object_id, scene.gaussians.object_id).values()) >= 0.9


def test_touching_objects_of_different_colour_are_separated():
    scene = scene_of(
        table_gaussians(), block((-0.06, 0.0), (0.12, 0.1, 0.08), (0.8, 0.1, 0.1), 1),
        egg((0.068, 0.0, 0.07), (0.068, 0.068, 0.07), (0.1, 0.2, 0.8), 2), noise=0.001,
    )  # fmt: skip
    assert min(overlaps(scene).values()) >= 0.75


def test_stacked_objects_are_separated():
    ball = egg((0.0, 0.0, 0.14), (0.06, 0.06, 0.06), (0.9, 0.8, 0.1), 2)
    scene = scene_of(table_gaussians(), block((0.0, 0.0), (0.2, 0.2, 0.08), (0.3, 0.1, 0.5), 1), ball, noise=0.001)
    assert min(overlaps(scene).values()) >= 0.75


def test_striped_object_is_one():
    cube = block((0.0, 0.0), (0.16, 0.16, 0.12), (0.9, 0.9, 0.9), 1)
    stripes = (cube.means[:, 0] / 0.03).floor().remainder(2) == 0
    cube = replace(cube, sh=torch.where(stripes[:, None, None], -cube.sh, cube.sh))
    assert overlaps(scene_of(table_gaussians(), cube))[1] >= 0.9


def test_flat_object_is_found_and_a_stain_is_not():
    phone = block((0.15, 0.0), (0.16, 0.08, 0.008), (0.05, 0.05, 0.05), 1)
    top = table_gaussians()
    stain = (top.means[:, :2] - torch.tensor([-0.2, 0.1])).norm(dim=1) < 0.07
    top = replace(top, sh=torch.where(stain[:, None, None], top.sh - 1.2, top.sh))
    scene = scene_of(top, phone, noise=0.0005)
    found = group_objects(unlabelled(scene))
    assert len(found.objects) == 1
    assert best_overlap(found.gaussians.object_id, scene.gaussians.object_id)[1] >= 0.75


def test_walls_and_floaters_are_background():
    wall = coloured_wall()
    floaters = random_gaussians(150, size=0.01)
    floaters = replace(floaters, means=floaters.means + torch.tensor([0, 0, 0.6]))
    scene = three_apart()
    scene = replace(scene, gaussians=concatenate([scene.gaussians, wall, floaters]))
    found = group_objects(unlabelled(scene))
    assert len(found.objects) == 3
    assert int((found.gaussians.object_id[-len(floaters) - len(wall) :] > 0).sum()) < 10


def coloured_wall() -> Gaussians:
    from stages.lab.assets.shapes import Surface, sheet

    flat = sheet(1.4, 0.8, 0.015)
    x, y, _ = flat.points.unbind(1)
    points = torch.stack([x, torch.full_like(x, 0.75), y + 0.4], 1)
    upright = Surface(points, torch.tensor([[0.0, -1, 0]]).repeat(len(x), 1))
    return coloured_gaussians(upright, (0.8, 0.8, 0.75), 0)


def test_transparent_gaussians_inside_an_object_are_labelled():
    scene = three_apart()
    inner = random_gaussians(40, size=0.005)
    inner = replace(
        inner, means=inner.means * 0.05 + torch.tensor([-0.2, -0.1, 0.05]), opacities=torch.full((40,), 0.05)
    )
    found = group_objects(unlabelled(replace(scene, gaussians=concatenate([scene.gaussians, inner]))))
    ids = found.gaussians.object_id
    red = ids[scene.gaussians.object_id.argmax()]
    assert float((ids[-40:] == ids[torch.nonzero(scene.gaussians.object_id == 1)[50, 0]]).float().mean()) > 0.95
    assert red > 0


def test_large_gaussian_is_labelled_only_inside_an_object():
    shell = coloured_gaussians(ellipsoid((1.0, 1.0, 1.0), 2000), (0.8, 0.1, 0.1), 1)
    blurs = random_gaussians(3)
    scales = torch.tensor([[0.4, 0.3, 0.3], [0.4, 0.3, 0.3], [0.4, 0.3, torch.inf]])
    centres = torch.tensor([[0.1, 0.0, 0.2], [0.75, 0.0, 0.0], [0.0, 0.0, 0.0]])
    blurs = replace(blurs, means=centres, scales=scales, object_id=torch.zeros(3, dtype=torch.int64))
    whole = grow_objects(concatenate([shell, blurs, replace(shell[:20], object_id=torch.zeros(20).long())]), None, 0.1)
    assert whole.object_id[len(shell) :][:3].tolist() == [1, 0, 0]


def test_objects_grow_where_no_gaussian_is_on_the_supporting_plane():
    scene = three_apart()
    support = find_support(scene)
    above = replace(support, coefficients=support.coefficients + torch.tensor([0.3, 0, 0, 0, 0, 0]))
    strays = replace(scene.gaussians[scene.gaussians.object_id == 1][:20], object_id=torch.zeros(20).long())
    higher = replace(strays, means=strays.means + torch.tensor([0.0, 0.0, 0.6]))
    body = replace(higher, means=higher.means + 0.001, object_id=torch.ones(20).long())
    assert (above.heights(scene.gaussians.means).abs() > above.tolerance).all()
    assert (grow_objects(concatenate([body, higher]), above, 0.02).object_id == 1).all()


def test_supporting_plane_is_found_without_a_floor():
    scene = replace(three_apart(tilt=0.02), floor=None)
    support = find_support(scene)
    expected = 0.02 * scene.gaussians.means[:500, 0]
    assert torch.allclose(support.surface(scene.gaussians.means[:500]), expected, atol=0.004)


def test_objects_are_ordered_by_size_with_unique_names():
    found = group_objects(unlabelled(three_apart()))
    counts = torch.bincount(found.gaussians.object_id)[1:].tolist()
    assert counts == sorted(counts, reverse=True)
    names = [o.name for o in found.objects]
    assert len(set(names)) == 3
    assert {"red", "blue", "green"} == {n.replace("tall_", "").split("_")[0] for n in names}


def test_same_seed_gives_the_same_labels():
    one, two = (group_objects(unlabelled(three_apart(noise=0.002))).gaussians.object_id for _ in range(2))
    assert torch.equal(one, two)


@pytest.mark.parametrize("kind", ["one point", "all the same", "a line", "huge", "zero scales", "not finite", "faint"])
def test_degenerate_gaussians_give_no_objects(kind):
    g = random_gaussians(200)
    g = {
        "one point": lambda: g[:1],
        "all the same": lambda: replace(g, means=torch.zeros(200, 3)),
        "a line": lambda: replace(g, means=g.means * torch.tensor([1.0, 0, 0])),
        "huge": lambda: replace(g, scales=torch.full((200, 3), 1e6), means=g.means * 1e6),
        "zero scales": lambda: replace(g, scales=torch.zeros(200, 3)),
        "not finite": lambda: replace(g, means=torch.full((200, 3), torch.nan)),
        "faint": lambda: replace(g, opacities=torch.zeros(200)),
    }[kind]()
    found = group_objects(Scene(g, floor=0.0))
    assert len(found.gaussians) == len(g)
    assert len(found.objects) <= 3
    assert view_extent(Scene(g)).radius > 0
