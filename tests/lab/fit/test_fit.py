"""Materials from motion: true values are found from tracks of known motion, and undetermined ones are reported."""

import json
from dataclasses import replace
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.geometry.similarity import Similarity
from stages.core.physics.forces import ForcePrompts
from stages.core.physics.materials import Material, choose_materials
from stages.core.scene.scene import SceneObject
from stages.core.scene.scene_ply import read_scene, write_scene
from stages.core.scene.trajectory import TrajectoryWriter, read_trajectory
from stages.lab.bench.experiments.bodies import Run, ball, block
from stages.lab.fit import search
from stages.lab.fit.alignment import aligned
from stages.lab.fit.fit import Fit, _command, _settled, run, solve, with_initial
from stages.lab.fit.options import MaterialFitOptions
from stages.lab.fit.parameters import fitted, material_parameters, velocity_parameters
from stages.lab.fit.problem import _first_velocity, estimate_noise, pose_problem, read_problem
from stages.lab.fit.search import (
    OUTCOME,
    PRIOR,
    Estimate,
    OutOfTime,
    Simulations,
    _derivatives,
    _evolve,
    descend,
    descent_simulations,
    final_simulations,
    interval_simulations,
    narrowed,
    simulations,
    with_intervals,
)
from stages.simulate.options import SimulateOptions
from stages.simulate.stage import run as simulate
from tests.conftest import CliRunner, ring

NOISE = 0.002  # standard deviation of positions in the tracks [m]
TRUTH = {"E": 1e7, "density": 540.0, "friction": 0.3, "loss": 0.35}
OPTIONS = MaterialFitOptions(workers=1, keypoints=16, evaluations=400)


def make_track(folder, thing, noise=NOISE, **options):
    """Files with a scene of one object and a noisy track of its motion."""
    write_scene(folder / "scene.ply", Run((thing,)).scene())
    (folder / "truth.json").write_text(json.dumps({"1": TRUTH}))
    simulate(folder / "scene.ply", folder / "exact.h5", SimulateOptions(
        engine="rigid", materials=folder / "truth.json", keypoints=16, quality="draft", **options))  # fmt: skip
    exact = read_trajectory(folder / "exact.h5")
    rng = torch.Generator().manual_seed(0)
    with TrajectoryWriter(folder / "track.h5", exact.scene, exact.info, exact.keypoints, exact.binding) as track:
        for x, com, rotation in zip(exact.positions, exact.com, exact.rotation, strict=True):
            track.append(x + noise * torch.randn(x.shape, generator=rng), com, rotation)
    return folder


@pytest.fixture(scope="module")
def slide(tmp_path_factory):
    """A flat block slides on the floor and comes to rest."""
    flat = block((0.3, 0.2, 0.1), (0.0, 0.0, 0.05))
    return make_track(tmp_path_factory.mktemp("slide"), flat, velocity=("object=1 2,0.5,0",), steps=20)


@pytest.fixture(scope="module")
def bounce(tmp_path_factory):
    """A ball falls without rotation and rebounds once."""
    folder = tmp_path_factory.mktemp("bounce")
    return make_track(folder, ball(0.1, (0.0, 0.0, 0.1)), lift=("0.2",), steps=25)


@pytest.fixture(scope="module")
def bounce_fit(bounce, device):
    """The fit of the bounce by the command, the command's output, and its file of materials."""
    fits, out = [], bounce / "m.json"
    words = ["fit", bounce / "scene.ply", bounce / "track.h5", "-o", out, "--workers", 1, "--keypoints", 16,
             "--evaluations", OPTIONS.evaluations, "--device", device]  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stages.lab.fit.fit.solve", lambda *problem: fits.append(solve(*problem)) or fits[0])
        done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    return fits[0], done.stdout, out


def of(fit, name):
    """Index of a parameter."""
    return [p.name for p in fit.problem.parameters].index(name)


@pytest.mark.slow
def test_a_slide_shows_friction_and_nothing_of_the_rebound(slide, device):
    problem = read_problem(slide / "scene.ply", slide / "track.h5", OPTIONS)
    fit = solve(problem, OPTIONS)
    assert fit.problem.options.engine == "rigid"
    assert fit.problem.noise == pytest.approx(NOISE, rel=0.1)
    for name, true in (("friction", 0.3), ("x", 2.0), ("y", 0.5)):
        k = of(fit, name)
        assert fit.is_identifiable(k) and abs(fit.value(k) - true) < 2 * fit.half_width(k) < 0.05, name
    assert not fit.is_identifiable(of(fit, "loss"))
    assert fit.rmse[1] == pytest.approx(3**0.5 * NOISE, rel=0.1) and fit.rmse[0] > 0.02
    materials, velocity = fitted(fit.problem.parameters, fit.accepted, fit.problem.materials)
    assert materials[1].loss == pytest.approx(fit.problem.materials[1].loss)  # the initial value of the search


@pytest.mark.slow
def test_two_processes_simulate_the_same_as_one(slide, device):
    problem = read_problem(slide / "scene.ply", slide / "track.h5", replace(OPTIONS, frames=4, device=device))
    costs = []
    for workers in (1, 2):
        with simulations(problem, workers) as sims:
            costs.append(sims.costs([sims.start, sims.start + 0.1], 4))
    assert costs[0] == costs[1]


def test_friction_is_found_from_near_and_its_uncertainty_is_small(slide, device):
    """Only Levenberg and Marquardt's method is used; the slide does not depend on the rebound."""
    problem = read_problem(slide / "scene.ply", slide / "track.h5", replace(OPTIONS, frames=14))
    true = {"friction": 0.3, "loss": problem.materials[1].loss, "x": 2.0, "y": 0.5}
    exact = np.array([p.coordinate(true[p.name]) for p in problem.parameters])
    with simulations(problem, 1) as sims:
        near = Estimate(exact + [0.05, 0.0, 0.02, -0.02], np.diag([0.05, 0.05, 0.02, 0.02]))
        x = descend(sims, len(problem.track), near, sims.noise)
        known = narrowed(sims, len(problem.track), Estimate(x, near.root), sims.noise)
    found = dict(zip(true, [p.value(v) for p, v in zip(problem.parameters, x, strict=True)], strict=True))
    assert found["friction"] == pytest.approx(0.3, abs=0.025) and found["x"] == pytest.approx(2.0, abs=0.05)
    friction, loss, *_ = known.deviations
    assert friction < 0.02 and loss > 0.9 * PRIOR


def test_a_rebound_shows_the_loss_factor_and_nothing_of_friction(bounce_fit):
    fit, *_ = bounce_fit
    k = of(fit, "loss")
    assert fit.is_identifiable(k) and abs(fit.value(k) - 0.35) < 2 * fit.half_width(k) < 0.05
    assert not fit.is_identifiable(of(fit, "friction"))
    assert len(fit.problem.parameters) == 2  # no velocity, because it is released from rest, and no density


def test_the_command_writes_materials_that_simulate_takes(bounce, bounce_fit):
    _, printed, out = bounce_fit
    assert "not identifiable from the motion: friction" in printed
    chosen = choose_materials(read_scene(bounce / "scene.ply").objects, file=out)
    assert chosen[1].material.loss == pytest.approx(0.35, abs=0.05)
    rows = json.loads(out.with_suffix(".fit.json").read_text())["parameters"]
    assert [row["quantity"] for row in rows if row["identifiable"]] == ["loss"]
    assert f"--materials {out} --lift 1=0.2" in printed


def test_the_command_that_repeats_the_motion_has_the_velocity(slide):
    problem = read_problem(slide / "scene.ply", slide / "track.h5", OPTIONS)
    fit = Fit(problem, Estimate(np.zeros(4), np.eye(4)), np.zeros(4), (0.0, 0.0), 0, 0.0)
    words = _command(slide / "scene.ply", slide / "m.json", fit, {1: (2.0, 0.5, 0.0)})
    assert words.endswith(f'--materials {slide / "m.json"} --velocity "object=1 2,0.5,0"')


def test_the_command_that_repeats_the_motion_has_its_conditions(slide):
    """Objects not held at rest, and a gravity other than that of `ngff simulate`, for a track on the moon."""
    scene, truth = read_scene(slide / "scene.ply"), read_trajectory(slide / "track.h5")
    moon = replace(truth, info=replace(truth.info, gravity=(0.0, 0.0, -1.62)))
    problem = pose_problem(scene, moon, ForcePrompts(), replace(OPTIONS, rest=False))
    assert not problem.options.rest and problem.options.gravity == pytest.approx(1.62)
    fit = Fit(problem, Estimate(np.zeros(4), np.eye(4)), np.zeros(4), (0.0, 0.0), 0, 0.0)
    assert "--engine rigid --no-rest --gravity 1.62 --materials" in _command(
        slide / "scene.ply", slide / "m.json", fit, {}
    )
    held = replace(problem, options=replace(problem.options, rest=True, gravity=9.81))
    assert "--engine rigid --materials" in _command(
        slide / "scene.ply", slide / "m.json", replace(fit, problem=held), {}
    )


@pytest.mark.parametrize(("heights", "stands", "found"), [
    ([0.0, -0.001, -0.003, -0.002, -0.001], False, {}),  # settles on its support
    ([0.0, -0.00196, -0.00785, -0.01766, -0.03139], False, {}),  # is released from rest
    ([0.0, 0.01804, 0.03215, 0.04234, 0.04861], True, {"x": 0.0, "y": 0.0, "z": 1.0}),  # is thrown upwards with 1 m/s
    ([0.0, -0.0036, -0.0072, -0.0108, -0.0144], False, {"x": 0.0, "y": 0.0, "z": 0.1463}),
    # a standing object cannot fall, so this is an error of the track's depth
    ([0.0, -0.0036, -0.0072, -0.0108, -0.0144], True, {}),
])  # fmt: skip
def test_what_settles_or_stands_does_not_fly(heights, stands, found, slide):
    """Of two explanations of the heights in the first five frames, the closer possible one is chosen."""
    problem = read_problem(slide / "scene.ply", slide / "track.h5", OPTIONS)
    centre = torch.tensor([[0.0, 0.0, z] for z in heights])
    velocity = _first_velocity(problem, centre, 0.0025, stands)
    assert velocity == pytest.approx(found, abs=1e-3)


def test_what_stands_gets_no_vertical_velocity_from_errors_of_the_depth(slide):
    scene, truth = read_scene(slide / "scene.ply"), read_trajectory(slide / "track.h5")
    sinking = torch.tensor([0.0, 0.0, -0.18]) * truth.info.dt * torch.arange(len(truth))[:, None, None]
    problem = pose_problem(scene, replace(truth, positions=truth.positions + sinking), ForcePrompts(), OPTIONS)
    assert [p.name for p in problem.parameters] == ["friction", "loss", "x", "y"]


def test_the_learned_engine_is_fitted_with_contacts_that_know_stiffness(slide):
    """The object is stiff, so that `ngff simulate` would use solved contacts by default."""
    problem = read_problem(slide / "scene.ply", slide / "track.h5", replace(OPTIONS, engine="ngff"))
    assert [p.name for p in problem.parameters] == ["friction", "loss", "E", "x", "y"]
    fit = Fit(problem, Estimate(np.zeros(5), np.eye(5)), np.zeros(5), (0.0, 0.0), 0, 0.0)
    words = _command(slide / "scene.ply", slide / "m.json", fit, {})
    assert "--engine ngff --contact learned --materials" in words


@pytest.mark.slow
@pytest.mark.skipif(find_spec("cma") is None, reason="cma is not installed")
def test_cma_es_comes_nearer_from_far_away(slide, device, monkeypatch):
    monkeypatch.setattr(search, "GENERATIONS", 5)
    options = replace(OPTIONS, frames=8)
    problem = read_problem(slide / "scene.ply", slide / "track.h5", options)
    far = np.array([0.9, 0.5, 0.6, 0.4])
    with simulations(problem, 1) as sims:
        near = _evolve(sims, 8, far, Estimate(far, np.eye(4) / 4), 0, options)
        before, after = sims.costs([far, near], 8)
    assert after < before / 2


def test_tracks_that_do_not_fit_the_scene_are_refused(slide):
    scene, truth = read_scene(slide / "scene.ply"), read_trajectory(slide / "track.h5")
    nothing = ForcePrompts()
    with pytest.raises(InputError, match="no object of this scene"):
        pose_problem(replace(scene, objects=()), truth, nothing, OPTIONS)
    with pytest.raises(InputError, match="starts at another position"):
        pose_problem(scene, replace(truth, positions=truth.positions + torch.tensor([0.2, 0, 0])), nothing, OPTIONS)
    with pytest.raises(InputError, match="no object moves"):
        pose_problem(scene, replace(truth, positions=truth.positions[:1].expand(len(truth), -1, -1)), nothing, OPTIONS)
    with pytest.raises(InputError, match="three or more"):
        pose_problem(scene, truth, nothing, replace(OPTIONS, frames=2))


def test_a_track_in_another_frame_is_aligned(slide):
    """Cameras with the same names define the alignment; scales, directions, ids and names of objects differ."""
    scene, truth = read_scene(slide / "scene.ply"), read_trajectory(slide / "track.h5")
    turned = torch.tensor([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    cameras, away = ring(count=3), Similarity(2.0, turned, torch.ones(3))
    gaussians = replace(scene.gaussians, object_id=5 * scene.gaussians.object_id)
    scene = replace(scene, cameras=cameras, gaussians=gaussians, objects=(SceneObject(5, "brick"),))
    moved = replace(
        truth, scene=replace(truth.scene, cameras=cameras.transformed(away)), positions=away(truth.positions),
        keypoints=replace(truth.keypoints, rest=away(truth.keypoints.rest)),
        info=replace(truth.info, gravity=(0.0, 0.0, -2 * 9.81)),
    )  # fmt: skip
    found = aligned(moved, scene, slide / "scene.ply")
    assert found.keypoints.object_id.unique().tolist() == [5]
    torch.testing.assert_close(found.positions, truth.positions, atol=1e-5, rtol=0)
    torch.testing.assert_close(found.keypoints.rest, truth.keypoints.rest, atol=1e-5, rtol=0)
    assert found.info.gravity == pytest.approx((0, 0, -9.81), abs=1e-5)


def test_a_track_with_prompts_of_another_frame_is_refused(bounce):
    """The exception are start velocities, because these are fitted."""
    scene, track = replace(read_scene(bounce / "scene.ply"), cameras=ring()), read_trajectory(bounce / "track.h5")
    with pytest.raises(InputError, match="without --align"):
        aligned(track, scene, bounce / "scene.ply")


def test_films_are_not_aligned(slide):
    with pytest.raises(InputError, match="only a track can be aligned"):
        run(slide / "scene.ply", [slide / "film.mp4"], slide / "m.json", replace(OPTIONS, align=True))


def test_parameters_become_materials_and_velocities():
    m = Material(E=1e6, density=500.0)
    parameters = material_parameters(1, m, ("friction", "density", "E")) + velocity_parameters(1, {"x": 1.0, "y": 0.0})
    x = [p.coordinate(p.start) for p in parameters]
    materials, velocity = fitted(parameters, x, {1: m})
    assert pytest.approx(1e6) == materials[1].E and materials[1].density == pytest.approx(500)
    assert velocity == {1: (pytest.approx(1.0), pytest.approx(0.0), 0.0)}
    materials, velocity = fitted(parameters, [1.0, 1.0, 0.0, 1.0, 0.0], {1: m})
    assert materials[1].friction == 1.2 and materials[1].density == pytest.approx(5000)  # ten times the initial density
    assert pytest.approx(1e3) == materials[1].E and velocity == {1: (2.0, -1.0, 0.0)}


def test_noise_is_estimated_beside_motion_and_collisions():
    t = torch.arange(50)[:, None, None] * 0.02
    path = torch.where(t < 0.5, 2 * t, 2 - 2 * t) * torch.tensor([1.0, 0, 0]) - 4.9 * t**2 * torch.tensor([0, 0, 1.0])
    rng = torch.Generator().manual_seed(0)
    track = path + 0.003 * torch.randn(50, 20, 3, generator=rng)
    # 3,000 correlated third differences have an error of a few percent
    assert estimate_noise(track) == pytest.approx(0.003, rel=0.06)


def test_parameters_that_act_together_keep_their_sum():
    sum_known, difference = np.array([[1.0], [1.0]]) / 2**0.5, np.array([[1.0], [-1.0]]) / 2**0.5
    found = Estimate(np.array([0.3, 0.4]), np.hstack([0.01 * sum_known, 0.3 * difference]))
    accepted = with_initial(found, np.array([0.15, 0.15]), [0, 1])
    assert accepted == pytest.approx([0.15, 0.55], abs=0.002)  # 0.15 for both would be wrong
    alone = Estimate(found.x, np.diag([0.2, 0.01]))
    assert with_initial(alone, np.array([0.15, 0.15]), [0]) == pytest.approx([0.15, 0.4])


@pytest.mark.parametrize("residual", [
    lambda d: d + 2 * d**2,  # with curvature, the central difference avoids the bias of one-sided ones
    lambda d: d + 100 * max(d, 0.0),  # with a different motion above, the slope below is used
    lambda d: d - 100 * max(-d, 0.0),  # and vice versa
])  # fmt: skip
def test_derivatives_are_central_but_for_a_side_with_another_motion(residual):
    step = 0.1
    sims = SimpleNamespace(residuals=lambda points, frames: [np.array([residual(float(x[0]) - 0.5)]) for x in points])
    found = float(_derivatives(sims, 1, Estimate(np.array([0.5]), np.array([[step]])))[0, 0])
    assert found == pytest.approx(step, rel=1e-6)  # derivative per unit of the root


class Ramp:
    """Replaces a Problem: a ramp with two parameters, and a track (k frames) of heights it cannot match exactly."""

    noise_level, noise_cost = 1e-3, 1e-6
    parameters = [SimpleNamespace(name=name, low=0.0, high=1.0, start=0.2, step=0.2, coordinate=lambda value: value)
                  for name in ("friction", "loss")]  # fmt: skip

    def __init__(self, frames: int = 40):
        self.track = np.arange(frames) / 40

    def first_frames(self, frames: int) -> "Ramp":
        return Ramp(frames)

    def residuals(self, x: np.ndarray) -> np.ndarray:
        return (x[0] - 0.6) + 4 * (x[1] - 0.4) * self.track + 0.05 * np.sin(25 * self.track)

    def cost(self, residuals: np.ndarray) -> float:
        return float(np.log1p(residuals**2).mean())

    def error(self, residuals: np.ndarray) -> float:
        return float(np.square(residuals).sum() ** 0.5)

    def rmse(self, residuals: np.ndarray) -> float:
        return float(np.square(residuals).mean() ** 0.5)


@pytest.mark.skipif(find_spec("cma") is None, reason="cma is not installed")
def test_a_track_that_the_engine_cannot_follow_to_its_noise_is_followed_to_its_end():
    """The search must not spend all its simulations on the first segments."""

    class Ramps(Simulations):
        def residuals(self, points, frames):
            self.count += len(points)
            return [Ramp(frames).residuals(np.clip(x, 0, 1)) for x in points]

    sims = Ramps(Ramp(), map)
    found = search.search(sims, replace(OPTIONS, evaluations=10_000))
    assert sims.count < 2_000
    np.testing.assert_allclose(found.x, [0.6, 0.4], atol=0.02)
    assert (found.deviations > 0.002).all()  # larger than for the noise, and smaller than before
    assert (found.deviations < 0.15).all()


@pytest.fixture
def ramps(monkeypatch):
    """Function that creates simulations of a ramp, which end at a given time, and their simulated clock.

    A simulation of all frames takes one second, and the first one two seconds more, like the start of processes.
    """
    clock = SimpleNamespace(now=0.0, started=False)
    monkeypatch.setattr(search, "time", SimpleNamespace(perf_counter=lambda: clock.now))

    def simulated(_, points, frames):
        for x, n in zip(points, frames, strict=True):
            clock.now += n / 40 + (0 if clock.started else 2)
            clock.started = True
            yield Ramp(n).residuals(x)

    return lambda until: Simulations(Ramp(), simulated, until), clock


def test_the_simulations_of_the_end_of_a_fit_are_known_beforehand(ramps):
    sims = ramps[0](np.inf)
    near = Estimate(np.array([0.3, 0.6]), 0.2 * np.eye(2))
    descend(sims, 40, near, sims.noise)
    assert len(near.x) < sims.count <= descent_simulations(2)
    before = sims.count
    with_intervals(sims, 40, near, sims.noise)
    assert sims.count - before == interval_simulations(2)
    before = sims.count
    _settled(sims, near)
    assert interval_simulations(2) < sims.count - before <= final_simulations(2)


@pytest.mark.skipif(find_spec("cma") is None, reason="cma is not installed")
@pytest.mark.parametrize(("until", "determined"), [(0, False), (10, False), (40, False), (140, True), (400, True)])
def test_a_fit_and_its_intervals_end_in_time(until, determined, ramps):
    """If not, the intervals are undetermined, and none is computed from half of the differences."""
    make, clock = ramps
    sims = make(until)
    fit = _settled(sims, search.search(sims, replace(OPTIONS, evaluations=10_000)))
    assert clock.now <= until + (OUTCOME + 2 if until == 0 else 1)
    assert fit.determined == determined
    if determined:
        assert (abs(fit.found.x - [0.6, 0.4]) < fit.half).all() and (fit.half < 0.5).all()
    else:
        assert fit.half_width(0) is None and not fit.is_identifiable(0)
        np.testing.assert_array_equal(fit.accepted, fit.found.x)


def test_what_was_found_before_the_time_ended_stays(ramps):
    """A descent that ends early has a result that is better than its start."""
    make, clock = ramps
    start = Estimate(np.array([0.9, 0.9]), 0.2 * np.eye(2))
    sims = make(20)
    x = descend(sims, 40, start, sims.noise)
    assert clock.now == 20
    assert sims.count == 18
    with pytest.raises(OutOfTime):
        sims.cost(x, 40)
    sims.until = np.inf
    assert sims.cost(x, 40) < sims.cost(start.x, 40) / 10


def test_the_start_of_processes_is_not_taken_for_the_time_of_simulations(ramps):
    make, clock = ramps
    sims = make(10)
    sims.costs([sims.start], 4)
    sims.reserved = OUTCOME
    with pytest.raises(OutOfTime):
        while True:
            sims.costs([sims.start], 4)
    assert clock.now == pytest.approx(10 - OUTCOME, abs=0.11)


def test_the_command_says_which_intervals_the_time_did_not_allow(bounce, tmp_path, device):
    out = tmp_path / "m.json"
    words = ["fit", bounce / "scene.ply", bounce / "track.h5", "-o", out, "--workers", 1, "--minutes", 1e-6]
    done = CliRunner().invoke(app, [str(word) for word in [*words, "--device", device]])
    assert done.exit_code == 0, done.output
    assert "object 1 (body1): friction" in done.stdout and "not determined within --minutes" in done.stdout
    assert "+-" not in done.stdout
    rows = json.loads(out.with_suffix(".fit.json").read_text())["parameters"]
    assert [(row["half_width"], row["identifiable"]) for row in rows] == [(None, False)] * 2
