"""Changes of conditions during a simulation, bodies of uneven density, and options, with every engine."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from stages.core.backends import load
from stages.core.errors import InputError
from stages.core.physics.forces import Change, Force, ForcePrompts
from stages.core.physics.keypoints import choose_keypoints
from stages.core.physics.mpm.solver import Box, Solver
from stages.core.physics.particles import Bodies
from stages.core.scene.gaussians import concatenate
from stages.core.scene.scene import Scene, SceneObject
from stages.lab.assets.shapes import box, to_gaussians
from stages.simulate import rigid
from stages.simulate.learned import _starts_awake, _woken
from stages.simulate.mpm import _change, _PromptedForce
from stages.simulate.options import ENGINES, QUALITIES, MpmQuality, SimulateOptions
from stages.simulate.setup import set_up_scene
from tests.conftest import ball
from tests.core.physics.test_mpm import block

pytestmark = pytest.mark.usefixtures("device")
DT = 0.02


@pytest.fixture(autouse=True)
def small_draft(monkeypatch):
    monkeypatch.setitem(QUALITIES, "draft", MpmQuality(particles=800, step=0.014))


def frames(scene: Scene, prompts: ForcePrompts, **chosen) -> list:
    options = SimulateOptions(keypoints=16, quality="draft", dt=DT, **chosen)
    rollout = load(ENGINES[options.engine].rollout)
    return list(rollout(scene, choose_keypoints(scene, 16), prompts, options))


@pytest.fixture(scope="module")
def apart() -> Scene:
    """Two balls of radius 0.15 in the air."""
    parts = [ball((x, 0, 1.0), 0.15, 600, (1, 0, 0), i, seed=i) for i, x in ((1, -1.0), (2, 1.0))]
    return Scene(concatenate(parts), (SceneObject(1, "a", "common"), SceneObject(2, "b", "common")), None, 0.0)


@pytest.mark.parametrize("engine", ["rigid", "mpm", "ngff"])
def test_a_denser_material_slows_a_push_and_a_pin_stops_a_body(apart, engine):
    """Body 1 is pushed and becomes rubber at 0.1 s; 2 is pinned from 0.1 to 0.2 s. Gravity is zero until 0.2 s."""
    changes = (Change("material", "rubber", 0.1, 1), Change("pinned", True, 0.1, 2),
               Change("pinned", False, 0.2, 2), Change("gravity", 2.0, 0.2))  # fmt: skip
    prompts = ForcePrompts((Force(1, (0.0, 20.0, 0.0)),), velocity={2: (1.0, 0.0, 0.0)}, changes=changes)
    states = frames(apart, prompts, engine=engine, gravity=0.0, steps=15)
    com = torch.stack([s.com for s in states]).double()
    speed = com.diff(dim=0) / DT
    light, heavy = float(states[0].mass[0]), float(states[-1].mass[0])
    assert heavy / light == pytest.approx(930 / 540, rel=1e-3)
    gained = [float(speed[b, 0, 1] - speed[a, 0, 1]) / ((b - a) * DT) for a, b in ((0, 4), (5, 9))]
    assert gained == pytest.approx([20 / light, 20 / heavy], rel=0.03)
    assert speed[1:5, 1, 0].tolist() == pytest.approx([1.0] * 4, abs=0.02)
    assert float(speed[5:, 1, :2].abs().max()) < 0.01  # a released body starts from rest
    fall = (speed[13, :, 2] - speed[10, :, 2]) / (3 * DT)
    assert fall.tolist() == pytest.approx([-2.0, -2.0], rel=0.03)


def test_what_rests_in_photos_moves_when_its_material_or_gravity_changes(apart, monkeypatch):
    """The support of the balls is not visible. Ball 1 falls when its material changes at 0.04 s, later both fall."""
    monkeypatch.setattr(rigid, "held_as_seen", lambda scene, options: True)
    changes = Change("material", "rubber", 0.04, 1), Change("gravity", 5.0, 0.1)
    z = torch.stack([s.com[:, 2] for s in frames(apart, ForcePrompts(changes=changes), engine="rigid", steps=9)])
    fallen = (z < z[0] - 1e-4).T.tolist()
    assert fallen == [[False] * 3 + [True] * 6, [False] * 6 + [True] * 3]


def test_a_ball_rebounds_by_the_loss_of_the_material_that_it_has_become(apart):
    """It rebounds from the floor, without gravity, as if it had the material from the start."""
    speeds = {}
    rubber = Change("material", "rubber", 0.04, 1)
    for name, given, changes in (("before", (), ()), ("after", ("1=rubber",), ()), ("changed", (), (rubber,))):
        prompts = ForcePrompts(velocity={1: (0.0, 0.0, -8.0)}, changes=changes)
        z = [float(s.com[0, 2]) for s in frames(apart, prompts, engine="rigid", gravity=0.0, steps=9, material=given)]
        speeds[name] = (z[8] - z[7]) / DT
    assert speeds["changed"] == pytest.approx(speeds["after"], rel=0.02)
    assert speeds["after"] > 1.2 * speeds["before"] > 0


@pytest.mark.parametrize("engine", ["rigid", "mpm", "ngff"])
def test_the_first_frame_is_the_lifted_scene(apart, engine):
    keypoints = choose_keypoints(apart, 16)
    first, second = frames(apart, ForcePrompts(lift={2: 0.5}), engine=engine, steps=2)
    up = 0.5 * (keypoints.object_id == 2)[:, None] * torch.tensor([0.0, 0.0, 1.0])
    torch.testing.assert_close(first.positions, keypoints.rest + up)
    assert first.com[:, 2].tolist() == pytest.approx([1.0, 1.5], abs=0.02)
    assert float((second.com - first.com).norm(dim=1).max()) < 0.005  # a fall by 2 mm


@pytest.mark.parametrize("engine", ["rigid", "mpm"])
def test_the_centre_of_mass_of_an_uneven_bar(tmp_path, monkeypatch, engine):
    """In a bar of length 0.4 the half at x < 0 is four times as dense, so the centre is at -3/20 of the length."""
    monkeypatch.setitem(QUALITIES, "draft", MpmQuality(particles=6000, step=0.027))
    bar = box((0.4, 0.1, 0.1), 0.0125).moved((0, 0, 1.0))
    bar = to_gaussians(bar, torch.full((len(bar.points), 3), 0.5), 1)
    scene = Scene(bar, (SceneObject(1, "bar"),), None, 0.0)
    material = {"E": 1e7, "density": 400}
    parts = [{"box": [-1, -1, 0, 0, 1, 2], "material": {**material, "density": 1600}}, {"material": material}]
    (tmp_path / "m.json").write_text(json.dumps({"bar": {"parts": parts}}))
    state = frames(scene, ForcePrompts(), engine=engine, gravity=0.0, steps=1, materials=tmp_path / "m.json")[0]
    assert state.com[0].tolist() == pytest.approx([-0.06, 0, 1.0], abs=0.006)


def test_a_fine_setup_has_half_the_spacing_and_the_same_mass(apart):
    coarse, fine = (set_up_scene(apart, ForcePrompts(), SimulateOptions(quality="draft"), refinement).bodies
                    for refinement in (1, 2))  # fmt: skip
    assert fine.spacing == coarse.spacing / 2 and len(fine.x) > 4 * len(coarse.x)
    torch.testing.assert_close(fine.volume.sum(), coarse.volume.sum(), rtol=0.03, atol=0)


def test_bodies_end_where_their_lowest_voxels_are_filled(apart, monkeypatch):
    """The lowest of voxels with edge 0.1 are filled in their upper 30 %, so the body ends 0.07 above the floor."""
    h, rng = 0.1, torch.Generator().manual_seed(0)
    cells = torch.cartesian_prod(torch.arange(4), torch.arange(4), torch.arange(5))
    volume = h**3 * torch.where(cells[:, 2] == 0, 0.3, 1.0)
    x = h * (cells + 0.5 + 0.5 * (torch.rand(cells.shape, generator=rng) - 0.5))
    body = Bodies(x, torch.zeros(len(x), dtype=torch.int64), volume, h)
    monkeypatch.setattr("stages.simulate.setup.sample_bodies", lambda *_, **__: body)
    monkeypatch.setattr("stages.simulate.setup.surface_particles", lambda *_, **__: body)
    one = replace(apart, gaussians=apart.gaussians[apart.gaussians.object_id == 1], objects=apart.objects[:1])
    placed = set_up_scene(one, ForcePrompts(), SimulateOptions(quality="draft"), refinement=1)
    assert placed.floor_offset[0].tolist() == pytest.approx([0.0, 0.0, -0.07], abs=1e-6)


def test_only_what_is_below_the_floor_after_a_lift_is_placed_on_it(apart):
    """Two balls end 0.85 above the floor; one is lowered by 0.95, the other lifted by 1.2."""
    setup = set_up_scene(apart, ForcePrompts(lift={1: -0.95, 2: 1.2}), SimulateOptions(quality="draft"))
    h, body = setup.bodies.spacing, setup.bodies.body
    assert setup.floor_offset[0].tolist() == pytest.approx([0.0, 0.0, 0.1], abs=0.5 * h)
    assert not setup.floor_offset[1].any() and setup.on_floor.tolist() == [True, False]
    assert not setup.on_floor_as_seen.any()
    assert float(setup.start[body == 0, 2].quantile(0.01)) == pytest.approx(1.5 * h, abs=0.1 * h)
    torch.testing.assert_close(setup.start[body == 1], setup.bodies.x[body == 1] + torch.tensor([0.0, 0.0, 1.2]))


def test_mpm_refuses_another_material_model_during_a_simulation(apart):
    with pytest.raises(InputError, match=r"object 2 \(b\) cannot become snow.*has a different material model"):
        frames(apart, ForcePrompts(changes=(Change("material", "snow", 0.0, 2),)), engine="mpm", steps=2)


def test_gravity_wakes_all_objects_and_other_changes_their_own():
    ids = [3, 5, 8]
    assert _woken((Change("gravity", 1.0, 0.0),), ids).tolist() == [True, True, True]
    changes = (Change("material", "jelly", 0.0, 5), Change("pinned", False, 0.0, 8))
    assert _woken(changes, ids).tolist() == [False, True, True] and not _woken((), ids).any()


@pytest.mark.parametrize("gravity", [-1.0, 0.0, 0.5, 9.81])
def test_what_moves_at_the_start_or_is_not_held_down_is_awake(gravity):
    """Four objects: at rest, with a velocity, lifted, and with a velocity and a lift of one unit each."""
    velocity, lift = torch.zeros(1, 4, 3), torch.zeros(4, 3)
    velocity[0, 1, 2], lift[2, 2], velocity[0, 3], lift[3] = -0.3, 0.2, 1.0, 1.0
    awake = _starts_awake(SimpleNamespace(velocity=velocity), SimpleNamespace(gravity=gravity),
                          SimpleNamespace(lift=lift))  # fmt: skip
    assert awake.tolist() == [gravity <= 0, True, True, True]


def test_a_sliding_body_has_the_friction_of_its_new_material():
    """Two boxes slide by v^2 / 2 mu g on the floor; the second one becomes rubber at the start."""
    flat = [box((0.2, 0.2, 0.1), 0.02).moved((x, 0.0, 0.05)) for x in (-0.5, 0.5)]
    g = concatenate([to_gaussians(s, torch.full((len(s.points), 3), 0.5), i, widest=math.inf)
                     for i, s in enumerate(flat, 1)])  # fmt: skip
    scene = Scene(g, (SceneObject(1, "a", "common"), SceneObject(2, "b", "common")), None, 0.0)
    prompts = ForcePrompts(velocity={1: (0.0, 1.0, 0.0), 2: (0.0, 1.0, 0.0)},
                           changes=(Change("material", "rubber", 0.0, 2),))  # fmt: skip
    states = frames(scene, prompts, engine="rigid", steps=14)
    way = (states[-1].com - states[0].com)[:, 1].tolist()
    assert way == pytest.approx([1 / (2 * mu * 9.81) for mu in (0.5, 0.8)], rel=0.05)


def test_new_materials_and_pins_reach_the_solver_of_mpm():
    particles = block((0.1, 0.1, 0.1), 0.05, low=(0, 0, 0.2))
    particles.v[:], particles.C[:] = torch.tensor([1.0, -2.0, 3.0]), torch.eye(3)
    half = torch.arange(len(particles)) < len(particles) // 2
    new = replace(particles, mass=2 * particles.mass, stiffness=3 * particles.stiffness, held=half.to(torch.int8),
                  friction=particles.friction + 0.1, plastic=particles.plastic + 0.2)  # fmt: skip
    solver = Solver(particles, Box((-0.5, -0.5, 0.0), (0.5, 0.5, 0.5)), 0.05)
    _change(solver, particles, new)
    for name in ("mass", "stiffness", "held", "friction", "plastic"):
        assert torch.equal(getattr(solver.particles, name), getattr(new, name)), name
        assert getattr(particles, name) is getattr(new, name)
    moving = (~half).float()[:, None]  # pinned particles stop
    assert torch.equal(solver.particles.v, moving * torch.tensor([1.0, -2.0, 3.0]))
    assert torch.equal(solver.particles.C, moving[..., None] * torch.eye(3))


def small_setup(x: torch.Tensor, body: list[int]) -> SimpleNamespace:
    return SimpleNamespace(start=x, bodies=SimpleNamespace(x=x, body=torch.tensor(body), spacing=0.1))


def test_forces_on_particles_sum_to_the_force_and_the_torque_that_are_asked_for():
    rng = torch.Generator().manual_seed(0)
    x, mass = torch.rand(40, 3, generator=rng) + 3, torch.rand(40, generator=rng) + 0.5
    setup = small_setup(x, [0] * 30 + [1] * 10)
    particles = SimpleNamespace(mass=mass, held=torch.zeros(40))
    push, turn = torch.tensor([1.0, -2.0, 3.0]), torch.tensor([0.5, 0.2, -0.3])
    force = Force(1, tuple(push.tolist()), tuple(turn.tolist()), start=0.0, end=0.3)
    a = _PromptedForce(force, particles, setup, 0).acceleration(x, 0.2, 0.4)  # acts during half of the time
    total = (mass[:, None] * a)[:30]
    torch.testing.assert_close(total.sum(0), push / 2)
    centre = (mass[:30, None] * x[:30]).sum(0) / mass[:30].sum()
    torch.testing.assert_close(torch.linalg.cross(x[:30] - centre, total).sum(0), turn / 2, atol=1e-4, rtol=1e-4)
    assert not a[30:].any()


def test_a_force_at_a_point_acts_on_the_particles_near_it():
    """Weights are Gaussian with a width of 4 spacings about the nearest particle, and zero beyond 8 spacings."""
    x = torch.tensor([[0.2, 0, 0], [0.6, 0, 0], [0.95, 0, 0], [1.05, 0, 0]])
    particles = SimpleNamespace(mass=torch.ones(4), held=torch.zeros(4))
    a = _PromptedForce(Force(1, (1.0, 0.0, 0.0), at=(0.0, 0.0, 0.0)), particles, small_setup(x, [0] * 4), 0)
    weight = torch.exp(-((torch.tensor([0.0, 0.4, 0.75]) / 0.4) ** 2) / 2)
    torch.testing.assert_close(a.acceleration(x, 0.0, 1.0)[:, 0], torch.cat([weight / weight.sum(), torch.zeros(1)]))


@pytest.mark.parametrize("options", [{"port": 8000}, {"browser": False}])
def test_options_of_the_page_need_live(options):
    assert replace(SimulateOptions(live=True), **options).live
    with pytest.raises(InputError, match="only work with --live"):
        SimulateOptions(**options)
