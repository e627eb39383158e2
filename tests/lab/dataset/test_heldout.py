"""Objects other than the ten: held-out shapes, random shapes, solid shapes, rotated objects and meshes."""

import json

import h5py
import pytest
import torch

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.models.field.solidity import REFERENCE_THICKNESS
from stages.lab.assets.heldout_shapes import HELDOUT_SHAPES, ShapeKind, surface_points
from stages.lab.assets.objects import OBJECTS
from stages.lab.assets.random_shapes import random_shapes
from stages.lab.assets.signed_distance import ellipsoid
from stages.lab.dataset import extra_objects, object_particles
from stages.lab.dataset.extra_objects import load_shape_assets, random_mesh_assets, rotated_assets
from stages.lab.dataset.heldout import run, sample_configs
from stages.lab.dataset.keypoint_motions import read_motions
from stages.lab.dataset.object_particles import Asset, particle_volumes
from stages.lab.dataset.options import Discretisation, HeldoutOptions
from stages.lab.dataset.scene_configs import read_scene_configs
from stages.lab.dataset.selection import EXTRA_GROUPS, HELDOUT, parse_groups
from tests.conftest import CliRunner

DISCRETISATION = Discretisation(dx=0.1, spacing=0.06, substep=5e-4)
COARSE = {"keypoints": 40, "dx": 0.1, "spacing": 0.06, "substep": 5e-4, "frames": 3}


def test_held_out_objects_differ_from_the_ten():
    assert not HELDOUT_SHAPES.keys() & OBJECTS.keys()
    assert not {k.id for k in HELDOUT_SHAPES.values()} & {k.id for k in OBJECTS.values()}


@pytest.mark.parametrize("name", HELDOUT_SHAPES)
def test_surface_points_are_evenly_spaced(name):
    points = surface_points(HELDOUT_SHAPES[name], 2000)
    sides = points.amax(0) - points.amin(0)
    assert len(points) == 2000 and float(sides.max()) == pytest.approx(1.0)
    assert (points.amax(0) + points.amin(0)).abs().max() < 1e-5
    gap = torch.cdist(points, points).fill_diagonal_(9).min(1).values
    # for random points, a tenth of the distances would be below a fifth of the median
    assert float((gap < 0.2 * gap.median()).float().mean()) < 0.01 and float(gap.max()) < 4 * float(gap.median())


def test_ball_is_round_and_knot_is_connected():
    ball = surface_points(HELDOUT_SHAPES["soccer"], 1000)
    assert (ball.norm(dim=1) - 0.5).abs().max() < 2e-3
    knot = surface_points(HELDOUT_SHAPES["rope2"], 600)
    near = torch.cdist(knot, knot) < 0.11
    reached = torch.zeros(600, dtype=torch.bool)
    reached[0] = True
    for _ in range(100):
        reached = (near & reached).any(1)
    assert reached.all()


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Cached particles of all shapes, sampled with few points."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(extra_objects, "SURFACE_POINTS", 2000)
        path = tmp_path_factory.mktemp("held") / "p.npz"
        load_shape_assets(HELDOUT_SHAPES, DISCRETISATION, 40, path)
    return path


@pytest.fixture(scope="module")
def assets(cache):
    return load_shape_assets(HELDOUT_SHAPES, DISCRETISATION, 40, cache)


def test_scenes_are_sampled_as_in_the_data_set(assets):
    configs = sample_configs(assets, 3, 3)
    assert configs == sample_configs(assets, 3, 3) and [n.split("_")[0] for n in configs] == ["10000", "10001", "10002"]
    for c in configs.values():
        assert (
            len(c.ids) == 3
            and c.translation[0] == (0.0, 0.0, 0.0)
            and set(c.ids) <= {k.id for k in HELDOUT_SHAPES.values()}
        )


def test_group_is_written_once(assets, tmp_path, monkeypatch):
    monkeypatch.setattr(extra_objects, "load_shape_assets", lambda *_: assets)
    options = HeldoutOptions(scenes=2, **COARSE)
    assert "2 scenes of 8 objects" in run(tmp_path, options)
    made = read_motions(tmp_path / "motions" / f"{HELDOUT}.h5")
    assert made.points.shape == (2, 3, 3, 40, 3) and list(made.names) == list(
        read_scene_configs(tmp_path / "scene_configs" / f"{HELDOUT}.json")
    )
    kinds = {k.id: k for k in HELDOUT_SHAPES.values()}
    for row, ids in enumerate(made.objects.tolist()):
        assert [float(E) for E in made.E[row]] == [kinds[i].E for i in ids]
    # unsupported objects fall with 5 m/s^2 for two frames
    dropped = (made.points[:, 0, :, :, 2] - made.points[:, 2, :, :, 2]).amax()
    assert float(dropped) == pytest.approx(5 / 2 * 0.04**2, rel=0.15, abs=2e-4)
    assert "exists already" in run(tmp_path, options)


def test_particles_are_cached(assets, cache, tmp_path, monkeypatch):
    monkeypatch.setattr(extra_objects, "_shape_particles", None)  # must not be called
    again = load_shape_assets(HELDOUT_SHAPES, DISCRETISATION, 40, cache)
    assert all(torch.equal(assets[i].points, again[i].points) for i in assets) and len(again) == 8
    (tmp_path / "p.npz").write_text("no")
    with pytest.raises(InputError, match="p.npz"):
        load_shape_assets(HELDOUT_SHAPES, DISCRETISATION, 40, tmp_path / "p.npz")


def test_meshes_replace_the_shapes(tmp_path, caplog):
    trimesh = pytest.importorskip("trimesh")
    (tmp_path / "pillow").mkdir()
    trimesh.creation.box((2.0, 1.0, 0.5)).export(tmp_path / "pillow" / "mesh.obj")
    trimesh.creation.icosphere(2, 3.0).export(tmp_path / "steel_thing.stl")
    args = ["heldout", str(tmp_path), "--scenes", "1", "--objects", "2", "--size", "0.3"]
    for key in ("keypoints", "dx", "spacing", "substep", "frames"):
        args += [f"--{key}", str(COARSE[key])]
    for mesh in ("pillow/mesh.obj", "steel_thing.stl"):
        args += ["--from", str(tmp_path / mesh)]
    done = CliRunner().invoke(app, args)
    assert done.exit_code == 0 and "1 scenes of 2 objects" in done.stdout, done.stderr
    made = read_motions(tmp_path / "motions" / f"{HELDOUT}.h5")
    sides = made.points[0, 0].amax(1) - made.points[0, 0].amin(1)
    for id, row in zip(made.objects[0].tolist(), sides.tolist(), strict=True):
        expected = [0.3, 0.15, 0.075] if id == 100 else [0.3] * 3
        assert row == pytest.approx(expected, abs=0.03)
    found = dict(zip(made.objects[0].tolist(), made.E[0].tolist(), strict=True))
    stiffness = {100: 1e4, 101: 2e7}  # a pillow, and steel limited to a stiffness that the solver can simulate
    assert found.items() <= stiffness.items()
    config = json.loads((tmp_path / "scene_configs" / f"{HELDOUT}.json").read_text())
    assert len(config) == 1


def test_a_folder_of_stiff_meshes_is_simulated_without_loss(tmp_path):
    """A sheet without thickness and a plank in two files, with an option for the substep that is too long for them."""
    pytest.importorskip("trimesh")
    meshes = tmp_path / "meshes"
    (meshes / "wood").mkdir(parents=True)
    (meshes / "paper sheet.obj").write_text("v 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\nf 1 2 3 4\n")
    for i in range(2):
        at = 300 * i  # for example in millimetres
        corners = "".join(f"v {x} {y} {at + z}\n" for z in (0, 200) for y in (0, 200) for x in (0, 200))
        sides = "f 1 3 4 2\nf 5 6 8 7\nf 1 2 6 5\nf 3 7 8 4\nf 1 5 7 3\nf 2 4 8 6\n"
        (meshes / "wood" / f"plank_{i}.obj").write_text(corners + sides)
    options = HeldoutOptions(scenes=2, objects=2, size=0.3, **(COARSE | {"frames": 12}))
    summary = run(tmp_path / "out", options, [meshes])
    assert "2 scenes of 2 objects" in summary and "failed" not in summary
    with h5py.File(tmp_path / "out" / "motions" / f"{HELDOUT}.h5") as file:
        made_by = json.loads(file.attrs["provenance"])
    assert [i["name"] for i in made_by["inputs"]][1:] == ["paper sheet.obj", "plank_0.obj", "plank_1.obj"]
    assert made_by["options"]["substep"] < options.substep  # the substep of the simulation is stored
    made = read_motions(tmp_path / "out" / "motions" / f"{HELDOUT}.h5")
    sides = (made.points[:, 0].amax(2) - made.points[:, 0].amin(2)).flatten(0, 1)
    for id, row in zip(made.objects.flatten().tolist(), sides.tolist(), strict=True):
        assert sorted(row) == pytest.approx([0, 0.15, 0.3] if id == 100 else [0.12, 0.12, 0.3], abs=0.03)
    start, end = (torch.cdist(made.points[:, i], made.points[:, i]) for i in (0, -1))
    assert (start - end).abs().max() < 0.05  # no object breaks


def test_meshes_become_a_training_group_of_random_sizes_and_materials(tmp_path, monkeypatch):
    trimesh = pytest.importorskip("trimesh")
    monkeypatch.setattr(extra_objects, "SURFACE_POINTS", 2000)
    trimesh.creation.box((2.0, 1.0, 0.5)).export(tmp_path / "box.obj")
    trimesh.creation.icosphere(2).export(tmp_path / "globe.stl")
    meshes = [(tmp_path / "box.obj",), (tmp_path / "globe.stl",)]
    cache = tmp_path / "cache.npz"
    made = random_mesh_assets(meshes, 6, DISCRETISATION, 40, cache=cache)
    again = random_mesh_assets(meshes, 6, DISCRETISATION, 40, cache=cache)
    other = random_mesh_assets(meshes, 6, DISCRETISATION, 40, seed=1)
    assert [a.E for a in made.values()] == [a.E for a in again.values()] != [a.E for a in other.values()]
    assert all(torch.equal(a.points, again[i].points) for i, a in made.items())
    for i, a in enumerate(made.values()):
        assert 0.25 <= a.scale <= 0.8 and 100 <= a.density <= 2700 and a.E <= 2e7
        assert (torch.cdist(a.points, a.points).amax() >= 0.9 * a.scale) and (
            a.points.amax(0) + a.points.amin(0)
        ).norm() < 0.1
        if i % 2 == 0:  # every other object is not rotated
            assert float((a.points.amax(0) - a.points.amin(0)).amax()) == pytest.approx(a.scale, rel=0.1)
    assert len({round(a.scale, 6) for a in made.values()}) == 6
    options = HeldoutOptions(scenes=2, objects=2, shapes=4, seed=1, **(COARSE | {"frames": 4}))
    assert "2 scenes of 4 objects" in run(tmp_path, options, [tmp_path])
    assert bool((read_motions(tmp_path / "motions" / "meshes_1.h5").objects >= 3000).all())
    assert parse_groups("meshes,meshes_1..meshes_2", more=EXTRA_GROUPS) == ["meshes", "meshes_1", "meshes_2"]
    with pytest.raises(InputError, match="--solid or --rotations"):
        run(tmp_path, HeldoutOptions(rotations=2), [tmp_path])


def test_random_shapes_are_reproducible_and_within_the_range_of_the_ten():
    table = random_shapes(18)
    assert [k.E for k in random_shapes(5).values()] == [k.E for k in table.values()][:5]
    assert [k.E for k in random_shapes(5, seed=1).values()] != [k.E for k in random_shapes(5).values()]
    for name, kind in table.items():
        points = surface_points(kind, 800)
        sides = points.amax(0) - points.amin(0)
        assert float(sides.max()) == pytest.approx(1.0) and float(sides.min()) > 0.02, name
        assert kind.shape()(torch.tensor([[0.6, 0.6, 0.6]])) > 0  # the shape is inside the sampled cube
        assert 0.3 <= kind.scale <= 1 and 100 <= kind.density <= 2700 and 10 <= kind.E / kind.density <= 7400
    assert len({k.id for k in table.values()} | {k.id for k in HELDOUT_SHAPES.values()}) == 18 + 8


def test_random_shapes_become_a_training_group(tmp_path, monkeypatch):
    monkeypatch.setattr(extra_objects, "SURFACE_POINTS", 2000)
    assert "2 scenes of 3 objects" in run(tmp_path, HeldoutOptions(scenes=2, shapes=3, **COARSE))
    made = read_motions(tmp_path / "motions" / "varied.h5")
    assert made.points.shape == (2, 3, 3, 40, 3) and bool((made.objects >= 1000).all())
    assert parse_groups("varied,3_0", more=("varied",)) == ["varied", "3_0"]
    with pytest.raises(InputError, match="choose from"):
        parse_groups("varied")


def test_solid_shapes_are_filled_and_have_the_mass_of_their_volume(tmp_path, monkeypatch):
    """The keypoints are still on the surface."""
    monkeypatch.setattr(extra_objects, "SURFACE_POINTS", 2000)
    kind = ShapeKind(7, 0.6, 1e4, 500.0, lambda: ellipsoid((0, 0, 0), (0.4, 0.4, 0.4)))
    ball = load_shape_assets({"ball": kind}, Discretisation(0.04, 0.03, 5e-4), 40, solid=True)[7]
    assert (ball.points[:40].norm(dim=1) - 0.3).abs().max() < 3e-3
    assert ball.points.norm(dim=1).max() < 0.304
    cache = tmp_path / "cache.npz"
    fine, coarse = (
        load_shape_assets({"ball": kind}, Discretisation(dx, 0.03, 5e-4), 40, cache, solid=True)[7]
        for dx in (0.04, 0.06)
    )
    assert torch.equal(fine.points, ball.points)
    assert len(coarse.points) < len(fine.points)  # the cache is not used for a different dx
    volume = float(4 / 3 * torch.pi * 0.3**3)
    around = float(4 * torch.pi * 0.3**2) * 0.04
    assert volume < ball.mass / 500 < volume + around  # cells at the surface count fully
    assert ball.solidity == pytest.approx((ball.mass / 500 / (24 * 0.3**2) / REFERENCE_THICKNESS) ** 3, rel=0.05)
    assert "1 scenes of 9 objects" in run(tmp_path, HeldoutOptions(scenes=1, shapes=9, solid=True, **COARSE))
    made = read_motions(tmp_path / "motions" / "solid.h5")
    assert made.initial_conditions().solidity.amax() > 1 and torch.equal(
        made.initial_conditions().solidity, made.solidity
    )
    assert parse_groups("solid,turned", more=EXTRA_GROUPS) == ["solid", "turned"]


def test_rotated_objects_keep_shape_and_material(tmp_path, monkeypatch):
    box = 0.1 * (torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([6.0, 2, 1]))
    ten = {i: Asset(i, 0.6, box, particle_volumes(box, 0.1), 1e5 * i, 300.0) for i in (1, 2)}
    made = rotated_assets(ten, 5, DISCRETISATION)
    assert list(made) == [2000, 2001, 2002, 2003, 2004] and [a.E for a in made.values()][:3] == [1e5, 2e5, 1e5]
    for a in made.values():
        assert (a.points.amax(0) + a.points.amin(0)).abs().max() < 1e-5
        torch.testing.assert_close(torch.cdist(a.points, a.points), torch.cdist(box, box), atol=1e-3, rtol=0)
    one, other = made[2000].points, made[2002].points
    assert (one - one.mean(0) - (other - other.mean(0))).norm(dim=1).mean() > 0.05
    monkeypatch.setattr(object_particles, "load_assets", lambda *_: ten)
    assert "2 scenes of 4 objects" in run(tmp_path, HeldoutOptions(scenes=2, rotations=4, **COARSE))
    assert bool((read_motions(tmp_path / "motions" / "turned.h5").objects >= 2000).all())


@pytest.mark.parametrize(
    ("choices", "message"),
    [({"scenes": 0}, "at least one scene"), ({"objects": 9}, "1 to 6 objects"), ({"size": 3.0}, "--size 3.0"),
     ({"solid": True}, "--solid needs --shapes"), ({"shapes": 2, "rotations": 2}, "cannot be combined"),
     ({"rotations": -1}, "--rotations -1"), ({"dx": 1e-9}, "--dx 1e-09: must be from 0.011 to 0.2 m"),
     ({"dx": float("nan")}, "--dx nan"), ({"spacing": 0.0}, "--spacing 0"), ({"substep": 0.0}, "--substep 0"),
     ({"substep": float("nan")}, "--substep nan"), ({"frames": 0}, "--frames and"), ({"keypoints": -1}, "--keypoints")],
)  # fmt: skip
def test_invalid_options_are_rejected(choices, message):
    with pytest.raises(InputError, match=message):
        HeldoutOptions(**choices)
