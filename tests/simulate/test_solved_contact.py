"""Solved contacts of the learned field, compared with textbook physics in complete runs; and their selection."""

import json
import math
from dataclasses import replace

import pytest
import torch

from stages.core.errors import InputError
from stages.core.physics.forces import ForcePrompts
from stages.core.physics.keypoints import choose_keypoints
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.shapes import Surface, box, ellipsoid, to_gaussians
from stages.lab.bench.experiments.bodies import (
    Run,
    Specimen,
    about_z,
    ball,
    bowl,
    compound,
    cylinder,
    on_slope,
    tilted,
)
from stages.lab.bench.experiments.catalogue import experiments
from stages.lab.bench.experiments.friction import ladder_angle
from stages.lab.bench.motion_options import PhysicsBenchOptions
from stages.lab.bench.physics import measure
from stages.simulate.engine_choice import with_engine
from stages.simulate.options import SimulateOptions
from tests.conftest import two_balls_scene
from tests.simulate.motion import roll_out

SOLVED = PhysicsBenchOptions(contact="solved")


@pytest.mark.parametrize(
    "name", ["bounce/friction=0.5 loss=0.15", "slope/25deg friction=0.3", "slide/stool on shelf friction=0.6",
             "collision/row of five", "pile/three logs"]
)  # fmt: skip
def test_agrees_with_theory_where_learned_contact_does_not(device, name):
    experiment = experiments()[name]
    assert experiment.passes("ngff", measure(experiment, "ngff", SOLVED)["value"])


@pytest.mark.parametrize("degrees", [10.0, 25.0])
def test_a_cylinder_rolls_down_a_slope(device, degrees):
    """It rolls straight by g sin(degrees) t^2 / 3; a polyhedron would lose energy at each edge."""
    run = on_slope(degrees, 0.02, {}, cylinder(0.1, 0.3, 0.01).moved((0.0, 0.0, 0.1)))
    options = SimulateOptions(engine="ngff", contact="solved", steps=31, keypoints=64, pin=("1",), device=device)
    t = roll_out(run.scene(), options)
    way = t.com[-1, 1] - t.com[0, 1]
    assert float(way.norm()) == pytest.approx(9.81 * math.sin(math.radians(degrees)) * 0.6**2 / 3, rel=0.01)
    assert abs(float(way[1])) < 1e-3


def test_a_cylinder_rolls_on_the_floor_at_two_thirds_of_its_speed(device):
    scene = Run((Specimen(about_z(cylinder(0.1, 0.3, 0.01), 33.0).moved((0.0, 0.0, 0.1))),)).scene()
    options = SimulateOptions(engine="ngff", contact="solved", steps=60, keypoints=64, velocity=("object=1 1,0,0",),
                              friction=0.0, device=device)  # fmt: skip
    assert float(roll_out(scene, options).com[-1, 0, 0]) == pytest.approx(59 * 0.02, rel=1e-3)  # it slides
    along = math.cos(math.radians(33.0)), math.sin(math.radians(33.0))
    options = replace(options, velocity=(f"object=1 {along[0]},{along[1]},0",), friction=0.5)
    t = roll_out(scene, options)
    assert float((t.com[-1, 0] - t.com[-11, 0]).norm()) == pytest.approx(2 / 3 * 0.2, rel=5e-3)


@pytest.mark.parametrize("upright", [True, False])
def test_what_stands_and_lies_on_cylinders_stays(device, upright):
    """A small box on a can, and a plank balanced on the middle of a pinned log."""
    can = cylinder(0.1, 0.3, 0.01)
    if upright:
        can = Surface(can.points[:, [0, 2, 1]], can.normals[:, [0, 2, 1]])
        bodies = can.moved((0.0, 0.0, 0.15)), box((0.06, 0.06, 0.06), 0.005).moved((0.03, 0.0, 0.33))
    else:
        bodies = can.moved((0.0, 0.0, 0.1)), box((0.5, 0.1, 0.04), 0.008).moved((0.0, 0.0, 0.22))
    scene = Run(tuple(Specimen(b) for b in bodies)).scene()
    pins = () if upright else ("1",)
    t = roll_out(
        scene, SimulateOptions(engine="ngff", contact="solved", steps=50, keypoints=64, pin=pins, device=device)
    )
    assert float((t.com[-1] - t.com[0]).norm(dim=1).max()) < 2e-3


def test_a_light_ball_between_heavy_ones_keeps_momentum_and_gains_no_energy(device, tmp_path):
    """It rebounds from both alternately, more often than substeps can resolve."""
    masses = torch.tensor([1.0, 1e-3, 1.0])
    balls = [ball(0.1, (x, 0.0, 0.5), density=1000 * float(m)) for x, m in zip((-0.25, 0.0, 0.2), masses, strict=True)]
    path = tmp_path / "m.json"
    path.write_text(json.dumps({str(i + 1): b.material() for i, b in enumerate(balls)}))
    options = SimulateOptions(engine="ngff", contact="solved", steps=16, keypoints=64, gravity=0.0, materials=path,
                              velocity=("object=1 1,0,0",), device=device)  # fmt: skip
    t = roll_out(Run(tuple(balls)).scene(), options)
    velocity = (t.com[-1] - t.com[-2])[:, 0] / options.dt
    assert float(masses @ velocity) == pytest.approx(1.0, abs=1e-3)
    assert float(masses @ velocity**2) < 1.0
    assert float(velocity[2]) > float(velocity[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", [
    "slide/friction=0.1", "slide/soft friction=0.3", "slope/40deg friction=0.3", "tower/3 for 2s", "roll/25deg",
    "rebound/box loss=0.15", "boxes/0.06m 540kg/m3 1e+07Pa",
])  # fmt: skip
def test_agrees_with_theory(device, name):
    test_agrees_with_theory_where_learned_contact_does_not(device, name)


def test_is_the_default_for_stiff_bodies():
    with pytest.raises(InputError, match="--contact hard: choose from auto, learned, solved"):
        SimulateOptions(contact="hard")
    with pytest.raises(InputError, match="--contact solved: only works with --engine ngff, not with --engine rigid"):
        SimulateOptions(engine="rigid", contact="solved")
    scene = two_balls_scene()

    def chosen(**options):
        return with_engine(SimulateOptions(**options), scene, choose_keypoints(scene, 32))

    assert chosen(contact="solved").engine == "ngff"
    soft = {"material": ("1=pillow",)}
    for options, contact in (({}, "solved"), (soft, "learned"), ({"integrator": "rk4"}, "learned"),
                             ({**soft, "contact": "solved"}, "solved")):  # fmt: skip
        assert chosen(engine="ngff", **options).contact == contact
    thrown = ForcePrompts(velocity={2: (0.5, 0.0, 0.0)})
    options = SimulateOptions(engine="ngff", **soft)
    assert with_engine(options, scene, choose_keypoints(scene, 32), thrown).contact == "solved"


def test_balls_that_overlap_at_the_start_are_not_pushed_apart(device):
    """They are side by side on the floor and overlap by 1/20 of their radius."""
    surfaces = [ellipsoid((0.1,) * 3, 2000).moved((x, 0.0, 0.1)) for x in (0.0, 0.195)]
    grey = torch.full((2000, 3), 0.5)
    parts = [to_gaussians(s, grey[: len(s.points)], i + 1, widest=math.inf) for i, s in enumerate(surfaces)]
    scene = Scene(concatenate(parts), (SceneObject(1, "left"), SceneObject(2, "right")), None, 0.0)
    t = roll_out(scene, SimulateOptions(engine="ngff", contact="solved", steps=16, keypoints=64, device=device))
    assert float((t.com[-1] - t.com[0]).norm(dim=1).max()) < 1e-3


def test_a_ring_of_random_gaussians_has_its_volume_and_inertia(device):
    """Volume 2 pi^2 R r^2; inertia per mass R^2 + 3/4 r^2 about the axis and R^2 / 2 + 5/8 r^2 perpendicular to it."""
    R, r = 0.2, 0.06
    rng = torch.Generator().manual_seed(0)
    a, b, keep = torch.rand(3, 9000, generator=rng) * torch.tensor([2 * math.pi, 2 * math.pi, R + r])[:, None]
    a, b = (angle[keep < R + r * b.cos()] for angle in (a, b))  # uniform over the area
    out = torch.stack([a.cos() * b.cos(), a.sin() * b.cos(), b.sin()], 1)
    points = R * torch.stack([a.cos(), a.sin(), torch.zeros_like(a)], 1) + r * out + torch.tensor([0, 0, 1.0])
    grey = torch.full((len(points), 3), 0.5)
    scene = Scene(to_gaussians(Surface(points, out), grey, 1), (SceneObject(1, "ring"),), None, 0.0)
    t = roll_out(scene, SimulateOptions(engine="ngff", contact="solved", steps=1, keypoints=64, device=device))
    assert float(t.field.volume[0]) == pytest.approx(2 * math.pi**2 * R * r**2, rel=0.05)
    across = R**2 / 2 + 5 / 8 * r**2
    expected = t.field.units.length**2 * torch.diag(torch.tensor([across, across, R**2 + 3 / 4 * r**2]))
    torch.testing.assert_close(t.field.inertia[0], expected, rtol=0.03, atol=0.03 * float(expected[0, 0]))


WALL = compound(0.012, ((0.5, 0.4, 0.04), (0.0, 0.0, 0.02)), ((0.04, 0.4, 0.36), (-0.23, 0.0, 0.22)))


@pytest.mark.parametrize("name", ["wall", "bowl", "plate"])
def test_nothing_passes_through_a_wall_in_a_step(device, name):
    """A ball of radius 0.05 at 60 m/s moves 0.15 per substep, in an L and near the bottom of a bowl.

    In the third case, a push within one frame gives a ball in front of a plate 400 m/s.
    """
    body, at, push = {
        "wall": (WALL, (0.1, 0.0, 0.1), {"velocity": ("object=1 -60,0,0",)}),
        "bowl": (bowl(0.28, 0.3), (0.0, 0.0, 0.08), {"velocity": ("object=1 -60,0,0",)}),
        "plate": (box((0.04, 0.4, 0.4), 0.01).moved((-0.23, 0.0, 0.2)), (-0.05, 0.0, 0.2),
                  {"force": (f"object=1 force=-{400 / 0.01 * 540 * 4 / 3 * math.pi * 0.05**3},0,0 from=0 to=0.01",)}),
    }[name]  # fmt: skip
    parts = [to_gaussians(s, torch.full((len(s.points), 3), 0.5), i + 1, widest=math.inf)
             for i, s in enumerate((ellipsoid((0.05,) * 3, 1500).moved(at), body))]  # fmt: skip
    scene = Scene(concatenate(parts), (SceneObject(1, "ball"), SceneObject(2, "body")), None, 0.0)
    t = roll_out(scene, SimulateOptions(engine="ngff", contact="solved", steps=6, dt=0.01, gravity=0.0, pin=("2",),
                                        keypoints=64, device=device, **push))  # fmt: skip
    com = t.com[:, 0]
    if name == "bowl":  # the ball moves up the wall and over the rim
        assert bool((com[com[:, 2] < 0.3] - torch.tensor([0.0, 0.0, 0.3])).norm(dim=1).max() < 0.26)
        assert float(com[-1, 2]) > 0.5
    else:
        assert float(com[:, 0].min()) > -0.21


@pytest.mark.parametrize(("friction", "share"), [(0.0, 1.0), (0.5, 1 / 1.8)])
def test_a_ball_touches_both_sides_of_a_groove(device, friction, share):
    """In an L on its edge; the ball rolls at 1 / (1 + 2/5 r^2 / d^2) of its speed, with d = r / sqrt(2)."""
    radius, at = 0.05, (-0.21 + 0.05, -0.15, 0.04 + 0.05)
    bodies = [tilted(body, -45).moved((0, 0, 0.5)) for body in (WALL, ellipsoid((radius,) * 3, 1500).moved(at))]
    scene = Run(tuple(Specimen(b, loss=0.02) for b in bodies)).scene()
    t = roll_out(scene, SimulateOptions(engine="ngff", contact="solved", steps=31, pin=("1",), friction=friction,
                                        velocity=("object=2 0,.4,0",), keypoints=64, device=device))  # fmt: skip
    path = t.com[:, 1] - t.com[0, 1]
    assert float(path[-1, 1] - path[-11, 1]) / 0.2 == pytest.approx(0.4 * share, rel=0.02)
    assert float(path[:, [0, 2]].norm(dim=1).max()) < 0.02 * radius


def test_an_edge_slides_along_a_face_without_a_jolt(device):
    """A ladder between a wall and a floor without friction rotates from 60 to 40 degrees."""
    length, thick, start = 1.0, 0.1, math.radians(60)
    faces = []
    for axis, sides in enumerate(((0.2, thick), (length, thick), (length, 0.2))):
        grid = torch.cartesian_prod(*(torch.linspace(-s / 2, s / 2, round(s / 0.01) + 1) for s in sides))
        for side in (-1.0, 1.0):
            height, across = side * (length, 0.2, thick)[axis] / 2, [a for a in range(3) if a != axis]
            points, normals = torch.full((len(grid), 3), height), torch.zeros(len(grid), 3)
            points[:, across], normals[:, axis] = grid, side
            faces.append(Surface(points, normals))
    plank = tilted(Surface(*(torch.cat([getattr(f, n) for f in faces]) for n in ("points", "normals"))), 60)
    low = plank.points.amin(0)
    bodies = box((0.1, 0.6, 1.2), 0.03).moved((-0.05, 0, 0.6)), plank.moved((-float(low[0]), 0.0, -float(low[2])))
    parts = [to_gaussians(s, torch.full((len(s.points), 3), 0.5), i + 1, widest=math.inf) for i, s in enumerate(bodies)]
    scene = Scene(concatenate(parts), (SceneObject(1, "wall"), SceneObject(2, "ladder")), None, 0.0)
    options = SimulateOptions(engine="ngff", contact="solved", steps=31, dt=0.01, friction=0.0, pin=("1",),
                              keypoints=128, device=device)  # fmt: skip
    t = roll_out(scene, options)
    turned = 2 * math.atan2(float(t.rotation[-1, 1, 2].abs()), float(t.rotation[-1, 1, 0].abs()))
    assert turned == pytest.approx(start - ladder_angle(length, thick, start, 0.3), rel=0.02)
