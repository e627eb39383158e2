"""The benchmark of materials from films: its scenes, and one complete scene."""

import pytest
import torch

from stages.core.errors import InputError
from stages.lab.bench.fit_films import filmed_toy, run
from stages.lab.bench.motion_options import FILM_KINDS, FilmBenchOptions


@pytest.mark.parametrize("kind", FILM_KINDS)
def test_toys_are_drawn_by_seed(kind):
    toy, same, other = (filmed_toy(kind, 2, 128, seed) for seed in (0, 0, 1))
    assert (toy.material, toy.velocity) == (same.material, same.velocity) and toy.material != other.material
    assert torch.equal(toy.scene.gaussians.means, same.scene.gaussians.means)
    assert toy.scene.cameras.names == ("camera00.mp4", "camera01.mp4")
    lowest = float(toy.scene.gaussians.means[toy.scene.gaussians.object_id == 1][:, 2].min())
    assert (lowest > 0.05) == (kind == "throw") and (toy.velocity[2] != 0) == (kind == "throw")


def test_unusable_options_are_refused():
    with pytest.raises(InputError, match="choose from slide, throw"):
        FilmBenchOptions(only="fly")
    with pytest.raises(InputError, match="--frames 3 or more"):
        FilmBenchOptions(frames=2)


@pytest.mark.slow
def test_a_slide_from_films_and_from_its_track(tmp_path, device):
    options = FilmBenchOptions(scenes=1, only="slide", width=160, frames=15, workers=1, seed=114, device=device)
    of_films, of_track = run(tmp_path / "results.json", options)
    assert of_films.startswith("slide 114: friction") and of_track.startswith("    of the track: friction")
    assert (tmp_path / "results.json").is_file()
