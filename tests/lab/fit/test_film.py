"""Materials from films of a toy rendered by `render`; unsuitable films are refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from ngff_cli.lab import app
from stages.core.errors import InputError
from stages.core.scene.images import VideoWriter, read_video
from stages.core.scene.scene_ply import write_scene
from stages.core.scene.sequence import FilmedSequence
from stages.lab.bench.fit_films import film, filmed_toy
from stages.lab.fit.film import by_camera, read_film_problem, robust, timing
from stages.lab.fit.fit import _kept, solve
from stages.lab.fit.options import MaterialFitOptions
from stages.lab.fit.search import OUTCOME, Estimate, descend, simulations
from tests.conftest import CliRunner

OPTIONS = MaterialFitOptions(engine="rigid", workers=1, keypoints=16, resolution=160)
FRAMES = 8


def still_film(path, frames=4, fps=50.0, size=(64, 48)):
    """A film of constant grey."""
    with VideoWriter(path, fps) as video:
        for _ in range(frames):
            video.append(torch.full((size[1], size[0], 3), 0.5))
    return path


def true_point(problem, toy):
    """Its true coordinates, with the initial value of the loss factor, which a slide does not reveal."""
    true = {"friction": toy.material.friction, "x": toy.velocity[0], "y": toy.velocity[1]}
    return np.array([p.coordinate(true.get(p.name, p.start)) for p in problem.parameters])


def values(problem, x):
    """Values of the parameters by name."""
    return {p.name: p.value(v) for p, v in zip(problem.parameters, x, strict=True)}


@pytest.fixture(scope="module")
def slide(tmp_path_factory, device):
    """A sliding block, its scene and films, and the fit problem of these."""
    folder, toy = tmp_path_factory.mktemp("slide"), filmed_toy("slide", 2, 160, seed=110)
    scene, films = film(toy, FRAMES, folder)
    return toy, scene, films, read_film_problem(scene, films, replace(OPTIONS, device=device))


def test_the_true_motion_explains_the_pictures_best(slide):
    toy, _, _, problem = slide
    assert [p.name for p in problem.parameters] == ["friction", "loss", "x", "y"]
    exact = true_point(problem, toy)

    def cost(change):
        return problem.cost(problem.residuals(problem.motion(exact + change)))

    least = cost(np.zeros(4))
    assert least < problem.noise_margin * problem.noise_level**2  # as for tracked poses without any engine
    assert all(
        cost(sign * change) > 1.1 * least for change in np.diag([0.1, 0, 0.02, 0.02])[[0, 2, 3]] for sign in (1, -1)
    )


@pytest.mark.slow
@pytest.mark.parametrize("level", [0, 1], ids=["coarse", "fine"])
def test_friction_and_velocity_are_found_from_near_in_pictures_alone(level, slide):
    """The motion improves from 5 mm or more to within 1 mm at all points and times; the parameters are correlated."""
    toy, _, _, problem = slide
    exact = true_point(problem, toy)
    near = Estimate(exact + [0.03, 0.0, 0.02, -0.02], np.diag([0.03, 0.05, 0.02, 0.02]))
    with simulations(problem.levels[level], 1) as sims:
        x = descend(sims, FRAMES, near, sims.noise)
    truth, start, end = (problem.motion(point) for point in (exact, near.x, x))
    assert (start - truth).norm(dim=-1).max() > 0.005
    assert (end - truth).norm(dim=-1).max() < 0.001
    before, found = values(problem, near.x), values(problem, x)
    assert before["friction"] > toy.material.friction + 0.03 and before["x"] > toy.velocity[0] + 0.03
    assert found["friction"] == pytest.approx(toy.material.friction, abs=0.03)
    assert (found["x"], found["y"]) == pytest.approx(toy.velocity[:2], abs=0.03)


def test_a_motion_that_diverges_has_no_residuals(slide):
    problem = slide[-1]
    residuals = problem.residuals(torch.full_like(problem.track, torch.nan))
    assert len(residuals) == len(problem.residuals(problem.track)) and np.isnan(residuals).all()
    assert problem.cost(residuals) > problem.cost(problem.residuals(problem.track))


def test_the_first_frames_have_the_first_pictures(slide):
    part = slide[-1].first_frames(5)
    assert {p.film for p in part.pictures} == {0, 1} and max(p.time for p in part.pictures) == 4
    assert len(part.residuals(part.track)) == 3 * sum(int(p.window.sum()) for p in part.pictures)


def test_large_differences_are_bounded():
    small, large = torch.full((1, 3), 0.01), torch.full((1, 3), 100.0)
    assert torch.allclose(robust(small), small, rtol=1e-3) and robust(large).square().mean() == pytest.approx(
        1, abs=1e-3
    )
    assert torch.equal(robust(-large), -robust(large))


def test_without_time_pictures_determine_no_intervals(slide):
    """The intervals of the preceding track are not reported instead."""
    *_, problem = slide
    fit = solve(problem, replace(OPTIONS, minutes=1e-6))
    assert fit.problem is problem and not fit.determined
    assert [fit.half_width(k) for k in range(4)] == [None] * 4
    assert fit.evaluations == 2 * OUTCOME  # one run each for the track and the images


def test_time_is_kept_for_pictures_but_not_more_than_half(slide):
    *_, problem = slide
    assert 0 < _kept(problem, 1e9) < 1e6 and _kept(problem, 1e-3) == 5e-4
    assert _kept(problem.tracked, 1e9) == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [111, 112, 113])
def test_the_command_finds_friction_and_velocity_from_two_films(seed, tmp_path, device):
    toy = filmed_toy("slide", 2, 240, seed)
    scene, films = film(toy, 20, tmp_path)
    out = tmp_path / "m.json"
    words = ["fit", scene, *films, "-o", out, "--workers", 1, "--device", device]
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
    rows = {row["quantity"]: row for row in json.loads(out.with_suffix(".fit.json").read_text())["parameters"]}
    speed = np.hypot(*toy.velocity[:2])
    assert rows["friction"]["identifiable"] and not rows["loss"]["identifiable"]
    assert rows["friction"]["value"] == pytest.approx(toy.material.friction, abs=0.05)
    assert (rows["x"]["value"], rows["y"]["value"]) == pytest.approx(toy.velocity[:2], abs=0.03 * speed)
    assert json.loads(out.read_text())["1"]["friction"] == pytest.approx(toy.material.friction, abs=0.05)
    assert "colours from 0 to 1" in done.stdout and '--velocity "object=1 ' in done.stdout


@pytest.mark.slow
def test_films_of_a_sequence_start_when_the_scene_says(slide, tmp_path, device):
    toy, _, films, _ = slide
    before = {"camera00.mp4": 3, "camera01.mp4": 5}
    for path in films:
        pictures = list(read_video(path))
        with VideoWriter(tmp_path / path.name, 50.0) as video:
            for image in [pictures[0]] * before[path.name] + pictures:
                video.append(image)
    starts = {name: float(n) for name, n in before.items()}
    write_scene(tmp_path / "scene.ply", replace(toy.scene, sequence=FilmedSequence(50.0, FRAMES, starts)))
    options = replace(OPTIONS, device=device)
    fit = solve(read_film_problem(tmp_path / "scene.ply", [tmp_path / path.name for path in films], options), options)
    found = {p.name: fit.value(k) for k, p in enumerate(fit.problem.parameters)}
    assert found["friction"] == pytest.approx(toy.material.friction, abs=0.05)
    assert (found["x"], found["y"]) == pytest.approx(toy.velocity[:2], abs=0.05)


def test_films_of_no_camera_of_the_scene_are_refused(slide, tmp_path):
    _, scene, films, problem = slide
    world = problem.scene
    with pytest.raises(InputError, match="beach.mp4.* has no camera of this name; .*camera00, camera01"):
        by_camera(world, scene, [*films, tmp_path / "beach.mp4"])
    with pytest.raises(InputError, match="of the same camera"):
        by_camera(world, scene, [films[0], tmp_path / "camera00.mov"])
    with pytest.raises(InputError, match="has no cameras"):
        by_camera(replace(world, cameras=None), scene, films)


def test_films_of_other_frame_rates_are_refused(slide, tmp_path):
    _, scene, films, problem = slide
    slow = {"camera00.mp4": still_film(tmp_path / "camera00.mp4", fps=25.0)}
    with pytest.raises(InputError, match="the same frame rate"):
        timing(problem.scene, scene, {**slow, "camera01.mp4": films[1]}, 0)
    filmed = replace(problem.scene, sequence=FilmedSequence(50.0, 9, {"camera01.mp4": 2.5}))
    with pytest.raises(InputError, match="camera00.mp4: has 25 frames per second, but the films of .* have 50"):
        timing(filmed, scene, slow, 0)
    with pytest.raises(InputError, match="does not state when this camera started"):
        timing(filmed, scene, {"camera00.mp4": films[0]}, 0)
    assert timing(filmed, scene, {"camera01.mp4": films[1]}, 4) == FilmedSequence(50.0, 4, {"camera01.mp4": 2.5})


def test_films_that_show_nothing_of_the_scene_are_refused(slide, tmp_path):
    _, scene, _, _ = slide
    with pytest.raises(InputError, match="its first frame shows no object where .* has one"):
        read_film_problem(scene, [still_film(tmp_path / "camera00.mp4")], OPTIONS)
    with pytest.raises(InputError, match="has 2 frames from the start of the motion on; give a film of three"):
        read_film_problem(scene, [still_film(tmp_path / "camera01.mp4", frames=2)], OPTIONS)


@pytest.mark.parametrize(("names", "message"), [
    (("track.h5", "camera00.mp4"), "track.h5: a track cannot be combined"),
    (("a.h5", "b.h5"), "a.h5: a track cannot be combined"),
    (("notes.txt",), "notes.txt"),
    (("camera00.mp4",), "camera00.mp4: no such file"),
])  # fmt: skip
def test_the_command_names_a_file_that_it_cannot_use(names, message, slide, tmp_path):
    done = CliRunner().invoke(app, ["fit", str(slide[1]), *(str(tmp_path / name) for name in names)])
    assert done.exit_code != 0
    assert message in str(done.exception) + done.output
